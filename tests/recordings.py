"""Recordings whose tracks wander, in stores of their own; and a log of nuPlan's format."""

from pathlib import Path

import numpy as np
import places

from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store.recordings import ego_table, frames_table, lights_table, tracks_table
from shiftsim.data.store.tables import require_ranges
from shiftsim.data.store.writing import StoreWriter
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks, TrafficLights

GOLDEN = places.GOLDEN / "nuplan_format"
LOG = GOLDEN / "logs" / "fixture_log_0001.db"
TOKEN = "000000012a05f23c"


def make_recording(num_rows: int, num_tracks: int, rng: np.random.Generator) -> Recording:
    """Tracks that wander near UTM coordinates; each is absent for a while."""
    heading = np.cumsum(rng.normal(0, 0.02, (num_rows, num_tracks)), axis=0)
    speed = rng.uniform(0, 14, num_tracks) + rng.normal(0, 0.2, heading.shape)
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    start = np.array([587_000.0, 4_475_000.0]) + rng.uniform(-50, 50, (num_tracks, 2))
    poses = np.concatenate([start + np.cumsum(velocity * 0.05, 0), heading[..., None]], -1)
    size = rng.uniform([3.0, 1.5], [5.0, 2.2], (num_tracks, 2))
    sizes = np.broadcast_to(size, (num_rows, num_tracks, 2)).copy()
    valid = np.ones((num_rows, num_tracks), np.bool_)
    for track in range(0, num_tracks, 3):
        valid[: int(rng.integers(0, num_rows)), track] = False
    for values in (poses, velocity, sizes):
        values[~valid] = np.nan
    tokens = tuple(f"{i:016x}" for i in range(num_tracks))
    tracks = Tracks(valid, poses, velocity, sizes, np.zeros(num_tracks, np.int64), tokens)
    lights = TrafficLights(("38", "34"), rng.integers(-1, 4, (num_rows, 2)).astype(np.int8))
    return Recording("drive", "fixture-town", np.arange(num_rows) * 50_000, tracks, lights)


def make_window(token: str, first: int, last: int, ego: str = "ego") -> Window:
    return Window(
        token=token,
        scenario_type="unknown",
        log_name="drive",
        ego=ego,
        first_row=first,
        last_row=last,
        iteration_rows=np.arange(first, last, 2),
        row_step=2,
        route=("1", "31"),
        mission_goal=None,
        mapping=(10.0, 0.0, 0.5),
        metadata={"note": "x"},
    )


def write_store(path: Path, road: VectorMap, recording: Recording, *windows: Window) -> None:
    num_rows = len(recording.time_us)
    with StoreWriter(path) as writer:
        writer.add_map(road)
        writer.add_recording(recording)
        for name in sorted({window.ego for window in windows}):
            writer.add_ego(EgoTrace("drive", name, 0, np.full((num_rows, 11), 0.25)))
        for window in windows:
            writer.add_window(window)


def require_plausible(scene: Scenario) -> None:
    """Refuse a scenario with a number outside of the ranges of a store."""
    rows = slice(0, len(scene.time_us))
    for table in (
        frames_table(scene.time_us),
        lights_table(scene.traffic_lights, rows),
        tracks_table(scene.tracks, rows),
        ego_table(scene.ego, 0),
    ):
        require_ranges(table, f"scenario {scene.token}")


def driving(*objects: tuple[float, ...], hz: int = 10) -> TrackSamples:
    """Objects along +x on the road: first and last time [s], x at time 0, y, speed."""
    parts = []
    for number, (first, last, x, y, speed) in enumerate(objects):
        time = np.arange(round(first * hz), round(last * hz) + 1) / hz
        parts.append(
            np.column_stack([np.full(len(time), number), time, x + speed * time, 0 * time])
        )
        parts[-1][:, 3] = y
    rows = np.concatenate(parts)
    return make_samples(
        "r",
        time_us=5_000_000 + np.rint(rows[:, 1] * 1e6).astype(np.int64),
        ids=rows[:, 0].astype(np.int64),
        category=np.zeros(len(rows), np.int64),
        xy=rows[:, 2:],
        headings=np.zeros(len(rows)),
    )
