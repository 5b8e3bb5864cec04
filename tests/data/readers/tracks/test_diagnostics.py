"""Tables with wrong units, axes, orders or origins: each is named, and its remedy repairs it."""

from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from track_files import export_town, write_tracks

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.readers.tracks.axes import Diagnostics
from shiftsim.data.readers.tracks.diagnostics import _check_starts, diagnose
from shiftsim.data.readers.tracks.table import read_tracks
from shiftsim.errors import ConfigError, ConversionError

FOOT = 0.3048
PLACES = ("x_m", "y_m")
SIZES = ("length_m", "width_m")
SPEEDS = ("vx_mps", "vy_mps")


def _times(names, factor):
    return lambda c: {name: c[name] * factor for name in names}


def _shifted(x, y):
    return lambda c: {"x_m": c["x_m"] + x, "y_m": c["y_m"] + y}


def _along(share):
    """Places of another point of the vehicles, so many lengths ahead of the middle."""

    def change(c):
        way = share * c["length_m"] * np.isin(c["kind"], ["car", "van", "truck", "bus"])
        heading = c["heading_rad"]
        return {
            "x_m": c["x_m"] + way * np.cos(heading),
            "y_m": c["y_m"] + way * np.sin(heading),
        }

    return change


def _heading(function):
    return lambda c: {"heading_rad": function(c["heading_rad"])}


def _in_body(c):
    return {"vx_mps": np.hypot(c["vx_mps"], c["vy_mps"]), "vy_mps": 0.0 * c["vx_mps"]}


def _jumping(c):
    x = c["x_m"].copy()
    x[100] += 80.0
    return {"x_m": x}


def _merged(c):
    """The last object gets the id of the first, whose time it shares."""
    track = c["track"]
    return {"track": np.where(track == track.max(), track.min(), track)}


