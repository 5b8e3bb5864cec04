"""Tables of tracks become the scenarios that the same recording in the layout of DSC3D becomes."""

import json
import re

import numpy as np
import pyarrow as pa
import pyarrow.csv as pc
import pyarrow.parquet as pq
import pytest
from track_files import export_town, write_tracks

from shiftsim.cli import main
from shiftsim.data.maps.build import build_lane_map
from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.segments import LanePiece, MapSource
from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.readers.motion import fitted_velocities
from shiftsim.data.readers.scenarios import make_scenarios
from shiftsim.data.readers.tracks.reader import TracksReader, convert_tracks
from shiftsim.data.readers.tracks.table import read_tracks
from shiftsim.data.store.check import survey_store
from shiftsim.data.store.reading import open_store
from shiftsim.errors import ConfigError, ConversionError

TOWN = "roundabout"


@pytest.fixture(scope="module")
def towns(tmp_path_factory):
    return tmp_path_factory.mktemp("towns")


@pytest.fixture(scope="module")
def town(towns):
    return export_town(towns, TOWN)


@pytest.fixture(scope="module")
def road(town):
    return build_road_map(read_opendrive(town[1]), name=TOWN)[0]


def _windows(made):
    """Egos and rows of all scenarios; tokens also tell the name of the recording."""
    return [(w.ego, w.first_row, w.last_row, w.route) for w in made.windows]


def _samples(columns, **changed):
    c = {**columns, **changed}
    names = sorted(set(c["kind"].tolist()))
    return make_samples(
        "t",
        time_us=np.rint(c["time_s"] * 1e6).astype(np.int64),
        ids=c["track"],
        category=np.searchsorted(names, c["kind"]),
        categories=names,
        xy=np.column_stack([c["x_m"], c["y_m"]]),
        headings=c["heading_rad"],
        velocities=np.column_stack([c["vx_mps"], c["vy_mps"]]),
        sizes=np.column_stack([c["length_m"], c["width_m"]]),
    )


def test_a_table_gives_the_scenarios_of_the_same_recording_in_dsc3d(towns, town, tmp_path):
    table = write_tracks(tmp_path / "t.csv", town[0])
    report = convert_tracks(TracksReader(table, town[1], city=TOWN), tmp_path / "own")
    convert_dsc3d(towns / TOWN, tmp_path / "theirs", site=TOWN)
    own, theirs = open_store(tmp_path / "own"), open_store(tmp_path / "theirs")
    assert report.accepted == len(own) == len(theirs) > 0

    def by_place(store):
        return {(w.ego, w.first_row): t for t in store.tokens for w in [store.window(t)]}

    pairs = by_place(own), by_place(theirs)
    assert set(pairs[0]) == set(pairs[1])
    for place, token in pairs[0].items():
        a, b = own.read(token), theirs.read(pairs[1][place])
        assert (a.route, a.tracks.tokens) == (b.route, b.tracks.tokens)
        np.testing.assert_allclose(a.ego[:, 2:], b.ego[:, 2:], rtol=0, atol=1e-7)
        shift = b.ego[0, :2] - a.ego[0, :2]
        np.testing.assert_allclose(a.ego[:, :2] + shift, b.ego[:, :2], rtol=0, atol=1e-6)
    found = {problem.what for problem in survey_store(tmp_path / "own").problems}
    assert found == {"the route has 1 roadblock, IDM and PDM planners need at least 2"}


def test_the_order_of_rows_and_the_first_number_of_frames_do_not_matter(town, road, rng):
    columns = town[0]
    expected = make_scenarios(_samples(columns), road)
    order = rng.permutation(len(columns["track"]))
    mixed = {name: values[order] for name, values in columns.items()}
    mixed["time_s"] = mixed["time_s"] + 80.0
    made = make_scenarios(_samples(mixed), road)
    assert _windows(made) == _windows(expected)
    np.testing.assert_array_equal(made.recording.tracks.poses, expected.recording.tracks.poses)


