"""The lanes PDM-Closed follows: corrected route, current lane, centerline."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.errors import PlannerError
from shiftsim.geometry.rings import EXTERIOR, locate_in_polygon
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.planners.proposals.areas import Areas, index_ranks, make_areas
from shiftsim.planners.proposals.places import EgoBox
from shiftsim.planners.routes.correction import Start, correct_route, find_start, known_blocks
from shiftsim.planners.routes.graph import HINT, Search, deviation, lane_at, search_cheapest
from shiftsim.world.layers import square_around
from shiftsim.world.map import VectorMap
from shiftsim.world.state import HEADING, X, Y

SEARCH_DEPTH = 30  # blocks of the route the centerline covers
START_HALF_WIDTH = 1.0  # m, of the square around the rear axle that is searched for the start


class Route(NamedTuple):
    """What PDM-Closed decides once per scenario."""

    start: Start  # where it begins
    corrected: list[int]  # blocks of the corrected route
    lanes: IntArray  # lanes and connectors of these blocks, in order
    areas: Areas  # the drivable areas of the map, those of the route marked


def start_route(road: VectorMap, ids: Sequence[str], ego: FloatArray, token: str) -> Route:
    """Correct a route, given by roadblock ids, at the start of a scenario, from an ego state (11,).

    Raises PlannerError: the route is empty, unknown to the map, or has no lanes.
    """
    blocks = known_blocks(road, ids, token, "pdm-closed")
    square = square_around(float(ego[0]), float(ego[1]), START_HALF_WIDTH)
    start = find_start(road, blocks, ego[:3], square)
    corrected = list(dict.fromkeys(correct_route(road, blocks, start)))
    lanes = road.lanes_of(corrected)
    if not lanes:
        raise PlannerError(f"pdm-closed: the route of scenario {token!r} has no lanes", hint=HINT)
    return Route(start, corrected, np.array(lanes), make_areas(road, lanes))


def current_lane(
    road: VectorMap,
    route: Route,
    selected: IntArray,  # drivable areas of this step
    ego: FloatArray,  # (11,) ego state
    center: FloatArray,  # (3,) its centre x [m], y [m], heading [rad]
    size: EgoBox,
) -> int:
    """The lane of the route that the ego is on."""
    areas, errors = lanes_at(road, route, selected, ego)
    if not areas:
        return lane_at(road, route.lanes, center, size.length, size.width)
    least = min(errors)
    tied = [area for area, error in zip(areas, errors, strict=True) if error == least]
    if len(tied) > 1:
        tied = in_index_order(route, selected, tied)
    return int(route.areas.lane[tied[0]])


def lanes_at(
    road: VectorMap, route: Route, selected: IntArray, ego: FloatArray
) -> tuple[list[int], list[float]]:
    """Areas of the route under the rear axle, and their heading errors [rad]."""
    x, y, heading = float(ego[X]), float(ego[Y]), float(ego[HEADING])
    areas, under = route.areas, selected[route.areas.on_route[selected]]
    shapes, bounds = areas.polygons, areas.polygons.bounds[under]
    under = under[(bounds[:, :2] <= (x, y)).all(axis=1) & (bounds[:, 2:] >= (x, y)).all(axis=1)]
    found = [
        area
        for area in under.tolist()
        if locate_in_polygon(
            shapes.xy, shapes.ring_ptr, *shapes.poly_ptr[area : area + 2].tolist(), x, y
        )
        != EXTERIOR
    ]
    lanes = areas.lane[found].tolist()
    return found, [deviation(road.baselines, lane, 1, x, y, heading)[1] for lane in lanes]


def in_index_order(route: Route, selected: IntArray, chosen: list[int]) -> list[int]:
    """Some of the selected areas, in the order in which nuPlan's spatial index yields them."""
    ranks = index_ranks(route.areas.polygons.bounds[selected])
    rank_of = dict(zip(selected.tolist(), ranks.tolist(), strict=True))
    return sorted(chosen, key=rank_of.__getitem__)


def follow_route(road: VectorMap, route: list[int], current: int) -> Search:
    """Lanes from the current one to the end of the route, or of its next 30 blocks."""
    block = int(road.block_of[current])
    # nuPlan rule 197: a lane whose block is not on the route starts at its first block
    start = route.index(block) if block in route else 0
    goal = route[start : start + SEARCH_DEPTH][-1]
    allowed = set(road.lanes_of(route))
    return search_cheapest(
        current,
        lambda lane: [after for after in road.outgoing.at(lane).tolist() if after in allowed],
        road.baselines.length,
        lambda lane: bool(road.block_of[lane] == goal),
    )


def offset_poses(poses: FloatArray, offset: float) -> FloatArray:
    """Poses (K, 3) moved sideways, to the left where `offset` is positive [m]."""
    out = poses.copy()
    out[:, 0] += offset * np.cos(poses[:, 2] + np.pi / 2.0)
    out[:, 1] += offset * np.sin(poses[:, 2] + np.pi / 2.0)
    return out
