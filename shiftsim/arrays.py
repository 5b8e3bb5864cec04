"""Array type aliases, and the one decorator that compiles a kernel.

Shapes and units are in the docstrings; the aliases say the kind of number only.
"""

from typing import Any, TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]


def kernel(function: Any) -> Any:
    """Compile a function over plain arrays and cache the machine code on disk.

    No fastmath and no parallel loops: results must not depend on the processor or on the number
    of threads. Division by zero gives inf or NaN, as in NumPy.
    """
    return numba.njit(cache=True, error_model="numpy")(function)
