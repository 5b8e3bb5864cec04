"""Reading scenarios and maps from a store: pytest benchmarks/speed/test_store.py."""

from pathlib import Path

import numpy as np
import pytest

from shiftsim.data.nuplan.map import read_map
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store.map import read_map_file
from shiftsim.data.store.reading import ScenarioStore, open_store
from shiftsim.data.store.tables import map_file
from shiftsim.data.store.writing import StoreWriter
from shiftsim.world.state import Tracks, TrafficLights

ROWS, TRACKS = 520, 100  # 26 s at 20 Hz
GOLDEN = Path(__file__).resolve().parents[2] / "tests" / "golden" / "nuplan_format"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ScenarioStore:
    rng = np.random.default_rng(1)
    heading = np.cumsum(rng.normal(0, 0.02, (ROWS, TRACKS)), axis=0)
    speed = rng.uniform(0, 14, TRACKS) + rng.normal(0, 0.2, heading.shape)
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    start = np.array([587_000.0, 4_475_000.0]) + rng.uniform(-50, 50, (TRACKS, 2))
    poses = np.concatenate([start + np.cumsum(velocity * 0.05, 0), heading[..., None]], -1)
    sizes = np.broadcast_to(rng.uniform([3, 1.5], [5, 2.2], (TRACKS, 2)), (ROWS, TRACKS, 2)).copy()
    tokens = tuple(f"{i:016x}" for i in range(TRACKS))
    valid, kinds = np.ones((ROWS, TRACKS), np.bool_), np.zeros(TRACKS, np.int64)
    tracks = Tracks(valid, poses, velocity, sizes, kinds, tokens)
    times = np.arange(ROWS) * 50_000
    path = tmp_path_factory.mktemp("store")
    with StoreWriter(path) as writer:
        writer.add_map(read_map(GOLDEN / "maps" / "fixture-town" / "1.0.0" / "map.gpkg", "town"))
        writer.add_recording(Recording("log", "town", times, tracks, TrafficLights.empty(ROWS)))
        writer.add_ego(EgoTrace("log", "ego", 0, rng.normal(size=(ROWS, 11))))
        rows = np.arange(60, 361, 2)
        mapping = (15.0, 0.0, 0.5)
        writer.add_window(
            Window("a", "unknown", "log", "ego", 0, ROWS, rows, 2, ("1",), None, mapping)
        )
    return open_store(path)


def test_read_scenario_with_100_agents(benchmark, store):
    scene = benchmark(store.read, "a")
    assert scene.tracks.num_tracks == TRACKS


def test_read_map(benchmark, store):
    road = benchmark(read_map_file, map_file(store.path, "town"))
    assert len(road.edges) > 0
