"""Training learned traffic, and how real it is."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from commands import call
from worlds import cruise_scenario, standing_tracks, straight_road

from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConfigError
from shiftsim.sim.traffic.learned.model import LearnedTraffic, load_weights
from shiftsim.sim.traffic.mixed import ConstantVelocity
from shiftsim.train.folder import TrafficSettings
from shiftsim.train.traffic.realism import compare
from shiftsim.train.traffic.recipe import train_traffic
from shiftsim.train.traffic.states import compute_labels
from shiftsim.world.state import AgentKind, Tracks

SMALL = {"seed": 3, "rounds": 2, "scenarios": 2, "epochs": 1, "tests": 2}
ROWS = 60 + 2 * 70 + 1


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Six scenarios in which a car brakes behind a parked one."""
    path = tmp_path_factory.mktemp("stores") / "braking"
    with StoreWriter(path) as writer:
        writer.add_map(straight_road())
        for number in range(6):
            _add(writer, number)
    return path


def _add(writer, number):
    speed, brake = 6.0 + number, 1.2 + 0.2 * number
    time = 0.05 * (np.arange(ROWS) - 60)
    stop = speed / brake
    slowed = speed * time - 0.5 * brake * np.clip(time, 0.0, stop) ** 2
    way = np.where(time < stop, slowed, 0.5 * speed * stop)
    poses = np.array([[60.0, 0.0, 0.0], [66.5 + 0.5 * speed * stop, 0.0, 0.0]])
    tracks = standing_tracks(ROWS, poses, [AgentKind.VEHICLE] * 2)
    tracks.poses[:, 0, 0] += way
    tracks.velocities[:, 0, 0] = np.clip(speed - brake * np.maximum(time, 0.0), 0.0, None)
    bare = cruise_scenario(speed=1.0, iterations=71, tracks=tracks, start=(5.0, 0.0, 0.0))
    rows, log = bare.iteration_rows, f"log-{number}"
    span = slice(0, ROWS)
    writer.add_recording(
        Recording(log, "straight", bare.time_us[span], tracks, bare.traffic_lights.rows(span))
    )
    writer.add_ego(EgoTrace(log, "ego", 0, bare.ego[span]))
    cut = bare.route, bare.mission_goal, bare.mapping
    writer.add_window(Window(f"{number:04x}", "free", log, "ego", 0, ROWS, rows, 2, *cut))


def recorded(poses):
    """One agent over rows 0.1 s apart."""
    rows = len(poses)
    shape = (rows, 1)
    speeds = np.zeros((*shape, 2))
    size = np.full((*shape, 2), 2.0)
    return Tracks(np.ones(shape, bool), poses[:, None], speeds, size, np.zeros(1, int), ("a",))


def label(tracks, pose, speed, closing=(np.inf, 0.0)):
    found = compute_labels(tracks, 20, np.array([pose]), np.array([speed]), np.array([closing]))
    assert not np.isnan(found).any()
    return tuple(found[0, :2].tolist())


def test_labels_lead_back_to_the_recorded_drive():
    x = 10.0 * 0.1 * np.arange(60)
    straight = recorded(np.c_[x, np.zeros(60), np.zeros(60)])
    here = 20.0, 0.0, 0.0
    assert label(straight, here, 10.0) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert label(straight, here, 8.0)[0] > 1.0  # too slow
    assert label(straight, (22.0, 0.0, 0.0), 10.0)[0] < -1.0  # too far
    assert label(straight, (20.0, 1.0, 0.0), 10.0)[1] < -0.01  # left of it: steer to the right
    assert label(straight, (20.0, 0.0, -0.1), 10.0)[1] > 0.01  # turned to the right
    assert label(straight, here, 10.0, (10.0, 8.0))[0] < -3.0  # about to run into somebody
    angle = np.arange(60) * 0.05  # a left bend of 20 m radius at 10 m/s
    bend = recorded(np.c_[20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle), angle])
    pose = bend.poses[20, 0]
    assert label(bend, pose, 10.0)[1] == pytest.approx(1.0 / 20.0, rel=0.05)


@pytest.fixture(scope="module")
def weights(store, tmp_path_factory):
    settings = TrafficSettings(
        store=str(store), out=tmp_path_factory.mktemp("traffic") / "out", **SMALL
    )
    lines = []
    return train_traffic(settings, lines.append), lines


def test_a_training_gives_weights_losses_and_a_table(weights, store, tmp_path):
    file, lines = weights
    assert [line[:12] for line in lines] == ["round 1 of 2", "round 2 of 2"]
    rows = pq.read_table(file.parent / "realism.parquet").to_pylist()
    names = ["recording", "learned", "reactive", "constant-velocity"]
    assert [row["traffic"] for row in rows] == names
    assert rows[0]["distance_m"] == 0.0
    assert rows[1]["distance_m"] > 0.0
    assert pq.read_table(file.parent / "losses.parquet").num_rows == 2
    with pytest.raises(ConfigError, match="is not empty"):
        train_traffic(TrafficSettings(store=str(store), out=file.parent, **SMALL), lines.append)
    again = train_traffic(
        TrafficSettings(store=str(store), out=tmp_path / "out", **SMALL), lines.append
    )
    for first, second in zip(load_weights(file), load_weights(again), strict=True):
        np.testing.assert_array_equal(first, second)
    other = TrafficSettings(store=str(store), out=tmp_path / "other", **(SMALL | {"seed": 4}))
    found = load_weights(train_traffic(other, lines.append))
    assert not np.array_equal(found.first, load_weights(file).first)


def test_settings_that_make_no_training_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="rounds is 0"):
        TrafficSettings(out=tmp_path, rounds=0)


def test_the_shipped_weights_are_nearer_than_constant_velocity(store):
    scenarios = list(open_store(store))
    rows = compare(scenarios, {"learned": LearnedTraffic, "straight": ConstantVelocity})
    by_name = {row["traffic"]: row for row in rows}
    assert by_name["recording"]["vehicles_that_moved"] == 6
    assert by_name["learned"]["distance_m"] < by_name["straight"]["distance_m"]
    assert by_name["learned"]["collided"] <= by_name["straight"]["collided"]


@pytest.mark.thorough
def test_the_commands(store, tmp_path, weights):
    small = [word for name, value in SMALL.items() for word in (f"--{name}", value)]
    done = call(tmp_path, "train", "traffic", "--store", store, "--out", "out", *map(str, small))
    assert "weights.npz" in done.stdout, done.stderr
    names = "--traffic", "learned", "--traffic", "constant-velocity"
    shown = call(tmp_path, "realism", store, *names, "--limit", "1")
    assert "constant-velocity" in shown.stdout
    own = "--weights", weights[0]
    told = call(tmp_path, "realism", store, *names, "--limit", "1", *own, "--json")
    assert [row["traffic"] for row in json.loads(told.stdout)] == ["recording", *names[1::2]]
    refused = call(tmp_path, "realism", store, *names, "--seconds", "30")
    assert "no scenario lasts 30 s; the longest lasts 7 s" in refused.stderr
