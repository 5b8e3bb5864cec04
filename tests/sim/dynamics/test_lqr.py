import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.errors import InvalidTrajectoryError
from shiftsim.sim.dynamics import lqr
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.world.state import HEADING, NUM_STATE, STEERING, VX, Y

NOW = 1_630_000_000_000_000
STEP_US = 100_000
OTHER = lqr.LqrParameters(7.0, 1.5, 2.0, 5.0, 3.0, 0.7, 50_000, 6, 2e-4, 3e-2, 0.25, 0.4, 2.5)
parameters = st.sampled_from([lqr.NUPLAN, OTHER])


def straight(speed: float, count: int = 81) -> tuple[np.ndarray, np.ndarray]:
    """A plan along +x at constant speed, 0.1 s apart."""
    states = np.zeros((count, NUM_STATE))
    states[:, 0] = speed * 0.1 * np.arange(count)
    return NOW + STEP_US * np.arange(count), states


def wobbly(rng: np.random.Generator, count: int, speed: float) -> np.ndarray:
    """Poses (count, 3) that drive forward, with noise on everything."""
    poses = np.zeros((count, 3))
    poses[:, 2] = rng.normal(0.0, 0.1, count).cumsum()
    steps = 0.1 * speed * rng.uniform(0.0, 1.0, count)
    poses[:, 0] = (steps * np.cos(poses[:, 2])).cumsum() + 664_430.0
    poses[:, 1] = (steps * np.sin(poses[:, 2])).cumsum() + 3_998_750.0
    return poses


def dense_speed(poses: np.ndarray, dt: float = 0.1, penalty: float = 1e-4) -> np.ndarray:
    """The speed fit as nuPlan states it: initial speed and accelerations, pseudo-inverse."""
    count = len(poses) - 1
    sums = np.concatenate([dt * np.ones((count, 1)), dt**2 * np.tri(count, count - 1, -1)], axis=1)
    rows = np.concatenate([np.cos(poses[:-1, 2:]) * sums, np.sin(poses[:-1, 2:]) * sums])
    jerk = np.zeros((count - 2, count))
    jerk[:, 1:] = np.diff(np.eye(count - 1), axis=0)
    target = np.diff(poses[:, :2], axis=0).T.ravel()
    solved = np.linalg.pinv(rows.T @ rows + penalty * jerk.T @ jerk) @ rows.T @ target
    return sums @ solved / dt


def dense_curvature(
    poses: np.ndarray, speed: np.ndarray, dt: float = 0.1, penalty: float = 1e-2
) -> np.ndarray:
    """The curvature fit as nuPlan states it: initial curvature and rates, pseudo-inverse."""
    count = len(speed)
    sums = np.concatenate([np.ones((count, 1)), dt * np.tri(count)[:, 1:]], axis=1)
    rows = speed[:, None] * dt * sums
    penalties = np.diag([1e-10, *[penalty] * (count - 1)])
    turns = (np.diff(poses[:, 2]) + np.pi) % (2.0 * np.pi) - np.pi
    return sums @ np.linalg.pinv(rows.T @ rows + penalties, rcond=1e-15) @ rows.T @ turns


@pytest.mark.thorough
@given(st.integers(0, 2**32 - 1), st.integers(3, 161), st.sampled_from([0.0, 0.1, 5.0, 30.0]))
def test_banded_fits_agree_with_the_pseudo_inverse(seed, count, speed):
    poses = wobbly(np.random.default_rng(seed), count, speed)
    speeds, curvatures = np.empty(count - 1), np.empty(count - 1)

    lqr.fit_speed(poses, 0.1, 1e-4, speeds)
    lqr.fit_curvature(poses, speeds, 0.1, 1e-2, curvatures)

    np.testing.assert_allclose(speeds, dense_speed(poses), rtol=0.0, atol=1e-9)
    # at standstill the pseudo-inverse itself loses digits to the penalty of 1e-10
    atol = 1e-9 if speed >= 5.0 else 1e-6
    np.testing.assert_allclose(curvatures, dense_curvature(poses, speeds), rtol=0.0, atol=atol)


