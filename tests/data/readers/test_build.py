"""From columns of a source to samples of tracks."""

import numpy as np
import pytest

from shiftsim.data.readers.build import find_pause, find_twice, make_samples
from shiftsim.data.readers.codes import KINDS
from shiftsim.errors import ConversionError
from shiftsim.world.state import AgentKind

USUAL = {
    AgentKind.VEHICLE: (4.6, 1.9),
    AgentKind.PEDESTRIAN: (0.7, 0.7),
    AgentKind.BICYCLE: (1.8, 0.6),
    AgentKind.TRAFFIC_CONE: (0.4, 0.4),
    AgentKind.BARRIER: (2.0, 0.5),
    AgentKind.CZONE_SIGN: (0.5, 0.5),
    AgentKind.GENERIC_OBJECT: (1.0, 1.0),
}


def columns(kinds, rows=4, hz=10):
    """Objects 10 m apart that move along +x at 2 m/s."""
    which, step = np.repeat(np.arange(len(kinds)), rows), np.tile(np.arange(rows), len(kinds))
    return {
        "time_us": 1_000_000 * step // hz,
        "ids": which,
        "category": np.array(kinds)[which],
        "xy": np.column_stack([2.0 * step / hz, 10.0 * which]),
    }


def test_objects_of_unknown_size_are_as_large_as_usual():
    samples = make_samples("r", **columns([int(kind) for kind in USUAL]))
    np.testing.assert_array_equal(samples.sizes[:, :2], list(USUAL.values()))
    np.testing.assert_allclose(samples.raw_headings, 0.0, rtol=0, atol=1e-9)
    assert samples.period == 0.1
    assert samples.warnings["tracks without size (that of their kind)"] == len(USUAL)


def test_the_size_of_a_track_is_the_median_of_the_rows_that_have_one():
    given = np.array([[4.0, 2.0], [0.0, 2.0], [5.0, 1.0], [4.4, 1.8]])
    samples = make_samples("r", **columns([0]), sizes=given)
    np.testing.assert_allclose(samples.sizes, [[4.4, 1.8]])


def test_rows_at_one_time_are_refused():
    with pytest.raises(ConversionError, match="3 rows at one time"):
        make_samples("r", **columns([0, 0, 1], rows=1))
    late = columns([0], rows=6)
    late["time_us"][4:] += 86_399_800_000
    with pytest.raises(ConversionError, match=r"no object has a row between 0.3 s and 86400.2 s"):
        make_samples("r", **late)


def test_a_track_goes_on_as_another_run_after_a_long_hole():
    given = columns([0, 1], rows=20)
    given["time_us"][30:] += 500_000  # of the second object, from its row 10 on
    whole = make_samples("r", **given).runs
    assert (whole.first.tolist(), whole.last.tolist()) == ([0, 20], [19, 39])
    given["time_us"][30:] += 2
    split = make_samples("r", **given).runs
    assert (split.first.tolist(), split.last.tolist()) == ([0, 20, 30], [19, 29, 39])
    assert (split.track.tolist(), list(split.tokens)) == ([0, 1, 1], ["0", "1", "1_2"])


@pytest.mark.parametrize(
    ("category", "size"),
    [
        ("car", (4.6, 1.9)),
        ("medium_vehicle", (6.0, 2.2)),
        ("bus", (12.0, 2.5)),
        ("hgv", (12.0, 2.5)),
    ],
)
def test_large_vehicles_of_unknown_size_are_large(category, size):
    made = make_samples("r", **columns([0]), categories=[category], kind_of=KINDS)
    np.testing.assert_array_equal(made.sizes, [size])


def test_the_category_of_a_track_is_its_most_frequent_one():
    given = columns([0, 0, 0], rows=4)
    given["category"] = np.array([1, 2, 2, 1, 0, 2, 2, 2, 1, 1, 1, 1])
    made = make_samples("r", **given, categories=["car", "bus", "person"])
    assert made.categories == ("bus", "person", "bus")  # the first one of as many
    assert made.kinds.tolist() == [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.VEHICLE]
    assert made.warnings["tracks of changing category (most frequent taken)"] == 2
    with pytest.raises(ConversionError, match=r"f\.csv: category 'tank' is unknown"):
        make_samples("r", **given, categories=["tank", "tank", "car"], where="f.csv")


