"""The emergency brake of PDM-Closed."""

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.proposals.tracker import DT, STEPS
from shiftsim.world.state import (
    AX,
    HEADING,
    VX,
    YAW_RATE,
    VehicleParameters,
    center_poses,
    rear_poses,
)

MAX_ACCEL, MIN_ACCEL = 2.40, -4.05  # m/s^2
STOPPED = 0.2  # m/s


def brake_speed(ego: FloatArray, vehicle: VehicleParameters) -> float:
    """Speed of the reference that makes the tracker brake, usually backwards [m/s]."""
    speed = float(ego[VX])
    if speed > STOPPED:
        return 1.1 * (speed + float(np.clip(-10.0 * speed, MIN_ACCEL, MAX_ACCEL)))
    # nuPlan rule 194: the centre's acceleration without the angular term
    accel = float(ego[AX]) + vehicle.rear_axle_to_center * float(ego[YAW_RATE]) ** 2
    return float(np.clip(-4.0 * speed - accel, MIN_ACCEL, MAX_ACCEL))


def brake_poses(ego: FloatArray, vehicle: VehicleParameters) -> FloatArray:
    """(81, 3) rear-axle poses straight along the heading of an ego state (11,)."""
    center = center_poses(ego[None, :3], vehicle)[0]
    travel = brake_speed(ego, vehicle) * DT * np.arange(STEPS + 1)
    centers = np.tile(center, (STEPS + 1, 1))
    centers[:, 0] += travel * np.cos(ego[HEADING])
    centers[:, 1] += travel * np.sin(ego[HEADING])
    return rear_poses(centers, vehicle)