NO_SPEEDS = dict.fromkeys(SPEEDS)
# what is done to a right table; a word of the error, a word of the remedy, and the same remedy in
# TOML where there is one
SPOILT = {
    "centimetres": (_times(PLACES, 100), "m/s", "'cm'", {"units": {"position": "cm"}}),
    "millimetres": (_times(PLACES, 1e3), "m/s", "'mm'", {"units": {"position": "mm"}}),
    "kilometres": (_times(PLACES, 1e-3), "faster than", "'km'", {"units": {"position": "km"}}),
    "feet": (_times(PLACES, 1 / FOOT), "drivable area", "'ft'", {"units": {"position": "ft"}}),
    "all in feet": (
        _times(PLACES + SIZES + SPEEDS, 1 / FOOT),
        "6.07 m wide",
        "velocity = 'ftps'",
        {"units": {"position": "ft", "size": "ft", "velocity": "ftps"}},
    ),
    "degrees of longitude and latitude": (
        lambda c: {"x_m": 9 + c["x_m"] / 72e3, "y_m": 48 + c["y_m"] / 111e3, **NO_SPEEDS},
        "faster than",
        "longitude and latitude",
        None,
    ),
    "y downwards": (
        lambda c: {"y_m": -c["y_m"]},
        "with y mirrored",
        "y = '-y_m'",
        {"columns": {"y": "-y_m"}},
    ),
    "y, headings and velocities downwards": (
        lambda c: {n: -c[n] for n in ("y_m", "heading_rad", "vy_mps")},
        "with y mirrored",
        "vy = '-vy_mps'",
        {"columns": {"y": "-y_m", "heading": "-heading_rad", "vy": "-vy_mps"}},
    ),
    "x and y swapped": (
        lambda c: {"x_m": c["y_m"], "y_m": c["x_m"]},
        "swapped",
        "x = 'y_m', y = 'x_m'",
        {"columns": {"x": "y_m", "y": "x_m"}},
    ),
    "another origin": (
        _shifted(512_345.0, 5_400_000.0),
        "only 0% of the moving vehicles",
        "shift_m = [-51234",
        {"shift_m": [-512_345, -5_400_000]},
    ),
    "an origin seven metres off": (
        _shifted(7.0, 0.0),
        "drivable area",
        "shift_m = [-",
        {"shift_m": [-7.0, 0.0]},
    ),
    "milliseconds": (_times(("time_s",), 1e3), "80 s apart", "'ms'", {"units": {"time": "ms"}}),
    "microseconds": (_times(("time_s",), 1e6), "80000 s apart", "'us'", {"units": {"time": "us"}}),
    "frames as time": (
        lambda c: {"time_s": c["frame"], "frame": None},
        "1 s apart",
        "frame = 'time_s'",
        {"columns": {"frame": "time_s", "time": ""}, "hz": 12.5},
    ),
    "degrees": (_heading(np.rad2deg), "headings differ", "'deg'", {"units": {"heading": "deg"}}),
    "degrees clockwise from north": (
        _heading(lambda h: 90 - np.rad2deg(h)),
        "headings differ",
        "'compass'",
        {"units": {"heading": "compass"}},
    ),
    "clockwise headings": (
        _heading(np.negative),
        "headings differ",
        "'-heading_rad'",
        {"columns": {"heading": "-heading_rad"}},
    ),
    "headings from the y axis": (
        _heading(lambda h: h - np.pi / 2),
        "headings differ",
        "quarter turn too small",
        {"columns": {"heading": ""}},
    ),
    "headings backwards": (
        _heading(lambda h: h + np.pi),
        "headings differ",
        "backwards",
        {"columns": {"heading": ""}},
    ),
    "km/h": (_times(SPEEDS, 3.6), "3.6 times", "'kmh'", {"units": {"velocity": "kmh"}}),
    "miles per hour": (
        _times(SPEEDS, 1 / 0.44704),
        "2.24 times",
        "'mph'",
        {"units": {"velocity": "mph"}},
    ),
    "velocities swapped": (
        lambda c: {"vx_mps": c["vy_mps"], "vy_mps": c["vx_mps"]},
        "contradict",
        "vx = 'vy_mps'",
        {"columns": {"vx": "vy_mps", "vy": "vx_mps"}},
    ),
    "velocities of the body": (
        _in_body,
        "contradict",
        "along and across",
        {"columns": {"vx": "", "vy": ""}},
    ),
    "no velocities but zeros": (
        _times(SPEEDS, 0.0),
        "contradict",
        "vx = ''",
        {"columns": {"vx": "", "vy": ""}},
    ),
    "length and width swapped": (
        lambda c: {"length_m": c["width_m"], "width_m": c["length_m"]},
        "1.85 m long",
        "look swapped",
        {"columns": {"length": "width_m", "width": "length_m"}},
    ),
    "half sizes": (_times(SIZES, 0.5), "2.25 m long", "halves", None),
    "sizes in centimetres": (_times(SIZES, 100), "m long", "'cm'", {"units": {"size": "cm"}}),
    "places of the front": (
        _along(0.5),
        "in turns",
        "reference = 'front'",
        {"reference": "front"},
    ),
    "places of the rear": (_along(-0.5), "in turns", "reference = 'rear'", {"reference": "rear"}),
    "one id for two objects": (_merged, "has two rows", "ids of their own", None),
    "a row far away": (_jumping, "jumps 80.4 m", "a row is wrong", None),
    "a place of -9999 for what is not known": (
        lambda c: {"x_m": np.where(np.arange(len(c["x_m"])) % 33 == 5, -9999.0, c["x_m"])},
        "jumps",
        "lead to x = -9999 m",
        None,
    ),
    "negative sizes": (
        _times(SIZES, -1),
        "lengths and widths are negative",
        "length = '-NAME'",
        {"columns": {"length": "-length_m", "width": "-width_m"}},
    ),
    "negative lengths": (
        _times(("length_m",), -1),
        "all lengths and widths are negative, the first -",
        "length = '-NAME'",
        {"columns": {"length": "-length_m"}},
    ),
    "a negative width": (
        lambda c: {"width_m": np.where(np.arange(len(c["track"])) == 7, -1.0, c["width_m"])},
        "1 lengths and widths are negative, the first -1 m, of object",
        "cells that are not known empty",
        None,
    ),
    "one car of 300 m": (
        lambda c: {"length_m": np.where(c["track"] == c["track"][0], 300.0, c["length_m"])},
        "300 m long",
        "correct its size",
        None,
    ),
    "yards": (
        _times(PLACES + SPEEDS, 1 / 0.9144),
        "47% of the moving vehicles are on drivable area",
        "no other unit, axis or origin fits better",
        None,
    ),
    "numbers for kinds": (
        lambda c: {"kind": np.where(c["kind"] == "pedestrian", 1, 2)},
        "kinds '1', '2' are unknown",
        "[kinds]",
        {"kinds": {"1": "pedestrian", "2": "car"}},
    ),
    "pedestrians only": (
        lambda c: {"kind": np.full(len(c["x_m"]), "pedestrian")},
        "is a vehicle",
        "kinds",
        None,
    ),
}


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    columns, map_path = export_town(tmp_path_factory.mktemp("towns") / "t", "roundabout")
    return columns, build_road_map(read_opendrive(map_path), name="roundabout")[0]


