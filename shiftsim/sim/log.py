"""SimulationLog: the arrays of one finished rollout, nothing else.

Metrics, results and pages are made from it. It holds K = T - 1 samples for a scenario of T
iterations: the state reached after the last planner call is never stored.
"""

from dataclasses import dataclass

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.world.state import Tracks, TrafficLights


@dataclass(frozen=True, slots=True)
class SimulationLog:
    """One rollout. K samples, T = K + 1 iterations.

    Attributes:
        token: Id of the scenario.
        time_us: (K,) time stamps [us].
        ego: (K, 11) simulated ego states, columns of `state.STATE_COLUMNS`.
        tracks: What the planner saw of the others at each sample.
        traffic_lights: Lights at each sample.
        expert_time_us: (T,) time stamps of the iterations [us].
        expert_ego: (T, 11) recorded ego states at the iterations.
        route: Route roadblock ids.
        commands: (K, 2) acceleration [m/s^2] and steering rate [rad/s] asked for at each sample,
            before noise; NaN where no motion model ran.
        noise: (K, 2) what was added to them.
        plans: (K, P, 3) poses of the plan over its first second, from the moment of planning on
            (P = 11 at 0.1 s); NaN where a command was returned.
        planning_seconds: (K,) time the planner took for each call [s].
        degraded: (K,) whether the plan was a fallback by the planner's own account.
    """

    token: str
    time_us: IntArray
    ego: FloatArray
    tracks: Tracks
    traffic_lights: TrafficLights
    expert_time_us: IntArray
    expert_ego: FloatArray
    route: tuple[str, ...]
    commands: FloatArray
    noise: FloatArray
    plans: FloatArray
    planning_seconds: FloatArray
    degraded: BoolArray
