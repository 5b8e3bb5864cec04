"""Which tracks and lights stand in the corridors of the paths, on every forecast map."""

from typing import NamedTuple

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.geometry.corridor import (
    BAND,
    CLEAR,
    Corridor,
    corridor_polygon,
    is_run_near,
    occupancy,
    without_repeats,
)
from shiftsim.geometry.polylines import RUN, Path, project, window
from shiftsim.geometry.rings import centroid, ring_bounds
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.pdm.forecast import Forecast


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
    occupancy: IntArray  # (L, 41, M) CLEAR, HIT or UNDECIDED on every forecast map
    progress: FloatArray  # (L, 41, M) projection of the centroid on the path, where not CLEAR [m]


def corridor_shape(path: Path, low: float, high: float, half_width: float) -> shapely.Polygon:
    """The polygon that nuPlan compares tracks and lights with."""
    first, last = window(path, low, high)
    if last - first > 1:
        line = shapely.LineString(path.xy[first:last])
    else:
        ends = np.clip([low, high], 0.0, path.progress[-1]).tolist()
        line = substring(shapely.LineString(path.xy), *ends)
    return corridor_polygon(line, half_width)


@kernel
def fill_corridor(
    path: Path, corridors: Corridors, forecast: Forecast, number: int, first: int, last: int
) -> None:
    """Fill in what distances decide, on forecast maps `first` … `last` - 1, for a path's corridor.

    Of what stands still, maps beyond the second one repeat the one before.
    """
    known, progress = corridors.occupancy[number], corridors.progress[number]
    boxes, centroids = forecast.others.boxes, forecast.others.centroids
    light_ptr, light_xy, runs = forecast.light_ptr, forecast.light_xy, path.runs
    begin, end = window(path, corridors.spans[number, 0], corridors.spans[number, 1])
    begin, end = without_repeats(path.xy, begin, end)
    corridor = Corridor(path.xy, runs, begin, end, corridors.half_width)
    reach = 1.5 * (1.0 + BAND) * corridors.half_width  # covers the corners of the square ends
    num_boxes = len(forecast.moves)
    for index in range(known.shape[1]):
        light = index - num_boxes
        moves = light < 0 and forecast.moves[index]
        stop = last if moves else min(first + 1, last) if first == 1 else first
        first_near, last_near = begin // RUN, (end - 2) // RUN  # runs
        is_bounded = light < 0 and stop > first and end - begin >= 2
        if is_bounded:
            # boxes move in straight lines
            low_x, low_y, high_x, high_y = ring_bounds(boxes[first, index])
            x0, y0, x1, y1 = ring_bounds(boxes[stop - 1, index])
            swept = (min(low_x, x0), min(low_y, y0), max(high_x, x1), max(high_y, y1))
            while first_near <= last_near and not is_run_near(runs, first_near, swept, reach):
                first_near += 1
            while first_near <= last_near and not is_run_near(runs, last_near, swept, reach):
                last_near -= 1
            if first_near > last_near:
                continue
        guess = 0
        for row in range(first, stop):
            if is_bounded and moves:
                low_x = low_y = np.inf
                high_x = high_y = -np.inf
                for corner in range(4):
                    x, y = boxes[row, index, corner, 0], boxes[row, index, corner, 1]
                    low_x, high_x = min(low_x, x), max(high_x, x)
                    low_y, high_y = min(low_y, y), max(high_y, y)
                run, bounds = first_near, (low_x, low_y, high_x, high_y)
                while run <= last_near and not is_run_near(runs, run, bounds, reach):
                    run += 1
                if run > last_near:
                    continue
            if light < 0:
                ring = boxes[row, index]
                x, y = centroids[row, index, 0], centroids[row, index, 1]
            else:
                ring = light_xy[light_ptr[light] : light_ptr[light + 1]]
                x, y = centroid(ring)
            known[row, index] = occupancy(corridor, ring, True)
            if known[row, index] != CLEAR:
                progress[row, index], _, guess = project(path, x, y, guess)
        for row in range(stop, last):
            if stop > 0 and not moves:
                known[row, index] = known[stop - 1, index]
                progress[row, index] = progress[stop - 1, index]
