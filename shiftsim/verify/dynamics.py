"""Compares vehicle dynamics, tracker, noise, interpolation, comfort and IDM steps with nuPlan's.

One function per file of the folder. What a function reads is compared or consumed as input; every
array that none reads is named in the report, and so is every unknown file.
"""

from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import DataError, ShiftsimError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics.comfort import (
    BOUNDED_SIGNALS,
    MIN_SAMPLES,
    ComfortSignals,
    comfort_signals,
    within_bounds,
)
from shiftsim.metrics.thresholds import PROFILES
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.sim.dynamics.idm import idm_acceleration, idm_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.noise import NOISE_NAMES, noise_from_normals, parse_noise
from shiftsim.verify.array_file import EXACT, ArrayFile
from shiftsim.verify.idm_worlds import verify_idm_world
from shiftsim.verify.report import Report
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    NUM_STATE,
    PACIFICA,
    STEERING,
    STEERING_RATE,
    VX,
    YAW_ACCEL,
    YAW_RATE,
    X,
    Y,
    center_accelerations,
    center_poses,
    center_velocities,
    rear_states,
    speeds,
)

CORNER_TOLERANCE = 2e-9  # m, coordinates near 4e6 are spaced 5e-10
LOOP_TOLERANCE = 1e-6  # closed loops: m, m/s, m/s^2, rad/s
LOOP_ANGLE_TOLERANCE = 1e-7  # rad, closed loops
LONGEST_PLAN_US = 3_600_000_000  # us, longer ones are broken input
WINDOW_KNOTS = 81  # knots of the plan in closed loops of mode `window`

STATE_NAMES = (
    *("x", "y", "heading", "vx", "vy", "ax", "ay"),
    *("steer", "steer_rate", "omega", "alpha"),
)
CENTER_NAMES = ("x", "y", "heading", "vx", "vy", "ax", "ay", "speed", "accel")
FROM_CENTER_NAMES = ("x", "y", "heading", "vx", "vy", "ax", "ay", "omega", "alpha")
CORNER_NAMES = ("FL", "RL", "RR", "FR")
IDM_NAMES = {
    "param_columns": ("target_velocity", "min_gap", "headway", "accel_max", "decel_max"),
    "agent_columns": ("progress", "velocity"),
    "lead_columns": ("progress", "velocity", "length_rear"),
}


def verify_dynamics(folder: Path, report: Report) -> None:
    """Compare every file of a folder of dynamics references.

    Args:
        folder: The folder.
        report: Receives the comparisons.
    """
    for path in sorted(folder.iterdir()):
        if path.suffix == ".npz" and path.stem in _CHECKS:
            _verify_file(path, report)
        elif path.name.startswith("idm_world_"):
            verify_idm_world(path, report)
        elif path.name in ("README.md", "meta.json"):
            report.note(f"{path.name}: origin of the folder")
        else:
            report.skip(f"file {path.name}")


def _verify_file(path: Path, report: Report) -> None:
    try:
        file = ArrayFile(path, report)
        file.note("label", "case")
        _CHECKS[path.stem](file)
        file.finish()
    except (ShiftsimError, OSError, BadZipFile, ValueError, TypeError, IndexError) as error:
        report.fail(path.stem, path.name, f"cannot be compared: {error}")


def _centers(states: FloatArray) -> FloatArray:
    """(..., 9) columns of `CENTER_NAMES` from (..., 11) states."""
    magnitude = np.sqrt(states[..., AX] ** 2 + states[..., AY] ** 2)
    return np.concatenate(
        [
            center_poses(states[..., :3]),
            center_velocities(states),
            center_accelerations(states),
            speeds(states)[..., None],
            magnitude[..., None],
        ],
        axis=-1,
    )


def _bicycle_steps(file: ArrayFile) -> None:
    states = file.take("in_state", file.num_cases(), NUM_STATE)
    commands = file.take("cmd", len(states), 2)
    in_time, dt_us, out_time = file["in_time_us"], file["dt_us"], file["out_time_us"]
    expected, centers = file["out_state"], file["out_centre"]
    out = np.empty(NUM_STATE)
    for case, state in enumerate(states):
        dt = step_seconds(0, int(dt_us[case]))
        step_bicycle(state, *map(float, commands[case]), WHEEL_BASE, dt, out)
        file.compare("out_state", case, out, expected[case])
        file.compare("out_centre", case, _centers(out), centers[case])
        file.compare("out_time_us", case, in_time[case] + dt_us[case], out_time[case])
    file.columns("state_columns", STATE_NAMES)
    file.columns("centre_columns", CENTER_NAMES)
    file.note("label", "kind")
    file.note("in_state vy, ay, steer_rate, alpha: not read by the model")


