"""Windows of recordings made by hand, and who may be an ego in them."""

import numpy as np
import pytest
from recordings import driving
from worlds import straight_road

from shiftsim.data.readers.scenarios import make_scenarios, require_scenarios
from shiftsim.data.readers.windows import ConversionConfig, Span, evaluate_windows, window_spans
from shiftsim.errors import ConfigError, ConversionError

ROAD = straight_road()
SHORT = ConversionConfig(window_s=3.0, overlap_s=1.0, history_s=1.0, ego_categories=("vehicle",))


@pytest.mark.parametrize(
    ("length", "history", "is_short"),
    [(18.0, 3.0, False), (17.95, 3.0, True), (18.0, 2.95, True), (20.0, 4.0, False)],
)
def test_windows_shorter_than_the_benchmarks_are_marked(length, history, is_short):
    assert Span(1.0, length, history).is_short == is_short
    config = ConversionConfig(window_s=length, overlap_s=0.0, history_s=history)
    assert config.is_short == is_short


@pytest.mark.parametrize(
    ("fast", "verdict"),
    [
        ([20], "speed"),
        ([20, 21], "ego"),
        ([20, 22], "ego"),
        ([20, 23], "speed"),
        ([0], "ego"),  # nothing to compare the ends of a track with
        ([40], "ego"),
    ],
)
def test_a_peak_is_that_of_the_median_of_three_frames(fast, verdict):
    samples = driving((0.0, 4.0, 10.0, 0.0, 0.0), (0.0, 4.0, 50.0, 0.0, 0.0))
    samples.velocities[np.array(fast) + 41, 0] = 9.0
    (found,) = evaluate_windows(samples, SHORT, [Span(0.0, 4.05, 1.0)])
    assert found.verdicts == ("speed", verdict)


@pytest.mark.parametrize(
    ("first", "last", "verdicts"),
    [
        (0.0, 9.0, "ego ego ego ego"),
        (0.1, 9.0, "presence ego ego ego"),
        (2.0, 8.9, "presence ego ego ego"),
        (2.1, 8.8, "presence presence ego presence"),
        (4.0, 6.9, "- presence ego presence"),
        (6.8, 9.0, "- - presence presence"),
        (7.0, 9.0, "- - - presence"),
    ],
)
def test_an_ego_is_there_throughout_a_window(first, last, verdicts):
    """Windows of 3 s begin every 2 s; another object is there all the time."""
    samples = driving((0.0, 9.0, 10.0, 0.0, 5.0), (first, last, 60.0, 0.0, 5.0))
    found = evaluate_windows(samples, SHORT, window_spans(9.0, SHORT))
    assert [window.span.start_s for window in found] == [0.0, 2.0, 4.0, 6.0]
    assert [dict(zip(w.tracks.tolist(), w.verdicts, strict=True)).get(1, "-") for w in found] == (
        verdicts.split()
    )


def test_named_egos_are_taken_for_their_own_time():
    """Of the second object from its first row on; of the first as far as windows fit."""
    objects = (0.0, 8.0, 10.0, 0.0, 5.0), (1.03, 4.5, 60.0, 0.0, 5.0), (0.0, 9.0, 10.0, 3.5, 5.0)
    made = make_scenarios(driving(*objects, hz=100), ROAD, config=SHORT, egos=["1", "0"])
    found = [(w.ego, w.first_row, w.last_row, int(w.iteration_rows[0])) for w in made.windows]
    assert found == [
        ("0", 0, 60, 20),
        ("1", 21, 81, 41),
        ("0", 40, 100, 60),
        ("0", 80, 140, 100),
    ]
    assert (made.summary.seen, made.summary.accepted, made.summary.rejected) == (4, 4, {})
    with pytest.raises(ConfigError, match="no object has the id '7'") as error:
        make_scenarios(driving(*objects), ROAD, config=SHORT, egos=["0", "7"])
    assert "there are 3, such as 0, 1, 2" in str(error.value.hint)


def test_a_scenario_is_one_window_of_one_ego():
    objects = [(0.0, 6.0, 10.0, 0.0, 5.0), (0.0, 6.0, 30.0, 0.0, 5.0), (0.0, 6.0, 10.0, 3.5, 0.0)]
    made = make_scenarios(driving(*objects), ROAD, config=SHORT, metadata={"source": "hand"})
    assert [(w.first_row, w.ego) for w in made.windows] == [
        (0, "0"),
        (0, "1"),
        (40, "0"),
        (40, "1"),
    ]
    window = made.windows[2]
    assert window.iteration_rows.tolist() == list(range(60, 100, 2))
    assert (window.last_row, window.row_step, window.is_short) == (100, 2, True)
    assert (window.log_name, window.route) == (made.egos[0].log_name, ("1", "2"))
    assert window.mapping == (2.0, 0.0, 0.5)
    # the place of the rear axle where the object is seen last
    assert window.mission_goal.tolist() == pytest.approx([40.0 - 1.461, 0.0, 0.0])
    assert window.metadata == {
        "recording": "r",
        "window": 1,
        "window_start_s": 2.0,
        "track_id": 0,
        "category": "vehicle",
        "size_m": [4.6, 1.9],
        "driven_blocks": 1,
        "padded_history_s": 0.0,
        "duration_class": window.metadata["duration_class"],
        "source": "hand",
    }
    assert len({w.token for w in made.windows}) == 4
    assert made.summary.rejected == {"speed": 2}
    assert (made.summary.windows, made.summary.seen, made.summary.candidates) == (2, 6, 4)
    assert [ego.name for ego in made.egos] == ["0", "1"]
    np.testing.assert_allclose(made.egos[0].states[60, :4], [10.0 - 1.461 + 15.0, 0.0, 0.0, 5.0])


def test_at_most_so_many_egos_of_a_window_are_taken():
    objects = [(0.0, 4.0, 10.0 + 50.0 * n, 0.0, 5.0 * (n != 1)) for n in range(4)]
    config = ConversionConfig(
        window_s=4.0, overlap_s=0.0, history_s=1.0, ego_categories=("vehicle",), max_per_window=2
    )
    made = make_scenarios(driving(*objects), ROAD, config=config)
    assert [w.ego for w in made.windows] == ["0", "2"]
    assert made.summary.rejected == {"beyond max_per_window": 1, "speed": 1}
    require_scenarios(made.summary, "file")


@pytest.mark.parametrize(
    ("objects", "message", "hint"),
    [
        ([(0.0, 2.1, 10.0, 0.0, 5.0)], "2.1 s long, too short", "unit of time"),
        ([(0.0, 4.0, 10.0, 0.0, 0.0)], "1 pairs .* by the rules speed 1", "all vehicles stand"),
        (
            [(0.0, 4.0, 10.0, 0.0, 5.0), (0.0, 4.0, 10.0, 0.5, 5.0), (0.0, 4.0, 90.0, 0.0, 0.0)],
            "3 pairs .* by the rules overlap 2, speed 1",
            "boxes lie on one another",
        ),
        ([(0.0, 4.0, 10.0, -9.0, 5.0)], "by the rules lane 1", "beside the lanes"),
    ],
)
def test_a_recording_without_scenarios_says_which_rule_dropped_most(objects, message, hint):
    config = ConversionConfig(window_s=4.0, overlap_s=0.0, ego_categories=("vehicle",))
    made = make_scenarios(driving(*objects), ROAD, config=config)
    with pytest.raises(ConversionError, match=message) as error:
        require_scenarios(made.summary, "file")
    assert hint in str(error.value.hint)
