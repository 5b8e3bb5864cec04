"""Blocks and lanes of a route: searches, which lane a pose is on, the path along the lanes."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import box_corners, wrap_angle
from shiftsim.geometry.polylines import (
    Path,
    arc_lengths,
    make_path,
    pose_at,
    project_on_polyline,
    vertex_heading,
    vertex_headings,
)
from shiftsim.geometry.rings import ring_distance
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.layers import Polylines, contains
from shiftsim.world.map import NONE, VectorMap

HINT = "correct the route of the scenario, or leave it out"  # of errors about routes
SAME_POINT = 1e-8  # m, vertices closer than this are one
START_COST = 1.0  # nuPlan rule 184: the first lane costs 1, whatever its length
Neighbours = Callable[[int], Iterable[int]]


class Search(NamedTuple):
    """Result of a search."""

    # from the start to the goal; without one, to the place that comes nearest to it
    path: list[int]
    found: bool  # whether a goal was reached


def search_levels(
    neighbours: Neighbours, start: int, goals: set[int], max_depth: int, *, only_last: bool = False
) -> Search:
    """Breadth-first search by levels, the start being level 1 and `max_depth` the last.

    With `only_last` goals count on the last level only.
    """
    # nuPlan rule 150: no set of visited places is kept, so a place may be queued many times on one
    # level; its parent is the last one that queued it, the goal is the first one queued, and
    # without a goal the path leads to the place queued last. A level therefore holds each place
    # once, ordered by its first and by its last appearance.
    firsts, lasts = [start], [start]
    parents: list[dict[int, int]] = [{}]  # per level
    end = start
    for depth in range(1, max_depth + 1):
        if depth == max_depth or not only_last:
            reached = next((place for place in firsts if place in goals), NONE)
            if reached != NONE:
                return Search(_trace(parents, reached), True)
        queued = [(int(after), place) for place in lasts for after in neighbours(place)]
        if not queued:
            break
        end = queued[-1][0]
        parents.append(dict(queued))
        firsts = list(dict.fromkeys(int(after) for place in firsts for after in neighbours(place)))
        lasts = list(dict.fromkeys(after for after, _ in reversed(queued)))[::-1]
    return Search(_trace(parents, end), False)


def _trace(parents: list[dict[int, int]], place: int) -> list[int]:
    """Places from the start to `place`, which lies on the last level."""
    path = [place]
    for level in reversed(parents[1:]):
        path.append(level[path[-1]])
    return path[::-1]


def search_cheapest(
    start: int,
    neighbours: Neighbours,
    length: Callable[[int], float],
    is_goal: Callable[[int], bool],
) -> Search:
    """Dijkstra's search with an open list; the first of equal costs is expanded first."""
    opened, cost, parent = [start], {start: START_COST}, {start: NONE}
    depth = {start: 1}
    expanded: list[int] = []
    while opened:
        lane = min(opened, key=cost.__getitem__)
        opened.remove(lane)
        if is_goal(lane):
            return Search(_ancestry(parent, lane), True)
        expanded.append(lane)
        for after in neighbours(lane):
            total = cost[lane] + length(after)
            if after in cost and (after not in opened or total >= cost[after]):
                continue
            if after not in opened:
                opened.append(after)
            cost[after], parent[after], depth[after] = total, lane, depth[lane] + 1
    deepest = max(depth[lane] for lane in expanded)
    end = min((lane for lane in expanded if depth[lane] == deepest), key=cost.__getitem__)
    return Search(_ancestry(parent, end), False)


def _ancestry(parent: dict[int, int], lane: int) -> list[int]:
    path = [lane]
    while parent[path[-1]] != NONE:
        path.append(parent[path[-1]])
    return path[::-1]


@kernel
def deviation(
    baselines: Polylines, lane: int, stride: int, x: float, y: float, heading: float
) -> tuple[float, float]:
    """Distance [m] to the nearest of every `stride`-th vertex of a baseline, and heading error."""
    # nuPlan rule 180: to vertices, not to the line between them
    start, stop = baselines.ptr[lane], baselines.ptr[lane + 1]
    least, nearest = np.inf, start  # the first one on ties
    for vertex in range(start, stop, stride):
        distance = np.hypot(baselines.xy[vertex, 0] - x, baselines.xy[vertex, 1] - y)
        if distance < least:
            least, nearest = distance, vertex
    return least, abs(wrap_angle(vertex_heading(baselines.xy, nearest, stop) - heading))


