"""Which occupants stand in the corridor of a path, on every forecast map (pdm-closed.md §6.1).

nuPlan buffers a stretch of the path by half the ego's width: square ends, round joins of 16 segments
per quarter circle. Distances to the path decide nearly everything; what lies in the thin band in
which that polygon and the true buffer may differ is compared with the polygon itself.
"""

from typing import NamedTuple

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.arrays import FloatArray, IntArray, kernel
from shiftsim.planners.idm_corridor import BAND, CLEAR, HIT, OPEN, segment_distance
from shiftsim.planners.pdm_forecast import (
    LIGHT,
    NUM_FORECASTS,
    Occupants,
    centroid,
    place_ring,
    ring_of,
    widest,
)
from shiftsim.planners.pdm_path import RUN, PdmPath, project, window

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
    begin, end = window(path, corridor.low, corridor.high)
    begin, end = _drop_repeats(path.xy, begin, end)
    outer = (1.0 + BAND) * corridor.half_width
    reach = 1.5 * outer  # covers the corners of the square ends
    bounds = _bounds(path.xy, begin, end, reach)
    ring_room = np.empty((widest(occupants), 2))
    is_open = False
    for index in range(len(occupants.kinds)):
        guess = 0
        moves = occupants.motion[index, 0] != 0.0 or occupants.motion[index, 1] != 0.0
        circle = occupants.circles[index].copy()
        for forecast in range(first, last):
            if forecast > first and not moves:
                corridor.sides[forecast, index] = corridor.sides[forecast - 1, index]
                corridor.progress[forecast, index] = corridor.progress[forecast - 1, index]
                continue
            seconds = 0.1 * (2 * forecast)
            circle[0] = occupants.circles[index, 0] + seconds * occupants.motion[index, 0]
            circle[1] = occupants.circles[index, 1] + seconds * occupants.motion[index, 1]
            if end - begin > 1 and not (
                bounds[0] - circle[2] <= circle[0] <= bounds[2] + circle[2]
                and bounds[1] - circle[2] <= circle[1] <= bounds[3] + circle[2]
            ):
                continue
            ring = ring_room[: place_ring(occupants, index, forecast, ring_room)]
            x, y = centroid(ring)
            progress, distance, guess = project(path, x, y, guess)
            side = OPEN
            if end - begin > 1:
                is_box = occupants.kinds[index] != LIGHT
                if is_box and distance > reach + circle[2]:
                    side = CLEAR
                elif (
                    distance <= (1.0 - BAND) * corridor.half_width
                    and path.progress[begin] <= progress <= path.progress[end - 1]
                    and is_box
                ):
                    side = HIT
                else:
                    side = _side(path, begin, end, corridor.half_width, ring, circle)
            corridor.sides[forecast, index] = side
            corridor.progress[forecast, index] = progress
            is_open = is_open or side == OPEN
    return is_open


@kernel
def _drop_repeats(xy: FloatArray, begin: int, end: int) -> tuple[int, int]:
    """A stretch of vertices whose first and last segments have a length; 1 vertex if there is none."""
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


@kernel
def _side(
    path: PdmPath, begin: int, end: int, half_width: float, ring: FloatArray, circle: FloatArray
) -> int:
    inner, outer = (1.0 - BAND) * half_width, (1.0 + BAND) * half_width
    limit = circle[2] + outer
    nearest = np.inf
    for run in range(begin // RUN, (end - 2) // RUN + 1):
        dx = max(path.runs[run, 0] - circle[0], 0.0, circle[0] - path.runs[run, 2])
        dy = max(path.runs[run, 1] - circle[1], 0.0, circle[1] - path.runs[run, 3])
        if dx * dx + dy * dy > limit * limit:
            continue
        for index in range(max(begin, run * RUN), min(end - 1, (run + 1) * RUN)):
            nearest = min(nearest, segment_distance(ring, path.xy[index], path.xy[index + 1]))
            if nearest <= inner:
                return HIT
    # beyond the first and the last vertex the corridor goes on straight by half a width
    nearest = min(nearest, _cap_distance(path.xy[begin + 1], path.xy[begin], outer, ring, circle))
    nearest = min(nearest, _cap_distance(path.xy[end - 2], path.xy[end - 1], outer, ring, circle))
    return OPEN if nearest <= outer else CLEAR


@kernel
def _cap_distance(
    a: FloatArray, b: FloatArray, outer: float, ring: FloatArray, circle: FloatArray
) -> float:
    """Distance from a ring to the extension of the segment a-b beyond b; inf if it is far."""
    length = np.hypot(b[0] - a[0], b[1] - a[1])
    if np.hypot(circle[0] - b[0], circle[1] - b[1]) > circle[2] + 2.0 * outer:
        return np.inf
    tip = np.empty(2)
    tip[0] = b[0] + outer / length * (b[0] - a[0])
    tip[1] = b[1] + outer / length * (b[1] - a[1])
    return segment_distance(ring, b, tip)
