"""Recorded plans of the nuplan folder, made again from the recorded ego states and objects."""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.errors import ShiftsimError
from shiftsim.planners.registry import PLANNERS, load_planner
from shiftsim.sim.planner import Planner
from shiftsim.verify.observing import observe, scene_info
from shiftsim.verify.report import Report
from shiftsim.verify.tables import Group, read_groups
from shiftsim.world import state
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, Tracks, Trajectory

PLAN_COLUMNS = {
    "x": state.X,
    "y": state.Y,
    "heading": state.HEADING,
    "vx": state.VX,
    "vy": state.VY,
    "ax": state.AX,
    "ay": state.AY,
    "tire_steering_angle": state.STEERING,
}
EGO_COLUMNS = {
    **PLAN_COLUMNS,
    "tire_steering_rate": state.STEERING_RATE,
    "angular_velocity": state.YAW_RATE,
    "angular_acceleration": state.YAW_ACCEL,
}
TOLERANCE = 1e-9
EVERY = 10  # iterations between recorded plans; the last one is recorded as well
_KEYS = ("scene", "challenge", "planner", "iteration", "index", "time_us")


def verify_planners(
    folder: Path, report: Report, scenes: dict[str, Scenario], mode: str | None = None
) -> None:
    """Plan again at every iteration of `expected/trajectories.parquet` and compare the states.

    Args:
        folder: The nuplan folder.
        report: Filled with the comparisons.
        scenes: The scenarios by scene name.
        mode: Only runs of this challenge.
    """
    plans = read_groups(folder / "expected" / "trajectories.parquet")
    egos = read_groups(folder / "expected" / "ego.parquet")
    objects = read_groups(folder / "expected" / "objects.parquet")
    for key in egos:
        if key not in plans and not key[2].startswith("scripted") and mode in (None, key[1]):
            report.fail("plan iterations", " ".join(key), "no plans are recorded")
    for key, rows in plans.items():
        scene, challenge, name = key
        if mode not in (None, challenge):
            continue
        where = f"{scene} {challenge} {name}"
        for extra in sorted(set(rows) - {*_KEYS, *PLAN_COLUMNS}):
            report.skip(f"trajectories.parquet: column {extra}")
        spec = name.replace("_", "-")
        if spec not in PLANNERS or scene not in scenes:
            report.skip(f"plans of {name} in {scene}, which is not known")
        elif key not in egos:
            report.fail("plan", where, "no ego states of this run are recorded")
        else:
            # challenge PT and NR show the log's objects, R its own
            seen = objects.get(key) if challenge == "R" else None
            _verify_run(report, where, load_planner(spec), scenes[scene], rows, egos[key], seen)


def _verify_run(
    report: Report,
    where: str,
    planner: Planner,
    scenario: Scenario,
    rows: Group,
    ego: Group,
    objects: Group | None,
) -> None:
    recorded = sorted(set(rows["iteration"].tolist()))
    last = len(ego["iteration"]) - 1
    report.compare("plan iterations", where, sorted({*range(0, last + 1, EVERY), last}), recorded)
    try:
        planner.reset(scene_info(scenario))
    except ShiftsimError as error:
        report.fail("plan", where, str(error))
        return
    for iteration in sorted({0, *recorded}):
        at = f"{where} iteration {iteration}"
        plan = _plan(report, at, planner, scenario, iteration, ego, objects)
        if plan is not None and iteration in recorded:
            members = np.flatnonzero(rows["iteration"] == iteration)
            _compare_plan(report, rows["planner"][0], at, plan, {n: rows[n][members] for n in rows})


def _plan(
    report: Report,
    at: str,
    planner: Planner,
    scenario: Scenario,
    iteration: int,
    ego: Group,
    objects: Group | None,
) -> Trajectory | None:
    where = np.flatnonzero(ego["iteration"] == iteration)
    if len(where) != 1 or not 0 <= iteration < scenario.num_iterations:
        report.fail("plan", at, f"{len(where)} ego states of this iteration are recorded")
        return None
    row: FloatArray = np.zeros(state.NUM_STATE)
    for column, index in EGO_COLUMNS.items():
        row[index] = ego[column][where[0]]
    tracks = None if objects is None else tracks_at(objects, iteration)
    try:
        plan = planner.plan(observe(scenario, iteration, row, tracks))
    except ShiftsimError as error:
        report.fail("plan", at, str(error))
        return None
    return plan if isinstance(plan, Trajectory) else None


def tracks_at(objects: Group, iteration: int) -> Tracks:
    """One row of tracks from a table of objects, in its order."""
    where = np.flatnonzero(objects["iteration"] == iteration)

    def table(*names: str) -> Any:
        return np.column_stack([objects[name][where].astype(np.float64) for name in names])[None]

    kinds = [AgentKind[str(name).upper()] for name in objects["type"][where].tolist()]
    return Tracks(
        np.ones((1, len(where)), np.bool_),
        table("x", "y", "heading"),
        table("vx", "vy"),
        table("length", "width"),
        np.array(kinds, np.int64),
        tuple(map(str, objects["track_token"][where].tolist())),
    )


def _compare_plan(report: Report, name: str, at: str, plan: Trajectory, rows: Group) -> None:
    report.compare(f"{name} plan index", at, np.arange(len(plan.time_us)), rows["index"])
    report.compare(f"{name} plan time", at, plan.time_us, rows["time_us"])
    for column, index in PLAN_COLUMNS.items():
        if column not in rows:
            report.fail(f"{name} plan {column}", at, "no such column")
            continue
        report.compare(
            f"{name} plan {column}", at, plan.states[:, index], rows[column], atol=TOLERANCE
        )
