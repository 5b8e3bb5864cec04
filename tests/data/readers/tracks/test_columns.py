"""What names of columns and overrides tell."""

import numpy as np
import pytest

from shiftsim.data.readers.tracks.columns import recognise
from shiftsim.errors import ConfigError

NAMES = ["id", "Time [ms]", "x_km", "y (feet)", "kind", "Heading_degrees", "vx-km/h", "width.cm"]


def test_names_tell_units_in_any_of_their_spellings():
    found = recognise(NAMES, {}, "t.csv").found
    assert {role: column.name for role, column in found.items()} == dict(
        zip(("id", "time", "x", "y", "kind", "heading", "vx", "width"), NAMES, strict=True)
    )
    factors = {role: found[role].factor(role) for role in ("time", "x", "y", "vx", "width")}
    assert factors == {"time": 1e3, "x": 1e3, "y": 0.3048, "vx": 1 / 3.6, "width": 0.01}
    assert found["heading"].factor("heading") == pytest.approx(np.pi / 180.0)


@pytest.mark.parametrize(
    ("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 1e-3), ("ft", 0.3048), ("km", 1e3)]
)
def test_a_unit_that_is_said_goes_before_the_name(unit, metres):
    found = recognise(NAMES, {"units": {"position": unit}}, "t.csv").found
    assert [found[role].factor(role) for role in "xy"] == [metres, metres]


def test_a_shift_or_rate_of_a_billion_is_the_most():
    columns = recognise(NAMES, {"shift_m": [1e9, -1e9], "hz": 1e9}, "t.csv")
    assert (columns.shift, columns.hz) == ((1e9, -1e9), 1e9)
    for wrong in ({"shift_m": [0.0, -1.1e9]}, {"hz": 1.1e9}, {"hz": 0.0}):
        with pytest.raises(ConfigError, match="is"):
            recognise(NAMES, wrong, "t.csv")
