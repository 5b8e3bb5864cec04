"""What a checkpoint file holds, read without running anything that is in it.

Torch files are pickles, and a pickle is a program: torch reads plain containers and tensors of it
alone, and for every other class that a file names, as training frameworks leave behind, an empty
dictionary stands.
"""

import json
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import CheckpointError

_LEGACY_MAGIC = b"l\xfc\x9cF\xf9 j\xa8P\x19"  # the number with which torch < 1.6 began its files
_HEADER_BYTES = 64
ARGS_HINT = "use the args.json that was published with the checkpoint"
WRITTEN_HINT = "give the checkpoint that the training wrote"
_DAMAGED_HINT = (
    "download it again, and compare its size with the one that its authors publish; or, where you "
    "trust it, load it with torch.load(…, weights_only=False) and save its state_dict alone"
)


@dataclass(frozen=True, slots=True)
class Contents:
    """A file as read."""

    container: str  # what kind of file it is
    entries: dict[str, Any]  # its top level: tensors, and what else is plain
    # texts beside the tensors of a safetensors file
    metadata: dict[str, str] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()  # names of the classes whose objects were left out


class _StandIn:
    """In the place of a foreign class: an empty dictionary, whatever an object is made with."""

    def __new__(cls, *_args: object) -> "OrderedDict[Any, Any]":  # type: ignore[misc]
        return OrderedDict()


def read_contents(path: Path) -> Contents:
    """Tensors and plain values of a torch or safetensors file; else a CheckpointError."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEADER_BYTES)
    except OSError as error:
        raise unreadable(path, error) from error
    is_zip = head.startswith(b"PK\x03\x04")
    if not is_zip and _LEGACY_MAGIC not in head and head[8:9] != b"{":
        raise CheckpointError(f"checkpoint {str(path)!r} {_what_else(head)}", WRITTEN_HINT)
    try:
        contents = _read_safetensors(path) if head[8:9] == b"{" else _read_torch(path, is_zip)
    except Exception as error:  # damaged files make torch raise whatever there is
        text = (str(error) or type(error).__name__).splitlines()[0]
        what = "is damaged, or holds more than tensors and plain values"
        raise CheckpointError(f"checkpoint {str(path)!r} {what}: {text}", _DAMAGED_HINT) from error
    loaded: object = contents.entries  # of torch.load, which may return anything
    if not isinstance(loaded, dict):
        what = f"holds one {type(loaded).__name__}, not tensors by name"
        raise CheckpointError(f"checkpoint {str(path)!r} {what}", WRITTEN_HINT)
    return contents


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
    return "is neither a torch nor a safetensors file"


def _read_safetensors(path: Path) -> Contents:
    from safetensors import safe_open

    with safe_open(path, framework="pt", device="cpu") as file:
        entries = {name: file.get_tensor(name) for name in file.keys()}
        return Contents("safetensors", entries, dict(file.metadata() or {}))


def _read_torch(path: Path, is_zip: bool) -> Contents:
    import torch

    skipped: list[str] = []
    with torch.serialization.safe_globals(list(_numpy_scalars())), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other pickle protocols
        if is_zip:
            with zipfile.ZipFile(path) as archive:
                if bad := archive.testzip():  # torch itself would load other numbers
                    raise zipfile.BadZipFile(f"wrong checksum of {bad}")
            skipped = sorted(torch.serialization.get_unsafe_globals_in_checkpoint(path))
        stand_ins: list[Any] = [(_StandIn, name) for name in skipped]
        with torch.serialization.safe_globals(stand_ins):
            loaded = torch.load(path, map_location="cpu", weights_only=True)
    if isinstance(loaded, dict):
        loaded = {str(name): value for name, value in loaded.items()}
    return Contents("torch zip" if is_zip else "torch, before 1.6", loaded, skipped=tuple(skipped))


def _numpy_scalars() -> Iterator[Any]:
    """What numbers of NumPy are made of, under its old name too."""
    scalar: Any = np.float64(0.0).__reduce__()[0]
    yield from ((scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core"))
    yield np.dtype
    kinds = (np.bool_, np.int32, np.int64, np.uint8, np.float16, np.float32, np.float64)
    yield from (type(np.dtype(kind)) for kind in kinds)


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
