"""Points, segments and rings: inside or not, touching or not, how far.

A ring is a closed or open sequence of vertices (the closing edge is implied). Coordinates may
be UTM: differences are always taken first.

Every touching-or-not decision rests on the exact `orientation`. The sign of a cross product is
computed in floating point first; when the rounding error could change it, it is computed again with
exact expansions (Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric
Predicates", 1997). Decisions are therefore exact at any distance from the origin.
"""

import numpy as np

from shiftsim.kernels import FloatArray, IntArray, kernel

INTERIOR, BOUNDARY, EXTERIOR = 1, 0, -1
SLACK = 1e-6  # m, more than rounding can change a distance by
_SPLITTER = 134217729.0  # 2**27 + 1
_ERROR_BOUND = 3.3306690738754716e-16  # (3 + 16 eps) eps, eps = 2**-53


@kernel
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
    expansion, size = np.zeros(12), 0
    for p, q in ((ax, by), (-ay, bx), (bx, cy), (-by, cx), (cx, ay), (-cy, ax)):
        high, p_big, q_big = p * q, _SPLITTER * p, _SPLITTER * q
        p_high, q_high = p_big - (p_big - p), q_big - (q_big - q)
        p_low, q_low = p - p_high, q - q_high
        low = p_low * q_low - (((high - p_high * q_high) - p_low * q_high) - p_high * q_low)
        for carry in (low, high):
            for index in range(size):
                other = expansion[index]
                total = carry + other
                virtual = total - carry
                expansion[index] = (carry - (total - virtual)) + (other - virtual)
                carry = total
            expansion[size] = carry
            size += 1
    # components do not overlap and grow in magnitude: the last non-zero one has the sign
    for index in range(size - 1, -1, -1):
        if expansion[index] > 0.0:
            return 1
        if expansion[index] < 0.0:
            return -1
    return 0


@kernel
def _separated_by_edges(a: FloatArray, b: FloatArray) -> bool:
    count, outside = len(a), False
    for index in range(count):
        ax, ay = a[index, 0], a[index, 1]
        after = index + 1 if index + 1 < count else 0
        bx, by = a[after, 0], a[after, 1]
        if ax == bx and ay == by:
            continue
        outside = True
        for vertex in range(len(b)):
            if orientation(ax, ay, bx, by, b[vertex, 0], b[vertex, 1]) >= 0:
                outside = False
                break
        if outside:
            break
    return outside


@kernel
def convex_intersect(a: FloatArray, b: FloatArray) -> bool:
    """Whether two convex rings (V, 2), counter-clockwise, share a point; touching counts.

    A separating line, if there is one, can be taken along an edge of either ring. Rings must have
    a positive area.
    """
    return not (_separated_by_edges(a, b) or _separated_by_edges(b, a))


@kernel
def segments_meet(
    ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float
) -> bool:
    """Whether the closed segments a-b and c-d share a point."""
    if (
        max(ax, bx) < min(cx, dx)
        or max(cx, dx) < min(ax, bx)
        or max(ay, by) < min(cy, dy)
        or max(cy, dy) < min(ay, by)
    ):
        return False
    if orientation(ax, ay, bx, by, cx, cy) * orientation(ax, ay, bx, by, dx, dy) > 0:
        return False
    return orientation(cx, cy, dx, dy, ax, ay) * orientation(cx, cy, dx, dy, bx, by) <= 0


@kernel
def locate_in_ring(ring: FloatArray, x: float, y: float) -> int:
    """Where a point lies relative to one ring (V, 2): INTERIOR, BOUNDARY or EXTERIOR."""
    parity, on_edge = ray_crossings(ring, len(ring) - 1, 0, len(ring), x, y)
    if on_edge:
        return BOUNDARY
    return INTERIOR if parity else EXTERIOR


@kernel
def ray_crosses(
    px: float, py: float, qx: float, qy: float, x: float, y: float
) -> tuple[bool, bool]:
    """Whether a ray from (x, y) to +x crosses the segment p-q, and whether it starts on it.

    The lower end counts, the upper one does not; it starts at q, but not at p.
    """
    crosses, on_edge = False, qx == x and qy == y
    if on_edge:
        pass
    elif py == y and qy == y:
        on_edge = min(px, qx) <= x <= max(px, qx)
    elif (py > y) != (qy > y) and (px >= x or qx >= x):
        if px > x and qx > x:
            crosses = True
        else:
            side = orientation(px, py, qx, qy, x, y)
            on_edge, crosses = side == 0, (side > 0) == (qy > py)
    return crosses, on_edge


