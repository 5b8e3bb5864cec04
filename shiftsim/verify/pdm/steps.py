"""Planning steps of PDM-Closed: recorded with all their inputs, and as calls in closed loops."""

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from shiftsim.geometry import polylines
from shiftsim.kernels import BoolArray, FloatArray
from shiftsim.planners.pdm import forecast as around
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.planner import PdmClosed, Seen
from shiftsim.planners.pdm.scorer import TTC_STEPS, Place, Scores, score, weighted_mean
from shiftsim.planners.pdm.step import Step, choose
from shiftsim.planners.proposals.areas import areas_of
from shiftsim.planners.proposals.contacts import Obstacles
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.proposals.tracker import SCORED, STEP_US, STEPS
from shiftsim.planners.routes.lights import red_lights
from shiftsim.sim.planner import scene_info
from shiftsim.verify.files import Scenes, Source, open_tables, read_file, read_json
from shiftsim.verify.nuplan import runs
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables
from shiftsim.verify.worlds import BOX_COLUMNS, kind_of
from shiftsim.world.layers import make_layer, make_polygons
from shiftsim.world.state import HEADING, PACIFICA, center_poses, tracks_of_boxes

TABLES = read_tables(__file__)
UNSTABLE_BEARING = 1e-7  # rad from dead ahead or dead behind
STORED = np.array([2e-5, 2e-5, 1e-6])  # m, m, rad: plans stored as 32 bit floats
ROLLED = 1e-6  # m, rad, m/s, …: arrays of a step
ASIDE = np.array([1e-6, 3e-6])  # m, moves what is exactly ahead or behind to a side


def verify_step(report: Report, facts: dict[str, dict[str, Any]], path: Path) -> None:
    """Plan one recorded step again and compare everything.

    The `.json` has its inputs, the `.npz` beside it the outputs; `facts` takes what
    `step_core_summary.json` lists of the step.
    """
    inputs, where = read_file(path, report, "step_NNN.json"), path.stem
    file = read_file(path.with_suffix(".npz"), report, "PDM")
    ego, limit, planner = np.array(inputs["ego_state"]), inputs["speed_limit_mps"], PdmClosed()
    paths = planner.follow(np.array(inputs["centerline"], np.float64))
    seen = _see(inputs, ego, paths.at(0))
    step = planner.step_in(seen, paths, ego, np.nan if limit is None else limit, PACIFICA)
    facts[where] = made = {
        **{"seen": seen, "collided": planner.collided, "step": step, "arrays": step_arrays(step)},
        "boxes": seen.forecast.others.boxes[[0, 5, 20]],  # two time indices each
        "times": int(inputs["ego_time_us"]) + STEP_US * np.arange(STEPS + 1),
        "inputs": inputs,
        "zero": np.flatnonzero(step.scores.total == 0.0),
        "at_fault": np.flatnonzero(np.isfinite(step.scores.collision_index)),
        "too_near": np.flatnonzero(np.isfinite(step.scores.ttc_index)),
    }
    TABLES["step"].match(file, where, **made)
    rows = [file["scores"], *file.take("multi", 3, -1), *file.take("weighted", 3, -1)]
    rows += [file[name] for name in ("progress_raw", "collision_idx", "ttc_idx")]
    theirs = Source("PDM", "score", dict(zip(TABLES["scores"].rows, rows, strict=True)), report)
    if compare_scores(where, ego, seen, step, theirs, file):
        TABLES["plan"].match(file, where, **made)
    file.note("compared where the same proposal is chosen", "trajectory_rear")
    inputs.finish()
    file.finish()


def verify_summary(report: Report, facts: dict[str, dict[str, Any]], path: Path) -> None:
    """Compare the entries of `step_core_summary.json` with what the steps came to."""
    for entry in read_json(path):
        name, theirs = entry.get("case", "?"), Source(path.name, "field", entry, report)
        theirs.note("label", "case")
        with report.attempt("PDM step summary", name):
            TABLES["summary"].match(theirs, name, **facts[name])
            theirs.finish()


