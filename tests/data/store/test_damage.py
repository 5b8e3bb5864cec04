"""What is damaged, or could not be read, is named and not written."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from recordings import TOKEN, make_recording, make_window, write_store

from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.data.store import schema, tables
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.map import read_map_file, write_map
from shiftsim.data.store.reading import open_store
from shiftsim.data.store.recordings import ego_states, write_ego
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import DataError
from shiftsim.files import store_path
from shiftsim.world.map import VectorMap
from shiftsim.world.state import TrafficLights


def test_an_ego_that_lacks_a_row_is_named(tmp_path: Path) -> None:
    write_ego(tmp_path, EgoTrace("drive", "ego", 0, np.zeros((5, 11))))
    path = tmp_path / "ego-ego.parquet"
    table = pq.read_table(path)
    pq.write_table(pa.concat_tables([table.slice(0, 2), table.slice(3)]), path)
    with pytest.raises(DataError, match=r"ego-ego\.parquet: no rows 0 … 4"):
        ego_states(tables.Table(tables.ego_file(tmp_path, "ego"), schema.EGO), 0, 5)


@pytest.mark.parametrize("name", ["tracks", "lights", "frames"])
def test_a_file_of_others_without_statistics_is_read(
    name: str, tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    write_store(tmp_path / "s", road, make_recording(1200, 4, rng), make_window("a", 600, 700))
    before = open_store(tmp_path / "s").read("a")
    path = next((tmp_path / "s").rglob(f"{name}.parquet"))
    pq.write_table(pq.read_table(path), path, write_statistics=False, row_group_size=700)
    after = open_store(tmp_path / "s").read("a")
    assert np.array_equal(after.tracks.poses, before.tracks.poses, equal_nan=True)
    assert (after.traffic_lights.status == before.traffic_lights.status).all()
    assert (after.time_us == before.time_us).all()


def test_a_map_too_wide_for_its_grids_is_neither_written_nor_read(
    tmp_path: Path, road: VectorMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = np.array(road.crosswalks.polygons.xy)
    far[0] += 1e8
    flat = road.crosswalks.polygons._replace(xy=far)
    wide = dataclasses.replace(road, crosswalks=dataclasses.replace(road.crosswalks, polygons=flat))
    path = tmp_path / "wide.arrow"
    message = r"wide\.arrow: crosswalks:? 'extent'.* is beyond"
    with pytest.raises(DataError, match=message):
        write_map(path, wide)
    with monkeypatch.context() as patch:
        patch.setattr("shiftsim.data.store.map.require_sound", lambda *given: None)
        write_map(path, wide)
    with pytest.raises(DataError, match=message):
        read_map_file(path)


def test_a_sound_store_has_no_problems(store: Path) -> None:
    assert survey_store(store).problems == []


def test_check_finds_changed_missing_and_foreign_files(store: Path) -> None:
    tracks = next(store.rglob("tracks.parquet"))
    data = bytearray(tracks.read_bytes())
    data[100] ^= 1
    tracks.write_bytes(data)
    next(store.rglob("ego-*.parquet")).unlink()
    (store / "notes.txt").write_text("x")
    found = {problem.where.split("/")[-1]: problem for problem in survey_store(store).problems}
    assert set(found) == {"tracks.parquet", "ego-ego.parquet", "notes.txt"}
    assert not found["notes.txt"].is_error


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stores are written whatever is in them."""
    monkeypatch.setattr("shiftsim.data.store.recordings.require_ranges", lambda *given: None)
    monkeypatch.setattr("shiftsim.data.store.recordings._require", lambda *given: None)


@pytest.mark.usefixtures("unchecked")
def test_check_names_what_is_implausible(
    tmp_path: Path, road: VectorMap, rng: np.random.Generator
) -> None:
    recording = make_recording(100, 4, rng)
    recording.tracks.poses[50, 1] = np.nan
    recording.time_us[20] = recording.time_us[19]
    bad = dataclasses.replace(make_window("a", 0, 100), route=("1", "nowhere"))
    write_store(tmp_path / "s", road, recording, bad)
    found = " | ".join(problem.what for problem in survey_store(tmp_path / "s").problems)
    assert "time stamps do not increase" in found
    assert "pose is not finite" in found
    assert "'nowhere'" in found


