"""Array type aliases, and the decorators that compile kernels.

Shapes and units are in the docstrings; the aliases say the kind of number only.

Compiled kernels are cached on disk. numba's cache looks only at the file of the outermost kernel,
so in a checkout, where a kernel of another file may change under it, the cache lives in a folder
named by a hash of all kernel sources. An installed package is replaced as a whole and needs no such
care. `NUMBA_CACHE_DIR` overrides both.
"""

import hashlib
import os
from pathlib import Path
from typing import Any, TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]

_CHECKOUT = Path(__file__).resolve().parent.parent


def _kernel_sources() -> list[Path]:
    folders = ("shiftsim", "planners", "metrics", "data")
    return sorted(path for name in folders for path in (_CHECKOUT / name).rglob("*.py"))


def _use_checkout_cache() -> None:
    if "NUMBA_CACHE_DIR" in os.environ or not (_CHECKOUT / "pyproject.toml").is_file():
        return
    digest = hashlib.sha256()
    for path in _kernel_sources():
        if b"kernel" in (source := path.read_bytes()):
            digest.update(path.name.encode() + b"\n" + source)
    folder = _CHECKOUT / ".numba-cache" / digest.hexdigest()[:16]
    vars(numba.config)["CACHE_DIR"] = str(folder)  # a setting that numba makes at run time


_use_checkout_cache()


# The entry point for C, which nobody calls, would take a tenth of the time to compile.
_OPTIONS: dict[str, Any] = {"cache": True, "error_model": "numpy", "no_cfunc_wrapper": True}


def kernel(function: Any) -> Any:
    """Compile a function over plain arrays and cache the machine code on disk.

    No fastmath and no parallel loops: results must not depend on the processor or on the number
    of threads. Division by zero gives inf or NaN, as in NumPy.
    """
    # said although it is the default: a kernel called by a lean one would inherit the opposite
    return numba.njit(**(_OPTIONS | {"_nrt": True}))(function)


def lean_kernel(function: Any) -> Any:
    """As `kernel`, for functions that make no arrays and count no references.

    Neither may they return one, nor call a kernel that does: it would never be given back.

    Counting takes a third of the time of kernels that hand many arrays to small ones.
    """
    return numba.njit(**(_OPTIONS | {"_nrt": False}))(function)
