"""Rollouts in the words of nuPlan's tables: columns, tolerances, and what a planner saw.

Last, a few outputs of nuPlan's own code that come with the package, against what is computed here.
"""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeAlias
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike

from shiftsim.data.store.map import read_map_file
from shiftsim.errors import DataError
from shiftsim.files import PACKAGE
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics import evaluate, measure
from shiftsim.metrics.comfort import comfort_signals, within_bounds
from shiftsim.metrics.result import PROFILES
from shiftsim.planners.registry import load_planner
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.sim.dynamics.lqr import TRACKED, track_and_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.log import SimulationLog, as_recorded
from shiftsim.sim.planner import Observation, observe_log, scene_info
from shiftsim.verify.report import EXACT, TOLERANCE, Named, Report, Source
from shiftsim.world import state
from shiftsim.world.scenario import Scenario, scenario_of_rows
from shiftsim.world.state import AgentKind, Tracks, Trajectory, tracks_of_boxes

Bounds: TypeAlias = dict[str, ArrayLike]  # tolerance by column, "" being that of all others

# Columns of an ego state in the words of the official tables, in the order of `state.STATE_COLUMNS`
_STEERING = ("tire_steering_angle", "tire_steering_rate")
EGO_COLUMNS = (*state.STATE_COLUMNS[:7], *_STEERING, "angular_velocity", "angular_acceleration")
CENTER_COLUMNS = ("center_x", "center_y", "center_heading")
BOX_COLUMNS = ("x", "y", "heading", "vx", "vy", "length", "width")
_SHORT = {"omega": "angular_velocity", "alpha": "angular_acceleration"}

# Tolerances [m, rad, m/s, ...]
SIMULATED: Bounds = {"heading": 1e-7, "center_heading": 1e-7, "": 1e-6}  # ego states
LOGGED: Bounds = {
    **{"x": 1e-6, "y": 1e-6, "heading": 1e-7},
    **{"center_x": 1e-6, "center_y": 1e-6, "center_heading": 1e-7},
}
REACTIVE: Bounds = {"x": 1e-4, "y": 1e-4, "heading": 1e-5, "vx": 1e-4, "vy": 1e-4}
# what follows from recorded states; coordinates near 4e6 are spaced 5e-10
DERIVED: Bounds = {"center_x": 2e-9, "center_y": 2e-9, "center_heading": 1e-9}
# the other scores are 0 or 1
SCORES = dict.fromkeys(
    ("ego_progress_along_expert_route", "speed_limit_compliance", "score"), TOLERANCE
)
CHALLENGES = {  # controller and traffic
    "NR": ("lqr", "nonreactive"),
    "PT": ("perfect", "nonreactive"),
    "R": ("lqr", "reactive"),
}
ORIGINS = {  # of the ego states in a simulation log
    "driven": "driven: every state follows from the plan before it",
    "played back": "played back: its states are the recorded ego and do not follow from the plans",
    "exported": "exported by shiftsim: its plans are kept in part, and it is not driven again",
    "other": "driven by another controller: its states do not follow from the plans",
    "unknown": "driven or played back: its plans are of a class that is not known here",
}
REFERENCE = PACKAGE / "verify" / "reference"
_SIGNALS = ("heading", "vx", "ax", "ay", "omega", "alpha")
_STEP_ERROR = 1e-6  # m, rad, m/s, …: of a state that follows from the plan before it


def ego_states(columns: Mapping[str, Any]) -> FloatArray:
    """(R, 11) ego states from columns by name; what has no column is 0."""
    out = np.zeros((len(next(iter(columns.values()))), state.NUM_STATE))
    for name, values in columns.items():
        out[:, EGO_COLUMNS.index(_SHORT.get(name, name))] = values
    return out


def read_ego(rows: Source) -> FloatArray:
    """(R, 11) ego states of a table."""
    return ego_states({name: rows[name] for name in EGO_COLUMNS})


def ego_columns(states: FloatArray) -> dict[str, FloatArray]:
    """Columns of the official tables by name, from (R, 11) ego states: rear axle and centre."""
    columns = np.concatenate([states, state.center_poses(states[:, :3])], axis=1)
    return dict(zip((*EGO_COLUMNS, *CENTER_COLUMNS), columns.T, strict=True))