def test_a_missing_store_and_an_unknown_token_are_named(store: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a scenario store"):
        open_store(tmp_path / "nothing")
    with pytest.raises(DataError, match="'abc'"):
        open_store(store).read("abc")


def test_an_unknown_map_is_named_with_those_there_are(store: Path) -> None:
    with pytest.raises(DataError, match="map 'junktion' is missing") as caught:
        open_store(store).map("junktion")
    assert caught.value.hint.startswith("there are: ")


def test_a_folder_here_that_is_no_store_is_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broke").mkdir()
    with pytest.raises(DataError, match=r"\./broke has no store.json either"):
        tables.read_manifest(store_path("broke"))


def test_a_table_of_scenarios_that_was_cut_is_refused(store: Path) -> None:
    path = store / "scenarios.parquet"
    pq.write_table(pq.read_table(path).slice(0, 0), path)
    with pytest.raises(DataError, match=r"scenarios\.parquet: the content is not what store\.json"):
        open_store(store)


def test_another_version_is_refused(store: Path) -> None:
    manifest = json.loads((store / "store.json").read_text())
    for version in (3, 99):
        (store / "store.json").write_text(json.dumps({**manifest, "version": version}))
        with pytest.raises(DataError, match=f"version {version}") as caught:
            open_store(store)
        assert f"python tools/upgrade.py {store}" in caught.value.hint


@pytest.mark.parametrize(
    "name",
    [
        "scenarios.parquet",
        "frames.parquet",
        "lights.parquet",
        "tracks.parquet",
        "ego-ego.parquet",
        "fixture-town.arrow",
    ],
)
@pytest.mark.parametrize("damage", ["missing", "truncated", "empty", "column", "null"])
def test_a_damaged_file_gives_one_error_that_names_it(name: str, damage: str, store: Path) -> None:
    path = next(store.rglob(name))
    DAMAGES[damage](path)
    with pytest.raises(DataError, match=name) as caught:
        open_store(store).read(TOKEN)
    assert caught.value.hint


def _rewritten(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    if path.suffix == ".parquet":
        pq.write_table(change(pq.read_table(path)), path)
        return
    table = change(pa.ipc.open_file(path.read_bytes()).read_all())
    with pa.ipc.new_file(str(path), table.schema) as writer:
        writer.write_table(table)


def _drop_column(table: pa.Table) -> pa.Table:
    return table.drop_columns([table.column_names[:2][-1]])


def _put_null(table: pa.Table) -> pa.Table:
    name = table.column_names[:2][-1]
    column = table[name]
    values = pa.array([*column.to_pylist()[:-1], None], column.type)
    return table.set_column(table.column_names.index(name), name, values)


DAMAGES = {
    "null": lambda path: _rewritten(path, _put_null),
    "missing": Path.unlink,
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "empty": lambda path: path.write_bytes(b""),
    "column": lambda path: _rewritten(path, _drop_column),
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
    what = f"tracks.parquet: token '.*', row 50: column '{column}': "
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
    "a light": (_spoil("status", (3, 1), 9), "connector '34', row 3: column 'status': 9 is beyond"),
    "a kind": (
        _spoil("kinds", 2, 7),
        "token '0000000000000002', row .*: column 'kind': 7 is beyond",
    ),
    "names": (
        lambda r: dataclasses.replace(r, tracks=dataclasses.replace(r.tracks, tokens=("a",))),
        "tracks.parquet: the arrays do not fit together",
    ),
    "lights": (
        lambda r: dataclasses.replace(r, lights=TrafficLights.empty(7)),
        "lights.parquet: the arrays do not fit together",
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
