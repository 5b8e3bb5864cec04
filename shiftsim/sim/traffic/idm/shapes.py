"""Gaps and contacts between the outlines of road users, and corridors along paths.

An outline is one or two rings: a box, and the buffer of a piece of path (`buffer`), whose ring may
cross itself inside. Their union is meant; touching counts as contact. Rings are searched with
bounding boxes, and exact predicates decide whether two edges meet. Corridors are searched by the
runs of segments of their line (`geometry.polylines`).
"""

import numpy as np

from shiftsim.geometry.polylines import RUN
from shiftsim.geometry.rings import orientation, point_segment_distance, segments_meet
from shiftsim.kernels import FloatArray, kernel

APART, MEETING, UNSURE = 0, 1, 2
# A buffer lies within these shares of its distance from the line: round joins are segmented (inner
# bound), and shallow concave vertices are left out (outer bound; see `buffer`).
_INNER, OUTER = 0.97, 1.02


@kernel
def bound_ring(ring: FloatArray, bounds: FloatArray) -> None:
    """Widen `bounds` (4,) min x, min y, max x, max y by a ring (V, 2)."""
    for vertex in range(len(ring)):
        bounds[0] = min(bounds[0], ring[vertex, 0])
        bounds[1] = min(bounds[1], ring[vertex, 1])
        bounds[2] = max(bounds[2], ring[vertex, 0])
        bounds[3] = max(bounds[3], ring[vertex, 1])


@kernel
def winds_around(ring: FloatArray, x: float, y: float) -> bool:
    """Whether a ring (V, 2) winds around a point, or has it on an edge."""
    winding = 0
    px, py = ring[-1, 0], ring[-1, 1]
    for vertex in range(len(ring)):
        qx, qy = ring[vertex, 0], ring[vertex, 1]
        if min(py, qy) <= y <= max(py, qy):
            side = orientation(px, py, qx, qy, x, y)
            if side == 0 and min(px, qx) <= x <= max(px, qx):
                return True
            if py <= y < qy and side > 0:
                winding += 1
            elif qy <= y < py and side < 0:
                winding -= 1
        px, py = qx, qy
    return winding != 0


@kernel
def ring_gap(a: FloatArray, b: FloatArray, limit: float) -> float:
    """Distance between what two rings (V, 2) enclose, at most `limit`; 0 where they meet [m]."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for vertex in range(len(b)):
        low_x, high_x = min(low_x, b[vertex, 0]), max(high_x, b[vertex, 0])
        low_y, high_y = min(low_y, b[vertex, 1]), max(high_y, b[vertex, 1])
    if _box_apart(a, low_x, low_y, high_x, high_y) >= limit:
        return limit
    best = min(limit, _vertex_distance(a, b) * (1.0 + 1e-12))
    px, py = a[-1, 0], a[-1, 1]
    for vertex in range(len(a)):
        qx, qy = a[vertex, 0], a[vertex, 1]
        apart_x = max(low_x - max(px, qx), min(px, qx) - high_x)
        apart_y = max(low_y - max(py, qy), min(py, qy) - high_y)
        if apart_x < best and apart_y < best:
            best = _edge_gap(px, py, qx, qy, b, best)
            if best == 0.0:
                return 0.0
        px, py = qx, qy
    if winds_around(b, a[0, 0], a[0, 1]) or winds_around(a, b[0, 0], b[0, 1]):
        return 0.0
    return best


@kernel
def _box_apart(ring: FloatArray, low_x: float, low_y: float, high_x: float, high_y: float) -> float:
    """Lower bound of the distance from a ring to what lies in an axis-parallel box [m]."""
    x0, y0, x1, y1 = np.inf, np.inf, -np.inf, -np.inf
    for vertex in range(len(ring)):
        x0, x1 = min(x0, ring[vertex, 0]), max(x1, ring[vertex, 0])
        y0, y1 = min(y0, ring[vertex, 1]), max(y1, ring[vertex, 1])
    return max(low_x - x1, x0 - high_x, low_y - y1, y0 - high_y)


@kernel
def _vertex_distance(a: FloatArray, b: FloatArray) -> float:
    """Distance between two close vertices: an upper bound that makes the search short."""
    found = 0
    x, y = a[0, 0], a[0, 1]
    best = np.inf
    for sweep in range(2):
        best = np.inf
        for vertex in range(len(b)):
            square = (b[vertex, 0] - x) ** 2 + (b[vertex, 1] - y) ** 2
            if square < best:
                best, found = square, vertex
        x, y = b[found, 0], b[found, 1]
        best = np.inf
        for vertex in range(len(a)):
            square = (a[vertex, 0] - x) ** 2 + (a[vertex, 1] - y) ** 2
            if square < best:
                best, found = square, vertex
        if sweep == 0:
            x, y = a[found, 0], a[found, 1]
    return np.sqrt(best)


@kernel
def _edge_gap(px: float, py: float, qx: float, qy: float, ring: FloatArray, best: float) -> float:
    """The distance from q to a ring, or from a vertex of it to the segment p-q, if below `best`.

    Or 0, where they meet; p is the q of another segment.
    """
    low_x, high_x = min(px, qx) - best, max(px, qx) + best
    low_y, high_y = min(py, qy) - best, max(py, qy) + best
    rx, ry = ring[-1, 0], ring[-1, 1]
    for vertex in range(len(ring)):
        sx, sy = ring[vertex, 0], ring[vertex, 1]
        if (
            (rx >= low_x or sx >= low_x)
            and (rx <= high_x or sx <= high_x)
            and (ry >= low_y or sy >= low_y)
            and (ry <= high_y or sy <= high_y)
        ):
            if segments_meet(px, py, qx, qy, rx, ry, sx, sy):
                return 0.0
            best = _nearer(qx, qy, rx, ry, sx, sy, best)
            best = _nearer(sx, sy, px, py, qx, qy, best)
        rx, ry = sx, sy
    return best


@kernel
def _nearer(x: float, y: float, ax: float, ay: float, bx: float, by: float, best: float) -> float:
    """Distance from a point to the segment a-b where it is less than `best`, else `best` [m]."""
    if _square_distance(x, y, ax, ay, bx, by) * (1.0 - 1e-9) >= best * best:
        return best  # most often, and without a root
    distance = point_segment_distance(x, y, ax, ay, bx, by)
    return distance if distance < best else best


@kernel
def _square_distance(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Square of the distance from a point to the segment a-b, up to rounding [m^2]."""
    dx, dy = bx - ax, by - ay
    ex, ey = x - ax, y - ay
    along = ex * dx + ey * dy
    if along <= 0.0:
        return ex * ex + ey * ey
    square = dx * dx + dy * dy
    if along >= square:
        return (x - bx) * (x - bx) + (y - by) * (y - by)
    cross = ex * dy - ey * dx
    return cross * cross / square


