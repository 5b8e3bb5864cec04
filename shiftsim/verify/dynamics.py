"""Compares vehicle dynamics, tracker, noise, interpolation, comfort and IDM steps with nuPlan's.

`CHECKS` has what computes, for each file, the names of `dynamics.toml` from the arrays of one case.
"""

from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.comfort import comfort_signals, within_bounds
from shiftsim.metrics.result import PROFILES
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.sim.dynamics.idm import idm_acceleration, idm_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.noise import noise_from_normals, parse_noise
from shiftsim.verify.files import Compare, Source, verify_files
from shiftsim.verify.idm_worlds import compare_idm_world
from shiftsim.verify.report import Report
from shiftsim.verify.tables import read_tables, rows_of
from shiftsim.verify.worlds import ego_states
from shiftsim.world import state

TABLES = read_tables(__file__)
GIVEN_STEERING = 0.1  # rad, of all states made from centres; not among their inputs
LONGEST_PLAN_US = 3_600_000_000  # us, longer ones are broken input
WINDOW_KNOTS = 81  # knots of the plan in closed loops of mode `window`
_POSE = ("x", "y", "heading")


def verify_dynamics(folder: Path, report: Report) -> None:
    """Compare every file of a folder of dynamics references."""
    files: dict[str, Compare] = {f"{name}.npz": _compare_cases for name in CHECKS}
    files["idm_world_*"] = compare_idm_world
    verify_files(folder, report, {"meta.json": None}, files)


def _compare_cases(file: Source, name: str) -> None:
    table = TABLES[name]
    file.note("label", *table.about["labels"])
    file.match("file", {column: TABLES["lists"].rows[column] for column in table.about["lists"]})
    for number, case in enumerate(rows_of(file)):
        table.match(case, f"case {number}", **CHECKS[name](case))


def _stamps(case: Source, name: str) -> IntArray:
    time_us: IntArray = case.take(name, -1)
    if time_us.dtype != np.int64 or len(time_us) < 2 or (np.diff(time_us) <= 0).any():
        raise DataError(f"array {name!r}: need two or more increasing integer time stamps")
    if time_us[-1] - time_us[0] > LONGEST_PLAN_US:
        raise DataError(f"array {name!r}: longer than {LONGEST_PLAN_US} us")
    return time_us


def _centers(states: FloatArray) -> FloatArray:
    """(..., 9) columns of `centre_columns` from (..., 11) states."""
    moves = state.center_velocities(states), state.center_accelerations(states)
    magnitude = np.sqrt(states[..., state.AX] ** 2 + states[..., state.AY] ** 2)
    sizes = state.speeds(states)[..., None], magnitude[..., None]
    return np.concatenate([state.center_poses(states[..., :3]), *moves, *sizes], axis=-1)


def _bicycle(case: Source) -> dict[str, Any]:
    """A step, or a rollout, which has an axis of time."""
    before, dt_us = case.take("in_state", state.NUM_STATE), case["dt_us"]
    commands = case.take("cmd", *dt_us.shape, 2).reshape(-1, 2)
    out = np.empty((len(commands), state.NUM_STATE))
    for step, (accel, rate) in enumerate(commands.tolist()):
        dt = step_seconds(0, int(dt_us.flat[step]))
        step_bicycle(before, accel, rate, WHEEL_BASE, dt, out[step])
        before = out[step]
    out, times = out.reshape(*dt_us.shape, state.NUM_STATE), case["in_time_us"] + np.cumsum(dt_us)
    return {"states": out, "times": times.reshape(dt_us.shape), "centers": _centers(out)}


def _lqr_commands(case: Source) -> dict[str, Any]:
    now, initial = int(case["now_us"]), case.take("ego_state", state.NUM_STATE)
    time_us, speed = _stamps(case, "traj_time_us"), initial[state.VX]
    plan = now, initial, time_us, ego_states({name: case[f"traj_{name}"] for name in _POSE})
    ref = lqr.reference(*plan, lqr.NUPLAN)
    lqr.raise_for_status(ref.status, now, time_us)
    speeds, curvatures = lqr.fit_profiles(*plan[2:], lqr.NUPLAN)
    times = (time_us[0] + np.arange(len(speeds)) * lqr.NUPLAN.step_us) / 1e6
    names = {"now": now, "speed": speed, "ref": ref, "command": lqr.track(*plan, lqr.NUPLAN)[1:]}
    names["is_stopping"] = lqr.is_stopping(speed, ref.speed, lqr.NUPLAN)
    return {**names, "times": times, "speeds": speeds, "curvatures": curvatures}


