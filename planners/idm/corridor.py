"""Which objects stand in the IDM planner's way (idm-planner.md §4.2).

nuPlan buffers the path by half the ego's width with square ends, unites it with the footprint, and
asks which polygons intersect the result. Distances to the path decide the same thing at a fraction
of the cost, except in a thin band: the buffer is a polygon that stays within 2 % of its radius
around the true outline, and its ends are square. Objects in that band are left open here and get
the real buffer.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, kernel
from shiftsim.geometry.rings import (
    EXTERIOR,
    locate_in_ring,
    point_segment_distance,
    segments_intersect,
)
from shiftsim.planners.idm.path import Path, interpolate

UNKNOWN, CLEAR, HIT, OPEN = 0, 1, 2, 3
# GEOS drops vertices of the line within 1 % of the radius, and its arcs (16 segments per quarter)
# lie 0.1 % inside the circle; twice that is safe
BAND = 0.02


class Occupants(NamedTuple):
    """Polygons around the ego. M objects.

    Attributes:
        xy: (V, 2) vertices of all rings, not closed [m].
        ptr: (M + 1,) first vertex of each ring.
        circles: (M, 3) x, y, radius of a circle around each ring [m].
        headings: (M,) heading, 0 for a red light [rad].
        speeds: (M,) speed, 0 for static objects and red lights [m/s].
    """

    xy: FloatArray
    ptr: IntArray
    circles: FloatArray
    headings: FloatArray
    speeds: FloatArray


@kernel
def sub_path(path: Path, low: float, high: float) -> FloatArray:
    """(K', 2) points of the path between two progresses, the interpolated ends included [m]."""
    # loops instead of slice assignments, which take numba seconds to compile
    count = len(path.progress)
    first = int(np.searchsorted(path.progress, low, side="right"))
    last = int(np.searchsorted(path.progress, high, side="left"))  # one past the last vertex
    if first == count or last == 0:
        out = np.empty((2, 2))
        for row in range(2):
            vertex = row if last == 0 else count - 2 + row
            out[row, 0], out[row, 1] = path.xy[vertex, 0], path.xy[vertex, 1]
        return out
    inner = max(last - first, 0)
    out = np.empty((inner + 2, 2))
    out[0, 0], out[0, 1], _ = interpolate(path, low)
    for row in range(inner):
        out[row + 1, 0], out[row + 1, 1] = path.xy[first + row, 0], path.xy[first + row, 1]
    out[inner + 1, 0], out[inner + 1, 1], _ = interpolate(path, high)
    return out


@kernel
def near_path(
    path: Path, low: float, high: float, circles: FloatArray, x: float, y: float, reach: float
) -> IntArray:
    """Circles (M, 3) within `reach` [m] of a stretch of the path or of the point (x, y)."""
    first = max(int(np.searchsorted(path.progress, low)) - 1, 0)
    last = min(int(np.searchsorted(path.progress, high)) + 1, len(path.progress))
    out = np.empty(len(circles), np.int64)
    found = 0
    for index in range(len(circles)):
        if _is_near(path, first, last, circles[index], x, y, reach):
            out[found] = index
            found += 1
    return out[:found]


@kernel
def _is_near(
    path: Path, first: int, last: int, circle: FloatArray, x: float, y: float, reach: float
) -> bool:
    cx, cy = circle[0], circle[1]
    limit = circle[2] + reach
    if np.hypot(cx - x, cy - y) <= limit:
        return True
    for index in range(first, last - 1):
        if _is_within(cx, cy, path.xy[index], path.xy[index + 1], limit):
            return True
    return False


@kernel
def _is_within(x: float, y: float, a: FloatArray, b: FloatArray, limit: float) -> bool:
    """Whether a point is within `limit` [m] of the segment a-b; a cheap test rejects most."""
    dx, dy = x - a[0], y - a[1]
    far = limit + abs(b[0] - a[0]) + abs(b[1] - a[1])
    if dx * dx + dy * dy > far * far:
        return False
    return point_segment_distance(x, y, a[0], a[1], b[0], b[1]) <= limit


@kernel
def find_sides(
    line: FloatArray, half_width: float, footprint: FloatArray, occupants: Occupants, out: IntArray
) -> None:
    """Decide which occupants touch the corridor, as far as distances can.

    Args:
        line: (K, 2) the stretch of path [m].
        half_width: Radius of the buffer around it [m].
        footprint: (4, 2) corners of the ego, which belongs to the corridor [m].
        occupants: The polygons.
        out: (M,) CLEAR, HIT or OPEN is written where UNKNOWN stands.
    """
    center_x = 0.5 * (footprint[0, 0] + footprint[2, 0])
    center_y = 0.5 * (footprint[0, 1] + footprint[2, 1])
    reach = np.hypot(footprint[0, 0] - center_x, footprint[0, 1] - center_y) + 1e-6
    for index in range(len(out)):
        if out[index] != UNKNOWN:
            continue
        ring = occupants.xy[occupants.ptr[index] : occupants.ptr[index + 1]]
        circle = occupants.circles[index]
        near = np.hypot(circle[0] - center_x, circle[1] - center_y) <= circle[2] + reach
        if near and rings_touch(ring, footprint):
            out[index] = HIT
        else:
            out[index] = _side_of_corridor(line, half_width, ring, circle)


@kernel
def _side_of_corridor(
    line: FloatArray, half_width: float, ring: FloatArray, circle: FloatArray
) -> int:
    inner, outer = (1.0 - BAND) * half_width, (1.0 + BAND) * half_width
    nearest = np.inf
    for index in range(len(line) - 1):
        a, b = line[index], line[index + 1]
        if _is_within(circle[0], circle[1], a, b, circle[2] + outer):
            nearest = min(nearest, segment_distance(ring, a, b))
            if nearest <= inner:
                return HIT
    # the square ends: beyond the first and the last point the corridor goes on by half a width
    before = _beyond(line[1], line[0], outer)
    after = _beyond(line[-2], line[-1], outer)
    if _is_within(circle[0], circle[1], before, line[0], circle[2] + outer):
        nearest = min(nearest, segment_distance(ring, before, line[0]))
    if _is_within(circle[0], circle[1], line[-1], after, circle[2] + outer):
        nearest = min(nearest, segment_distance(ring, line[-1], after))
    return OPEN if nearest <= outer else CLEAR


@kernel
def _beyond(a: FloatArray, b: FloatArray, distance: float) -> FloatArray:
    length = np.hypot(b[0] - a[0], b[1] - a[1])
    share = distance / length if length > 0.0 else 0.0
    out = np.empty(2)
    out[0] = b[0] + share * (b[0] - a[0])
    out[1] = b[1] + share * (b[1] - a[1])
    return out


@kernel
def segment_distance(ring: FloatArray, a: FloatArray, b: FloatArray) -> float:
    """Distance between the area of a simple ring (V, 2) and the segment a-b [m]."""
    if locate_in_ring(ring, a[0], a[1]) != EXTERIOR:
        return 0.0
    best = np.inf
    before = len(ring) - 1
    for vertex in range(len(ring)):
        c, d = ring[before], ring[vertex]
        if segments_intersect(a, b, c, d):
            return 0.0
        best = min(best, point_segment_distance(a[0], a[1], c[0], c[1], d[0], d[1]))
        best = min(best, point_segment_distance(b[0], b[1], c[0], c[1], d[0], d[1]))
        best = min(best, point_segment_distance(d[0], d[1], a[0], a[1], b[0], b[1]))
        before = vertex
    return best


@kernel
def rings_touch(a: FloatArray, b: FloatArray) -> bool:
    """Whether the areas of two simple rings (V, 2) share a point; touching counts."""
    if (
        locate_in_ring(a, b[0, 0], b[0, 1]) != EXTERIOR
        or locate_in_ring(b, a[0, 0], a[0, 1]) != EXTERIOR
    ):
        return True
    for i in range(len(a)):
        for j in range(len(b)):
            if segments_intersect(a[i - 1], a[i], b[j - 1], b[j]):
                return True
    return False


@kernel
def find_lead(footprint: FloatArray, occupants: Occupants, sides: IntArray) -> tuple[int, float]:
    """The occupant nearest to the footprint (4, 2) and its gap [m]; (-1, inf) if all are CLEAR.

    It may be OPEN; those farther away need not be decided.
    """
    found, best, best_gap = -1, np.inf, np.inf
    for index in range(len(sides)):
        if sides[index] != CLEAR:
            ring = occupants.xy[occupants.ptr[index] : occupants.ptr[index + 1]]
            distance, gap = _ring_gap(footprint, ring)
            if distance < best:
                found, best, best_gap = index, distance, gap
    return found, best_gap


@kernel
def _ring_gap(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance between two rings, and the same measured between their nearest points [m].

    nuPlan takes the latter, and the nearest point on an edge is rounded to what a coordinate in
    UTM can hold.
    """
    if rings_touch(a, b):
        return 0.0, 0.0
    best, gap = np.inf, np.inf
    for swap in range(2):
        points, ring = (a, b) if swap == 0 else (b, a)
        for i in range(len(points)):
            for j in range(len(ring)):
                p, c, d = points[i], ring[j - 1], ring[j]
                distance = point_segment_distance(p[0], p[1], c[0], c[1], d[0], d[1])
                if distance < best:
                    best, gap = distance, _gap_to_edge(p, c, d)
    return best, gap


@kernel
def _gap_to_edge(p: FloatArray, a: FloatArray, b: FloatArray) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    along = ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square if square > 0.0 else 0.0
    along = min(max(along, 0.0), 1.0)
    x = b[0] if along == 1.0 else a[0] + along * dx
    y = b[1] if along == 1.0 else a[1] + along * dy
    return np.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2)
