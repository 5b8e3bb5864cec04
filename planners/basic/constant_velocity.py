"""The smallest possible planner: keep heading and speed."""

import math

import numpy as np

from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import HEADING, NUM_STATE, VX, Trajectory, X, Y

_TIMES = 100_000 * np.arange(81)  # us, 8 s


class ConstantVelocity:
    """Drives straight on at the present speed."""

    name = "constant-velocity"

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation) -> Trajectory:
        """Poses every 0.1 s along the present heading."""
        ego, states = observation.ego, np.zeros((len(_TIMES), NUM_STATE))
        x, y, heading = ego.pose.tolist()
        distance = ego.speed * 0.1 * np.arange(len(states))
        states[:, X] = x + distance * math.cos(heading)
        states[:, Y] = y + distance * math.sin(heading)
        states[:, HEADING], states[:, VX] = heading, ego.speed
        return Trajectory(_TIMES.copy(), states, relative=True)
