"""nuPlan's SimplePlanner: straight on, and not faster than a limit."""

import numpy as np

from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.dynamics.bicycle import WHEEL_BASE, step_bicycle
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import AX, NUM_STATE, VX, VY, Trajectory

STEPS = 40  # 10 s at 0.25 s
STEP_US = 250_000


class Simple:
    """Keeps the heading; a speed above the limit decays towards it."""

    name = "simple"

    def __init__(self, *, max_velocity: float = 5.0) -> None:
        """`max_velocity`: Speed above which it brakes [m/s]."""
        self._max_velocity = float(max_velocity)

    def reset(self, scene: SceneInfo) -> None:
        """Nothing to prepare."""

    def plan(self, observation: Observation) -> Trajectory:
        """The present state without acceleration and steering, and 40 steps of 0.25 s from it."""
        states = np.zeros((STEPS + 1, NUM_STATE))
        states[0, :AX] = observation.ego.values[:AX]
        _drive(states, self._max_velocity)
        return Trajectory(observation.time_us + STEP_US * np.arange(STEPS + 1), states)


@kernel
def _drive(states: FloatArray, max_velocity: float) -> None:
    """Write the states (H, 11) that follow from the first one."""
    for row in range(len(states) - 1):
        # nuPlan rule 394: the new acceleration is not written back into the earlier state
        before = states[row].copy()
        speed = np.sqrt(before[VX] ** 2 + before[VY] ** 2)
        if speed > max_velocity:
            before[AX] = max_velocity - speed
        step_bicycle(before, before[AX], 0.0, WHEEL_BASE, STEP_US * 1e-6, states[row + 1])
