"""PLUTO's emergency brake: follow the best proposal, but stop."""

import numpy as np

from shiftsim.kernels import FloatArray, kernel
from shiftsim.planners.proposals.tracker import DT, fit_speed, reference_at
from shiftsim.sim.dynamics.bicycle import step_bicycle
from shiftsim.sim.dynamics.lqr import (
    NUPLAN,
    LqrParameters,
    command,
    fit_curvature,
    is_stopping,
)
from shiftsim.world.state import NUM_STATE, STEERING_RATE, VX, VY, VehicleParameters

MAX_SPEED = 8.0  # m/s, a faster ego does not brake
GENTLE, HARD = 2.4, 4.05  # m/s^2, that decide whether and how to brake
REACTION = 0.5  # s
MIN_TIME = 3.0  # s, an infraction before that always brakes
SOFT_ACCEL, HARD_ACCEL = -4.0, -4.5  # m/s^2


def must_brake(speed: float, fault_time: float) -> bool:
    """Whether an infraction at a time [s] makes an ego of a speed [m/s] brake."""
    return fault_time <= max(speed / GENTLE + REACTION, MIN_TIME) and speed <= MAX_SPEED


def brake(
    proposal: FloatArray, ego: FloatArray, fault_time: float, vehicle: VehicleParameters
) -> FloatArray:
    """(81, 11) states, 0.1 s apart, along a proposal (81, 3) with a fault at `fault_time` [s]."""
    out = np.empty((len(proposal), NUM_STATE))
    out[0] = ego
    soft = fault_time > float(np.hypot(ego[VX], ego[VY])) / HARD + REACTION
    tracker = NUPLAN._replace(wheel_base=vehicle.wheel_base)
    _roll_out(np.ascontiguousarray(proposal), soft, tracker, DT, out)
    # nuPlan rule 240: the plan is made without the rates of steering and yaw
    out[:, STEERING_RATE:] = 0.0
    return out


@kernel
def _roll_out(
    poses: FloatArray, soft: bool, params: LqrParameters, dt: float, states: FloatArray
) -> None:
    """Drive along poses (81, 3) to a standstill; `states` (81, 11) starts with the ego's."""
    count = len(poses) - 1
    speeds, curvatures, ahead = np.empty(count), np.empty(count), np.empty(params.horizon)
    fit_speed(poses, dt, params.jerk_penalty, speeds)
    fit_curvature(poses, speeds, dt, params.curvature_rate_penalty, curvatures)
    for step in range(count):
        state = states[step]
        reference = reference_at(state, poses, step, 0.0, curvatures, ahead)
        accel, rate = command(state, reference, params)
        if soft or is_stopping(state[VX], 0.0, params):
            accel = max(accel, SOFT_ACCEL)
        else:
            accel = HARD_ACCEL
        step_bicycle(state, accel, rate, params.wheel_base, dt, states[step + 1])
