import dataclasses
import re

import dsc3d_writer as writer
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter

from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.dsc3d import convert_dsc3d, open_site, read_recording
from shiftsim.data.readers.samples import ego_states, resample, slope
from shiftsim.data.readers.scenarios import _spans
from shiftsim.data.readers.windows import (
    ConversionConfig,
    Span,
    evaluate_windows,
    make_config,
    overlap_partners,
    window_spans,
)
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, ConversionError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.world import state

CONFIG = ConversionConfig()


def _recording(tmp_path, tracks, duration=18.08, **kwargs):
    site = open_site(writer.write_site(tmp_path / "s", tracks, duration, **kwargs))
    return read_recording(site, "r")


def _verdicts(tmp_path, tracks, duration=18.08, config=CONFIG):
    recording = _recording(tmp_path, tracks, duration)
    return [
        dict(zip(recording.track_ids[w.tracks].tolist(), w.verdicts, strict=True))
        for w in evaluate_windows(recording, config, window_spans(duration, config))
    ]


@pytest.mark.parametrize(
    ("duration", "count"), [(17.9, 0), (17.92, 0), (18.0, 1), (29.9, 1), (30.0, 2), (42.04, 3)]
)
def test_windows_are_counted_in_time(duration, count):
    assert len(window_spans(duration, CONFIG)) == count


def test_a_moving_car_that_is_always_there_is_an_ego(tmp_path):
    assert _verdicts(tmp_path, [writer.car(1, writer.frame_times(18.08))]) == [{1: "ego"}]


@pytest.mark.parametrize(("speed", "verdict"), [(1.0, "speed"), (1.001, "ego")])
def test_a_peak_of_exactly_one_metre_per_second_is_not_enough(tmp_path, speed, verdict):
    tracks = [writer.car(1, writer.frame_times(18.08), speed=speed)]
    assert _verdicts(tmp_path, tracks) == [{1: verdict}]


def test_one_noisy_frame_of_speed_does_not_make_a_parked_car_an_ego(tmp_path):
    track = writer.car(1, writer.frame_times(18.08), speed=0.0)
    track["velocity"][50, 0] = 3.0
    assert _verdicts(tmp_path, [track]) == [{1: "speed"}]


@pytest.mark.parametrize(("hole", "verdict"), [(0.3, "ego"), (0.48, "ego"), (0.8, "presence")])
def test_holes_are_filled_up_to_half_a_second(tmp_path, hole, verdict):
    times = writer.frame_times(18.08)
    kept = times[(times <= 6.0) | (times > 6.0 + hole + 0.04)]
    assert _verdicts(tmp_path, [writer.car(1, kept)]) == [{1: verdict}]


@pytest.mark.parametrize("category", ["truck", "bus", "motorcycle", "pedestrian", "trailer"])
def test_only_passenger_cars_are_egos(tmp_path, category):
    tracks = [writer.car(1, writer.frame_times(18.08), category=category)]
    assert _verdicts(tmp_path, tracks) == [{1: "category"}]


def test_boxes_that_overlap_at_one_frame_disqualify_each_other(tmp_path):
    times = writer.frame_times(18.08)
    other = writer.car(2, times[100:101], x0=20.0, category="pedestrian", size=(0.6, 0.6))
    assert _verdicts(tmp_path, [writer.car(1, times), other]) == [{1: "overlap", 2: "category"}]


def test_two_cars_of_one_window_are_both_egos(tmp_path):
    times = writer.frame_times(18.08)
    tracks = [writer.car(1, times), writer.car(2, times, x0=60.0)]
    assert _verdicts(tmp_path, tracks) == [{1: "ego", 2: "ego"}]


@given(
    st.tuples(*[st.floats(-3, 3)] * 2, st.floats(-4, 4), *[st.floats(0.3, 6)] * 2),
    st.tuples(*[st.floats(-3, 3)] * 2, st.floats(-4, 4), *[st.floats(0.3, 6)] * 2),
)
def test_boxes_overlap_where_they_share_more_than_the_limit(a, b):
    box = np.array([a, b] * 2)
    samples = make_samples(
        "r",
        time_us=np.array([0, 0, 50_000, 50_000]),
        ids=np.array([1, 2] * 2),
        category=np.zeros(4, np.int64),
        xy=box[:, :2],
        headings=box[:, 2],
        sizes=box[:, 3:],
    )
    rings = [boxes_to_corners(row[:3], row[3:]) for row in box[:2]]
    area = shapely.Polygon(rings[0]).intersection(shapely.Polygon(rings[1])).area
    both = np.ones(2, np.bool_)
    assert (overlap_partners(samples, both, area + 1e-6) == -1).all()
    if area > 1e-5:
        assert overlap_partners(samples, both, area - 1e-6).tolist() == [1, 1, 0, 0]


