"""One planning step of PDM-Closed, from what it sees to the plan."""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.pdm.brake import brake_poses
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.pdm.rollout import Proposals, Scene, extend, roll_out, start_proposals
from shiftsim.planners.pdm.scorer import Place, Scores, score
from shiftsim.planners.proposals.tracker import DT, SCORED, Driven, drive_proposals
from shiftsim.world.state import VX, VY, VehicleParameters


class Step(NamedTuple):
    """What one step came to. P = 15 proposals, 5 speeds on each of 3 paths."""

    poses: FloatArray  # (81, 3) the plan, rear axle x [m], y [m], heading [rad]
    best: int  # number of the best proposal
    braked: bool  # whether the emergency brake replaces it
    proposals: Proposals  # as rolled out
    driven: Driven  # as driven by the tracker
    scores: Scores  # of the driven proposals


def plan_step(
    ego: FloatArray,
    targets: FloatArray,
    scene: Scene,
    place: Place,
    vehicle: VehicleParameters,
    params: PdmParameters,
) -> Step:
    """Roll out, drive and score proposals, and choose.

    Args:
        ego: (11,) ego state.
        targets: (F,) target speeds, slowest first [m/s].
        scene: What the proposals are rolled out in.
        place: The map of this step.
        vehicle: Dimensions of the ego.
        params: The planner's numbers.
    """
    proposals = start_proposals(scene, ego, targets)
    roll_out(proposals, scene)
    poses = np.ascontiguousarray(proposals.poses[:, :, : SCORED + 1]).reshape(-1, SCORED + 1, 3)
    driven = drive_proposals(poses, ego, vehicle)
    scores = score(driven.states, place, scene.forecast.others, scene.size, params)
    best = int(np.argmax(scores.total))  # the first one on ties
    is_near = DT * scores.collision_index[best] <= params.brake_time
    braked = bool(is_near and np.hypot(ego[VX], ego[VY]) <= params.brake_speed)
    plan = brake_poses(ego, vehicle) if braked else extend(proposals, scene, best)
    return Step(plan, best, braked, proposals, driven, scores)
