"""Recorded single calls of nuPlan's IDM planner (`idm_calls.json`)."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.planners.idm.planner import STEP_US, STEPS, Idm
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.verify.observing import observe, scene_info
from shiftsim.verify.report import Report
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, AgentKind, LightStatus

TOLERANCE = 1e-9
_KEY = ("scene", "first_call_iteration", "iteration")
_INPUTS = ("route", "ego_center", "ego_rear_velocity", "time_us", "objects", "red_connectors")
_OUTPUTS = (
    "edges",
    "path_found",
    "target_velocity",
    "path_points",
    "path_end",
    "polyline_length",
    "trajectory",
)
_OBJECT = ("token", "type", "x", "y", "heading", "length", "width", "vx", "vy")


def verify_idm_calls(folder: Path, report: Report, scenes: dict[str, Scenario]) -> None:
    """Repeat every recorded call from the scene's log and compare inputs and outputs.

    Args:
        folder: Folder with `idm_calls.json`.
        report: Filled with the comparisons.
        scenes: The scenarios by scene name; calls of other scenes are named as not covered.
    """
    path = folder / "idm_calls.json"
    try:
        calls = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: not readable as JSON ({error})") from error
    planners: dict[tuple[str, int], Idm] = {}
    for call in calls:
        scene = scenes.get(call["scene"])
        if scene is None:
            report.skip(f"IDM calls of scene {call['scene']}, which is not at hand")
            continue
        for extra in sorted(set(call) - {*_KEY, *_INPUTS, *_OUTPUTS}):
            report.skip(f"{path.name}: field {extra}")
        where = f"{call['scene']} first {call['first_call_iteration']} call {call['iteration']}"
        missing = [name for name in (*_INPUTS, *_OUTPUTS) if name not in call]
        if missing:
            report.fail("IDM call", where, f"no field {missing[0]!r}")
            continue
        iterations = (call["first_call_iteration"], call["iteration"])
        if not all(isinstance(i, int) and 0 <= i < scene.num_iterations for i in iterations):
            report.fail("IDM call", where, "no such iteration")
            continue
        _verify_call(report, where, call, scene, planners)


def _verify_call(
    report: Report,
    where: str,
    call: dict[str, Any],
    scenario: Scenario,
    planners: dict[tuple[str, int], Idm],
) -> None:
    key = (call["scene"], call["first_call_iteration"])
    info = scene_info(scenario)
    if key not in planners:
        planners[key] = Idm()
        planners[key].reset(info)
        planners[key].plan(_logged(scenario, call["first_call_iteration"]))
    planner = planners[key]
    observation = _logged(scenario, call["iteration"])
    _compare_inputs(report, where, call, info, observation)
    centers, speeds = planner.roll_out(observation)
    route_plan, road, made = planner.route_plan, scenario.map, planner.path
    assert route_plan is not None
    assert made is not None
    edges = [road.edges.ids[edge] for edge in route_plan.path]
    report.compare("IDM path edges", where, edges, call["edges"])
    report.compare("IDM path found", where, route_plan.found, call["path_found"])
    report.compare(
        "IDM target velocity",
        where,
        planner.target_velocity,
        call["target_velocity"],
        atol=TOLERANCE,
    )
    report.compare("IDM path points", where, len(made.driven.progress), call["path_points"])
    end = [made.end, *made.driven.xy[-1].tolist(), float(made.driven.heading[-1])]
    end[3] = (end[3] + np.pi) % (2.0 * np.pi) - np.pi
    report.compare("IDM path end", where, end, call["path_end"], atol=TOLERANCE)
    report.compare(
        "IDM polyline length",
        where,
        float(made.line_arc[-1]),
        call["polyline_length"],
        atol=TOLERANCE,
    )
    rows = np.array(call["trajectory"], np.float64)
    times = observation.time_us + STEP_US * np.arange(STEPS + 1)
    report.compare("IDM plan time", where, times, rows[:, 0].astype(np.int64))
    ours = np.column_stack([centers, speeds])
    report.compare("IDM plan", where, ours, rows[:, 1:], atol=TOLERANCE)


def _logged(scenario: Scenario, iteration: int) -> Observation:
    return observe(scenario, iteration, scenario.expert[iteration])


def _compare_inputs(
    report: Report, where: str, call: dict[str, Any], info: SceneInfo, observation: Observation
) -> None:
    """What the call recorded of its inputs is also in the log."""
    report.compare("IDM input route", where, list(info.route), call["route"])
    report.compare("IDM input time", where, observation.time_us, call["time_us"])
    ego = observation.ego
    report.compare("IDM input ego", where, ego.center, call["ego_center"], atol=TOLERANCE)
    report.compare(
        "IDM input velocity", where, ego.values[[VX, VY]], call["ego_rear_velocity"], atol=TOLERANCE
    )
    lights = observation.traffic_lights
    red = sorted(name for name, status in lights.items() if status == LightStatus.RED)
    report.compare("IDM input red lights", where, red, sorted(call["red_connectors"]))
    tracks = observation.tracks
    present = np.flatnonzero(tracks.valid[0])
    objects = {item["token"]: item for item in call["objects"]}
    tokens = [tracks.tokens[i] for i in present.tolist()]
    if not report.compare("IDM input tokens", where, sorted(tokens), sorted(objects)):
        return
    for extra in sorted({name for item in call["objects"] for name in item} - set(_OBJECT)):
        report.skip(f"idm_calls.json: object field {extra}")
    for index, token in zip(present.tolist(), tokens, strict=True):
        kind = AgentKind(int(tracks.kinds[index])).name.lower()
        report.compare("IDM input type", f"{where} {token}", kind, objects[token]["type"])
        # the planner takes static objects, which have no velocity, as standing
        velocity = np.nan_to_num(tracks.velocities[0, index])
        ours = np.concatenate([tracks.poses[0, index], tracks.sizes[0, index], velocity])
        theirs = np.array([objects[token].get(name) for name in _OBJECT[2:]], np.float64)
        report.compare("IDM input object", f"{where} {token}", ours, theirs, atol=TOLERANCE)
