"""The path of the IDM planner: lanes along the route, and poses by progress."""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, kernel
from shiftsim.errors import PlannerError
from shiftsim.geometry.paths import Path, make_path, pose_at
from shiftsim.geometry.polylines import arc_lengths, project_on_polyline, vertex_headings
from shiftsim.planners.routes.lanes import HINT, lane_at, lanes_of
from shiftsim.planners.routes.search import Search, search_levels
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import VehicleParameters

SAME_POINT = 1e-8  # m, vertices closer than this are one


class LanePath(NamedTuple):
    """The path along some lanes.

    Attributes:
        line: (V, 2) all vertices of the lanes' baselines, on which the ego is projected [m].
        line_arc: (V,) arc length at each of them [m].
        driven: What poses are read from: without repeated vertices.
    """

    line: FloatArray
    line_arc: FloatArray
    driven: Path

    @property
    def end(self) -> float:
        """Progress at the last vertex [m]."""
        return float(self.driven.progress[-1])

    def project(self, x: float, y: float) -> float:
        """Progress of the point of the path nearest to (x, y) [m]."""
        return float(project_on_polyline(self.line, self.line_arc, 0, len(self.line), x, y))


def route_blocks(road: VectorMap, route: tuple[str, ...], token: str) -> list[int]:
    """Block indices of a route, NONE for ids the map does not have.

    Raises:
        PlannerError: The route is too short, or a block that must be known is not.
    """
    if len(route) < 2:
        raise PlannerError(
            f"idm: the route of scenario {token!r} has {len(route)} roadblocks, at least 2 "
            "are needed",
            hint=HINT,
        )
    blocks = [road.blocks.index.get(name, NONE) for name in route]
    # nuPlan rule 151: an unknown id is passed over, except where the planner needs the object
    for position in (0, 1, len(blocks) - 1):
        if blocks[position] == NONE:
            raise PlannerError(
                f"idm: map {road.name!r} has no roadblock {route[position]!r}, number {position} "
                f"of the route of scenario {token!r}",
                hint="the first two and the last roadblock of a route must exist",
            )
    return blocks


def plan_route(
    road: VectorMap, blocks: list[int], center: FloatArray, vehicle: VehicleParameters
) -> Search:
    """Lanes from the ego to the last block of the route.

    Args:
        road: The map.
        blocks: Block indices of the route.
        center: (3,) ego box centre x [m], y [m], heading [rad].
        vehicle: Dimensions of the ego.

    Raises:
        PlannerError: The first two blocks of the route have no lanes.
    """
    lanes = lanes_of(road, blocks[:2])
    if not lanes:
        raise PlannerError(
            f"idm: map {road.name!r} has no lanes in the first two roadblocks of the route",
            hint=HINT,
        )
    start = lane_at(road, np.array(lanes), center, vehicle.length, vehicle.width)
    skipped = 1 if int(road.block_of[start]) == blocks[1] else 0
    allowed = set(lanes_of(road, blocks))
    # nuPlan rule 152: the goal must lie exactly as deep as the route is long
    return search_levels(
        lambda lane: [after for after in road.outgoing.at(lane).tolist() if after in allowed],
        start,
        set(lanes_of(road, blocks[-1:])),
        len(blocks) - skipped,
        only_last=True,
    )


def build_path(road: VectorMap, lanes: list[int]) -> LanePath:
    """The path along the baselines of some lanes.

    Raises:
        PlannerError: Fewer than two vertices are left.
    """
    lines = [road.baselines.at(lane) for lane in lanes]
    line = np.concatenate(lines)
    arc = arc_lengths(line, np.array([0, len(line)]))
    poses = np.column_stack([line, np.concatenate([vertex_headings(xy) for xy in lines])])
    # nuPlan rule 153: of two equal vertices the second stays, and the last of all is always lost
    kept = np.flatnonzero(np.abs(np.diff(arc)) > SAME_POINT)
    if len(kept) < 2:
        raise PlannerError(
            f"idm: the baselines of {[road.edges.ids[e] for e in lanes]} have too few vertices",
            hint="a path needs at least three different vertices",
        )
    return LanePath(line, arc, make_path(poses[kept], arc[kept]))


@kernel
def sub_path(path: Path, low: float, high: float) -> FloatArray:
    """(K', 2) points of the path between two progresses, the interpolated ends included [m]."""
    # loops instead of slice assignments, which take numba seconds to compile
    count = len(path.progress)
    first = int(np.searchsorted(path.progress, low, side="right"))
    last = int(np.searchsorted(path.progress, high, side="left"))  # one past the last vertex
    if first == count or last == 0:
        out = np.empty((2, 2))
        for row in range(2):
            vertex = row if last == 0 else count - 2 + row
            out[row, 0], out[row, 1] = path.xy[vertex, 0], path.xy[vertex, 1]
        return out
    inner = max(last - first, 0)
    out = np.empty((inner + 2, 2))
    out[0, 0], out[0, 1], _ = pose_at(path, low)
    for row in range(inner):
        out[row + 1, 0], out[row + 1, 1] = path.xy[first + row, 0], path.xy[first + row, 1]
    out[inner + 1, 0], out[inner + 1, 1], _ = pose_at(path, high)
    return out
