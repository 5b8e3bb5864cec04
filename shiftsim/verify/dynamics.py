"""Compares vehicle dynamics, tracker, noise, interpolation, comfort and IDM steps with nuPlan's.

One function per file of the folder, in the table `CHECKS`. Most arrays have a row per case.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

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
from shiftsim.world.state import NUM_STATE, PACIFICA

LOOP_TOLERANCE = 1e-6  # closed loops: m, m/s, m/s^2, rad/s
LOOP_ANGLE_TOLERANCE = 1e-7  # rad, closed loops
WINDOW_KNOTS = 81  # knots of the plan in closed loops of mode `window`

STATE_PARTS = {  # of a closed loop: columns of the states, tolerance
    "position": ([state.X, state.Y], LOOP_TOLERANCE),
    "heading and steering angle": ([state.HEADING, state.STEERING], LOOP_ANGLE_TOLERANCE),
    "velocity, acceleration, rates": ([3, 4, 5, 6, 8, 9, 10], LOOP_TOLERANCE),
}
TOLERANCES = {  # of what `TOLERANCE` does not hold for
    "": TOLERANCE,
    "corners": 2e-9,  # m, coordinates near 4e6 are spaced 5e-10
    "cmd": LOOP_TOLERANCE,
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
    report: Report, compare: Callable[[Source], None], lists: str, labels: str, path: Path
) -> None:
    file = read_arrays(path, report)
    file.note("label", *labels.split())
    compare(file)
    names, count = lists.split(), len(file["case"])
    file.match("file", {name: NAMES[name] for name in names})
    ragged = tuple(name.removesuffix("ptr") for name in file if name.endswith("_ptr"))
    for name, array in file.values.items():
        if not name.startswith(ragged) and name not in names and len(array) != count:
            raise DataError(f"array {name!r} has {len(array)} rows, not {count}")
    file.finish()


def _cases(file: Source, prefix: str) -> list[IntArray]:
    """Rows of each case in the arrays `<prefix>_*`, which `<prefix>_ptr` divides."""
    ends = file.take(f"{prefix}_ptr", len(file["case"]) + 1)
    ragged = [n for n in file if n.startswith(f"{prefix}_") and n != f"{prefix}_ptr"]
    if ends[0] or (np.diff(ends) < 0).any() or {len(file[n]) for n in ragged} != {int(ends[-1])}:
        raise DataError(f"array '{prefix}_ptr' does not divide {', '.join(ragged)} into cases")
    return np.split(np.arange(ends[-1]), ends[1:-1])


def _centers(states: FloatArray) -> FloatArray:
    """(..., 9) columns of `centre_columns` from (..., 11) states."""
    magnitude = np.sqrt(states[..., state.AX] ** 2 + states[..., state.AY] ** 2)
    return np.concatenate(
        [
            state.center_poses(states[..., :3]),
            state.center_velocities(states),
            state.center_accelerations(states),
            state.speeds(states)[..., None],
            magnitude[..., None],
        ],
        axis=-1,
    )


def _bicycle(file: Source) -> None:
    """Steps and rollouts; a step is a rollout without an axis of time."""
    states = file.take("in_state", -1, NUM_STATE)
    commands = file["cmd"].reshape(len(states), -1, 2)
    dt_us = file["dt_us"].reshape(commands.shape[:2])
    out = np.empty((*dt_us.shape, NUM_STATE))
    for case, before in enumerate(states):
        for step, (accel, rate) in enumerate(commands[case].tolist()):
            dt = step_seconds(0, int(dt_us[case, step]))
            step_bicycle(before, accel, rate, WHEEL_BASE, dt, out[case, step])
            before = out[case, step]
    out = out.reshape(*file["dt_us"].shape, NUM_STATE)
    times = file["in_time_us"][:, None] + np.cumsum(dt_us, axis=1)
    ours = {"out_state": out, "out_time_us": times.reshape(file["dt_us"].shape)}
    if file.name == "bicycle_steps":
        ours["out_centre"] = _centers(out)
    file.match_rows(ours, TOLERANCES)


def _lqr_commands(file: Source) -> None:
    stamps, states = file.take("traj_time_us", -1), file["ego_state"]
    plans = ego_states({name: file[f"traj_{name}"] for name in _POSE})
    cases = zip(_cases(file, "traj"), _cases(file, "profile"), strict=True)
    tracked = []
    for case, (plan, profile) in enumerate(cases):
        time_us, poses, now = stamps[plan], plans[plan], int(file["now_us"][case])
        ref = lqr.reference(now, states[case], time_us, poses, lqr.NUPLAN)
        lqr.raise_for_status(ref.status, now, time_us)
        _, accel, rate = lqr.track(now, states[case], time_us, poses, lqr.NUPLAN)
        speed, curvature = lqr.fit_profiles(time_us, poses, lqr.NUPLAN)
        initial = states[case, state.VX]
        stops = lqr.is_stopping(initial, ref.speed, lqr.NUPLAN)
        errors = ref.lateral_error, ref.heading_error
        tracked.append((*errors, initial, ref.speed, ref.curvature, stops, accel, rate, now))
        ours = {
            "profile_time_s": (time_us[0] + np.arange(len(speed)) * lqr.NUPLAN.step_us) / 1e6,
            "profile_speed": speed,
            "profile_curvature": curvature,
        }
        file.at(profile).match(f"case {case}", ours, TOLERANCES)
    names = "lat_error heading_error v0 v_ref kappa_ref stop_mode accel_cmd steer_rate_cmd"
    file.match_rows(
        dict(zip((*names.split(), "ego_time_us"), zip(*tracked, strict=True), strict=True)),
        TOLERANCES,
    )


def _closed_loop(file: Source) -> None:
    jitter = (np.diff(file["iter_time_us"]) != lqr.NUPLAN.step_us).any(axis=1)
    file.match_rows({"jitter": jitter})
    whole_plan = [{"full": True, "window": False}[mode] for mode in file["mode"].tolist()]
    _drive_loops(file, whole_plan, np.zeros(file["cmd"].shape))


def _closed_loop_noise(file: Source) -> None:
    names = [f"{pair[0]}-{pair[1]}" for pair in zip(file["process"], file["level"], strict=True)]
    pairs = zip(names, file["eps"], strict=True)
    noise = [noise_from_normals(parse_noise(name), normals) for name, normals in pairs]
    ours = {"noise": noise, "cmd_applied": file["cmd"] + file["noise"]}
    file.match_rows(ours, TOLERANCES)
    _drive_loops(file, [False] * len(names), np.ascontiguousarray(file["noise"]))


def _drive_loops(file: Source, whole_plan: list[bool], noise: FloatArray) -> None:
    cases = len(whole_plan)
    references = file.take("ref_pose", cases, -1, 3)
    ref_time = file.take("ref_time_us", cases, references.shape[1])
    states = file.take("state", cases, -1, NUM_STATE)
    iter_time = file.take("iter_time_us", cases, states.shape[1])
    commands = np.empty((cases, states.shape[1] - 1, 2))
    for case, whole in enumerate(whole_plan):
        plan = ego_states(dict(zip(_POSE, references[case].T, strict=True)))
        window = len(plan) if whole else WINDOW_KNOTS
        driven = np.empty(states[case].shape)
        driven[0] = states[case, 0]
        for step, (accel, rate) in enumerate(noise[case].tolist()):
            first = 0 if whole else step
            knots = slice(first, first + window)
            now, after = iter_time[case, step : step + 2].tolist()
            status = lqr.track_and_step(
                *(now, after, driven[step], ref_time[case, knots], plan[knots]),
                *(accel, rate, driven[step + 1], commands[case, step]),
            )
            lqr.raise_for_status(status, now, ref_time[case, knots])
        for part, (columns, atol) in STATE_PARTS.items():
            ours, theirs = driven[:, columns], states[case][:, columns]
            file.report.compare(f"{file.name} {part}", f"case {case}", ours, theirs, atol=atol)
    grid = ref_time[:, :1] + lqr.NUPLAN.step_us * np.arange(ref_time.shape[1])
    times = {"ref_time_us": grid, "state_time_us": iter_time}
    file.match_rows({**times, "cmd": commands, "centre": _centers(states)}, TOLERANCES)


def _trajectory_interpolation(file: Source) -> None:
    stamps = file.take("knot_time_us", -1)
    states = file.take("knot_state", len(stamps), NUM_STATE)
    queries = file.take("query_time_us", -1)
    out = np.empty((len(queries), NUM_STATE))
    for knot, query in zip(_cases(file, "knot"), _cases(file, "query"), strict=True):
        for row in query.tolist():
            now = int(queries[row])
            if not interpolate(stamps[knot], states[knot], now, out[row]):
                raise DataError(f"query {now} is outside the trajectory")
    file.match_rows({"query_out_state": out, "query_out_time_us": queries}, TOLERANCES)


def _ego_frames(file: Source) -> None:
    states = file.take("rear_state", -1, NUM_STATE)
    size = np.broadcast_to([PACIFICA.length, PACIFICA.width], (len(states), 2))
    corners = boxes_to_corners(state.center_poses(states[:, :3]), np.ascontiguousarray(size))
    given = file.take("from_centre_in", len(states), len(NAMES["from_centre_columns"]))
    built = np.zeros((len(states), NUM_STATE))
    built[:, :7] = given[:, :7]
    built[:, [state.YAW_RATE, state.YAW_ACCEL]] = given[:, 7:]
    # not among the inputs: one steering angle for all, and no rate
    built[:, state.STEERING] = np.median(file["from_centre_rear_state"][:, state.STEERING])
    built[:, state.STEERING_RATE] = 0.0
    built = state.rear_states(built)
    ours = {"centre": _centers(states), "corners": corners, "from_centre_rear_state": built}
    file.match_rows(ours, TOLERANCES)


def _comfort_signals(file: Source) -> None:
    stamps = file.take("sig_in_time_us", -1)
    names = ("heading", "vx", "ax", "ay", "omega", "alpha")
    states = ego_states({name: file[f"sig_in_{name}"] for name in names})
    flags: dict[str, list[list[bool]]] = {"within_default": [], "within_deepplan": []}
    for case, rows in enumerate(_cases(file, "sig")):
        signals = comfort_signals(stamps[rows], states[rows])
        ours = {f"sig_{name}": values for name, values in signals._asdict().items()}
        file.at(rows).match(f"case {case}", ours, TOLERANCES)
        for found, profile in zip(flags.values(), ("nuplan", "deepplan"), strict=True):
            within = within_bounds(signals, PROFILES[profile])
            found.append([*within, all(within)])
    file.match_rows(flags)


def _idm_steps(file: Source) -> None:
    params = file.take("params", -1, 5).tolist()
    agents, leads = file.take("agent", len(params), 2), file.take("lead", len(params), 3)
    rows = zip(agents.tolist(), leads.tolist(), params, file["dt_s"].tolist(), strict=True)
    accelerations, after = [], []
    for (progress, speed), (lead, lead_speed, rear), values, dt in rows:
        given = (speed, lead - progress - rear, lead_speed, *values)
        distance, next_speed = idm_step(*given, dt)
        accelerations.append(idm_acceleration(*given))
        after.append([progress + distance, next_speed])
    file.match_rows({"accel_unclipped": accelerations, "forward_euler": after}, TOLERANCES)


_EGO = "state_columns centre_columns"
_IDM = "param_columns agent_columns lead_columns"
CHECKS = {  # file: what compares it, arrays that list `NAMES`, labels and what nothing uses
    "bicycle_rollouts": (_bicycle, "state_columns", "case"),
    "bicycle_steps": (_bicycle, _EGO, "case kind"),
    "closed_loop": (_closed_loop, _EGO, "case shape"),
    "closed_loop_noise": (_closed_loop_noise, _EGO, "case shape"),
    "comfort_signals": (_comfort_signals, "flag_columns", "case sig_in_vx"),
    "ego_state_frames": (_ego_frames, f"{_EGO} corner_order from_centre_columns", "case"),
    "idm_steps": (_idm_steps, _IDM, "case odeint rk45"),
    "lqr_commands": (_lqr_commands, "state_columns", "case kind"),
    "trajectory_interpolation": (_trajectory_interpolation, "state_columns", "case"),
}
