"""From columns of a source to samples of tracks."""

import numpy as np
import pytest

from shiftsim.data.readers.build import make_samples
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
