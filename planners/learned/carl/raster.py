"""Lines and areas on a pixel grid, with the pixels that OpenCV sets.

Vertices are whole pixels; x is the column, y the row. Three rules (nuPlan rule 362) make
the raster:

* A line is Bresenham's, 8-connected, walked from the left end to the right one. One that leaves the
  picture is cut at its borders first, and the cut ends are rounded towards the first one.
* An area is its outline, and in every row the pixels between the first and the second crossing of
  the outline, between the third and the fourth, and so on. An edge crosses the rows from its upper
  end on, its lower end not counted, at columns with 16 fractional bits, to the nearest pixel.
* An edge of a general area that leaves the raster goes through its cut ends, and its columns are
  rounded down. Edges of a box are not cut.
"""

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import IntArray, kernel

_ONE, _HALF = 1 << 16, 1 << 15  # a pixel, and half of one, in fixed point

Raster = NDArray[np.uint8]


@kernel
def draw_line(raster: Raster, x0: int, y0: int, x1: int, y1: int, value: int) -> None:
    """Draw a line between two pixels, both included."""
    height, width = raster.shape
    if not (_within(x0, y0, width, height) and _within(x1, y1, width, height)):
        visible, x0, y0, x1, y1 = _cut(x0, y0, x1, y1, width, height)
        if not visible:
            return
    if x1 < x0:
        x0, y0, x1, y1 = x1, y1, x0, y0
    run, rise, down = x1 - x0, abs(y1 - y0), 1 if y1 > y0 else -1
    steep = rise > run
    long, short = (rise, run) if steep else (run, rise)
    error = long - 2 * short
    x, y = x0, y0
    raster[y, x] = value
    for _ in range(long):
        aside = error < 0
        error += 2 * (long - short) if aside else -2 * short
        if steep:
            y += down
            x += aside
        else:
            x += 1
            if aside:
                y += down
        raster[y, x] = value


@kernel
def _within(x: int, y: int, width: int, height: int) -> bool:
    return 0 <= x < width and 0 <= y < height


@kernel
def _side(at: int, size: int) -> int:
    """Where a coordinate is: -1 before the raster, 1 behind it, 0 in it."""
    return -1 if at < 0 else (1 if at >= size else 0)


@kernel
def _cut(
    x0: int, y0: int, x1: int, y1: int, width: int, height: int
) -> tuple[bool, int, int, int, int]:
    """Cut a line at the borders: whether it can be seen, and its ends as far as they were cut."""
    sx0, sy0, sx1, sy1 = _side(x0, width), _side(y0, height), _side(x1, width), _side(y1, height)
    if sx0 * sx1 > 0 or sy0 * sy1 > 0:  # both ends lie beyond the same border
        return False, x0, y0, x1, y1
    if sy0 != 0:
        border = 0 if sy0 < 0 else height - 1
        x0 += int(float(border - y0) * (x1 - x0) / (y1 - y0))
        y0 = border
        sx0 = _side(x0, width)
    if sy1 != 0:
        border = 0 if sy1 < 0 else height - 1
        x1 += int(float(border - y1) * (x1 - x0) / (y1 - y0))
        y1 = border
        sx1 = _side(x1, width)
    if sx0 * sx1 > 0:
        return False, x0, y0, x1, y1
    if sx0 != 0:
        border = 0 if sx0 < 0 else width - 1
        y0 += int(float(border - x0) * (y1 - y0) / (x1 - x0))
        x0 = border
    if sx1 != 0:
        border = 0 if sx1 < 0 else width - 1
        y1 += int(float(border - x1) * (y1 - y0) / (x1 - x0))
        x1 = border
    return True, x0, y0, x1, y1


@kernel
def _quotient(dividend: int, divisor: int) -> int:
    """Whole quotient, rounded towards zero; the divisor is positive."""
    return dividend // divisor if dividend >= 0 else -(-dividend // divisor)


@kernel
def fill(raster: Raster, xy: IntArray, value: int, is_box: bool) -> None:
    """Fill the area within a ring of pixels (V, 2), by the even-odd rule, or a box (4, 2)."""
    height, width = raster.shape
    # the columns at which edges cross each row, and how many they are
    columns, counts = np.empty((height, len(xy)), np.int32), np.zeros(height, np.int64)
    top, bottom = height, -1
    bx, by = xy[-1, 0], xy[-1, 1]
    for index in range(len(xy)):
        ax, ay = bx, by
        bx, by = xy[index, 0], xy[index, 1]
        top, bottom = min(top, by), max(bottom, by)
        draw_line(raster, ax, ay, bx, by, value)
        if ay == by or max(ay, by) <= 0 or min(ay, by) >= height:
            continue
        cx, cy, dx, dy, shift = ax, ay, bx, by, _HALF
        inside = _within(ax, ay, width, height) and _within(bx, by, width, height)
        if not (is_box or inside):
            _, cx, cy, dx, dy = _cut(ax, ay, bx, by, width, height)
            shift = 0
            if cy == dy:
                cx, cy, dx, dy = ax, ay, bx, by
        if dy < cy:
            cx, cy, dx, dy = dx, dy, cx, cy
        if is_box:
            slope = _quotient(2 * (dx - cx) * _ONE + (dy - cy), 2 * (dy - cy))
        else:
            slope = _quotient((dx - cx) * _ONE, dy - cy)
        first = min(ay, by)
        start = cx * _ONE + shift + (first - cy) * slope
        for row in range(max(first, 0), min(max(ay, by), height)):
            columns[row, counts[row]] = (start + (row - first) * slope) >> 16
            counts[row] += 1
    for row in range(max(top, 0), min(bottom, height - 1) + 1):
        ends = columns[row, : counts[row]]
        if len(ends) > 2:
            ends.sort()
        elif len(ends) == 2 and ends[0] > ends[1]:
            ends[0], ends[1] = ends[1], ends[0]
        for index in range(0, len(ends) - 1, 2):
            for column in range(max(ends[index], 0), min(ends[index + 1] + 1, width)):
                raster[row, column] = value
