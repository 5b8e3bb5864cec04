"""Proposals driven by a tracker and the kinematic bicycle.

The tracker is nuPlan's LQR but for the speed profile, and for time, which is a whole index here.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, kernel, lean_kernel
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.sim.dynamics.bicycle import step_bicycle
from shiftsim.sim.dynamics.lqr import (
    NUPLAN,
    TRACKED,
    LqrParameters,
    Reference,
    command,
    fit_curvature,
)
from shiftsim.world.state import HEADING, NUM_STATE, PACIFICA, VehicleParameters, X, Y

DT = 0.1  # s, between poses
STEP_US = 100_000
STEPS = 80  # of a plan
SCORED = 40  # of a proposal, as far as proposals are compared


@kernel
def fit_speed(poses: FloatArray, dt: float, penalty: float, out: FloatArray) -> None:
    """Smoothed signed speed between poses (M + 1, 3), into `out` (M,) [m/s]; M >= 3.

    Penalises the accelerations a_j = (v_j+1 - v_j) / dt. In the speeds v that is a system with two
    sub-diagonals,

        sum (d_k - dt v_k)^2 + penalty (sum_{j < M - 3} a_j^2 + (a_M-2 - a_M-3)^2),

    solved by an LDL' factorisation.
    """
    # nuPlan rule 185: differences of accelerations are meant to be penalised, but only the last row
    # of the matrix is one
    count = len(out)
    weight = penalty / dt**4
    diagonal, side1, side2 = np.ones(count), np.zeros(count), np.zeros(count)
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
    # side1 and side2 become the factors L, diagonal the pivots, out the solution
    for row in range(count):
        out[row] = (
            (poses[row + 1, 0] - poses[row, 0]) * np.cos(poses[row, 2])
            + (poses[row + 1, 1] - poses[row, 1]) * np.sin(poses[row, 2])
        ) / dt
        if row >= 2:
            factor2 = side2[row] / diagonal[row - 2]
            side1[row] -= side2[row] * side1[row - 1]
            diagonal[row] -= factor2 * side2[row]
            out[row] -= factor2 * out[row - 2]
            side2[row] = factor2
        if row >= 1:
            factor1 = side1[row] / diagonal[row - 1]
            diagonal[row] -= factor1 * side1[row]
            out[row] -= factor1 * out[row - 1]
            side1[row] = factor1
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


@kernel
def fit_profiles(poses: FloatArray, dt: float, params: LqrParameters, profiles: Profiles) -> None:
    """Fill in the profiles of poses (T, 3)."""
    fit_speed(poses, dt, params.jerk_penalty, profiles.speeds)
    rate_penalty = params.curvature_rate_penalty
    fit_curvature(poses, profiles.speeds, dt, rate_penalty, profiles.curvatures)


@lean_kernel
def look_ahead(
    state: FloatArray, pose: FloatArray, step: int, profiles: Profiles
) -> tuple[float, float]:
    """Lateral error [m] and heading error [rad] of a state (11,) beside the pose (3,) of a step.

    The curvatures from there on are written into `profiles.ahead`.
    """
    last = len(profiles.curvatures) - 1
    for index in range(len(profiles.ahead)):
        profiles.ahead[index] = profiles.curvatures[min(step + index, last)]
    lateral = (state[Y] - pose[1]) * np.cos(pose[2]) - (state[X] - pose[0]) * np.sin(pose[2])
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
    ahead = np.empty(params.horizon)
    for row in range(len(poses)):
        profiles = Profiles(out.speeds[row], out.curvatures[row], ahead)
        fit_profiles(poses[row], dt, params, profiles)
        _follow(poses[row], ego, params, dt, profiles, out.states[row])


@lean_kernel
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
    last = len(profiles.speeds) - 1
    for step in range(len(states) - 1):
        speed = profiles.speeds[min(step + params.horizon, last)]
        lateral, turn = look_ahead(states[step], poses[step], step, profiles)
        reference = Reference(TRACKED, lateral, turn, speed, profiles.ahead)
        accel, rate = command(states[step], reference, params)
        step_bicycle(states[step], accel, rate, params.wheel_base, dt, states[step + 1])
