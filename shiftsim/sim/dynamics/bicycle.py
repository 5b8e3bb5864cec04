"""Kinematic bicycle model at the rear axle, with nuPlan's low-pass filters on the command.

One forward Euler step: the pose moves with the old speed, heading and steering angle; the yaw rate
follows from the new ones. Speed may become negative; only the steering angle is limited.
"""

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, kernel
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    PACIFICA,
    STEERING,
    STEERING_RATE,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    X,
    Y,
)

MAX_STEERING = np.pi / 3.0  # rad, nuPlan kinematic bicycle
ACCEL_TIME_CONSTANT = 0.2  # s, nuPlan kinematic bicycle
STEERING_TIME_CONSTANT = 0.05  # s, nuPlan kinematic bicycle
WHEEL_BASE = PACIFICA.wheel_base  # m


@kernel
def step_seconds(now_us: int, next_us: int) -> float:
    """Seconds from one time stamp to another, for the motion model."""
    # nuPlan rule 11: microseconds times 1e-6, so 100000 us are 0.09999999999999999 s
    return (next_us - now_us) * 1e-6


@kernel
def step_bicycle(
    state: FloatArray,  # (11,) columns of `state.STATE_COLUMNS`; vy and ay are ignored
    accel: float,  # commanded longitudinal acceleration [m/s^2]
    steering_rate: float,  # commanded rate of the steering angle [rad/s]
    wheel_base: float,  # distance between the axles [m]
    dt: float,  # step [s]
    # (11,) receives the next state; heading wrapped to [-pi, pi), vy = ay = 0. May be `state`
    # itself
    out: FloatArray,
) -> None:
    """Advance the kinematic bicycle by one Euler step, low-pass filters included."""
    turn_and_step(state, np.tan(state[STEERING]), accel, steering_rate, wheel_base, dt, out)


@kernel
def turn_and_step(
    state: FloatArray,
    tangent: float,  # of the steering angle
    accel: float,
    steering_rate: float,
    wheel_base: float,
    dt: float,
    out: FloatArray,
) -> float:
    """As `step_bicycle`; the tangent of the new steering angle, for the next step."""
    heading, speed, steering = state[HEADING], state[VX], state[STEERING]
    old_accel, old_yaw_rate = state[AX], state[YAW_RATE]
    new_accel = old_accel + dt / (dt + ACCEL_TIME_CONSTANT) * (accel - old_accel)
    ideal = steering + dt * steering_rate
    filtered = steering + dt / (dt + STEERING_TIME_CONSTANT) * (ideal - steering)
    rate = (filtered - steering) / dt

    new_speed = speed + new_accel * dt  # nuPlan rule 23: also below 0
    # nuPlan rule 15: the pose uses the old steering angle, the yaw rate the new one; the stored
    # rate is the one before clipping
    new_steering = min(max(steering + rate * dt, -MAX_STEERING), MAX_STEERING)
    new_tangent = np.tan(new_steering)
    yaw_rate = new_speed * new_tangent / wheel_base
    out[X] = state[X] + speed * np.cos(heading) * dt
    out[Y] = state[Y] + speed * np.sin(heading) * dt
    out[HEADING] = wrap_angle(heading + speed * tangent / wheel_base * dt)
    out[VX] = new_speed
    out[VY] = 0.0
    out[AX] = new_accel
    out[AY] = 0.0
    out[STEERING] = new_steering
    out[STEERING_RATE] = rate
    out[YAW_RATE] = yaw_rate
    out[YAW_ACCEL] = (yaw_rate - old_yaw_rate) / dt
    return new_tangent


@kernel
def command_and_step(
    now_us: int,  # time stamp of `state` [us]
    next_us: int,  # time stamp of the next iteration [us]
    state: FloatArray,  # (11,) ego state
    command: FloatArray,  # (2,) clean acceleration [m/s^2] and steering rate [rad/s]
    noise_accel: float,  # added to the acceleration, unless exactly 0 [m/s^2]
    noise_rate: float,  # added to the steering rate, unless exactly 0 [rad/s]
    out_state: FloatArray,  # (11,) receives the next state
) -> None:
    """One step of nuPlan's vehicle for a planner that returns commands: noise, then the model."""
    accel, rate = command[0], command[1]
    if noise_accel != 0.0:
        accel += noise_accel
    if noise_rate != 0.0:
        rate += noise_rate
    step_bicycle(state, accel, rate, WHEEL_BASE, step_seconds(now_us, next_us), out_state)
