import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.errors import InvalidTrajectoryError, PlannerError
from shiftsim.sim.dynamics.perfect import (
    KEPT_US,
    follow_perfectly,
    interpolate,
    sample_poses,
    segment_end,
    unwrap_correction,
)
from shiftsim.world.state import (
    HEADING,
    NUM_STATE,
    STEERING,
    STEERING_RATE,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    Trajectory,
)


def two_states() -> tuple[np.ndarray, np.ndarray]:
    return np.array([0, 1_000_000]), np.zeros((2, NUM_STATE))


def test_poses_of_plans_are_kept_every_tenth_of_a_second_and_then_every_second():
    tenths = [*range(11), *range(20, 90, 10)]
    np.testing.assert_array_equal(KEPT_US, 100_000 * np.array(tenths))


@given(st.integers(0, 2**32 - 1), st.integers(2, 30), st.floats(0.0, 1.0))
def test_states_are_interpolated_over_unwrapped_headings(seed, count, share):
    rng = np.random.default_rng(seed)
    time_us = 1_630_000_000_000_000 + np.cumsum(rng.integers(1, 200_000, count))
    states = rng.uniform(-np.pi, np.pi, (count, NUM_STATE))
    query = int(time_us[0] + share * (time_us[-1] - time_us[0]))
    out, plain = np.empty(NUM_STATE), np.empty(NUM_STATE)

    assert interpolate(time_us, states, query, out)
    assert interpolate.py_func(time_us, states, query, plain)

    unwrapped = states.copy()
    unwrapped[:, HEADING] = np.unwrap(states[:, HEADING])
    offsets = time_us - time_us[0]
    expected = [np.interp(query - time_us[0], offsets, column) for column in unwrapped.T]
    turned = (out[HEADING] - expected[HEADING] + np.pi) % (2.0 * np.pi) - np.pi
    assert turned == pytest.approx(0.0, abs=1e-9)
    expected[HEADING] = out[HEADING]
    expected[STEERING + 1 :] = [0.0] * (NUM_STATE - STEERING - 1)
    np.testing.assert_allclose(out, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(plain, out, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("turns", [-1.5, -1.0, -0.6, -0.5, 0.0, 0.4, 0.5, 0.6, 1.0, 1.5, 2.5])
@pytest.mark.parametrize("before", [0.0, 1.0])
def test_headings_are_unwrapped_as_numpy_does(before, turns):
    after = before + 2.0 * np.pi * turns

    correction = unwrap_correction(before, after)

    expected = np.unwrap([before, after])[1] - after
    assert correction == pytest.approx(expected, abs=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(2, 20))
def test_the_segment_of_a_time_is_that_of_a_search(seed, count):
    time_us = np.cumsum(np.random.default_rng(seed).integers(1, 5, count))

    for query in range(int(time_us[0]) - 2, int(time_us[-1]) + 3):
        expected = np.clip(np.searchsorted(time_us, query), 1, count - 1)
        assert segment_end(time_us, query) == expected


@pytest.mark.parametrize("at", [0, 1])
def test_the_ends_of_a_trajectory_are_covered(at):
    time_us, states = two_states()
    states[:] = np.arange(2)[:, None]
    out = np.empty(NUM_STATE)

    assert interpolate(time_us, states, int(time_us[at]), out)
    np.testing.assert_array_equal(out[: STEERING + 1], at)


def test_a_single_state_covers_nothing():
    time_us, states = two_states()

    assert not interpolate(time_us[:1], states[:1], 0, np.empty(NUM_STATE))


def test_a_heading_that_crosses_half_a_turn_goes_the_short_way():
    time_us, states = two_states()
    states[:, HEADING] = 3.1, -3.1
    out = np.empty(NUM_STATE)

    interpolate(time_us, states, 500_000, out)

    assert abs(out[HEADING]) == pytest.approx(np.pi, abs=1e-9)


def test_yaw_rate_yaw_acceleration_and_steering_rate_are_not_carried():
    time_us, states = two_states()
    states[:] = 1.0
    out = np.empty(NUM_STATE)

    interpolate(time_us, states, 500_000, out)

    np.testing.assert_array_equal(out[[STEERING_RATE, YAW_RATE, YAW_ACCEL]], 0.0)


@pytest.mark.parametrize("query", [-1, 1_000_001])
def test_nothing_is_extrapolated(query):
    time_us, states = two_states()
    out = np.full(NUM_STATE, 7.0)

    assert not interpolate(time_us, states, query, out)
    np.testing.assert_array_equal(out, 7.0)


@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_poses_are_sampled_in_one_sweep_as_at_each_time(seed, count):
    rng = np.random.default_rng(seed)
    time_us = 1_630_000_000_000_000 + np.cumsum(rng.integers(5_000, 400_000, count))
    states = rng.uniform(-3.0, 3.0, (count, NUM_STATE))
    start_us = int(time_us[0]) - 200_000
    ahead_us = np.append(100_000 * np.arange(count), [200_000, time_us[-1] - start_us])
    ahead_us.sort()
    poses = np.empty((len(ahead_us), 3))

    sample_poses(time_us, states, start_us, ahead_us, poses)

    for ahead, pose in zip(ahead_us.tolist(), poses, strict=True):
        one = np.full(NUM_STATE, np.nan)
        interpolate(time_us, states, start_us + ahead, one)
        np.testing.assert_array_equal(pose, one[:3])


def test_poses_behind_the_end_of_a_plan_are_absent():
    time_us, states = two_states()
    states[1, 0] = 10.0
    poses, ahead_us = np.zeros((4, 3)), np.array([0, 100_000, 200_000, 1_000_000])

    sample_poses(time_us, states, 800_000, ahead_us, poses)

    np.testing.assert_allclose(poses[:3, 0], [8.0, 9.0, 10.0], atol=1e-12)
    assert np.isnan(poses[3]).all()


def test_perfect_tracking_puts_the_ego_on_the_plan():
    time_us, states = two_states()
    states[1, 0], states[:, VX] = 10.0, 10.0
    out = np.empty(NUM_STATE)

    follow_perfectly(Trajectory(time_us, states), 100_000, out)

    np.testing.assert_allclose(out[[0, VX]], [1.0, 10.0], atol=1e-12)


def test_perfect_tracking_refuses_fifty_metres_per_second():
    time_us, states = two_states()
    states[:, VX] = 50.0

    with pytest.raises(PlannerError, match="50 m/s"):
        follow_perfectly(Trajectory(time_us, states), 100_000, np.empty(NUM_STATE))


@pytest.mark.parametrize(("sideways", "refused"), [(40.0, True), (39.99, False)])
def test_the_speed_of_perfect_tracking_is_that_in_any_direction(sideways, refused):
    time_us, states = two_states()
    states[:, VX], states[:, VY] = -30.0, sideways
    plan = Trajectory(time_us, states)

    if refused:
        with pytest.raises(PlannerError, match="speed 50 m/s at 100000 us"):
            follow_perfectly(plan, 100_000, np.empty(NUM_STATE))
    else:
        follow_perfectly(plan, 100_000, np.empty(NUM_STATE))


def test_perfect_tracking_needs_a_plan_to_the_next_iteration():
    with pytest.raises(InvalidTrajectoryError, match="does not cover"):
        follow_perfectly(Trajectory(*two_states()), 1_000_001, np.empty(NUM_STATE))
