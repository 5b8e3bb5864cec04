"""What is damaged, or could not be read, is named and not written."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recordings import TOKEN, make_recording, make_window, write_store

from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.data.store.check import check_store
from shiftsim.data.store.map import read_map_file, write_map
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.tracks import ego_states, open_ego, write_ego
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import DataError
from shiftsim.world.map import VectorMap
from shiftsim.world.state import TrafficLights


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