def lane_at(
    road: VectorMap, lanes: IntArray, center: FloatArray, length: float, width: float
) -> int:
    """The first lane that holds the centre (3,) of a box, else the one nearest to the box."""
    x, y, heading = center
    bounds = road.edges.polygons.bounds[lanes]
    away_x = np.maximum(np.maximum(bounds[:, 0] - x, x - bounds[:, 2]), 0.0)
    away_y = np.maximum(np.maximum(bounds[:, 1] - y, y - bounds[:, 3]), 0.0)
    away = np.hypot(away_x, away_y)
    for lane in lanes[away == 0.0].tolist():
        if contains(road.edges.polygons, lane, x, y):
            return int(lane)
    footprint = np.empty((4, 2))
    box_corners(x, y, heading, length, width, footprint)
    best = (np.inf, 0)  # the first one on ties
    for place in np.argsort(away).tolist():
        if away[place] > best[0] + 0.51 * np.hypot(length, width):
            break
        ring = road.edges.rings(lanes[place])[0].copy()  # read-only ones would need a kernel more
        best = min(best, (float(ring_distance(footprint, ring)), place))
    return int(lanes[best[1]])


class LanePath(NamedTuple):
    """The path along some lanes."""

    # (V, 2) all vertices of the lanes' baselines, on which the ego is projected [m]
    line: FloatArray
    line_arc: FloatArray  # (V,) arc length at each of them [m]
    driven: Path  # what poses are read from: without repeated vertices

    @property
    def end(self) -> float:
        """Progress at the last vertex [m]."""
        return float(self.driven.progress[-1])

    def project(self, x: float, y: float) -> float:
        """Progress of the point of the path nearest to (x, y) [m]."""
        return float(project_on_polyline(self.line, self.line_arc, 0, len(self.line), x, y))


def centerline(road: VectorMap, lanes: Iterable[int]) -> FloatArray:
    """Poses (K, 3) along the baselines of lanes x [m], y [m], heading [rad]."""
    lines = [road.baselines.at(lane) for lane in lanes]
    return np.concatenate([np.column_stack([xy, vertex_headings(xy)]) for xy in lines])


def lane_path(road: VectorMap, lanes: Iterable[int]) -> LanePath:
    """The path along the baselines of some lanes."""
    poses = centerline(road, lanes)
    line = np.ascontiguousarray(poses[:, :2])
    arc = arc_lengths(line, np.array([0, len(line)]))
    # nuPlan rule 153: of two equal vertices the second stays, and the last of all is always lost
    distinct = np.flatnonzero(np.diff(arc) > SAME_POINT)
    return LanePath(line, arc, make_path(poses[distinct], arc[distinct]))


@kernel
def sub_path(path: Path, low: float, high: float) -> FloatArray:
    """Poses (K', 3) of a path between two progresses, the interpolated ends included.

    Headings are not wrapped. At the ends of the path its two first, or last, vertices are left.
    """
    # loops instead of slice assignments, which take numba seconds to compile
    count = len(path.progress)
    first = int(np.searchsorted(path.progress, low, side="right"))
    last = int(np.searchsorted(path.progress, high, side="left"))  # one past the last vertex
    margin = 1
    if first == count or last == 0:
        margin, first, last = 0, 0 if last == 0 else count - 2, 2 if last == 0 else count
    out = np.empty((max(last - first, 0) + 2 * margin, 3))
    for vertex in range(first, last):
        row = out[vertex - first + margin]
        row[0], row[1], row[2] = path.xy[vertex, 0], path.xy[vertex, 1], path.heading[vertex]
    if margin > 0:
        out[0, 0], out[0, 1], out[0, 2] = pose_at(path, low)
        end = len(out) - 1
        out[end, 0], out[end, 1], out[end, 2] = pose_at(path, high)
    return out
