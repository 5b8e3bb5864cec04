"""Recorded single calls of nuPlan's IDM planner (`idm_calls.json`)."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.planners.idm import STEP_US, STEPS, Idm
from shiftsim.sim.planner import Observation, observe_log, scene_info
from shiftsim.verify.files import TOLERANCE, Source, read_json
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, AgentKind, LightStatus


def verify_idm_calls(path: Path, report: Report, scenes: Mapping[str, Scenario]) -> None:
    """Repeat every recorded call from the scene's log; those of unknown scenes are not covered."""
    planners: dict[tuple[str, int], Idm] = {}
    for content in read_json(path):
        call = Source("idm_calls.json", "field", content, report)
        key, iteration = (call["scene"], call["first_call_iteration"]), call["iteration"]
        if key[0] not in scenes:
            report.skip(f"IDM calls of scene {key[0]}, which is not at hand")
            continue
        where = f"{key[0]} first {key[1]} call {iteration}"
        with report.attempt("IDM call", where):
            scenario = scenes[key[0]]
            if not all(0 <= index < scenario.num_iterations for index in (key[1], iteration)):
                raise DataError("no such iteration")
            if key not in planners:
                planners[key] = Idm()
                planners[key].reset(scene_info(scenario))
                planners[key].plan(observe_log(scenario, key[1], samples=1))
            seen = observe_log(scenario, iteration, samples=1)
            _compare_inputs(where, call, scenario, seen)
            _compare_outputs(where, call, scenario, planners[key], seen)
            call.finish()


def _compare_outputs(
    where: str, call: Source, scenario: Scenario, planner: Idm, seen: Observation
) -> None:
    centers, speeds = planner.roll_out(seen)
    route, path = planner.route_plan, planner.path
    assert route is not None
    assert path is not None
    end = [*path.driven.xy[-1].tolist(), float(path.driven.heading[-1])]
    ours = {
        "edges": [scenario.map.edges.ids[edge] for edge in route.path],
        "path_found": route.found,
        "target_velocity": planner.target_velocity,
        "path_points": len(path.driven.progress),
        "path_end": [path.end, *end[:2], wrap_angle(end[2])],
        "polyline_length": float(path.line_arc[-1]),
    }
    call.match(where, ours, TOLERANCE, quantity="IDM")
    times = seen.time_us + STEP_US * np.arange(STEPS + 1)
    rows = np.array(call["trajectory"], np.float64)
    call.report.compare("IDM plan time", where, times, rows[:, 0].astype(np.int64))
    plan = np.column_stack([centers, speeds])
    call.report.compare("IDM plan", where, plan, rows[:, 1:], atol=TOLERANCE)


def _compare_inputs(where: str, call: Source, scenario: Scenario, seen: Observation) -> None:
    """What the call recorded of its inputs is also in the log."""
    lights = seen.traffic_lights.items()
    ours = {
        "route": list(scenario.route),
        "time_us": seen.time_us,
        "ego_center": seen.ego.center,
        "ego_rear_velocity": seen.ego.values[[VX, VY]],
        "red_connectors": sorted(name for name, status in lights if status == LightStatus.RED),
    }
    call.match(where, ours, TOLERANCE, quantity="IDM input")
    tracks, objects = seen.tracks, {thing["token"]: thing for thing in call.each("objects")}
    present = {tracks.tokens[index]: index for index in np.flatnonzero(tracks.valid[0]).tolist()}
    if not call.report.compare("IDM input tokens", where, sorted(present), sorted(objects)):
        return
    for token, index in present.items():
        # the planner takes static objects, which have no velocity, as standing
        velocity = np.nan_to_num(tracks.velocities[0, index])
        values = np.concatenate([tracks.poses[0, index], tracks.sizes[0, index], velocity])
        names = ("x", "y", "heading", "length", "width", "vx", "vy")
        kind = {"type": AgentKind(int(tracks.kinds[index])).name.lower()}
        mine = {**kind, **dict(zip(names, values, strict=True))}
        objects[token].match(f"{where} {token}", mine, TOLERANCE, quantity="IDM input")