@kernel
def ray_crossings(
    xy: FloatArray, before: int, start: int, stop: int, x: float, y: float
) -> tuple[bool, bool]:
    """Whether a ray from (x, y) to +x crosses a chain an odd number of times, or starts on it.

    The chain goes from the vertex `before` (of a whole ring the last one) to `start` … `stop` - 1.
    """
    parity, on_edge = False, False
    px, py = xy[before, 0], xy[before, 1]
    for index in range(start, stop):
        qx, qy = xy[index, 0], xy[index, 1]
        crosses, on_edge = ray_crosses(px, py, qx, qy, x, y)
        if on_edge:
            break  # a single return: numba then needs no count of references
        parity ^= crosses
        px, py = qx, qy
    return parity and not on_edge, on_edge


@kernel
def locate_in_polygon(
    xy: FloatArray, ring_ptr: IntArray, first: int, last: int, x: float, y: float
) -> int:
    """Where a point lies relative to a polygon with holes: INTERIOR, BOUNDARY or EXTERIOR.

    Its rings are `first` (the shell) … `last` - 1, with the vertices from `ring_ptr` on.
    """
    inside = False
    for ring in range(first, last):
        start, stop = ring_ptr[ring], ring_ptr[ring + 1]
        parity, on_edge = ray_crossings(xy, stop - 1, start, stop, x, y)
        if on_edge:
            return BOUNDARY
        if parity:
            inside = not inside
    return INTERIOR if inside else EXTERIOR


