"""Array type aliases, the decorators that compile kernels, and how they are given many arrays.

Shapes and units are in the docstrings; the aliases say the kind of number only.

Compiled kernels are kept on disk: in a checkout in `CACHE`, for an installed package where numba
would keep them, and in `NUMBA_CACHE_DIR` where that is set. What is kept counts only as long as the
file of the kernel and all that it imports are the same. Trouble with it costs time, nothing else.
"""

import gc
import hashlib
import logging
import os
import pickle
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numba
import numpy as np
from numba.core import event
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox
from numpy.typing import NDArray

from shiftsim.files import PACKAGE, sources

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


class _Door:
    """What a sealed array has for a base: its one attribute cannot be looked into."""

    __slots__ = ("__array_struct__",)
    __array_struct__: object


def _behind_door(view: Any) -> Any:
    door = _Door()
    door.__array_struct__ = view.__array_struct__  # holds the memory
    return np.asarray(door)


# An array as another one over the same memory, read-only if it is, whose `base` leads to no array.
# NumPy before 2.1 passes on no read-only array, and takes twice as long in our way.
_IS_NEW = np.lib.NumpyVersion(np.__version__) >= "2.1.0"
opaque: Any = np.from_dlpack if _IS_NEW else _behind_door


def read_only(array: Any) -> Any:
    """A view that cannot be written; its `base` can be."""
    view = array.view()
    view.flags.writeable = False
    return view


def sealed(array: Any) -> Any:
    """The same memory as an array that cannot be written, nor be made writable.

    Its `base` leads to no array.
    """
    return opaque(read_only(array))


CACHE = PACKAGE.parent / ".numba-cache"  # in a checkout
_USES_CACHE = "NUMBA_CACHE_DIR" not in os.environ and (CACHE.parent / "pyproject.toml").is_file()
_COMPILED = re.compile(rb"kernel|^[A-Z][A-Z0-9_, ]* = ", re.MULTILINE)  # constants are, too


_LOG = logging.getLogger(__name__)


def cache_folder(file: str = "") -> str:
    """Where the compiled kernels of a source file are; without one, where all of them are."""
    if not _USES_CACHE:
        return str(vars(numba.config)["CACHE_DIR"])
    return str(CACHE / _fingerprint(Path(file))) if file else str(CACHE)


@cache
def _fingerprint(path: Path) -> str:
    """Hash of all that the kernels of a source file are made of."""
    digest = hashlib.sha256()
    is_ours = path.is_relative_to(PACKAGE)
    for name, source in sorted(sources([path] if is_ours else PACKAGE.rglob("*.py")).items()):
        if _COMPILED.search(source):
            digest.update(name.encode() + b"\n" + source)
    return digest.hexdigest()[:16]


class _Kept(FunctionCache):
    """What is kept of one kernel: a file for each signature, whole and with its hash, or ignored.

    numba's own files have no hash. They have an index, which a kill or a second process can make
    point to the code of another signature; and numba looks only at the file of the outermost
    kernel, while a kernel or constant of another file may have changed.
    """

    def __init__(self, function: Any) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        source = Path(function.__code__.co_filename)
        stamp = self._impl.locator.get_source_stamp()
        self._made_of = (numba.__version__, stamp, _fingerprint(source))

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel, None where it is to be compiled."""
        path, key = self._file(sig, target_context.codegen())
        try:
            content = path.read_bytes()
            digest, content = content[:_DIGEST], content[_DIGEST:]
            if hashlib.sha256(content).digest() != digest:
                raise ValueError(f"{path} is damaged")
            if _NEEDS_ALL in content:
                target_context.refresh()
            else:
                rtsys.initialize(target_context)
            found, compiled = pickle.loads(content)
            return self._impl.rebuild(target_context, compiled) if found == key else None
        except FileNotFoundError:
            pass
        except Exception as error:  # unpickling may run into anything
            _say_once("kernels that were kept cannot be used and are compiled again", error)
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel, if possible."""
        if not self._impl.check_cachable(data):
            return
        path, key = self._file(sig, data.codegen)
        partial = path.with_name(f".{path.name}.{os.getpid()}")  # others may write the same file
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                content = dumps((key, self._impl.reduce(data)))  # type: ignore[no-untyped-call]
                partial.write_bytes(hashlib.sha256(content).digest() + content)
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
        except OSError as error:
            _say_once(_UNKEPT, error)

    def _file(self, sig: Any, codegen: Any) -> tuple[Path, Any]:
        """Where the code for a signature and processor is, and what it must be made of."""
        key = self._index_key(sig, codegen)  # type: ignore[no-untyped-call]
        name = hashlib.sha256(repr(key[:2]).encode()).hexdigest()[:16]
        path = Path(self.cache_path) / f"{self._impl.filename_base}.{name}.nbc"
        return path, (self._made_of, key)