def test_the_heading_is_interpolated_the_short_way_round(tmp_path):
    times = writer.frame_times(2.0)
    yaw = np.where(np.arange(len(times)) % 2 == 0, 3.1, -3.1)
    recording = _recording(tmp_path, [writer.car(1, times, yaw=yaw)], duration=2.0)
    out = resample(recording, "r", "c")
    assert (np.abs(out.tracks.poses[:, 0, 2]) > 3.09).all()


def test_rows_are_linear_in_time_and_never_stretched(tmp_path):
    recording = _recording(tmp_path, [writer.car(1, writer.frame_times(18.08))])
    out = resample(dataclasses.replace(recording, offset=np.array([1e5, 5e6])), "r", "c")
    rows = np.arange(len(out.time_us))
    np.testing.assert_array_equal(out.time_us, writer.START_US + 50_000 * rows)
    np.testing.assert_allclose(
        out.tracks.poses[:, 0, 0], 1e5 + 20.0 + 8.0 * 0.05 * rows, rtol=0, atol=1e-9
    )


def test_a_long_hole_splits_a_track_in_two(tmp_path):
    times = writer.frame_times(10.0)
    recording = _recording(tmp_path, [writer.car(1, times[(times < 4) | (times > 6)])], 10.0)
    out = resample(recording, "r", "c")
    assert out.tracks.tokens == ("1", "1_2")
    assert not out.tracks.valid[100].any()


def test_padding_continues_the_motion_backwards(tmp_path):
    recording = _recording(tmp_path, [writer.car(1, writer.frame_times(5.0))], 5.0)
    out = resample(recording, "r", "c", padding=40)
    assert out.time_us[0] == writer.START_US - 2_000_000
    np.testing.assert_allclose(out.tracks.poses[0, 0, 0], 20.0 - 16.0, rtol=0, atol=1e-9)


def test_slope_is_exact_for_parabolas_also_at_the_ends():
    t = np.arange(40) * 0.05
    np.testing.assert_allclose(
        slope(3.0 + 2.0 * t - 1.5 * t**2, 0.05), 2.0 - 3.0 * t, rtol=0, atol=1e-9
    )


def test_slope_is_the_one_of_savitzky_and_golay(rng):
    values = rng.normal(size=40)
    expected = savgol_filter(values, 11, 2, deriv=1, delta=0.05, mode="interp")
    np.testing.assert_allclose(slope(values, 0.05), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "spans"),
    [(45, []), (46, [Span(5.0, 2.3, 2.0, 3)]), (47, [Span(5.0, 2.35, 2.0, 3)])],
)
def test_where_no_window_fits_a_short_one_does_from_two_seconds_on(rows, spans):
    assert list(_spans(100, rows, 3, CONFIG)) == spans


