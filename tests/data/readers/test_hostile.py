"""Recordings nobody should trust: one clear error or a counted repair, never a hang or a crash."""

import resource

import dsc3d_writer as writer
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shiftsim.data.readers.dsc3d import convert_dsc3d, open_site, read_recording
from shiftsim.data.readers.windows import ConversionConfig, make_config
from shiftsim.data.store.check import survey_store
from shiftsim.errors import ConfigError, ConversionError

SHORT = ConversionConfig(window_s=4.0, overlap_s=1.0, history_s=1.0, min_drivable_share=0.0)


def _site(folder, tracks=None, duration=5.0, **kwargs):
    times = writer.frame_times(duration)
    return writer.write_site(folder / "s", tracks or [writer.car(1, times)], duration, **kwargs)


def _read(folder):
    return read_recording(open_site(folder), "r")


@pytest.mark.parametrize(
    ("group", "value", "message"),
    [
        ("translation", 1e300, "'translation_x', row 4: 1e\\+300 is beyond"),
        ("translation", -2e5, "beyond"),
        ("translation", np.inf, "not a finite number"),
        ("rotation", 1e18, "'rotation_x'"),
        ("dimension", 1e9, "'dimension_x'"),
    ],
)
def test_huge_values_are_refused(tmp_path, group, value, message):
    track = writer.car(1, writer.frame_times(5.0))
    track[group][4, 0] = value
    with pytest.raises(ConversionError, match=message):
        _read(_site(tmp_path, [track]))


def test_a_huge_stored_velocity_is_not_believed(tmp_path):
    track = writer.car(1, writer.frame_times(5.0))
    track["velocity"][4, 0] = 1e300
    recording = _read(_site(tmp_path, [track]))
    np.testing.assert_allclose(recording.velocities[:, 0], 8.0, rtol=0, atol=1e-9)
    assert recording.warnings == {"tracks whose stored velocity does not fit (derived)": 1}


def test_frames_years_apart_are_refused_before_anything_is_made_of_them(tmp_path):
    folder = _site(tmp_path)
    path = folder / "annotations/r/frames.parquet"
    ids = pa.array([0, 2, 4_000_000_000], pa.uint32())
    stamps = pa.array([0, 1, 2], pa.timestamp("us", "UTC"))
    pq.write_table(pa.table({"frame_id": ids, "time": stamps}), path)
    with pytest.raises(ConversionError, match=r"row between 0.08 s and 1.6e\+08 s"):
        _read(folder)


def test_a_small_file_of_very_many_rows_is_refused_unread(tmp_path):
    folder = _site(tmp_path)
    path = folder / "annotations/r/annotations.parquet"
    table = pq.read_table(path).slice(0, 1)
    many = table.take(pa.array(np.zeros(1_000_000, np.int64)))
    with pq.ParquetWriter(path, many.schema) as file:
        for _ in range(9):
            file.write_table(many)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ConversionError, match="9000000 rows, need 1 to 8000000"):
        _read(folder)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_too_many_boxes_in_one_frame_are_refused(tmp_path):
    one = writer.car(1, [0.0])
    whole = {
        key: value * 6000 if isinstance(value, list) else np.repeat(value, 6000, axis=0)
        for key, value in one.items()
    }
    whole["track_id"] = np.arange(6000)
    with pytest.raises(ConversionError, match="6000 boxes in one frame"):
        _read(_site(tmp_path, [whole]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[" * 100_000, "the JSON cannot be unpacked"),
        ('{"interface_version": "1.0"', "the JSON cannot be unpacked"),
        ("\udcff".encode("utf-8", "surrogateescape"), "the JSON cannot be unpacked"),
        (b" " * 10_000_001, "more than"),
    ],
)
def test_a_hostile_data_meta_is_one_error(tmp_path, text, message):
    folder = _site(tmp_path)
    path = folder / "data_meta.json"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConversionError, match=message):
        open_site(folder)


@pytest.mark.parametrize(
    "change",
    [
        {"frame_distance": float("inf")},
        {"frame_rate": 10**400},
        {"reference_utm": {"zone": [32, "N"], "offset": [1e300, 0, 0]}},
        {"locations": [{"recordings": 5}]},
    ],
)
def test_impossible_values_of_data_meta_are_errors_of_ours(tmp_path, change):
    with pytest.raises(ConversionError):
        open_site(_site(tmp_path, meta=change))


def test_the_size_of_a_track_that_changes_is_its_median(tmp_path):
    times = writer.frame_times(5.0)
    tracks = [writer.car(1, times), writer.car(2, times, x0=90.0)]
    tracks[1]["dimension"][:3, 0] = [4.0, 9.0, 9.0]
    recording = _read(_site(tmp_path, tracks))
    np.testing.assert_array_equal(recording.sizes[:, 0], [4.5, 4.5])
    assert recording.warnings == {"tracks of varying size (median taken)": 1}


def test_a_missing_map_is_one_error_and_leaves_no_store(tmp_path):
    with pytest.raises(ConversionError, match="no OpenDRIVE map"):
        convert_dsc3d(_site(tmp_path, road=""), tmp_path / "store")
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    "values",
    [{"window_s": "18"}, {"country": 5}, {"max_per_window": 0}, {"category_map": {"a": 1}}],
)
def test_settings_of_a_wrong_type_are_refused(values):
    with pytest.raises(ConfigError):
        make_config(values)


_boxes = st.lists(
    st.tuples(
        st.integers(1, 3),  # track
        st.integers(0, 62),  # frame
        st.floats(allow_nan=True, allow_infinity=True) | st.floats(-300.0, 700.0),
        st.floats(-60.0, 60.0),
        st.floats(-4.0, 4.0),
        st.sampled_from(["car", "van", "pedestrian", "bicycle", "truck", "ufo"]) | st.just("car"),
        st.floats(0.1, 20.0) | st.floats(-1.0, 1e9),
        st.floats(-30.0, 30.0) | st.floats(),
    ),
    min_size=1,
    max_size=60,
)


@settings(max_examples=30, deadline=None)
@given(_boxes, st.booleans())
def test_any_boxes_give_a_sound_store_or_an_error_of_ours(tmp_path_factory, boxes, add_ego):
    folder = tmp_path_factory.mktemp("fuzz")
    track, frame, x, y, yaw, names, length, speed = zip(*boxes, strict=True)
    count = len(boxes)
    zero = np.zeros(count)
    rows = {
        "track_id": np.array(track),
        "time": np.array(frame) * 0.08,
        "category": list(names),
        "translation": np.column_stack([x, y, zero]),
        "rotation": np.column_stack([zero, zero, yaw]),
        "dimension": np.column_stack([length, zero + 2.0, zero + 1.5]),
        "velocity": np.column_stack([speed, zero, zero]),
    }
    tracks = [rows, *([writer.car(9, writer.frame_times(5.0))] if add_ego else [])]
    try:
        convert_dsc3d(_site(folder, tracks), folder / "store", options=SHORT)
    except ConversionError:
        return
    # boxes at random places move as no vehicle does; that the store says so is not its fault
    told = {"scenarios", "velocity", "heading", "off the map"}
    problems = [
        p for p in survey_store(folder / "store").problems if p.is_error and p.kind not in told
    ]
    assert [p for p in problems if "faster" not in p.what] == []
