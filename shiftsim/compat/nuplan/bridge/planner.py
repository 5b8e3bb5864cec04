"""A planner for shiftsim around one for nuPlan, which sees nuPlan's objects."""

import copy
import hashlib
import inspect
import pickle
from collections.abc import Mapping
from typing import Any

import numpy as np

from nuplan.common.actor_state.agent import Agent
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.oriented_box import OrientedBox
from nuplan.common.actor_state.scene_object import SceneObjectMetadata
from nuplan.common.actor_state.state_representation import StateSE2, StateVector2D, TimePoint
from nuplan.common.actor_state.static_object import StaticObject
from nuplan.common.actor_state.tracked_objects import TrackedObjects
from nuplan.common.actor_state.tracked_objects_types import TrackedObjectType
from nuplan.common.actor_state.vehicle_parameters import VehicleParameters
from nuplan.common.maps.maps_datatypes import TrafficLightStatusData, TrafficLightStatusType
from nuplan.planning.simulation.history.simulation_history_buffer import SimulationHistoryBuffer
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks
from nuplan.planning.simulation.planner.abstract_planner import PlannerInitialization, PlannerInput
from nuplan.planning.simulation.simulation_time_controller.simulation_iteration import (
    SimulationIteration,
)
from nuplan.planning.simulation.trajectory.abstract_trajectory import AbstractTrajectory
from nuplan.planning.simulation.trajectory.interpolated_trajectory import InterpolatedTrajectory
from shiftsim.compat.nuplan.bridge.map import BridgeMap
from shiftsim.compat.nuplan.shims.boxes import dimensions_of
from shiftsim.errors import ConfigError, PlannerError
from shiftsim.kernels import FloatArray
from shiftsim.sim.planner import HISTORY_SAMPLES, Observation, SceneInfo
from shiftsim.world.map import PerMap
from shiftsim.world.state import LAST_AGENT_KIND, NUM_STATE, Tracks, TrafficLights, Trajectory
from shiftsim.world.state import VehicleParameters as Dimensions

HEIGHT = 1.8  # m, of all objects: the arrays of a scenario have none
ROW_SECONDS = 0.05  # s, between the rows of a log
_STEP_US = 100_000  # us, between the poses that the tracker reads
_maps = PerMap(BridgeMap)


def vehicle_parameters(vehicle: Dimensions) -> Any:
    """Dimensions of the ego."""
    return VehicleParameters(*dimensions_of(vehicle))


def ego_state(time_us: int, row: FloatArray, vehicle: Any) -> Any:
    """The ego state of a row (11,), columns of `STATE_COLUMNS`."""
    x, y, heading, vx, vy, ax, ay, steering, steering_rate, yaw_rate, yaw_accel = row.tolist()
    pose, velocity, accel = StateSE2(x, y, heading), StateVector2D(vx, vy), StateVector2D(ax, ay)
    time, turning = TimePoint(int(time_us)), (yaw_rate, yaw_accel, steering_rate)
    return EgoState.build_from_rear_axle(
        pose, velocity, accel, steering, time, vehicle, True, *turning
    )


def observed_tracks(time_us: int, tracks: Tracks) -> Any:
    """The objects of one moment, the first row of the tracks."""
    present = np.flatnonzero(tracks.valid[0]).tolist()
    return DetectionsTracks(TrackedObjects([_object(time_us, tracks, track) for track in present]))


def _object(time_us: int, tracks: Tracks, track: int) -> Any:
    kind = TrackedObjectType(int(tracks.kinds[track]))
    token = tracks.tokens[track]
    length, width = tracks.sizes[0, track].tolist()
    box = OrientedBox(StateSE2(*tracks.poses[0, track].tolist()), length, width, HEIGHT)
    sample = f"{token}@{time_us}"
    metadata = SceneObjectMetadata(time_us, sample, track, token, kind.fullname)
    if tracks.kinds[track] > LAST_AGENT_KIND:
        return StaticObject(kind, box, metadata)
    velocity = StateVector2D(*tracks.velocities[0, track].tolist())
    # nuPlan rule 579: objects of a log come with an unknown angular velocity and no predictions
    return Agent(kind, box, velocity, metadata, angular_velocity=np.nan, predictions=[])


def traffic_lights(time_us: int, lights: TrafficLights) -> list[Any]:
    """The listed lights; ids are integers wherever they can be."""
    return [
        TrafficLightStatusData(
            status=TrafficLightStatusType(int(status)),
            lane_connector_id=int(name) if name.isdecimal() else name,
            timestamp=int(time_us),
        )
        for name, status in lights.listed(0)
    ]


def to_trajectory(plan: Any, now_us: int, next_us: int, planner: str) -> Trajectory:
    """What a planner returned, as ours; the times are those of this iteration and the next [us].

    The states of an `InterpolatedTrajectory` are taken as they are. Another kind of trajectory is
    asked for its states wherever the simulation looks at it. It is a PlannerError if the states are
    not those of an ego.
    """
    if not isinstance(plan, AbstractTrajectory):
        raise PlannerError(
            f"planner {planner!r}: compute_planner_trajectory() returned {type(plan).__name__}, "
            "not an AbstractTrajectory",
            hint="return an InterpolatedTrajectory of EgoStates",
        )
    if isinstance(plan, InterpolatedTrajectory):
        states = plan.get_sampled_trajectory()
    else:
        first, last = int(plan.start_time.time_us), int(plan.end_time.time_us)
        moments = {*range(first, last + 1, _STEP_US), first, last, now_us, next_us}
        times = [TimePoint(time) for time in sorted(moments) if first <= time <= last]
        states = plan.get_state_at_times(times)
    wrong = next((state for state in states if not isinstance(state, EgoState)), None)
    if wrong is not None:
        what = f"planner {planner!r}: its trajectory has states of class {type(wrong).__name__}"
        raise PlannerError(what, hint="return a trajectory of EgoStates")
    times_us = np.array([int(state.time_us) for state in states], np.int64)
    rows = np.array([_row(state) for state in states], np.float64)
    return Trajectory(times_us, rows.reshape(-1, NUM_STATE))


