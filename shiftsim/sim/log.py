"""SimulationLog: the arrays of one finished rollout, nothing else.

Metrics, results and pages are made from it. It holds K = T - 1 samples for a scenario of T
iterations: the state reached after the last planner call is never stored.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks, TrafficLights

NUM_KEPT = 18  # poses of a plan


class Seen(NamedTuple):
    """What a planner saw in K samples."""

    ego: FloatArray  # (K, 3) where it took its rear axle to be: x [m], y [m], heading [rad]
    tracks: Tracks  # the boxes; those that return after a drop-out have tokens of their own


@dataclass(frozen=True, slots=True)
class SimulationLog:
    """One rollout. K samples, T = K + 1 iterations.

    Attributes:
        token: Id of the scenario.
        time_us: (K,) time stamps [us].
        ego: (K, 11) simulated ego states, columns of `state.STATE_COLUMNS`.
        tracks: The others at each sample.
        traffic_lights: Lights at each sample.
        expert_time_us: (T,) time stamps of the iterations [us].
        expert_ego: (T, 11) recorded ego states at the iterations.
        route: Route roadblock ids.
        commands: (K, 2) acceleration [m/s^2] and steering rate [rad/s] asked for at each sample,
            before noise; NaN where no motion model ran.
        noise: (K, 2) what was added to them.
        plans: (K, P, 3) poses of the plan: every 0.1 s over its first second, from the moment of
            planning on, then every second to 8 s (P = 18); NaN where it does not reach, and where a
            command was returned. Of a rollout from disk they are rounded to 1 mm and 0.1 mrad.
        planning_seconds: (K,) time the planner took for each call [s].
        degraded: (K,) whether the plan was a fallback by the planner's own account.
        seen: What the planner saw in place of `ego` and `tracks`; None where it saw these.

    Example:
        ```python
        log = shiftsim.simulate(shiftsim.open_store("demo")["01f13e"], "idm")
        print(log.ego[-1, :2], log.commands[:, 0].min())
        ```
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
    seen: Seen | None = None

    def __repr__(self) -> str:
        gone = np.hypot(*np.diff(self.ego[:, :2], axis=0).T).sum()
        return (
            f"<SimulationLog of {self.token}: {len(self.ego)} samples, {gone:.1f} m, "
            f"{self.tracks.num_tracks} tracks>"
        )


def as_recorded(scenario: Scenario) -> SimulationLog:
    """The recording of a scenario as if it had been driven, without commands and plans."""
    rows = scenario.iteration_rows[:-1]
    count = len(rows)
    return SimulationLog(
        token=scenario.token,
        time_us=scenario.time_us[rows],
        ego=scenario.ego[rows],
        tracks=scenario.tracks.rows(rows),
        traffic_lights=scenario.traffic_lights.rows(rows),
        expert_time_us=scenario.iteration_times,
        expert_ego=scenario.expert,
        route=scenario.route,
        commands=np.full((count, 2), np.nan),
        noise=np.zeros((count, 2)),
        plans=np.full((count, NUM_KEPT, 3), np.nan),
        planning_seconds=np.zeros(count),
        degraded=np.zeros(count, np.bool_),
    )
