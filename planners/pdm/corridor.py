"""Which tracks and lights stand in the corridor of a path, on every forecast map."""

from typing import NamedTuple

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.arrays import FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.polylines import (
    BAND,
    CLEAR,
    HIT,
    OPEN,
    Path,
    Stretch,
    corridor_polygon,
    project,
    side_of,
    window,
    without_repeats,
)
from shiftsim.geometry.rings import centroid
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Forecast, ring_of


class Corridor(NamedTuple):
    """A stretch of a path and what stands in it. M tracks and lights."""

    low: float  # progress at its start [m]
    high: float  # progress at its end [m]
    half_width: float  # radius of the buffer [m]
    sides: IntArray  # (41, M) CLEAR, HIT or OPEN on every forecast map
    progress: FloatArray  # (41, M) projection of the centroid on the path, where not CLEAR [m]


def make_corridor(low: float, high: float, half_width: float, count: int) -> Corridor:
    """A corridor that nothing is known of yet."""
    shape = (NUM_FORECASTS, count)
    return Corridor(low, high, half_width, np.full(shape, CLEAR), np.zeros(shape))


def fill_corridor(
    path: Path, corridor: Corridor, forecast: Forecast, first: int, last: int
) -> None:
    """Decide forecast maps `first` … `last` - 1 of a corridor."""
    if _fill(path, corridor, forecast, first, last):
        polygon = corridor_shape(path, corridor)
        shapely.prepare(polygon)
        for row, index in np.argwhere(corridor.sides[first:last] == OPEN).tolist():
            ring = shapely.Polygon(ring_of(forecast, index, first + row))
            side = HIT if polygon.intersects(ring) else CLEAR
            corridor.sides[first + row, index] = side


def corridor_shape(path: Path, corridor: Corridor) -> shapely.Polygon:
    """The polygon that nuPlan compares tracks and lights with."""
    first, last = window(path, corridor.low, corridor.high)
    if last - first > 1:
        line = shapely.LineString(path.xy[first:last])
    else:
        ends = np.clip([corridor.low, corridor.high], 0.0, path.progress[-1]).tolist()
        line = substring(shapely.LineString(path.xy), *ends)
    return corridor_polygon(line, corridor.half_width)


@kernel
def _fill(path: Path, corridor: Corridor, forecast: Forecast, first: int, last: int) -> bool:
    """Fill in what distances decide; whether something stays OPEN."""
    sides, progress, others = corridor.sides, corridor.progress, forecast.others
    begin, end = window(path, corridor.low, corridor.high)
    begin, end = without_repeats(path.xy, begin, end)
    stretch = Stretch(path.xy, path.runs, begin, end, corridor.half_width)
    has_length = end - begin > 1
    reach = 1.5 * (1.0 + BAND) * stretch.half_width  # covers the corners of the square ends
    bounds = _bounds(stretch, reach)
    num_boxes, is_open = len(others.radii), False
    for index in range(num_boxes):
        guess, radius = 0, others.radii[index]
        for row in range(first, last):
            if row > first and not forecast.moves[index]:
                sides[row, index] = sides[row - 1, index]
                progress[row, index] = progress[row - 1, index]
                continue
            x, y = others.centers[row, index, 0], others.centers[row, index, 1]
            if has_length and not (
                bounds[0] - radius <= x <= bounds[2] + radius
                and bounds[1] - radius <= y <= bounds[3] + radius
            ):
                continue
            middle = others.centroids[row, index]
            along, distance, guess = project(path, middle[0], middle[1], guess)
            if has_length and distance > reach + radius:
                continue
            is_inside = (
                has_length
                and path.progress[begin] <= along <= path.progress[end - 1]
                and distance <= (1.0 - BAND) * stretch.half_width
            )
            side = HIT if is_inside else side_of(stretch, others.boxes[row, index])
            sides[row, index], progress[row, index] = side, along
            is_open = is_open or side == OPEN
    for light in range(len(forecast.light_ptr) - 1):
        ring = forecast.light_xy[forecast.light_ptr[light] : forecast.light_ptr[light + 1]]
        x, y = centroid(ring)
        side = side_of(stretch, ring)
        is_open = is_open or side == OPEN
        along = project(path, x, y, 0)[0]
        for row in range(first, last):
            sides[row, num_boxes + light] = side
            progress[row, num_boxes + light] = along
    return is_open


@lean_kernel
def _bounds(stretch: Stretch, reach: float) -> tuple[float, float, float, float]:
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for vertex in range(stretch.begin, stretch.end):
        x, y = stretch.xy[vertex, 0], stretch.xy[vertex, 1]
        low_x, high_x = min(low_x, x - reach), max(high_x, x + reach)
        low_y, high_y = min(low_y, y - reach), max(high_y, y + reach)
    return low_x, low_y, high_x, high_y
