"""Which tracks and lights stand in the corridors of the paths, on every forecast map."""

from typing import NamedTuple

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.geometry.polylines import (
    BAND,
    CLEAR,
    HIT,
    OPEN,
    RUN,
    Path,
    Stretch,
    corridor_polygon,
    is_run_within,
    project,
    side_of,
    window,
    without_repeats,
)
from shiftsim.geometry.rings import SLACK, centroid
from shiftsim.planners.pdm.forecast import NUM_FORECASTS, Forecast, ring_of


class Paths(NamedTuple):
    """Paths with the same number of vertices, see `Path`. L paths."""

    xy: FloatArray  # (L, K, 2) vertices [m]
    heading: FloatArray  # (L, K) unwrapped heading at each of them [rad]
    progress: FloatArray  # (L, K) arc length at each of them [m]
    runs: FloatArray  # (L, R, 4) bounds of segments 8 r … 8 r + 7

    def at(self, number: int) -> Path:
        """One of them."""
        return Path(*(array[number] for array in self))


class Corridors(NamedTuple):
    """A stretch of every path and what stands in it. M tracks and lights."""

    spans: FloatArray  # (L, 2) progress at its start and at its end [m]
    half_width: float  # radius of the buffer [m]
    sides: IntArray  # (L, 41, M) CLEAR, HIT or OPEN on every forecast map
    progress: FloatArray  # (L, 41, M) projection of the centroid on the path, where not CLEAR [m]


def make_corridors(num_paths: int, half_width: float, count: int) -> Corridors:
    """Corridors of no length that nothing is known of yet."""
    shape = (num_paths, NUM_FORECASTS, count)
    return Corridors(np.zeros((num_paths, 2)), half_width, np.full(shape, CLEAR), np.zeros(shape))


def decide(
    polygon: shapely.Polygon,
    corridors: Corridors,
    forecast: Forecast,
    index: int,
    row: int,
    it: int,
) -> None:
    """Decide by the polygon of a path's corridor what is OPEN; what stands still, for all rows."""
    side = HIT if polygon.intersects(shapely.Polygon(ring_of(forecast, it, row))) else CLEAR
    stands = it >= len(forecast.moves) or not forecast.moves[it]
    rows = corridors.sides[index, :, it] if stands else corridors.sides[index, row : row + 1, it]
    rows[rows == OPEN] = side


def corridor_shape(path: Path, low: float, high: float, half_width: float) -> shapely.Polygon:
    """The polygon that nuPlan compares tracks and lights with."""
    first, last = window(path, low, high)
    if last - first > 1:
        line = shapely.LineString(path.xy[first:last])
    else:
        ends = np.clip([low, high], 0.0, path.progress[-1]).tolist()
        line = substring(shapely.LineString(path.xy), *ends)
    return corridor_polygon(line, half_width)


@lean_kernel
def fill_corridor(
    path: Path, corridors: Corridors, forecast: Forecast, number: int, first: int, last: int
) -> None:
    """Fill in what distances decide, on forecast maps `first` … `last` - 1, for a path's corridor.

    Of what stands still, maps beyond the second one repeat the one before.
    """
    sides, progress, others = corridors.sides[number], corridors.progress[number], forecast.others
    low, high = corridors.spans[number, 0], corridors.spans[number, 1]
    begin, end = window(path, low, high)
    begin, end = without_repeats(path.xy, begin, end)
    stretch = Stretch(path.xy, path.runs, begin, end, corridors.half_width)
    has_length = end - begin > 1
    reach = 1.5 * (1.0 + BAND) * stretch.half_width  # covers the corners of the square ends
    bounds = _bounds(stretch, reach)
    num_boxes = len(others.radii)
    for index in range(num_boxes):
        stop = last
        if not forecast.moves[index]:
            if first > 1:
                _repeat(sides, progress, index, first, last)
                continue
            stop = first + 1
        guess, radius = -1, others.radii[index]
        # boxes move in straight lines
        start, there = others.centers[first, index], others.centers[stop - 1, index]
        slack = radius + SLACK
        if has_length and (
            max(start[0], there[0]) + slack < bounds[0]
            or min(start[0], there[0]) - slack > bounds[2]
            or max(start[1], there[1]) + slack < bounds[1]
            or min(start[1], there[1]) - slack > bounds[3]
        ):
            continue
        for row in range(first, stop):
            center = others.centers[row, index]
            run = _run_near(stretch, center[0], center[1], reach + slack) if has_length else 0
            if run < 0:
                continue
            if guess < 0:
                guess = run
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
        if stop < last:
            _repeat(sides, progress, index, first, last)
    for light in range(len(forecast.light_ptr) - 1):
        index = num_boxes + light
        if first <= 1:
            ring = forecast.light_xy[forecast.light_ptr[light] : forecast.light_ptr[light + 1]]
            x, y = centroid(ring)
            sides[first, index] = side_of(stretch, ring)
            progress[first, index] = project(path, x, y, 0)[0]
        _repeat(sides, progress, index, first, last)


@lean_kernel
def _repeat(sides: IntArray, progress: FloatArray, index: int, first: int, last: int) -> None:
    """Write what is known of something that stands still on maps `first` … `last` - 1."""
    known = first - 1 if first > 1 else first
    if sides[known, index] != CLEAR:
        for row in range(first, last):
            sides[row, index], progress[row, index] = sides[known, index], progress[known, index]


@lean_kernel
def _run_near(stretch: Stretch, x: float, y: float, limit: float) -> int:
    """The first run of a stretch whose bounds come within `limit` [m] of a point, or -1."""
    for run in range(stretch.begin // RUN, (stretch.end - 2) // RUN + 1):
        if is_run_within(stretch.runs, run, x, y, limit):
            return run
    return -1


@lean_kernel
def _bounds(stretch: Stretch, reach: float) -> tuple[float, float, float, float]:
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for run in range(stretch.begin // RUN, max(stretch.end - 2, stretch.begin) // RUN + 1):
        low_x, high_x = min(low_x, stretch.runs[run, 0]), max(high_x, stretch.runs[run, 2])
        low_y, high_y = min(low_y, stretch.runs[run, 1]), max(high_y, stretch.runs[run, 3])
    return low_x - reach, low_y - reach, high_x + reach, high_y + reach