# What is kept calls numba's run time, which is there at once, and only for hashes of texts a module
# that comes with all that numba can compile: a sixth of the time of a warm command.
_NEEDS_ALL = b"_numba_hashsecret"
_DIGEST = hashlib.sha256().digest_size
_UNKEPT = "compiled kernels cannot be kept and are compiled anew by every process"
_SAID = set[str]()


def _say_once(what: str, error: Exception) -> None:
    if what not in _SAID:
        _SAID.add(what)
        _LOG.warning("%s: %s", what, error)


class _NoCollection(event.Listener):
    """Compiling makes millions of objects that stay: looking for garbage takes a sixth of it."""

    def __init__(self) -> None:
        self._depth, self._was_on = 0, False

    def on_start(self, event: Any) -> None:
        """A kernel begins to be compiled, maybe within another one."""
        if self._depth == 0:
            self._was_on = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        """It is done."""
        self._depth -= 1
        if self._depth == 0 and self._was_on:
            gc.enable()


event.register("numba:compile", _NoCollection())  # type: ignore[no-untyped-call]

# The entry point for C, which nobody calls, would take a tenth of the time to compile.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Any) -> Any:
    """Compile a function over plain arrays and cache the machine code on disk.

    No fastmath and no parallel loops: results must not depend on the processor or on the number
    of threads. Division by zero gives inf or NaN, as in NumPy.
    """
    # said although it is the default: a kernel called by a lean one would inherit the opposite
    return _compiled(function, counts_references=True)


def lean_kernel(function: Any) -> Any:
    """As `kernel`, for functions that make no arrays and count no references.

    Neither may they return one, nor call a kernel that does: it would never be given back (a test
    looks at all of them).

    Counting takes a third of the time of kernels that hand many arrays to small ones.
    """
    return _compiled(function, counts_references=False)


def part_kernel(function: Any) -> Any:
    """As `lean_kernel`, for one that is called in one place of another one, and becomes part of it.

    A call of its own would copy every array that is handed over, seven words each.
    """
    return _compiled(function, counts_references=False, forceinline=True)


def _compiled(function: Any, *, counts_references: bool, **options: Any) -> Any:
    compiled = numba.njit(**(_OPTIONS | {"_nrt": counts_references} | options))(function)
    # a setting that numba makes at run time, and reads when it looks for a folder
    vars(numba.config)["CACHE_DIR"] = cache_folder(function.__code__.co_filename)
    try:
        compiled._cache = _Kept(function)
    except (OSError, RuntimeError) as error:  # no folder can be written to
        _say_once(_UNKEPT, error)
    return compiled


class Held:
    """Arrays and numbers in nested tuples, which a kernel takes as one: `contents` gives them.

    An array costs a third of a microsecond per call to hand over; this costs as much as a few. The
    arrays stay the same memory: what is written into them, kernels see. Numbers are as they were
    when it was made.
    """

    __slots__ = ("_memory", "_value", "address", "kind")

    def __init__(self, value: tuple[Any, ...]) -> None:
        """Hold what a kernel would take, arrays and numbers of eight bytes."""
        self._value = value  # keeps the arrays alive
        self._memory = np.array(list(_words(value)), np.int64)
        self.kind = _HeldType(numba.typeof(value))  # type: ignore[no-untyped-call]
        self.address = self._memory.ctypes.data

    def __reduce__(self) -> Any:
        return Held, (self._value,)  # a copy holds copies


def _words(value: Any) -> Iterator[int]:
    """What compiled code sees of a value, in words; nobody owns the arrays there."""
    if isinstance(value, tuple):
        for part in value:
            yield from _words(part)
    elif isinstance(value, np.ndarray):
        yield from (0, 0, value.size, value.itemsize, value.ctypes.data)
        yield from (*value.shape, *value.strides)
    elif isinstance(value, float):
        yield int(np.float64(value).view(np.int64))
    elif type(value) is int:
        yield value
    else:
        raise TypeError(f"cannot be held: {type(value).__name__}")


class _HeldType(numba.types.Type):
    def __init__(self, of: Any) -> None:
        super().__init__(f"Held({of})")
        self.of = of

    @property
    def key(self) -> Any:
        return self.of

    def __hash__(self) -> int:
        return hash(self.name)  # every call asks for it, and strings remember theirs


register_model(_HeldType)(models.OpaqueModel)


@typeof_impl.register(Held)
def _typeof_held(value: Held, _: Any) -> Any:
    return value.kind


@unbox(_HeldType)  # type: ignore[no-untyped-call]
def _unbox_held(_: Any, value: Any, c: Any) -> Any:
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_longlong(number)
    c.pyapi.decref(number)
    pointer = c.builder.inttoptr(address, c.pyapi.voidptr)
    return NativeValue(pointer)  # type: ignore[no-untyped-call]


def _contents(_: Any, held: Any) -> Any:
    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = context.get_value_type(signature.return_type).as_pointer()
        return builder.load(builder.bitcast(arguments[0], pointer))

    return held.of(held), codegen


contents: Any = intrinsic(_contents)  # in a kernel, what is held
