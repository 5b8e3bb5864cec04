"""Scenario: one logged situation, ready to be simulated.

Rows are the log's own samples (20 Hz); iterations are the rows the simulation visits (10 Hz). Rows
before the first iteration feed the history a planner sees, rows after the last one feed planners
and learned targets that look into the recorded future.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from shiftsim.errors import ConfigError
from shiftsim.kernels import FloatArray, IntArray, readonly
from shiftsim.world.events import RolloutEvents
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks, TrafficLights

FULL_DURATION = "15 s"  # class of the scenarios of nuPlan's and DeepPlan's benchmarks
_FULL_S = 14.9  # s; 150 iterations
_LONGER_S = 15.85  # s, from which it is another class, such as the 30 s of interPlan


def duration_class(time_us: IntArray) -> str:
    """Class of a scenario whose iterations are at these times (T,) [us], such as `8 s`.

    Scores of different classes do not compare: `15 s`, or the whole seconds of another one.
    """
    seconds = float(time_us[-1] - time_us[0]) * 1e-6
    if seconds < _FULL_S - 0.05:
        return f"{np.floor(seconds + 0.05):.0f} s"
    # as with 15 s, the last iteration may be missing
    return FULL_DURATION if seconds < _LONGER_S else f"{np.floor(seconds + 0.15):.0f} s"


@dataclass(frozen=True, slots=True)
class Scenario:
    """One logged scene with its route and map. R rows, T iterations. Arrays are read-only.

    Attributes:
        token: Id of the scenario.
        scenario_type: Its tag, such as `starting_left_turn`; `unknown` without one.
        log_name: Recording it was cut from.
        city: Map name.
        map: The map.
        time_us: (R,) time stamps of the rows [us], never decreasing; increasing over iterations.
        ego: (R, 11) recorded ego states, columns of `state.STATE_COLUMNS`.
        tracks: Recorded tracks over the rows.
        traffic_lights: Recorded lights over the rows.
        iteration_rows: (T,) row of each iteration, strictly increasing.
        row_step: Distance in rows between iterations, 2 for 20 Hz logs and a 10 Hz simulation.
        route: Route roadblock ids from start to goal, as the source lists them.
        mission_goal: (3,) goal x [m], y [m], heading [rad], or None.
        mapping: Duration [s], offset [s] and subsample ratio the scenario was cut with.
        is_short: Whether the log ended before the duration did.
        script: What an edit asks of a rollout; None of a scenario as it was recorded.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        print(scenario.num_iterations, scenario.expert[:, :2], scenario.route)
        ```
    """

    token: str
    scenario_type: str
    log_name: str
    city: str
    map: VectorMap
    time_us: IntArray
    ego: FloatArray
    tracks: Tracks
    traffic_lights: TrafficLights
    iteration_rows: IntArray
    row_step: int
    route: tuple[str, ...]
    mission_goal: FloatArray | None
    mapping: tuple[float, float, float]
    is_short: bool = False
    script: RolloutEvents | None = None

    def __post_init__(self) -> None:
        for name in ("time_us", "ego", "iteration_rows", "mission_goal"):
            if (array := getattr(self, name)) is not None:
                object.__setattr__(self, name, readonly(array))
        object.__setattr__(self, "tracks", self.tracks.readonly())
        object.__setattr__(self, "traffic_lights", self.traffic_lights.readonly())

    def __repr__(self) -> str:
        return (
            f"<Scenario {self.token}: {self.scenario_type} in {self.city}, "
            f"{self.duration:.1f} s, {self.tracks.num_tracks} tracks>"
        )

    @property
    def num_iterations(self) -> int:
        """Number of simulation iterations T; a rollout stores T - 1 samples."""
        return len(self.iteration_rows)

    @property
    def iteration_times(self) -> IntArray:
        """(T,) time stamps of the iterations [us]."""
        return self.time_us[self.iteration_rows]

    @property
    def duration(self) -> float:
        """Time from the first iteration to the last one [s]."""
        times = self.iteration_times
        return float(times[-1] - times[0]) * 1e-6

    @property
    def duration_class(self) -> str:
        """Scenarios of one class may stand in one mean: `15 s`, or shorter, such as `8 s`."""
        return duration_class(self.iteration_times)

    @property
    def expert(self) -> FloatArray:
        """(T, 11) recorded ego states at the iterations."""
        return self.ego[self.iteration_rows]

    # edited(name="edited", **tables): this scenario changed; attached by shiftsim.edits
    edited: ClassVar[Callable[..., "Scenario"]]
    # plot(): a matplotlib figure of the first iteration; attached by shiftsim.api
    plot: ClassVar[Callable[..., Any]]


def scenario_of_rows(
    token: str, road: VectorMap, time_us: IntArray, ego: FloatArray, tracks: Tracks
) -> Scenario:
    """A scenario whose iterations are all R rows, without lights, route and goal."""
    return Scenario(
        token=token,
        scenario_type="unknown",
        log_name="world",
        city=road.name,
        map=road,
        time_us=time_us,
        ego=ego,
        tracks=tracks,
        traffic_lights=TrafficLights.empty(len(time_us)),
        iteration_rows=np.arange(len(time_us)),
        row_step=1,
        route=(),
        mission_goal=None,
        mapping=(10.0, 0.0, 1.0),
    )


def require_scenario(what: str, given: object) -> None:
    """Refuse what is no scenario, with a ConfigError that says how to get one."""
    if not isinstance(given, Scenario):
        raise ConfigError(
            f"{what}() needs a scenario first, not {type(given).__name__}",
            hint=f'scenario = shiftsim.open_store("demo")[TOKEN]; shiftsim.{what}(scenario, …)',
        )
