"""Complete planning steps of PDM-Closed with their inputs (`step_NNN.json` and `.npz`)."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.paths import make_path
from shiftsim.planners.pdm.forecast import (
    LIGHT_TOKEN,
    Forecast,
    make_forecast,
    select_tracks,
    touched,
)
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.rollout import Scene
from shiftsim.planners.pdm.route import offset_poses
from shiftsim.planners.pdm.scorer import Place
from shiftsim.planners.pdm.step import Step, plan_step
from shiftsim.planners.proposals.areas import areas_of
from shiftsim.planners.proposals.contacts import ego_box
from shiftsim.planners.proposals.tracker import SCORED, STEP_US, STEPS
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.pdm.scores import Recorded, compare_scores
from shiftsim.verify.report import Report
from shiftsim.world.layers import make_polygons
from shiftsim.world.state import PACIFICA, AgentKind, Tracks, center_poses

TOLERANCE = 1e-6  # m, rad, m/s …, of the issue; coordinates near 5e6 are spaced 1e-9
SHOWN_FORECASTS = (0, 11, 40)  # time indices of `map_boxes`
_INPUTS = {
    *("ego_state", "ego_time_us", "speed_limit_mps", "objects", "drivable"),
    *("red_light_lane_ids", "intersections", "centerline"),
}
_OBJECT = {"token", "type", "x", "y", "heading", "length", "width", "vx", "vy"}
_AREA = {"id", "on_route", "exterior"}


class Planned(NamedTuple):
    """One step that was planned again: what it saw, and what it came to."""

    tokens: list[str]
    forecast: Forecast
    collided: list[str]
    step: Step
    place: Place


def verify_step(path: Path, report: Report) -> dict[str, Any]:
    """Plan one recorded step again and compare everything.

    Args:
        path: The `.npz`; its inputs are in the `.json` beside it.
        report: Receives the comparisons.

    Returns:
        The facts of this step that `step_core_summary.json` lists.
    """
    inputs = read_json(path.with_suffix(".json"))
    _name_unknown(inputs, report)
    planned = _plan(inputs)
    ego = np.array(inputs["ego_state"], np.float64)
    file = ArrayFile(path, report)
    _compare(file, report, path.stem, ego, int(inputs["ego_time_us"]), planned)
    file.finish()
    scores = planned.step.scores
    return {
        "best": planned.step.best,
        "braked": planned.step.braked,
        "best_score": float(scores.total.max()),
        "n_objects": len(inputs["objects"]),
        "red": len(inputs["red_light_lane_ids"]),
        "collided": len(planned.collided),
        "zero_scores": int((scores.total == 0.0).sum()),
        "at_fault": int(np.isfinite(scores.collision_index).sum()),
        "ttc": int(np.isfinite(scores.ttc_index).sum()),
    }


def _name_unknown(inputs: dict[str, Any], report: Report) -> None:
    for extra in sorted(set(inputs) - _INPUTS):
        report.skip(f"step_NNN.json: field {extra!r}")
    for field, known in (("objects", _OBJECT), ("drivable", _AREA)):
        for extra in sorted({name for item in inputs[field] for name in item} - known):
            report.skip(f"step_NNN.json: field {extra!r} of {field}")


def _plan(inputs: dict[str, Any]) -> Planned:
    ego = np.array(inputs["ego_state"], np.float64)
    tracks = _tracks(inputs["objects"])
    center = center_poses(ego[None, :3])[0]
    chosen = select_tracks(tracks, center[0], center[1], set(), DEFAULT)
    ids = [area["id"] for area in inputs["drivable"]]
    rings = [np.array(area["exterior"], np.float64) for area in inputs["drivable"]]
    polygons = make_polygons([[ring] for ring in rings])
    areas = areas_of(
        polygons,
        np.array([area["on_route"] for area in inputs["drivable"]], np.bool_),
        np.arange(len(ids)),
    )
    lights = [_open(rings[ids.index(name)]) for name in inputs["red_light_lane_ids"]]
    forecast = make_forecast(tracks, chosen, lights)
    tokens = [tracks.tokens[i] for i in chosen.tolist()]
    tokens += [LIGHT_TOKEN + name for name in inputs["red_light_lane_ids"]]
    footprint = boxes_to_corners(center, np.array([PACIFICA.length, PACIFICA.width]))
    hit = touched(forecast, footprint)
    forecast.ignored[hit] = True
    line = np.array(inputs["centerline"], np.float64)
    paths = [make_path(line), *(make_path(offset_poses(line, s)) for s in DEFAULT.lateral_offsets)]
    crossings = make_polygons([[np.array(r, np.float64)] for r in inputs["intersections"]])
    limit = inputs["speed_limit_mps"]
    limit = DEFAULT.fallback_velocity if limit is None else limit
    place = Place(areas, np.arange(len(ids)), crossings, paths[0])
    targets = limit * np.array(DEFAULT.speed_fractions)
    scene = Scene(paths, forecast, ego_box(PACIFICA), DEFAULT.following)
    step = plan_step(ego, targets, scene, place, PACIFICA, DEFAULT)
    return Planned(tokens, forecast, [tokens[i] for i in hit], step, place)


def _open(ring: FloatArray) -> FloatArray:
    return ring[:-1] if (ring[0] == ring[-1]).all() else ring


def _tracks(objects: list[dict[str, Any]]) -> Tracks:
    def table(*names: str) -> FloatArray:
        rows = [[item[name] for name in names] for item in objects]
        return np.array(rows, np.float64).reshape(1, len(objects), len(names))

    for item in objects:
        if item["type"].upper() not in AgentKind.__members__:
            raise DataError(f"object {item['token']!r} has the unknown type {item['type']!r}")
    return Tracks(
        np.ones((1, len(objects)), np.bool_),
        table("x", "y", "heading"),
        table("vx", "vy"),
        table("length", "width"),
        np.array([AgentKind[item["type"].upper()] for item in objects], np.int64),
        tuple(item["token"] for item in objects),
    )


def _compare(
    file: ArrayFile, report: Report, where: str, ego: FloatArray, time_us: int, planned: Planned
) -> None:
    step, forecast = planned.step, planned.forecast
    report.compare("PDM map tokens", where, planned.tokens, file["map_tokens"].tolist())
    report.compare("PDM collided", where, planned.collided, file["collided_ids"].tolist())
    boxes = forecast.others.boxes[[index // 2 for index in SHOWN_FORECASTS]]
    report.compare("PDM map boxes", where, boxes, file["map_boxes"], atol=TOLERANCE)
    compare_arrays(report, where, step, {name: file[name] for name in STEP_ARRAYS})
    multi, weighted = file.take("multi", 3, -1), file.take("weighted", 3, -1)
    theirs = Recorded(
        total=file["scores"],
        no_collision=multi[0],
        drivable=multi[1],
        direction=multi[2],
        progress=weighted[0],
        ttc=weighted[1],
        comfort=weighted[2],
        raw_progress=file["progress_raw"],
        collision_index=file["collision_idx"],
        ttc_index=file["ttc_idx"],
    )
    choice = (int(file["best"]), bool(file["braked"]))
    if compare_scores(report, where, ego, step, (forecast, planned.place), theirs, choice):
        plan = file["trajectory_rear"]
        report.compare("PDM plan", where, step.poses, plan, atol=TOLERANCE)
    times = time_us + STEP_US * np.arange(STEPS + 1)
    report.compare("PDM plan time", where, times, file["trajectory_time_us"])


STEP_ARRAYS = ("proposal_poses", "idm", "lead", "simulated", "ego_areas")


def compare_arrays(report: Report, where: str, step: Step, theirs: dict[str, np.ndarray]) -> None:
    """Compare proposals, leads, driven states and areas of one step with arrays by name."""
    made, scored = step.proposals, slice(0, SCORED + 1)
    count = len(step.driven.states)
    # the best proposal goes on to 8 s; what is recorded ends where proposals are compared
    ours = {
        "proposal_poses": made.poses[:, :, scored].reshape(count, SCORED + 1, 3),
        "idm": made.motion[:, :, scored].reshape(count, SCORED + 1, 2),
        "lead": made.leads[:, :, scored].reshape(count, SCORED + 1, 3),
        "simulated": step.driven.states,
        "ego_areas": step.scores.flags,
    }
    for name, array in theirs.items():
        report.compare(f"PDM {name}", where, ours[name], array, atol=TOLERANCE)


def verify_summary(path: Path, report: Report, steps: dict[str, dict[str, Any]]) -> None:
    """Compare `step_core_summary.json` with what the steps came to."""
    for entry in read_json(path):
        name = entry.get("case", "?")
        if name not in steps:
            report.fail("PDM step summary", name, "this step is missing or cannot be compared")
            continue
        for field, value in entry.items():
            if field == "case":
                continue
            if field not in steps[name]:
                report.skip(f"{path.name}: field {field!r}")
                continue
            ours = steps[name][field]
            report.compare(f"PDM summary {field}", name, ours, value, atol=1e-9)
