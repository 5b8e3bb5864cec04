"""The smallest possible planner: keep heading and speed."""

import numpy as np

from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import NUM_STATE, VX, Trajectory

_STEPS = np.arange(81)  # 8 s


class ConstantVelocity:
    """Drives straight on at the present speed."""

    name = "constant-velocity"

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation) -> Trajectory:
        """Poses every 0.1 s along the present heading."""
        ego = observation.ego
        x, y, heading = ego.pose.tolist()
        speed = ego.speed
        distance = speed * 0.1 * _STEPS
        states = np.zeros((len(_STEPS), NUM_STATE))
        states[:, 0] = x + distance * np.cos(heading)
        states[:, 1] = y + distance * np.sin(heading)
        states[:, 2] = heading
        states[:, VX] = speed
        return Trajectory(_STEPS * 100_000, states, relative=True)