def test_a_named_ego_is_taken_for_its_own_time(town, road):
    columns = town[0]
    samples = _samples(columns)
    ego = make_scenarios(samples, road).windows[-1].ego
    made = make_scenarios(samples, road, egos=[ego])
    own = columns["time_s"][columns["track"] == int(ego)]
    assert {window.ego for window in made.windows} == {ego}
    first = made.windows[0]
    assert first.first_row * 0.05 == pytest.approx(own.min(), abs=0.05)
    assert first.last_row * 0.05 <= own.max() + 0.1
    absent = str(columns["track"].max() + 1)
    with pytest.raises(ConfigError, match=f"no object has the id '{absent}'"):
        make_scenarios(samples, road, egos=[absent])


def test_a_short_recording_is_one_window_with_two_seconds_of_history(town, road):
    columns = town[0]
    kept = (columns["time_s"] >= 4.0) & (columns["time_s"] <= 13.0)
    made = make_scenarios(_samples({n: v[kept] for n, v in columns.items()}), road, left_out_s=0.5)
    assert made.windows
    for window in made.windows:
        assert (window.first_row, window.iteration_rows[0]) == (0, 40)
        assert window.last_row == 170  # 8.96 s - 0.5 s
        assert window.is_short


def test_objects_with_times_of_their_own_are_put_on_common_rows(town, road):
    columns = town[0]
    late = columns["time_s"] + 0.0007 * columns["track"]
    samples = _samples(columns, time_s=late)
    assert samples.period == 0.05
    assert (np.diff(samples.clock) > 0.049).all()
    expected = _samples(columns)
    np.testing.assert_array_equal(samples.track_ids, expected.track_ids)
    assert make_scenarios(samples, road).windows


def test_a_hole_in_the_recording_leaves_no_scenario_across_it(town, road):
    columns = {n: v[town[0]["time_s"] < 30.0] for n, v in town[0].items()}
    assert make_scenarios(_samples(columns), road).windows
    kept = (columns["time_s"] < 10.0) | (columns["time_s"] > 14.0)
    made = make_scenarios(_samples({n: v[kept] for n, v in columns.items()}), road)
    assert made.windows == ()
    assert made.summary.rejected["presence"] > 0


def test_velocities_and_headings_that_are_not_given_follow_from_the_places(town):
    columns = town[0]
    samples = _samples(columns)
    table = {n: v for n, v in columns.items() if n not in ("vx_mps", "vy_mps", "heading_rad")}
    names = sorted(set(columns["kind"].tolist()))
    bare = make_samples(
        "t",
        time_us=np.rint(table["time_s"] * 1e6).astype(np.int64),
        ids=table["track"],
        category=np.searchsorted(names, table["kind"]),
        categories=names,
        xy=np.column_stack([table["x_m"], table["y_m"]]),
    )
    error = np.hypot(*(bare.velocities - samples.velocities).T)
    assert np.percentile(error, 95) < 0.1
    moving = np.hypot(*samples.velocities.T) > 2.0
    turn = np.angle(np.exp(1j * (bare.headings - samples.headings)[moving]))
    assert np.percentile(np.abs(turn), 95) < 0.05
    assert bare.warnings["tracks without size (that of their kind)"] == len(bare.track_ids)


def test_a_track_with_an_impossible_velocity_gets_that_of_its_places(town):
    fast = town[0]["vx_mps"].copy()
    fast[100] = 1e30
    samples, before = _samples(town[0], vx_mps=fast), _samples(town[0])
    assert np.abs(samples.velocities).max() < 60.0
    assert samples.warnings["tracks whose stored velocity does not fit (derived)"] == 1
    same = samples.track != samples.track_ids.tolist().index(town[0]["track"][100])
    np.testing.assert_array_equal(samples.velocities[same], before.velocities[same])


@pytest.mark.parametrize("hz", [2.0, 4.0, 10.0, 12.5, 29.97, 100.0])
def test_fitted_velocities_of_a_parabola_are_exact(hz):
    time = np.arange(round(3 * hz)) / hz
    xy = np.column_stack([3.0 * time + 0.5 * time**2, 7.0 - 2.0 * time])
    expected = np.column_stack([3.0 + time, np.full_like(time, -2.0)])
    inner = slice(1, -1) if hz <= 4 else slice(None)  # two rows tell a line only
    found = fitted_velocities(xy, time, np.zeros(len(time), np.int64), 1 / hz)
    np.testing.assert_allclose(found[inner], expected[inner], rtol=0, atol=1e-9)