def _see(inputs: Source, ego: FloatArray, centerline: polylines.Path) -> Seen:
    center, things, parts = center_poses(ego[:3]), inputs.each("objects"), inputs.each("drivable")
    values = np.array([[thing[name] for name in BOX_COLUMNS] for thing in things], np.float64)
    kinds, names = [kind_of(thing) for thing in things], [thing["token"] for thing in things]
    tracks = tracks_of_boxes(values.reshape(1, -1, 7), kinds, names)
    chosen = around.select_tracks(tracks, center[0], center[1], set(), DEFAULT)
    shapes = [shapely.Polygon(part["exterior"]) for part in parts]
    drivable, red = make_layer([part["id"] for part in parts], shapes), inputs["red_light_lane_ids"]
    lights = red_lights([], [drivable.rings(drivable.index[name])[0] for name in red])
    tokens = [tracks.tokens[i] for i in chosen] + [around.LIGHT_TOKEN + name for name in red]
    crossings = make_polygons([[np.array(r, np.float64)] for r in inputs["intersections"]])
    numbers, on_route = np.arange(len(parts)), np.array([p["on_route"] for p in parts], np.bool_)
    place = Place(areas_of(drivable.polygons, on_route, numbers), numbers, crossings, centerline)
    return Seen(around.make_forecast(tracks, chosen, lights), tokens, place, -1)


def step_arrays(step: Step) -> dict[str, np.ndarray]:
    """Proposals, leads, driven states and areas of a step by the names of the reference."""
    made, shape = step.proposals, step.driven.states.shape[:2]
    # the best proposal goes on to 8 s; what is recorded ends where proposals are compared
    rolled = {"proposals": made.poses, "idm": made.motion, "lead": made.leads}
    arrays = {n: array[:, :, : SCORED + 1].reshape(*shape, -1) for n, array in rolled.items()}
    return {**arrays, "simulated": step.driven.states, "ego_areas": step.scores.flags}


def compare_scores(
    where: str, ego: FloatArray, seen: Seen, step: Step, proposals: Source, chosen: Source
) -> bool:
    """Compare scores, choice and brake decision of an ego (11,); whether the plan is the same."""
    ours = _settled(where, seen, step, proposals)
    best, braked = choose(ours, ego, DEFAULT)
    TABLES["scores"].match(proposals, where, scores=ours)
    TABLES["choice"].match(chosen, where, best=best, braked=braked)
    return (step.best, step.braked) == (chosen["best"], chosen["braked"])


def _settled(where: str, seen: Seen, step: Step, theirs: Source) -> Scores:
    """Our scores, with those times to collision of theirs that hang on an unstable bearing.

    The bearing is an arccos of a number that may round beyond 1 where an object is exactly ahead or
    behind; then it is overlooked. Either outcome is accepted there, and named.
    """
    ours, index = step.scores, theirs["ttc_idx"]
    if (ours.ttc_index == index).all():
        return ours
    states, others = step.driven.states, seen.forecast.others
    counted = others._replace(centroids=others.centroids + ASIDE)
    overlooked = others._replace(ignored=others.ignored | _in_line(states, others))
    for boxes in (counted, overlooked):
        other = score(states, seen.place, boxes, ego_box(PACIFICA), DEFAULT)
        rows = (ours.ttc_index != index) & (other.ttc_index == index)
        for row in np.flatnonzero(rows).tolist():
            note = "an object exactly ahead or behind"
            theirs.report.note(f"PDM ttc at {where}, proposal {row}: {note}")
        ttc, ttc_index = np.where(rows, (other.ttc, index), (ours.ttc, ours.ttc_index))
        ours = ours._replace(ttc=ttc, ttc_index=ttc_index)
    factor = ours.no_collision * ours.drivable * ours.direction
    return ours._replace(
        total=factor * weighted_mean(ours.progress, ours.ttc, ours.comfort, DEFAULT)
    )


