"""Route correction, current lane and centerline of PDM-Closed (`routes.json`)."""

from functools import partial

import numpy as np

from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm import route as routes
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.proposals.areas import select_areas
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.routes.graph import centerline
from shiftsim.verify.files import Source
from shiftsim.verify.tables import read_tables, verify_cases
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, PACIFICA, center_poses

TABLES = read_tables(__file__)


def _compare(case: Source, where: str, scenario: Scenario) -> None:
    road, ego = scenario.map, np.zeros(NUM_STATE)
    case.note("label", "route_name", "pose_name")
    ego[:3] = case["rear_axle"]
    route = routes.start_route(road, tuple(case["route"]), ego, scenario.token)
    center = center_poses(ego[None, :3])[0]
    selected = select_areas(road, center[0], center[1], DEFAULT.map_radius)
    areas, errors = routes.lanes_at(road, route, selected, ego)
    ordered = routes.in_index_order(route, selected, areas)
    lane = routes.current_lane(road, route, selected, ego, center, ego_box(PACIFICA))
    line = centerline(road, routes.follow_route(road, route.corrected, lane).path)
    found = {
        "under": route.areas.lane[ordered],
        "errors": [errors[areas.index(a)] for a in ordered],
    }
    found |= {"lane": lane, "line": line, "path": make_path(line)}
    TABLES["routes"].match(case, where, road=road, route=route, **found)


verify_routes = partial(verify_cases, _compare)
