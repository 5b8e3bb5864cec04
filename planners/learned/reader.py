"""What a checkpoint file holds, read without running anything that is in it.

Torch files are pickles, and a pickle is a program. They are read with torch's own restricted
loader, which knows plain containers and the numpy scalars allowed here. Where a file holds more, as
training frameworks leave behind, a second reader keeps the tensors and puts something inert in the
place of every object of another class. Nothing of a foreign class is ever imported or called.
"""

import json
import pickle
import warnings
import zipfile
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from pickletools import genops
from typing import Any

import numpy as np

from shiftsim.errors import CheckpointError

_LEGACY_MAGIC = b"l\xfc\x9cF\xf9 j\xa8P\x19"  # the number with which torch < 1.6 began its files
_HEADER_BYTES = 64
_STORAGES = {  # names of typed storages in a torch file
    "DoubleStorage": "float64",
    "FloatStorage": "float32",
    "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16",
    "LongStorage": "int64",
    "IntStorage": "int32",
    "ShortStorage": "int16",
    "CharStorage": "int8",
    "ByteStorage": "uint8",
    "BoolStorage": "bool",
}
_TORCH_HINT = "download it again, and compare its size with the one that its authors publish"
ARGS_HINT = "use the args.json that was published with the checkpoint"
_WRITTEN_HINT = "give the checkpoint that the training wrote"
_NUMBERED = ("PUT", "LONG_BINPUT")  # a pickle's reader makes room for all up to a number
# what content of any kind makes code raise that takes it for granted
MISFIT = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
# what reading a damaged file raises
BROKEN = (*MISFIT, pickle.UnpicklingError, zipfile.BadZipFile, EOFError, ImportError, MemoryError)


@dataclass(frozen=True, slots=True)
class Contents:
    """A file as read."""

    container: str  # what kind of file it is
    entries: dict[str, Any]  # its top level: tensors, and what else is plain
    # texts beside the tensors of a safetensors file
    metadata: dict[str, str] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()  # names of the classes whose objects were left out


def read_contents(path: Path) -> Contents:
    """Tensors and plain values of a torch or safetensors file.

    Raises:
        CheckpointError: It is neither, or it is damaged.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
    except OSError as error:
        raise unreadable(path, error) from error
    if head.startswith(b"PK\x03\x04"):
        return _read_zip(path)
    if _LEGACY_MAGIC in head:
        return _read_legacy(path)
    if head[8:9] == b"{":
        return _read_safetensors(path)
    raise CheckpointError(f"checkpoint {str(path)!r} {_what_else(head)}", _WRITTEN_HINT)


def unreadable(path: Path, error: OSError) -> CheckpointError:
    """The error to raise for a file that cannot be opened."""
    text = f"checkpoint {str(path)!r} cannot be read ({error.strerror})"
    return CheckpointError(text, "check the path")


def _what_else(head: bytes) -> str:
    """What a file is that is no checkpoint."""
    if not head:
        return "is empty"
    if head.startswith(b"version https://git-lfs"):
        return "is a Git LFS pointer, not the file itself; run git lfs pull where it came from"
    if head.lstrip().startswith(b"<"):
        return "is a web page: the download has failed"
    if head.startswith(b"\x80"):
        return "is a pickle, but none that torch has saved"
    return "is neither a torch nor a safetensors file"


def _read_safetensors(path: Path) -> Contents:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            entries = {name: file.get_tensor(name) for name in file.keys()}
            return Contents("safetensors", entries, dict(file.metadata() or {}))
    except (SafetensorError, *BROKEN) as error:
        raise _damaged(path, error) from error


def _read_zip(path: Path) -> Contents:
    try:
        with zipfile.ZipFile(path) as archive:
            root = _root_of(archive, path)
            if bad := archive.testzip():  # torch itself would load other numbers
                raise zipfile.BadZipFile(f"wrong checksum of {bad}")
            return _load(path, "torch zip") or _read_tensors(archive, root, path)
    except CheckpointError:
        raise
    except (*BROKEN, OSError) as error:
        raise _damaged(path, error) from error


def _read_legacy(path: Path) -> Contents:
    found = _load(path, "torch, before 1.6")
    if found is None:
        raise CheckpointError(
            f"checkpoint {str(path)!r} is damaged, or holds more than tensors in the old "
            "format of torch < 1.6",
            hint="where you trust it, load it with torch and save its state_dict alone",
        )
    return found


def _load(path: Path, container: str) -> Contents | None:
    """What torch's restricted loader reads; None where it refuses."""
    import torch

    try:
        with torch.serialization.safe_globals(list(_allowed())), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other pickle protocols
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # damaged files make torch raise whatever there is
        return None
    return Contents(container, _as_entries(loaded, path))


