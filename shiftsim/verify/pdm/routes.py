"""Route correction, current lane and centerline of PDM-Closed (`routes.json`)."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm import route as routes
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.proposals.areas import select_areas
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.routes.graph import centerline
from shiftsim.verify.files import TOLERANCE, Source, read_json
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, PACIFICA, center_poses


def verify_cases(
    compare: Callable[[Source, str, Scenario], None],
    path: Path,
    report: Report,
    scenes: Mapping[str, Any],
) -> None:
    """`compare` every entry of a list, in its scene; those of unknown scenes are not covered."""
    for number, content in enumerate(read_json(path)):
        case = Source(path.name, "field", content, report)
        if case["scene"] not in scenes:
            report.skip(f"{path.name}: scene {case['scene']}, which is not at hand")
            continue
        where = f"{path.name} {number} ({case['scene']})"
        with report.attempt(path.stem, where):
            compare(case, where, scenes[case["scene"]])
        case.finish()


def _compare(case: Source, where: str, scenario: Scenario) -> None:
    road, ego = scenario.map, np.zeros(NUM_STATE)
    case.note("label", "route_name", "pose_name")
    ego[:3] = case["rear_axle"]
    route = routes.start_route(road, tuple(case["route"]), ego, scenario.token)
    center = center_poses(ego[None, :3])[0]
    selected = select_areas(road, center[0], center[1], DEFAULT.map_radius)
    under, errors = routes.lanes_at(road, route, selected, ego)
    ordered = routes.in_index_order(route, selected, under)
    lane = routes.current_lane(road, route, selected, ego, center, ego_box(PACIFICA))
    line = centerline(road, routes.follow_route(road, route.corrected, lane).path)
    edge_ids, block_ids = road.edges.ids, road.blocks.ids
    ours = {
        "start_block": block_ids[route.start.block],
        "start_candidates": [block_ids[block] for block in route.start.others],
        "corrected": [block_ids[block] for block in route.corrected],
        "route_lanes": [edge_ids[edge] for edge in route.lanes.tolist()],
        "intersecting_lanes": [edge_ids[route.areas.lane[area]] for area in ordered],
        "heading_errors": [errors[under.index(area)] for area in ordered],
        "current_lane": edge_ids[lane],
        "n_centerline": len(line),
        "centerline_first": line[0],
        "centerline_last": line[-1],
        "centerline_length": float(make_path(line).progress[-1]),
    }
    case.match(where, ours, TOLERANCE, quantity="PDM")


verify_routes = partial(verify_cases, _compare)
