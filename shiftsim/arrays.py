"""Array type aliases, and the decorators that compile kernels.

Shapes and units are in the docstrings; the aliases say the kind of number only.

Compiled kernels are cached on disk. numba's cache looks only at the file of the outermost kernel,
so in a checkout, where a kernel or constant of another file may change under it, every file with
kernels has a cache of its own, named by a hash of that file and of all that it imports. An
installed package is replaced as a whole and needs no such care. `NUMBA_CACHE_DIR` overrides both.
"""

import hashlib
import os
import re
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from shiftsim.files import PACKAGE, sources

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


class _Door:
    """What a sealed array has for a base: its one attribute cannot be looked into."""

    __slots__ = ("__array_struct__",)
    __array_struct__: object


def sealed(array: Any) -> Any:
    """The same memory as an array that cannot be written, nor be made writable.

    Its `base` leads to no array.
    """
    view, door = array.view(), _Door()
    view.flags.writeable = False
    door.__array_struct__ = view.__array_struct__  # holds the memory
    return np.asarray(door)


CACHE = PACKAGE.parent / ".numba-cache"  # in a checkout
_USES_CACHE = "NUMBA_CACHE_DIR" not in os.environ and (CACHE.parent / "pyproject.toml").is_file()
_COMPILED = re.compile(rb"kernel|^[A-Z][A-Z0-9_, ]* = ", re.MULTILINE)  # constants are, too


def cache_folder(file: str = "") -> str:
    """Where the compiled kernels of a source file are; without one, where all of them are."""
    if not _USES_CACHE:
        return str(vars(numba.config)["CACHE_DIR"])
    return _folder_of(Path(file)) if file else str(CACHE)


@cache
def _folder_of(path: Path) -> str:
    digest = hashlib.sha256()
    is_ours = path.is_relative_to(PACKAGE)
    for name, source in sorted(sources([path] if is_ours else PACKAGE.rglob("*.py")).items()):
        if _COMPILED.search(source):
            digest.update(name.encode() + b"\n" + source)
    return str(CACHE / digest.hexdigest()[:16])


# The entry point for C, which nobody calls, would take a tenth of the time to compile.
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Any) -> Any:
    """Compile a function over plain arrays and cache the machine code on disk.

    No fastmath and no parallel loops: results must not depend on the processor or on the number
    of threads. Division by zero gives inf or NaN, as in NumPy.
    """
    # said although it is the default: a kernel called by a lean one would inherit the opposite
    return _compiled(function, counts_references=True)


def lean_kernel(function: Any) -> Any:
    """As `kernel`, for functions that make no arrays and count no references.

    Neither may they return one, nor call a kernel that does: it would never be given back.

    Counting takes a third of the time of kernels that hand many arrays to small ones.
    """
    return _compiled(function, counts_references=False)


def _compiled(function: Any, *, counts_references: bool) -> Any:
    # a setting that numba makes at run time, and reads when a function is decorated
    vars(numba.config)["CACHE_DIR"] = cache_folder(function.__code__.co_filename)
    return numba.njit(**(_OPTIONS | {"_nrt": counts_references}))(function)