def test_the_ego_turns_about_its_rear_axle():
    t = np.arange(100) * 0.05
    rate, speed = 0.3, 6.0
    radius = speed / rate
    rear = np.column_stack([radius * np.sin(rate * t), radius * (1 - np.cos(rate * t)), rate * t])
    lever = state.PACIFICA.rear_axle_to_center
    center = state.center_poses(rear)
    velocity = speed * np.column_stack([np.cos(rate * t), np.sin(rate * t)])
    velocity += lever * rate * np.column_stack([-np.sin(rate * t), np.cos(rate * t)])
    states = ego_states(center, velocity)
    np.testing.assert_allclose(states[:, :3], rear, rtol=0, atol=1e-9)
    np.testing.assert_allclose(states[:, state.VX], speed, rtol=0, atol=1e-9)
    np.testing.assert_allclose(states[:, state.VY], 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(states[:, state.AY], speed * rate, rtol=0, atol=1e-9)


def test_a_recording_becomes_scenarios_of_the_benchmark_s_form(tmp_path):
    times = writer.frame_times(30.0)
    tracks = [writer.car(1, times), writer.car(2, times, x0=380.0, y=1.75, speed=-8.0)]
    tracks[1]["rotation"][:, 2] = np.pi
    folder = writer.write_site(tmp_path / "s", tracks, 30.0)
    report = convert_dsc3d(folder, tmp_path / "store", site="town")
    store = ScenarioStore(tmp_path / "store")
    assert report.accepted == len(store) == 4
    scene = next(s for s in store if s.ego[0, state.X] == pytest.approx(500_020 - 1.461, abs=1e-6))
    assert scene.num_iterations == 150
    assert scene.iteration_rows[:2].tolist() == [60, 62]
    assert scene.mapping == (15.0, 0.0, 0.5)
    assert scene.scenario_type == "unlabelled"
    assert scene.tracks.tokens == ("2",)
    assert scene.city == "town"
    assert scene.mission_goal[0] == pytest.approx(500_020 + 240 - 1.461, abs=1e-6)


@pytest.mark.parametrize(("y", "rows"), [(203.4, 0), (203.6, 227), (-203.4, 0), (-203.6, 227)])
def test_rows_more_than_two_hundred_metres_outside_of_the_map_are_counted(tmp_path, y, rows):
    """The road reaches 3.5 m to either side."""
    times = writer.frame_times(18.08)
    tracks = [writer.car(1, times), writer.car(2, times, y=y, speed=0.9)]
    folder = writer.write_site(tmp_path / "s", tracks, 18.08)
    (summary,) = convert_dsc3d(folder, tmp_path / "store").recordings
    assert summary.warnings.get("rows far outside the map", 0) == rows


def test_a_car_far_from_any_lane_is_rejected_by_name(tmp_path):
    times = writer.frame_times(18.08)
    tracks = [writer.car(1, times), writer.car(2, times, y=-12.0, speed=0.9)]
    tracks += [writer.car(3, times, y=20.0), *(writer.car(n, times, x0=9.0 * n) for n in ())]
    config = dataclasses.replace(CONFIG, min_drivable_share=0.4)
    folder = writer.write_site(tmp_path / "s", tracks, 18.08)
    report = convert_dsc3d(folder, tmp_path / "store", options=config)
    assert report.recordings[0].rejected == {"lane": 1, "speed": 1}


def test_a_wrong_placement_stops_with_the_shift_that_fits(tmp_path):
    times = writer.frame_times(18.08)
    track = writer.car(1, times)
    track["translation"] += [-3.0, 60.0, 0.0]
    folder = writer.write_site(tmp_path / "s", [track], 18.08)
    with pytest.raises(ConversionError, match="only 0%") as caught:
        convert_dsc3d(folder, tmp_path / "store")
    assert "-6" in caught.value.hint or "-5" in caught.value.hint
    assert not (tmp_path / "store").exists()


def test_a_map_with_another_georeference_is_refused(tmp_path):
    times = writer.frame_times(18.08)
    road = writer.straight_road().replace(
        '<header revMajor="1" revMinor="7"/>',
        '<header revMajor="1" revMinor="7"><geoReference>EPSG:32632</geoReference>'
        '<offset x="500300" y="5300000" z="0" hdg="0"/></header>',
    )
    folder = writer.write_site(tmp_path / "s", [writer.car(1, times)], 18.08, road=road)
    with pytest.raises(ConversionError, match="500300"):
        convert_dsc3d(folder, tmp_path / "store")


def test_a_map_that_carries_its_utm_offset_is_placed_once(tmp_path):
    times = writer.frame_times(18.08)
    road = writer.straight_road().replace(
        '<header revMajor="1" revMinor="7"/>',
        '<header revMajor="1" revMinor="7"><geoReference>EPSG:32632</geoReference>'
        '<offset x="500000" y="5300000" z="0" hdg="0"/></header>',
    )
    folder = writer.write_site(tmp_path / "s", [writer.car(1, times)], 18.08, road=road)
    assert convert_dsc3d(folder, tmp_path / "store").details["drivable_share"] == 1.0


def test_a_short_recording_is_converted_with_a_short_window_and_marked(tmp_path):
    folder = writer.write_site(tmp_path / "s", [writer.car(1, writer.frame_times(4.96))], 4.96)
    config = ConversionConfig(window_s=4.0, overlap_s=1.0, history_s=1.0, padding_s=2.0)
    assert convert_dsc3d(folder, tmp_path / "store", options=config).accepted == 1
    scene = next(iter(ScenarioStore(tmp_path / "store")))
    assert scene.is_short
    assert scene.iteration_rows[0] == 60
    assert scene.num_iterations == 30


def test_two_conversions_give_the_same_bytes(tmp_path):
    folder = writer.write_site(tmp_path / "s", [writer.car(1, writer.frame_times(18.08))], 18.08)
    for name in ("a", "b"):
        convert_dsc3d(folder, tmp_path / name, site="town")
    assert ScenarioStore(tmp_path / "a").hash == ScenarioStore(tmp_path / "b").hash


@pytest.mark.parametrize(
    "setting", [{"window_s": 18.03}, {"overlap_s": 18.0}, {"history_s": 17.9}, {"padding_s": -1.0}]
)
def test_settings_that_cannot_work_are_refused(setting):
    with pytest.raises(ConfigError):
        ConversionConfig(**setting)


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("route_extension_blocks", (0, 2), (-1, 1.5, True)),
        ("max_per_window", (None, 1), (0, -1, 2.0)),
        ("country", ("DE",), (49,)),
        ("max_overlap", (0, 0.0), (-0.1, float("inf"), "1")),
    ],
)
def test_settings_of_a_conversion_are_of_their_type(name, good, bad):
    for value in good:
        assert getattr(make_config({name: value}), name) == value
    for value in bad:
        with pytest.raises(ConfigError, match=f"{name} is {re.escape(repr(value))}; it must be"):
            make_config({name: value})
