"""Route correction, current lane and centerline of PDM-Closed (`routes.json`)."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import ShiftsimError
from shiftsim.geometry.paths import make_path
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.route import (
    current_lane,
    follow_route,
    in_index_order,
    lanes_at,
    start_route,
)
from shiftsim.planners.proposals.areas import select_areas
from shiftsim.planners.proposals.contacts import ego_box
from shiftsim.planners.routes.paths import centerline
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, PACIFICA, center_poses

TOLERANCE = 1e-9
_INPUTS = {"scene", "route", "rear_axle"}
_LABELS = {"route_name", "pose_name"}
_OUTPUTS = (
    *("start_block", "start_candidates", "corrected", "route_lanes", "intersecting_lanes"),
    *("heading_errors", "current_lane", "n_centerline", "centerline_first", "centerline_last"),
    "centerline_length",
)


def verify_routes(path: Path, report: Report, scenes: dict[str, Scenario]) -> None:
    """Correct every route again and compare.

    Args:
        path: The file.
        report: Receives the comparisons.
        scenes: The scenarios by scene name; cases of other scenes are named as not covered.
    """
    report.note("routes.json: route_name, pose_name (labels)")
    for number, case in enumerate(read_json(path)):
        where = f"routes.json {number} ({case.get('scene')} {case.get('route_name')})"
        for extra in sorted(set(case) - _INPUTS - _LABELS - set(_OUTPUTS) - {"error"}):
            report.skip(f"routes.json: field {extra!r}")
        if case["scene"] not in scenes:
            report.skip(f"routes of scene {case['scene']}, which is not at hand")
            continue
        if "error" in case:
            report.note(f"{where}: the official code fails on it")
            continue
        try:
            ours = _solve(case, scenes[case["scene"]])
        except ShiftsimError as error:
            report.fail("PDM route", where, str(error))
            continue
        for name in _OUTPUTS:
            if name not in case:
                report.fail(f"PDM {name}", where, f"no field {name!r}")
                continue
            report.compare(f"PDM {name}", where, ours[name], case[name], atol=TOLERANCE)


def _solve(case: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    road = scenario.map
    ego = np.zeros(NUM_STATE)
    ego[:3] = case["rear_axle"]
    route = start_route(road, tuple(case["route"]), ego, scenario.token)
    center = center_poses(ego[None, :3])[0]
    selected = select_areas(road, center[0], center[1], DEFAULT.map_radius)
    under, errors = lanes_at(road, route, selected, ego)
    ordered = in_index_order(route, selected, under)
    lane = current_lane(road, route, selected, ego, center, ego_box(PACIFICA))
    line = centerline(road, follow_route(road, route.corrected, lane).path)
    edge_ids, block_ids = road.edges.ids, road.blocks.ids
    return {
        "start_block": block_ids[route.start.block],
        "start_candidates": [block_ids[block] for block in route.start.others],
        "corrected": [block_ids[block] for block in route.corrected],
        "route_lanes": [edge_ids[edge] for edge in route.lanes.tolist()],
        "intersecting_lanes": [edge_ids[route.areas.edge[area]] for area in ordered],
        "heading_errors": [errors[under.index(area)] for area in ordered],
        "current_lane": edge_ids[lane],
        "n_centerline": len(line),
        "centerline_first": line[0],
        "centerline_last": line[-1],
        "centerline_length": float(make_path(line).progress[-1]),
    }
