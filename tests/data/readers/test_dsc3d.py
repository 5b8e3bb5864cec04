from collections import Counter

import dsc3d_writer as writer
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shiftsim.data.readers.dsc3d import find_map, open_site, read_recording, rotation_angles
from shiftsim.data.readers.motion import held_headings
from shiftsim.errors import ConversionError


def _site(tmp_path, tracks=None, duration=5.0, **kwargs):
    times = writer.frame_times(duration)
    return writer.write_site(tmp_path / "s", tracks or [writer.car(1, times)], duration, **kwargs)


def test_yaw_comes_from_the_rotation_vector_and_not_from_its_z_component():
    cos, sin = np.cos, np.sin
    a, b = 3.0, 0.1
    turn = np.array([[cos(a), -sin(a), 0], [sin(a), cos(a), 0], [0, 0, 1]])
    tilt = np.array([[cos(b), 0, sin(b)], [0, 1, 0], [-sin(b), 0, cos(b)]])
    matrix = turn @ tilt
    angle = np.arccos((np.trace(matrix) - 1) / 2)
    axis = np.array(
        [matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]]
    ) / (2 * sin(angle))
    angles, up = rotation_angles((axis * angle)[None])
    np.testing.assert_allclose(angles[0], [3.0, 0.1, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(up[0], matrix[:, 2], rtol=0, atol=1e-12)


@given(st.lists(st.floats(-1.8, 1.8), min_size=3, max_size=3))
def test_rotation_angles_rebuild_the_rotation(vector):
    angles, up = rotation_angles(np.array([vector]))
    yaw, pitch, roll = angles[0]
    expected = np.array(
        [
            np.cos(yaw) * np.sin(pitch) * np.cos(roll) + np.sin(yaw) * np.sin(roll),
            np.sin(yaw) * np.sin(pitch) * np.cos(roll) - np.cos(yaw) * np.sin(roll),
            np.cos(pitch) * np.cos(roll),
        ]
    )
    np.testing.assert_allclose(up[0], expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_pitch_of_what_points_straight_up_or_down_is_a_number(sign):
    """The sine of it rounds to more than 1."""
    down = np.array([[1.1109245883766612, -sign * 1.2690097928649733, sign * 1.110924588376661]])
    assert rotation_angles(down)[0][0, 1] == pytest.approx(-sign * np.pi / 2)


def test_reads_a_recording_sorted_by_track_and_frame(tmp_path):
    times = writer.frame_times(5.0)
    folder = _site(tmp_path, [writer.car(7, times, x0=60.0), writer.car(3, times)])
    site = open_site(folder)
    recording = read_recording(site, "r")
    assert recording.track_ids.tolist() == [3, 7]
    assert site.epsg == 32632
    np.testing.assert_allclose(recording.xy[0], [20.0, -1.75], rtol=0, atol=1e-12)
    assert recording.start_us == writer.START_US


def test_the_middle_of_a_tilted_box_is_half_its_height_above_its_place(tmp_path):
    track = writer.car(1, writer.frame_times(5.0))
    track["rotation"][:, 1] = 0.1  # about the axis to the left: it leans ahead
    recording = read_recording(open_site(_site(tmp_path, [track])), "r")
    np.testing.assert_allclose(recording.xy[0], [20.0 + 0.75 * np.sin(0.1), -1.75], atol=1e-9)


def test_missing_velocities_are_derived_and_counted(tmp_path):
    folder = _site(tmp_path)
    writer.write_annotations(
        folder, [writer.car(1, writer.frame_times(5.0))], drop=("velocity_x", "velocity_y")
    )
    recording = read_recording(open_site(folder), "r")
    np.testing.assert_allclose(recording.velocities[:, 0], 8.0, rtol=0, atol=1e-9)
    assert recording.warnings["tracks without stored velocity (derived)"] == 1


def test_velocities_that_contradict_the_positions_are_not_believed(tmp_path):
    track = writer.car(1, writer.frame_times(5.0))
    track["velocity"][:, 0] = 5.0
    recording = read_recording(open_site(_site(tmp_path, [track])), "r")
    np.testing.assert_allclose(recording.velocities[:, 0], 8.0, rtol=0, atol=1e-9)
    assert recording.warnings == {"tracks whose stored velocity does not fit (derived)": 1}


def test_a_standing_object_that_spins_keeps_its_heading():
    yaw = np.array([0.1, 0.1, 1.5, -2.0, 0.9, 0.3])
    speed = np.array([1.0, 0.1, 0.1, 0.1, 0.1, 2.0])
    out = held_headings(
        yaw,
        np.column_stack([speed, 0 * speed]),
        np.arange(6) * 0.08,
        np.zeros(6, np.int64),
        Counter(),
    )
    np.testing.assert_array_equal(out, [0.1, 0.1, 0.1, 0.1, 0.1, 0.3])


def test_the_map_is_found_under_any_name_and_missing_maps_are_explained(tmp_path):
    folder = _site(tmp_path)
    (folder / "map/map.xodr").rename(folder / "map/town.xodr")
    assert find_map(open_site(folder)).name == "town.xodr"
    (folder / "map/town.xodr").unlink()
    with pytest.raises(ConversionError, match="no OpenDRIVE map"):
        find_map(open_site(folder))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"interface_version": "2.0"}, "interface_version '2.0'"),
        ({"reference_utm": {"zone": [99, "N"], "offset": [0, 0, 0]}}, "99"),
        ({"reference_utm": {"zone": [32, "N"]}}, "'offset' is missing"),
        ({"frame_rate": 0}, "frame_rate"),
        ({"frame_rate": "fast"}, "need a number"),
        ({"locations": []}, "no recordings"),
        ({"locations": [{"recordings": ["../x"]}]}, "not a plain folder name"),
        (
            {"reference_utm": {"zone": [32, "N"], "offset": [float("nan"), 0, 0]}},
            "not a finite number",
        ),
    ],
)
def test_a_wrong_data_meta_is_one_clear_error(tmp_path, change, message):
    folder = _site(tmp_path, meta=change)
    with pytest.raises(ConversionError, match=message):
        open_site(folder)


