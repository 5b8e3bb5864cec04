"""Boxes as they are stored and as dense arrays; numbers as second differences of their bits.

The bits of a float, read as an integer, grow with its size. Where a number changes evenly in time,
second differences of these integers are small, and compress to much less than the number itself.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.data.store.plausible import BOX_LIMITS

BitArray: TypeAlias = NDArray[np.uint64]
# bits of the largest numbers that are in `BOX_LIMITS`, which are as wide to both sides; of infinity
HIGHEST = tuple(np.array([*BOX_LIMITS[:5, 1], np.inf]).view(np.uint64))
SIZE_LIMITS = tuple(BOX_LIMITS[5:].reshape(-1).tolist())


class BoxBlock(NamedTuple):
    """Boxes of a row group. A boxes, sorted by track, then by row."""

    row: IntArray  # (A,)
    track: IntArray  # (A,)
    motion: tuple[BitArray, ...]  # 5 of (A,): `schema.MOTION`, as codes, or as bits where plain
    sizes: tuple[FloatArray, FloatArray]  # (A,), (A,)
    is_plain: bool


def second_differences(values: FloatArray) -> BitArray:
    """(n,) codes of numbers (n,), which `restored` gives back bit for bit.

    The difference d is written as 2 d, or -2 d - 1 where it is negative: small ones of either sign
    have few bytes. The first number follows two zeros.
    """
    bits = np.ascontiguousarray(values, np.float64).view(np.int64)
    bend = np.diff(bits, n=2, prepend=np.zeros(2, np.int64))
    return ((bend << 1) ^ (bend >> 63)).view(np.uint64)


def restored(codes: BitArray) -> FloatArray:
    """(n,) numbers of which `second_differences` made these codes (n,)."""
    one = np.uint64(1)
    differences = (codes >> one) ^ -(codes & one)
    return np.cumsum(np.cumsum(differences)).view(np.float64)


@lean_kernel
def difference_of(code: np.uint64) -> np.uint64:
    """The second difference, modulo 2^64, that a code stands for."""
    one = np.uint64(1)
    return (code >> one) ^ (np.uint64(0) - (code & one))


@kernel
def note_tracks(row: IntArray, track: IntArray, first: int, last: int, place: IntArray) -> None:
    """Set `place` (N,) to 0 for tracks, all of the N, that occur in the rows first … last - 1."""
    for box in range(np.uint64(len(row))):
        if first <= row[box] < last:
            place[np.uint64(track[box])] = 0


@kernel
def mark(row: IntArray, track: IntArray, place: IntArray, first: int, valid: BoolArray) -> None:
    """Note in `valid` (R, N), which is false, where there are boxes."""
    num_rows = np.uint64(len(valid))
    for box in range(np.uint64(len(row))):
        at = np.uint64(row[box] - first)  # one before the first is a large one, too
        if at < num_rows:
            valid[at, np.uint64(place[np.uint64(track[box])])] = True


@kernel
def scatter(
    row: IntArray,
    track: IntArray,
    motion: tuple[BitArray, ...],
    extent: tuple[FloatArray, FloatArray],
    is_plain: bool,
    place: IntArray,
    first: int,
    shape: tuple[int, int],
    highest: tuple[int, ...],
    limits: tuple[float, ...],
    poses: BitArray,
    velocities: BitArray,
    sizes: FloatArray,
) -> bool:
    """Spread the boxes of a row group over dense arrays, those of tracks that have a place.

    The arrays, for R rows and N tracks as `shape` says, are flat: poses (3 R N,) and velocities
    (2 R N,), both as their bits, and sizes (2 R N,).

    Returns whether all of the row group are within the ranges of a store. The bits of a float
    without its sign are in the order of its size, and up to `highest` (6,), the last that of
    infinity; `limits` (4,) are the least and most length and width. Places and the rest take
    turns, as the sums of all do not fit into the registers.
    """
    x, y, heading, vx, vy = motion
    length, width = extent
    x_top, y_top, heading_top, vx_top, vy_top, infinity = highest
    least_length, most_length, least_width, most_width = limits
    zero, one, two, three = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3)
    size = ~(one << np.uint64(63))
    num_rows, num = np.uint64(shape[0]), np.uint64(shape[1])
    good = True
    x_step = y_step = heading_step = x_bits = y_bits = heading_bits = zero
    for box in range(np.uint64(len(row))):
        if is_plain:
            x_bits, y_bits, heading_bits = x[box], y[box], heading[box]
        else:
            x_step += difference_of(x[box])
            y_step += difference_of(y[box])
            heading_step += difference_of(heading[box])
            x_bits += x_step
            y_bits += y_step
            heading_bits += heading_step
        good &= (x_bits & size <= x_top) & (y_bits & size <= y_top)
        good &= heading_bits & size <= heading_top
        at, to = np.uint64(row[box] - first), place[np.uint64(track[box])]
        if to >= 0 and at < num_rows:  # a row before the first is a large one, too
            at = three * (at * num + np.uint64(to))
            poses[at] = x_bits
            poses[at + one] = y_bits
            poses[at + two] = heading_bits
    vx_step = vy_step = vx_bits = vy_bits = zero
    for box in range(np.uint64(len(row))):
        if is_plain:
            vx_bits, vy_bits = vx[box], vy[box]
        else:
            vx_step += difference_of(vx[box])
            vy_step += difference_of(vy[box])
            vx_bits += vx_step
            vy_bits += vy_step
        # velocities of static objects are NaN: more than infinity
        good &= (vx_bits & size <= vx_top) | (vx_bits & size > infinity)
        good &= (vy_bits & size <= vy_top) | (vy_bits & size > infinity)
        good &= (length[box] >= least_length) & (length[box] <= most_length)
        good &= (width[box] >= least_width) & (width[box] <= most_width)
        at, to = np.uint64(row[box] - first), place[np.uint64(track[box])]
        if to >= 0 and at < num_rows:
            at = two * (at * num + np.uint64(to))
            velocities[at] = vx_bits
            velocities[at + one] = vy_bits
            sizes[at] = length[box]
            sizes[at + one] = width[box]
    return good
