"""Headings and velocities that follow from how objects move."""

from collections import Counter

import numpy as np
import pytest

from shiftsim.data.readers.motion import (
    contradiction,
    fitted_velocities,
    headings_of_motion,
    track_medians,
)


def test_a_standing_object_keeps_its_heading_or_gets_the_next():
    velocities = [(0, 0), (1, 1), (0, 0), (0, 0), (0, 0), (0, -2), (0, 0), (0.2, 0.2), (0, 0)]
    track, warnings = np.array([0, 0, 0, 1, 1, 2, 2, 3, 3]), Counter()
    found = headings_of_motion(np.array(velocities, np.float64), track, warnings)
    expected = np.pi * np.array([0.25, 0.25, 0.25, 0.0, 0.0, -0.5, -0.5, 0.0, 0.0])
    np.testing.assert_allclose(found, expected)
    assert warnings == {"tracks without heading that never move (heading 0)": 2}


def test_velocities_are_exact_for_parabolas_and_for_two_rows():
    time = np.array([0.0, 0.1, 0.2, 0.35, 0.4, 0.5, 0.6, 0.0, 0.1, 0.3])
    track = np.array([0] * 7 + [1] * 2 + [2])
    xy = np.column_stack([3.0 + 2.0 * time - 1.5 * time**2, 0.5 * time**2])
    found = fitted_velocities(xy, time, track, 0.1)
    expected = np.column_stack([2.0 - 3.0 * time, time])
    expected[7:] = [1.85, 0.05], [1.85, 0.05], [0.0, 0.0]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("speed", "stored", "is_wrong"),
    [
        (10.0, 10.99, False),
        (10.0, 11.01, True),
        (2.0, 2.29, False),
        (2.0, 1.69, True),
        (0.0, 0.3, False),
    ],
)
def test_velocities_contradict_from_a_tenth_of_the_speed_and_three_decimetres_on(
    speed, stored, is_wrong
):
    """The first and the last second, which are far off, are left out of a track of 3.2 s."""
    time, track = np.r_[0.0, 0.1, np.arange(33) * 0.1], np.repeat([0, 1], [2, 33])
    derived, given = np.full((2, 35, 2), [speed, 0.0])
    given[2:, 0] = np.where((time[2:] > 0.95) & (time[2:] < 2.25), stored, 99.0)
    wrong, share = contradiction(given, derived, time, track)
    assert wrong.tolist() == [False, is_wrong]
    assert share.tolist() == pytest.approx([0.0, abs(stored - speed) / max(speed, 0.3)])


def test_medians_are_those_of_each_track():
    values, track = np.array([3.0, 1.0, 2.0, 7.0, 5.0]), np.array([0, 0, 0, 2, 2])
    assert track_medians(values, track, 4).tolist()[::2] == [2.0, 6.0]
    assert np.isnan(track_medians(values, track, 4)[1::2]).all()
    both = track_medians(np.column_stack([values, -values]), track)
    np.testing.assert_array_equal(both[[0, 2]], [[2.0, -2.0], [6.0, -6.0]])