def _closed_loop(case: Source) -> dict[str, Any]:
    if case["mode"] not in ("full", "window"):
        raise DataError(f"mode {str(case['mode'])!r} is neither 'full' nor 'window'")
    jitter = (np.diff(case["iter_time_us"]) != lqr.NUPLAN.step_us).any()
    return {"jitter": jitter, **_drive(case, case["mode"] == "full", 0.0 * case["cmd"])}


def _closed_loop_noise(case: Source) -> dict[str, Any]:
    noise = noise_from_normals(parse_noise(f"{case['process']}-{case['level']}"), case["eps"])
    applied = case["cmd"] + case["noise"]
    return {"noise": noise, "applied": applied, **_drive(case, False, case["noise"])}


def _drive(case: Source, is_whole: bool, noise: FloatArray) -> dict[str, Any]:
    """A closed loop; the tracker sees the whole plan, or a window that moves on with it."""
    plan, states = case.take("ref_pose", -1, 3), case.take("state", -1, state.NUM_STATE)
    ref_time, iter_time = _stamps(case, "ref_time_us"), _stamps(case, "iter_time_us")
    if len(plan) != len(ref_time) or len({len(states), len(iter_time), len(noise) + 1}) != 1:
        raise DataError("arrays 'state', 'iter_time_us', 'cmd' and 'ref_*' do not belong together")
    poses = ego_states(dict(zip(_POSE, plan.T, strict=True)))
    driven, commands = np.empty(states.shape), np.empty(noise.shape)
    driven[0] = states[0]
    for step, added in enumerate(noise.tolist()):
        knots = slice(None) if is_whole else slice(step, step + WINDOW_KNOTS)
        now, after = iter_time[step : step + 2].tolist()
        given = now, after, driven[step], ref_time[knots], poses[knots], *added
        status = lqr.track_and_step(*given, driven[step + 1], commands[step])
        lqr.raise_for_status(status, now, ref_time[knots])
    plan_times = ref_time[0] + lqr.NUPLAN.step_us * np.arange(len(ref_time))
    ours = {"driven": driven, "commands": commands, "centers": _centers(states)}
    return {**ours, "times": iter_time, "plan_times": plan_times}


def _trajectory_interpolation(case: Source) -> dict[str, Any]:
    stamps, states = _stamps(case, "knot_time_us"), case.take("knot_state", -1, state.NUM_STATE)
    queries = case["query_time_us"]
    out = np.empty((len(queries), state.NUM_STATE))
    for row, now in enumerate(queries.tolist()):
        if not interpolate(stamps, states, now, out[row]):
            raise DataError(f"query {now} is outside the trajectory")
    return {"states": out, "times": queries}


def _ego_frames(case: Source) -> dict[str, Any]:
    states, given = case.take("rear_state", state.NUM_STATE), case["from_centre_in"]
    size, built = np.array([state.PACIFICA.length, state.PACIFICA.width]), np.zeros(state.NUM_STATE)
    built[:7], built[[state.YAW_RATE, state.YAW_ACCEL]] = given[:7], given[7:]
    built[state.STEERING] = GIVEN_STEERING
    corners = boxes_to_corners(state.center_poses(states[:3]), size)
    return {"centers": _centers(states), "corners": corners, "rear": state.rear_states(built)}


def _comfort_signals(case: Source) -> dict[str, Any]:
    names = ("heading", "vx", "ax", "ay", "omega", "alpha")
    states = ego_states({name: case[f"sig_in_{name}"] for name in names})
    signals = comfort_signals(case.take("sig_in_time_us", -1), states)
    within = {name: within_bounds(signals, profile) for name, profile in PROFILES.items()}
    return {"signals": signals, **{name: [*flags, all(flags)] for name, flags in within.items()}}


def _idm_steps(case: Source) -> dict[str, Any]:
    (progress, speed), (lead, lead_speed, rear) = case["agent"].tolist(), case["lead"].tolist()
    given = speed, lead - progress - rear, lead_speed, *case.take("params", 5).tolist()
    distance, after = idm_step(*given, float(case["dt_s"]))
    return {"acceleration": idm_acceleration(*given), "after": [progress + distance, after]}


CHECKS = {
    "bicycle_rollouts": _bicycle,
    "bicycle_steps": _bicycle,
    "closed_loop": _closed_loop,
    "closed_loop_noise": _closed_loop_noise,
    "comfort_signals": _comfort_signals,
    "ego_state_frames": _ego_frames,
    "idm_steps": _idm_steps,
    "lqr_commands": _lqr_commands,
    "trajectory_interpolation": _trajectory_interpolation,
}
