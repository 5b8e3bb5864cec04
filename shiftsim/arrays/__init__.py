"""Array type aliases, and the decorators that compile kernels.

Shapes and units are in the docstrings; the aliases say the kind of number only.
"""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shiftsim.arrays.compiling import compiled
from shiftsim.arrays.held import Held as Held
from shiftsim.arrays.held import contents as contents

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


def kernel(function: Any) -> Any:
    """Compile a function over plain arrays and cache the machine code on disk.

    No fastmath and no parallel loops: results must not depend on the processor or on the number
    of threads. Division by zero gives inf or NaN, as in NumPy.
    """
    # said although it is the default: a kernel called by a lean one would inherit the opposite
    return compiled(function, counts_references=True, forceinline=False)


def lean_kernel(function: Any) -> Any:
    """As `kernel`, for functions that make no arrays and count no references.

    Neither may they return one, nor call a kernel that does: it would never be given back (a test
    looks at all of them).

    Counting takes a third of the time of kernels that hand many arrays to small ones.
    """
    return compiled(function, counts_references=False, forceinline=False)


def part_kernel(function: Any) -> Any:
    """As `lean_kernel`, for one that is called in one place of another one, and becomes part of it.

    A call of its own would copy every array that is handed over, seven words each.
    """
    return compiled(function, counts_references=False, forceinline=True)
