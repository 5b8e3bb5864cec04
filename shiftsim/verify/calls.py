"""Recorded calls that are made again from the log and map of a scene: routes, plans of IDM."""

from functools import partial

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners, wrap_angle
from shiftsim.geometry.polylines import make_path
from shiftsim.planners.idm import STEP_US, STEPS, Idm
from shiftsim.planners.pdm import route as routes
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.proposals.areas import select_areas
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.routes import correction
from shiftsim.planners.routes.graph import centerline
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.verify.files import Source
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import read_tables, verify_cases
from shiftsim.verify.worlds import object_columns
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, PACIFICA, LightStatus, center_poses

TABLES = read_tables(__file__)
SQUARE = 1.0  # m, half width


def verify_corrections(file: Source, scenes: Scenes) -> None:
    """Correct every route of a file as the learned planners do."""
    scenario = scenes[str(file["scene"])]
    TABLES["scene"].match(file, file.name, scenario=scenario)
    for number, case in enumerate(file.each("cases")):
        at = f"{file.name} {number} ({case['case']})"
        with file.report.attempt("corrected route", at):
            _compare_correction(case, at, scenario)


def _compare_correction(case: Source, where: str, scenario: Scenario) -> None:
    road, rear_axle = scenario.map, np.array(case["rear_axle"], np.float64).reshape(3)
    if case["case"] == "as_logged":
        TABLES["logged"].match(case, where, scenario=scenario)
    blocks = correction.known_blocks(road, case["route"], "of the file", "route correction")
    size = np.array([PACIFICA.length, PACIFICA.width])
    footprint = boxes_to_corners(center_poses(rear_axle), size)
    start = correction.find_start(road, blocks, rear_axle, footprint)
    ours = {
        "square": correction.RouteCorrector(road, blocks, SQUARE).at(rear_axle),
        "footprint": correction.correct_route(road, blocks, start),
    }
    TABLES["corrections"].match(case, where, road=road, **ours)


def _compare_route(case: Source, where: str, scenario: Scenario) -> None:
    """Corrected route, current lane and centerline of PDM-Closed."""
    road, ego = scenario.map, np.zeros(NUM_STATE)
    case.note("label", "route_name", "pose_name")
    ego[:3] = case["rear_axle"]
    route = routes.start_route(road, tuple(case["route"]), ego, scenario.token)
    center = center_poses(ego[:3])
    selected = select_areas(road, center[0], center[1], DEFAULT.map_radius)
    areas, errors = routes.lanes_at(road, route, selected, ego)
    ordered = routes.in_index_order(route, selected, areas)
    lane = routes.current_lane(road, route, selected, ego, center, ego_box(PACIFICA))
    line = centerline(road, routes.follow_route(road, route.corrected, lane).path)
    ours = {
        "under": route.areas.lane[ordered],
        "errors": [errors[areas.index(area)] for area in ordered],
    }
    ours |= {"lane": lane, "line": line, "path": make_path(line)}
    TABLES["routes"].match(case, where, road=road, route=route, **ours)


def _compare_idm(call: Source, where: str, scenario: Scenario) -> None:
    """Inputs and plan of nuPlan's IDM planner, which was called once before."""
    first, iteration = call["first_call_iteration"], call["iteration"]
    if not all(0 <= index < scenario.num_iterations for index in (first, iteration)):
        raise DataError("no such iteration")
    planner, road = Idm(), scenario.map
    planner.reset(scene_info(scenario))
    planner.plan(observe_log(scenario, first, samples=1))
    seen = observe_log(scenario, iteration, samples=1)
    centers, speeds = planner.roll_out(seen)
    reds = [name for name, status in seen.lights.listed(0) if status == LightStatus.RED]
    TABLES["inputs"].match(call, where, scenario=scenario, seen=seen, reds=sorted(reds))
    tracks = seen.tracks
    index = sorted(np.flatnonzero(tracks.valid[0]).tolist(), key=tracks.tokens.__getitem__)
    columns = object_columns(tracks, np.zeros(len(index), np.int64), np.array(index, np.int64))
    kinds = [kind.lower() for kind in columns["type"]]
    things = sorted(call.each("objects"), key=lambda thing: str(thing["token"]))
    listed = {name: [thing[name] for thing in things] for name in TABLES["objects"].rows}
    theirs = Source(call.name, "field", listed, call.report)
    TABLES["objects"].match(theirs, where, columns=columns, kinds=kinds)
    path, times = planner.path, seen.time_us + STEP_US * np.arange(STEPS + 1)
    assert path is not None
    ours = {
        "end": [path.end, *path.driven.xy[-1], wrap_angle(float(path.driven.heading[-1]))],
        "states": np.column_stack([times, centers, speeds]),
    }
    TABLES["plan"].match(call, where, road=road, planner=planner, **ours)


verify_routes = partial(verify_cases, _compare_route)
verify_idm_calls = partial(verify_cases, _compare_idm)
FILES = {"route_correction_*.json": verify_corrections}
