"""The lanes that the IDM planner drives along."""

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import PlannerError
from shiftsim.planners.routes.lanes import HINT, lane_at, lanes_of
from shiftsim.planners.routes.paths import LanePath, lane_path
from shiftsim.planners.routes.search import Search, search_levels
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import VehicleParameters


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
    path = lane_path(road, lanes)
    if len(path.driven.progress) < 2:
        raise PlannerError(
            f"idm: the baselines of {[road.edges.ids[e] for e in lanes]} have too few vertices",
            hint="a path needs at least three different vertices",
        )
    return path