def _bicycle_rollouts(file: ArrayFile) -> None:
    states = file.take("in_state", file.num_cases(), NUM_STATE)
    commands = file.take("cmd", len(states), -1, 2)
    dt_us = file.take("dt_us", *commands.shape[:2])
    expected = file["out_state"]
    for case, state in enumerate(states):
        driven = np.empty((commands.shape[1], NUM_STATE))
        for step, (accel, rate) in enumerate(commands[case].tolist()):
            dt = step_seconds(0, int(dt_us[case, step]))
            step_bicycle(
                driven[step - 1] if step else state, accel, rate, WHEEL_BASE, dt, driven[step]
            )
        file.compare("out_state", case, driven, expected[case])
        stamps = file["in_time_us"][case] + np.cumsum(dt_us[case])
        file.compare("out_time_us", case, stamps, file["out_time_us"][case])
    file.columns("state_columns", STATE_NAMES)
    file.note("in_state vy, ay, steer_rate, alpha: not read by the model")


def _plan_states(*columns: FloatArray) -> FloatArray:
    """(H, 11) states whose first columns are given, the others 0."""
    states = np.zeros((len(columns[0]), NUM_STATE))
    for index, column in enumerate(columns):
        states[:, index] = column
    return states


def _check_stamps(time_us: IntArray, what: str) -> None:
    steps = np.diff(time_us)
    if time_us.dtype != np.int64 or len(time_us) < 2 or (steps <= 0).any():
        raise DataError(f"{what}: need two or more increasing integer time stamps")
    if time_us[-1] - time_us[0] > LONGEST_PLAN_US:
        raise DataError(f"{what}: longer than {LONGEST_PLAN_US} us")


def _lqr_commands(file: ArrayFile) -> None:
    states = file.take("ego_state", file.num_cases("traj", "profile"), NUM_STATE)
    stamps = file.take("traj_time_us", -1)
    plans = _plan_states(
        *(file.take(f"traj_{name}", len(stamps)) for name in ("x", "y", "heading"))
    )
    now_us = file["now_us"]
    profiles = file.slices("profile")
    for case, (plan, profile) in enumerate(zip(file.slices("traj"), profiles, strict=True)):
        time_us, poses, now = stamps[plan], plans[plan], int(now_us[case])
        _check_stamps(time_us, f"trajectory of case {case}")
        ref = lqr.reference(now, states[case], time_us, poses, lqr.NUPLAN)
        lqr.raise_for_status(ref.status, now, time_us)
        _, accel, rate = lqr.track(now, states[case], time_us, poses, lqr.NUPLAN)
        speed, curvature = lqr.fit_profiles(time_us, poses, lqr.NUPLAN)
        times = (time_us[0] + np.arange(len(speed)) * lqr.NUPLAN.step_us) / 1e6
        initial = states[case, VX]
        stops = lqr.is_stopping(initial, ref.speed, lqr.NUPLAN)
        file.compare("lat_error", case, ref.lateral_error, file["lat_error"][case])
        file.compare("heading_error", case, ref.heading_error, file["heading_error"][case])
        file.compare("v0", case, initial, file["v0"][case])
        file.compare("v_ref", case, ref.speed, file["v_ref"][case])
        file.compare("kappa_ref", case, ref.curvature, file["kappa_ref"][case])
        file.compare("stop_mode", case, stops, file["stop_mode"][case], EXACT)
        file.compare("accel_cmd", case, accel, file["accel_cmd"][case])
        file.compare("steer_rate_cmd", case, rate, file["steer_rate_cmd"][case])
        file.compare("profile_time_s", case, times, file["profile_time_s"][profile], EXACT)
        file.compare("profile_speed", case, speed, file["profile_speed"][profile])
        file.compare("profile_curvature", case, curvature, file["profile_curvature"][profile])
        file.compare("ego_time_us", case, file["ego_time_us"][case], now, EXACT)
    file.columns("state_columns", STATE_NAMES)
    file.note("label", "kind")
    file.note("ego_state vy, ax, ay, steer_rate, omega, alpha: not read by the tracker")


def _closed_loop(file: ArrayFile) -> None:
    modes = [str(mode) for mode in file["mode"]]
    for case, mode in enumerate(modes):
        if mode not in ("full", "window"):
            raise DataError(f"case {case}: mode {mode!r} unknown")
        stamps = file["iter_time_us"][case]
        jittered = bool((np.diff(stamps) != lqr.NUPLAN.step_us).any())
        file.compare("jitter", case, jittered, file["jitter"][case], EXACT)
    _drive_loops(file, [mode == "full" for mode in modes], np.zeros(file["cmd"].shape))
    file.note("shape of the reference", "shape")


