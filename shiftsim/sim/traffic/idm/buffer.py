"""Flat-capped buffers of polylines, with the vertices that GEOS gives them.

nuPlan measures gaps between such buffers, so their shape matters: round joins are segmented, and
shallow concave vertices of the line are left out before it is offset. The outline made here is the
raw offset curve: clockwise, and at sharp inner turns it may cross itself inside the buffer. A point
belongs to the buffer where the curve winds around it.
"""

import numpy as np

from shiftsim.geometry.rings import orientation, point_segment_distance
from shiftsim.kernels import BoolArray, FloatArray, kernel

QUADRANT_SEGMENTS = 16  # per right angle of a round join; what shapely's method defaults to
_SIMPLIFY = 0.01  # concave vertices shallower than this share of the distance are left out
_SAMPLED = 10  # vertices looked at between the neighbours of a vertex that is left out
_SAME_POINT = 1e-6  # share of the distance below which a vertex repeats the one before
_NARROW_TURN = 1e-3  # share of the distance below which an outer join is a single vertex
_CLOSING = 80.0  # closing points of an inner turn lie this much nearer to the curve
_PER_VERTEX = 4  # most curve vertices of a join, fillets apart


def curve_capacity(num_points: int) -> int:
    """Most vertices the buffer curve of a polyline can have, whatever its turns add up to."""
    return 2 * num_points * (_PER_VERTEX + 2 * QUADRANT_SEGMENTS) + 8


@kernel
def buffer_curve(line: FloatArray, distance: float, out: FloatArray) -> int:
    """Outline of a polyline (K, 2) buffered by `distance` [m] with flat caps and round joins.

    `out` (V, 2) receives the curve, V being at least `curve_capacity(K)`.

    Returns:
        How many vertices the curve has, the closing one not repeated.
    """
    keep, count = np.empty(len(line), np.bool_), 0
    for side in range(2):
        _simplify(line, distance * _SIMPLIFY, side == 0, keep)
        count = _offset_side(line, distance, side == 0, keep, out, count)
    return count


@kernel
def _simplify(line: FloatArray, tolerance: float, left: bool, keep: BoolArray) -> None:
    """Mark the vertices that stay when shallow turns to one side are left out."""
    concave, size = 1 if left else -1, len(line)
    for vertex in range(size):
        keep[vertex] = (
            vertex == 0
            or line[vertex, 0] != line[vertex - 1, 0]
            or (line[vertex, 1] != line[vertex - 1, 1])
        )
    changed = True
    while changed:
        changed = False
        index = _walk(keep, size, 0, 1)
        middle = _walk(keep, size, index, 1)
        last = _walk(keep, size, middle, 1)
        while last < size:
            ax, ay, bx, by = line[index, 0], line[index, 1], line[middle, 0], line[middle, 1]
            side = orientation(ax, ay, bx, by, line[last, 0], line[last, 1])
            if side == concave and _is_shallow(line, index, middle, last, tolerance):
                keep[middle] = False
                changed = True
                index = last
            else:
                index = middle
            middle = _walk(keep, size, index, 1)
            last = _walk(keep, size, middle, 1)


