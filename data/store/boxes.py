"""Boxes as they are stored and as dense arrays; numbers as second differences of their bits.

The bits of a float, read as an integer, grow with its size. Where a number changes evenly in time,
second differences of these integers are small, and compress to much less than the number itself.
"""

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from shiftsim.data.store.plausible import BOX_LIMITS
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel

BitArray: TypeAlias = NDArray[np.uint64]
# bits of the largest numbers that are in `BOX_LIMITS`, which are as wide to both sides; of infinity
HIGHEST = tuple(np.array([*BOX_LIMITS[:5, 1], np.inf]).view(np.uint64))
SIZE_LIMITS = tuple(BOX_LIMITS[5:].reshape(-1).tolist())
_AT_ONCE = 32  # boxes that are looked at together


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


@kernel
def difference_of(code: np.uint64) -> np.uint64:
    """The second difference, modulo 2^64, that a code stands for."""
    one = np.uint64(1)
    return (code >> one) ^ (np.uint64(0) - (code & one))


def restored(codes: BitArray) -> FloatArray:
    """(n,) numbers of which `second_differences` made these codes (n,)."""
    out = np.empty(len(codes))
    restore(codes, out.view(np.uint64))
    return out


@kernel
def restore(codes: BitArray, out: BitArray) -> None:
    """Write the bits (n,) of which these are the codes (n,)."""
    step = bits = np.uint64(0)
    for at in range(np.uint64(len(codes))):
        step += difference_of(codes[at])
        bits += step
        out[at] = bits


@kernel
def cut_spans(
    row: IntArray, track: IntArray, first: int, last: int, place: IntArray, spans: IntArray
) -> int:
    """Number S of spans: boxes of one track in rows one after the other; -1 if a track is none.

    All or none of a span is in the rows first … last - 1. `spans` (A + 1, 3), of which S + 1 are
    written, are the box that each begins at, its row counted from `first`, and its track, or -1
    where it is in none of the rows. `place` (N,) becomes 1 for tracks, all of the N, that are in
    some.
    """
    count, of, gap, stop = 0, -1, 0, 0
    box, total, many = np.uint64(0), np.uint64(len(row)), np.uint64(_AT_ONCE)
    while box < total:
        if track[box] != of or row[box] - np.int64(box) != gap or row[box] == stop:
            of, gap = track[box], row[box] - np.int64(box)
            if not 0 <= of < len(place):
                return -1
            stop = first if row[box] < first else last
            is_inside = first <= row[box] < last
            if is_inside:
                place[np.uint64(of)] = 1
            at = np.uint64(count)
            spans[at, 0], spans[at, 1] = box, row[box] - first
            spans[at, 2] = of if is_inside else -1
            count += 1
        box += np.uint64(1)
        while box + many <= total and not box <= np.uint64(stop - gap) < box + many:
            other = 0  # looked at together: nearly always all of them go on with the span
            for i in range(many):
                there = np.int64(box + i)
                other |= (track[box + i] - of) | (row[box + i] - there - gap)
            if other:
                break
            box += many
    spans[np.uint64(count), 0] = len(row)
    return count


@kernel
def place_of(spans: IntArray, span: np.uint64, place: IntArray) -> int:
    """The place of a span's track in the dense arrays, from 1; 0 if it is in none of their rows."""
    track = spans[span, 2]
    return place[np.uint64(track)] if track >= 0 else 0


@kernel
def mark(spans: IntArray, place: IntArray, there: BoolArray) -> None:
    """Note in `there` (N, R) where there are boxes of tracks, by their place, from 1 on."""
    for span in range(np.uint64(len(spans) - 1)):
        to, row = place_of(spans, span, place), np.uint64(spans[span, 1])
        if to > 0:
            for _ in range(spans[span, 0], spans[span + np.uint64(1), 0]):
                there[np.uint64(to - 1), row] = True
                row += np.uint64(1)


@kernel
def scatter(
    motion: tuple[BitArray, ...],
    extent: tuple[FloatArray, FloatArray],
    is_plain: bool,
    spans: IntArray,
    place: IntArray,
    shape: tuple[int, int],
    highest: tuple[int, ...],
    limits: tuple[float, ...],
    poses: BitArray,
    velocities: BitArray,
    sizes: FloatArray,
) -> bool:
    """Spread the boxes of a row group over dense arrays, those of tracks that have a place, from 1.

    The arrays, for R rows and N tracks as `shape` says, are flat: poses (3 R N,) and velocities
    (2 R N,), both as their bits, and sizes (2 R N,). `spans` (S + 1, 3) are those of `cut_spans`.

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
    num = np.uint64(shape[1])
    good, over = True, zero  # the top bit of `over`: a number was beyond its limit
    x_step = y_step = heading_step = x_bits = y_bits = heading_bits = zero
    for span in range(np.uint64(len(spans) - 1)):
        to = place_of(spans, span, place)
        at = np.uint64(spans[span, 1]) * num + np.uint64(to - 1)
        for box in range(np.uint64(spans[span, 0]), np.uint64(spans[span + one, 0])):
            if is_plain:
                x_bits, y_bits, heading_bits = x[box], y[box], heading[box]
            else:
                x_step += difference_of(x[box])
                y_step += difference_of(y[box])
                heading_step += difference_of(heading[box])
                x_bits += x_step
                y_bits += y_step
                heading_bits += heading_step
            over |= (x_top - (x_bits & size)) | (y_top - (y_bits & size))
            over |= heading_top - (heading_bits & size)
            if to > 0:
                poses[three * at] = x_bits
                poses[three * at + one] = y_bits
                poses[three * at + two] = heading_bits
            at += num
    # velocities of static objects are NaN: more than infinity
    vx_least = vy_least = ~zero
    vx_step = vy_step = vx_bits = vy_bits = zero
    for span in range(np.uint64(len(spans) - 1)):
        to = place_of(spans, span, place)
        at = np.uint64(spans[span, 1]) * num + np.uint64(to - 1)
        for box in range(np.uint64(spans[span, 0]), np.uint64(spans[span + one, 0])):
            if is_plain:
                vx_bits, vy_bits = vx[box], vy[box]
            else:
                vx_step += difference_of(vx[box])
                vy_step += difference_of(vy[box])
                vx_bits += vx_step
                vy_bits += vy_step
            # those up to the highest become more than any other
            vx_least = min(vx_least, (vx_bits & size) - vx_top - one)
            vy_least = min(vy_least, (vy_bits & size) - vy_top - one)
            long, wide = length[box], width[box]
            good &= (long >= least_length) & (long <= most_length)
            good &= (wide >= least_width) & (wide <= most_width)
            if to > 0:
                velocities[two * at] = vx_bits
                velocities[two * at + one] = vy_bits
                sizes[two * at] = long
                sizes[two * at + one] = wide
            at += num
    fits = vx_least >= infinity - vx_top and vy_least >= infinity - vy_top
    return bool(good and fits and over <= size)
