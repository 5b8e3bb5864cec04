"""Comfort signals: filters, edges, bounds."""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from shiftsim.errors import DataError
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, comfort_signals, within_bounds
from shiftsim.metrics.result import DEEPPLAN, NUPLAN
from shiftsim.world.state import AX, AY, HEADING, NUM_STATE, YAW_ACCEL, YAW_RATE


def times(count: int) -> np.ndarray:
    # from 0 on: seconds since 1970 in float64 are only good to 2e-7 s
    return 100_000 * np.arange(count, dtype=np.int64)


def states_with(column: int, values: np.ndarray) -> np.ndarray:
    states = np.zeros((len(values), NUM_STATE))
    states[:, column] = values
    return states


def test_smoothing_of_a_ramp_jumps_half_a_sample_between_edge_and_interior() -> None:
    signals = comfort_signals(times(20), states_with(AX, np.arange(20.0)))
    expected = [0, 1, 2, 3, *np.arange(4.5, 16.0), 16, 17, 18, 19]
    np.testing.assert_allclose(signals.lon_accel, expected, rtol=0, atol=1e-9)


def test_yaw_rate_of_a_uniform_turn_is_its_rate_across_the_wrap() -> None:
    heading = (3.0 + 0.05 * np.arange(30) + np.pi) % (2 * np.pi) - np.pi
    signals = comfort_signals(times(30), states_with(HEADING, heading))
    np.testing.assert_allclose(signals.yaw_rate, 0.5, rtol=0, atol=1e-8)
    np.testing.assert_allclose(signals.yaw_accel, 0.0, rtol=0, atol=1e-8)


def test_yaw_acceleration_leaks_into_the_longitudinal_acceleration_at_the_centre() -> None:
    states = states_with(YAW_ACCEL, np.full(20, 2.0))
    states[:, YAW_RATE] = 1.0
    signals = comfort_signals(times(20), states)
    np.testing.assert_allclose(signals.lon_accel, 3 * 1.461, rtol=0, atol=1e-8)
    np.testing.assert_allclose(signals.mag_accel, 0.0, rtol=0, atol=1e-8)


@pytest.mark.parametrize("count", [4, 5, 7, 8, 9, 14, 15, 16, 151])
def test_signals_agree_with_scipy_at_every_length(count: int, rng: np.random.Generator) -> None:
    states = rng.normal(size=(count, NUM_STATE))
    states[:, [YAW_RATE, YAW_ACCEL]] = 0.0
    signals = comfort_signals(times(count), states)
    smooth = np.round(savgol_filter(states[:, AY], min(8, count), 2), 8)
    np.testing.assert_allclose(signals.lat_accel, smooth, rtol=0, atol=1e-8)
    jerk = savgol_filter(signals.lon_accel, min(15, count), 2, deriv=1, delta=0.1)
    np.testing.assert_allclose(signals.lon_jerk, jerk, rtol=0, atol=1e-7)


@pytest.mark.parametrize(("accel", "nuplan", "deepplan"), [(2.39, 1, 1), (3.9, 0, 1), (4.1, 0, 0)])
def test_deepplan_relaxes_the_longitudinal_bound(accel: float, nuplan: int, deepplan: int) -> None:
    signals = comfort_signals(times(20), states_with(AX, np.full(20, accel)))
    at = list(BOUNDED_SIGNALS.values()).index("lon_accel")
    assert within_bounds(signals, NUPLAN)[at] == nuplan
    assert within_bounds(signals, DEEPPLAN)[at] == deepplan


def test_three_samples_are_too_few() -> None:
    with pytest.raises(DataError, match="3 samples are too few"):
        comfort_signals(times(3), np.zeros((3, NUM_STATE)))


def test_time_stamps_must_increase() -> None:
    stamps = times(10)
    stamps[4] = stamps[3]
    with pytest.raises(DataError, match="at sample 4"):
        comfort_signals(stamps, np.zeros((10, NUM_STATE)))