def test_arrays_of_headings_in_degrees_are_refused(town):
    heading, first = town[0]["heading_rad"], town[0]["track"] == town[0]["track"][0]
    degrees = np.where(first, np.rad2deg(heading) + 30.0, heading)
    with pytest.raises(
        ConversionError, match=r"t: .* headings are beyond 2 pi rad, such as .* of"
    ) as e:
        _samples(town[0], heading_rad=degrees)
    assert "np.deg2rad" in e.value.hint


def test_arrays_of_negative_sizes_are_refused(town):
    width = town[0]["width_m"].copy()
    width[7] = -1.0
    with pytest.raises(
        ConversionError, match="t: 1 values of size are negative, the first in row 7"
    ):
        _samples(town[0], width_m=width)


def test_two_rows_of_an_object_at_one_time_are_refused(town):
    twice = {name: np.r_[values, values[:1]] for name, values in town[0].items()}
    with pytest.raises(ConversionError, match="has two rows at"):
        _samples(twice)


def test_parquet_and_other_delimiters_give_the_same_table(town, tmp_path):
    expected = read_tracks(write_tracks(tmp_path / "t.csv", town[0]))
    pq.write_table(pa.table(town[0]), tmp_path / "t.parquet")
    semicolon = pc.WriteOptions(delimiter=";")
    pc.write_csv(pa.table(town[0]), tmp_path / "s.csv", write_options=semicolon)
    for name in ("t.parquet", "s.csv"):
        found = read_tracks(tmp_path / name)
        np.testing.assert_array_equal(found.xy, expected.xy)
        np.testing.assert_array_equal(found.time_us, expected.time_us)
        assert found.categories == expected.categories


def test_two_files_are_one_table_also_where_ids_are_texts_in_one(town, tmp_path):
    half = len(town[0]["track"]) // 2
    first, second = (
        {n: v[part] for n, v in town[0].items()} for part in (slice(half), slice(half, None))
    )
    second["track"] = np.array([f"p{number}" for number in second["track"]])
    paths = [write_tracks(tmp_path / name, c) for name, c in (("a.csv", first), ("b.csv", second))]
    found = read_tracks(paths)
    assert len(found.xy) == len(town[0]["track"])
    ids = {*map(str, first["track"]), *second["track"]}
    assert {str(name) for name in found.track_ids} == ids


def test_recordings_that_share_ids_are_refused_and_one_is_not(town, tmp_path):
    case, path = np.zeros(len(town[0]["track"]), int), tmp_path / "t.csv"
    assert len(read_tracks(write_tracks(path, town[0], case_id=case)).xy) == len(case)
    case[5] = 1
    with pytest.raises(ConversionError, match="'case_id' tells 2 recordings apart"):
        read_tracks(write_tracks(path, town[0], case_id=case))


def test_the_corner_with_the_least_numbers_is_half_a_size_from_the_middle(town, tmp_path):
    c = town[0]
    half = 0.5 * np.column_stack([c["length_m"], c["width_m"]])
    path = write_tracks(
        tmp_path / "t.csv", c, x_m=c["x_m"] - half[:, 0], y_m=-c["y_m"] - half[:, 1]
    )
    columns = {"reference": "corner", "columns": {"y": "-y_m"}}
    expected = np.column_stack([c["x_m"], c["y_m"]])[np.lexsort((c["time_s"], c["track"]))]
    np.testing.assert_allclose(read_tracks(path, overrides=columns).xy, expected, rtol=0, atol=1e-6)


def test_frames_per_second_of_a_table_with_times_are_not_used_and_that_is_said(town, tmp_path):
    table = {name: values for name, values in town[0].items() if name != "frame"}
    inspection = TracksReader(write_tracks(tmp_path / "t.csv", table), town[1], hz=5.0)
    assert [w.what for w in inspection.diagnostics.warnings] == [
        "hz is not used: the table has times"
    ]


def test_a_map_where_a_table_is_wanted_is_refused(town, tmp_path):
    with pytest.raises(ConversionError, match="is an OpenDRIVE map, not a table"):
        TracksReader(town[1], write_tracks(tmp_path / "t.csv", town[0]))


