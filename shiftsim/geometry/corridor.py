"""Corridors: does a ring touch a stretch of a line that is buffered by a half width?

nuPlan builds the polygon of the buffer and asks which objects intersect it. Distances to the line
decide the same thing at a fraction of the cost, except in a thin band: the polygon's round joins
are segmented, and GEOS leaves out shallow vertices first. What lies in the band stays UNDECIDED,
for the polygon itself to decide.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.polylines import RUN
from shiftsim.geometry.rings import ring_bounds, ring_segment_distance, rings_touch
from shiftsim.kernels import FloatArray, kernel

CLEAR, HIT, UNDECIDED = 0, 1, 2
# GEOS drops vertices of the line within 1 % of the radius, and its arcs (16 segments per quarter)
# lie 0.1 % inside the circle; twice that is safe
BAND = 0.02
_QUARTER_SEGMENTS = 16  # of the round joins


class Corridor(NamedTuple):
    """A stretch of a polyline, and how far it is buffered."""

    xy: FloatArray  # (K, 2) vertices of the whole polyline [m]
    runs: FloatArray  # (R, 4) bounds of its runs of segments, as in `Path` [m]
    begin: int  # first vertex of the stretch
    end: int  # one past its last vertex
    half_width: float  # radius of the buffer [m]


@kernel
def without_repeats(xy: FloatArray, begin: int, end: int) -> tuple[int, int]:
    """Vertices `begin` … `end` - 1 without repeats at their ends; one if all are the same."""
    while end - begin > 1 and xy[begin, 0] == xy[begin + 1, 0] and xy[begin, 1] == xy[begin + 1, 1]:
        begin += 1
    while end - begin > 1 and xy[end - 1, 0] == xy[end - 2, 0] and xy[end - 1, 1] == xy[end - 2, 1]:
        end -= 1
    return begin, end


@kernel
def line_distance(
    corridor: Corridor,
    ring: FloatArray,
    bounds: tuple[float, float, float, float],
    enough: float,
    limit: float,
) -> float:
    """Distance of the area of a ring (V, 2) from the line of a corridor, inf beyond `limit` [m].

    The search ends at the first distance that is not above `enough`. `bounds` are the ring's.
    """
    xy, runs = corridor.xy, corridor.runs
    nearest, starts_outside = np.inf, False
    for run in range(corridor.begin // RUN, (corridor.end - 2) // RUN + 1):
        if not is_run_near(runs, run, bounds, limit):
            starts_outside = False
            continue
        first, stop = max(corridor.begin, run * RUN), min(corridor.end - 1, (run + 1) * RUN)
        for index in range(first, stop):
            distance = ring_segment_distance(ring, xy[index], xy[index + 1], limit, starts_outside)
            nearest, starts_outside = min(nearest, distance), True
            if nearest <= enough:
                return nearest
    return nearest


@kernel
def is_run_near(
    runs: FloatArray, run: int, bounds: tuple[float, float, float, float], reach: float
) -> bool:
    """Whether a run and what lies in `bounds` may come within `reach` [m] of one another."""
    return (
        runs[run, 0] <= bounds[2] + reach
        and runs[run, 1] <= bounds[3] + reach
        and runs[run, 2] >= bounds[0] - reach
        and runs[run, 3] >= bounds[1] - reach
    )


@kernel
def occupancy(corridor: Corridor, ring: FloatArray, square_ends: bool) -> int:
    """CLEAR, HIT or UNDECIDED: whether a ring (V, 2) touches a corridor.

    Its stretch ends `without_repeats`; UNDECIDED where it has a single vertex. With `square_ends`
    the corridor goes on straight by half a width, else it ends flat.
    """
    xy, begin, end = corridor.xy, corridor.begin, corridor.end
    if end - begin < 2:
        return UNDECIDED
    inner, outer = (1.0 - BAND) * corridor.half_width, (1.0 + BAND) * corridor.half_width
    bounds = ring_bounds(ring)
    enough = inner if square_ends else 0.0
    nearest = line_distance(corridor, ring, bounds, enough, outer)
    if nearest <= enough:
        return HIT
    first = _end_occupancy(xy[begin + 1], xy[begin], corridor.half_width, ring, bounds)
    last = _end_occupancy(xy[end - 2], xy[end - 1], corridor.half_width, ring, bounds)
    if first == last == CLEAR:
        if nearest <= inner:
            return HIT
        return CLEAR if nearest > outer else UNDECIDED
    if square_ends:
        return HIT if first == HIT or last == HIT else UNDECIDED
    return UNDECIDED if nearest <= outer else CLEAR


@kernel
def _end_occupancy(
    a: FloatArray,
    b: FloatArray,
    half_width: float,
    ring: FloatArray,
    bounds: tuple[float, float, float, float],
) -> int:
    """As `occupancy`, for the square end of a corridor alone: half a width straight on from b.

    Before b (2,) comes a (2,); `bounds` are those of the ring.
    """
    reach = 2.0 * (1.0 + BAND) * half_width  # more than to the corners
    if not (
        bounds[0] - reach <= b[0] <= bounds[2] + reach
        and bounds[1] - reach <= b[1] <= bounds[3] + reach
    ):
        return CLEAR
    length, square = np.hypot(b[0] - a[0], b[1] - a[1]), np.empty((4, 2))
    for is_outer in range(2):
        reach = (1.0 + BAND) * half_width if is_outer else (1.0 - BAND) * half_width
        along_x, along_y = reach * (b[0] - a[0]) / length, reach * (b[1] - a[1]) / length
        for corner in range(4):
            ahead = 1.0 if corner == 0 or corner == 3 else 0.0
            left = 1.0 if corner < 2 else -1.0
            square[corner, 0] = b[0] + ahead * along_x - left * along_y
            square[corner, 1] = b[1] + ahead * along_y + left * along_x
        if rings_touch(square, ring):
            return UNDECIDED if is_outer else HIT
    return CLEAR


def corridor_polygon(line: shapely.LineString, half_width: float) -> shapely.Polygon:
    """The corridor of a line with square ends as nuPlan makes it."""
    return line.buffer(half_width, quad_segs=_QUARTER_SEGMENTS, cap_style="square")
