"""Planning steps of PDM-Closed: those recorded with all their inputs, and how any is compared."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import make_path
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
from shiftsim.planners.pdm.scorer import TTC_STEPS, Place, Scores, score, weigh
from shiftsim.planners.pdm.step import Step, plan_step
from shiftsim.planners.proposals.areas import areas_of
from shiftsim.planners.proposals.contacts import Others, touches_boxes
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.proposals.tracker import DT, SCORED, STEP_US, STEPS
from shiftsim.verify.files import EXACT, TOLERANCE, Source, read_arrays, read_fields, read_json
from shiftsim.verify.report import Report
from shiftsim.verify.worlds import BOX_COLUMNS, make_tracks
from shiftsim.world.layers import make_polygons
from shiftsim.world.state import HEADING, PACIFICA, VX, VY, X, Y, center_poses

STEP_TOLERANCE = 1e-6  # m, rad, m/s …; coordinates near 5e6 are spaced 1e-9
SHOWN_FORECASTS = (0, 11, 40)  # time indices of `map_boxes`
UNSTABLE_BEARING = 1e-7  # rad from dead ahead or dead behind
SCORE_COLUMNS = {  # column of the reference: field of `Scores`, tolerance
    "score": ("total", TOLERANCE),
    "no_collision": ("no_collision", EXACT),
    "drivable_area": ("drivable", EXACT),
    "driving_direction": ("direction", EXACT),
    "progress": ("progress", TOLERANCE),
    "ttc": ("ttc", EXACT),
    "comfort": ("comfort", EXACT),
    "progress_raw": ("raw_progress", STEP_TOLERANCE),  # m
    "collision_idx": ("collision_index", EXACT),
    "ttc_idx": ("ttc_index", EXACT),
}


class Planned(NamedTuple):
    """One step that was planned: from which ego state, what it saw, and what it came to."""

    ego: FloatArray
    tokens: list[str]
    forecast: Forecast
    place: Place
    step: Step


def verify_step(report: Report, facts: dict[str, dict[str, Any]], path: Path) -> None:
    """Plan one recorded step again and compare everything.

    The `.json` has its inputs, the `.npz` beside it the outputs; `facts` takes what
    `step_core_summary.json` lists of the step.
    """
    inputs, where = read_fields(path, report, "step_NNN.json"), path.stem
    file = read_arrays(path.with_suffix(".npz"), report, "PDM")
    planned, collided = _plan(inputs)
    ours = {
        "map_tokens": planned.tokens,
        "collided_ids": collided,
        "map_boxes": planned.forecast.others.boxes[[index // 2 for index in SHOWN_FORECASTS]],
        "trajectory_time_us": int(inputs["ego_time_us"]) + STEP_US * np.arange(STEPS + 1),
        **step_arrays(planned),
    }
    file.match(where, ours, STEP_TOLERANCE)
    names = ("no_collision", "drivable_area", "driving_direction", "progress", "ttc", "comfort")
    rows = np.concatenate([file.take("multi", 3, -1), file.take("weighted", 3, -1)])
    columns = dict(zip(names, rows, strict=True))
    columns |= {name: file[name] for name in ("progress_raw", "collision_idx", "ttc_idx")}
    theirs = Source("PDM", "score", {**columns, "score": file["scores"]}, report)
    if compare_scores(where, planned, theirs, (int(file["best"]), bool(file["braked"]))):
        file.match(where, {"trajectory_rear": planned.step.poses}, STEP_TOLERANCE)
    file.note("compared where the same proposal is chosen", "trajectory_rear")
    inputs.finish()
    file.finish()
    step, scores = planned.step, planned.step.scores
    facts[where] = {
        "best": step.best,
        "braked": step.braked,
        "best_score": float(scores.total.max()),
        "n_objects": len(inputs["objects"]),
        "red": len(inputs["red_light_lane_ids"]),
        "collided": len(collided),
        "zero_scores": int((scores.total == 0.0).sum()),
        "at_fault": int(np.isfinite(scores.collision_index).sum()),
        "ttc": int(np.isfinite(scores.ttc_index).sum()),
    }


def _plan(inputs: Source) -> tuple[Planned, list[str]]:
    ego = np.array(inputs["ego_state"], np.float64)
    things, parts = inputs.each("objects"), inputs.each("drivable")
    values = np.array([[thing[name] for name in BOX_COLUMNS] for thing in things], np.float64)
    kinds, names = ([thing[name] for thing in things] for name in ("type", "token"))
    tracks = make_tracks((1, len(things)), ..., values.reshape(1, -1, 7), kinds, names)
    center = center_poses(ego[None, :3])[0]
    chosen = select_tracks(tracks, center[0], center[1], set(), DEFAULT)
    ids, reds = [part["id"] for part in parts], inputs["red_light_lane_ids"]
    rings = [np.array(part["exterior"], np.float64) for part in parts]
    on_route = np.array([part["on_route"] for part in parts], np.bool_)
    areas = areas_of(make_polygons([[ring] for ring in rings]), on_route, np.arange(len(ids)))
    forecast = make_forecast(tracks, chosen, [_open(rings[ids.index(name)]) for name in reds])
    tokens = [*(tracks.tokens[i] for i in chosen.tolist()), *(LIGHT_TOKEN + name for name in reds)]
    hit = touched(forecast, boxes_to_corners(center, np.array([PACIFICA.length, PACIFICA.width])))
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
    return Planned(ego, tokens, forecast, place, step), [tokens[i] for i in hit]


def _open(ring: FloatArray) -> FloatArray:
    return ring[:-1] if (ring[0] == ring[-1]).all() else ring


def step_arrays(planned: Planned) -> dict[str, np.ndarray]:
    """Proposals, leads, driven states and areas of a step by the names of the reference."""
    step, made, scored = planned.step, planned.step.proposals, slice(0, SCORED + 1)
    shape = step.driven.states.shape[:2]
    # the best proposal goes on to 8 s; what is recorded ends where proposals are compared
    return {
        "proposal_poses": made.poses[:, :, scored].reshape(*shape, 3),
        "idm": made.motion[:, :, scored].reshape(*shape, 2),
        "lead": made.leads[:, :, scored].reshape(*shape, 3),
        "simulated": step.driven.states,
        "ego_areas": step.scores.flags,
    }


def compare_scores(where: str, planned: Planned, theirs: Source, choice: tuple[int, bool]) -> bool:
    """Compare sub-scores, scores, choice and brake decision of one step.

    `choice` is the number of the recorded best proposal, and whether the emergency brake came
    instead. Returns whether both chose the same plan, so that plans can be compared.
    """
    ours, report = _settled(where, planned, theirs), theirs.report
    values = {column: getattr(ours, field) for column, (field, _) in SCORE_COLUMNS.items()}
    tolerances = {column: atol for column, (_, atol) in SCORE_COLUMNS.items()}
    theirs.match(where, values, tolerances, quantity="PDM")
    best = int(np.argmax(ours.total))
    report.compare("PDM choice", where, best, choice[0])
    is_slow = np.hypot(planned.ego[VX], planned.ego[VY]) <= DEFAULT.brake_speed
    braked = bool(is_slow and DT * ours.collision_index[best] <= DEFAULT.brake_time)
    report.compare("PDM brake", where, braked, choice[1])
    return (planned.step.best, planned.step.braked) == choice


def _settled(where: str, planned: Planned, theirs: Source) -> Scores:
    """Our scores, with those times to collision of theirs that hang on an unstable bearing.

    The bearing is an arccos of a number that may round beyond 1 where an object is exactly ahead or
    behind; then it is overlooked. Differences that this explains are named.
    """
    ours, given, index = planned.step.scores, theirs["ttc"], theirs["ttc_idx"]
    exempt = np.zeros(len(given), np.bool_)
    for row in np.flatnonzero((ours.ttc != given) | (ours.ttc_index != index)).tolist():
        states, others = planned.step.driven.states, planned.forecast.others
        if not (first := _unstable(states[row], others)):
            continue
        ignored: BoolArray = others.ignored.copy()
        ignored[list(first)] = True
        blind = others._replace(ignored=ignored)
        rest = score(states, planned.place, blind, ego_box(PACIFICA), DEFAULT)
        explained = index[row] in {rest.ttc_index[row], *first.values()}
        exempt[row] = explained and np.isfinite(index[row]) == (given[row] < 1.0)
    for row in np.flatnonzero(exempt).tolist():
        note = "an object exactly ahead or behind"
        theirs.report.note(f"PDM ttc at {where}, proposal {row}: {note}")
    ttc = np.where(exempt, given, ours.ttc)
    factor = ours.no_collision * ours.drivable * ours.direction
    return ours._replace(
        ttc=ttc,
        ttc_index=np.where(exempt, index, ours.ttc_index),
        total=factor * weigh(ours.progress, ttc, ours.comfort, DEFAULT),
    )


def _unstable(driven: FloatArray, others: Others) -> dict[int, float]:
    """Boxes exactly ahead or behind when the projected ego first touches them: its time index."""
    seen = others.ignored.copy()
    size = np.array([PACIFICA.length, PACIFICA.width])
    corners = boxes_to_corners(center_poses(driven[:, :3]), size)
    out: dict[int, float] = {}
    for index, row in enumerate(driven):
        cos, sin = np.cos(row[HEADING]), np.sin(row[HEADING])
        travel = DT * np.hypot(row[VX], row[VY]) * np.array([cos, sin])
        for later in TTC_STEPS:
            forecast = (index + later) // 2
            box = corners[index] + later * travel
            for hit in np.flatnonzero(touches_boxes(box, others.boxes[forecast]) & ~seen):
                seen[hit] = True
                dx, dy = others.centers[forecast, hit] - row[[X, Y]]
                turn = np.arctan2(abs(cos * dy - sin * dx), abs(cos * dx + sin * dy))
                if turn < UNSTABLE_BEARING:
                    out[int(hit)] = float(index)
    return out


def verify_summary(report: Report, facts: dict[str, dict[str, Any]], path: Path) -> None:
    """Compare the entries of `step_core_summary.json` with what the steps came to."""
    for entry in read_json(path):
        name = entry.get("case", "?")
        theirs = Source("step_core_summary.json", "field", entry, report)
        theirs.note("label", "case")
        with report.attempt("PDM step summary", name):
            theirs.match(name, facts[name], TOLERANCE, quantity="PDM summary")
            theirs.finish()