def test_files_of_levelxdata_need_nothing_said(town, tmp_path):
    c = town[0]
    table = {
        "trackId": c["track"],
        "frame": c["frame"],
        "trackLifetime": c["frame"],
        "xCenter": c["x_m"] + 7e5,  # the origin of their frame brings them back
        "yCenter": c["y_m"] - 3e5,
        "heading": np.rad2deg(c["heading_rad"]) % 360.0,
        "width": c["width_m"],
        "length": c["length_m"],
        "xVelocity": c["vx_mps"],
        "yVelocity": c["vy_mps"],
    }
    pc.write_csv(pa.table(table), tmp_path / "07_tracks.csv")
    tracks, first = np.unique(c["track"], return_index=True)
    kinds = {"trackId": tracks, "class": c["kind"][first]}
    pc.write_csv(pa.table(kinds), tmp_path / "07_tracksMeta.csv")
    meta = {"frameRate": [12.5], "xUtmOrigin": [-7e5], "yUtmOrigin": [3e5]}
    pc.write_csv(pa.table(meta), tmp_path / "07_recordingMeta.csv")
    inspection = TracksReader(tmp_path / "07_tracks.csv", town[1])
    assert inspection.diagnostics.errors == []
    assert inspection.table.hz == 12.5
    names = np.array(inspection.table.categories)[inspection.table.category]
    assert sorted(set(names.tolist())) == sorted(set(c["kind"].tolist()))


@pytest.mark.thorough
def test_a_recording_that_is_converted_again_takes_the_place_of_the_old_one(town, tmp_path):
    inspection = TracksReader(write_tracks(tmp_path / "t.csv", town[0]), town[1])
    before = convert_tracks(inspection, tmp_path / "s")
    store = open_store(tmp_path / "s")
    ego = store.window(store.tokens[-1]).ego
    report = convert_tracks(inspection, tmp_path / "s", egos=[ego])
    assert (report.converted, report.accepted < before.accepted) == (1, True)
    store = open_store(tmp_path / "s")
    assert {store.window(token).ego for token in store.tokens} == {ego}
    assert len(store) == report.accepted
    assert survey_store(tmp_path / "s").problems == []
    other = TracksReader(tmp_path / "t.csv", export_town(tmp_path, "junction")[1], city="map")
    other.diagnostics.errors.clear()
    with pytest.raises(ConversionError, match="another map named 'map'"):
        convert_tracks(other, tmp_path / "s")


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("05-01.cam1.csv", "05-01.cam1"),
        ("t.csv.gz", "t"),
        ("a.v2.pq", "a.v2"),
        ("2024.05", "2024.05"),
    ],
)
def test_a_recording_has_the_name_of_its_file(file, name, town, tmp_path):
    if file.endswith("pq"):
        pq.write_table(pa.table(town[0]), tmp_path / file)
    else:
        with pa.output_stream(str(tmp_path / file), compression="detect") as stream:
            pc.write_csv(pa.table(town[0]), stream)
    assert read_tracks(tmp_path / file).name == name


def test_another_table_or_map_of_the_same_name_is_refused(town, tmp_path):
    for folder in ("a", "b", "s"):
        (tmp_path / folder).mkdir()
    first, second = (write_tracks(tmp_path / n / "t.csv", town[0]) for n in "ab")
    store, limits = (
        tmp_path / "s",
        town[1].read_text().replace("<speed max=", '<speed max="3" was='),
    )
    before = convert_tracks(TracksReader(first, town[1]), store)
    again = convert_tracks(TracksReader(second, town[1]), store)  # the same table
    assert (before.replaced, again.converted, again.replaced) == ({}, 0, {})
    other = write_tracks(second, town[0], vx_mps=None, vy_mps=None)
    with pytest.raises(
        ConversionError, match=rf"b/t.csv: .* of another table, {before.accepted} scen"
    ) as e:
        convert_tracks(TracksReader(other, town[1]), store)
    assert "--replace" in e.value.hint
    report = convert_tracks(TracksReader(other, town[1]), store, replace=True)
    assert (report.converted, report.replaced) == (1, {"t": before.accepted})
    map_path = tmp_path / "b/map.xodr"
    map_path.write_text(limits)
    with pytest.raises(ConversionError, match=r"b/map.xodr: .* another map named 'map'") as e:
        convert_tracks(TracksReader(first, map_path), store, replace=True)
    assert "--store" in e.value.hint


