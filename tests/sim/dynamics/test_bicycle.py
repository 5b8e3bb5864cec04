import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.sim.dynamics.bicycle import (
    MAX_STEERING,
    WHEEL_BASE,
    command_and_step,
    step_bicycle,
    step_seconds,
)
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    NUM_STATE,
    STEERING,
    STEERING_RATE,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    X,
    Y,
)

numbers = st.floats(-20.0, 20.0)


def state_of(**columns: float) -> np.ndarray:
    names = {"x": X, "y": Y, "heading": HEADING, "vx": VX, "vy": VY, "ax": AX, "ay": AY}
    names |= {"steering": STEERING, "yaw_rate": YAW_RATE}
    state = np.zeros(NUM_STATE)
    for name, value in columns.items():
        state[names[name]] = value
    return state


def stepped(state: np.ndarray, accel: float, rate: float, dt: float = 0.1) -> np.ndarray:
    out = np.empty(NUM_STATE)
    step_bicycle(state, accel, rate, WHEEL_BASE, dt, out)
    return out


def test_twenty_metres_per_second_for_two_seconds_are_forty_metres():
    state = state_of(vx=20.0)
    for _ in range(20):
        state = stepped(state, 0.0, 0.0)

    np.testing.assert_allclose(state[:3], [40.0, 0.0, 0.0], atol=1e-9)


def test_a_third_of_an_acceleration_step_passes_the_filter():
    after = stepped(state_of(vx=5.0), 3.0, 0.0)

    np.testing.assert_allclose(after[[VX, AX]], [5.1, 1.0], atol=1e-12)


def test_two_thirds_of_a_steering_rate_pass_the_filter():
    after = stepped(state_of(vx=5.0), 0.0, 0.3)

    np.testing.assert_allclose(after[[STEERING, STEERING_RATE]], [0.02, 0.2], atol=1e-12)


def test_the_pose_turns_with_the_old_steering_angle_and_the_yaw_rate_with_the_new():
    after = stepped(state_of(vx=10.0, yaw_rate=0.1), 0.0, 0.3)

    assert after[HEADING] == 0.0
    assert after[YAW_RATE] == pytest.approx(10.0 * np.tan(0.02) / WHEEL_BASE, abs=1e-12)
    assert after[YAW_ACCEL] == pytest.approx((after[YAW_RATE] - 0.1) / 0.1, abs=1e-12)


def test_steering_stops_at_its_limit_but_the_stored_rate_does_not():
    after = stepped(state_of(vx=1.0, steering=MAX_STEERING), 0.0, 1.0)

    assert after[STEERING] == MAX_STEERING
    assert after[STEERING_RATE] == pytest.approx(2.0 / 3.0, abs=1e-12)


def test_braking_at_standstill_drives_backwards():
    assert stepped(state_of(), -1.0, 0.0)[VX] < 0.0


def test_lateral_velocity_and_acceleration_are_dropped():
    plain = stepped(state_of(vx=5.0), 1.0, 0.1)
    sliding = stepped(state_of(vx=5.0, vy=2.0, ay=3.0), 1.0, 0.1)

    np.testing.assert_array_equal(sliding, plain)
    assert plain[VY] == plain[AY] == 0.0


def test_a_tenth_of_a_second_is_nuplans_product_not_the_quotient():
    assert step_seconds(1_630_000_000_000_000, 1_630_000_000_100_000) == 100_000 * 1e-6 != 0.1


@given(numbers, numbers, st.floats(-1.0, 1.0), st.floats(-3.0, 3.0))
def test_mirroring_the_world_mirrors_the_step(speed, accel, steering, heading):
    right = stepped(state_of(vx=speed, steering=steering, heading=heading), accel, 0.2)
    left = stepped(state_of(vx=speed, steering=-steering, heading=-heading), accel, -0.2)

    flipped = right.copy()
    flipped[[Y, HEADING, STEERING, STEERING_RATE, YAW_RATE, YAW_ACCEL]] *= -1.0
    turned = (left[HEADING] - flipped[HEADING] + np.pi) % (2.0 * np.pi) - np.pi
    assert turned == pytest.approx(0.0, abs=1e-9)
    flipped[HEADING] = left[HEADING]
    np.testing.assert_allclose(left, flipped, rtol=0.0, atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_compiled_code_is_the_python_code(seed):
    rng = np.random.default_rng(seed)
    states, commands = rng.normal(size=(3, NUM_STATE)), rng.normal(size=(3, 2))
    compiled, plain = np.empty_like(states), np.empty_like(states)

    for row in range(3):
        step_bicycle(states[row], *commands[row], WHEEL_BASE, 0.1, compiled[row])
        step_bicycle.py_func(states[row], *commands[row], WHEEL_BASE, 0.1, plain[row])

    np.testing.assert_allclose(compiled, plain, rtol=0.0, atol=1e-12)


def test_a_step_may_overwrite_its_own_state():
    state = state_of(x=1.0, y=2.0, vx=5.0, heading=0.3, steering=0.1)
    expected = stepped(state, 1.0, 0.1)

    step_bicycle(state, 1.0, 0.1, WHEEL_BASE, 0.1, state)

    np.testing.assert_array_equal(state, expected)


def test_noise_is_added_to_a_planners_command_before_the_filters():
    state, noisy, direct = state_of(vx=5.0), np.empty(NUM_STATE), np.empty(NUM_STATE)

    command_and_step(0, 100_000, state, np.array([1.0, 0.1]), 0.5, -0.2, noisy)
    step_bicycle(state, 1.5, 0.1 - 0.2, WHEEL_BASE, 100_000 * 1e-6, direct)

    np.testing.assert_array_equal(noisy, direct)
