"""PLUTO's emergency brake: follow the best candidate, but stop (planner-pluto.md §6)."""

import numpy as np

from shiftsim.arrays import FloatArray, kernel
from shiftsim.geometry.frames import wrap_angle
from shiftsim.planners.pdm.parameters import DT
from shiftsim.planners.proposals.tracker import fit_speed
from shiftsim.sim.dynamics.bicycle import step_bicycle
from shiftsim.sim.dynamics.lqr import (
    NUPLAN,
    TRACKED,
    LqrParameters,
    Reference,
    command,
    fit_curvature,
    is_stopping,
)
from shiftsim.world.state import HEADING, NUM_STATE, STEERING_RATE, VX, VY, VehicleParameters, X, Y

MAX_SPEED = 8.0  # m/s, a faster ego does not brake
GENTLE, HARD = 2.4, 4.05  # m/s^2, that decide whether and how to brake
REACTION = 0.5  # s
MIN_TIME = 3.0  # s, an infraction before that always brakes
SOFT_ACCEL, HARD_ACCEL = -4.0, -4.5  # m/s^2


def must_brake(speed: float, fault_time: float) -> bool:
    """Whether an infraction at a time [s] makes an ego of a speed [m/s] brake."""
    return fault_time <= max(speed / GENTLE + REACTION, MIN_TIME) and speed <= MAX_SPEED


def brake(
    candidate: FloatArray, ego: FloatArray, fault_time: float, vehicle: VehicleParameters
) -> FloatArray:
    """(81, 11) states, 0.1 s apart.

    Args:
        candidate: (81, 3) poses to steer along.
        ego: (11,) ego state.
        fault_time: Of the infraction [s].
        vehicle: Dimensions of the ego.
    """
    out = np.empty((len(candidate), NUM_STATE))
    soft = fault_time > float(np.hypot(ego[VX], ego[VY])) / HARD + REACTION
    tracker = NUPLAN._replace(wheel_base=vehicle.wheel_base)
    _roll_out(np.ascontiguousarray(candidate), ego, soft, tracker, DT, out)
    out[:, STEERING_RATE:] = 0.0  # nuPlan: the plan is made without the rates of steering and yaw
    return out


@kernel
def _roll_out(
    poses: FloatArray,
    ego: FloatArray,
    soft: bool,
    params: LqrParameters,
    dt: float,
    states: FloatArray,
) -> None:
    """Drive along poses (81, 3) to a standstill, into `states` (81, 11)."""
    last = len(poses) - 2
    speeds, curvatures = np.empty(last + 1), np.empty(last + 1)
    ahead = np.empty(params.horizon)
    fit_speed(poses, dt, params.jerk_penalty, speeds)
    fit_curvature(poses, speeds, dt, params.curvature_rate_penalty, curvatures)
    states[0] = ego
    for step in range(last + 1):
        state, pose = states[step], poses[step]
        for index in range(params.horizon):
            ahead[index] = curvatures[min(step + index, last)]
        lateral = (state[Y] - pose[1]) * np.cos(pose[2]) - (state[X] - pose[0]) * np.sin(pose[2])
        turn = wrap_angle(state[HEADING] - pose[2])
        reference = Reference(TRACKED, lateral, turn, 0.0, ahead)
        accel, rate = command(state, reference, params)
        if soft or is_stopping(state[VX], 0.0, params):
            accel = max(accel, SOFT_ACCEL)
        else:
            accel = HARD_ACCEL
        step_bicycle(state, accel, rate, params.wheel_base, dt, states[step + 1])
