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
from shiftsim.world.state import HEADING, NUM_STATE, PACIFICA, STEERING, VehicleParameters, X, Y

DT = 0.1  # s, between poses
STEP_US = 100_000
STEPS = 80  # of a plan
SCORED = 40  # of a proposal, as far as proposals are compared


@kernel
def fit_speed(poses: FloatArray, dt: float, penalty: float, out: FloatArray) -> None:
    """Smoothed signed speed between poses (M + 1, 3), into `out` (M,) [m/s]; M >= 3.

    It penalises the accelerations a_j = (v_j+1 - v_j) / dt. In the speeds v that is a system with
    two sub-diagonals,

        sum (d_k - dt v_k)^2 + penalty (sum_{j < M - 3} a_j^2 + (a_M-2 - a_M-3)^2),

    solved by an LDL' factorisation.
    """
    # nuPlan rule 185: differences of accelerations are meant to be penalised, but only the last row
    # of the matrix is one
    count, weight = len(out), penalty / dt**4
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
    # side1 and side2 become the factors L, diagonal the pivots
    for row in range(count):
        out[row] = (
            (poses[row + 1, 0] - poses[row, 0]) * np.cos(poses[row, 2])
            + (poses[row + 1, 1] - poses[row, 1]) * np.sin(poses[row, 2])
        ) / dt
        if row >= 2:
            factor2 = side2[row] / diagonal[row - 2]
            side1[row] -= side2[row] * side1[row - 1]
            diagonal[row] -= factor2 * side2[row]
            side2[row] = factor2
            out[row] -= factor2 * out[row - 2]
        if row >= 1:
            factor1 = side1[row] / diagonal[row - 1]
            diagonal[row] -= factor1 * side1[row]
            side1[row] = factor1
            out[row] -= factor1 * out[row - 1]
    for row in range(count - 1, -1, -1):
        out[row] /= diagonal[row]
        if row + 1 < count:
            out[row] -= side1[row + 1] * out[row + 1]
        if row + 2 < count:
            out[row] -= side2[row + 2] * out[row + 2]


@kernel
def reference_at(
    state: FloatArray,
    poses: FloatArray,
    step: int,
    speed: float,
    curvatures: FloatArray,
    ahead: FloatArray,
) -> Reference:
    """What a state (11,) is steered to at a step of poses (T, 3) with curvatures (T - 1,) [1/m].

    `speed` is that of the reference [m/s]; `ahead` (horizon,) receives the next curvatures.
    """
    last = len(curvatures) - 1
    for index in range(len(ahead)):
        ahead[index] = curvatures[min(step + index, last)]
    cos, sin = np.cos(poses[step, 2]), np.sin(poses[step, 2])
    lateral = (state[Y] - poses[step, 1]) * cos - (state[X] - poses[step, 0]) * sin
    return Reference(TRACKED, lateral, wrap_angle(state[HEADING] - poses[step, 2]), speed, ahead)


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
    ahead, last, state = np.empty(params.horizon), out.speeds.shape[1] - 1, np.empty(len(ego))
    states = out.states
    for row in range(len(poses)):
        path, speeds, curvatures = poses[row], out.speeds[row], out.curvatures[row]
        fit_speed(path, dt, params.jerk_penalty, speeds)
        fit_curvature(path, speeds, dt, params.curvature_rate_penalty, curvatures)
        for column in range(len(ego)):
            state[column] = states[row, 0, column] = ego[column]
        tangent = np.tan(ego[STEERING])
        for step in range(states.shape[1] - 1):
            speed = speeds[min(step + params.horizon, last)]
            reference = reference_at(state, path, step, speed, curvatures, ahead)
            accel, rate = command(state, reference, params)
            tangent = turn_and_step(state, tangent, accel, rate, params.wheel_base, dt, state)
            for column in range(len(state)):
                states[row, step + 1, column] = state[column]