@kernel
def last_near_run(runs: FloatArray, first: int, reach: float, bounds: FloatArray) -> int:
    """The last run, of those from `first` on, that comes within `reach` [m] of bounds; or -1."""
    low_x, low_y = bounds[0] - reach, bounds[1] - reach
    high_x, high_y = bounds[2] + reach, bounds[3] + reach
    for run in range(len(runs) - 1, first - 1, -1):
        if (
            runs[run, 0] <= high_x
            and runs[run, 1] <= high_y
            and runs[run, 2] >= low_x
            and runs[run, 3] >= low_y
        ):
            return run
    return -1


@kernel
def touches_corridor(
    line: FloatArray,
    runs: FloatArray,
    first: int,
    half_width: float,
    ring: FloatArray,
    bounds: FloatArray,
) -> int:
    """Whether a ring meets the flat-capped buffer of a polyline: APART, MEETING, or UNSURE.

    UNSURE where the answer hangs on the exact shape of the buffer, or on its caps. The line (K, 2),
    of which the vertices from `first` on count, has runs with bounds (R, 4), the ring (V, 2) the
    bounds (4,).
    """
    reach = half_width * OUTER
    low_x, low_y = bounds[0] - reach, bounds[1] - reach
    high_x, high_y = bounds[2] + reach, bounds[3] + reach
    answer = APART
    for run in range(first // RUN, len(runs)):
        if (
            runs[run, 0] > high_x
            or runs[run, 1] > high_y
            or runs[run, 2] < low_x
            or runs[run, 3] < low_y
        ):
            continue
        for vertex in range(max(run * RUN, first) + 1, min((run + 1) * RUN + 1, len(line))):
            px, py = line[vertex - 1, 0], line[vertex - 1, 1]
            qx, qy = line[vertex, 0], line[vertex, 1]
            if (
                (px < low_x and qx < low_x)
                or (px > high_x and qx > high_x)
                or (py < low_y and qy < low_y)
                or (py > high_y and qy > high_y)
            ):
                continue
            found = _touches_segment(px, py, qx, qy, half_width, ring)
            if found == MEETING:
                return MEETING
            if found == UNSURE:
                answer = UNSURE
    x, y = line[first, 0], line[first, 1]
    around = bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]
    if answer == APART and around and winds_around(ring, x, y):
        return MEETING
    return answer


@kernel
def _touches_segment(
    px: float, py: float, qx: float, qy: float, half_width: float, ring: FloatArray
) -> int:
    inner, outer = half_width * _INNER, half_width * OUTER
    low_x, high_x = min(px, qx) - outer, max(px, qx) + outer
    low_y, high_y = min(py, qy) - outer, max(py, qy) + outer
    dx, dy = qx - px, qy - py
    square, limit = dx * dx + dy * dy, outer * outer
    answer = APART
    rx, ry = ring[-1, 0], ring[-1, 1]
    for vertex in range(len(ring)):
        sx, sy = ring[vertex, 0], ring[vertex, 1]
        if (
            (rx >= low_x or sx >= low_x)
            and (rx <= high_x or sx <= high_x)
            and (ry >= low_y or sy >= low_y)
            and (ry <= high_y or sy <= high_y)
        ):
            if segments_meet(px, py, qx, qy, rx, ry, sx, sy):
                return MEETING
            along = (sx - px) * dx + (sy - py) * dy
            nearest = _square_distance(sx, sy, px, py, qx, qy)
            if nearest < inner * inner and 0.0 < along < square:
                return MEETING  # beside the segment, within its part of the buffer
            near_p = _square_distance(px, py, rx, ry, sx, sy)
            near_q = _square_distance(qx, qy, rx, ry, sx, sy)
            if nearest < limit or near_p < limit or near_q < limit:
                answer = UNSURE
        rx, ry = sx, sy
    return answer
