"""One planning step of PDM-Closed, from what it sees to the plan (pdm-closed.md §2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.pdm.brake import brake_poses
from shiftsim.planners.pdm.forecast import Occupants
from shiftsim.planners.pdm.parameters import DT, SCORED, PdmParameters
from shiftsim.planners.pdm.path import PdmPath
from shiftsim.planners.pdm.rollout import Proposals, extend, roll_out, start_proposals
from shiftsim.planners.pdm.scorer import Road, Scores, score
from shiftsim.planners.proposals.comfort import make_filters
from shiftsim.planners.proposals.tracker import simulate_proposals
from shiftsim.sim.dynamics.lqr import NUPLAN
from shiftsim.world.state import NUM_STATE, VX, VY, VehicleParameters


@dataclass(frozen=True, slots=True)
class Step:
    """What one step came to. P = 15 proposals, 5 speeds on each of 3 paths.

    Attributes:
        poses: (81, 3) the plan, rear axle x [m], y [m], heading [rad].
        best: Number of the best proposal.
        braked: Whether the emergency brake replaces it.
        proposals: As rolled out.
        speeds: (P, 40) reference speeds of the tracker [m/s].
        curvatures: (P, 40) reference curvatures of the tracker [1/m].
        driven: (P, 41, 11) states of the proposals as driven by the tracker.
        scores: Of the driven proposals.
    """

    poses: FloatArray
    best: int
    braked: bool
    proposals: Proposals
    speeds: FloatArray
    curvatures: FloatArray
    driven: FloatArray
    scores: Scores


def plan_step(
    ego: FloatArray,
    targets: FloatArray,
    paths: Sequence[PdmPath],
    occupants: Occupants,
    road: Road,
    vehicle: VehicleParameters,
    params: PdmParameters,
) -> Step:
    """Roll out, drive and score proposals, and choose.

    Args:
        ego: (11,) ego state.
        targets: (F,) target speeds, slowest first [m/s].
        paths: The centerline and those beside it.
        occupants: What is around, forecast included.
        road: The map of this step.
        vehicle: Dimensions of the ego.
        params: The planner's numbers.
    """
    proposals = start_proposals(paths, ego, targets, vehicle, len(occupants.ignored))
    roll_out(proposals, paths, occupants, vehicle, params.following)
    poses = np.ascontiguousarray(proposals.poses[:, :, : SCORED + 1]).reshape(-1, SCORED + 1, 3)
    speeds, curvatures = np.empty((len(poses), SCORED)), np.empty((len(poses), SCORED))
    driven = np.empty((len(poses), SCORED + 1, NUM_STATE))
    tracker = NUPLAN._replace(wheel_base=vehicle.wheel_base)
    simulate_proposals(poses, ego, tracker, DT, speeds, curvatures, driven)
    scores = score(driven, road, occupants, vehicle, params, make_filters())
    best = int(np.argmax(scores.total))  # the first one on ties
    is_near = DT * scores.collision_index[best] <= params.brake_time
    braked = bool(is_near and np.hypot(ego[VX], ego[VY]) <= params.brake_speed)
    if braked:
        plan = brake_poses(ego, vehicle)
    else:
        plan = extend(proposals, best, paths, occupants, vehicle, params.following)
    return Step(plan, best, braked, proposals, speeds, curvatures, driven, scores)
