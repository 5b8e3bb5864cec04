"""The planner interface: what a planner is given, and the trajectories it returns."""

import math
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np

from shiftsim.compat.nuplan.shims.ego import EgoState, InterpolatableState, SplitState
from shiftsim.compat.nuplan.shims.geometry import StateSE2, TimePoint, derived, part
from shiftsim.compat.nuplan.shims.map_types import AbstractMap, TrafficLightStatusData
from shiftsim.compat.nuplan.shims.objects import Observation
from shiftsim.compat.nuplan.shims.transforms import AngularInterpolator

_SAMPLING_TOLERANCE = 1e-10  # as in nuPlan


class AbstractTrajectory(ABC):
    """States over a span of time."""

    @property
    @abstractmethod
    def start_time(self) -> TimePoint:
        """Its first moment."""

    @property
    @abstractmethod
    def end_time(self) -> TimePoint:
        """Its last moment."""

    duration = derived(
        lambda self: self.end_time.time_s - self.start_time.time_s, "How long it lasts [s]."
    )
    duration_us = derived(
        lambda self: int(self.end_time.time_us - self.start_time.time_us), "How long it lasts [us]."
    )

    @abstractmethod
    def get_state_at_time(self, time_point: TimePoint) -> Any:
        """The state at a moment of its span."""

    @abstractmethod
    def get_state_at_times(self, time_points: list[TimePoint]) -> list[Any]:
        """The states at moments of its span."""

    @abstractmethod
    def get_sampled_trajectory(self) -> list[Any]:
        """The states it is made of."""

    def is_in_range(self, time_point: TimePoint | int) -> bool:
        now = TimePoint(time_point) if isinstance(time_point, int) else time_point
        return bool(self.start_time <= now <= self.end_time)


class InterpolatedTrajectory(AbstractTrajectory):
    """Linear between states."""

    def __init__(self, trajectory: list[Any]) -> None:
        assert trajectory, "a trajectory needs states"
        kind = type(trajectory[0])
        assert isinstance(trajectory[0], InterpolatableState), f"{kind} cannot be interpolated"
        assert all(isinstance(state, kind) for state in trajectory), "states of several classes"
        if len(trajectory) < 2:
            raise ValueError("a trajectory needs at least two states")
        self._trajectory = trajectory

    def __reduce__(self) -> Any:
        return type(self), (self._trajectory,)

    @cached_property
    def _parts(self) -> tuple[Any, AngularInterpolator, list[Any]]:
        """Linear values and angles by time, and the fixed parts; made when first asked for."""
        from scipy.interpolate import interp1d

        parts = [state.to_split_state() for state in self._trajectory]
        times = np.array([state.time_us for state in self._trajectory])
        linear = np.array([part.linear_states for part in parts], np.float64)
        angles = AngularInterpolator(times, [part.angular_states for part in parts])
        return interp1d(times, linear, axis=0), angles, parts[0].fixed_states

    start_time = derived(lambda self: self._trajectory[0].time_point, "Moment of the first state.")
    end_time = derived(lambda self: self._trajectory[-1].time_point, "Moment of the last state.")

    def get_state_at_time(self, time_point: TimePoint) -> Any:
        return self.get_state_at_times([time_point])[0]

    def get_state_at_times(self, time_points: list[TimePoint]) -> list[Any]:
        first, last = min(time_points), max(time_points)
        assert self.start_time <= first <= last <= self.end_time, (
            f"times {first.time_us} … {last.time_us} us are not in the trajectory, "
            f"{self.start_time.time_us} … {self.end_time.time_us} us"
        )
        linear, angles, fixed = self._parts
        at = [moment.time_us for moment in time_points]
        make = type(self._trajectory[0]).from_split_state
        return [
            make(SplitState(list(numbers), list(turns), fixed))
            for numbers, turns in zip(linear(at), angles.interpolate(at), strict=True)
        ]

    def get_sampled_trajectory(self) -> list[Any]:
        return self._trajectory