def _in_line(states: FloatArray, others: Obstacles) -> BoolArray:
    """(N,) what is exactly ahead of the ego or behind it, from any of its states (P, T, 11)."""
    cos, sin = np.cos(states[..., HEADING, None]), np.sin(states[..., HEADING, None])
    out, times = np.zeros(len(others.radii), np.bool_), np.arange(states.shape[1])
    for later in TTC_STEPS:
        away = others.centroids[(times + later) // 2] - states[:, :, None, :2]
        aside = np.abs(cos * away[..., 1] - sin * away[..., 0])
        out |= (aside < UNSTABLE_BEARING * np.linalg.norm(away, axis=-1)).any(axis=(0, 1))
    return out


def verify_calls(folder: Path, report: Report, scenes: Scenes) -> None:
    """Make every planning call of closed loops again from the recorded ego state."""
    tables = open_tables(folder, report, "ego", "objects", "steps", "proposals")
    egos, objects, steps, proposals = tables.values()
    static = read_file(folder / "static.json", report, "static.json")
    for key in egos.of_mode():
        call, where = key[:2], " ".join(key[:2])
        with report.attempt("PDM loop", where):
            seen = runs.Seen(scenes[key[0]], egos[key], objects[key], key[1])
            file = read_file(folder / f"{'_'.join(call)}.npz", report, "PDM")
            names = {"road": seen.scenario.map, "scenario": seen.scenario}
            names["planner"] = _compare_calls(where, seen, steps[call], proposals[call], file)
            facts = static.each(key[0])[0].each(key[1])[0]
            TABLES["facts"].match(facts, where, nothing=None, **names)
    steps.finish()
    proposals.finish()
    if report.mode is None:
        static.finish()
    known = {f"{name}.parquet" for name in (*runs.RUN_TABLES, "steps", "proposals")}
    known |= {"static.json", *(f"{'_'.join(key[:2])}.npz" for key in egos)}
    for name in sorted({path.name for path in folder.iterdir()} - known):
        report.skip(f"file loop/{name}")


def _compare_calls(
    where: str, seen: runs.Seen, steps: Source, proposals: Source, file: Source
) -> PdmClosed:
    """Compare every call; the planner after the last one."""
    planner, road = PdmClosed(), seen.scenario.map
    planner.reset(scene_info(seen.scenario, planner=planner))
    count, per_call = len(seen.ego), proposals.num_rows // len(seen.ego)
    calls, numbers = np.arange(count), np.arange(per_call)
    steps.match(where, {"iteration": calls})
    rows = {"proposal": np.tile(numbers, count), "iteration": np.repeat(calls, per_call)}
    proposals.match(where, rows)
    times = steps["time_us"][:, None] + STEP_US * np.arange(STEPS + 1)
    file.match(where, {"trajectory_time_us": times})
    plans = file.take("trajectory", count, STEPS + 1, 3).astype(np.float64)
    plans[:, :, :2] += file.take("trajectory_origin", 3)[:2]
    for index, plan in enumerate(plans):
        at, observation = f"{where} iteration {index}", seen.at(index)
        step, sight = planner.step(observation), planner.seen
        assert sight is not None
        row, theirs = steps.at(index), proposals.at(numbers + index * per_call)
        names = {"road": road, "seen": observation, "sight": sight, "lane": sight.lane}
        names |= {"collided": ",".join(planner.collided), "scores": theirs["score"]}
        TABLES["call"].match(row, at, **names)
        TABLES["ends"].match(theirs, at, ends=step.driven.states[:, -1])
        if compare_scores(at, seen.ego[index], sight, step, theirs, row):
            file.report.compare("PDM plan", at, step.poses, plan, atol=STORED)
        if f"proposals_{index}" in file:
            ids = [*road.edges.ids, *road.car_parks.ids]
            areas = [ids[area] for area in sight.place.selected.tolist()]
            arrays = {"map_tokens": sight.tokens, "drivable_tokens": areas, **step_arrays(step)}
            file.match(at, {f"{name}_{index}": arrays[name] for name in arrays}, ROLLED)
    file.finish()
    return planner
