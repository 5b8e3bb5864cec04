"""Which tracks and lights stand in the corridors of the paths, on every forecast map."""

from typing import NamedTuple

import numpy as np
import shapely
from shapely.ops import substring

from shiftsim.geometry.polylines import (
    BAND,
    CLEAR,
    HIT,
    OPEN,
    RUN,
    Path,
    PathInterval,
    corridor_polygon,
    is_run_near,
    is_run_within,
    project,
    side_of,
    window,
    without_repeats,
)
from shiftsim.geometry.rings import SLACK, centroid
from shiftsim.kernels import FloatArray, IntArray, kernel
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


class BoxFrame(NamedTuple):
    """Axes and size of a box."""

    cos: float  # cosine of its heading
    sin: float  # sine of its heading
    half_length: float  # [m]
    half_width: float  # [m]


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


@kernel
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
    stretch = PathInterval(path.xy, path.runs, begin, end, corridors.half_width)
    has_length = end - begin > 1
    reach = 1.5 * (1.0 + BAND) * stretch.half_width  # covers the corners of the square ends
    num_boxes = len(others.radii)
    for index in range(sides.shape[1]):
        light = index - num_boxes
        stop = last if light < 0 and forecast.moves[index] else first + 1
        if stop < last and first > 1:
            stop = first  # all is known
        ring = (
            others.boxes[first, index]
            if light < 0
            else forecast.light_xy[forecast.light_ptr[light] : forecast.light_ptr[light + 1]]
        )
        near, farthest, radius, frame = 0, 0, 0.0, BoxFrame(1.0, 0.0, 0.0, 0.0)
        is_box = has_length and light < 0 and stop > first
        if is_box:
            # boxes move in straight lines
            start, there = others.centers[first, index], others.centers[stop - 1, index]
            swept = (
                *(min(start[0], there[0]), min(start[1], there[1])),
                *(max(start[0], there[0]), max(start[1], there[1])),
            )
            radius = others.radii[index] + SLACK
            near, farthest = _runs_near(stretch, swept, reach + radius)
            if near > farthest:
                continue
            frame = BoxFrame(
                np.cos(forecast.headings[index]),
                np.sin(forecast.headings[index]),
                0.5 * np.hypot(ring[0, 0] - ring[1, 0], ring[0, 1] - ring[1, 1]),
                0.5 * np.hypot(ring[1, 0] - ring[2, 0], ring[1, 1] - ring[2, 1]),
            )
        guess = near
        for row in range(first, stop):
            side = OPEN
            if is_box:
                center = others.centers[row, index]
                side = _side_of_frame(path, stretch, near, farthest, radius, center, frame)
            if side == CLEAR:
                continue
            if light < 0:
                ring = others.boxes[row, index]
                x, y = others.centroids[row, index, 0], others.centroids[row, index, 1]
            else:
                x, y = centroid(ring)
            along, _, guess = project(path, x, y, guess)
            if side == OPEN:
                side = side_of(stretch, ring)
            sides[row, index], progress[row, index] = side, along
        known = stop - 1
        if stop < last and sides[known, index] != CLEAR:
            for row in range(stop, last):
                sides[row, index], progress[row, index] = (
                    sides[known, index],
                    progress[known, index],
                )


@kernel
def _side_of_frame(
    path: Path,
    stretch: PathInterval,
    first: int,  # run that may be near
    last: int,  # likewise; those outside are not
    radius: float,  # of a circle around the box [m]
    center: FloatArray,  # (2,) of the box [m]
    frame: BoxFrame,
) -> int:
    """As `side_of`, from distances of a box from vertices alone: OPEN where these say nothing."""
    inner, outer = (1.0 - BAND) * stretch.half_width - SLACK, (1.0 + BAND) * stretch.half_width
    x, y, begin, end = center[0], center[1], stretch.begin, stretch.end - 1
    cap = 1.5 * outer  # to the corners of the square ends
    side = CLEAR
    if (
        _square_from(frame, stretch.xy[begin, 0] - x, stretch.xy[begin, 1] - y) <= cap * cap
        or _square_from(frame, stretch.xy[end, 0] - x, stretch.xy[end, 1] - y) <= cap * cap
    ):
        side = OPEN
    for run in range(first, last + 1):
        if not is_run_within(stretch.runs, run, x, y, radius + outer):
            continue
        for vertex in range(max(begin, run * RUN), min(end, (run + 1) * RUN) + 1):
            square = _square_from(frame, stretch.xy[vertex, 0] - x, stretch.xy[vertex, 1] - y)
            if square <= inner * inner:
                return HIT
            # no point of the segments beside it is farther from one of their ends
            step = path.progress[vertex] - path.progress[max(vertex - 1, begin)]
            step = max(step, path.progress[min(vertex + 1, end)] - path.progress[vertex])
            limit = outer + 0.5 * step + SLACK
            if square <= limit * limit:
                side = OPEN
    return side


@kernel
def _square_from(frame: BoxFrame, dx: float, dy: float) -> float:
    """Square of the distance of a box from a point, given from its centre [m^2]."""
    along = max(abs(frame.cos * dx + frame.sin * dy) - frame.half_length, 0.0)
    across = max(abs(frame.cos * dy - frame.sin * dx) - frame.half_width, 0.0)
    return along * along + across * across


@kernel
def _runs_near(
    stretch: PathInterval, bounds: tuple[float, float, float, float], reach: float
) -> tuple[int, int]:
    """The first and the last run of a stretch near to bounds; where none is, the last is less."""
    first, last = len(stretch.runs), -1
    for run in range(stretch.begin // RUN, (stretch.end - 2) // RUN + 1):
        if is_run_near(stretch.runs, run, bounds, reach):
            first, last = min(first, run), run
    return first, last