def _row(state: Any) -> tuple[float, ...]:
    pose, motion = state.rear_axle, state.dynamic_car_state
    velocity, accel = motion.rear_axle_velocity_2d, motion.rear_axle_acceleration_2d
    moving = velocity.x, velocity.y, accel.x, accel.y
    steering = state.tire_steering_angle, motion.tire_steering_rate
    turning = motion.angular_velocity, motion.angular_acceleration
    return (pose.x, pose.y, pose.heading, *moving, *steering, *turning)


class NuplanPlanner:
    """Drives with a nuPlan planner; `shiftsim.compat.nuplan.wrap` makes it."""

    def __init__(self, source: Any, arguments: Mapping[str, Any]) -> None:
        self._source, self._arguments = source, dict(arguments)
        self._planner = self._make()
        self.code = _hash_of_code(type(self._planner))
        self.name = str(self._planner.name() or type(self._planner).__name__)
        self.report: Any = None  # what the planner reported of the scenario before
        self._scene: SceneInfo | None = None
        self._vehicle: Any = None
        self._buffer: Any = None
        self._iteration = -1

    def _make(self) -> Any:
        fresh = inspect.isclass(self._source)
        return self._source(**self._arguments) if fresh else self._source

    def reset(self, scene: SceneInfo) -> None:
        """Initialize the planner, of a class a new one; a ConfigError if it wants sensor data."""
        if self._scene is not None:
            self.close()
            self._planner = self._make()
        wanted = self._planner.observation_type()
        if not (inspect.isclass(wanted) and issubclass(wanted, DetectionsTracks)):
            raise ConfigError(
                f"planner {self.name!r} wants to observe {getattr(wanted, '__name__', wanted)}",
                hint="shiftsim has tracks, no sensor data: observation_type() must be "
                "DetectionsTracks",
            )
        self._scene, self._vehicle, self._buffer = scene, vehicle_parameters(scene.vehicle), None
        goal: Any = None if scene.goal is None else StateSE2(*scene.goal.tolist())
        self._planner.initialize(PlannerInitialization(list(scene.route), goal, _maps(scene.map)))

    def plan(self, observation: Observation) -> Trajectory:
        """The planner's trajectory; a PlannerError where it returned something else."""
        if self._scene is None:
            raise PlannerError(f"planner {self.name!r}: plan() was called before reset()")
        now_us, times = int(observation.time_us), self._scene.times
        self._remember(observation, self._scene)
        now = SimulationIteration(TimePoint(now_us), observation.iteration)
        given = PlannerInput(now, self._buffer, traffic_lights(now_us, observation.lights))
        found = self._planner.compute_trajectory(given)
        next_us = int(times[min(observation.iteration + 1, len(times) - 1)])
        return to_trajectory(found, now_us, next_us, self.name)

    def _remember(self, observation: Observation, scene: SceneInfo) -> None:
        """Let the history grow by one sample per step, as nuPlan's own does."""
        history = observation.history

        def sample(row: int) -> tuple[Any, Any]:
            time_us = int(history.time_us[row])
            seen = observed_tracks(time_us, history.tracks.rows(slice(row, row + 1)))
            return ego_state(time_us, history.ego[row], self._vehicle), seen

        last = len(history.time_us) - 1
        if self._buffer is None or observation.iteration != self._iteration + 1:
            step = float(np.median(np.diff(scene.times))) * 1e-6
            interval = ROW_SECONDS * round(step / ROW_SECONDS)
            egos, seen = (list(part) for part in zip(*map(sample, range(last + 1)), strict=True))
            make = SimulationHistoryBuffer.initialize_from_list
            self._buffer = make(HISTORY_SAMPLES, egos, seen, interval)
        else:
            self._buffer.append(*sample(last))
        self._iteration = observation.iteration

    def close(self) -> None:
        """Take the last report."""
        if self._scene is not None:
            self.report = self._planner.generate_planner_report()

    def __deepcopy__(self, memo: dict[int, Any]) -> "NuplanPlanner":
        return NuplanPlanner(copy.deepcopy(self._source, memo), self._arguments)

    def __reduce__(self) -> Any:
        kind = self._source if inspect.isclass(self._source) else type(self._source)
        if kind.__module__ == "__main__":
            raise pickle.PicklingError(f"{kind.__name__} is defined in the main script")
        # where it arrives this class comes first, and with its package the `nuplan.*` names
        return NuplanPlanner, (self._source, self._arguments)


def _hash_of_code(kind: type) -> str:
    try:
        return hashlib.sha256(inspect.getsource(kind).encode()).hexdigest()
    except (OSError, TypeError):
        return ""