@pytest.mark.parametrize(
    ("dt", "jerk", "rate"), [(0.2, 1e-4, 1e-2), (0.1, 2e-3, 0.3), (0.5, 1.0, 5.0)]
)
def test_other_steps_and_penalties_give_other_fits(dt, jerk, rate, rng):
    poses = wobbly(rng, 20, 8.0)
    speeds, curvatures = np.empty(19), np.empty(19)

    lqr.fit_speed(poses, dt, jerk, speeds)
    lqr.fit_curvature(poses, speeds, dt, rate, curvatures)

    np.testing.assert_allclose(speeds, dense_speed(poses, dt, jerk), rtol=0.0, atol=1e-9)
    expected = dense_curvature(poses, speeds, dt, rate)
    np.testing.assert_allclose(curvatures, expected, rtol=0.0, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(-1.0, 5.0))
def test_a_profile_is_read_as_numpy_interpolates(seed, seconds):
    profile = np.random.default_rng(seed).normal(size=30)
    times = (NOW + STEP_US * np.arange(30)) / 1e6
    at = NOW * 1e-6 + seconds

    read = lqr.profile_at(profile, NOW, STEP_US, at)

    assert read == pytest.approx(np.interp(at, times, profile), abs=1e-12)


@pytest.mark.parametrize(("step_us", "count"), [(STEP_US, 30), (50_000, 2), (30_000, 7)])
def test_a_profile_has_its_values_at_its_times_and_ends(step_us, count, rng):
    profile = rng.normal(size=count)

    for index, value in enumerate(profile):
        assert lqr.profile_at(profile, NOW, step_us, (NOW + index * step_us) / 1e6) == value
    for offset, value in ((-5.0, profile[0]), (5.0, profile[-1])):
        assert lqr.profile_at(profile, NOW, step_us, NOW / 1e6 + offset) == value


@given(st.integers(NOW, 2 * NOW), st.sampled_from([STEP_US, 33_333]))
def test_values_at_sample_times_do_not_suffer_from_rounding(start_us, step_us):
    # microseconds / 1e6 * 1e6 may fall below the number that it was
    profile = np.tan(np.arange(30.0))  # no round numbers, which would hide the last bit

    for index in range(30):
        seconds = (start_us + index * step_us) / 1e6
        for at in (np.nextafter(seconds, 0.0), seconds, np.nextafter(seconds, np.inf)):
            read = lqr.profile_at(profile, start_us, step_us, at)
            assert read == pytest.approx(profile[index], rel=1e-3, abs=1e-2)
        assert lqr.profile_at(profile, start_us, step_us, seconds) == profile[index]


def slow_rate(ref, speed, steering, accel, params):
    """The steering rate by matrices: the end of the horizon is linear in the rate."""
    dt = params.step_us / 1e6
    end, gain = np.array([ref.lateral_error, ref.heading_error, steering]), np.zeros(3)
    for step in range(params.horizon):
        arm = dt * (speed + step * dt * accel)
        turn = arm / params.wheel_base
        move = np.array([[1.0, arm, 0.0], [0.0, 1.0, turn], [0.0, 0.0, 1.0]])
        end = move @ end - [0.0, arm * ref.curvature[step], 0.0]
        gain = move @ gain + [0.0, 0.0, dt]
    end[1:] = (end[1:] + np.pi) % (2.0 * np.pi) - np.pi
    cost = np.diag([params.q_lateral_error, params.q_heading_error, params.q_steering])
    return -(gain @ cost @ end) / (params.r_lateral + gain @ cost @ gain)


@given(st.integers(0, 2**32 - 1), parameters)
def test_the_steering_rate_is_that_of_the_matrices(seed, params):
    rng = np.random.default_rng(seed)
    ref = lqr.Reference(0, rng.normal(), 2.0 * rng.normal(), 0.0, 0.3 * rng.normal(size=10))
    speed, steering, accel = rng.uniform(-5.0, 15.0), rng.uniform(-4.0, 4.0), rng.normal()

    rate = lqr.steering_rate(ref, speed, steering, accel, params)

    assert rate == pytest.approx(slow_rate(ref, speed, steering, accel, params), abs=1e-9)


@given(st.integers(0, 2**32 - 1), parameters)
def test_the_acceleration_is_the_cheapest_that_is_held(seed, params):
    rng = np.random.default_rng(seed)
    state = rng.normal(size=NUM_STATE)
    state[VX] = rng.uniform(1.0, 15.0)
    ref = lqr.Reference(0, 0.1, 0.2, rng.uniform(-3.0, 15.0), 0.1 * rng.normal(size=10))

    accel, rate = lqr.command(state, ref, params)

    hold = params.horizon * params.step_us * 1e-6
    # the derivative of q (v + hold a - v_ref)^2 + r a^2
    error = state[VX] + hold * accel - ref.speed
    slope = params.q_longitudinal * hold * error + params.r_longitudinal * accel
    assert slope == pytest.approx(0.0, abs=1e-9)
    expected = lqr.steering_rate(ref, state[VX], state[STEERING], accel, params)
    assert rate == expected


