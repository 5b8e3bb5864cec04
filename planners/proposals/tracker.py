"""Proposals driven by PDM-Closed's own tracker and the kinematic bicycle (pdm-closed.md §7).

The tracker is nuPlan's LQR but for the speed profile, and for time, which is a whole index here.
"""

import numpy as np

from shiftsim.arrays import FloatArray, kernel
from shiftsim.geometry.frames import wrap_angle
from shiftsim.sim.dynamics.bicycle import step_bicycle
from shiftsim.sim.dynamics.lqr import TRACKED, LqrParameters, Reference, command, fit_curvature
from shiftsim.world.state import HEADING, X, Y


@kernel
def fit_speed(poses: FloatArray, dt: float, penalty: float, out: FloatArray) -> None:
    """Smoothed signed speed between poses (M + 1, 3), into `out` (M,) [m/s]; M >= 3.

    nuPlan: meant to penalise differences of accelerations a_j = (v_j+1 - v_j) / dt, the reference
    implementation penalises the accelerations themselves, but for the last row, which is a
    difference (pdm-closed.md §7.1). In the speeds v that is a system with two sub-diagonals,

        sum (d_k - dt v_k)^2 + penalty (sum_{j < M - 3} a_j^2 + (a_M-2 - a_M-3)^2),

    solved by an LDL' factorisation.
    """
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


@kernel
def simulate_proposals(
    poses: FloatArray,
    ego: FloatArray,
    params: LqrParameters,
    dt: float,
    speeds: FloatArray,
    curvatures: FloatArray,
    states: FloatArray,
) -> None:
    """Drive P proposals from one ego state.

    Args:
        poses: (P, T, 3) poses of the proposals x [m], y [m], heading [rad].
        ego: (11,) ego state.
        params: Of the tracker.
        dt: Time between poses [s].
        speeds: (P, T - 1) receives the reference speeds [m/s].
        curvatures: (P, T - 1) receives the reference curvatures [1/m].
        states: (P, S, 11) receives the driven states, S <= T.
    """
    last = poses.shape[1] - 2
    ahead = np.empty(params.horizon)
    for row in range(len(poses)):
        fit_speed(poses[row], dt, params.jerk_penalty, speeds[row])
        fit_curvature(poses[row], speeds[row], dt, params.curvature_rate_penalty, curvatures[row])
        for column in range(len(ego)):
            states[row, 0, column] = ego[column]
        for step in range(states.shape[1] - 1):
            state, pose = states[row, step], poses[row, step]
            for index in range(params.horizon):
                ahead[index] = curvatures[row, min(step + index, last)]
            lateral = (state[Y] - pose[1]) * np.cos(pose[2]) - (state[X] - pose[0]) * np.sin(
                pose[2]
            )
            turn = wrap_angle(state[HEADING] - pose[2])
            speed = speeds[row, min(step + params.horizon, last)]
            reference = Reference(TRACKED, lateral, turn, speed, ahead)
            accel, rate = command(state, reference, params)
            step_bicycle(state, accel, rate, params.wheel_base, dt, states[row, step + 1])
