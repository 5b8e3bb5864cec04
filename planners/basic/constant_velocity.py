"""The smallest possible planner: keep heading and speed."""

import numpy as np

from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import NUM_STATE, VX, Trajectory

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
        _go_straight(x, y, heading, ego.speed, states)
        return Trajectory(_TIMES.copy(), states, relative=True)


@kernel
def _go_straight(x: float, y: float, heading: float, speed: float, out: FloatArray) -> None:
    """Write poses and speeds of states (H, 11) from a pose straight on."""
    cos, sin = np.cos(heading), np.sin(heading)
    for step in range(len(out)):
        distance = speed * 0.1 * step
        out[step, 0], out[step, 1], out[step, 2] = x + distance * cos, y + distance * sin, heading
        out[step, VX] = speed