def _closed_loop_noise(file: ArrayFile) -> None:
    noise, eps = file["noise"], file["eps"]
    for case, process in enumerate(file["process"]):
        name = f"{process}-{file['level'][case]}"
        if name not in NOISE_NAMES:
            raise DataError(f"case {case}: noise {name!r} unknown")
        file.compare(
            "noise", case, noise_from_normals(parse_noise(name), eps[case]), noise[case], EXACT
        )
        applied = file["cmd"][case] + noise[case]
        file.compare("cmd_applied", case, applied, file["cmd_applied"][case], EXACT)
    _drive_loops(file, [False] * len(noise), noise)
    file.note("shape of the reference", "shape")


def _drive_loops(file: ArrayFile, whole_plan: list[bool], noise: FloatArray) -> None:
    cases = file.num_cases()
    references = file.take("ref_pose", cases, -1, 3)
    states = file.take("state", cases, -1, NUM_STATE)
    ref_time = file.take("ref_time_us", cases, references.shape[1])
    iter_time = file.take("iter_time_us", cases, states.shape[1])
    noise = np.ascontiguousarray(noise, np.float64).reshape(cases, states.shape[1] - 1, 2)
    for case, whole in enumerate(whole_plan):
        _check_stamps(ref_time[case], f"reference of case {case}")
        _check_stamps(iter_time[case], f"iterations of case {case}")
        grid = ref_time[case, 0] + lqr.NUPLAN.step_us * np.arange(ref_time.shape[1])
        file.compare("ref_time_us", case, grid, ref_time[case], EXACT)
        plan = _plan_states(*references[case].T)
        window = len(plan) if whole else WINDOW_KNOTS
        driven, commands = _drive(
            iter_time[case], states[case, 0], ref_time[case], plan, window, noise[case]
        )
        _compare_states(file, case, driven, states[case])
        file.compare("cmd", case, commands, file["cmd"][case], LOOP_TOLERANCE)
        file.compare("centre", case, _centers(states[case]), file["centre"][case])
        file.compare("state_time_us", case, file["state_time_us"][case], iter_time[case], EXACT)
    file.columns("state_columns", STATE_NAMES)
    file.columns("centre_columns", CENTER_NAMES)
    file.note("ref_pose: knots behind the last window are read by no step")