def object_columns(tracks: Tracks, rows: IntArray, index: IntArray) -> dict[str, Any]:
    """Columns of a table of objects but for heights: tracks at rows, both (R,)."""
    kinds = tracks.kinds[index]
    # the official table shows static objects, which have no velocity, as standing
    moves = tracks.velocities[rows, index]
    moves = np.where(kinds[:, None] > state.LAST_AGENT_KIND, np.nan_to_num(moves), moves)
    values = [tracks.poses[rows, index], moves, tracks.sizes[rows, index]]
    return {
        "iteration": rows,
        "track_token": [tracks.tokens[i] for i in index.tolist()],
        "type": [AgentKind(kind).name for kind in kinds.tolist()],
        **dict(zip(BOX_COLUMNS, np.concatenate(values, axis=1).T, strict=True)),
    }


def light_columns(scenario: Scenario) -> dict[str, Any]:
    """Lights of every sample that are listed."""
    rows, lights = scenario.iteration_rows[:-1].tolist(), scenario.traffic_lights
    listed = [(i, *light) for i, row in enumerate(rows) for light in lights.listed(row)]
    return {
        "iteration": [i for i, _, _ in listed],
        "lane_connector_id": [int(name) for _, name, _ in listed],
        "status": [status.name for _, _, status in listed],
        "timestamp": [int(scenario.time_us[rows[i]]) for i, _, _ in listed],
    }


def tracks_of(rows: Source, count: int) -> Tracks:
    """Dense tracks over `count` iterations from rows of a table of objects."""
    names, iteration = rows["track_token"].tolist(), rows["iteration"].astype(np.int64)
    kinds = dict(zip(names, rows["type"].tolist(), strict=True))
    column = {token: index for index, token in enumerate(kinds)}
    track = [column[token] for token in names]
    if not ((iteration >= 0) & (iteration < count)).all():
        raise DataError(f"objects at iterations which the ego does not have, of {count}")
    if len({*zip(iteration.tolist(), track, strict=True)}) != len(track):
        raise DataError("an object occurs twice at one iteration")
    if [kinds[token] for token in names] != rows["type"].tolist():
        raise DataError("an object changes its type")
    boxes = np.full((count, len(kinds), len(BOX_COLUMNS)), np.nan)
    boxes[iteration, track] = np.column_stack([rows[n].astype(np.float64) for n in BOX_COLUMNS])
    return tracks_of_boxes(boxes, [AgentKind[kind] for kind in kinds.values()], list(kinds))


def recorded_log(scenario: Scenario, ego: FloatArray) -> SimulationLog:
    """A rollout of which only the ego states (K, 11) are known; the scenario has the expert's."""
    log = as_recorded(scenario)
    if len(ego) != len(log.ego):
        raise DataError(f"{len(ego)} ego states, {len(log.ego) + 1} of the expert")
    return replace(log, ego=ego)


def origin(challenge: str, ego: Source, plans: Source | None) -> str:
    """How the ego of a simulation log came to its states: a word of `ORIGINS`."""
    states, time_us = read_ego(ego), ego["ego_time_us"].astype(np.int64)
    if plans is None:
        return "unknown"
    after, command = np.empty(state.NUM_STATE), np.empty(2)
    for row, (now, following) in enumerate(pairwise(time_us.tolist())):
        plan = plan_at(plans, row)
        if challenge == "PT":
            is_stepped = interpolate(plan.time_us, plan.states, following, after)
        else:
            given = now, following, states[row], plan.time_us, plan.states, 0.0, 0.0
            is_stepped = track_and_step(*given, after, command) == TRACKED
        error = after - states[row + 1]
        error[state.HEADING] = wrap_angle(error[state.HEADING])
        if not (is_stepped and np.abs(error).max() <= _STEP_ERROR):
            # nuPlan rule 415: a recorded ego has neither
            return "other" if states[:, [state.STEERING, state.YAW_RATE]].any() else "played back"
    return "driven"


def plan_at(plans: Source, iteration: int) -> Trajectory:
    """The recorded plan of an iteration."""
    now = plans.at(plans["iteration"] == iteration)
    return Trajectory(now["time_us"].astype(np.int64), read_ego(now))


class RecordedRun:
    """What a planner saw: the run's ego states, and its own objects where traffic is reactive."""

    def __init__(self, scenario: Scenario, ego: Source, objects: Source, challenge: str) -> None:
        self.scenario, self.ego = scenario, read_ego(ego)
        self._tracks = tracks_of(objects, len(self.ego)) if challenge == "R" else None

    def at(self, iteration: int) -> Observation:
        """The present alone; the rule-based planners look at nothing else."""
        row = slice(iteration, iteration + 1)
        tracks = None if self._tracks is None else self._tracks.rows(row)
        ego = self.ego[iteration]
        return observe_log(self.scenario, iteration, ego=ego, tracks=tracks, samples=1)