def _allowed() -> Iterator[Any]:
    """Numpy scalars, under their old name too, and plain containers."""
    scalar: Any = np.float64(0.0).__reduce__()[0]
    yield from ((scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core"))
    yield np.dtype
    kinds = (np.bool_, np.int32, np.int64, np.uint8, np.float16, np.float32, np.float64)
    yield from (type(np.dtype(kind)) for kind in kinds)
    yield from (defaultdict, dict, list, set, tuple)


def _as_entries(loaded: Any, path: Path) -> dict[str, Any]:
    if not isinstance(loaded, dict):
        raise CheckpointError(
            f"checkpoint {str(path)!r} holds one {type(loaded).__name__}, not tensors by name",
            _WRITTEN_HINT,
        )
    return {str(name): value for name, value in loaded.items()}


def _root_of(archive: zipfile.ZipFile, path: Path) -> str:
    """The folder inside a torch zip that everything is in."""
    names = archive.namelist()
    roots = [name.removesuffix("/data.pkl") for name in names if name.endswith("/data.pkl")]
    if not roots:
        what = f"checkpoint {str(path)!r} is a zip file that torch has not saved"
        raise CheckpointError(what, _WRITTEN_HINT)
    if f"{roots[0]}/constants.pkl" in names:
        text = f"checkpoint {str(path)!r} is a TorchScript program, not a state_dict"
        raise CheckpointError(text, _WRITTEN_HINT)
    return roots[0]


def _read_tensors(archive: zipfile.ZipFile, root: str, path: Path) -> Contents:
    """The tensors of a torch zip that holds objects of other classes too."""
    order = f"{root}/byteorder"
    if order in archive.namelist() and archive.read(order) != b"little":
        raise ValueError("its numbers are big-endian")
    reader = _TensorReader(archive.read(f"{root}/data.pkl"), archive, root)
    entries = _as_entries(reader.load(), path)
    return Contents("torch zip", entries, skipped=tuple(sorted(reader.foreign)))


def _damaged(path: Path, error: BaseException) -> CheckpointError:
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    return CheckpointError(f"checkpoint {str(path)!r} is damaged: {text}", hint=_TORCH_HINT)


class Inert(dict[Any, Any]):
    """In the place of an object of a foreign class: takes everything, does nothing."""

    def __new__(cls, *_args: object, **_named: object) -> "Inert":
        """Another one, whatever it is made with."""
        return dict.__new__(cls)

    def __init__(self, *_args: object, **_named: object) -> None:
        super().__init__()

    def __call__(self, *_args: object, **_named: object) -> "Inert":
        """Another one, as what is in its place may be called."""
        return Inert()

    def _ignore(self, _anything: object) -> None:
        pass

    __setstate__ = append = extend = add = _ignore
    __hash__ = object.__hash__  # type: ignore[assignment]  # keys of a dict must be hashable
    __eq__ = object.__eq__


class PlainReader(pickle.Unpickler):
    """Reads a pickle; of what it names only that which is known is there, the rest is inert.

    Nothing that the file names is imported, and nothing is called but what is known.
    """

    def __init__(self, content: bytes, known: Callable[[str, str], Any]) -> None:
        """`known` gives what a module and a name stand for, None where they are foreign.

        Raises:
            ValueError: The pickle is cut short, or asks for memory that its size does not explain.
        """
        for operation, argument, _ in genops(content):
            if operation.name in _NUMBERED and int(argument or 0) > len(content):
                raise ValueError(f"object number {argument} in a pickle of {len(content)} bytes")
        super().__init__(BytesIO(content), encoding="utf-8")
        self.foreign: set[str] = set()
        self._known = known

    def find_class(self, module: str, name: str) -> Any:
        """What a name in the file stands for: something known, or something inert."""
        known = self._known(module, name)
        if known is None:
            self.foreign.add(f"{module}.{name}")
            return type("Inert", (Inert,), {})
        return known


class _TensorReader(PlainReader):
    """Reads tensors and plain containers."""

    def __init__(self, content: bytes, archive: zipfile.ZipFile, root: str) -> None:
        names = _known_names()
        super().__init__(content, lambda module, name: names.get((module, name)))
        self._archive = archive
        self._root = root
        self._storages: dict[str, Any] = {}

    def persistent_load(self, pid: Any) -> Any:
        """A storage as a flat tensor on the CPU, wherever it was saved from."""
        import torch

        _, dtype, key, _, count = pid
        if not isinstance(dtype, torch.dtype):
            return Inert()
        if key not in self._storages:
            info = self._archive.getinfo(f"{self._root}/data/{key}")
            if info.compress_type != zipfile.ZIP_STORED or info.file_size < count * dtype.itemsize:
                raise ValueError(f"storage {key} has {info.file_size} bytes")
            flat = torch.frombuffer(bytearray(self._archive.read(info) or b"\0" * 8), dtype=dtype)
            self._storages[key] = flat[:count]
        return self._storages[key]


def _known_names() -> dict[tuple[str, str], Any]:
    """All that a torch file may name, by module and name."""
    import torch

    known: dict[tuple[str, str], Any] = {
        ("collections", "OrderedDict"): OrderedDict,
        ("torch._utils", "_rebuild_tensor"): _tensor,
        ("torch._utils", "_rebuild_tensor_v2"): _tensor,
        ("torch._utils", "_rebuild_parameter"): _first,
        ("torch._utils", "_rebuild_parameter_with_state"): _first,
        ("torch._tensor", "_rebuild_from_type_v2"): _call_known,
        ("torch", "Size"): tuple,
    }
    for storage, dtype in _STORAGES.items():
        known["torch", storage] = getattr(torch, dtype)
        known["torch", dtype] = getattr(torch, dtype)
    return known


def _tensor(flat: Any, offset: int, size: Any, stride: Any, *_: object) -> Any:
    if isinstance(flat, Inert):
        return flat
    return flat.as_strided(tuple(size), tuple(stride), offset)


def _first(data: Any, *_: object) -> Any:
    return data


def _call_known(function: Callable[..., Any], _kind: object, arguments: Any, _state: object) -> Any:
    """A tensor with attributes: the tensor alone."""
    return function(*arguments) if function in (_tensor, _first) else Inert()


def read_json_object(path: Path) -> dict[str, Any]:
    """A JSON file that holds one object, such as `args.json`; else a CheckpointError."""
    try:
        value = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        what = f"{str(path)!r} cannot be read as JSON ({error})"
        raise CheckpointError(what, ARGS_HINT) from error
    if not isinstance(value, dict):
        what = f"{str(path)!r} holds {type(value).__name__}, not an object"
        raise CheckpointError(what, ARGS_HINT)
    return value
