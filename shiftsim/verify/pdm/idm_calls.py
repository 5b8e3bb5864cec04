"""Recorded single calls of nuPlan's IDM planner, repeated from the logs (`idm_calls.json`)."""

from functools import partial

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.planners.idm import STEP_US, STEPS, Idm
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.verify.files import TOLERANCE, Source
from shiftsim.verify.pdm.routes import verify_cases
from shiftsim.verify.worlds import object_columns
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, LightStatus


def _compare(call: Source, where: str, scenario: Scenario) -> None:
    first, iteration = call["first_call_iteration"], call["iteration"]
    if not all(0 <= index < scenario.num_iterations for index in (first, iteration)):
        raise DataError("no such iteration")
    planner, road = Idm(), scenario.map
    planner.reset(scene_info(scenario))
    planner.plan(observe_log(scenario, first, samples=1))
    seen = observe_log(scenario, iteration, samples=1)
    centers, speeds = planner.roll_out(seen)
    # what the call recorded of its inputs is also in the log
    tracks, lights = seen.tracks, seen.lights.listed(0)
    inputs = {
        "route": list(scenario.route),
        "time_us": seen.time_us,
        "ego_center": seen.ego.center,
        "ego_rear_velocity": seen.ego.values[[VX, VY]],
        "red_connectors": sorted(name for name, status in lights if status == LightStatus.RED),
    }
    call.match(where, inputs, TOLERANCE, quantity="IDM input")
    index = sorted(np.flatnonzero(tracks.valid[0]).tolist(), key=tracks.tokens.__getitem__)
    columns = object_columns(tracks, np.zeros(len(index), np.int64), np.array(index, np.int64))
    columns["token"], columns["type"] = columns["track_token"], map(str.lower, columns["type"])
    things = sorted(call.each("objects"), key=lambda thing: str(thing["token"]))
    for name in ("token", "type", "x", "y", "heading", "length", "width", "vx", "vy"):
        theirs, mine = [thing[name] for thing in things], list(columns[name])
        call.report.compare(f"IDM input {name}", where, mine, theirs, atol=TOLERANCE)
    route, path = planner.route_plan, planner.path
    assert route is not None
    assert path is not None
    heading = wrap_angle(float(path.driven.heading[-1]))
    ours = {
        "edges": [road.edges.ids[edge] for edge in route.path],
        "path_found": route.found,
        "target_velocity": planner.target_velocity,
        "path_points": len(path.driven.progress),
        "path_end": [path.end, *path.driven.xy[-1].tolist(), heading],
        "polyline_length": float(path.line_arc[-1]),
    }
    call.match(where, ours, TOLERANCE, quantity="IDM")
    times = seen.time_us + STEP_US * np.arange(STEPS + 1)
    rows = np.array(call["trajectory"], np.float64)
    call.report.compare("IDM plan time", where, times, rows[:, 0].astype(np.int64))
    plan = np.column_stack([centers, speeds])
    call.report.compare("IDM plan", where, plan, rows[:, 1:], atol=TOLERANCE)


verify_idm_calls = partial(verify_cases, _compare)
