"""Closed loops of PDM-Closed: every call made again from the recorded ego, then driven freely."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.paths import make_path
from shiftsim.metrics import judge, measure
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.pdm.step import Step
from shiftsim.planners.proposals.tracker import STEP_US, STEPS
from shiftsim.sim.loop import simulate
from shiftsim.sim.planner import Observation
from shiftsim.verify.array_file import ArrayFile
from shiftsim.verify.nuplan.metrics import PROFILES, verify_nuplan_metrics
from shiftsim.verify.nuplan.planners import EGO_COLUMNS, tracks_at
from shiftsim.verify.nuplan.reactive import verify_nuplan_reactive
from shiftsim.verify.nuplan.reading import read_json
from shiftsim.verify.observing import observe, scene_info
from shiftsim.verify.pdm.scores import Recorded, compare_scores
from shiftsim.verify.pdm.steps import compare_arrays
from shiftsim.verify.report import Report
from shiftsim.verify.tables import RUN_KEY, Group, read_groups
from shiftsim.world import state
from shiftsim.world.scenario import Scenario

PLAN_POSITION, PLAN_HEADING = 2e-5, 1e-6  # m, rad: stored as 32 bit floats
TOLERANCE = 1e-6  # m, rad, m/s …
SCORE_TOLERANCE = 1e-9
TRAFFIC = {"NR": "nonreactive", "R": "reactive"}
_TABLES = ("metrics", "statistics", "time_series", "route", "collisions")  # of the metrics
_CALL = ("scene", "challenge")
_STEP_COLUMNS = {
    *("iteration", "time_us", "best", "braked", "best_score", "current_lane_id"),
    *("speed_limit_mps", "collided_ids", "n_map_tokens", "n_drivable_tokens"),
}
_DRIVEN = {  # column of proposals.parquet → index in a state row
    "sim_x": state.X,
    "sim_y": state.Y,
    "sim_heading": state.HEADING,
    "sim_vx": state.VX,
    "sim_ax": state.AX,
    "sim_steering": state.STEERING,
}
_SCORES = {  # column of proposals.parquet → field of Recorded
    "score": "total",
    "no_collision": "no_collision",
    "drivable_area": "drivable",
    "driving_direction": "direction",
    "progress": "progress",
    "ttc": "ttc",
    "comfort": "comfort",
    "progress_raw": "raw_progress",
    "collision_idx": "collision_index",
    "ttc_idx": "ttc_index",
}
_ARRAYS = {"proposals": "proposal_poses", "idm": "idm", "lead": "lead", "simulated": "simulated"}
_STATIC = ("scenario_route_ids", "route_ids", "route_lane_ids", "centerline", "centerline_length")


@dataclass(frozen=True, slots=True)
class Run:
    """One recorded closed loop and its scenario; tables hold the rows of this run only."""

    where: str
    scenario: Scenario
    ego: Group
    objects: Group | None
    steps: Group
    proposals: Group
    static: dict[str, Any]
    arrays: Path


def verify_loops(
    folder: Path, report: Report, scenes: dict[str, Scenario], source: Path, mode: str | None
) -> None:
    """Compare every run of the folder.

    Args:
        folder: The `loop` folder.
        report: Receives the comparisons.
        scenes: The scenarios by scene name.
        source: Folder with their logs and maps.
        mode: Only runs of this challenge.
    """
    runs = verify_calls(folder, report, scenes, mode)
    maps = {scenario.city: scenario.map for scenario in scenes.values()}
    verify_nuplan_metrics(source, report, maps, mode, loops=folder)
    if mode in (None, "R"):
        verify_nuplan_reactive(source, report, scenes, loops=folder)
    scores = read_groups(folder / "scores.parquet", (*RUN_KEY, "thresholds"))
    for run in runs:
        _drive_freely(run, scores, report)


def verify_calls(
    folder: Path, report: Report, scenes: dict[str, Scenario], mode: str | None = None
) -> list[Run]:
    """Make every planning call again from the recorded ego state; arguments as above.

    Returns:
        The runs that were compared.
    """
    runs = list(_runs(folder, report, scenes, mode))
    for run in runs:
        _verify_calls(run, report)
    return runs


def _runs(
    folder: Path, report: Report, scenes: dict[str, Scenario], mode: str | None
) -> Iterator[Run]:
    egos, objects = read_groups(folder / "ego.parquet"), read_groups(folder / "objects.parquet")
    steps = read_groups(folder / "steps.parquet", _CALL)
    proposals = read_groups(folder / "proposals.parquet", _CALL)
    static = read_json(folder / "static.json")
    read = {"ego", "objects", "steps", "proposals", "scores", *_TABLES}
    known = {f"{name}.parquet" for name in read} | {"static.json"}
    for key in egos:
        scene, challenge, _ = key
        arrays = folder / f"{scene}_{challenge}.npz"
        known.add(arrays.name)
        if mode not in (None, challenge):
            continue
        where = f"{scene} {challenge}"
        if scene not in scenes:
            report.skip(f"closed loops of scene {scene}, which is not at hand")
        elif challenge not in TRAFFIC:
            report.skip(f"closed loops of challenge {challenge}")
        elif key[:2] not in steps or key[:2] not in proposals or not arrays.exists():
            report.fail("PDM loop", where, "steps, proposals or arrays of this run are missing")
        elif challenge not in static.get(scene, {}):
            report.fail("PDM loop", where, "static.json lacks this run")
        else:
            tables = (egos[key], objects.get(key), steps[key[:2]], proposals[key[:2]])
            yield Run(where, scenes[scene], *tables, static[scene][challenge], arrays)
    calls = {key[:2] for key in egos}
    listed = {(scene, name) for scene, by_mode in static.items() for name in by_mode}
    for name, keys in (("steps", set(steps)), ("proposals", set(proposals)), ("static", listed)):
        for extra in sorted(keys - calls):
            report.skip(f"{name}: rows of {' '.join(extra)}")
    for path in sorted(folder.iterdir()):
        if path.name not in known:
            report.skip(f"file loop/{path.name}")


def _verify_calls(run: Run, report: Report) -> None:
    """Make every planning call again from the recorded ego state and objects."""
    planner = PdmClosed()
    planner.reset(scene_info(run.scenario))
    file = ArrayFile(run.arrays, report)
    count = len(run.ego["iteration"])
    plans = file.take("trajectory", count, STEPS + 1, 3).astype(np.float64)
    plans[:, :, :2] += file.take("trajectory_origin", 3)[:2]
    report.compare("PDM steps", run.where, np.arange(count), run.steps["iteration"])
    per_call = len(run.proposals["proposal"]) // count
    numbers = np.tile(np.arange(per_call), count)
    report.compare("PDM proposals", run.where, numbers, run.proposals["proposal"])
    report.compare(
        "PDM proposals",
        run.where,
        np.repeat(np.arange(count), per_call),
        run.proposals["iteration"],
    )
    for extra in sorted(set(run.steps) - {*_CALL, *_STEP_COLUMNS}):
        report.skip(f"steps.parquet: column {extra!r}")
    columns = {*_CALL, "iteration", "proposal", *_SCORES, *_DRIVEN}
    for extra in sorted(set(run.proposals) - columns):
        report.skip(f"proposals.parquet: column {extra!r}")
    for index in range(count):
        where = f"{run.where} iteration {index}"
        seen = _observe(run, index)
        step = planner.step(seen)
        _compare_step(run, report, where, index, planner, seen)
        rows = slice(index * per_call, (index + 1) * per_call)
        if _compare_scores(run, report, where, rows, index, step, planner, seen):
            plan, theirs = step.poses, plans[index]
            report.compare("PDM plan [m]", where, plan[:, :2], theirs[:, :2], atol=PLAN_POSITION)
            report.compare("PDM plan [rad]", where, plan[:, 2], theirs[:, 2], atol=PLAN_HEADING)
        _compare_arrays(report, where, index, file, step, planner, run.scenario)
    times = run.steps["time_us"][:, None] + STEP_US * np.arange(STEPS + 1)
    report.compare("PDM plan time", run.where, times, file["trajectory_time_us"])
    _compare_static(run, report, planner)
    file.finish()


def _observe(run: Run, index: int) -> Observation:
    ego = np.zeros(state.NUM_STATE)
    for column, position in EGO_COLUMNS.items():
        ego[position] = run.ego[column][index]
    # without objects of its own the run shows those of the log
    tracks = None if run.objects is None else tracks_at(run.objects, index)
    if tracks is None and run.where.endswith(" R"):
        tracks = state.Tracks.empty(1)
    return observe(run.scenario, index, ego, tracks)


def _compare_step(
    run: Run, report: Report, where: str, index: int, planner: PdmClosed, seen: Observation
) -> None:
    """Compare what a step saw."""
    road, sight = run.scenario.map, planner.seen
    assert sight is not None
    limit = float(road.speed_limits[sight.lane])
    ours = {
        "time_us": seen.time_us,
        "current_lane_id": road.edges.ids[sight.lane],
        "speed_limit_mps": limit,
        "collided_ids": ",".join(planner.collided),
        "n_map_tokens": len(sight.tokens),
        "n_drivable_tokens": len(sight.place.selected),
    }
    for column, value in ours.items():
        given = run.steps[column][index]
        given = np.nan if given is None else given
        report.compare(f"PDM step {column}", where, value, given)


def _compare_scores(
    run: Run,
    report: Report,
    where: str,
    rows: slice,
    index: int,
    step: Step,
    planner: PdmClosed,
    seen: Observation,
) -> bool:
    given = run.steps
    theirs = Recorded(
        **{field: run.proposals[name][rows].astype(np.float64) for name, field in _SCORES.items()}
    )
    choice = (int(given["best"][index]), bool(given["braked"][index]))
    assert planner.seen is not None
    highest = float(theirs.total.max())
    report.compare(
        "PDM best score", where, highest, float(given["best_score"][index]), atol=SCORE_TOLERANCE
    )
    for column, position in _DRIVEN.items():
        ends = run.proposals[column][rows]
        report.compare(
            f"PDM {column}", where, step.driven.states[:, -1, position], ends, atol=TOLERANCE
        )
    ego = seen.history.ego[-1]
    sight = (planner.seen.forecast, planner.seen.place)
    return compare_scores(report, where, ego, step, sight, theirs, choice)


def _compare_arrays(
    report: Report,
    where: str,
    index: int,
    file: ArrayFile,
    step: Step,
    planner: PdmClosed,
    scenario: Scenario,
) -> None:
    """Compare the arrays that are stored for some of the calls."""
    assert planner.seen is not None
    assert planner.route is not None
    names = {**_ARRAYS, "ego_areas": "ego_areas"}
    stored = {o: file[f"{n}_{index}"] for n, o in names.items() if f"{n}_{index}" in file.arrays}
    compare_arrays(report, where, step, stored)
    if (name := f"map_tokens_{index}") in file.arrays:
        report.compare("PDM map tokens", where, planner.seen.tokens, file[name].tolist())
    if (name := f"drivable_tokens_{index}") in file.arrays:
        ids = [*scenario.map.edges.ids, *scenario.map.car_parks.ids]
        ours = [ids[area] for area in planner.seen.place.selected.tolist()]
        report.compare("PDM drivable tokens", where, ours, file[name].tolist())


def _compare_static(run: Run, report: Report, planner: PdmClosed) -> None:
    """Compare what is decided once per scenario."""
    road, route, line = run.scenario.map, planner.route, planner.centerline
    if route is None or line is None:
        raise DataError("the run has no calls")
    ours: dict[str, object] = {
        "scenario_route_ids": list(run.scenario.route),
        "route_ids": [road.blocks.ids[block] for block in route.corrected],
        "route_lane_ids": [road.edges.ids[edge] for edge in route.lanes.tolist()],
        "centerline": line,
        "centerline_length": float(make_path(line).progress[-1]),
        "ego_state": [float(run.ego[column][0]) for column in EGO_COLUMNS],
    }
    for name, value in run.static.items():
        if name == "ego_state" and value is None:
            report.note("static.json: ego_state is null")
        elif name in ours:
            report.compare(f"PDM static {name}", run.where, ours[name], value, atol=1e-9)
        else:
            report.skip(f"static.json: field {name!r}")
    for name in _STATIC:
        if name not in run.static:
            report.fail(f"PDM static {name}", run.where, "no such field")


def _drive_freely(run: Run, scores: dict[tuple[str, ...], Group], report: Report) -> None:
    """Simulate the run from its start and compare what it scores."""
    challenge = run.where.split()[-1]
    log = simulate(run.scenario, PdmClosed(), traffic=TRAFFIC[challenge])
    measured = measure(log, run.scenario.map)
    for thresholds, profile in PROFILES.items():
        key = next((k for k in scores if " ".join(k[:2]) == run.where and k[3] == thresholds), None)
        if key is None:
            report.fail("PDM free run", run.where, f"no score with thresholds {thresholds}")
            continue
        result = judge(measured, profile)
        for metric, score in {**result.scores, "score": result.score}.items():
            if score is not None:
                given = float(scores[key][metric][0])
                where = f"{run.where} {thresholds} {metric}"
                report.compare("PDM free run score", where, score, given, atol=SCORE_TOLERANCE)