@dataclass(eq=False)
class TrajectorySampling:
    """How a trajectory is sampled; the third value follows from two."""

    # int, float and float: given, or found
    num_poses: Any = None  # states beyond the present one
    time_horizon: Any = None  # from now to the last state [s]
    interval_length: Any = None  # between states [s]

    step_time = part("interval_length", "Between states [s].")

    def __post_init__(self) -> None:
        count, horizon, interval = self.num_poses, self.time_horizon, self.interval_length
        if count and not isinstance(count, int):
            raise ValueError(f"num_poses is {count!r}, not an integer")
        if [bool(count), bool(horizon), bool(interval)].count(True) < 2:
            raise ValueError(f"two of the three values are needed: {self}")
        if not count:
            count = int(horizon / interval)  # nuPlan rule 574: cut, not rounded
            rest = math.fmod(horizon, interval)
            if min(rest, abs(interval - rest)) > _SAMPLING_TOLERANCE:
                raise ValueError(f"the horizon is not a multiple of the interval: {self}")
        elif horizon and interval:
            if not math.isclose(count, horizon / interval, abs_tol=_SAMPLING_TOLERANCE):
                raise ValueError(f"the three values do not fit together: {self}")
        self.num_poses, self.time_horizon = count, float(horizon or count * interval)
        self.interval_length = float(interval or horizon / count)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TrajectorySampling):
            return NotImplemented
        return (
            math.isclose(self.time_horizon, other.time_horizon)
            and math.isclose(self.step_time, other.step_time)
            and self.num_poses == other.num_poses
        )

    def __hash__(self) -> int:
        return hash((self.num_poses, self.time_horizon, self.interval_length))


@dataclass
class PredictedTrajectory:
    """One possible future. `waypoints` may hold None where nothing is known."""

    probability: float
    waypoints: list[Any]

    valid_waypoints = derived(
        lambda self: [waypoint for waypoint in self.waypoints if waypoint],
        "The waypoints that are known.",
    )

    @cached_property
    def trajectory(self) -> AbstractTrajectory:
        return InterpolatedTrajectory(self.valid_waypoints)

    def __len__(self) -> int:
        return len(self.waypoints)


@dataclass
class SimulationIteration:
    """Number and moment of a step."""

    time_point: TimePoint
    index: int

    def __post_init__(self) -> None:
        assert self.index >= 0, f"iterations count from 0: {self.index}"

    time_us = part("time_point.time_us", "Its moment [us].")
    time_s = part("time_point.time_s", "Its moment [s].")


class SimulationHistoryBuffer:
    """The last states of the ego and the observations beside them, the present ones last."""

    def __init__(
        self,
        ego_state_buffer: deque[EgoState],
        observations_buffer: deque[Observation],
        sample_interval: float | None = None,
    ) -> None:
        if not ego_state_buffer or len(ego_state_buffer) != len(observations_buffer):
            raise ValueError(
                f"{len(ego_state_buffer)} ego states and {len(observations_buffer)} observations: "
                "there must be equally many, and some"
            )
        self.ego_state_buffer, self.observation_buffer = ego_state_buffer, observations_buffer
        self.sample_interval = sample_interval

    @classmethod
    def initialize_from_list(
        cls,
        buffer_size: int,
        ego_states: list[EgoState],
        observations: list[Observation],
        sample_interval: float | None = None,
    ) -> "SimulationHistoryBuffer":
        """A buffer that keeps the last `buffer_size` samples."""
        egos, seen = deque(ego_states, buffer_size), deque(observations, buffer_size)
        return cls(egos, seen, sample_interval)

    size = derived(lambda self: len(self.ego_state_buffer), "How many samples there are.")

    def __len__(self) -> int:
        return self.size

    duration = derived(
        lambda self: self.sample_interval * self.size if self.sample_interval else None,
        "Samples times interval [s].",
    )
    current_state = derived(
        lambda self: (self.ego_state_buffer[-1], self.observation_buffer[-1]),
        "The present ego state and observation.",
    )
    ego_states = derived(
        lambda self: list(self.ego_state_buffer), "Ego states, the present one last."
    )
    observations = derived(
        lambda self: list(self.observation_buffer), "Observations, the present one last."
    )

    def append(self, ego_state: EgoState, observation: Observation) -> None:
        self.extend([ego_state], [observation])

    def extend(self, ego_states: Sequence[EgoState], observations: Sequence[Observation]) -> None:
        if len(ego_states) != len(observations):
            raise ValueError(f"{len(ego_states)} ego states, {len(observations)} observations")
        self.ego_state_buffer.extend(ego_states)
        self.observation_buffer.extend(observations)


