"""The scenario store: what is written comes back to the last bit, and damage is named."""

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

from shiftsim.data.nuplan.convert import convert_nuplan
from shiftsim.data.nuplan.map import read_map
from shiftsim.data.nuplan.scenarios import list_scenarios, read_scenario
from shiftsim.data.recording import EgoTrace, Recording, Window
from shiftsim.data.store import schema
from shiftsim.data.store.boxes import restored, second_differences
from shiftsim.data.store.check import check_store
from shiftsim.data.store.map import read_map_file, write_map
from shiftsim.data.store.plausible import BOX_LIMITS
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.tracks import ego_span, ego_states, open_ego, write_ego
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks, TrafficLights

GOLDEN = places.GOLDEN / "nuplan_format"
LOG = GOLDEN / "logs" / "fixture_log_0001.db"
TOKEN = "000000012a05f23c"
VERSION_1, VERSION_2 = (places.GOLDEN / f"store_version_{number}" for number in (1, 2))


@pytest.fixture(scope="module")
def road() -> VectorMap:
    return read_map(GOLDEN / "maps" / "fixture-town" / "1.0.0" / "map.gpkg", "fixture-town")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "store"
    convert_nuplan(LOG, GOLDEN / "maps", path, tokens=[TOKEN], mapping=(10.0, 0.0, 0.5))
    return path


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


@pytest.mark.parametrize("count", [10, 22])
def test_a_row_group_without_whole_states_is_named(count: int, tmp_path: Path) -> None:
    write_ego(tmp_path, EgoTrace("drive", "ego", 0, np.zeros((3, 11))))
    path = tmp_path / "ego-ego.parquet"
    file = pq.ParquetFile(path)
    table = file.read().replace_schema_metadata(file.metadata.metadata)
    with pq.ParquetWriter(path, table.schema) as writer:
        for part in (table.slice(0, count), table.slice(count)):
            writer.write_table(part)
    with pytest.raises(DataError, match=r"ego-ego\.parquet: .*(whole states|too short)"):
        ego_states(open_ego(tmp_path, "ego"), 0, 3)