@pytest.mark.parametrize("params", [lqr.NUPLAN, OTHER])
def test_the_stop_controller_acts_up_to_its_speed(params):
    limit, above = params.stopping_speed, np.nextafter(params.stopping_speed, 1.0)
    assert lqr.is_stopping(limit, limit, params)
    assert not lqr.is_stopping(above, limit, params)
    assert not lqr.is_stopping(limit, above, params)
    state = np.zeros(NUM_STATE)
    state[VX] = limit
    ref = lqr.Reference(0, 1.0, 1.0, limit - 0.1, np.ones(10))
    assert lqr.command(state, ref, params) == (pytest.approx(-0.1 * params.stopping_gain), 0.0)


@given(st.integers(0, 2**32 - 1), st.integers(3, 40), parameters)
def test_the_reference_is_read_from_plan_and_profiles(seed, count, params):
    rng = np.random.default_rng(seed)
    time_us, states = straight(5.0, count)
    states[:, :3] = wobbly(rng, count, 6.0)
    state = states[0] + rng.normal(0.0, 1.0, NUM_STATE)
    now = int(rng.integers(NOW, time_us[-1] + 1))

    ref = lqr.reference(now, state, time_us, states, params)

    target = np.empty(NUM_STATE)
    interpolate(time_us, states, now, target)
    (dx, dy), heading = state[:2] - target[:2], target[HEADING]
    assert ref.status == lqr.TRACKED
    assert ref.lateral_error == pytest.approx(dy * np.cos(heading) - dx * np.sin(heading), abs=1e-9)
    turn = (state[HEADING] - heading + np.pi) % (2.0 * np.pi) - np.pi
    assert ref.heading_error == pytest.approx(turn, abs=1e-12)
    speed, curvature = lqr.fit_profiles(time_us, states, params)
    knots = (params.step_us * np.arange(len(speed))) / 1e6
    ahead = (now - NOW) / 1e6 + params.step_us / 1e6 * np.arange(params.horizon + 1)
    assert ref.speed == pytest.approx(np.interp(ahead[-1], knots, speed), abs=1e-5)
    np.testing.assert_allclose(ref.curvature, np.interp(ahead[:-1], knots, curvature), atol=1e-5)


@pytest.mark.parametrize(("count", "now"), [(2, NOW), (3, NOW - 1), (1, NOW)])
def test_without_a_reference_nothing_is_commanded(count, now):
    time_us, states = straight(10.0, count)
    state = np.ones(NUM_STATE)

    ref = lqr.reference(now, state, time_us, states, lqr.NUPLAN)

    assert ref.status == (lqr.TOO_SHORT if count == 2 else lqr.NOT_COVERED)
    assert ref[1:4] == (0.0, 0.0, 0.0)
    np.testing.assert_array_equal(ref.curvature, np.zeros(10))
    assert lqr.track(now, state, time_us, states, lqr.NUPLAN) == (ref.status, 0.0, 0.0)


def test_three_poses_are_enough_and_need_no_explanation():
    time_us, states = straight(10.0, 3)

    status, _, _ = lqr.track(NOW, states[0], time_us, states, lqr.NUPLAN)

    assert status == lqr.TRACKED
    lqr.raise_for_status(status, NOW, time_us)


def test_on_the_plan_at_its_speed_nothing_is_commanded():
    state = np.zeros(NUM_STATE)
    state[VX] = 10.0

    status, accel, rate = lqr.track(NOW, state, *straight(10.0), lqr.NUPLAN)

    assert status == lqr.TRACKED
    assert accel == pytest.approx(0.0, abs=1e-9)
    assert rate == pytest.approx(0.0, abs=1e-9)


def test_a_speed_error_is_cut_by_ten_elevenths_per_second():
    state = np.zeros(NUM_STATE)
    state[VX] = 8.9

    _, accel, _ = lqr.track(NOW, state, *straight(10.0), lqr.NUPLAN)

    assert accel == pytest.approx(1.0, abs=1e-9)