@kernel
def _is_shallow(line: FloatArray, i0: int, i1: int, i2: int, tolerance: float) -> bool:
    ax, ay = line[i0, 0], line[i0, 1]
    bx, by = line[i1, 0], line[i1, 1]
    cx, cy = line[i2, 0], line[i2, 1]
    if point_segment_distance(bx, by, ax, ay, cx, cy) >= tolerance:
        return False
    step = max((i2 - i0) // _SAMPLED, 1)
    for vertex in range(i0, i2, step):
        # GEOS measures from the middle vertex to the line towards each sampled one
        if point_segment_distance(bx, by, ax, ay, line[vertex, 0], line[vertex, 1]) >= tolerance:
            return False
    return True


@kernel
def _offset_side(
    line: FloatArray, distance: float, left: bool, keep: BoolArray, out: FloatArray, count: int
) -> int:
    """Append the offset of one side, to the left of the direction walked, and the cap after it."""
    size, step = len(line), 1 if left else -1
    at = 0 if left else size - 1
    while not keep[at]:
        at += step
    x1, y1 = line[at, 0], line[at, 1]
    at = _walk(keep, size, at, step)
    x2, y2 = line[at, 0], line[at, 1]
    ux, uy = _offset(x1, y1, x2, y2, distance)
    at = _walk(keep, size, at, step)
    while 0 <= at < size:
        x0, y0, x1, y1 = x1, y1, x2, y2
        x2, y2 = line[at, 0], line[at, 1]
        vx, vy = ux, uy
        ux, uy = _offset(x1, y1, x2, y2, distance)
        turn = orientation(x0, y0, x1, y1, x2, y2)
        if turn < 0:
            count = _outer_turn(x1, y1, vx, vy, ux, uy, distance, out, count)
        elif turn > 0:
            count = _inner_turn(x0, y0, x1, y1, x2, y2, vx, vy, ux, uy, distance, out, count)
        at = _walk(keep, size, at, step)
    count = _add(out, count, x2 + ux, y2 + uy, distance)
    return _add(out, count, x2 - ux, y2 - uy, distance)


@kernel
def _walk(keep: BoolArray, size: int, at: int, step: int) -> int:
    """The next vertex that is kept, or one beyond the ends."""
    at += step
    while 0 <= at < size and not keep[at]:
        at += step
    return at


@kernel
def _offset(ax: float, ay: float, bx: float, by: float, distance: float) -> tuple[float, float]:
    """Vector from a segment to its offset on the left."""
    dx, dy = bx - ax, by - ay
    length = np.sqrt(dx * dx + dy * dy)
    return -distance * dy / length, distance * dx / length


@kernel
def _add(out: FloatArray, count: int, x: float, y: float, distance: float) -> int:
    if count:
        dx, dy = x - out[count - 1, 0], y - out[count - 1, 1]
        if np.sqrt(dx * dx + dy * dy) < distance * _SAME_POINT:
            return count
    out[count, 0] = x
    out[count, 1] = y
    return count + 1


@kernel
def _outer_turn(
    x: float,
    y: float,
    vx: float,
    vy: float,
    ux: float,
    uy: float,
    distance: float,
    out: FloatArray,
    count: int,
) -> int:
    """Round join at (x, y) from offset v to offset u, clockwise."""
    count = _add(out, count, x + vx, y + vy, distance)
    if np.sqrt((vx - ux) ** 2 + (vy - uy) ** 2) < distance * _NARROW_TURN:
        return count
    first, last = np.arctan2(vy, vx), np.arctan2(uy, ux)
    if first <= last:
        first += 2.0 * np.pi
    total = first - last
    segments = int(total / (0.5 * np.pi / QUADRANT_SEGMENTS) + 0.5)
    for index in range(segments):
        angle = first - index * (total / segments)
        count = _add(
            out, count, x + distance * np.cos(angle), y + distance * np.sin(angle), distance
        )
    return _add(out, count, x + ux, y + uy, distance)


@kernel
def _inner_turn(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    x2: float,
    y2: float,
    vx: float,
    vy: float,
    ux: float,
    uy: float,
    distance: float,
    out: FloatArray,
    count: int,
) -> int:
    """Join on the inside: where the offsets of both segments cross, else closed near the curve."""
    ax, ay = x1 - x0, y1 - y0
    bx, by = x2 - x1, y2 - y1
    gap_x, gap_y = (x1 + ux) - (x0 + vx), (y1 + uy) - (y0 + vy)
    cross = ax * by - ay * bx
    along_a = (gap_x * by - gap_y * bx) / cross
    along_b = (gap_x * ay - gap_y * ax) / cross
    if 0.0 <= along_a <= 1.0 and 0.0 <= along_b <= 1.0:
        return _add(out, count, x0 + vx + along_a * ax, y0 + vy + along_a * ay, distance)
    count = _add(out, count, x1 + vx, y1 + vy, distance)
    if np.sqrt((vx - ux) ** 2 + (vy - uy) ** 2) < distance * _NARROW_TURN:
        return count
    share = _CLOSING / (_CLOSING + 1.0)
    count = _add(out, count, x1 + share * vx, y1 + share * vy, distance)
    count = _add(out, count, x1 + share * ux, y1 + share * uy, distance)
    return _add(out, count, x1 + ux, y1 + uy, distance)
