"""Vehicle dynamics, tracker, noise, interpolation, comfort and IDM steps against nuPlan's own."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import places
import pytest
from json_worlds import read_map, read_scenario
from parity_cases import (
    Cases,
    File,
    change_array,
    name_unknown,
    noticed,
    order_observed,
    read_file,
    tracked,
)
from worlds import rear_states

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics.comfort import comfort_signals, within_bounds
from shiftsim.metrics.result import PROFILES
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle, step_seconds
from shiftsim.sim.dynamics.idm import idm_acceleration, idm_step
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.sim.noise import noise_from_normals, parse_noise
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.verify.rollouts import EGO_COLUMNS, ego_states
from shiftsim.world import state
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VY, AgentKind, LightStatus, TrafficLights

pytestmark = [pytest.mark.golden, pytest.mark.reference("dynamics")]
GOLDEN = places.GOLDEN / "dynamics"

ATOL = 1e-9
WORLD = 1e-6  # m, rad, m/s: vehicles in reactive traffic
# states in closed loops [m, m, rad, m/s, ...]
LOOP = [1e-6, 1e-6, 1e-7, 1e-6, 1e-6, 1e-6, 1e-6, 1e-7, 1e-6, 1e-6, 1e-6]
GIVEN_STEERING = 0.1  # rad, of all states made from centres; not among their inputs
WINDOW_KNOTS = 81  # knots of the plan in closed loops of mode `window`
POSE = ("x", "y", "heading")
COLUMNS = {  # of arrays, as listed in the files
    "state_columns": "x y heading vx vy ax ay steer steer_rate omega alpha".split(),
    "centre_columns": "x y heading vx vy ax ay speed accel".split(),
    "from_centre_columns": "x y heading vx vy ax ay omega alpha".split(),
    "corner_order": "FL RL RR FR".split(),
    "flag_columns": "mag_jerk lat_accel lon_accel lon_jerk yaw_accel yaw_rate "
    "ego_is_comfortable".split(),
    "param_columns": "target_velocity min_gap headway accel_max decel_max".split(),
    "agent_columns": ["progress", "velocity"],
    "lead_columns": ["progress", "velocity", "length_rear"],
}
LABELS = ("case", "kind", "shape", "odeint", "rk45", "sig_in_vx")  # need not be compared


def open_cases(path: Path, cases: Cases) -> list[File]:
    """The cases of a file, whose lists of columns are compared."""
    file = read_file(path, cases)
    file.match("file", {name: COLUMNS[name] for name in COLUMNS if name in file})
    file.note("label", *(name for name in LABELS if name in file))
    return file.array_rows()


def stamps(case: File, name: str) -> np.ndarray:
    time_us = case.take(name, -1)
    assert time_us.dtype == np.int64
    assert (np.diff(time_us) > 0).all(), "increasing integer time stamps"
    assert time_us[-1] - time_us[0] <= 3_600_000_000, "longer than an hour"
    return time_us


def centers(states: np.ndarray) -> np.ndarray:
    """(..., 9) columns of `centre_columns` from (..., 11) states."""
    moves = state.center_velocities(states), state.center_accelerations(states)
    magnitude = np.sqrt(states[..., state.AX] ** 2 + states[..., state.AY] ** 2)
    sizes = state.speeds(states)[..., None], magnitude[..., None]
    return np.concatenate([state.center_poses(states[..., :3]), *moves, *sizes], axis=-1)


def finish(rows: list[File]) -> None:
    rows[-1].finish()


@pytest.mark.files("bicycle_rollouts.npz", "bicycle_steps.npz")
def test_bicycle(path: Path, cases: Cases) -> None:
    for number, case in enumerate(rows := open_cases(path, cases)):
        before, dt_us = case.take("in_state", state.NUM_STATE), case["dt_us"]
        commands = case.take("cmd", *dt_us.shape, 2).reshape(-1, 2)
        out = np.empty((len(commands), state.NUM_STATE))
        for step, (accel, rate) in enumerate(commands.tolist()):
            dt = step_seconds(0, int(dt_us.flat[step]))
            step_bicycle(before, accel, rate, WHEEL_BASE, dt, out[step])
            before = out[step]
        out = out.reshape(*dt_us.shape, state.NUM_STATE)
        times = (case["in_time_us"] + np.cumsum(dt_us)).reshape(dt_us.shape)
        ours = {"out_state": out, "out_time_us": times}
        if "out_centre" in case:
            ours["out_centre"] = centers(out)
        case.match(f"case {number}", ours, ATOL)
    finish(rows)


@pytest.mark.files("lqr_commands.npz")
def test_tracker(path: Path, cases: Cases) -> None:
    for number, case in enumerate(rows := open_cases(path, cases)):
        now, initial = int(case["now_us"]), case.take("ego_state", state.NUM_STATE)
        time_us, speed = stamps(case, "traj_time_us"), initial[state.VX]
        plan = now, initial, time_us, ego_states({name: case[f"traj_{name}"] for name in POSE})
        ref = lqr.reference(*plan, lqr.NUPLAN)
        lqr.raise_for_status(ref.status, now, time_us)
        speeds, curvatures = lqr.fit_profiles(*plan[2:], lqr.NUPLAN)
        _, acceleration, rate = lqr.track(*plan, lqr.NUPLAN)
        ours = {
            "lat_error": ref.lateral_error,
            "heading_error": ref.heading_error,
            "v0": speed,
            "v_ref": ref.speed,
            "kappa_ref": ref.curvature,
            "stop_mode": lqr.is_stopping(speed, ref.speed, lqr.NUPLAN),
            "accel_cmd": acceleration,
            "steer_rate_cmd": rate,
            "ego_time_us": now,
            "profile_time_s": (time_us[0] + np.arange(len(speeds)) * lqr.NUPLAN.step_us) / 1e6,
            "profile_speed": speeds,
            "profile_curvature": curvatures,
        }
        case.match(f"case {number}", ours, {"": ATOL, "profile_time_s": 0.0})
    finish(rows)


def drive(case: File, is_whole: bool, noise: np.ndarray) -> dict[str, Any]:
    """A closed loop; the tracker sees the whole plan, or a window that moves on with it."""
    plan, states = case.take("ref_pose", -1, 3), case.take("state", -1, state.NUM_STATE)
    ref_time, iter_time = stamps(case, "ref_time_us"), stamps(case, "iter_time_us")
    assert len(plan) == len(ref_time)
    assert len(states) == len(iter_time) == len(noise) + 1
    poses = ego_states(dict(zip(POSE, plan.T, strict=True)))
    driven, commands = np.empty(states.shape), np.empty(noise.shape)
    driven[0] = states[0]
    for step, added in enumerate(noise.tolist()):
        knots = slice(None) if is_whole else slice(step, step + WINDOW_KNOTS)
        now, after = iter_time[step : step + 2].tolist()
        given = now, after, driven[step], ref_time[knots], poses[knots], *added
        status = lqr.track_and_step(*given, driven[step + 1], commands[step])
        lqr.raise_for_status(status, now, ref_time[knots])
    return {
        "state": driven,
        "cmd": commands,
        "centre": centers(states),
        "state_time_us": iter_time,
        "ref_time_us": ref_time[0] + lqr.NUPLAN.step_us * np.arange(len(ref_time)),
    }


@pytest.mark.files("closed_loop.npz")
def test_closed_loop(path: Path, cases: Cases) -> None:
    for number, case in enumerate(rows := open_cases(path, cases)):
        assert case["mode"] in ("full", "window")
        jitter = (np.diff(case["iter_time_us"]) != lqr.NUPLAN.step_us).any()
        ours = {"jitter": jitter, **drive(case, case["mode"] == "full", 0.0 * case["cmd"])}
        case.match(f"case {number}", ours, {"": ATOL, "state": LOOP, "cmd": 1e-6})
    finish(rows)


@pytest.mark.files("closed_loop_noise.npz")
def test_closed_loop_with_noise(path: Path, cases: Cases) -> None:
    for number, case in enumerate(rows := open_cases(path, cases)):
        noise = noise_from_normals(parse_noise(f"{case['process']}-{case['level']}"), case["eps"])
        ours = {"noise": noise, "cmd_applied": case["cmd"] + case["noise"]}
        ours |= drive(case, False, case["noise"])
        atol = {"": ATOL, "noise": 0.0, "cmd_applied": 0.0, "state": LOOP, "cmd": 1e-6}
        case.match(f"case {number}", ours, atol)
    finish(rows)


@pytest.mark.files("trajectory_interpolation.npz")
def test_interpolation(path: Path, cases: Cases) -> None:
    for number, case in enumerate(rows := open_cases(path, cases)):
        times, states = stamps(case, "knot_time_us"), case.take("knot_state", -1, state.NUM_STATE)
        queries = case["query_time_us"]
        out = np.empty((len(queries), state.NUM_STATE))
        for row, now in enumerate(queries.tolist()):
            assert interpolate(times, states, now, out[row]), f"query {now} is outside"
        ours = {"query_out_state": out, "query_out_time_us": queries}
        case.match(f"case {number}", ours, ATOL)
    finish(rows)


@pytest.mark.files("ego_state_frames.npz")
def test_ego_frames(path: Path, cases: Cases) -> None:
    size = np.array([state.PACIFICA.length, state.PACIFICA.width])
    for number, case in enumerate(rows := open_cases(path, cases)):
        states, given = case.take("rear_state", state.NUM_STATE), case["from_centre_in"]
        built = np.zeros(state.NUM_STATE)
        built[:7], built[[state.YAW_RATE, state.YAW_ACCEL]] = given[:7], given[7:]
        built[state.STEERING] = GIVEN_STEERING
        ours = {
            "centre": centers(states),
            "corners": boxes_to_corners(state.center_poses(states[:3]), size),
            "from_centre_rear_state": rear_states(built),
        }
        # coordinates near 4e6 are spaced 5e-10
        case.match(f"case {number}", ours, {"": ATOL, "corners": 2e-9})
    finish(rows)


@pytest.mark.files("comfort_signals.npz")
def test_comfort(path: Path, cases: Cases) -> None:
    names = ("heading", "vx", "ax", "ay", "omega", "alpha")
    for number, case in enumerate(rows := open_cases(path, cases)):
        states = ego_states({name: case[f"sig_in_{name}"] for name in names})
        signals = comfort_signals(case.take("sig_in_time_us", -1), states)
        flags = {name: within_bounds(signals, profile) for name, profile in PROFILES.items()}
        ours = {
            **{f"sig_{jerk}": getattr(signals, jerk) for jerk in ("lon_jerk", "mag_jerk")},
            **{f"sig_{name}_accel": getattr(signals, f"{name}_accel") for name in ("lon", "lat")},
            **{f"sig_{name}": getattr(signals, name) for name in ("mag_accel", "yaw_rate")},
            "sig_yaw_accel": signals.yaw_accel,
            "within_default": [*flags["nuplan"], all(flags["nuplan"])],
            "within_deepplan": [*flags["deepplan"], all(flags["deepplan"])],
        }
        case.match(f"case {number}", ours, ATOL)
    finish(rows)


@pytest.mark.files("idm_steps.npz")
def test_idm_steps(path: Path, cases: Cases) -> None:
    for number, case in enumerate(rows := open_cases(path, cases)):
        (progress, speed), (lead, lead_speed, rear) = case["agent"].tolist(), case["lead"].tolist()
        given = speed, lead - progress - rear, lead_speed, *case.take("params", 5).tolist()
        distance, after = idm_step(*given, float(case["dt_s"]))
        ours = {
            "accel_unclipped": idm_acceleration(*given),
            "forward_euler": [progress + distance, after],
        }
        case.match(f"case {number}", ours, ATOL)
    finish(rows)


NUMBERS = ("x", "y", "heading", "vx", "vy", "path_speed")  # of a vehicle in a world
VEHICLE_COLUMNS = ["token", *NUMBERS, "route_edge_ids"]


@pytest.mark.files("idm_world_*.json")
def test_idm_world(path: Path, cases: Cases) -> None:
    """The vehicles of a small world after each of 100 steps, their routes and their order."""
    world, name = tracked(json.loads(path.read_text())), path.stem
    world.used.add("world")  # its number
    scenario, expected = world_scenario(world), world["expected"]
    tracks = scenario.tracks.rows(np.arange(scenario.num_iterations))  # a copy, to be driven
    traffic = IdmTraffic()
    traffic.start(scenario, tracks, 0)
    order = order_observed(tracks.kinds, tracks.valid[0]).tolist()
    columns = expected["vehicle_columns"]
    cases.compare("idm_world vehicle_columns", name, VEHICLE_COLUMNS, columns)
    observed = [tracks.tokens[i] for i in order]
    cases.compare("idm_world order_frame0", name, observed, expected["order_frame0"])
    frames, is_vehicle = expected["vehicles"], tracks.kinds == AgentKind.VEHICLE
    cases.compare("idm_world frames", name, scenario.num_iterations, len(frames))
    for iteration, rows in enumerate(frames[: scenario.num_iterations]):
        if iteration:
            traffic.step(iteration - 1, scenario.ego[iteration - 1], tracks, iteration)
        fleet, where = traffic._scene.fleet, f"{name} {iteration}"
        index, alive = traffic._scene.agents[fleet.alive], np.flatnonzero(fleet.alive)
        vehicles = np.flatnonzero(tracks.valid[iteration] & is_vehicle)
        cases.compare("idm_world tracks", where, vehicles, index)
        values = np.array(rows, np.object_).reshape(-1, len(VEHICLE_COLUMNS)).T
        theirs = File("idm_world", "column", dict(zip(columns, values, strict=True)), cases)
        theirs.match(where, {"token": [tracks.tokens[i] for i in index.tolist()]})
        numbers = [tracks.poses[iteration, index], tracks.velocities[iteration, index]]
        ours = np.column_stack([*numbers, fleet.speed[fleet.alive]]).T
        theirs.match(where, dict(zip(NUMBERS, ours, strict=True)), WORLD)
        assert len(index) == len(rows)
        for row, agent in enumerate(alive.tolist()):
            route = fleet.route[agent, : fleet.route_size[agent]].tolist()
            edges = {"route_edge_ids": [scenario.map.edges.ids[edge] for edge in route]}
            theirs.at(row).match(f"{where} vehicle {row}", edges)
    world.finish(cases, "idm_world")


def world_scenario(world: Any) -> Scenario:
    road = read_map(world, "has_traffic_lights", "stop_lines")
    columns = zip(EGO_COLUMNS[: VY + 1], np.transpose(world["ego"]), strict=True)
    out, lights = read_scenario(world, road, ego_states(dict(columns))), world["lights"]
    names = tuple(sorted({name for row in lights for name in row}))
    if lost := set(names) - set(road.edges.ids):
        raise DataError(f"lights are on lanes that the map does not have: {sorted(lost)}")
    assert len(lights) == out.num_iterations
    status = [[LightStatus[row.get(name, "ABSENT")] for name in names] for row in lights]
    return replace(out, traffic_lights=TrafficLights(names, np.array(status, np.int8)))


def test_every_file_is_known(folder: Path, cases: Cases) -> None:
    stems = "bicycle_rollouts bicycle_steps lqr_commands closed_loop closed_loop_noise"
    stems += " trajectory_interpolation ego_state_frames comfort_signals idm_steps"
    known = [f"{stem}.npz" for stem in stems.split()]
    name_unknown(folder, cases, "idm_world_*.json", "meta.json", *known)


@pytest.mark.parametrize(
    ("test", "stem", "name"),
    [
        (test_bicycle, "bicycle_rollouts", "out_state"),
        (test_bicycle, "bicycle_steps", "out_centre"),
        (test_bicycle, "bicycle_steps", "cmd"),
        (test_tracker, "lqr_commands", "kappa_ref"),
        (test_tracker, "lqr_commands", "stop_mode"),
        (test_tracker, "lqr_commands", "traj_heading"),
        (test_closed_loop, "closed_loop", "state"),
        (test_closed_loop, "closed_loop", "cmd"),
        (test_closed_loop_with_noise, "closed_loop_noise", "noise"),
        (test_interpolation, "trajectory_interpolation", "query_out_state"),
        (test_ego_frames, "ego_state_frames", "corners"),
        (test_comfort, "comfort_signals", "sig_mag_jerk"),
        (test_comfort, "comfort_signals", "within_deepplan"),
        (test_idm_steps, "idm_steps", "forward_euler"),
        (test_idm_steps, "idm_steps", "param_columns"),
    ],
)
def test_a_changed_value_is_noticed(test: Any, stem: str, name: str, tmp_path: Path) -> None:
    path, cases = tmp_path / f"{stem}.npz", Cases()
    change_array(GOLDEN / path.name, path, name, amount=1e-5)
    assert noticed(test, path, cases)


@pytest.mark.parametrize("change", ["speed", "route", "field"])
def test_a_changed_world_is_noticed(change: str, tmp_path: Path) -> None:
    source, cases = places.GOLDEN / "idm_worlds" / "idm_world_0.json", Cases()
    world = json.loads(source.read_text())
    if change == "field":
        world["surprise"] = 1
    else:
        column = VEHICLE_COLUMNS.index("path_speed" if change == "speed" else "route_edge_ids")
        row = world["expected"]["vehicles"][50][0]
        row[column] = row[column] + 1e-5 if change == "speed" else row[column][1:]
    (tmp_path / source.name).write_text(json.dumps(world))
    test_idm_world(tmp_path / source.name, cases)
    assert cases.not_covered if change == "field" else cases.mismatches


def test_what_is_not_known_is_named(tmp_path: Path) -> None:
    cases = Cases()
    with np.load(GOLDEN / "idm_steps.npz") as archive:
        np.savez(tmp_path / "idm_steps.npz", **archive, surprise=archive["case"])
    shutil.copy(GOLDEN / "idm_steps.npz", tmp_path / "other.npz")
    test_idm_steps(tmp_path / "idm_steps.npz", cases)
    test_every_file_is_known(tmp_path, cases)
    assert list(cases.not_covered) == ["idm_steps: array 'surprise'", "file other.npz"]