def test_left_of_the_plan_it_steers_right():
    state = np.zeros(NUM_STATE)
    state[VX], state[Y] = 10.0, 0.5

    _, _, rate = lqr.track(NOW, state, *straight(10.0), lqr.NUPLAN)

    assert rate < 0.0


def test_near_standstill_the_stop_controller_halves_the_error_and_does_not_steer():
    state = np.zeros(NUM_STATE)
    state[VX], state[HEADING] = 0.2, 0.5

    _, accel, rate = lqr.track(NOW, state, *straight(0.0), lqr.NUPLAN)

    assert accel == pytest.approx(-0.1, abs=1e-9)
    assert rate == 0.0


def test_a_standing_plan_has_no_curvature_however_its_heading_turns():
    time_us, states = straight(0.0, 21)
    states[:, HEADING] = 0.1 * np.arange(21)

    speed, curvature = lqr.fit_profiles(time_us, states, lqr.NUPLAN)

    np.testing.assert_array_equal(speed, 0.0)
    np.testing.assert_array_equal(curvature, 0.0)


def test_the_curvature_of_a_circle_is_found():
    radius, speed, count = 20.0, 8.0, 81
    time_us, states = straight(speed, count)
    angle = speed / radius * 0.1 * np.arange(count)
    states[:, 0], states[:, 1] = radius * np.sin(angle), radius * (1.0 - np.cos(angle))
    states[:, HEADING] = (angle + np.pi) % (2.0 * np.pi) - np.pi

    _, curvature = lqr.fit_profiles(time_us, states, lqr.NUPLAN)

    np.testing.assert_allclose(curvature, 1.0 / radius, rtol=2e-3)


def test_one_closed_loop_step_is_tracker_then_noise_then_bicycle():
    time_us, states = straight(10.0)
    state = np.zeros(NUM_STATE)
    state[VX], state[Y] = 9.0, 0.3
    fused, command, apart = np.empty(NUM_STATE), np.empty(2), np.empty(NUM_STATE)

    status = lqr.track_and_step(
        NOW, NOW + STEP_US, state, time_us, states, 0.7, -0.1, fused, command
    )

    _, accel, rate = lqr.track(NOW, state, time_us, states, lqr.NUPLAN)
    step_bicycle(state, accel + 0.7, rate - 0.1, WHEEL_BASE, STEP_US * 1e-6, apart)
    assert status == lqr.TRACKED
    np.testing.assert_array_equal(fused, apart)
    np.testing.assert_array_equal(command, [accel, rate])


def test_compiled_tracker_is_the_python_tracker():
    rng = np.random.default_rng(5)
    time_us, states = straight(5.0, 31)
    states[:, :3] = wobbly(rng, 31, 6.0)
    state = states[0].copy()
    poses, speed, curvature = states[:, :3].copy(), np.empty(30), np.empty(30)

    lqr.fit_speed.py_func(poses, 0.1, 1e-4, speed)
    lqr.fit_curvature.py_func(poses, speed, 0.1, 1e-2, curvature)

    fitted = np.empty(30)
    lqr.fit_speed(poses, 0.1, 1e-4, fitted)
    np.testing.assert_allclose(fitted, speed, rtol=0.0, atol=1e-12)
    lqr.fit_curvature(poses, speed, 0.1, 1e-2, fitted)
    np.testing.assert_allclose(fitted, curvature, rtol=0.0, atol=1e-12)
    ref = lqr.reference.py_func(NOW, state, time_us, states, lqr.NUPLAN)
    expected = lqr.command.py_func(state, ref, lqr.NUPLAN)
    assert lqr.track(NOW, state, time_us, states, lqr.NUPLAN)[1:] == pytest.approx(
        expected, abs=1e-9
    )


@pytest.mark.parametrize(
    ("count", "now", "message"),
    [
        (81, NOW - 1, "covers 1e-06 s to 8 s from now"),
        (81, NOW + 8_000_001, "covers -8 s to"),
        (2, NOW, "lasts 0.1 s"),
        (1, NOW, "has 1 states"),
    ],
)
def test_a_plan_that_cannot_be_tracked_is_explained(count, now, message):
    time_us, states = straight(10.0, count)
    out = np.full(NUM_STATE, 7.0)

    status = lqr.track_and_step(
        now, now + STEP_US, states[0], time_us, states, 0.0, 0.0, out, np.empty(2)
    )

    np.testing.assert_array_equal(out, 7.0)
    with pytest.raises(InvalidTrajectoryError, match=message):
        lqr.raise_for_status(status, now, time_us)
