"""Which axes are tried where vehicles lie beside the map."""

import numpy as np
import pytest
from worlds import straight_road

from shiftsim.data.readers.tracks.axes import _AXES, Guess, fit_map

ROAD = straight_road()  # 420 m x 7 m from (0, -1.75) on, 15 m/s
PLACES = np.column_stack([np.linspace(1.0, 419.0, 60), np.tile([-1.5, 5.0], 30)])
WAYS = np.tile([10.0, 0.0], (60, 1))


def test_axes_are_all_that_turn_by_quarters_or_mirror_and_stretch_nothing():
    axes = np.array([*_AXES.values()])
    assert len(np.unique(axes, axis=0)) == len(axes) == 8
    np.testing.assert_array_equal(axes @ axes.transpose(0, 2, 1), np.tile(np.eye(2), (8, 1, 1)))
    mirrored = [name for name in _AXES if "mirrored" in name or "swapped" in name]
    assert [name for name, one in _AXES.items() if np.linalg.det(one) < 0.0] == mirrored


def test_tracks_that_fit_say_how_fast_they_are():
    ways = WAYS * np.where(np.arange(60) < 7, 3.0, 1.0)[:, None]
    fit = fit_map(ROAD, PLACES, ways, 0.95)
    assert (fit.share, fit.along, fit.is_good, fit.best) == (1.0, 1.0, True, None)
    assert fit.overspeed == pytest.approx(30.0 / 15.0)  # of a tenth
    free = fit_map(straight_road(None), PLACES, ways, 0.95)
    assert (free.is_good, free.overspeed) == (True, 0.0)
    np.testing.assert_array_equal(fit.turned(ways), ways)


@pytest.mark.parametrize(
    ("against", "beside", "is_good"),
    [(0, 0, True), (18, 0, True), (19, 0, False), (0, 3, True), (0, 4, False)],
)
def test_shares_that_are_enough(against, beside, is_good):
    """7 of 10 must drive along their lanes, 95 % on drivable area."""
    ways, places = WAYS.copy(), PLACES.copy()
    ways[:against] *= -1.0
    places[len(places) - beside :, 1] = 99.0
    fit = fit_map(ROAD, places, ways, 0.95)
    assert fit.is_good == is_good
    assert fit.share == pytest.approx(1.0 - beside / 60.0)
    assert fit.along == pytest.approx(1.0 - against / (60.0 - beside))


@pytest.mark.parametrize("unit_and_size", [("m", 1.0), ("cm", 100.0), ("ft", 1.0 / 0.3048)])
@pytest.mark.parametrize(("axes", "mirrored"), [("", 1.0), ("with y mirrored", -1.0)])
def test_other_units_and_axes_are_found(unit_and_size, axes, mirrored):
    unit, size = unit_and_size
    if (unit, axes) == ("m", ""):
        return
    spoilt = size * np.array([1.0, mirrored])
    road = straight_road(offset=(0.0, 30.0))
    places, ways = (PLACES + np.array([0.0, 30.0])) * spoilt, WAYS * spoilt
    fit = fit_map(road, places, ways, 0.95)
    assert (fit.best.axes, fit.best.unit, fit.best.shift.tolist()) == (axes, unit, [0.0, 0.0])
    assert (fit.best.share, fit.best.along, fit.is_good) == (1.0, 1.0, False)
    np.testing.assert_allclose(fit.turned(ways), WAYS, rtol=0, atol=1e-9)
    if unit != "m":
        only = fit_map(road, places, ways, 0.95, only_metres=True)
        assert only.best is None or only.best.unit == "m"


def test_another_origin_is_found():
    places = np.column_stack([PLACES[:, 0] + 512.0, 2.5 * np.sin(1.7 * np.arange(60)) - 90.0])
    fit = fit_map(ROAD, places, WAYS, 0.95, only_metres=True)
    np.testing.assert_allclose(fit.best.shift, [-512.0, 91.75], rtol=0, atol=1.5)
    assert (fit.best.axes, fit.best.unit) == ("", "m")


@pytest.mark.parametrize(
    ("guess", "words", "remedies"),
    [
        (Guess("", "m", np.zeros(2), 1.0, 1.0), "", []),
        (Guess("", "cm", np.zeros(2), 1.0, 1.0), "in cm", ["[units] position = 'cm'"]),
        (
            Guess("", "m", np.array([0.0, -2.04]), 1.0, 1.0),
            "when shifted by (+0.0, -2.0) m",
            ["shift_m = [0.0, -2.0]"],
        ),
        (
            Guess("with y mirrored", "m", np.zeros(2), 1.0, 1.0),
            "with y mirrored",
            ["[columns] x = 'lon', y = '-up' ("],
        ),
        (
            Guess("turned by a quarter turn to the left", "m", np.zeros(2), 1.0, 1.0),
            "turned by a quarter turn to the left",
            ["[columns] x = '-up', y = 'lon' ("],
        ),
    ],
)
def test_a_guess_says_what_to_write(guess, words, remedies):
    assert guess.words == words
    found = guess.remedies("lon", "up")
    assert len(found) == len(remedies)
    assert all(one.startswith(start) for one, start in zip(found, remedies, strict=True))
    twice = Guess("with y mirrored", "m", np.zeros(2), 1.0, 1.0).remedies("x", "-y")
    assert twice[0].startswith("[columns] x = 'x', y = 'y'")


@pytest.mark.parametrize(("mirrored", "axes"), [(6, "with y mirrored"), (4, None), (5, None)])
def test_other_axes_must_fit_better_by_three_percent(mirrored, axes):
    """Of 100 places 88 are on the road either way, 2 as they are, and some mirrored."""
    y = np.repeat([0.0, 4.0, -4.0, 99.0], [88, 2, mirrored, 10 - mirrored])
    places = np.column_stack([np.linspace(1.0, 419.0, 100), y])
    fit = fit_map(ROAD, places, np.tile([10.0, 0.0], (100, 1)), 0.95, only_metres=True)
    assert (None if fit.best is None else fit.best.axes) == axes
    assert (fit.share, fit.is_good) == (0.9, False)
