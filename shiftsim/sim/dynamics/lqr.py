"""nuPlan's LQR tracker: trajectory in, command (acceleration, steering rate) out.

The plan is resampled at 0.1 s. Displacements along the heading give a smoothed speed profile,
heading changes a smoothed curvature profile; the speed one second ahead and the curvatures of the
next second are the references of two small LQR problems.

nuPlan fits (initial speed, accelerations) and (initial curvature, curvature rates) by the
pseudo-inverse of dense normal equations. Here the unknowns are the profiles themselves, which makes
the same least-squares problems banded:

    sum (d_k - D v_k)^2 + j sum ((v_k+2 - 2 v_k+1 + v_k) / D)^2             pentadiagonal
    sum (t_k - D v_k c_k)^2 + p c_0^2 + r sum ((c_k+1 - c_k) / D)^2         tridiagonal

with d displacement along the heading, t heading change, v speed, c curvature, D the time step, and
the penalties j (jerk), r (curvature rate), p (initial curvature). No singular value of nuPlan's
matrices ever falls below the cut of its pseudo-inverse, so the solutions are the same.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.errors import InvalidTrajectoryError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.perfect import interpolate, sample_poses
from shiftsim.world.state import HEADING, NUM_STATE, PACIFICA, STEERING, VX, X, Y

INITIAL_CURVATURE_PENALTY = 1e-10  # nuPlan tracker utilities
MIN_POSES = 3  # of the resampled plan; fewer have no second difference

TRACKED, NOT_COVERED, TOO_SHORT = 0, 1, 2  # what the kernels return


class LqrParameters(NamedTuple):
    """Weights and times of the tracker; the defaults are those of nuPlan's configuration.

    Each of the two problems minimises q (error at the end of the horizon)^2 + r (command)^2, the
    command being held for all of it.
    """

    q_longitudinal: float = 10.0  # cost of the speed error [s^2/m^2]
    r_longitudinal: float = 1.0  # cost of the acceleration [s^4/m^2]
    q_lateral_error: float = 1.0  # cost of the distance beside the plan [1/m^2]
    q_heading_error: float = 10.0  # cost of the heading error [1/rad^2]
    q_steering: float = 0.0  # cost of the steering angle [1/rad^2]
    r_lateral: float = 1.0  # cost of the steering rate [s^2/rad^2]
    step_us: int = 100_000  # discretisation time [us]
    horizon: int = 10  # its steps
    jerk_penalty: float = 1e-4  # of the speed profile, against displacements [s^4]
    # of the curvature profile, against heading changes [s^2 m^2]
    curvature_rate_penalty: float = 1e-2
    stopping_gain: float = 0.5  # acceleration per speed error of the stop controller [1/s]
    # where speed and plan are not above it, the stop controller acts [m/s]
    stopping_speed: float = 0.2
    wheel_base: float = PACIFICA.wheel_base  # distance between the axles [m]


NUPLAN = LqrParameters()


class Reference(NamedTuple):
    """What the tracker steers to."""

    status: int  # TRACKED, or why there is none: NOT_COVERED, TOO_SHORT
    lateral_error: float  # of the rear axle, left of the plan is positive [m]
    heading_error: float  # ego minus plan, in [-pi, pi) [rad]
    speed: float  # of the plan one horizon ahead [m/s]; negative in reverse
    curvature: FloatArray  # (horizon,) of the plan at the next steps [1/m]


@kernel
def num_resampled(traj_time_us: IntArray, step_us: int) -> int:
    """Number of poses of a trajectory at whole steps from its start."""
    return (traj_time_us[-1] - traj_time_us[0]) // step_us + 1


@kernel
def fit_speed(poses: FloatArray, dt: float, jerk_penalty: float, out: FloatArray) -> None:
    """Smoothed signed speed between poses (M + 1, 3), into `out` (M,) [m/s]; M >= 2.

    Solves (I + w D'D) v = d / dt, D the second difference, w = jerk_penalty / dt^4, by an LDL'
    factorisation with two sub-diagonals. Its condition is at most 1 + 16 w.
    """
    count = len(out)
    weight = jerk_penalty / dt**4
    lower1, lower2 = np.empty(count), np.empty(count)
    pivot1 = pivot2 = solved1 = solved2 = 0.0  # of the row before, and of the one before that
    factor1 = 0.0  # first sub-diagonal of the row before
    for row in range(count):
        # each second difference (1, -2, 1) that row takes part in, by its place in it
        first, middle, last = row + 2 < count, 0 < row < count - 1, row >= 2
        diagonal = 1.0
        if first:
            diagonal += weight
        if middle:
            diagonal += 4.0 * weight
        if last:
            diagonal += weight
        side2 = weight if last else 0.0
        side1 = 0.0  # with the row before
        if last:
            side1 -= 2.0 * weight
        if middle:
            side1 -= 2.0 * weight
        right = (
            (poses[row + 1, 0] - poses[row, 0]) * np.cos(poses[row, 2])
            + (poses[row + 1, 1] - poses[row, 1]) * np.sin(poses[row, 2])
        ) / dt
        factor2 = side2 / pivot2 if row >= 2 else 0.0
        coupled = side1 - factor2 * factor1 * pivot2
        factor = coupled / pivot1 if row >= 1 else 0.0
        pivot = diagonal - factor2 * side2 - factor * coupled
        solved = right - factor * solved1 - factor2 * solved2
        lower1[row], lower2[row] = factor, factor2
        out[row] = solved / pivot
        pivot2, pivot1 = pivot1, pivot
        solved2, solved1 = solved1, solved
        factor1 = factor
    for row in range(count - 2, -1, -1):
        out[row] -= lower1[row + 1] * out[row + 1]
        if row + 2 < count:
            out[row] -= lower2[row + 2] * out[row + 2]


@kernel
def fit_curvature(
    poses: FloatArray, speed: FloatArray, dt: float, rate_penalty: float, out: FloatArray
) -> None:
    """Smoothed curvature between poses (M + 1, 3), into `out` (M,) [1/m].

    Eliminates the tridiagonal system from its end. Divided by the penalty w = rate_penalty / dt^2
    every pivot is 1 + gain, and gain is a sum of positive terms: no digits are lost at standstill,
    where only the initial-curvature penalty keeps the matrix regular.
    """
    count = len(out)
    weight = rate_penalty / dt**2
    gains = np.empty(count)
    gain = load = 0.0
    for row in range(count - 1, -1, -1):
        arm = speed[row] * dt
        turn = wrap_angle(poses[row + 1, 2] - poses[row, 2])
        load = load / (1.0 + gain) + arm * turn / weight
        gain = gain / (1.0 + gain) + arm * arm / weight
        gains[row], out[row] = gain, load
    out[0] /= gains[0] + INITIAL_CURVATURE_PENALTY / weight
    for row in range(1, count):
        out[row] = (out[row] + out[row - 1]) / (1.0 + gains[row])


@kernel
def profile_at(profile: FloatArray, start_us: int, step_us: int, seconds: float) -> float:
    """Value of a profile sampled at whole steps, at a time [s]; clamped at both ends."""
    # nuPlan rule 11: the sample times are microseconds / 1e6, the queried time microseconds * 1e-6
    last = len(profile) - 1
    if seconds <= start_us / 1e6:
        return profile[0]
    if seconds >= (start_us + last * step_us) / 1e6:
        return profile[last]
    low = int((seconds * 1e6 - start_us) / step_us)
    low = min(max(low, 0), last - 1)
    while low > 0 and (start_us + low * step_us) / 1e6 > seconds:
        low -= 1
    while low < last - 1 and (start_us + (low + 1) * step_us) / 1e6 <= seconds:
        low += 1
    begin = (start_us + low * step_us) / 1e6
    end = (start_us + (low + 1) * step_us) / 1e6
    slope = (profile[low + 1] - profile[low]) / (end - begin)
    return slope * (seconds - begin) + profile[low]


@kernel
def fit_profiles(
    traj_time_us: IntArray, traj_states: FloatArray, params: LqrParameters
) -> tuple[FloatArray, FloatArray]:
    """Speed [m/s] and curvature [1/m] profiles (M,) at whole steps from the plan's start."""
    # nuPlan rule 20: the whole plan is fitted, not the second that the tracker looks ahead
    dt = params.step_us / 1e6
    ahead_us = np.arange(0, traj_time_us[-1] - traj_time_us[0] + 1, params.step_us)
    poses = np.empty((len(ahead_us), 3))
    sample_poses(traj_time_us, traj_states, traj_time_us[0], ahead_us, poses)
    speed, curvature = np.empty(len(poses) - 1), np.empty(len(poses) - 1)
    fit_speed(poses, dt, params.jerk_penalty, speed)
    fit_curvature(poses, speed, dt, params.curvature_rate_penalty, curvature)
    return speed, curvature


@kernel
def reference(
    now_us: int,  # time stamp of the current iteration [us]
    state: FloatArray,  # (11,) ego state
    traj_time_us: IntArray,  # (H,) strictly increasing time stamps of the plan [us]
    traj_states: FloatArray,  # (H, 11) states of the plan; only the poses are read
    params: LqrParameters,
) -> Reference:
    """Errors of the ego against the plan, and the speeds and curvatures to aim at."""
    target, curvature = np.empty(NUM_STATE), np.zeros(params.horizon)
    if not interpolate(traj_time_us, traj_states, now_us, target):
        return Reference(NOT_COVERED, 0.0, 0.0, 0.0, curvature)
    if num_resampled(traj_time_us, params.step_us) < MIN_POSES:
        return Reference(TOO_SHORT, 0.0, 0.0, 0.0, curvature)
    profiles = fit_profiles(traj_time_us, traj_states, params)
    return aim(now_us, state, target, traj_time_us[0], profiles, params, curvature)


@kernel
def aim(
    now_us: int,
    state: FloatArray,
    target: FloatArray,  # (11,) state of the plan now
    start_us: int,  # of the plan
    profiles: tuple[FloatArray, FloatArray],  # its speeds and curvatures
    params: LqrParameters,
    ahead: FloatArray,  # (horizon,) receives the next curvatures
) -> Reference:
    """The reference where a plan is at a target; what is not described is as of `reference`."""
    speeds, curvatures = profiles
    heading, dt, now = target[HEADING], params.step_us / 1e6, now_us * 1e-6
    lateral = -(state[X] - target[X]) * np.sin(heading) + (state[Y] - target[Y]) * np.cos(heading)
    for step in range(params.horizon):
        ahead[step] = profile_at(curvatures, start_us, params.step_us, now + step * dt)
    speed = profile_at(speeds, start_us, params.step_us, now + params.horizon * dt)
    return Reference(TRACKED, lateral, wrap_angle(state[HEADING] - heading), speed, ahead)


@kernel
def is_stopping(speed: float, reference_speed: float, params: LqrParameters) -> bool:
    """Whether the stop controller acts."""
    # nuPlan rule 18: speeds are compared with their sign, so it also acts when reversing
    return reference_speed <= params.stopping_speed and speed <= params.stopping_speed


@kernel
def steering_rate(
    ref: Reference, speed: float, steering: float, accel: float, params: LqrParameters
) -> float:
    """Steering rate [rad/s] of the lateral LQR, one rate held over the whole horizon."""
    dt = params.step_us / 1e6
    # x_end = a x_0 + b rate + g, propagated as columns (lateral, heading, steering)
    lateral, heading = ref.lateral_error, ref.heading_error
    b_lateral = b_heading = b_steering = 0.0
    for step in range(params.horizon):
        arm = (speed + step * dt * accel) * dt
        lateral += arm * heading
        heading += arm * steering / params.wheel_base - arm * ref.curvature[step]
        b_lateral += arm * b_heading
        b_heading += arm * b_steering / params.wheel_base
        b_steering += dt
    heading, steering = wrap_angle(heading), wrap_angle(steering)
    top = (
        b_lateral * params.q_lateral_error * lateral
        + b_heading * params.q_heading_error * heading
        + b_steering * params.q_steering * steering
    )
    bottom = (
        params.r_lateral
        + b_lateral * params.q_lateral_error * b_lateral
        + b_heading * params.q_heading_error * b_heading
        + b_steering * params.q_steering * b_steering
    )
    return -top / bottom


@kernel
def command(state: FloatArray, ref: Reference, params: LqrParameters) -> tuple[float, float]:
    """Acceleration [m/s^2] and steering rate [rad/s] that follow the reference."""
    # nuPlan rule 22: neither of them is limited
    speed = state[VX]
    if is_stopping(speed, ref.speed, params):
        return -params.stopping_gain * (speed - ref.speed), 0.0
    hold = params.horizon * (params.step_us / 1e6)
    gain = hold * params.q_longitudinal / (params.r_longitudinal + hold**2 * params.q_longitudinal)
    accel = -gain * (speed - ref.speed)
    return accel, steering_rate(ref, speed, state[STEERING], accel, params)


@kernel
def track(
    now_us: int,
    state: FloatArray,
    traj_time_us: IntArray,
    traj_states: FloatArray,
    params: LqrParameters,
) -> tuple[int, float, float]:
    """Status, acceleration [m/s^2] and steering rate [rad/s] for one iteration.

    Arguments as for `reference`. The command is 0 when the status is not TRACKED.
    """
    ref = reference(now_us, state, traj_time_us, traj_states, params)
    if ref.status != TRACKED:
        return ref.status, 0.0, 0.0
    accel, rate = command(state, ref, params)
    return TRACKED, accel, rate


@kernel
def track_and_step(
    now_us: int,  # time stamp of `state` [us]
    next_us: int,  # time stamp of the next iteration [us]
    state: FloatArray,  # (11,) ego state
    traj_time_us: IntArray,  # (H,) strictly increasing time stamps of the plan [us]
    traj_states: FloatArray,  # (H, 11) states of the plan; only the poses are read
    noise_accel: float,  # added to the acceleration, unless exactly 0 [m/s^2]
    noise_rate: float,  # added to the steering rate, unless exactly 0 [rad/s]
    out_state: FloatArray,  # (11,) receives the next state
    out_command: FloatArray,  # (2,) receives the clean command, before noise
) -> int:
    """One closed-loop step with nuPlan's parameters: tracker, noise, kinematic bicycle.

    Returns:
        TRACKED, or why nothing was written (see `raise_for_status`).
    """
    status, accel, rate = track(now_us, state, traj_time_us, traj_states, NUPLAN)
    if status != TRACKED:
        return status
    out_command[0], out_command[1] = accel, rate
    command_and_step(now_us, next_us, state, out_command, noise_accel, noise_rate, out_state)
    return TRACKED


def raise_for_status(status: int, now_us: int, traj_time_us: IntArray) -> None:
    """Turn a status of the kernels into an error.

    Raises:
        InvalidTrajectoryError: The status is not TRACKED.
    """
    if status == TRACKED:
        return
    if len(traj_time_us) < 2:
        raise InvalidTrajectoryError(
            f"trajectory has {len(traj_time_us)} states", "return at least 3 states, 0.1 s apart"
        )
    seconds = (int(traj_time_us[-1]) - int(traj_time_us[0])) / 1e6
    if status == TOO_SHORT:
        raise InvalidTrajectoryError(
            f"trajectory lasts {seconds:g} s", "plan at least 0.2 s, better 1 s and more"
        )
    start = (int(traj_time_us[0]) - now_us) / 1e6
    raise InvalidTrajectoryError(
        f"trajectory covers {start:g} s to {start + seconds:g} s from now, not the present",
        "let the first state be the present ego state, at the time stamp of the iteration",
    )
