"""What touches the corridor of a path: the path buffered by a half width, with square ends.

nuPlan builds that polygon and asks which objects intersect it. Distances to the path decide the
same thing at a fraction of the cost, except in a thin band: the polygon's round joins are
segmented, and GEOS leaves out shallow vertices first. What lies in the band is left OPEN, for the
polygon itself to decide.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import FloatArray, kernel, lean_kernel
from shiftsim.geometry.polylines import RUN, is_run_within
from shiftsim.geometry.rings import point_segment_distance, ring_segment_distance, rings_touch

CLEAR, HIT, OPEN = 0, 1, 2
# GEOS drops vertices of the line within 1 % of the radius, and its arcs (16 segments per quarter)
# lie 0.1 % inside the circle; twice that is safe
BAND = 0.02
_QUARTER_SEGMENTS = 16  # of the round joins


class Stretch(NamedTuple):
    """A stretch of a polyline and the half width of its corridor."""

    xy: FloatArray  # (K, 2) vertices of the whole polyline [m]
    runs: FloatArray  # bounds of its runs, as in `Path`
    begin: int  # first vertex of the stretch
    end: int  # one past its last vertex
    half_width: float  # radius of the buffer around it [m]


@lean_kernel
def without_repeats(xy: FloatArray, begin: int, end: int) -> tuple[int, int]:
    """Vertices `begin` … `end` - 1 without repeats at their ends; one if all are the same."""
    while end - begin > 1 and xy[begin, 0] == xy[begin + 1, 0] and xy[begin, 1] == xy[begin + 1, 1]:
        begin += 1
    while end - begin > 1 and xy[end - 1, 0] == xy[end - 2, 0] and xy[end - 1, 1] == xy[end - 2, 1]:
        end -= 1
    return begin, end


@lean_kernel
def side_of(stretch: Stretch, ring: FloatArray, x: float, y: float, radius: float) -> int:
    """CLEAR, HIT or OPEN: whether a ring (V, 2) touches the corridor of a stretch.

    The ring lies in the circle x, y, `radius` [m]. The stretch ends `without_repeats`; OPEN where
    it has a single vertex.
    """
    xy, begin, end = stretch.xy, stretch.begin, stretch.end
    if end - begin < 2:
        return OPEN
    inner, outer = (1.0 - BAND) * stretch.half_width, (1.0 + BAND) * stretch.half_width
    nearest = np.inf
    for run in range(begin // RUN, (end - 2) // RUN + 1):
        if not is_run_within(stretch.runs, run, x, y, radius + outer):
            continue
        for index in range(max(begin, run * RUN), min(end - 1, (run + 1) * RUN)):
            a, b = xy[index], xy[index + 1]
            if point_segment_distance(x, y, a[0], a[1], b[0], b[1]) > radius + outer:
                continue
            nearest = min(nearest, ring_segment_distance(ring, a, b))
            if nearest <= inner:
                return HIT
    # beyond the first and the last vertex the corridor goes on straight by half a width
    is_open = nearest <= outer
    for last, before in ((begin, begin + 1), (end - 1, end - 2)):
        if np.hypot(x - xy[last, 0], y - xy[last, 1]) <= radius + 2.0 * outer:
            if _touches_cap(xy[before], xy[last], inner, ring):
                return HIT
            is_open = is_open or _touches_cap(xy[before], xy[last], outer, ring)
    return OPEN if is_open else CLEAR


@kernel
def _touches_cap(a: FloatArray, b: FloatArray, reach: float, ring: FloatArray) -> bool:
    """Whether a ring touches the end of the corridor beyond the segment a-b, `reach` long [m]."""
    length = np.hypot(b[0] - a[0], b[1] - a[1])
    along_x, along_y = reach * (b[0] - a[0]) / length, reach * (b[1] - a[1]) / length
    cap = np.empty((4, 2))
    for corner in range(4):
        ahead = 1.0 if corner == 0 or corner == 3 else 0.0
        left = 1.0 if corner < 2 else -1.0
        cap[corner, 0] = b[0] + ahead * along_x - left * along_y
        cap[corner, 1] = b[1] + ahead * along_y + left * along_x
    return rings_touch(cap, ring)


def corridor_polygon(line: shapely.LineString, half_width: float) -> shapely.Polygon:
    """The corridor of a line as nuPlan makes it."""
    return line.buffer(half_width, quad_segs=_QUARTER_SEGMENTS, cap_style="square")