@dataclass(frozen=True)
class PlannerInitialization:
    """What a planner is given before the first step."""

    route_roadblock_ids: list[str]  # roadblocks from start to goal
    mission_goal: StateSE2  # where the drive leads to in the end, or None
    map_api: AbstractMap


@dataclass(frozen=True)
class PlannerInput:
    """What a planner is given at a step."""

    iteration: SimulationIteration
    history: SimulationHistoryBuffer  # the last samples
    traffic_light_data: list[TrafficLightStatusData] | None = None  # of this step


@dataclass(frozen=True)
class PlannerReport:
    """How long the calls of a planner took [s]."""

    compute_trajectory_runtimes: list[float]

    def compute_summary_statistics(self) -> dict[str, float]:
        """Mean, median and standard deviation of every list."""
        return {
            f"{item.name}_{name}": function(getattr(self, item.name))
            for item in fields(self)
            for name, function in (("mean", np.mean), ("median", np.median), ("std", np.std))
        }


@dataclass(frozen=True)
class MLPlannerReport(PlannerReport):
    """The same, for the parts of a learned planner."""

    feature_building_runtimes: list[float]
    inference_runtimes: list[float]


class AbstractPlanner(ABC):
    """What a planner must have. The simulator calls `compute_trajectory`."""

    requires_scenario: bool = False
    _compute_trajectory_runtimes: list[float]

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        """An instance whose times are counted, also where `__init__` does not call this class's."""
        planner = super().__new__(cls)
        planner._compute_trajectory_runtimes = []
        return planner

    @abstractmethod
    def name(self) -> str:
        """Its name."""

    @abstractmethod
    def initialize(self, initialization: PlannerInitialization) -> None:
        """Prepare for a scenario."""

    @abstractmethod
    def observation_type(self) -> type[Observation]:
        """What it wants to be shown."""

    @abstractmethod
    def compute_planner_trajectory(self, current_input: PlannerInput) -> AbstractTrajectory:
        """The plan from the present state on."""

    def compute_trajectory(self, current_input: PlannerInput) -> AbstractTrajectory:
        """The plan, with its time noted, also where it fails."""
        began = time.perf_counter()
        try:
            return self.compute_planner_trajectory(current_input)
        finally:
            self._compute_trajectory_runtimes.append(time.perf_counter() - began)

    def generate_planner_report(self, clear_stats: bool = True) -> PlannerReport:
        """The times noted so far, which are forgotten unless `clear_stats` is false."""
        report = PlannerReport(self._compute_trajectory_runtimes)
        if clear_stats:
            self._compute_trajectory_runtimes = []
        return report


# nuplan.planning.scenario_builder.abstract_scenario
class AbstractScenario:
    """A recorded scenario. For annotations: planners are not given one."""


# nuplan.planning.training
FeaturesType: TypeAlias = dict[str, Any]
TargetsType: TypeAlias = dict[str, Any]
ScenarioListType: TypeAlias = list[Any]


class AbstractModelFeature(ABC):  # noqa: B024  # a mere base
    """What a network reads or writes."""


class AbstractFeatureBuilder(ABC):  # noqa: B024  # a mere base
    """Makes features."""


class AbstractTargetBuilder(ABC):  # noqa: B024  # a mere base
    """Makes what a network is to learn."""


class EgoTrajectoryTargetBuilder(AbstractTargetBuilder):
    """Names the trajectory of the ego as the target; shiftsim has no scenarios to train on."""

    def __init__(self, future_trajectory_sampling: TrajectorySampling) -> None:
        self._sampling = future_trajectory_sampling

    @classmethod
    def get_feature_unique_name(cls) -> str:
        return "trajectory"
