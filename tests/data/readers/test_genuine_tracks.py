"""Checks of velocities and sizes pass what genuine nuPlan logs have, and find wrong units in it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import places
import pyarrow as pa
import pytest
from track_files import write_tracks

from shiftsim.data.readers.motion import contradiction, fitted_velocities, track_ends
from shiftsim.data.readers.tracks.axes import Diagnostics, Fit, check_velocities
from shiftsim.data.readers.tracks.diagnostics import _check_jumps, _check_sizes
from shiftsim.data.readers.tracks.table import read_tracks
from shiftsim.data.store.check import _check_boxes
from shiftsim.verify.report import Report
from shiftsim.verify.simulation_log import read_simulation_log
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind

REAL_LOGS = places.REPOSITORY.parent / "shared" / "reference" / "nuplan_real_logs"
KINDS = {
    "VEHICLE": "car",
    "PEDESTRIAN": "pedestrian",
    "BICYCLE": "bicycle",
    "TRAFFIC_CONE": "traffic cone",
    "BARRIER": "barrier",
    "CZONE_SIGN": "sign",
    "GENERIC_OBJECT": "other",
}


def recorded_rows(path: Path) -> dict[str, np.ndarray]:
    """Objects of a simulation log, sorted by track and time; times in seconds."""
    log = read_simulation_log(path, Report())
    rows = {name: log.objects[name] for name in ("track_token", "iteration", "type")}
    rows |= {name: log.objects[name] for name in ("x", "y", "heading", "vx", "vy")}
    rows |= {name: log.objects[name] for name in ("length", "width")}
    time_us = log.ego["ego_time_us"]
    rows["time"] = (time_us[rows["iteration"]] - time_us[0]) * 1e-6
    order = np.lexsort((rows["time"], rows["track_token"]))
    return {name: values[order] for name, values in rows.items()}


def synthetic_rows(seed: int) -> dict[str, np.ndarray]:
    """80 tracks over 15 s at 10 Hz, as noisy as those that detectors make of genuine recordings.

    A third lives less than a second. Single velocities are up to 18 m/s away from the motion; of
    the tracks that were lost and found again soon, all velocities are wrong.
    """
    rng, parts = np.random.default_rng(seed), []
    for number in range(80):
        kind = rng.choice([*KINDS], p=[0.4, 0.2, 0.02, 0.08, 0.02, 0.02, 0.26])
        is_agent = kind in ("VEHICLE", "PEDESTRIAN", "BICYCLE")
        count = rng.integers(1, 10) if number % 3 == 0 else rng.integers(20, 150)
        first = rng.integers(0, 150 - count)
        time = 0.1 * (first + np.arange(count)) + rng.uniform(-1e-5, 1e-4, count)
        top = {"VEHICLE": 12.0, "PEDESTRIAN": 1.8, "BICYCLE": 6.0}.get(kind, 0.0)
        speed, heading = rng.uniform(0.0, top) * (rng.random() > 0.3), rng.uniform(-3.0, 3.0)
        way = np.array([np.cos(heading), np.sin(heading)])
        noise = rng.choice([0.005, 0.02, 0.05]) * (4.0 if count < 10 else 1.0)
        xy = rng.uniform(0.0, 80.0, 2) + (time - time[0])[:, None] * speed * way
        xy += rng.normal(0.0, noise, (count, 2))
        velocity = speed * way + rng.normal(0.0, 0.06, (count, 2))
        if is_agent and ((count < 10 and rng.random() < 0.5) or number % 17 == 1):
            velocity += rng.uniform(0.4, 1.5) * way[::-1]  # the filter has not settled, or stands
        if count > 20 and rng.random() < 0.3:
            velocity[rng.integers(count)] += rng.uniform(2.0, 18.0) * way
        length = rng.uniform(3.8, 15.1) if kind == "VEHICLE" else rng.uniform(0.1, 0.9)
        if kind == "VEHICLE" and rng.random() < 0.8:
            length = rng.uniform(4.2, 5.2)
        columns = {"track_token": f"{number:04d}", "type": kind, "heading": heading}
        columns |= {"length": length, "width": max(0.2, min(0.42 * length, 3.0))}
        columns |= dict(zip(("x", "y", "vx", "vy"), np.column_stack([xy, velocity]).T, strict=True))
        columns |= {"time": time, "iteration": first + np.arange(count)}
        parts.append({name: np.broadcast_to(value, count) for name, value in columns.items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def found_in_table(rows: Mapping[str, np.ndarray], folder: Path, scale: float = 1.0) -> Diagnostics:
    """What is wrong with the rows as a table of tracks, whose velocities are scaled."""
    columns = {"time_s": rows["time"], "track": rows["track_token"]}
    columns |= {"kind": np.array([KINDS[kind] for kind in rows["type"]])}
    columns |= {"x_m": rows["x"], "y_m": rows["y"], "heading_rad": rows["heading"]}
    columns |= {"vx_mps": rows["vx"] * scale, "vy_mps": rows["vy"] * scale}
    columns |= {"length_m": rows["length"], "width_m": rows["width"]}
    table, out = read_tracks(write_tracks(folder / "tracks.csv", columns)), Diagnostics()
    assert _check_jumps(table, out)
    _check_sizes(table, out)
    check_velocities(table, Fit(1.0, 1.0, is_good=True), out)
    return out


def found_in_store(rows: Mapping[str, np.ndarray], scale: float = 1.0) -> list[Any]:
    """What the check of a store finds in the rows, whose velocities are scaled."""
    _, track = np.unique(rows["track_token"], return_inverse=True)
    stamps = np.unique(rows["iteration"])
    boxes = {"row": np.searchsorted(stamps, rows["iteration"]), "track": track}
    boxes |= {"token": rows["track_token"]}
    boxes |= {"kind": np.array([int(AgentKind[kind]) for kind in rows["type"]])}
    boxes |= {"x_m": rows["x"], "y_m": rows["y"], "heading_rad": rows["heading"]}
    boxes |= {"vx_mps": rows["vx"] * scale, "vy_mps": rows["vy"] * scale}
    time_us = np.zeros(len(stamps), np.int64)
    time_us[boxes["row"]] = np.round(rows["time"] * 1e6).astype(np.int64)
    return [*_check_boxes(pa.table(boxes), time_us)]


def assert_passes_and_wrong_units_do_not(rows: Mapping[str, np.ndarray], folder: Path) -> None:
    found = found_in_table(rows, folder)
    assert (found.errors, found.warnings) == ([], [])
    assert found_in_store(rows) == []
    (problem,) = found_in_store(rows, scale=3.6)
    assert problem[0] == "velocity"
    assert "'kmh'" in str(found_in_table(rows, folder, scale=3.6).errors)


@pytest.mark.parametrize("seed", range(4))
def test_tracks_as_noisy_as_genuine_ones_pass(tmp_path: Path, seed: int) -> None:
    rows = synthetic_rows(seed)
    _, track = np.unique(rows["track_token"], return_inverse=True)
    xy = np.column_stack([rows["x"], rows["y"]])
    velocities = np.column_stack([rows["vx"], rows["vy"]])
    derived = fitted_velocities(xy, rows["time"], track, 0.1)
    error = np.hypot(*(velocities - derived).T)
    assert 0.03 < np.median(error) < 0.21
    assert 0.5 < np.percentile(error, 95) < 1.8
    assert 6.0 < error.max() < 19.0
    # some contradict throughout, of those that last a second, too
    wrong, _ = contradiction(velocities, derived, rows["time"], track)
    lasts = np.diff(track_ends(track)) > 10
    assert (wrong & lasts).any()
    assert (wrong & ~lasts).sum() > 3
    assert_passes_and_wrong_units_do_not(rows, tmp_path)


@pytest.mark.thorough
@pytest.mark.skipif(not REAL_LOGS.is_dir(), reason="needs the genuine logs")
def test_genuine_tracks_pass(tmp_path: Path) -> None:
    lengths = []
    for path in sorted(REAL_LOGS.glob("*.xz")):
        rows = recorded_rows(path)
        assert (np.array([AgentKind[kind] for kind in rows["type"]]) > LAST_AGENT_KIND).any()
        lengths += rows["length"].tolist()
        assert_passes_and_wrong_units_do_not(rows, tmp_path)
    assert min(lengths) < 0.11
    assert max(lengths) > 14.0
