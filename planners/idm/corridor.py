"""Which objects stand in the IDM planner's way, and which of them is the lead.

The corridor is the path ahead, buffered by half the ego's width, united with the ego's footprint.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import circle_around
from shiftsim.geometry.polylines import (
    CLEAR,
    HIT,
    RUN,
    Stretch,
    bound_runs,
    corridor_polygon,
    side_of,
    without_repeats,
)
from shiftsim.geometry.rings import point_segment_distance, rings_touch

UNKNOWN = -1  # instead of CLEAR, HIT or OPEN: not looked at yet


class Objects(NamedTuple):
    """Polygons around the ego. M objects."""

    xy: FloatArray  # (V, 2) vertices of all rings, not closed [m]
    ptr: IntArray  # (M + 1,) first vertex of each ring
    circles: FloatArray  # (M, 3) x, y, radius of a circle around each ring [m]
    headings: FloatArray  # (M,) heading, 0 for a red light [rad]
    speeds: FloatArray  # (M,) speed, 0 for static objects and red lights [m/s]


@kernel
def find_sides(
    line: FloatArray, half_width: float, footprint: FloatArray, objects: Objects, out: IntArray
) -> None:
    """Decide which objects touch the corridor, as far as distances can.

    The corridor is the stretch of path (K, 2) or (K, 3), buffered by `half_width` [m], and the
    `footprint` (4, 2) of the ego. CLEAR, HIT or OPEN is written to `out` (M,) where UNKNOWN stands.
    """
    runs = np.empty(((len(line) - 2) // RUN + 1, 4))
    bound_runs(line, runs)
    begin, end = without_repeats(line, 0, len(line))
    stretch = Stretch(line, runs, begin, end, half_width)
    ego_x, ego_y, reach = circle_around(footprint)
    for index in range(len(out)):
        if out[index] != UNKNOWN:
            continue
        ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
        x, y, radius = objects.circles[index]
        if np.hypot(x - ego_x, y - ego_y) <= radius + reach and rings_touch(ring, footprint):
            out[index] = HIT
        else:
            out[index] = side_of(stretch, ring, x, y, radius)


def exact_side(
    line: FloatArray, half_width: float, footprint: FloatArray, objects: Objects, index: int
) -> int:
    """The side of an OPEN object, by the polygon nuPlan uses; arguments as for `find_sides`."""
    corridor = corridor_polygon(shapely.LineString(line[:, :2]), half_width)
    corridor = corridor.union(shapely.Polygon(footprint))
    ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
    return HIT if corridor.intersects(shapely.Polygon(ring)) else CLEAR


@lean_kernel
def find_lead(footprint: FloatArray, objects: Objects, sides: IntArray) -> tuple[int, float]:
    """The object nearest to the footprint (4, 2) and its gap [m]; (-1, inf) if all are CLEAR.

    It may be OPEN; those farther away need not be decided.
    """
    found, best, best_gap = -1, np.inf, np.inf
    for index in range(len(sides)):
        if sides[index] != CLEAR:
            ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
            distance, gap = _ring_gap(footprint, ring)
            if distance < best:
                found, best, best_gap = index, distance, gap
    return found, best_gap


@lean_kernel
def _ring_gap(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance between two rings, and the same measured between their nearest points [m]."""
    # nuPlan rule 154: the gap is the latter, and the nearest point on an edge is rounded to what a
    # coordinate in UTM can hold; hence not `ring_distance`
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


@lean_kernel
def _gap_to_edge(p: FloatArray, a: FloatArray, b: FloatArray) -> float:
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    along = ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square if square > 0.0 else 0.0
    along = min(max(along, 0.0), 1.0)
    x = b[0] if along == 1.0 else a[0] + along * dx
    y = b[1] if along == 1.0 else a[1] + along * dy
    return np.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2)