def compare_plans(where: str, spec: str, run: RecordedRun, rows: Source) -> None:
    """Compare the recorded plans, a row per state, with those of our planner."""
    recorded, planner = rows["iteration"], load_planner(spec)
    planner.reset(scene_info(run.scenario, planner=planner))
    for iteration in sorted({0, *recorded.tolist()}):
        plan = planner.plan(run.at(iteration))
        if iteration in recorded and isinstance(plan, Trajectory):
            ours = {"index": np.arange(len(plan.time_us)), "time_us": plan.time_us}
            columns = zip(EGO_COLUMNS, plan.states.T, strict=True)
            ours |= {name: values for name, values in columns if name in rows}
            here, at = rows.at(recorded == iteration), f"{where} iteration {iteration}"
            here.match(at, ours, TOLERANCE, quantity=f"{spec} plan")


def _check_bicycle(arrays: Named, report: Report) -> None:
    after_step = np.empty(arrays["in_state"].shape[1])
    for case, (before, command, dt_us, after) in enumerate(
        zip(*(arrays[name] for name in ("in_state", "cmd", "dt_us", "out_state")), strict=True)
    ):
        step_bicycle(before, *command.tolist(), WHEEL_BASE, step_seconds(0, int(dt_us)), after_step)
        report.compare("bicycle step", f"case {case}", after_step, after, atol=TOLERANCE)


def _check_tracker(arrays: Named, report: Report) -> None:
    commands = np.column_stack([arrays["accel_cmd"], arrays["steer_rate_cmd"]])
    for case, (begin, end) in enumerate(pairwise(arrays["traj_ptr"].tolist())):
        columns = {name: arrays[f"traj_{name}"][begin:end] for name in ("x", "y", "heading")}
        plan = arrays["traj_time_us"][begin:end], ego_states(columns)
        now, ego = int(arrays["now_us"][case]), arrays["ego_state"][case]
        command = lqr.track(now, ego, *plan, lqr.NUPLAN)[1:]
        report.compare("tracker command", f"case {case}", command, commands[case], atol=TOLERANCE)


def _check_comfort(arrays: Named, report: Report) -> None:
    for case, (begin, end) in enumerate(pairwise(arrays["sig_ptr"].tolist())):
        states = ego_states({name: arrays[f"sig_in_{name}"][begin:end] for name in _SIGNALS})
        signals = comfort_signals(arrays["sig_in_time_us"][begin:end], states)
        for name, profile in PROFILES.items():
            flags = within_bounds(signals, profile)
            theirs = arrays["within_default" if name == "nuplan" else f"within_{name}"][case]
            report.compare(f"comfort, {name}", f"case {case}", [*flags, all(flags)], theirs)


def _check_metrics(arrays: Named, report: Report) -> None:
    road = read_map_file(REFERENCE / "metric_world.arrow")
    time_us, expert = arrays["time_us"], arrays["expert"]
    scenario = scenario_of_rows("world", road, time_us, expert, Tracks.empty(len(time_us)))
    measured = measure(recorded_log(scenario, arrays["ego"]), road)
    for name, profile in PROFILES.items():
        result = evaluate(measured, profile)
        for metric, score in {**result.scores, "score": result.score}.items():
            if score is not None:
                theirs, atol = arrays[f"{name} {metric}"], SCORES.get(metric, EXACT)
                report.compare(f"score {metric}", name, score, theirs, atol=atol)


CHECKS = {
    "bicycle_steps.npz": _check_bicycle,
    "lqr_commands.npz": _check_tracker,
    "comfort_signals.npz": _check_comfort,
    "metric_world.npz": _check_metrics,
}


def check_reference(name: str, report: Report) -> None:
    """Compare with one file, a name in `CHECKS`; a DataError if it is missing or damaged."""
    path = REFERENCE / name
    try:
        with np.load(path, allow_pickle=False) as archive:
            CHECKS[name](dict(archive), report)
    except (OSError, BadZipFile, LookupError, ValueError) as error:
        raise DataError(f"{path}: {error}", hint="install shiftsim again") from error