def test_a_folder_without_data_meta_says_what_to_give(tmp_path):
    with pytest.raises(ConversionError, match="no DSC3D folder"):
        open_site(tmp_path)


@pytest.mark.parametrize(
    ("group", "row", "value", "message"),
    [
        ("translation", 4, np.nan, "translation_x.*not a finite number"),
        ("dimension", 4, -1.0, "dimensions"),
        ("dimension", 4, 0.0, "dimensions"),
    ],
)
def test_bad_numbers_are_named(tmp_path, group, row, value, message):
    track = writer.car(1, writer.frame_times(5.0))
    track[group][row, 0] = value
    with pytest.raises(ConversionError, match=message):
        read_recording(open_site(_site(tmp_path, [track])), "r")


@pytest.mark.parametrize(
    ("ids", "message"), [([0, 2, 2, 4], "increase strictly"), ([0, 2, 4, 7], "frame_distance")]
)
def test_frame_ids_that_repeat_or_are_no_distance_apart_are_refused(tmp_path, ids, message):
    folder = _site(tmp_path)
    path = folder / "annotations/r/frames.parquet"
    frames = pq.read_table(path).slice(0, len(ids))
    number = frames.column_names.index("frame_id")
    frames = frames.set_column(number, "frame_id", pa.array(ids, frames["frame_id"].type))
    pq.write_table(frames, path)
    with pytest.raises(ConversionError, match=message):
        read_recording(open_site(folder), "r")


def test_an_unknown_category_is_refused_unless_mapped(tmp_path):
    track = writer.car(1, writer.frame_times(5.0), category="Hover-Craft")
    site = open_site(_site(tmp_path, [track]))
    with pytest.raises(ConversionError, match="'hover_craft' is unknown"):
        read_recording(site, "r")
    assert read_recording(site, "r", {"hover_craft": "van"}).categories == ("van",)


def test_a_track_twice_in_one_frame_is_refused(tmp_path):
    times = writer.frame_times(5.0)
    folder = _site(tmp_path, [writer.car(1, times), writer.car(1, times[5:6], x0=90.0)])
    with pytest.raises(ConversionError, match=r"object 1 has two rows at 0\.4 s"):
        read_recording(open_site(folder), "r")


def test_an_object_in_a_frame_that_does_not_exist_is_refused(tmp_path):
    folder = _site(tmp_path, [writer.car(1, writer.frame_times(6.0))], duration=5.0)
    with pytest.raises(ConversionError, match="not listed in frames"):
        read_recording(open_site(folder), "r")


@pytest.mark.parametrize("name", ["frame_id", "track_id", "category", "rotation_z"])
def test_a_missing_column_is_named(tmp_path, name):
    folder = _site(tmp_path)
    path = folder / "annotations/r/annotations.parquet"
    pq.write_table(pq.read_table(path).drop_columns([name]), path)
    with pytest.raises(ConversionError, match=name):
        read_recording(open_site(folder), "r")


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_damaged_files_never_escape_as_anything_but_an_error_of_ours(tmp_path_factory, data):
    folder = _site(tmp_path_factory.mktemp("fuzz"), duration=1.0)
    name = data.draw(
        st.sampled_from(
            ["data_meta.json", "annotations/r/annotations.parquet", "annotations/r/frames.parquet"]
        )
    )
    content = bytearray((folder / name).read_bytes())
    cut = data.draw(st.integers(0, len(content)))
    flips = data.draw(st.lists(st.integers(0, len(content) - 1), max_size=5))
    for at in flips:
        content[at] ^= data.draw(st.integers(1, 255))
    if data.draw(st.booleans()):
        content = content[:cut]
    (folder / name).write_bytes(bytes(content))
    try:
        site = open_site(folder)
        for recording in site.recordings:
            read_recording(site, recording)
    except ConversionError:
        return
    assert site.recordings
