"""Comfort signals: filters, edges, bounds."""

import numpy as np
import pytest
from scipy.signal import savgol_filter

from shiftsim.errors import DataError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.metrics.comfort import (
    BOUNDED_SIGNALS,
    ComfortSignals,
    comfort_signals,
    derived_states,
    evaluate,
    within_bounds,
)
from shiftsim.metrics.result import DEEPPLAN, NUPLAN, Violation
from shiftsim.world.state import AX, AY, HEADING, NUM_STATE, VX, VY, YAW_ACCEL, YAW_RATE


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


def constant_signals(count: int = 10, **changed: np.ndarray) -> ComfortSignals:
    return ComfortSignals(**{name: np.zeros(count) for name in ComfortSignals._fields} | changed)


BOUNDS = {
    "ego_jerk": (-8.37, 8.37),
    "ego_lat_acceleration": (-4.89, 4.89),
    "ego_lon_acceleration": (-4.05, 2.40),
    "ego_lon_jerk": (-4.13, 4.13),
    "ego_yaw_acceleration": (-1.93, 1.93),
    "ego_yaw_rate": (-0.95, 0.95),
}


@pytest.mark.parametrize("metric", BOUNDS)
@pytest.mark.parametrize("side", [0, 1])
def test_a_signal_must_stay_strictly_within_both_bounds(metric: str, side: int) -> None:
    bound = BOUNDS[metric][side]
    for value, broken in ((bound, True), (np.nextafter(bound, 0.0), False)):
        values = np.zeros(10)
        values[[4, 6]] = value, 0.1 * bound
        signals = constant_signals(**{BOUNDED_SIGNALS[metric]: values})
        parts, comfortable = evaluate(signals, times(10), NUPLAN)
        row = {part.row.metric: part.row for part in parts}[metric]
        violation = Violation(4, 400_000, None, value) if broken else None
        assert (row.value, row.threshold, row.violation) == (value, bound, violation)
        assert comfortable.row.violation == violation
        assert comfortable.row.score == comfortable.statistics[0].value == float(not broken)
        assert comfortable.row.value == float(broken)
        assert within_bounds(signals, NUPLAN).count(False) == broken


def test_the_earliest_of_all_violations_is_that_of_comfort() -> None:
    late, early = np.zeros(10), np.zeros(10)
    late[7:], early[2] = 9.0, -9.0
    signals = constant_signals(mag_jerk=late, lon_jerk=early, yaw_rate=late)
    _, comfortable = evaluate(signals, times(10), NUPLAN)
    assert comfortable.row.threshold == 0.0
    assert comfortable.row.violation == Violation(2, 200_000, None, -9.0)
    assert comfortable.row.value == 3.0


def test_the_value_of_a_signal_is_the_one_nearest_to_a_bound() -> None:
    values = np.array([0.0, 2.0, -3.0, 1.0])
    parts, _ = evaluate(constant_signals(4, lon_accel=values), times(4), NUPLAN)
    part = parts[2]
    assert (part.row.value, part.row.threshold) == (2.0, 2.40)
    assert [s.value for s in part.statistics] == [2.0, -3.0, 0.0, 2.0, 1.0]
    assert [s.kind for s in part.statistics] == ["MAX", "MIN", "MEAN", "P90", "BOOLEAN"]
    assert part.series is not None
    np.testing.assert_array_equal(part.series.values, values)


RANKS = [(4, 3), (5, 4), (10, 8), (15, 12), (20, 17), (25, 22), (35, 30), (150, 134)]


@pytest.mark.parametrize(("count", "rank"), RANKS)
def test_the_ninetieth_percentile_is_the_observation_of_an_even_rank_on_ties(
    count: int, rank: int, rng: np.random.Generator
) -> None:
    values = rng.permutation(np.arange(count)) / 1000.0
    parts, _ = evaluate(constant_signals(count, yaw_rate=values), times(count), NUPLAN)
    assert parts[5].statistics[3].value == rank / 1000.0


def test_the_step_of_the_signals_is_the_mean_of_the_time_stamps() -> None:
    heading = 0.05 * np.arange(20)
    signals = comfort_signals(times(20) // 2, states_with(HEADING, heading))
    np.testing.assert_allclose(signals.yaw_rate, 1.0, rtol=0, atol=1e-8)
    curved = comfort_signals(times(20) // 2, states_with(HEADING, heading**2))
    np.testing.assert_allclose(curved.yaw_accel, 2.0, rtol=0, atol=1e-7)


def test_states_derived_from_poses_are_those_of_the_motion() -> None:
    time_us = times(60)
    seconds = time_us * 1e-6
    heading = 3.0 + 0.2 * seconds + 0.01 * seconds**2  # leaves pi on the way
    turn, speed = 0.2 + 0.02 * seconds, 5.0 + 0.5 * seconds
    fine = np.linspace(0.0, seconds[-1], 59 * 200 + 1)
    along = (5.0 + 0.5 * fine) * np.exp(1j * (3.0 + 0.2 * fine + 0.01 * fine**2))
    way = np.concatenate([[0.0], np.cumsum(0.5 * (along[1:] + along[:-1]) * np.diff(fine))])[::200]
    poses = np.column_stack([4e5 + way.real, 5e6 + way.imag, wrap_angles(heading)])

    states = derived_states(time_us, poses)[3:-3]

    np.testing.assert_array_equal(states[:, :3], poses[3:-3])
    inner = slice(3, -3)
    for column, values, tolerance in (
        (VX, speed, 5e-3),
        (VY, 0.0 * speed, 5e-3),
        (AX, 0.5 + 0.0 * speed, 2e-2),
        (AY, speed * turn, 2e-2),
        (YAW_RATE, turn, 1e-6),
        (YAW_ACCEL, 0.02 + 0.0 * turn, 1e-6),
    ):
        np.testing.assert_allclose(states[:, column], values[inner], atol=tolerance)
