"""One planning step of PDM-Closed, from what it sees to the plan or the emergency brake."""

from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.pdm.rollout import Proposals, Scene, extend, roll_out
from shiftsim.planners.pdm.scorer import Place, Scores, score
from shiftsim.planners.proposals.tracker import DT, SCORED, STEPS, Driven, drive_proposals
from shiftsim.world.state import (
    AX,
    HEADING,
    VX,
    VY,
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


class Step(NamedTuple):
    """What one step came to. P = 15 proposals, 5 speeds on each of 3 paths."""

    poses: FloatArray  # (81, 3) the plan, rear axle x [m], y [m], heading [rad]
    best: int  # number of the best proposal
    braked: bool  # whether the emergency brake replaces it
    proposals: Proposals  # as rolled out
    driven: Driven  # as driven by the tracker
    scores: Scores  # of the driven proposals


def plan_step(
    ego: FloatArray,  # (11,) ego state
    targets: FloatArray,  # (F,) target speeds, slowest first [m/s]
    scene: Scene,  # what the proposals are rolled out in
    place: Place,  # the map of this step
    vehicle: VehicleParameters,
    params: PdmParameters,
) -> Step:
    """Roll out, drive and score proposals, and choose."""
    proposals = roll_out(scene, ego, targets)
    poses = np.ascontiguousarray(proposals.poses[:, :, : SCORED + 1]).reshape(-1, SCORED + 1, 3)
    driven = drive_proposals(poses, ego, vehicle)
    scores = score(driven.states, place, scene.forecast.others, scene.size, params)
    best, braked = choose(scores, ego, params)
    plan = brake_poses(ego, vehicle) if braked else extend(proposals, scene, best)
    return Step(plan, best, braked, proposals, driven, scores)


def choose(scores: Scores, ego: FloatArray, params: PdmParameters) -> tuple[int, bool]:
    """Number of the best proposal, and whether the emergency brake replaces it."""
    best = int(np.argmax(scores.total))  # the first one on ties
    is_near = DT * scores.collision_index[best] <= params.brake_time
    return best, bool(is_near and np.hypot(ego[VX], ego[VY]) <= params.brake_speed)
