"""SimulationLog: the arrays of one finished rollout; Snapshot: those of one under way.

Metrics, results and pages are made from a log. It holds K = T - 1 samples for a scenario of T
iterations: the state reached after the last planner call is never stored.
"""

from dataclasses import astuple, dataclass, fields, replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from shiftsim.errors import one_of
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.sim.noise import NoiseModel
from shiftsim.sim.perception import Drift, Localization, Perception, make_drift
from shiftsim.sim.traffic import Traffic
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Tracks, TrafficLights, Trajectory

NUM_KEPT = 18  # poses of a plan
CONTROLLERS = ("lqr", "perfect", "log-playback")


@dataclass(frozen=True, slots=True)
class Setting:
    """How a scenario is driven, whichever scenario and planner it is."""

    # actuation noise, by name or model; added to the command before the motion model; or a drift
    noise: str | NoiseModel | Drift = "none"
    seed: int = 0  # seed of what is random, also of planners that sample
    traffic: str | Traffic = "nonreactive"  # `nonreactive`, `reactive`, or a traffic model
    # `lqr` (tracker and kinematic bicycle), `perfect` (the ego is where the plan says) or `log-
    # playback` (the ego is where the recording was; plans are ignored)
    controller: str = "lqr"
    strict: bool = False  # fail where the planner falls back instead of counting the step
    # what the planner sees, and where it believes to be, by name or model
    perception: str | Perception = "none"
    localization: str | Localization = "none"
    latency: int = 0  # time from an observation until its plan is followed [ms]

    def __post_init__(self) -> None:
        one_of("controller", self.controller, CONTROLLERS)

    @property
    def drift(self) -> Drift:
        """All that differs from a perfect vehicle."""
        return make_drift(self.noise, self.perception, self.localization, self.latency)


DEFAULT = Setting()


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
            command was returned. Of a rollout from disk they are rounded to 1/2048 m and rad.
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

    def snapshot(self, iteration: int, setting: Setting) -> "Snapshot":
        """Where the rollout was at an iteration, driven as a setting says."""
        past, ego = slice(iteration), self.ego[: iteration + 1]
        commands, seconds = self.commands[past], self.planning_seconds[past]
        return Snapshot(self.token, setting, ego, commands, seconds, self.degraded[past])

    def __repr__(self) -> str:
        gone = np.hypot(*np.diff(self.ego[:, :2], axis=0).T).sum()
        return (
            f"<SimulationLog of {self.token}: {len(self.ego)} samples, {gone:.1f} m, "
            f"{self.tracks.num_tracks} tracks>"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A rollout at iteration i: what others go on from, here or in another process.

    Traffic is not in it: it does the same again where the ego does. Two snapshots are equal where
    their contents are.

    Attributes:
        token: Id of the scenario.
        setting: How it is driven; models of one's own stand there by name.
        ego: (i + 1, 11) ego states of the iterations so far.
        commands: (i, 2) as of `SimulationLog`.
        planning_seconds: (i,) time the planner took for each call [s].
        degraded: (i,) whether the plan was a fallback.
        plans: Those under way, the next one first; as many as the latency has steps.
        action: The last action, in the environment.
        scenario: The scenario; None where the snapshot comes from another process.
    """

    token: str
    setting: Setting
    ego: FloatArray
    commands: FloatArray
    planning_seconds: FloatArray
    degraded: BoolArray
    plans: tuple[Trajectory | Command, ...] = ()
    action: Any = None
    scenario: Scenario | None = None

    @property
    def iteration(self) -> int:
        """The iteration i."""
        return len(self.ego) - 1

    def _content(self) -> tuple[Any, ...]:
        return tuple(getattr(self, item.name) for item in fields(self)[:-1])

    def _bytes(self) -> tuple[Any, ...]:
        token, setting, *parts, plans, _ = self._content()
        parts += chain(*map(astuple, plans))
        return token, setting, *(np.asarray(part).tobytes() for part in parts)

    def __reduce__(self) -> Any:
        return Snapshot, self._content()

    def __deepcopy__(self, memo: Any) -> "Snapshot":
        return replace(self)  # nobody writes to its arrays

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Snapshot) and self._bytes() == other._bytes()

    def __hash__(self) -> int:
        return hash(self._bytes())

    def __repr__(self) -> str:
        return f"<Snapshot of {self.token} at iteration {self.iteration}>"


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
