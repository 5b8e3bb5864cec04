"""What PLUTO takes from the map around the ego: drivable areas and reference lines.

The drivable areas are those of PDM-Closed with a larger square. A reference line
is one way along the lanes of the route, cut to the next 120 m.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.planners.proposals.areas import Areas, make_areas, select_areas
from shiftsim.planners.routes.graph import LanePath, deviation, lane_path, sub_path
from shiftsim.world.map import NONE, VectorMap

AREA_HALF_SIDE = 60.0  # m, of the square of the drivable areas
FALLBACK_LIMIT = 50.0  # m/s, of lanes without a speed limit
START_HALF_SIDE = 3.0  # m, of the square a reference line starts in
LINE_LENGTH = 120.0  # m
LONG_ENOUGH = 0.8 * LINE_LENGTH  # m, shorter lines give way to longer ones
MIN_BASELINE = 2.0  # m
MAX_HEADING_ERROR = np.pi / 2.0  # rad
MAX_LANES = 15  # of one line
STRIDE = 4  # vertices between two points that are looked at
NUM_POINTS = 120  # of a line in the features
SAME_LINE = 0.5  # m, |dx| + |dy| of two lines that count as one


class Drivable(NamedTuple):
    """Drivable areas of one step."""

    areas: Areas  # all areas of the map, those of the route marked
    selected: IntArray  # areas near the ego
    limits: FloatArray  # (M,) speed limit of each area of the map, of this step [m/s]


class RouteLanes(NamedTuple):
    """What is made once per scenario."""

    blocks: list[int]  # blocks of the corrected route, each once
    starts: IntArray  # connectors, then lanes of these blocks, in the order of the map
    has_block: BoolArray  # (B,) whether a block is one of these
    is_on: BoolArray  # (E,) whether a lane belongs to one of these blocks
    areas: Areas  # areas of the map, those of the route marked
    limits: FloatArray  # (M,) speed limits [m/s]
    paths: dict[tuple[int, ...], LanePath]  # made so far, by their lanes


def areas_of_map(road: VectorMap) -> tuple[Areas, FloatArray]:
    """Areas of a map, none on a route, and their speed limits (M,), 50 m/s where it has none."""
    limits = np.full(len(road.edges) + len(road.car_parks), FALLBACK_LIMIT)
    known = np.nan_to_num(road.speed_limits, nan=0.0)
    limits[: len(known)] = np.where(known == 0.0, FALLBACK_LIMIT, known)
    return make_areas(road, []), limits


def route_lanes(
    road: VectorMap, map_areas: tuple[Areas, FloatArray], blocks: Sequence[int]
) -> RouteLanes:
    """Lanes of a corrected route; `map_areas` are of `areas_of_map`."""
    areas, limits = map_areas
    unique = list(dict.fromkeys(blocks))
    has_block = np.zeros(len(road.blocks), np.bool_)
    has_block[unique] = True
    is_on = (road.block_of != NONE) & has_block[road.block_of]
    lanes = np.flatnonzero(is_on)
    starts = np.concatenate([lanes[lanes >= road.num_lanes], lanes[lanes < road.num_lanes]])
    areas = areas._replace(on_route=np.isin(areas.lane, lanes))
    return RouteLanes(unique, starts, has_block, is_on, areas, limits, {})


def drivable_near(road: VectorMap, route: RouteLanes, x: float, y: float) -> Drivable:
    """Drivable areas around the ego centre (x, y) [m]."""
    selected = select_areas(road, x, y, AREA_HALF_SIDE)
    limits = route.limits
    if len(selected) and selected[-1] >= len(road.edges):
        # nuPlan rule 246: a car park has the limit of the lane visited last
        lanes = selected[selected < len(road.edges)]
        limits = limits.copy()
        limits[len(road.edges) :] = limits[lanes[-1]] if len(lanes) else FALLBACK_LIMIT
    return Drivable(route.areas, selected, limits)


def reference_lines(
    road: VectorMap, route: RouteLanes, rear: FloatArray, center: FloatArray
) -> list[FloatArray]:
    """Ways along the route from here on: (K, 3) x [m], y [m], heading [rad]; none where off it.

    `rear` (3,) and `center` (3,) are the poses of the rear axle and of the ego box.
    """
    x, y = float(rear[0]), float(rear[1])
    near = set(road.edges.within_box(float(center[0]), float(center[1]), START_HALF_SIDE).tolist())
    starts = [
        start
        for start in route.starts.tolist()
        if start in near
        and road.baselines.length(start) > MIN_BASELINE
        and deviation(road.baselines, start, STRIDE, *rear.tolist())[1] < MAX_HEADING_ERROR
    ]
    after = {lane for start in starts for lane in road.outgoing.at(start).tolist()}
    lines, lengths = [], []
    for start in starts:
        if start in after:
            continue
        for path in _paths_from(road, route.is_on, start, road.progress_on(start, x, y)):
            if path not in route.paths:
                route.paths[path] = lane_path(road, path)
            line, length = _cut(route.paths[path], x, y)
            lines.append(line)
            lengths.append(length)
    if any(length > LONG_ENOUGH for length in lengths):
        lines = [lines[i] for i, length in enumerate(lengths) if length > LONG_ENOUGH]
    return _distinct(lines)


def _paths_from(
    road: VectorMap, is_on: BoolArray, start: int, behind: float
) -> list[tuple[int, ...]]:
    """Sequences of lanes of the route from one lane on, depth first in the order of the map."""
    paths: list[tuple[int, ...]] = []
    stack: list[tuple[tuple[int, ...], float]] = [((start,), road.baselines.length(start) - behind)]
    while stack:
        path, length = stack.pop()
        following = [lane for lane in road.outgoing.at(path[-1]).tolist() if is_on[lane]]
        if not following or len(path) == MAX_LANES or length > LINE_LENGTH:
            paths.append(path)
            continue
        stack += [
            ((*path, lane), length + road.baselines.length(lane)) for lane in reversed(following)
        ]
    return paths


def _distinct(lines: list[FloatArray]) -> list[FloatArray]:
    """The lines without those that run where an earlier one does."""
    distinct = []
    for index, line in enumerate(lines):
        for earlier in lines[:index]:  # nuPlan rule 247: a removed line still removes others
            count = min(len(earlier), len(line))
            apart = np.abs(earlier[:count, :2] - line[:count, :2])
            if (apart[:, 0] + apart[:, 1] < SAME_LINE).all():
                break
        else:
            distinct.append(line)
    return distinct


def _cut(path: LanePath, x: float, y: float) -> tuple[FloatArray, float]:
    """The next 120 m of a path from (x, y) on: poses (K, 3), and their length [m]."""
    here = path.project(x, y)
    first, last = float(path.driven.progress[0]), path.end
    low, high = (min(max(at, first), last) for at in (here, here + LINE_LENGTH))
    line = sub_path(path.driven, low, high)
    # nuPlan rule 250: the ends are wrapped, vertices keep the angle between them
    turned = np.abs(line[:, 2]) > np.pi
    turned[[0, -1]] = True
    line[turned, 2] = wrap_angles(line[turned, 2])
    return line, high - low


class LineFeatures(NamedTuple):
    """Reference lines as the network reads them, in the ego frame. R lines of 120 points."""

    position: np.ndarray  # (R, 120, 2) float32 [m]
    vector: np.ndarray  # (R, 120, 2) float32, to the next point [m]
    orientation: np.ndarray  # (R, 120) float32 [rad]
    valid_mask: BoolArray  # (R, 120)


def line_features(lines: Sequence[FloatArray], rear: FloatArray) -> LineFeatures:
    """Every fourth point of each line, in the frame of the rear axle (3,)."""
    points = np.zeros((len(lines), NUM_POINTS, 5))
    valid = np.zeros((len(lines), NUM_POINTS), np.bool_)
    for row, line in enumerate(lines):
        sampled = line[::STRIDE][: NUM_POINTS + 1]
        count = len(sampled) - 1
        points[row, :count, :2] = sampled[:-1, :2]
        points[row, :count, 2:4] = np.diff(sampled[:, :2], axis=0)
        points[row, :count, 4] = sampled[:-1, 2]
        valid[row, :count] = True
    cos, sin = np.cos(rear[2]), np.sin(rear[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    # nuPlan rule 248: padding is moved as well
    position, vector = (points[..., :2] - rear[:2]) @ turn, points[..., 2:4] @ turn
    orientation = points[..., 4] - rear[2]
    single = np.float32
    return LineFeatures(
        position.astype(single), vector.astype(single), orientation.astype(single), valid
    )
