"""The path of the IDM planner: lanes along the route, and poses by progress (idm-planner.md §3)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import FloatArray, kernel
from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.geometry.polylines import project_on_polyline
from shiftsim.world.layers import contains
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import VehicleParameters

SAME_POINT = 1e-8  # m, vertices closer than this are one


class Path(NamedTuple):
    """Poses by progress, and the polyline the ego is projected on. K and V vertices.

    Attributes:
        line: (V, 2) all vertices of the lanes' baselines [m].
        line_arc: (V,) arc length at each of them [m].
        xy: (K, 2) vertices of the interpolated path [m].
        heading: (K,) heading at each of them, unwrapped [rad].
        progress: (K,) arc length at each of them [m].
    """

    line: FloatArray
    line_arc: FloatArray
    xy: FloatArray
    heading: FloatArray
    progress: FloatArray

    @property
    def end(self) -> float:
        """Progress at the last vertex [m]."""
        return float(self.progress[-1])

    def project(self, x: float, y: float) -> float:
        """Progress of the point of the path nearest to (x, y) [m]."""
        return float(project_on_polyline(self.line, self.line_arc, 0, len(self.line), x, y))


@dataclass(frozen=True, slots=True)
class RoutePlan:
    """Lanes and connectors to drive.

    Attributes:
        edges: Their indices in order.
        found: Whether they lead to the last block of the route.
    """

    edges: list[int]
    found: bool


def route_blocks(road: VectorMap, route: tuple[str, ...], token: str) -> list[int]:
    """Block indices of a route, NONE for ids the map does not have.

    Raises:
        PlannerError: The route is too short, or a block that must be known is not.
    """
    if len(route) < 2:
        raise PlannerError(
            f"idm: the route of scenario {token!r} has {len(route)} roadblocks, at least 2 "
            "are needed",
            hint="correct the route of the scenario, or leave it out",
        )
    blocks = [road.blocks.index.get(name, NONE) for name in route]
    # nuPlan: an unknown id is passed over, except where the planner needs the object (§2)
    for position in (0, 1, len(blocks) - 1):
        if blocks[position] == NONE:
            raise PlannerError(
                f"idm: map {road.name!r} has no roadblock {route[position]!r}, number {position} "
                f"of the route of scenario {token!r}",
                hint="the first two and the last roadblock of a route must exist",
            )
    return blocks


def candidate_edges(road: VectorMap, blocks: list[int]) -> set[int]:
    """Lanes and connectors of the blocks of a route."""
    return {e for block in blocks if block != NONE for e in road.block_edges.at(block).tolist()}


def plan_route(
    road: VectorMap, blocks: list[int], center: FloatArray, vehicle: VehicleParameters
) -> RoutePlan:
    """Lanes from the ego to the last block of the route.

    Args:
        road: The map.
        blocks: Block indices of the route.
        center: (3,) ego box centre x [m], y [m], heading [rad].
        vehicle: Dimensions of the ego.

    Raises:
        PlannerError: The first two blocks of the route have no lanes.
    """
    start = _start_edge(road, blocks, center, vehicle)
    skipped = 1 if int(road.block_of[start]) == blocks[1] else 0
    return _search(road, start, blocks[-1], len(blocks) - skipped, candidate_edges(road, blocks))


def _start_edge(
    road: VectorMap, blocks: list[int], center: FloatArray, vehicle: VehicleParameters
) -> int:
    edges = [e for block in blocks[:2] for e in road.block_edges.at(block).tolist()]
    if not edges:
        raise PlannerError(
            f"idm: map {road.name!r} has no lanes in the first two roadblocks of the route",
            hint="correct the route of the scenario, or leave it out",
        )
    for edge in edges:
        if contains(road.edges.polygons, edge, center[0], center[1]):
            return edge
    size = np.array([vehicle.length, vehicle.width])
    footprint = shapely.Polygon(boxes_to_corners(center, size))
    distances = [float(shapely.distance(road.edges.shape(e), footprint)) for e in edges]
    return edges[int(np.argmin(distances))]  # the first one on ties


def _search(
    road: VectorMap, start: int, goal_block: int, goal_depth: int, allowed: set[int]
) -> RoutePlan:
    """Breadth-first search by levels; the goal must lie at exactly `goal_depth` (§3, quirk I6).

    nuPlan keeps no visited set: an edge may be queued many times on one level, its parent is the
    last one that queued it, the goal is the first one queued, and without a goal the path leads to
    the edge queued last. A level therefore needs each edge twice at most, ordered by its first and
    by its last appearance.
    """
    firsts, lasts = [start], [start]
    parents: list[dict[int, int]] = [{}]  # per depth
    end = start
    for depth in range(1, goal_depth + 1):
        if depth == goal_depth:
            goals = [edge for edge in firsts if int(road.block_of[edge]) == goal_block]
            if goals:
                return RoutePlan(_trace(parents, goals[0]), True)
        queued = [
            (after, edge)
            for edge in lasts
            for after in road.outgoing.at(edge).tolist()
            if after in allowed
        ]
        if not queued:
            break
        end = queued[-1][0]
        parents.append(dict(queued))
        firsts = list(
            dict.fromkeys(
                after
                for edge in firsts
                for after in road.outgoing.at(edge).tolist()
                if after in allowed
            )
        )
        lasts = list(dict.fromkeys(after for after, _ in reversed(queued)))[::-1]
    return RoutePlan(_trace(parents, end), False)


def _trace(parents: list[dict[int, int]], edge: int) -> list[int]:
    """Edges from the start to `edge`, which lies on the last level."""
    edges = [edge]
    for level in reversed(parents[1:]):
        edges.append(level[edges[-1]])
    return edges[::-1]


def build_path(road: VectorMap, edges: list[int]) -> Path:
    """The path along the baselines of some edges.

    Raises:
        PlannerError: Fewer than two vertices are left.
    """
    lines = [road.baselines.at(edge) for edge in edges]
    line = np.concatenate(lines)
    heading = np.concatenate([_headings(xy) for xy in lines])
    steps = np.hypot(*np.diff(line, axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    # nuPlan: of two equal vertices the second stays, and the last of all is always lost (I1)
    kept = np.flatnonzero(np.abs(steps) > SAME_POINT)
    if len(kept) < 2:
        raise PlannerError(
            f"idm: the baselines of {[road.edges.ids[e] for e in edges]} have too few vertices",
            hint="a path needs at least three different vertices",
        )
    return Path(line, arc, line[kept], np.unwrap(heading[kept]), arc[kept])


def _headings(xy: FloatArray) -> FloatArray:
    step = np.diff(xy, axis=0)
    angles = np.arctan2(step[:, 1], step[:, 0])
    return np.append(angles, angles[-1])


@kernel
def interpolate(path: Path, progress: float) -> tuple[float, float, float]:
    """Pose x [m], y [m], heading [rad] at a progress, clamped to the path."""
    p = min(max(progress, path.progress[0]), path.progress[-1])
    upper = int(np.searchsorted(path.progress, p))
    upper = min(max(upper, 1), len(path.progress) - 1)
    lower = upper - 1
    offset = p - path.progress[lower]
    span = path.progress[upper] - path.progress[lower]
    x = (path.xy[upper, 0] - path.xy[lower, 0]) / span * offset + path.xy[lower, 0]
    y = (path.xy[upper, 1] - path.xy[lower, 1]) / span * offset + path.xy[lower, 1]
    turn = (path.heading[upper] - path.heading[lower]) / span * offset + path.heading[lower]
    return x, y, wrap_angle(turn)
