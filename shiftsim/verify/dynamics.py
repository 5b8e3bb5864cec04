"""Compares vehicle dynamics, tracker, noise, interpolation, comfort and IDM steps with nuPlan's.

`CHECKS` has a function for each file, which computes the arrays of one case from the others.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, comfort_signals, within_bounds
from shiftsim.metrics.result import PROFILES
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.sim.dynamics.idm import idm_acceleration, idm_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.noise import noise_from_normals, parse_noise
from shiftsim.verify.files import EXACT, TOLERANCE, Source, read_arrays, verify_files
from shiftsim.verify.idm_worlds import verify_idm_world
from shiftsim.verify.report import Report
from shiftsim.verify.worlds import ego_states
from shiftsim.world import state
from shiftsim.world.state import HEADING, NUM_STATE, PACIFICA, STEERING, VX

Arrays: TypeAlias = dict[str, Any]

GIVEN_STEERING = 0.1  # rad, of all states made from centres; not among their inputs
LONGEST_PLAN_US = 3_600_000_000  # us, longer ones are broken input
WINDOW_KNOTS = 81  # knots of the plan in closed loops of mode `window`
LOOP_TOLERANCE = 1e-6  # closed loops: m, m/s, m/s^2, rad/s
LOOP_ANGLE_TOLERANCE = 1e-7  # rad, closed loops
TOLERANCES: Arrays = {  # of what `TOLERANCE` does not hold for
    "": TOLERANCE,
    "corners": 2e-9,  # m, coordinates near 4e6 are spaced 5e-10
    "cmd": LOOP_TOLERANCE,
    "state": np.where(
        np.isin(np.arange(NUM_STATE), [HEADING, STEERING]), LOOP_ANGLE_TOLERANCE, LOOP_TOLERANCE
    ),
    **dict.fromkeys(("profile_time_s", "noise", "cmd_applied"), EXACT),
}
_POSE, _MOTION = ("x", "y", "heading"), ("vx", "vy", "ax", "ay")
NAMES = {  # of columns, by the array that lists them
    "state_columns": (*_POSE, *_MOTION, "steer", "steer_rate", "omega", "alpha"),
    "centre_columns": (*_POSE, *_MOTION, "speed", "accel"),
    "from_centre_columns": (*_POSE, *_MOTION, "omega", "alpha"),
    "corner_order": ("FL", "RL", "RR", "FR"),
    "flag_columns": (*BOUNDED_SIGNALS.values(), "ego_is_comfortable"),
    "param_columns": ("target_velocity", "min_gap", "headway", "accel_max", "decel_max"),
    "agent_columns": ("progress", "velocity"),
    "lead_columns": ("progress", "velocity", "length_rear"),
}


def verify_dynamics(folder: Path, report: Report) -> None:
    """Compare every file of a folder of dynamics references."""
    parts = {f"{stem}.npz": partial(_verify_file, report, *check) for stem, check in CHECKS.items()}
    worlds = {"idm_world_*": partial(verify_idm_world, report=report)}
    verify_files(folder, report, {**parts, **worlds, "meta.json": None})


def _verify_file(
    report: Report, compute: Callable[[Source], Arrays], lists: str, labels: str, path: Path
) -> None:
    file, names = read_arrays(path, report), lists.split()
    file.note("label", *labels.split())
    file.match("file", {name: NAMES[name] for name in names})
    for number, case in enumerate(_cases(file, names)):
        case.match(f"case {number}", compute(case), TOLERANCES)
    file.finish()


def _cases(file: Source, names: list[str]) -> Iterator[Source]:
    """The arrays of each case: a row of every array, or what `<prefix>_ptr` gives it of others."""
    count = len(file["case"])
    ends = {n.removesuffix("ptr"): file.take(n, count + 1) for n in file if n.endswith("_ptr")}
    ragged: dict[str, IntArray] = {}
    for name in set(file) - set(names) - {f"{prefix}ptr" for prefix in ends}:
        size, divided = len(file.values[name]), np.arange(count + 1)
        for prefix in filter(name.startswith, ends):
            divided = ragged[name] = ends[prefix]
        if divided[0] or divided[-1] != size or (np.diff(divided) < 0).any():
            raise DataError(f"array {name!r} has {size} rows, which are not those of {count} cases")
    for case in range(count):
        rows = {name: slice(*divided[case : case + 2]) for name, divided in ragged.items()}
        values = {
            name: array[rows.get(name, case)]
            for name, array in file.values.items()
            if name not in names and not name.endswith("_ptr")
        }
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


_EGO = "state_columns centre_columns"
_FRAMES = f"{_EGO} corner_order from_centre_columns"
_IDM = "param_columns agent_columns lead_columns"
CHECKS = {  # file: what computes a case, arrays that list `NAMES`, labels and what nothing uses
    "bicycle_rollouts": (_bicycle, "state_columns", "case"),
    "bicycle_steps": (_bicycle, _EGO, "case kind"),
    "closed_loop": (_closed_loop, _EGO, "case shape"),
    "closed_loop_noise": (_closed_loop_noise, _EGO, "case shape"),
    "comfort_signals": (_comfort_signals, "flag_columns", "case sig_in_vx"),
    "ego_state_frames": (_ego_frames, _FRAMES, "case"),
    "idm_steps": (_idm_steps, _IDM, "case odeint rk45"),
    "lqr_commands": (_lqr_commands, "state_columns", "case kind"),
    "trajectory_interpolation": (_trajectory_interpolation, "state_columns", "case"),
}