@kernel
def point_segment_distance(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance from a point to the closed segment a-b [m]."""
    dx, dy = bx - ax, by - ay
    square = dx * dx + dy * dy
    if square == 0.0:
        return np.hypot(x - ax, y - ay)
    along = ((x - ax) * dx + (y - ay) * dy) / square
    if along <= 0.0:
        return np.hypot(x - ax, y - ay)
    if along >= 1.0:
        return np.hypot(x - bx, y - by)
    return abs((ay - y) * dx - (ax - x) * dy) / np.sqrt(square)


@kernel
def polygon_distance(
    xy: FloatArray, ring_ptr: IntArray, first: int, last: int, x: float, y: float
) -> float:
    """Distance from a point to a polygon with holes (see `locate_in_polygon`), 0 inside [m]."""
    if locate_in_polygon(xy, ring_ptr, first, last, x, y) != EXTERIOR:
        return 0.0
    best = np.inf
    for ring in range(first, last):
        start, stop = ring_ptr[ring], ring_ptr[ring + 1]
        before = stop - 1
        for index in range(start, stop):
            best = min(
                best,
                point_segment_distance(
                    x, y, xy[before, 0], xy[before, 1], xy[index, 0], xy[index, 1]
                ),
            )
            before = index
    return best


@kernel
def boundary_distance_below(
    xy: FloatArray, start: int, stop: int, x: float, y: float, limit: float
) -> float:
    """Distance from a point to the edges of a ring, or `limit` where that is not below it [m].

    The ring has the vertices `start` … `stop` - 1. Edges beyond the limit cost a comparison each.
    The distance is that of shapely, rounded alike: it is compared with thresholds.
    """
    best = limit
    ax, ay = xy[stop - 1, 0] - x, xy[stop - 1, 1] - y
    for index in range(start, stop):
        bx, by = xy[index, 0] - x, xy[index, 1] - y
        reach = best * (1.0 + 1e-12)  # a rounded distance may be a little below the bounds
        if (
            min(ax, bx) < reach
            and max(ax, bx) > -reach
            and min(ay, by) < reach
            and max(ay, by) > -reach
        ):
            before = index - 1 if index > start else stop - 1
            px, py, qx, qy = xy[before, 0], xy[before, 1], xy[index, 0], xy[index, 1]
            dx, dy = qx - px, qy - py
            square = dx * dx + dy * dy
            along = ((x - px) * dx + (y - py) * dy) / square  # NaN where both are one point
            if along >= 1.0:
                distance = np.sqrt((x - qx) * (x - qx) + (y - qy) * (y - qy))
            elif along > 0.0:
                distance = abs(((py - y) * dx - (px - x) * dy) / square) * np.sqrt(square)
            else:
                distance = np.sqrt((x - px) * (x - px) + (y - py) * (y - py))
            best = min(best, distance)
        ax, ay = bx, by
    return best


@kernel
def rings_touch(a: FloatArray, b: FloatArray) -> bool:
    """Whether the areas of two simple rings (V, 2) share a point; touching counts."""
    ax, ay, bx, by = ring_bounds(a)
    cx, cy, dx, dy = ring_bounds(b)
    low_x, low_y, high_x, high_y = max(ax, cx), max(ay, cy), min(bx, dx), min(by, dy)
    if low_x > high_x or low_y > high_y:
        return False
    if (
        locate_in_ring(a, b[0, 0], b[0, 1]) != EXTERIOR
        or locate_in_ring(b, a[0, 0], a[0, 1]) != EXTERIOR
    ):
        return True
    before = len(b) - 1
    for j in range(len(b)):
        if not (
            max(b[before, 0], b[j, 0]) < low_x
            or min(b[before, 0], b[j, 0]) > high_x
            or max(b[before, 1], b[j, 1]) < low_y
            or min(b[before, 1], b[j, 1]) > high_y
        ):
            px, py, qx, qy = b[before, 0], b[before, 1], b[j, 0], b[j, 1]
            for i in range(len(a)):
                if segments_meet(a[i - 1, 0], a[i - 1, 1], a[i, 0], a[i, 1], px, py, qx, qy):
                    return True
        before = j
    return False


@kernel
def ring_bounds(ring: FloatArray) -> tuple[float, float, float, float]:
    """Bounds of a ring (V, 2): min x, min y, max x, max y [m]."""
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for index in range(len(ring)):
        x, y = ring[index, 0], ring[index, 1]
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
    return low_x, low_y, high_x, high_y


@kernel
def ring_distance(a: FloatArray, b: FloatArray) -> float:
    """Distance between the areas of two simple rings (V, 2); 0 when they share a point [m]."""
    if rings_touch(a, b):
        return 0.0
    low_x, low_y, high_x, high_y = ring_bounds(a)
    reach = distance_bound(a, b)
    best = np.inf
    before = len(b) - 1
    for j in range(len(b)):
        cx, cy, dx, dy = b[before, 0], b[before, 1], b[j, 0], b[j, 1]
        if not (
            max(cx, dx) < low_x - reach
            or min(cx, dx) > high_x + reach
            or max(cy, dy) < low_y - reach
            or min(cy, dy) > high_y + reach
        ):
            for i in range(len(a)):
                px, py, qx, qy = a[i - 1, 0], a[i - 1, 1], a[i, 0], a[i, 1]
                best = min(best, point_segment_distance(qx, qy, cx, cy, dx, dy))
                best = min(best, point_segment_distance(dx, dy, px, py, qx, qy))
            reach = min(reach, best + SLACK)
        before = j
    return best


@kernel
def distance_bound(a: FloatArray, b: FloatArray) -> float:
    """More than the distance between two rings (V, 2): that between two of their vertices [m]."""
    square = np.inf
    for j in range(len(b)):
        dx, dy = b[j, 0] - a[0, 0], b[j, 1] - a[0, 1]
        square = min(square, dx * dx + dy * dy)
    return np.sqrt(square) + SLACK


@kernel
def centroid(ring: FloatArray) -> tuple[float, float]:
    """Centroid of the area of a ring (V, 2) [m]."""
    # nuPlan rule 2: triangles from the first vertex, of coordinates that are not reduced
    area = x = y = 0.0
    ox, oy = ring[0, 0], ring[0, 1]
    for index in range(len(ring)):
        after = index + 1 if index + 1 < len(ring) else 0
        ax, ay, bx, by = ring[index, 0], ring[index, 1], ring[after, 0], ring[after, 1]
        double = (ax - ox) * (by - oy) - (bx - ox) * (ay - oy)
        x += double * (ox + ax + bx)
        y += double * (oy + ay + by)
        area += double
    return x / 3.0 / area, y / 3.0 / area