def _convert(folder, capsys, *words):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.delenv("SHIFTSIM_DATA", raising=False)
        with pytest.raises(SystemExit) as end:
            main(["convert", "tracks", *map(str, words)])
    return end.value.code, *capsys.readouterr()


@pytest.mark.thorough
def test_the_command_converts_and_draws_what_is_right_and_what_is_wrong(town, tmp_path, capsys):
    right = write_tracks(tmp_path / "right.csv", town[0])
    wrong = write_tracks(tmp_path / "wrong.csv", town[0], y_m=-town[0]["y_m"])
    code, out, _ = _convert(tmp_path, capsys, right, town[1], "--store", tmp_path / "s")
    assert (code, "scenarios → " in out) == (0, True)
    assert "x = x_m" in out
    words = (wrong, town[1], "--store", tmp_path / "w", "--json")
    code, out, err = _convert(tmp_path, capsys, *words)
    assert (code, out, "1 thing cannot be right" in err) == (2, "", True)
    assert re.search("wrong: .*wrong.csv: .* with y mirrored\n.*remedy: .*y = '-y_m'", err)
    assert not (tmp_path / "w/store.json").exists()
    pytest.importorskip("matplotlib")
    assert (tmp_path / "s/reports/map_right.png").stat().st_size > 10_000
    assert (tmp_path / "w/reports/map_wrong.png").stat().st_size > 10_000
    report = json.loads((tmp_path / "s/reports/map.json").read_text())
    assert report["recordings"]["right"]["summary"]["accepted"] > 0
    (tmp_path / "c.toml").write_text("[columns]\ny = '-y_m'\n")
    words = (wrong, town[1], "--store", tmp_path / "w", "--columns", "c.toml", "--json")
    code, out, _ = _convert(tmp_path, capsys, *words)
    assert (code, json.loads(out)["city"], json.loads(out)["unusual"]) == (0, "map", [])


def test_the_command_says_why_no_scenario_is_left(town, tmp_path, capsys):
    time, kind = town[0]["time_s"], town[0]["kind"]
    kept = (kind == "pedestrian") | (time < 17.0) | (time > 25.0)  # a hole in every vehicle
    parts = {name: values[kept] for name, values in town[0].items()}
    table = write_tracks(tmp_path / "t.csv", parts)
    words = (table, town[1], "--store", tmp_path / "s")
    code, _, err = _convert(tmp_path, capsys, *words)
    assert code == 2
    assert "no scenario is left" in err
    assert "presence" in err
    assert "--window-s" in err


def test_the_rows_that_have_a_size_tell_that_of_the_track(town):
    sizes = {name: town[0][name].copy() for name in ("length_m", "width_m")}
    sizes["length_m"][::2] = np.nan
    sizes["width_m"][1::4] = 0.0
    np.testing.assert_array_equal(_samples(town[0], **sizes).sizes, _samples(town[0]).sizes)
    sizes["length_m"][:] = np.nan
    assert set(_samples(town[0], **sizes).sizes[:, 0].tolist()) == {4.6, 12.0, 1.8, 0.7}


@pytest.mark.parametrize("beside", [True, False])
def test_a_change_between_roads_that_are_not_linked_leaves_no_scenario(beside):
    line = np.array([[0.0, 0.0], [300.0, 0.0]])
    borders = [line + np.array([0.0, y]) for y in (7.0, 3.5, 0.0)]
    left = LanePiece("left", borders[0], borders[1], right_neighbor="right" if beside else None)
    right = LanePiece("right", borders[1], borders[2], left_neighbor="left" if beside else None)
    road = build_lane_map(MapSource("two", [left, right])).road
    time = np.arange(0, 20.0, 0.05)
    y = np.clip(1.75 + 0.5 * (time - 10.0), 1.75, 5.25)
    samples = make_samples(
        "one",
        time_us=np.rint(time * 1e6).astype(np.int64),
        ids=np.full(len(time), 1),
        category=np.zeros(len(time), np.int64),
        categories=["car"],
        xy=np.column_stack([20.0 + 10.0 * time, y]),
    )
    made = make_scenarios(samples, road)
    assert len(made.windows) == beside
    assert made.summary.rejected == ({} if beside else {"route with a gap": 1})