def test_boxes_of_a_track_that_is_none_are_refused(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    write_store(tmp_path / "s", road, make_recording(100, 4, rng), make_window("a", 0, 100))
    path = next((tmp_path / "s").rglob("tracks.parquet"))
    file = pq.ParquetFile(path)
    table = file.read().replace_schema_metadata(file.metadata.metadata)
    for wrong in (-1, 4):
        track = np.array(table["track"]).copy()
        track[20] = wrong
        at = table.column_names.index("track")
        pq.write_table(table.set_column(at, "track", pa.array(track)), path)
        with pytest.raises(DataError, match=r"tracks\.parquet: column 'track' names an unknown"):
            open_store(tmp_path / "s").read("a")


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


def test_a_map_too_wide_for_its_grids_is_neither_written_nor_read(
    tmp_path: Path, road: VectorMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = np.array(road.crosswalks.polygons.xy)
    far[0] += 1e8
    flat = road.crosswalks.polygons._replace(xy=far)
    wide = dataclasses.replace(road, crosswalks=dataclasses.replace(road.crosswalks, polygons=flat))
    path = tmp_path / "wide.parquet"
    message = r"wide\.parquet: crosswalks:? 'extent'.* is beyond"
    with pytest.raises(DataError, match=message):
        write_map(path, wide)
    monkeypatch.setattr("shiftsim.data.store.map.require_sound", lambda *given: None)
    write_map(path, wide)
    with pytest.raises(DataError, match=message):
        read_map_file(path)


def test_a_map_whose_grid_would_fill_the_memory_is_refused(tmp_path: Path, road: VectorMap) -> None:
    count = len(road.crosswalks)
    square = np.tile([[0.0, 0.0], [1e5, 0.0], [1e5, 1e5], [0.0, 1e5]], (count, 1))
    flat = road.crosswalks.polygons
    whole = flat._replace(
        xy=square,
        ring_ptr=np.arange(count + 1) * 4,
        poly_ptr=np.arange(count + 1),
        bounds=np.tile([0.0, 0.0, 1e5, 1e5], (count, 1)),
    )
    wide = dataclasses.replace(road.crosswalks, polygons=whole)
    path = tmp_path / "m.parquet"
    write_map(path, dataclasses.replace(road, crosswalks=wide))
    assert read_map_file(path).crosswalks.polygons.shape.tolist() == [1563, 1563]
    many = dataclasses.replace(
        wide,
        ids=tuple(map(str, range(100))),
        polygons=whole._replace(
            xy=np.tile(square[:4], (100, 1)),
            ring_ptr=np.arange(101) * 4,
            poly_ptr=np.arange(101),
            bounds=np.tile([0.0, 0.0, 1e5, 1e5], (100, 1)),
        ),
    )
    write_map(path, dataclasses.replace(road, crosswalks=many))
    with pytest.raises(DataError, match=r"m\.parquet: .* too many polygons cover too much"):
        read_map_file(path)


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


def test_a_sound_store_has_no_problems(store: Path) -> None:
    assert check_store(store) == []


def test_check_finds_changed_missing_and_foreign_files(store: Path) -> None:
    tracks = next(store.rglob("tracks.parquet"))
    data = bytearray(tracks.read_bytes())
    data[100] ^= 1
    tracks.write_bytes(data)
    next(store.rglob("ego-*.parquet")).unlink()
    (store / "notes.txt").write_text("x")
    found = {problem.where.split("/")[-1]: problem for problem in check_store(store)}
    assert set(found) == {"tracks.parquet", "ego-ego.parquet", "notes.txt"}
    assert not found["notes.txt"].is_error


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stores are written whatever is in them."""
    monkeypatch.setattr("shiftsim.data.store.tracks.require_recording", lambda *given: None)


@pytest.mark.usefixtures("unchecked")
def test_check_names_what_is_implausible(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    recording = make_recording(100, 4, rng)
    recording.tracks.poses[50, 1] = np.nan
    recording.time_us[20] = recording.time_us[19]
    bad = dataclasses.replace(make_window("a", 0, 100), route=("1", "nowhere"))
    write_store(tmp_path / "s", road, recording, bad)
    found = " | ".join(problem.what for problem in check_store(tmp_path / "s"))
    assert "time stamps do not increase" in found
    assert "pose is not finite" in found
    assert "'nowhere'" in found


def test_a_missing_store_and_an_unknown_token_are_named(store: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a scenario store"):
        open_store(tmp_path / "nothing")
    with pytest.raises(DataError, match="'abc'"):
        open_store(store).read("abc")


def test_another_version_is_refused(store: Path) -> None:
    manifest = json.loads((store / "store.json").read_text())
    (store / "store.json").write_text(json.dumps({**manifest, "version": 99}))
    with pytest.raises(DataError, match="version 99") as caught:
        open_store(store)
    assert "convert" in caught.value.hint


@pytest.mark.parametrize(
    "name",
    [
        "scenarios.parquet",
        "frames.parquet",
        "tracks.parquet",
        "ego-ego.parquet",
        "fixture-town.parquet",
    ],
)
@pytest.mark.parametrize("damage", ["missing", "truncated", "empty", "column", "null"])
def test_a_damaged_file_gives_one_error_that_names_it(name: str, damage: str, store: Path) -> None:
    path = next(store.rglob(name))
    DAMAGES[damage](path)
    with pytest.raises(DataError, match=name) as caught:
        open_store(store).read(TOKEN)
    assert caught.value.hint


def _drop_column(path: Path) -> None:
    file = pq.ParquetFile(path)
    table = file.read()
    notes = file.metadata.metadata
    table = table.drop_columns([table.column_names[:2][-1]]).replace_schema_metadata(notes)
    pq.write_table(table, path)


def _put_null(path: Path) -> None:
    file = pq.ParquetFile(path)
    table = file.read()
    name = table.column_names[:2][-1]
    column = table[name]
    values = pa.array([*column.to_pylist()[:-1], None], column.type)
    table = table.set_column(table.column_names.index(name), name, values)
    pq.write_table(table.replace_schema_metadata(file.metadata.metadata), path)


DAMAGES = {
    "null": _put_null,
    "missing": Path.unlink,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "column": _drop_column,
}


def test_a_name_that_no_file_can_have_is_a_missing_map(store: Path) -> None:
    with pytest.raises(DataError, match="is missing"):
        open_store(store).map("a" * 300)


def test_a_foreign_folder_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "x").write_text("mine")
    with pytest.raises(DataError, match="not empty"):
        StoreWriter(tmp_path)


def test_a_window_without_its_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not have"), StoreWriter(tmp_path / "s") as writer:
        writer.add_window(make_window("a", 0, 50))
    assert not (tmp_path / "s" / "store.json").exists()


def test_columns_carry_their_units(store: Path) -> None:
    tracks = pq.read_schema(next(store.rglob("tracks.parquet")))
    assert {"x_m_diff2", "heading_rad_diff2", "vx_mps_diff2", "length_m"} <= set(tracks.names)
    assert pa.types.is_float64(tracks.field("length_m").type)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("part", "axis", "column"),
    [
        *(("poses", axis, name) for axis, name in enumerate(("x_m", "y_m", "heading_rad"))),
        *(("velocities", axis, name) for axis, name in enumerate(("vx_mps", "vy_mps"))),
        *(("sizes", axis, name) for axis, name in enumerate(("length_m", "width_m"))),
    ],
)
@pytest.mark.parametrize("value", [1e300, -np.inf])
def test_an_implausible_number_names_file_track_and_column(
    part: str,
    axis: int,
    column: str,
    value: float,
    tmp_path: Path,
    road: VectorMap,
    rng: np.random.Generator,
) -> None:
    recording = make_recording(100, 4, rng)
    recording.tracks.valid[50, 1] = True
    getattr(recording.tracks, part)[50, 1, axis] = value
    write_store(tmp_path / "s", road, recording, make_window("a", 0, 100))
    what = f"tracks.parquet: track '.*', row 50: column '{column}': "
    with pytest.raises(DataError, match=what):
        open_store(tmp_path / "s").read("a")


def _spoil(name: str, index: object, value: object):
    def spoil(recording: Recording) -> Recording:
        recording.tracks.valid[50, 1] = True
        part = recording if name == "time_us" else recording.tracks
        array = recording.lights.status if name == "status" else getattr(part, name)
        array[index] = value
        return recording

    return spoil


UNWRITABLE = {
    "a pose": (_spoil("poses", (50, 1, 2), np.nan), "row 50: column 'heading_rad': nan is not"),
    "a size": (_spoil("sizes", (50, 1), 0.0), "row 50: column 'length_m': 0 is beyond 1e-09"),
    "a speed": (_spoil("velocities", (50, 1), 1e7), "column 'vx_mps'"),
    "time": (_spoil("time_us", 20, 18 * 50_000), "frames.parquet: column 'time_us' does not incr"),
    "an age": (_spoil("time_us", 99, 2**60), r"'time_us', row 99: 1.152921505e\+18 is beyond"),
    "a light": (_spoil("status", (3, 1), 9), "'light_status', row 3: 9 is beyond"),
    "a kind": (_spoil("kinds", 2, 7), "'kinds', row 2: 7 is beyond"),
    "names": (
        lambda r: dataclasses.replace(r, tracks=dataclasses.replace(r.tracks, tokens=("a",))),
        "tracks.parquet: the arrays do not fit together",
    ),
    "lights": (
        lambda r: dataclasses.replace(r, lights=TrafficLights.empty(7)),
        "frames.parquet: column: the arrays do not fit together",
    ),
    "poses": (
        lambda r: dataclasses.replace(
            r, tracks=dataclasses.replace(r.tracks, poses=r.tracks.poses[:, :2])
        ),
        "the arrays do not fit together",
    ),
}


@pytest.mark.parametrize("case", UNWRITABLE)
def test_what_could_not_be_read_is_not_written(
    case: str, tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    spoil, message = UNWRITABLE[case]
    recording = spoil(make_recording(100, 4, rng))
    with pytest.raises(DataError, match=message) as caught:
        write_store(tmp_path / "s", road, recording, make_window("a", 0, 100))
    assert caught.value.hint == "correct what is given; it is not written"
    assert not (tmp_path / "s/recordings").exists()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mission_goal": np.array([0.0, np.inf, 0.0])}, "scenario 'a': column 'goal_pose', row 1"),
        ({"mission_goal": np.zeros(2)}, "'goal_pose' holds no pose"),
        ({"mapping": (10.0, 0.0, 0.0)}, "'subsample_ratio', row 0: 0 is beyond"),
        ({"row_step": 0}, "'row_step', row 0: 0 is beyond"),
        ({"iteration_rows": np.array([4, 4])}, "iteration_rows do not increase"),
        ({"iteration_rows": np.array([90, 100])}, "iteration_rows do not increase within"),
    ],
)
def test_a_window_that_could_not_be_read_is_not_written(
    changes: dict, message: str, tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    window = dataclasses.replace(make_window("a", 0, 100), **changes)
    with pytest.raises(DataError, match=message):
        write_store(tmp_path / "s", road, make_recording(100, 4, rng), window)


def test_an_ego_and_a_map_that_could_not_be_read_are_not_written(
    tmp_path: Path, road: VectorMap
) -> None:
    states = np.zeros((9, 11))
    states[4, 7] = np.nan
    far = dataclasses.replace(road, speed_limits=np.full(len(road.edges), 1e9))
    with StoreWriter(tmp_path / "s") as writer:
        with pytest.raises(DataError, match="column 'steering_angle_rad', row 4: nan"):
            writer.add_ego(EgoTrace("drive", "ego", 0, states))
        with pytest.raises(DataError, match=r"ego-ego\.parquet: the arrays do not fit"):
            writer.add_ego(EgoTrace("drive", "ego", 0, states[:, :3]))
        with pytest.raises(DataError, match="'speed_limits', row 0: 1000000000 is beyond"):
            writer.add_map(far)
    assert not list((tmp_path / "s").rglob("*ego*"))
