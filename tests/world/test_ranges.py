"""Ranges: what is in them, and what the error says of the rest."""

import numpy as np
import pytest

from shiftsim.errors import DataError, MapError
from shiftsim.world.ranges import FORMATS, Range, require

TABLE = {"speed": Range(0.0, 100.0, "m/s")}


@pytest.mark.parametrize("values", [0.0, 100, np.array([1, 2]), np.zeros((2, 0)), np.array([5.5])])
def test_values_in_range_pass(values):
    require(TABLE, "speed", values, "a.db: column")


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (-1, "a.db: column 'speed': -1 is beyond 0 … 100 m/s"),
        (float("nan"), "a.db: column 'speed': nan is not a finite number"),
        (np.array([0, 1, 300, 400]), "a.db: column 'speed', row 2: 300 is beyond"),
        (np.array([0.0, np.nan, 1e300]), "row 1: nan is not a finite number (2 such values)"),
        (np.array([[0.0, 1.0], [2.0, np.inf]]), "row 1: inf is not a finite number"),
        (10**400, "a.db: column 'speed': 1.797693135e+308 is beyond"),
        (2**63, "a.db: column 'speed': 9.223372037e+18 is beyond"),
    ],
)
def test_the_first_value_outside_is_named(values, text):
    with pytest.raises(MapError) as caught:
        require(TABLE, "speed", values, "a.db: column", error=MapError)
    assert text in str(caught.value)
    assert caught.value.hint


def test_a_missing_value_may_be_nan():
    require(TABLE, "speed", np.array([1.0, np.nan]), "a", may_be_nan=True)
    with pytest.raises(DataError, match=r"row 1: 200 is beyond .* m/s\n"):
        require(TABLE, "speed", np.array([np.nan, 200.0]), "a", may_be_nan=True)


def test_every_range_has_two_finite_ends():
    for table in FORMATS.values():
        for field, allowed in table.items():
            assert np.isfinite([allowed.low, allowed.high]).all(), field
            assert allowed.low < allowed.high, field
