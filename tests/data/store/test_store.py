"""The scenario store: what is written comes back to the last bit."""

import dataclasses
import hashlib
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from nuplan_logs import list_scenarios, read_scenario
from recordings import GOLDEN, LOG, TOKEN, make_recording, make_window, write_store

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.data.store import schema, tables
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.recordings import ego_span, ego_states, write_ego
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks, TrafficLights


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
    monkeypatch.setattr(
        tracks, "read", lambda blocks, **how: asked.append(blocks) or read(blocks, **how)
    )
    store.read("a")
    assert asked == [[2]]  # of four, which hold 500 rows each
    assert tracks.blocks(0, 2000) == [0, 1, 2, 3]


def test_windows_of_several_blocks_come_back_to_the_last_bit(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    recording = make_recording(1700, 7, rng)
    tracks = recording.tracks
    write_store(tmp_path / "s", road, recording, make_window("a", 400, 1500))
    stored = open_store(tmp_path / "s").recording("drive")
    assert stored.tracks.blocks(0, 1700) == [0, 1, 2]
    for first, last in ((0, 1700), (400, 1500), (566, 568), (1699, 1700)):
        part = stored.read(first, last).tracks
        kept = [tracks.tokens.index(token) for token in part.tokens]
        assert kept == np.flatnonzero(tracks.valid[first:last].any(axis=0)).tolist()
        for name in ("valid", "poses", "velocities", "sizes"):
            expected = getattr(tracks, name)[first:last, kept]
            np.testing.assert_array_equal(getattr(part, name), expected)


def test_an_ego_of_several_row_groups_comes_back_to_the_last_bit(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    states = rng.normal(size=(2 * schema.FRAME_BLOCK + 7, 11))
    write_ego(tmp_path, EgoTrace("drive", "ego", 40, states))
    table = tables.Table(tables.ego_file(tmp_path, "ego"), schema.EGO)
    assert ego_span(table) == (40, 40 + len(states))
    for first, last in ((0, len(states)), (2040, 2060), (2048, 2049), (4096, 4103)):
        part = ego_states(table, 40 + first, 40 + last)
        assert part.tobytes() == states[first:last].tobytes()
    with pytest.raises(DataError, match="no rows"):
        ego_states(table, 39, 60)


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


def test_pandas_polars_and_duckdb_read_the_files_as_they_are(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    duckdb, pandas, polars = map(pytest.importorskip, ("duckdb", "pandas", "polars"))
    recording = make_recording(700, 4, rng)
    write_store(tmp_path / "s", road, recording, make_window("a", 0, 700))
    path = tmp_path / "s" / "recordings" / "drive" / "tracks.parquet"
    found = pandas.read_parquet(path)
    assert len(found) == np.count_nonzero(recording.tracks.valid)
    tracks = recording.tracks
    for track, token in enumerate(tracks.tokens):
        own = found[found.token == token].sort_values("row")
        there = tracks.valid[:, track]
        assert (own.row == np.flatnonzero(there)).all()
        assert (own[["x_m", "y_m", "heading_rad"]] == tracks.poses[there, track]).all(axis=None)
        assert (own[["vx_mps", "vy_mps"]] == tracks.velocities[there, track]).all(axis=None)
    query = f"select row, track, x_m, length_m from '{path}' order by all"
    columns = ["row", "track", "x_m", "length_m"]
    expected = found[columns].sort_values(columns).to_numpy()
    assert np.array_equal(duckdb.sql(query).df().to_numpy(), expected)
    assert np.array_equal(
        polars.read_parquet(path, columns=columns).sort(columns).to_numpy(), expected
    )
    lights = pandas.read_parquet(path.with_name("lights.parquet"))
    assert (lights.status >= 0).all()
    assert len(lights) == np.count_nonzero(recording.lights.status >= 0)
