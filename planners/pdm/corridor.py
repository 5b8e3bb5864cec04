"""Which occupants stand in the corridor of a path, on every forecast map (pdm-closed.md §6.1).

nuPlan buffers a stretch of the path by half the ego's width: square ends, round joins of 16
segments per quarter circle. Distances to the path decide nearly everything; what lies in the thin
band in which that polygon and the true buffer may differ is compared with the polygon itself.
"""

from typing import NamedTuple

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.arrays import FloatArray, IntArray, kernel, lean_kernel
from shiftsim.planners.idm.corridor import BAND, CLEAR, HIT, OPEN, segment_distance
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Occupants, centroid, ring_of
from shiftsim.planners.pdm.path import RUN, PdmPath, project, window
from shiftsim.planners.pdm.route import box_to_ring

QUARTER_SEGMENTS = 16  # of the round joins


class Corridor(NamedTuple):
    """A stretch of a path and what stands in it. M occupants.

    Attributes:
        low: Progress at its start [m].
        high: Progress at its end [m].
        half_width: Radius of the buffer [m].
        sides: (41, M) CLEAR, HIT or OPEN on every forecast map.
        progress: (41, M) projection of the occupant's centroid on the path, where not CLEAR [m].
    """

    low: float
    high: float
    half_width: float
    sides: IntArray
    progress: FloatArray


def make_corridor(low: float, high: float, half_width: float, num_occupants: int) -> Corridor:
    """A corridor that nothing is known of yet."""
    shape = (NUM_FORECASTS, num_occupants)
    return Corridor(low, high, half_width, np.full(shape, CLEAR), np.zeros(shape))


def fill_corridor(
    path: PdmPath, corridor: Corridor, occupants: Occupants, first: int, last: int
) -> None:
    """Decide forecast maps `first` … `last` - 1 of a corridor."""
    if _fill(path, corridor, occupants, first, last):
        polygon = corridor_polygon(path, corridor)
        shapely.prepare(polygon)
        for forecast, index in np.argwhere(corridor.sides[first:last] == OPEN).tolist():
            ring = shapely.Polygon(ring_of(occupants, index, first + forecast))
            side = HIT if polygon.intersects(ring) else CLEAR
            corridor.sides[first + forecast, index] = side


def corridor_polygon(path: PdmPath, corridor: Corridor) -> shapely.Polygon:
    """The polygon that nuPlan compares occupants with."""
    first, last = window(path, corridor.low, corridor.high)
    if last - first > 1:
        line = shapely.LineString(path.xy[first:last])
    else:
        end = path.progress[-1]
        low, high = np.clip([corridor.low, corridor.high], 0.0, end).tolist()
        line = substring(shapely.LineString(path.xy), low, high)
    return line.buffer(corridor.half_width, quad_segs=QUARTER_SEGMENTS, cap_style="square")


@kernel
def _fill(path: PdmPath, corridor: Corridor, occupants: Occupants, first: int, last: int) -> bool:
    """Fill in what distances decide; whether something stays OPEN."""
    xy, runs, half_width = path.xy, path.runs, corridor.half_width
    sides, progress = corridor.sides, corridor.progress
    centers, radii, moves, boxes = (
        occupants.centers,
        occupants.radii,
        occupants.moves,
        occupants.boxes,
    )
    begin, end = window(path, corridor.low, corridor.high)
    begin, end = _drop_repeats(xy, begin, end)
    reach = 1.5 * (1.0 + BAND) * half_width  # covers the corners of the square ends
    bounds = _bounds(xy, begin, end, reach)
    num_boxes, is_open = len(radii), False
    for index in range(num_boxes):
        guess, radius = 0, radii[index]
        for forecast in range(first, last):
            if forecast > first and not moves[index]:
                sides[forecast, index] = sides[forecast - 1, index]
                progress[forecast, index] = progress[forecast - 1, index]
                continue
            x, y = centers[forecast, index, 0], centers[forecast, index, 1]
            if end - begin > 1 and not (
                bounds[0] - radius <= x <= bounds[2] + radius
                and bounds[1] - radius <= y <= bounds[3] + radius
            ):
                continue
            ring = boxes[forecast, index]
            center_x, center_y = centroid(ring)
            along, distance, guess = project(path, center_x, center_y, guess)
            side = OPEN
            if end - begin > 1:
                if distance > reach + radius:
                    continue
                is_inside = path.progress[begin] <= along <= path.progress[end - 1]
                if is_inside and distance <= (1.0 - BAND) * half_width:
                    side = HIT
                else:
                    side = _side(xy, runs, begin, end, half_width, ring, x, y, radius)
            sides[forecast, index], progress[forecast, index] = side, along
            is_open = is_open or side == OPEN
    for light in range(len(occupants.light_ptr) - 1):
        ring = occupants.light_xy[occupants.light_ptr[light] : occupants.light_ptr[light + 1]]
        center_x, center_y = centroid(ring)
        along, _, _ = project(path, center_x, center_y, 0)
        side, radius = OPEN, 0.0
        for vertex in range(len(ring)):
            away = np.hypot(ring[vertex, 0] - center_x, ring[vertex, 1] - center_y)
            radius = max(radius, away)
        if end - begin > 1:
            side = _side(xy, runs, begin, end, half_width, ring, center_x, center_y, radius)
        is_open = is_open or side == OPEN
        for forecast in range(first, last):
            sides[forecast, num_boxes + light] = side
            progress[forecast, num_boxes + light] = along
    return is_open


@lean_kernel
def _drop_repeats(xy: FloatArray, begin: int, end: int) -> tuple[int, int]:
    """The stretch without repeated vertices at its ends; 1 vertex if all are the same."""
    while end - begin > 1 and xy[begin, 0] == xy[begin + 1, 0] and xy[begin, 1] == xy[begin + 1, 1]:
        begin += 1
    while end - begin > 1 and xy[end - 1, 0] == xy[end - 2, 0] and xy[end - 1, 1] == xy[end - 2, 1]:
        end -= 1
    return begin, end


@kernel
def _bounds(xy: FloatArray, begin: int, end: int, reach: float) -> FloatArray:
    out = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for vertex in range(begin, end):
        out[0], out[1] = min(out[0], xy[vertex, 0] - reach), min(out[1], xy[vertex, 1] - reach)
        out[2], out[3] = max(out[2], xy[vertex, 0] + reach), max(out[3], xy[vertex, 1] + reach)
    return out


@lean_kernel
def _side(
    xy: FloatArray,
    runs: FloatArray,
    begin: int,
    end: int,
    half_width: float,
    ring: FloatArray,
    x: float,
    y: float,
    radius: float,
) -> int:
    """Side of a ring within a circle, relative to the vertices `begin` … `end` - 1 of a path."""
    inner, outer = (1.0 - BAND) * half_width, (1.0 + BAND) * half_width
    limit = radius + outer
    nearest = np.inf
    for run in range(begin // RUN, (end - 2) // RUN + 1):
        dx = max(runs[run, 0] - x, 0.0, x - runs[run, 2])
        dy = max(runs[run, 1] - y, 0.0, y - runs[run, 3])
        if dx * dx + dy * dy > limit * limit:
            continue
        for index in range(max(begin, run * RUN), min(end - 1, (run + 1) * RUN)):
            nearest = min(nearest, segment_distance(ring, xy[index], xy[index + 1]))
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
    return box_to_ring(cap, ring) == 0.0