def _diagnose(path, road, **how):
    return diagnose(read_tracks(path, **how), road, 0.95)


@pytest.mark.thorough
def test_a_right_table_raises_no_doubt(town, tmp_path):
    columns, road = town
    found = _diagnose(write_tracks(tmp_path / "t.csv", columns), road)
    assert (found.errors, found.warnings) == ([], [])
    figures = {"fastest_vehicle_mps": 8.2, "walking_mps": 1.35, "acceleration_mps2": 0.43}
    figures |= {"median_length_m": 4.5, "median_width_m": 1.85, "reference_share": 0.0}
    figures |= dict.fromkeys(("drivable_share", "along_share"), 1.0)
    nothing = ("jumps", "heading_error_rad", "backwards_share", "contradicting_share")
    assert found.figures == pytest.approx(figures | dict.fromkeys(nothing, 0.0), abs=0.01)


@pytest.mark.parametrize("name", SPOILT)
def test_what_is_wrong_is_named_and_its_remedy_repairs_it(name, town, tmp_path):
    change, what, remedy, overrides = SPOILT[name]
    columns, road = town
    path = write_tracks(tmp_path / "t.csv", columns, **change(columns))
    found = _diagnose(path, road).errors
    assert what in " ".join(error.what for error in found)
    assert remedy in " ".join(error.remedy for error in found)
    if overrides is not None:
        assert _diagnose(path, road, overrides=overrides).errors == []


def test_frames_per_second_that_contradict_the_velocities_are_named(town, tmp_path):
    columns, road = town
    path = write_tracks(tmp_path / "t.csv", columns, time_s=None)
    (found,) = _diagnose(path, road, hz=25.0).errors
    assert "0.5 times" in found.what
    assert "--hz looks too large" in found.remedy
    assert _diagnose(path, road, hz=12.5).errors == []


def test_twice_the_speed_is_unusual_where_nothing_else_tells(town, tmp_path):
    columns, road = town
    path = write_tracks(tmp_path / "t.csv", columns, time_s=None, **NO_SPEEDS)
    found = _diagnose(path, road, hz=25.0)
    assert found.errors == []
    assert "speed limit" in found.warnings[0].what
    assert "--hz" in found.warnings[0].remedy


@pytest.mark.parametrize(("hz", "walking"), [(6.25, "0.67"), (25.0, "2.7")])
def test_half_and_twice_the_speed_are_noted_where_pedestrians_walk(hz, walking, town, tmp_path):
    columns, road = town
    path = write_tracks(tmp_path / "t.csv", columns, time_s=None, **NO_SPEEDS)
    found = _diagnose(path, road, hz=hz)
    assert found.errors == []
    assert f"pedestrian walks with {walking} m/s" in found.warnings[-1].what
    assert "--hz" in found.warnings[-1].remedy


def _lively(columns):
    """The rows of the vehicles that brake and turn most, a third of all."""
    median = {}
    for track in np.unique(columns["track"][columns["kind"] != "pedestrian"]).tolist():
        rows = columns["track"] == track
        change = np.hypot(*(np.diff(columns[name][rows]) for name in SPEEDS))
        median[track] = np.median(change)
    lively = [track for track, x in median.items() if x >= np.quantile([*median.values()], 2 / 3)]
    kept = np.isin(columns["track"], lively)
    return {name: values[kept] for name, values in columns.items()}


@pytest.mark.parametrize(("hz", "value"), [(37.5, 6.3), (50.0, 11)])
def test_three_times_the_speed_cannot_be_for_how_cars_would_turn_and_brake(
    hz, value, town, tmp_path
):
    columns, road = town
    path = write_tracks(tmp_path / "t.csv", _lively(columns), time_s=None, **NO_SPEEDS)
    (found,) = _diagnose(path, road, hz=hz).errors
    assert f"with {value} m/s²" in found.what
    assert "--hz" in found.remedy


