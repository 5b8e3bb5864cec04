"""Exact orientation test, on which every touching-or-not decision of the project rests.

The sign of a cross product is computed in floating point first; when the rounding error could
change it, it is computed again with exact expansions (Shewchuk, "Adaptive Precision Floating-Point
Arithmetic and Fast Robust Geometric Predicates", 1997). Decisions are therefore exact at any
distance from the origin, UTM coordinates included.
"""

import numpy as np

from shiftsim.arrays import FloatArray, kernel, lean_kernel

_SPLITTER = 134217729.0  # 2**27 + 1
_ERROR_BOUND = 3.3306690738754716e-16  # (3 + 16 eps) eps, eps = 2**-53


@lean_kernel
def orientation(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> int:
    """Side of the directed line a -> b on which c lies: 1 left, -1 right, 0 exactly on it."""
    left = (ax - cx) * (by - cy)
    right = (ay - cy) * (bx - cx)
    det = left - right
    if left == 0.0 or right == 0.0:
        # a product is zero only where a difference is, and differences have the right sign
        return 0 if det == 0.0 else (1 if det > 0.0 else -1)
    if abs(det) > _ERROR_BOUND * (abs(left) + abs(right)):
        return 1 if det > 0.0 else -1
    return _exact_orientation(ax, ay, bx, by, cx, cy)


@kernel
def _exact_orientation(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> int:
    # det = (ax by - ay bx) + (bx cy - by cx) + (cx ay - cy ax), each product exact
    expansion = np.zeros(12)
    size = np.int64(0)  # not a literal, for which kernels would be compiled a second time
    size = _add_product(expansion, size, ax, by)
    size = _add_product(expansion, size, -ay, bx)
    size = _add_product(expansion, size, bx, cy)
    size = _add_product(expansion, size, -by, cx)
    size = _add_product(expansion, size, cx, ay)
    size = _add_product(expansion, size, -cy, ax)
    # components do not overlap and grow in magnitude: the last non-zero one has the sign
    for index in range(size - 1, -1, -1):
        if expansion[index] > 0.0:
            return 1
        if expansion[index] < 0.0:
            return -1
    return 0


@lean_kernel
def _add_product(expansion: FloatArray, size: int, a: float, b: float) -> int:
    high = a * b
    a_big = _SPLITTER * a
    a_high = a_big - (a_big - a)
    a_low = a - a_high
    b_big = _SPLITTER * b
    b_high = b_big - (b_big - b)
    b_low = b - b_high
    low = a_low * b_low - (((high - a_high * b_high) - a_low * b_high) - a_high * b_low)
    size = _grow(expansion, size, low)
    return _grow(expansion, size, high)


@lean_kernel
def _grow(expansion: FloatArray, size: int, value: float) -> int:
    carry = value
    for index in range(size):
        other = expansion[index]
        total = carry + other
        virtual = total - carry
        expansion[index] = (carry - (total - virtual)) + (other - virtual)
        carry = total
    expansion[size] = carry
    return size + 1
