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
from shiftsim.geometry.rings import (
    EXTERIOR,
    locate_in_ring,
    point_segment_distance,
    ring_bounds,
    rings_touch,
    segments_meet,
)
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
    xy, runs, nearest, starts_outside = corridor.xy, corridor.runs, np.inf, False
    for run in range(corridor.begin // RUN, (corridor.end - 2) // RUN + 1):
        if not is_run_near(runs, run, bounds, limit):
            starts_outside = False
            continue
        first, stop = max(corridor.begin, run * RUN), min(corridor.end - 1, (run + 1) * RUN)
        for index in range(first, stop):
            # scalars instead of slices, which numba counts references of
            ax, ay, bx, by = xy[index, 0], xy[index, 1], xy[index + 1, 0], xy[index + 1, 1]
            low_x, high_x = min(ax, bx) - limit, max(ax, bx) + limit
            low_y, high_y = min(ay, by) - limit, max(ay, by) + limit
            if low_x > bounds[2] or low_y > bounds[3] or high_x < bounds[0] or high_y < bounds[1]:
                starts_outside = True  # the next segment, at the end of this one
                continue
            if not starts_outside and locate_in_ring(ring, ax, ay) != EXTERIOR:
                return 0.0
            starts_outside = True
            best, before = np.inf, len(ring) - 1
            for vertex in range(len(ring)):
                cx, cy, dx, dy = ring[before, 0], ring[before, 1], ring[vertex, 0], ring[vertex, 1]
                before = vertex
                if (
                    max(cx, dx) < low_x
                    or min(cx, dx) > high_x
                    or max(cy, dy) < low_y
                    or min(cy, dy) > high_y
                ):
                    continue
                if segments_meet(ax, ay, bx, by, cx, cy, dx, dy):
                    return 0.0
                best = min(best, point_segment_distance(ax, ay, cx, cy, dx, dy))
                best = min(best, point_segment_distance(bx, by, cx, cy, dx, dy))
                best = min(best, point_segment_distance(dx, dy, ax, ay, bx, by))
            if best <= limit:
                nearest = min(nearest, best)
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
    first = _end_occupancy(xy, begin + 1, begin, corridor.half_width, ring, bounds)
    last = _end_occupancy(xy, end - 2, end - 1, corridor.half_width, ring, bounds)
    if first == last == CLEAR:
        if nearest <= inner:
            return HIT
        return CLEAR if nearest > outer else UNDECIDED
    if square_ends:
        return HIT if first == HIT or last == HIT else UNDECIDED
    return UNDECIDED if nearest <= outer else CLEAR


@kernel
def _end_occupancy(
    xy: FloatArray,
    before: int,
    end: int,
    half_width: float,
    ring: FloatArray,
    bounds: tuple[float, float, float, float],
) -> int:
    """As `occupancy`, for the square end of a corridor alone: half a width straight on.

    The line ends with the vertices `before` and `end`; `bounds` are those of the ring.
    """
    x, y, reach = xy[end, 0], xy[end, 1], 2.0 * (1.0 + BAND) * half_width  # to beyond the corners
    if not (
        bounds[0] - reach <= x <= bounds[2] + reach and bounds[1] - reach <= y <= bounds[3] + reach
    ):
        return CLEAR
    dx, dy, square = x - xy[before, 0], y - xy[before, 1], np.empty((4, 2))
    length = np.hypot(dx, dy)
    for is_outer in range(2):
        reach = (1.0 + BAND) * half_width if is_outer else (1.0 - BAND) * half_width
        along_x, along_y = reach * dx / length, reach * dy / length
        for corner in range(4):
            ahead = 1.0 if corner == 0 or corner == 3 else 0.0
            left = 1.0 if corner < 2 else -1.0
            square[corner, 0] = x + ahead * along_x - left * along_y
            square[corner, 1] = y + ahead * along_y + left * along_x
        if rings_touch(square, ring):
            return UNDECIDED if is_outer else HIT
    return CLEAR


def corridor_polygon(line: shapely.LineString, half_width: float) -> shapely.Polygon:
    """The corridor of a line with square ends as nuPlan makes it."""
    return line.buffer(half_width, quad_segs=_QUARTER_SEGMENTS, cap_style="square")
