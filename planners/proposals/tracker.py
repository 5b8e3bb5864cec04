"""Proposals driven by a tracker and the kinematic bicycle.

The tracker is nuPlan's LQR but for the speed profile, and for time, which is a whole index here.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.dynamics.bicycle import turn_and_step
from shiftsim.sim.dynamics.lqr import (
    NUPLAN,
    TRACKED,
    LqrParameters,
    Reference,
    command,
    fit_curvature,
)
from shiftsim.world.state import (
    HEADING,
    NUM_STATE,
    PACIFICA,
    STEERING,
    VehicleParameters,
    X,
    Y,
)

DT = 0.1  # s, between poses
STEP_US = 100_000
STEPS = 80  # of a plan
SCORED = 40  # of a proposal, as far as proposals are compared


@kernel
def factor_speed_fit(dt: float, penalty: float, factors: FloatArray) -> None:
    """Write what `fit_speed` needs of its matrix, the same for all poses, into `factors` (3, M).

    It penalises the accelerations a_j = (v_j+1 - v_j) / dt. In the speeds v that is a system with
    two sub-diagonals,

        sum (d_k - dt v_k)^2 + penalty (sum_{j < M - 3} a_j^2 + (a_M-2 - a_M-3)^2),

    solved by an LDL' factorisation; M >= 3.
    """
    # nuPlan rule 185: differences of accelerations are meant to be penalised, but only the last row
    # of the matrix is one
    count, weight = factors.shape[1], penalty / dt**4
    diagonal, side1, side2 = factors[0], factors[1], factors[2]
    for row in range(count):
        diagonal[row], side1[row], side2[row] = 1.0, 0.0, 0.0
    for row in range(count - 3):
        diagonal[row] += weight
        diagonal[row + 1] += weight
        side1[row + 1] -= weight  # with the row before
    diagonal[count - 3] += weight
    diagonal[count - 2] += 4.0 * weight
    diagonal[count - 1] += weight
    side1[count - 2] -= 2.0 * weight
    side1[count - 1] -= 2.0 * weight
    side2[count - 1] += weight
    # side1 and side2 become the factors L, diagonal the pivots
    for row in range(1, count):
        if row >= 2:
            factor2 = side2[row] / diagonal[row - 2]
            side1[row] -= side2[row] * side1[row - 1]
            diagonal[row] -= factor2 * side2[row]
            side2[row] = factor2
        factor1 = side1[row] / diagonal[row - 1]
        diagonal[row] -= factor1 * side1[row]
        side1[row] = factor1


@kernel
def fit_speed(
    poses: FloatArray, courses: FloatArray, dt: float, factors: FloatArray, out: FloatArray
) -> None:
    """Smoothed signed speed between poses (M + 1, 3), into `out` (M,) [m/s]; M >= 3.

    `courses` (M + 1, 2) receives cosine and sine of their headings; see `factor_speed_fit`.
    """
    count, last = len(out), len(poses) - 1
    diagonal, side1, side2 = factors[0], factors[1], factors[2]
    courses[last, 0], courses[last, 1] = np.cos(poses[last, 2]), np.sin(poses[last, 2])
    for row in range(count):
        cos, sin = np.cos(poses[row, 2]), np.sin(poses[row, 2])
        courses[row, 0], courses[row, 1] = cos, sin
        out[row] = (
            (poses[row + 1, 0] - poses[row, 0]) * cos + (poses[row + 1, 1] - poses[row, 1]) * sin
        ) / dt
        if row >= 2:
            out[row] -= side2[row] * out[row - 2]
        if row >= 1:
            out[row] -= side1[row] * out[row - 1]
    for row in range(count - 1, -1, -1):
        out[row] /= diagonal[row]
        if row + 1 < count:
            out[row] -= side1[row + 1] * out[row + 1]
        if row + 2 < count:
            out[row] -= side2[row + 2] * out[row + 2]


class Profiles(NamedTuple):
    """What poses are tracked by."""

    speeds: FloatArray  # (T - 1,) reference speeds [m/s]
    curvatures: FloatArray  # (T - 1,) reference curvatures [1/m]
    ahead: FloatArray  # (horizon,) scratch
    courses: FloatArray  # (T, 2) cosine and sine of the headings
    factors: FloatArray  # (3, T - 1) see `factor_speed_fit`


@kernel
def fit_profiles(poses: FloatArray, dt: float, params: LqrParameters, profiles: Profiles) -> None:
    """Fill in the profiles of poses (T, 3); the factors are there."""
    fit_speed(poses, profiles.courses, dt, profiles.factors, profiles.speeds)
    rate_penalty = params.curvature_rate_penalty
    fit_curvature(poses, profiles.speeds, dt, rate_penalty, profiles.curvatures)


@kernel
def look_ahead(
    state: FloatArray, pose: FloatArray, step: int, profiles: Profiles
) -> tuple[float, float]:
    """Lateral error [m] and heading error [rad] of a state (11,) beside the pose (3,) of a step.

    The curvatures from there on are written into `profiles.ahead`.
    """
    last = len(profiles.curvatures) - 1
    for index in range(len(profiles.ahead)):
        profiles.ahead[index] = profiles.curvatures[min(step + index, last)]
    cos, sin = profiles.courses[step, 0], profiles.courses[step, 1]
    lateral = (state[Y] - pose[1]) * cos - (state[X] - pose[0]) * sin
    return lateral, wrap_angle(state[HEADING] - pose[2])


class Driven(NamedTuple):
    """Proposals as driven."""

    speeds: FloatArray  # (P, T - 1) reference speeds [m/s]
    curvatures: FloatArray  # (P, T - 1) reference curvatures [1/m]
    states: FloatArray  # (P, 41, 11) states


def drive_proposals(
    poses: FloatArray, ego: FloatArray, vehicle: VehicleParameters = PACIFICA
) -> Driven:
    """Drive proposals (P, T, 3), T > 40, from one ego state (11,)."""
    shape = (len(poses), poses.shape[1] - 1)
    driven = Driven(np.empty(shape), np.empty(shape), np.empty((len(poses), SCORED + 1, NUM_STATE)))
    _drive(poses, ego, NUPLAN._replace(wheel_base=vehicle.wheel_base), DT, driven)
    return driven


@kernel
def _drive(
    poses: FloatArray, ego: FloatArray, params: LqrParameters, dt: float, out: Driven
) -> None:
    count = out.speeds.shape[1]
    ahead, courses, factors = (
        np.empty(params.horizon),
        np.empty((count + 1, 2)),
        np.empty((3, count)),
    )
    factor_speed_fit(dt, params.jerk_penalty, factors)
    for row in range(len(poses)):
        profiles = Profiles(out.speeds[row], out.curvatures[row], ahead, courses, factors)
        fit_profiles(poses[row], dt, params, profiles)
        _follow(poses[row], ego, params, dt, profiles, out.states[row])


@kernel
def _follow(
    poses: FloatArray,
    ego: FloatArray,
    params: LqrParameters,
    dt: float,
    profiles: Profiles,
    states: FloatArray,
) -> None:
    """Drive one proposal (T, 3) into `states` (41, 11)."""
    for column in range(len(ego)):
        states[0, column] = ego[column]
    last, tangent = len(profiles.speeds) - 1, np.tan(ego[STEERING])
    for step in range(len(states) - 1):
        speed = profiles.speeds[min(step + params.horizon, last)]
        lateral, turn = look_ahead(states[step], poses[step], step, profiles)
        reference = Reference(TRACKED, lateral, turn, speed, profiles.ahead)
        accel, rate = command(states[step], reference, params)
        tangent = turn_and_step(
            states[step], tangent, accel, rate, params.wheel_base, dt, states[step + 1]
        )