def test_velocities_faster_than_any_are_not_believed():
    given, velocities = columns([0, 0, 0]), np.tile([2.0, 0.0], (12, 1))
    velocities[[1, 5]] = [[2.0, -200.1], [2.0, 200.0]]
    velocities[8, 0] = np.nan
    made = make_samples("r", **given, velocities=velocities)
    expected = velocities.copy()
    expected[1] = expected[8] = 2.0, 0.0
    np.testing.assert_allclose(made.velocities, expected, rtol=0, atol=1e-9)
    assert made.warnings["tracks without stored velocity (derived)"] == 1
    assert made.warnings["tracks whose stored velocity does not fit (derived)"] == 1


def test_headings_that_are_not_given_are_those_of_motion():
    headings = np.array([0.3, np.nan, np.nan, -0.2])
    made = make_samples("r", **columns([0]), headings=headings)
    np.testing.assert_allclose(made.raw_headings, [0.3, 0.0, 0.0, -0.2], rtol=0, atol=1e-9)
    assert made.warnings["rows without heading (direction of motion)"] == 2
    for what, wrong in (
        ("position", {"xy": np.full((4, 2), np.inf)}),
        (
            "heading",
            {"headings": np.array([0.0, np.inf, 0.0, 0.0])},
        ),
    ):
        with pytest.raises(ConversionError, match=f"values of {what} are not finite"):
            make_samples("r", **{**columns([0]), **wrong})


def test_objects_with_clocks_of_their_own_get_a_common_one():
    """Rows of each are 0.1 s apart; the third one is too short for a row every 0.05 s."""
    time_us = np.concatenate([100_000 * np.arange(9), 100_000 * np.arange(3, 11) + 33_000])
    time_us = np.concatenate([time_us, [510_000, 520_000], 100_000 * np.arange(10) + 67_000])
    which = np.repeat([0, 1, 2, 3], [9, 8, 2, 10])
    x = 50.0 * which + 3.0 * time_us * 1e-6
    made = make_samples(
        "r",
        time_us=7_000_000 + time_us,
        ids=which,
        category=which,
        categories=["car", "bus", "person", "bicycle"],
        xy=np.column_stack([x, 2.0 * which]),
        headings=0.1 * which,
    )
    assert (made.period, made.start_us) == (0.05, 7_000_000)
    # what is seen within 0.1 s of an end of the recording is there at its first or last row
    spans = [range(17), range(7, 21), range(21)]
    assert made.track_ids.tolist() == [0, 1, 3]
    for track, rows in enumerate(spans):
        assert made.frame[made.track == track].tolist() == [*rows]
    name = made.track_ids[made.track]
    expected = np.column_stack([50.0 * name + 3.0 * made.time, 2.0 * name])
    np.testing.assert_allclose(made.xy, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(made.velocities, np.tile([3.0, 0.0], (len(name), 1)), atol=1e-9)
    np.testing.assert_allclose(made.headings, 0.1 * name, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(made.headings, made.raw_headings)
    np.testing.assert_array_equal(made.clock, np.arange(21) / 20.0)
    assert made.categories == ("car", "bus", "bicycle")
    assert made.kinds.tolist() == [AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.BICYCLE]
    assert made.sizes.tolist() == [[4.6, 1.9], [12.0, 2.5], [1.8, 0.6]]
    assert made.warnings["tracks too short for a row every 0.05 s (left out)"] == 1


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        ([0, 3600, 7200], ""),
        ([0, 3600.000001], "no object has a row between 0 s and 3600 s"),
        ([*range(0, 100_001, 2500)], ""),
        ([*range(0, 97_501, 2500), 100_001], "the rows span 100001 s"),
    ],
)
def test_pauses_of_an_hour_and_spans_of_a_day_are_the_most(seconds, words):
    fault = find_pause(1_000_000 + np.rint(np.array(seconds) * 1e6).astype(np.int64))
    assert (fault[0] if fault else "").startswith(words)
    assert bool(fault) == bool(words)


def test_an_object_is_once_at_a_time():
    track, time = np.array([0, 0, 1, 1, 1]), np.array([0.0, 1.0, 1.0, 2.0, 2.0])
    assert find_twice(np.array(["a", "b"]), track, time)[0].startswith(
        "object 'b' has two rows at 2 s"
    )
    assert find_twice(np.array(["a", "b"]), track, time + (track * [0, 0, 0, 0, 1])) is None
