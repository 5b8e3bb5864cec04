"""The scenario store: what is written comes back to the last bit."""

import dataclasses
import hashlib
import json
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import places
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recordings import GOLDEN, LOG, TOKEN, make_recording, make_window, write_store

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.scenarios import list_scenarios, read_scenario
from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.data.store import schema
from shiftsim.data.store.boxes import restored, second_differences
from shiftsim.data.store.plausible import BOX_LIMITS
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.tracks import ego_span, ego_states, open_ego, write_ego
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks, TrafficLights

VERSION_1, VERSION_2 = (places.GOLDEN / f"store_version_{number}" for number in (1, 2))


def assert_same(a: object, b: object, where: str = "") -> None:
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{where}.{field.name}")
    elif isinstance(a, np.ndarray):
        assert isinstance(b, np.ndarray)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), where
        assert a.flags.c_contiguous == b.flags.c_contiguous, where
        assert not a.flags.writeable, where
        assert not b.flags.writeable, where
    elif isinstance(a, tuple) and hasattr(a, "_fields"):
        for left, right in zip(a, b, strict=True):  # type: ignore[call-overload]
            assert_same(left, right, where)
    else:
        assert a == b, where


def digest(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def test_store_gives_the_scenario_that_the_log_gives(store: Path, road: VectorMap) -> None:
    direct = read_scenario(LOG, TOKEN, road, (10.0, 0.0, 0.5))
    expected = dataclasses.replace(direct, log_name="fixture_log_0001")
    assert_same(open_store(store).read(TOKEN), expected)


@pytest.mark.golden
def test_store_gives_what_the_logs_give_for_overlapping_windows(
    nuplan_reference: Path, tmp_path: Path
) -> None:
    log = nuplan_reference / "logs" / "s07_parked_in_lane.db"
    tokens = [entry.token for entry in list_scenarios(log)][::40]
    report = convert_nuplan(
        log, nuplan_reference / "maps", tmp_path / "s", tokens=tokens, mapping=(3.0, 0.0, 0.5)
    )
    assert sorted(report.converted) == sorted(tokens)
    opened = open_store(tmp_path / "s")
    assert len(list((tmp_path / "s" / "recordings").iterdir())) == 1
    for token in tokens:
        scene = opened.read(token)
        assert_same(scene, read_scenario(log, token, scene.map, (3.0, 0.0, 0.5)))


def test_equal_conversions_give_equal_bytes(store: Path, tmp_path: Path) -> None:
    convert_nuplan(LOG, GOLDEN / "maps", tmp_path / "b", tokens=[TOKEN], mapping=(10.0, 0.0, 0.5))
    names = sorted(p.relative_to(store) for p in store.rglob("*") if p.is_file())
    assert names == sorted(
        p.relative_to(tmp_path / "b") for p in (tmp_path / "b").rglob("*") if p.is_file()
    )
    assert all((store / n).read_bytes() == (tmp_path / "b" / n).read_bytes() for n in names)


def test_converting_again_changes_nothing(store: Path) -> None:
    before = {p: p.read_bytes() for p in store.rglob("*") if p.is_file()}
    report = convert_nuplan(LOG, GOLDEN / "maps", store, tokens=[TOKEN], mapping=(10.0, 0.0, 0.5))
    assert (report.unchanged, report.converted) == ([TOKEN], [])
    assert before == {p: p.read_bytes() for p in store.rglob("*") if p.is_file()}


def test_scenarios_are_added_to_a_store(store: Path) -> None:
    other = list_scenarios(LOG)[100].token
    before = open_store(store)
    convert_nuplan(LOG, GOLDEN / "maps", store, tokens=[other], mapping=(5.0, 0.0, 0.5))
    after = open_store(store)
    assert after.tokens == tuple(sorted([TOKEN, other]))
    assert after.hash != before.hash
    assert_same(after.read(TOKEN), before.read(TOKEN))


def test_a_token_that_no_log_offers_is_reported(store: Path) -> None:
    report = convert_nuplan(LOG, GOLDEN / "maps", store, tokens=["00000000000000ff"])
    assert "fixture_log_0001.db" in report.failed["00000000000000ff"]


def test_one_broken_scenario_stops_no_other(tmp_path: Path) -> None:
    log = Path(shutil.copy(LOG, tmp_path / "log.db"))
    connection = sqlite3.connect(log)
    connection.execute(
        "UPDATE ego_pose SET x = NULL WHERE token ="
        " (SELECT ego_pose_token FROM lidar_pc ORDER BY timestamp DESC LIMIT 1)"
    )
    connection.commit()
    connection.close()
    rows = [entry.token for entry in list_scenarios(log)]
    report = convert_nuplan(
        log, GOLDEN / "maps", tmp_path / "s", tokens=[rows[0], rows[200]], mapping=(2.0, 0.0, 0.5)
    )
    assert report.converted == [rows[0]]
    assert "not finite" in report.failed[rows[200]]


def test_windows_share_a_recording_and_leave_out_their_ego(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    recording = make_recording(300, 6, rng)
    ego = recording.tracks.tokens[1]
    write_store(
        tmp_path / "s",
        road,
        recording,
        make_window("a", 0, 200),
        make_window("b", 130, 300, ego),
    )
    store = open_store(tmp_path / "s")
    assert store.read("a").tracks.num_tracks >= 5
    late = store.read("b")
    assert ego not in late.tracks.tokens
    assert late.time_us[0] == 130 * 50_000
    assert late.iteration_rows[0] == 0
    kept = [recording.tracks.tokens.index(token) for token in late.tracks.tokens]
    np.testing.assert_array_equal(late.tracks.poses, recording.tracks.poses[130:300, kept])
    np.testing.assert_array_equal(late.tracks.sizes, recording.tracks.sizes[130:300, kept])


def test_eighteen_seconds_with_100_agents_fit_in_one_and_a_half_megabytes(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    recording = make_recording(360, 100, rng)
    recording.tracks.valid[:] = True
    for values in (recording.tracks.poses, recording.tracks.sizes):
        values[np.isnan(values)] = 0.1
    write_store(tmp_path / "s", road, recording, make_window("a", 0, 360))
    folder = tmp_path / "s" / "recordings" / "drive"
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 1_500_000


def test_a_window_reads_only_its_part_of_a_long_recording(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_store(tmp_path / "s", road, make_recording(2000, 3, rng), make_window("a", 1000, 1200))
    store = open_store(tmp_path / "s")
    asked: list[list[int]] = []
    tracks = store.recording("drive").tracks
    read = tracks.read
    monkeypatch.setattr(tracks, "read", lambda blocks: asked.append(blocks) or read(blocks))
    store.read("a")
    rows = store.recording("drive").block_rows
    assert 0.7 * schema.BLOCK_ROWS < rows < 1.5 * schema.BLOCK_ROWS
    assert asked == [[block] for block in range(1000 // rows, 1199 // rows + 1)]
    assert len(asked) < tracks.num_blocks


def test_windows_of_several_blocks_come_back_to_the_last_bit(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    recording = make_recording(1700, 7, rng)
    tracks = recording.tracks
    write_store(tmp_path / "s", road, recording, make_window("a", 400, 1500))
    stored = open_store(tmp_path / "s").recording("drive")
    assert stored.tracks.num_blocks == 3
    for first, last in ((0, 1700), (400, 1500), (566, 568), (1699, 1700)):
        part = stored.read(first, last).tracks
        kept = [tracks.tokens.index(token) for token in part.tokens]
        assert kept == np.flatnonzero(tracks.valid[first:last].any(axis=0)).tolist()
        for name in ("valid", "poses", "velocities", "sizes"):
            expected = getattr(tracks, name)[first:last, kept]
            np.testing.assert_array_equal(getattr(part, name), expected)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 1000])
def test_any_bits_come_back_from_their_second_differences(
    count: int, rng: np.random.Generator
) -> None:
    smooth = 4_475_000.0 + np.cumsum(rng.normal(0.5, 1e-4, count))
    odd = np.array([0.0, -0.0, np.nan, -np.nan, np.inf, -np.inf, 5e-324, 1.7e308])
    anything = np.concatenate([rng.integers(-(2**63), 2**63, count).view(np.float64), odd])
    for values in (smooth, -smooth, anything):
        codes = second_differences(values)
        assert restored(codes).tobytes() == values.tobytes()
    assert (second_differences(smooth)[2:] < 2**40).all()


def test_limits_of_motion_are_as_wide_to_both_sides() -> None:
    # `scatter` looks at sizes only
    assert (BOX_LIMITS[: len(schema.MOTION), 0] == -BOX_LIMITS[: len(schema.MOTION), 1]).all()


def test_an_ego_of_several_row_groups_comes_back_to_the_last_bit(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    states = rng.normal(size=(2 * schema.FRAME_BLOCK + 7, 11))
    write_ego(tmp_path, EgoTrace("drive", "ego", 40, states))
    table = open_ego(tmp_path, "ego")
    assert ego_span(table) == (40, 40 + len(states))
    for first, last in ((0, len(states)), (2040, 2060), (2048, 2049), (4096, 4103)):
        part = ego_states(table, 40 + first, 40 + last)
        assert part.tobytes() == states[first:last].tobytes()
    with pytest.raises(DataError, match="no rows"):
        ego_states(table, 39, 60)


@pytest.mark.golden
@pytest.mark.parametrize("folder", [VERSION_1, VERSION_2])
def test_stores_of_earlier_versions_are_read(folder: Path) -> None:
    expected = json.loads((VERSION_1 / "expected.json").read_text("utf-8"))
    store = open_store(folder / "store")
    found: dict[str, object] = {}
    for scene in store:
        parts = {name: getattr(scene, name) for name in ("time_us", "ego")}
        for name in ("valid", "poses", "velocities", "sizes", "kinds"):
            parts[name] = getattr(scene.tracks, name)
        parts["lights"] = scene.traffic_lights.status
        found |= {f"{scene.token} {name}": digest(array) for name, array in parts.items()}
        found[f"{scene.token} tokens"] = list(scene.tracks.tokens)
    road = store.map("fixture-town")
    arrays = {"edges": road.edges.polygons.xy, "cells": road.edges.polygons.cell_items}
    arrays |= {"baselines": road.baselines.xy, "outgoing": road.outgoing.items}
    found |= {name: digest(array) for name, array in arrays.items()}
    found["ids"] = list(road.edges.ids[:3])
    assert found == expected


@pytest.mark.golden
@pytest.mark.parametrize("folder", [VERSION_1, VERSION_2])
def test_a_store_of_an_earlier_version_is_added_to(
    folder: Path, tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    path = Path(shutil.copytree(folder / "store", tmp_path / "s"))
    before = open_store(path).read("a")
    recording = dataclasses.replace(make_recording(150, 3, rng), log_name="late")
    with StoreWriter(path) as writer:
        writer.add_map(road)
        writer.add_recording(recording)
        writer.add_ego(EgoTrace("late", "ego", 0, np.full((150, 11), 0.25)))
        writer.add_window(dataclasses.replace(make_window("c", 0, 150), log_name="late"))
    assert json.loads((path / "store.json").read_text("utf-8"))["version"] == schema.VERSION
    after = open_store(path)
    assert_same(after.read("a"), before)
    assert after.read("c").tracks.num_tracks == 3


def test_an_empty_recording_is_fine(tmp_path: Path, road: VectorMap) -> None:
    recording = Recording(
        "drive", "fixture-town", np.arange(50) * 50_000, Tracks.empty(50), TrafficLights.empty(50)
    )
    write_store(tmp_path / "s", road, recording, make_window("a", 0, 50))
    scene = open_store(tmp_path / "s").read("a")
    assert scene.tracks.num_tracks == 0
    assert scene.traffic_lights.status.shape == (50, 0)


def test_a_map_is_read_once_per_store(store: Path) -> None:
    opened = open_store(store)
    assert opened.read(TOKEN).map is opened.map("fixture-town")


def test_columns_carry_their_units(store: Path) -> None:
    tracks = pq.read_schema(next(store.rglob("tracks.parquet")))
    assert {"x_m_diff2", "heading_rad_diff2", "vx_mps_diff2", "length_m"} <= set(tracks.names)
    assert pa.types.is_float64(tracks.field("length_m").type)
