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
    count = 0
    for side in range(2):  # the left of the line, and the left of the way back
        keep = _simplify(line, distance * _SIMPLIFY, side == 0)
        seen = 0
        x0 = y0 = x1 = y1 = x2 = y2 = 0.0
        vx = vy = ux = uy = 0.0  # from the segments before and after x1, y1 to their offsets
        for index in range(len(line)):
            at = index if side == 0 else len(line) - 1 - index
            if not keep[at]:
                continue
            x0, y0, x1, y1, x2, y2 = x1, y1, x2, y2, line[at, 0], line[at, 1]
            seen += 1
            if seen == 1:
                continue
            dx, dy = x2 - x1, y2 - y1
            length = np.sqrt(dx * dx + dy * dy)
            vx, vy, ux, uy = ux, uy, -distance * dy / length, distance * dx / length
            turn = orientation(x0, y0, x1, y1, x2, y2) if seen > 2 else 0
            if turn == 0:
                continue
            is_narrow = np.sqrt((vx - ux) ** 2 + (vy - uy) ** 2) < distance * _NARROW_TURN
            if turn < 0:  # outside: a round join, clockwise
                count = _add(out, count, x1 + vx, y1 + vy, distance)
                if is_narrow:
                    continue
                first, last = np.arctan2(vy, vx), np.arctan2(uy, ux)
                if first <= last:
                    first += 2.0 * np.pi
                total = first - last
                segments = int(total / (0.5 * np.pi / QUADRANT_SEGMENTS) + 0.5)
                for step in range(segments):
                    angle = first - step * (total / segments)
                    x, y = x1 + distance * np.cos(angle), y1 + distance * np.sin(angle)
                    count = _add(out, count, x, y, distance)
                count = _add(out, count, x1 + ux, y1 + uy, distance)
                continue
            # inside: where the offsets of both segments cross, else closed near the curve
            ax, ay, bx, by = x1 - x0, y1 - y0, x2 - x1, y2 - y1
            gap_x, gap_y = (x1 + ux) - (x0 + vx), (y1 + uy) - (y0 + vy)
            cross = ax * by - ay * bx
            along_a = (gap_x * by - gap_y * bx) / cross
            along_b = (gap_x * ay - gap_y * ax) / cross
            if 0.0 <= along_a <= 1.0 and 0.0 <= along_b <= 1.0:
                x, y = x0 + vx + along_a * ax, y0 + vy + along_a * ay
                count = _add(out, count, x, y, distance)
                continue
            count = _add(out, count, x1 + vx, y1 + vy, distance)
            if is_narrow:
                continue
            share = _CLOSING / (_CLOSING + 1.0)
            count = _add(out, count, x1 + share * vx, y1 + share * vy, distance)
            count = _add(out, count, x1 + share * ux, y1 + share * uy, distance)
            count = _add(out, count, x1 + ux, y1 + uy, distance)
        count = _add(out, count, x2 + ux, y2 + uy, distance)
        count = _add(out, count, x2 - ux, y2 - uy, distance)
    return count


@kernel
def _simplify(line: FloatArray, tolerance: float, left: bool) -> BoolArray:
    """(K,) which vertices stay when shallow turns to one side are left out."""
    concave, size = 1 if left else -1, len(line)
    keep = np.ones(size, np.bool_)
    for vertex in range(1, size):
        is_moved_x = line[vertex, 0] != line[vertex - 1, 0]
        keep[vertex] = is_moved_x or line[vertex, 1] != line[vertex - 1, 1]
    changed = True
    while changed:
        changed = False
        index = _walk(keep, 0)
        middle = _walk(keep, index)
        last = _walk(keep, middle)
        while last < size:
            ax, ay, bx, by = line[index, 0], line[index, 1], line[middle, 0], line[middle, 1]
            cx, cy = line[last, 0], line[last, 1]
            is_shallow = (
                orientation(ax, ay, bx, by, cx, cy) == concave
                and point_segment_distance(bx, by, ax, ay, cx, cy) < tolerance
            )
            if is_shallow:
                for vertex in range(index, last, max((last - index) // _SAMPLED, 1)):
                    # GEOS measures from the middle vertex to the line towards each sampled one
                    x, y = line[vertex, 0], line[vertex, 1]
                    if point_segment_distance(bx, by, ax, ay, x, y) >= tolerance:
                        is_shallow = False
                        break
            if is_shallow:
                keep[middle] = False
                changed = True
            index = last if is_shallow else middle
            middle = _walk(keep, index)
            last = _walk(keep, middle)
    return keep


@kernel
def _walk(keep: BoolArray, at: int) -> int:
    """The next vertex that is kept, or one beyond the end."""
    at += 1
    while at < len(keep) and not keep[at]:
        at += 1
    return at


@kernel
def _add(out: FloatArray, count: int, x: float, y: float, distance: float) -> int:
    """Append a vertex unless it repeats the one before; the new number of vertices."""
    if count:
        dx, dy = x - out[count - 1, 0], y - out[count - 1, 1]
        if np.sqrt(dx * dx + dy * dy) < distance * _SAME_POINT:
            return count
    out[count, 0] = x
    out[count, 1] = y
    return count + 1
