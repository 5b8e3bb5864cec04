"""Compares vehicle dynamics, tracker, noise, interpolation, comfort and IDM steps with nuPlan's.

`CHECKS` has a function for each file, which computes the arrays of one case from the others; names
of columns, labels and tolerances stand in `compared.toml`.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics.comfort import comfort_signals, within_bounds
from shiftsim.metrics.result import PROFILES
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.sim.dynamics.idm import idm_acceleration, idm_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.noise import noise_from_normals, parse_noise
from shiftsim.verify.files import COMPARED, Source, read_arrays, verify_files
from shiftsim.verify.idm_worlds import verify_idm_world
from shiftsim.verify.report import Report
from shiftsim.verify.worlds import ego_states
from shiftsim.world import state
from shiftsim.world.state import NUM_STATE, PACIFICA, STEERING, VX

Arrays: TypeAlias = dict[str, Any]

GIVEN_STEERING = 0.1  # rad, of all states made from centres; not among their inputs
LONGEST_PLAN_US = 3_600_000_000  # us, longer ones are broken input
WINDOW_KNOTS = 81  # knots of the plan in closed loops of mode `window`
_POSE = ("x", "y", "heading")


def verify_dynamics(folder: Path, report: Report) -> None:
    """Compare every file of a folder of dynamics references."""
    parts = dict.fromkeys(CHECKS, partial(_verify_file, report))
    worlds = {"idm_world_*": partial(verify_idm_world, report=report), "meta.json": None}
    verify_files(folder, report, {**parts, **worlds})


def _verify_file(report: Report, path: Path) -> None:
    file, lists = read_arrays(path, report), COMPARED[path.name]["lists"]
    file.note("label", *COMPARED[path.name]["labels"])
    file.match("file", {name: COMPARED["dynamics"]["lists"][name] for name in lists})
    for number, case in enumerate(_cases(file, lists)):
        case.match(f"case {number}", CHECKS[path.name](case), COMPARED["dynamics"]["atol"])
    file.finish()


def _cases(file: Source, lists: list[str]) -> Iterator[Source]:
    """The arrays of each case: a row of every array, or what `<prefix>_ptr` gives it of others."""
    count, given = len(file["case"]), {n: v for n, v in file.values.items() if n not in lists}
    ends = {name.removesuffix("ptr"): name for name in given if name.endswith("_ptr")}
    divided = {prefix: file.take(name, count + 1) for prefix, name in ends.items()}
    rows = {}
    for name in set(given) - set(ends.values()):
        ptr = next((divided[p] for p in divided if name.startswith(p)), np.arange(count + 1))
        size = len(given[name])
        if ptr[0] or ptr[-1] != size or (np.diff(ptr) < 0).any():
            raise DataError(f"array {name!r} has {size} rows, which are not those of {count} cases")
        rows[name] = np.split(given[name], ptr[1:-1]) if name.startswith((*ends,)) else given[name]
    for case in range(count):
        values = {name: array[case] for name, array in rows.items()}
        yield Source(file.name, file.what, values, file.report, file.used)


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


def _bicycle(case: Source) -> Arrays:
    """A step, or a rollout, which has an axis of time."""
    before, dt_us = case.take("in_state", NUM_STATE), case["dt_us"]
    commands = case.take("cmd", *dt_us.shape, 2).reshape(-1, 2)
    out = np.empty((len(commands), NUM_STATE))
    for step, (accel, rate) in enumerate(commands.tolist()):
        dt = step_seconds(0, int(dt_us.flat[step]))
        step_bicycle(before, accel, rate, WHEEL_BASE, dt, out[step])
        before = out[step]
    out, times = out.reshape(*dt_us.shape, NUM_STATE), case["in_time_us"] + np.cumsum(dt_us)
    ours = {"out_state": out, "out_time_us": times.reshape(dt_us.shape)}
    return ours if dt_us.shape else {**ours, "out_centre": _centers(out)}


def _lqr_commands(case: Source) -> Arrays:
    now, initial = int(case["now_us"]), case.take("ego_state", NUM_STATE)
    time_us = _stamps(case, "traj_time_us")
    plan = now, initial, time_us, ego_states({name: case[f"traj_{name}"] for name in _POSE})
    ref = lqr.reference(*plan, lqr.NUPLAN)
    lqr.raise_for_status(ref.status, now, time_us)
    _, accel, rate = lqr.track(*plan, lqr.NUPLAN)
    speed, curvature = lqr.fit_profiles(*plan[2:], lqr.NUPLAN)
    return {
        "lat_error": ref.lateral_error,
        "heading_error": ref.heading_error,
        "v0": initial[VX],
        "v_ref": ref.speed,
        "kappa_ref": ref.curvature,
        "stop_mode": lqr.is_stopping(initial[VX], ref.speed, lqr.NUPLAN),
        "accel_cmd": accel,
        "steer_rate_cmd": rate,
        "ego_time_us": now,
        "profile_time_s": (time_us[0] + np.arange(len(speed)) * lqr.NUPLAN.step_us) / 1e6,
        "profile_speed": speed,
        "profile_curvature": curvature,
    }


def _closed_loop(case: Source) -> Arrays:
    if case["mode"] not in ("full", "window"):
        raise DataError(f"mode {str(case['mode'])!r} is neither 'full' nor 'window'")
    jitter = (np.diff(case["iter_time_us"]) != lqr.NUPLAN.step_us).any()
    driven = _drive(case, case["mode"] == "full", np.zeros(case["cmd"].shape))
    return {"jitter": jitter, **driven}


def _closed_loop_noise(case: Source) -> Arrays:
    noise = noise_from_normals(parse_noise(f"{case['process']}-{case['level']}"), case["eps"])
    driven = _drive(case, False, case["noise"])
    return {"noise": noise, "cmd_applied": case["cmd"] + case["noise"], **driven}


def _drive(case: Source, is_whole: bool, noise: FloatArray) -> Arrays:
    """A closed loop; the tracker sees the whole plan, or a window that moves on with it."""
    plan, states = case.take("ref_pose", -1, 3), case.take("state", -1, NUM_STATE)
    ref_time, iter_time = _stamps(case, "ref_time_us"), _stamps(case, "iter_time_us")
    if len(plan) != len(ref_time) or len({len(states), len(iter_time), len(noise) + 1}) != 1:
        raise DataError("arrays 'state', 'iter_time_us', 'cmd' and 'ref_*' do not belong together")
    poses = ego_states(dict(zip(_POSE, plan.T, strict=True)))
    driven, commands = np.empty(states.shape), np.empty(noise.shape)
    driven[0] = states[0]
    for step, added in enumerate(noise.tolist()):
        knots = slice(None) if is_whole else slice(step, step + WINDOW_KNOTS)
        now, after = iter_time[step : step + 2].tolist()
        status = lqr.track_and_step(
            *(now, after, driven[step], ref_time[knots], poses[knots]),
            *(*added, driven[step + 1], commands[step]),
        )
        lqr.raise_for_status(status, now, ref_time[knots])
    return {
        "state": driven,
        "cmd": commands,
        "centre": _centers(states),
        "state_time_us": iter_time,
        "ref_time_us": ref_time[0] + lqr.NUPLAN.step_us * np.arange(len(ref_time)),
    }


def _trajectory_interpolation(case: Source) -> Arrays:
    stamps, states = _stamps(case, "knot_time_us"), case.take("knot_state", -1, NUM_STATE)
    queries = case["query_time_us"]
    out = np.empty((len(queries), NUM_STATE))
    for row, now in enumerate(queries.tolist()):
        if not interpolate(stamps, states, now, out[row]):
            raise DataError(f"query {now} is outside the trajectory")
    return {"query_out_state": out, "query_out_time_us": queries}


def _ego_frames(case: Source) -> Arrays:
    states, given = case.take("rear_state", NUM_STATE), case["from_centre_in"]
    size, built = np.array([PACIFICA.length, PACIFICA.width]), np.zeros(NUM_STATE)
    built[:7], built[[state.YAW_RATE, state.YAW_ACCEL]] = given[:7], given[7:]
    built[STEERING] = GIVEN_STEERING
    return {
        "centre": _centers(states),
        "corners": boxes_to_corners(state.center_poses(states[:3]), size),
        "from_centre_rear_state": state.rear_states(built),
    }


def _comfort_signals(case: Source) -> Arrays:
    names = ("heading", "vx", "ax", "ay", "omega", "alpha")
    states = ego_states({name: case[f"sig_in_{name}"] for name in names})
    signals = comfort_signals(case.take("sig_in_time_us", -1), states)
    ours: Arrays = {f"sig_{name}": values for name, values in signals._asdict().items()}
    for array, profile in (("within_default", "nuplan"), ("within_deepplan", "deepplan")):
        within = within_bounds(signals, PROFILES[profile])
        ours[array] = [*within, all(within)]
    return ours


def _idm_steps(case: Source) -> Arrays:
    (progress, speed), (lead, lead_speed, rear) = case["agent"].tolist(), case["lead"].tolist()
    given = speed, lead - progress - rear, lead_speed, *case.take("params", 5).tolist()
    distance, after = idm_step(*given, float(case["dt_s"]))
    euler = [progress + distance, after]
    return {"accel_unclipped": idm_acceleration(*given), "forward_euler": euler}


CHECKS = {
    "bicycle_rollouts.npz": _bicycle,
    "bicycle_steps.npz": _bicycle,
    "closed_loop.npz": _closed_loop,
    "closed_loop_noise.npz": _closed_loop_noise,
    "comfort_signals.npz": _comfort_signals,
    "ego_state_frames.npz": _ego_frames,
    "idm_steps.npz": _idm_steps,
    "lqr_commands.npz": _lqr_commands,
    "trajectory_interpolation.npz": _trajectory_interpolation,
}
