"""Closed loops of PDM-Closed: every call made again from the recorded ego, then driven freely."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.proposals.tracker import STEP_US, STEPS
from shiftsim.sim.planner import scene_info
from shiftsim.verify.files import TOLERANCE, Groups, Source, read_arrays, read_json
from shiftsim.verify.nuplan.metrics import verify_nuplan_metrics
from shiftsim.verify.nuplan.runs import CHALLENGES, Seen, verify_simulation
from shiftsim.verify.pdm.steps import compare_scores, step_arrays
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import read_tables
from shiftsim.world.scenario import Scenario

TABLES = read_tables(__file__)
PLAN_TOLERANCES = np.array([2e-5, 2e-5, 1e-6])  # m, m, rad: stored as 32 bit floats
STEP_TOLERANCE = 1e-6  # m, rad, m/s …
_TABLES = (
    *("metrics", "statistics", "time_series", "route", "collisions", "scores", "objects", "ego"),
    *("steps", "proposals"),
)


def verify_loops(folder: Path, report: Report, scenes: Scenes, mode: str | None = None) -> None:
    """Compare every run (of one mode) of the `loop` folder."""
    verify_calls(folder, report, scenes, mode)
    logged = scenes.folder / "expected"
    verify_nuplan_metrics(folder, report, scenes, mode, logged=logged)
    verify_simulation(folder, report, scenes, mode, logged=logged)


def verify_calls(
    folder: Path, report: Report, scenes: Mapping[str, Scenario], mode: str | None = None
) -> None:
    """Make every planning call again from the recorded ego state."""
    egos, objects = (Groups(folder / f"{name}.parquet", report) for name in ("ego", "objects"))
    steps, proposals = (
        Groups(folder / f"{name}.parquet", report, ("scene", "challenge"))
        for name in ("steps", "proposals")
    )
    static = Source("static.json", "scene", read_json(folder / "static.json"), report)
    known = {"static.json", *(f"{name}.parquet" for name in _TABLES)}
    for key in egos:
        scene, challenge, _ = key
        where, arrays = f"{scene} {challenge}", folder / f"{scene}_{challenge}.npz"
        known.add(arrays.name)
        if mode not in (None, challenge):
            continue
        if scene not in scenes or challenge not in CHALLENGES:
            report.skip(f"closed loop {where}, whose scene or challenge is not known")
            continue
        with report.attempt("PDM loop", where):
            seen = Seen(scenes[scene], egos[key], objects[key], challenge)
            call, file = (scene, challenge), read_arrays(arrays, report, "PDM")
            planner = _compare_calls(where, seen, steps[call], proposals[call], file)
            facts, line = static.each(scene)[0].each(challenge)[0], planner.centerline
            assert line is not None
            names = {"road": seen.scenario.map, "scenario": seen.scenario, "planner": planner}
            TABLES["facts"].match(facts, where, path=make_path(line), nothing=None, **names)
    for table in (steps, proposals):
        table.finish(mode)
    if mode is None:
        static.finish()
    for name in sorted({path.name for path in folder.iterdir()} - known):
        report.skip(f"file loop/{name}")


def _compare_calls(
    where: str, seen: Seen, steps: Source, proposals: Source, file: Source
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
        names = {"road": road, "seen": observation, "sight": sight}
        names["limit"] = float(road.speed_limits[sight.lane])
        names["collided"] = ",".join(planner.collided)
        TABLES["step"].match(row, at, **names)
        row.match(at, {"best_score": theirs["score"].max()}, TOLERANCE, quantity="PDM")
        TABLES["ends"].match(theirs, at, ends=step.driven.states[:, -1])
        if compare_scores(at, seen.ego[index], sight, step, theirs, row):
            file.report.compare("PDM plan", at, step.poses, plan, atol=PLAN_TOLERANCES)
        if f"proposals_{index}" in file:
            ids = [*road.edges.ids, *road.car_parks.ids]
            areas = [ids[area] for area in sight.place.selected.tolist()]
            arrays = {"map_tokens": sight.tokens, "drivable_tokens": areas, **step_arrays(step)}
            file.match(at, {f"{name}_{index}": arrays[name] for name in arrays}, STEP_TOLERANCE)
    file.finish()
    return planner