@pytest.mark.thorough
def test_the_map_of_another_place_is_named(town, tmp_path):
    columns, _ = town
    other = export_town(tmp_path / "towns", "junction")[1]
    road = build_road_map(read_opendrive(other), name="junction")[0]
    (found,) = _diagnose(write_tracks(tmp_path / "t.csv", columns), road).errors
    assert "drivable area" in found.what
    assert "the map of this place" in found.remedy


def test_a_gap_in_the_recording_is_named(town, tmp_path):
    columns, road = town
    kept = (columns["time_s"] < 10.0) | (columns["time_s"] > 14.0)
    path = write_tracks(tmp_path / "t.csv", {n: v[kept] for n, v in columns.items()})
    assert "between 9.92 s and 14.08 s" in _diagnose(path, road).warnings[0].what


def test_a_clock_that_begins_anew_at_midnight_is_named(town, tmp_path):
    time = np.mod(town[0]["time_s"] + 86_390.0, 86_400.0)
    found = _diagnose(write_tracks(tmp_path / "t.csv", town[0], time_s=time, frame=None), town[1])
    assert "no object has a row between" in found.errors[0].what
    assert "midnight" in found.errors[0].remedy


UNREADABLE = {
    "no time": ({"time_s": None, "frame": None}, "neither a time nor a frame"),
    "frames without a rate": ({"time_s": None}, "in frames"),
    "no kinds": ({"kind": None}, "known as 'kind'"),
    "no places": ({"x_m": None}, "known as 'x'"),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_a_missing_column_is_named(name, town, tmp_path):
    changed, what = UNREADABLE[name]
    with pytest.raises(ConversionError, match=what) as error:
        read_tracks(write_tracks(tmp_path / "t.csv", town[0], **changed))
    assert "--" in error.value.hint


def test_a_name_with_a_unit_where_none_belongs_is_not_known(town, tmp_path):
    changed = {"kind": None, "kind [s]": town[0]["kind"]}
    with pytest.raises(ConversionError, match="known as 'kind'"):
        read_tracks(write_tracks(tmp_path / "t.csv", town[0], **changed))


@pytest.mark.parametrize(
    ("text", "what"),
    [("width_m", "not readable"), (",car,", "'kind' is binary"), (",pedestrian,", "'kind' is bin")],
)
def test_bytes_that_are_no_text_are_named(text, what, town, tmp_path):
    path = write_tracks(tmp_path / "t.csv", town[0])
    data = path.read_bytes().replace(b'"', b"")
    assert text.encode() in data
    path.write_bytes(
        data.replace(text.encode(), text.encode()[:1] + b"\xff" + text.encode()[-1:], 1)
    )
    with pytest.raises(ConversionError, match=what):
        read_tracks(path)


def test_columns_of_longitude_and_latitude_are_refused(town, tmp_path):
    changed = {"x_m": None, "y_m": None, "lon": town[0]["x_m"], "lat": town[0]["y_m"]}
    with pytest.raises(ConversionError) as error:
        read_tracks(write_tracks(tmp_path / "t.csv", town[0], **changed))
    assert "lon and lat are degrees" in error.value.hint


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_places_that_are_no_numbers_are_named_with_their_row(value, town, tmp_path):
    x = town[0]["x_m"].copy()
    x[100] = value
    with pytest.raises(ConversionError, match=r"'x_m' holds 1 values .* row 101"):
        read_tracks(write_tracks(tmp_path / "t.csv", town[0], x_m=x))


@pytest.mark.parametrize(("unit", "offset"), [("m", 512_345.0), ("cm", 51_234_500.0)])
def test_coordinates_of_single_precision_are_refused_where_it_is_coarse(
    unit, offset, town, tmp_path
):
    x = (town[0]["x_m"] * (offset // 512_345) + offset).astype(np.float32).astype(np.float64)
    what = {"x_m": None, f"x_{unit}": x, "y_m": None, f"y_{unit}": town[0]["y_m"]}
    path = write_tracks(tmp_path / "t.csv", town[0], **what)
    with pytest.raises(
        ConversionError, match=rf"'x_{unit}' is float32 .* steps of 0.0.* row 1"
    ) as error:
        read_tracks(path, overrides={"shift_m": [-512_345.0, 0.0]})
    assert "float64" in error.value.hint
    read_tracks(write_tracks(path, town[0], x_m=town[0]["x_m"].astype(np.float32)))


@pytest.mark.parametrize("name", ["vx_mps", "length_m"])
def test_an_infinite_speed_or_size_is_no_missing_one(name, town, tmp_path):
    values = town[0][name].copy()
    values[100] = np.inf
    with pytest.raises(ConversionError, match=rf"'{name}' holds 1 values .* not finite.* row 101"):
        read_tracks(write_tracks(tmp_path / "t.csv", town[0], **{name: values}))
    values[100] = np.nan
    table = read_tracks(write_tracks(tmp_path / "t.csv", town[0], **{name: values}))
    kept = table.sizes if name == "length_m" else table.velocities
    assert np.isnan(kept).sum() == 1


def test_rows_without_a_heading_get_the_direction_of_motion(town, tmp_path):
    columns, road = town
    heading = columns["heading_rad"].copy()
    heading[::3] = np.nan
    path = write_tracks(tmp_path / "t.csv", columns, heading_rad=heading)
    found = _diagnose(path, road)
    assert not found.errors
    assert found.figures["heading_error_rad"] < 0.05
    wrong = write_tracks(tmp_path / "t.csv", columns, heading_rad=np.rad2deg(heading))
    assert "'deg'" in _diagnose(wrong, road).errors[0].remedy


def test_a_few_headings_in_degrees_are_named_and_unwrapped_radians_are_not(town, tmp_path):
    columns, road = town
    heading, track = columns["heading_rad"], columns["track"]
    few = np.isin(track, np.unique(track)[:: len(np.unique(track)) // 4])
    degrees = np.where(few, np.rad2deg(heading), heading)
    (found,) = _diagnose(
        write_tracks(tmp_path / "t.csv", columns, heading_rad=degrees), road
    ).errors
    assert "headings are beyond 2 pi rad, such as" in found.what
    assert "[units] heading = 'deg'" in found.remedy
    unwrapped = np.where(few, heading + 4.0 * np.pi, heading)
    assert not _diagnose(
        write_tracks(tmp_path / "t.csv", columns, heading_rad=unwrapped), road
    ).errors


def test_front_positions_need_neither_heading_nor_size(town, tmp_path):
    columns, _ = town
    ahead = _along(0.5)({**columns, "length_m": np.where(columns["kind"] == "truck", 12.0, 4.6)})
    bare = dict.fromkeys(("heading_rad", "length_m", "width_m", "vx_mps", "vy_mps"))
    path = write_tracks(tmp_path / "t.csv", columns, **ahead, **bare)
    table = read_tracks(path, overrides={"reference": "front"})
    order = np.lexsort((columns["time_s"], columns["track"]))
    truth = np.column_stack([columns["x_m"], columns["y_m"]])[order]
    used = np.isin(columns["kind"][order], ["car", "truck"]) & (table.speed > 4.0)
    error = np.hypot(*(table.xy - truth)[used].T)
    assert np.median(error) < 0.1


def test_pedestrians_as_long_as_cars_are_named(town, tmp_path):
    columns, road = town
    length = np.maximum(columns["length_m"], 4.5)
    (found,) = _diagnose(write_tracks(tmp_path / "t.csv", columns, length_m=length), road).errors
    assert "the median pedestrian is 4.5 m long" in found.what


def test_repeated_rows_are_named(town, tmp_path):
    columns = {n: np.r_[v, v[50:60]] for n, v in town[0].items()}
    (found,) = _diagnose(write_tracks(tmp_path / "t.csv", columns), town[1]).errors
    assert "has two rows at 4 s (10 such rows)" in found.what


@pytest.mark.parametrize(
    ("overrides", "what"),
    [
        ({"columns": {"x": "xx"}}, "no column 'xx'"),
        ({"columns": {"z": "x_m"}}, "column 'z' unknown"),
        ({"units": {"heading": "grad"}}, "unit of heading 'grad' unknown"),
        ({"kinds": {"1": "tank"}}, "kind 'tank' unknown"),
        ({"column": {}}, "setting 'column' unknown"),
        ({"shift_m": [1]}, "shift_m"),
        ({"shift_m": [10**400, 0]}, "shift_m"),
        ({"shift_m": 5}, "shift_m is 5"),
        ({"reference": "axle"}, "reference 'axle' unknown"),
        ({"reference": 5}, "reference '5' unknown"),
        ({"columns": ["x_m"]}, "columns is"),
        ({"hz": 10**400}, "hz is"),
    ],
)
def test_what_is_said_wrongly_is_named(overrides, what, town, tmp_path):
    with pytest.raises(ConfigError, match=what):
        read_tracks(write_tracks(tmp_path / "t.csv", town[0]), overrides=overrides)


def test_a_clock_of_its_own_for_every_object_is_named(town, tmp_path):
    columns, road = town
    first = {name: columns["time_s"][columns["track"] == name].min() for name in columns["track"]}
    since = columns["time_s"] - np.array([first[name] for name in columns["track"].tolist()])
    path = write_tracks(tmp_path / "t.csv", columns, frame=None, time_s=np.round(since, 3))
    (note,) = _diagnose(path, road).warnings
    assert f"{len(first)} objects appear at the first time" in note.what
    assert "one clock for all" in note.remedy


@pytest.mark.parametrize(
    ("late", "gone", "is_doubted"), [(0, 10, False), (0, 11, True), (1, 19, False)]
)
def test_a_clock_is_doubted_where_all_begin_at_once_and_most_end_early(late, gone, is_doubted):
    """Of 20 objects; the last second is from 9 s on."""
    first = np.where(np.arange(20) < late, 1.0, 0.0)
    last = np.where(np.arange(20) < gone, 8.9, np.where(np.arange(20) < 19, 9.0, 10.0))
    table = SimpleNamespace(time=np.column_stack([first, last]).ravel(), ends=2 * np.arange(21))
    out = Diagnostics()
    _check_starts(table, out)
    assert bool(out.warnings) == is_doubted


def test_a_column_that_is_there_twice_is_named(town, tmp_path):
    path = write_tracks(tmp_path / "t.csv", town[0])
    path.write_text(path.read_text().replace("heading_rad", "x_m", 1))
    with pytest.raises(ConversionError, match="2 columns 'x_m'"):
        read_tracks(path)


@pytest.mark.parametrize("kind", ["timestamp[ns, tz=UTC]", "timestamp[s]", "duration[us]", "int64"])
def test_times_may_be_dates_or_durations(kind, town, tmp_path):
    columns, _ = town
    time = pa.array(np.rint(columns["frame"] / 12.5).astype(np.int64) + 1_700_000_000)
    types = {"timestamp[ns, tz=UTC]": pa.timestamp("ns", "UTC"), "timestamp[s]": pa.timestamp("s")}
    if kind == "int64":
        time, unit = pa.array(time.to_numpy() * 10**9), "ns"
    elif kind == "duration[us]":
        time, unit = pa.array(time.to_numpy() * 10**6).cast(pa.duration("us")), "s"
    else:
        time, unit = time.cast(pa.timestamp("s")).cast(types[kind]), "s"
    table = pa.table({**columns, "time_s": time, "frame": columns["frame"]}).drop_columns("frame")
    pq.write_table(table, tmp_path / "t.parquet")
    found = read_tracks(tmp_path / "t.parquet", overrides={"units": {"time": unit}})
    assert set(np.diff(np.unique(found.time_us)).tolist()) == {1_000_000}
    assert found.time_us.min() == 1_700_000_000_000_000


@pytest.mark.parametrize("empty", ["", " "])
def test_an_empty_text_is_no_id(empty, town, tmp_path):
    names = np.array([f"car{number}" for number in town[0]["track"]])
    names[[3, 5]] = empty
    with pytest.raises(
        ConversionError, match="'track' is empty in 2 rows, the first in data row 4"
    ):
        read_tracks(write_tracks(tmp_path / "t.csv", town[0], track=names))


def test_objects_without_an_id_are_named(town, tmp_path):
    columns, _ = town
    ids = np.where(columns["track"] == 4, np.nan, columns["track"])
    pq.write_table(pa.table({**columns, "track": ids}), tmp_path / "t.parquet")
    with pytest.raises(ConversionError, match="'track' is empty in"):
        read_tracks(tmp_path / "t.parquet")


def test_a_clock_of_twelve_hours_is_refused_with_what_is_right(town, tmp_path):
    columns, _ = town
    names = np.array([f"01:00:{second:06.3f} PM" for second in columns["time_s"]])
    path = write_tracks(tmp_path / "t.csv", columns, frame=None, time_s=names)
    with pytest.raises(ConversionError, match="need times") as error:
        read_tracks(path)
    assert "2024-05-01T13" in error.value.hint
