"""What networks are tried on, and how their plans are looked at."""

import numpy as np
from worlds import standing_tracks

from shiftsim.geometry.boxes import to_frame
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.state import AgentKind


def crowd(rng, num_rows, count, num_kinds):
    """Tracks of the first kinds that stand around the middle of the straight road."""
    kinds = [AgentKind(int(kind)) for kind in rng.integers(0, num_kinds, count)]
    poses = np.c_[
        rng.uniform(150, 270, count), rng.uniform(-9, 12, count), rng.uniform(-3, 3, count)
    ]
    return standing_tracks(num_rows, poses, kinds)


def first_sight(scenario, planner):
    """What a planner sees first."""
    return Rollout(scenario, planner).observe()


def plan_of(planner, scenario):
    """Its first plan."""
    return planner.plan(first_sight(scenario, planner))


def recorded_inputs(scenario, planner=None):
    """The scene, and what a planner sees at the first 20 iterations of the recorded ego."""
    return scene_info(scenario, planner=planner), [observe_log(scenario, i) for i in range(20)]


def in_ego_frame(plan, ego):
    """(80, 4) x, y, cos and sin of the heading, as seen from the pose of an ego state (11,)."""
    poses = to_frame(plan.states[1:, :3], ego[:3])
    return np.c_[poses[:, :2], np.cos(poses[:, 2]), np.sin(poses[:, 2])]
