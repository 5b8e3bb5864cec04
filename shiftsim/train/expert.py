"""What PDM-Closed would do, as an action of CaRL's.

The tracker turns its plan into an acceleration and a steering rate; CaRL's action asks for an
acceleration and a steering angle. The angle is the present one and what the rate adds to it in
`tau` seconds. CaRL's angle is reached within 0.1 s: a larger `tau` steers harder than the tracker.
"""

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import FloatArray
from shiftsim.planners.learned.carl.planner import MAX_ACCELERATION, MAX_BRAKING, MAX_STEERING
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.sim.dynamics.lqr import NUPLAN, raise_for_status, track
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import STEERING, VX

Action = NDArray[np.float32]
SLOW, PARTING, HOLD = 0.3, 0.02, -0.3  # m/s; throttle of setting off; throttle of staying


def encode(acceleration: float, steering_rate: float, steering: float, tau: float) -> Action:
    """(2,) the action in [-1, 1] that stands for a command at a steering angle.

    `acceleration` [m/s^2], `steering_rate` [rad/s], `steering` [rad], `tau` [s].
    """
    most = MAX_ACCELERATION if acceleration >= 0.0 else MAX_BRAKING
    angle = steering + tau * steering_rate
    action = np.array([acceleration / most, angle / MAX_STEERING])
    return np.clip(action, -1.0, 1.0).astype(np.float32)


def hold(action: Action, speed: float) -> Action:
    """The action, which brakes where a vehicle at `speed` [m/s] is to stand or come to a stand.

    Braking at a stand changes nothing, as nobody drives backwards. But a network that is taught
    a throttle of 0 there errs to either side, and creeps into what it waits for.
    """
    if speed < SLOW and action[0] < PARTING:
        action[0] = min(float(action[0]), HOLD)
    return action


class Expert:
    """PDM-Closed in one scenario."""

    def __init__(self, scene: SceneInfo, tau: float) -> None:
        """`tau` as in `encode`."""
        self._planner, self._tau = PdmClosed(), tau
        self._planner.reset(scene)

    def act(self, observation: Observation) -> Action:
        """What it would do now."""
        plan = self._planner.plan(observation)
        ego: FloatArray = observation.history.ego[-1].copy()
        now = observation.time_us
        status, acceleration, rate = track(now, ego, plan.time_us, plan.states, NUPLAN)
        raise_for_status(status, now, plan.time_us)
        action = encode(acceleration, rate, float(ego[STEERING]), self._tau)
        return hold(action, float(ego[VX]))