def _drive(
    iter_time: IntArray,
    initial: FloatArray,
    ref_time: IntArray,
    plan: FloatArray,
    window: int,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """States (T, 11) and clean commands (T - 1, 2) of one closed loop."""
    states = np.empty((len(iter_time), NUM_STATE))
    states[0] = initial
    commands = np.empty((len(noise), 2))
    for step, (accel, rate) in enumerate(noise.tolist()):
        first = 0 if window == len(plan) else step
        knots = slice(first, first + window)
        now, after = int(iter_time[step]), int(iter_time[step + 1])
        status = lqr.track_and_step(
            *(now, after, states[step], ref_time[knots], plan[knots]),
            *(accel, rate, states[step + 1], commands[step]),
        )
        lqr.raise_for_status(status, now, ref_time[knots])
    return states, commands


def _compare_states(file: ArrayFile, case: int, driven: FloatArray, expected: FloatArray) -> None:
    angles = [HEADING, STEERING]
    others = [index for index in range(NUM_STATE) if index not in (X, Y, *angles)]
    if driven.shape != expected.shape:
        raise DataError(f"case {case}: states have shape {expected.shape}, not {driven.shape}")
    for what, columns, atol in (
        ("position", [X, Y], LOOP_TOLERANCE),
        ("heading and steering angle", angles, LOOP_ANGLE_TOLERANCE),
        ("velocity, acceleration, rates", others, LOOP_TOLERANCE),
    ):
        file.compare(what, case, driven[:, columns], expected[:, columns], atol)


def _trajectory_interpolation(file: ArrayFile) -> None:
    stamps = file.take("knot_time_us", -1)
    states = file.take("knot_state", len(stamps), NUM_STATE)
    queries = file.take("query_time_us", -1)
    file.num_cases("knot", "query")
    knots = file.slices("knot")
    out = np.empty(NUM_STATE)
    for case, (knot, query) in enumerate(zip(knots, file.slices("query"), strict=True)):
        _check_stamps(stamps[knot], f"trajectory of case {case}")
        for row in range(query.start, query.stop):
            now = int(queries[row])
            if not interpolate(stamps[knot], states[knot], now, out):
                raise DataError(f"case {case}: query {now} is outside the trajectory")
            file.compare("query_out_state", case, out, file["query_out_state"][row])
            file.compare("query_out_time_us", case, now, file["query_out_time_us"][row], EXACT)
    file.columns("state_columns", STATE_NAMES)
    file.note("knot_state steer_rate, omega, alpha: not carried by interpolation")


def _ego_state_frames(file: ArrayFile) -> None:
    states = file.take("rear_state", file.num_cases(), NUM_STATE)
    centers = _centers(states)
    size = np.broadcast_to([PACIFICA.length, PACIFICA.width], (len(states), 2))
    corners = boxes_to_corners(center_poses(states[:, :3]), np.ascontiguousarray(size))
    given = file.take("from_centre_in", len(states), len(FROM_CENTER_NAMES))
    built = np.zeros((len(states), NUM_STATE))
    built[:, :7] = given[:, :7]
    built[:, [YAW_RATE, YAW_ACCEL]] = given[:, 7:]
    expected = file["from_centre_rear_state"]
    # not among the inputs: one steering angle for all, and no rate
    built[:, STEERING] = np.median(expected[:, STEERING])
    built[:, STEERING_RATE] = 0.0
    built = rear_states(built)
    for case in range(len(states)):
        file.compare("centre", case, centers[case], file["centre"][case])
        file.compare("corners", case, corners[case], file["corners"][case], CORNER_TOLERANCE)
        file.compare("from_centre_rear_state", case, built[case], expected[case])
    file.columns("state_columns", STATE_NAMES)
    file.columns("centre_columns", CENTER_NAMES)
    file.columns("corner_order", CORNER_NAMES)
    file.columns("from_centre_columns", FROM_CENTER_NAMES)
    file.note("rear_state steer, steer_rate: not converted")


def _comfort_signals(file: ArrayFile) -> None:
    file.num_cases("sig")
    stamps = file.take("sig_in_time_us", -1)
    states = np.zeros((len(stamps), NUM_STATE))
    for name, column in (
        *(("heading", HEADING), ("vx", VX), ("ax", AX), ("ay", AY)),
        *(("omega", YAW_RATE), ("alpha", YAW_ACCEL)),
    ):
        states[:, column] = file.take(f"sig_in_{name}", len(stamps))
    for case, rows in enumerate(file.slices("sig")):
        if rows.stop - rows.start < MIN_SAMPLES:
            raise DataError(f"case {case}: fewer than {MIN_SAMPLES} samples")
        signals = comfort_signals(stamps[rows], states[rows])
        for name in ComfortSignals._fields:
            file.compare(name, case, getattr(signals, name), file[f"sig_{name}"][rows])
        for profile, array in (("nuplan", "within_default"), ("deepplan", "within_deepplan")):
            flags = within_bounds(signals, PROFILES[profile])
            file.compare(array, case, [*flags, all(flags)], file[array][case], EXACT)
    file.columns("flag_columns", (*BOUNDED_SIGNALS.values(), "ego_is_comfortable"))
    file.note("sig_in_vx: read by no signal")
    file.note("sig_in_time_us: only the mean step matters")


def _idm_steps(file: ArrayFile) -> None:
    params = file.take("params", file.num_cases(), 5)
    agents, leads = file.take("agent", len(params), 2), file.take("lead", len(params), 3)
    dt_s = file["dt_s"]
    for case in range(len(params)):
        progress, speed = map(float, agents[case])
        lead_progress, lead_speed, rear = map(float, leads[case])
        given = (speed, lead_progress - progress - rear, lead_speed, *params[case].tolist())
        distance, after = idm_step(*given, float(dt_s[case]))
        file.compare(
            "accel_unclipped", case, idm_acceleration(*given), file["accel_unclipped"][case]
        )
        file.compare(
            "forward_euler", case, [progress + distance, after], file["forward_euler"][case]
        )
    for array, names in IDM_NAMES.items():
        file.columns(array, names)
    file.note("lead progress, length_rear: not read where the gap is below min_gap")
    file.note("integrators that no configuration uses", "odeint", "rk45")


_CHECKS: dict[str, Callable[[ArrayFile], None]] = {
    "bicycle_rollouts": _bicycle_rollouts,
    "bicycle_steps": _bicycle_steps,
    "closed_loop": _closed_loop,
    "closed_loop_noise": _closed_loop_noise,
    "comfort_signals": _comfort_signals,
    "ego_state_frames": _ego_state_frames,
    "idm_steps": _idm_steps,
    "lqr_commands": _lqr_commands,
    "trajectory_interpolation": _trajectory_interpolation,
}
