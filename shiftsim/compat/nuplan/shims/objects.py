"""Everything in a scene except the ego, and what a planner observes of it."""

from abc import ABC
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, TypeAlias

import numpy as np
import shapely

from shiftsim.compat.nuplan.shims.boxes import OrientedBox
from shiftsim.compat.nuplan.shims.geometry import Point2D, StateSE2, StateVector2D, TimePoint, part
from shiftsim.compat.nuplan.shims.transforms import (
    InterpolatedPath,
    convert_se2_path_to_progress_path,
)


class TrackedObjectType(Enum):
    """Type of an object; `fullname` is its name in the data."""

    fullname: str

    VEHICLE = 0, "vehicle"
    PEDESTRIAN = 1, "pedestrian"
    BICYCLE = 2, "bicycle"
    TRAFFIC_CONE = 3, "traffic_cone"
    BARRIER = 4, "barrier"
    CZONE_SIGN = 5, "czone_sign"
    GENERIC_OBJECT = 6, "generic_object"
    EGO = 7, "ego"

    def __new__(cls, number: int, fullname: str) -> "TrackedObjectType":
        member = object.__new__(cls)
        member._value_ = number
        member.fullname = fullname
        return member

    def __int__(self) -> int:
        return int(self.value)


_TYPES = tuple(TrackedObjectType)
AGENT_TYPES = {*_TYPES[:3], TrackedObjectType.EGO}
STATIC_OBJECT_TYPES = {*_TYPES[3:7]}


@dataclass(frozen=True)
class SceneObjectMetadata:
    """Where an object comes from."""

    timestamp_us: int  # when it was seen [us]
    token: str  # of this object in this sample
    track_id: int | None  # number of its track
    track_token: str | None  # id of its track
    category_name: str | None = None  # name of its type in the data

    @property
    def timestamp_s(self) -> float:
        """When it was seen [s]."""
        return self.timestamp_us * 1e-6


class SceneObject:
    """Something with a type and a box."""

    def __init__(
        self,
        tracked_object_type: TrackedObjectType,
        oriented_box: OrientedBox,
        metadata: SceneObjectMetadata,
    ) -> None:
        self.tracked_object_type = tracked_object_type
        self.metadata = metadata
        self._box = oriented_box

    box = part("_box", "Its box.")
    center = part("_box.center", "Pose of the box's centre.")
    token = part("metadata.token", "Id of this object in this sample.")
    track_token = part("metadata.track_token", "Id of its track.")


class StaticObject(SceneObject):
    """Something that does not move."""


class AgentState(SceneObject):
    """Something that moves; the velocity is in the map's frame [m/s]."""

    def __init__(
        self,
        tracked_object_type: TrackedObjectType,
        oriented_box: OrientedBox,
        velocity: StateVector2D,
        metadata: SceneObjectMetadata,
        angular_velocity: float | None = None,
    ) -> None:
        SceneObject.__init__(self, tracked_object_type, oriented_box, metadata)
        self.velocity, self.angular_velocity = velocity, angular_velocity

    @classmethod
    def from_new_pose(cls, agent: "AgentState", pose: StateSE2) -> "AgentState":
        kind, box = agent.tracked_object_type, OrientedBox.from_new_pose(agent.box, pose)
        return AgentState(
            kind, box, agent.velocity, replace(agent.metadata), agent.angular_velocity
        )


class AgentTemporalState:
    """What is known of an agent's past and future."""

    def __init__(
        self,
        initial_time_stamp: TimePoint,
        predictions: Sequence[Any] | None = None,
        past_trajectory: Any = None,
    ) -> None:
        self._now = initial_time_stamp
        self.predictions = [] if predictions is None else predictions
        self.past_trajectory = past_trajectory

    @property
    def predictions(self) -> Sequence[Any]:
        """Predicted trajectories; their probabilities add up to 1."""
        return self._predictions

    @predictions.setter
    def predictions(self, predicted: Sequence[Any]) -> None:
        total = sum(prediction.probability for prediction in predicted)
        if predicted and abs(total - 1.0) >= 1e-6:
            raise ValueError(f"the probabilities of the predictions add up to {total:.2f}, not 1")
        self._predictions = predicted

    @property
    def past_trajectory(self) -> Any:
        """Where it was, ending now; or None."""
        return self._past_trajectory

    @past_trajectory.setter
    def past_trajectory(self, past: Any) -> None:
        if past and (past.waypoints[-1] is None or past.waypoints[-1].time_point != self._now):
            raise ValueError("the past of an agent does not end with its present state")
        self._past_trajectory = past

    @property
    def previous_state(self) -> Any:
        """The waypoint before the present one, or None."""
        past = self.past_trajectory
        return past.waypoints[-2] if past and len(past.valid_waypoints) > 1 else None


class Agent(AgentTemporalState, AgentState):
    """Something that moves, with what is known of its past and future."""

    def __init__(
        self,
        tracked_object_type: TrackedObjectType,
        oriented_box: OrientedBox,
        velocity: StateVector2D,
        metadata: SceneObjectMetadata,
        angular_velocity: float | None = None,
        predictions: Sequence[Any] | None = None,
        past_trajectory: Any = None,
    ) -> None:
        now = TimePoint(metadata.timestamp_us)
        AgentTemporalState.__init__(self, now, predictions, past_trajectory)
        AgentState.__init__(
            self, tracked_object_type, oriented_box, velocity, metadata, angular_velocity
        )


TrackedObject: TypeAlias = Any


class TrackedObjects:
    """Objects of one sample, sorted by the number of their type."""

    def __init__(self, tracked_objects: Iterable[TrackedObject] | None = None) -> None:
        self.tracked_objects: list[TrackedObject] = sorted(
            tracked_objects or (), key=lambda item: int(item.tracked_object_type)
        )

    def get_tracked_objects_of_type(
        self, tracked_object_type: TrackedObjectType
    ) -> list[TrackedObject]:
        wanted = tracked_object_type
        return [item for item in self.tracked_objects if item.tracked_object_type == wanted]

    def get_tracked_objects_of_types(
        self, tracked_object_types: Iterable[TrackedObjectType]
    ) -> list[TrackedObject]:
        """The objects of some types, type after type."""
        each = map(self.get_tracked_objects_of_type, tracked_object_types)
        return [item for found in each for item in found]

    def get_agents(self) -> list[Any]:
        """Vehicles, pedestrians, bicycles."""
        return [item for item in self.tracked_objects if item.tracked_object_type in AGENT_TYPES]

    def get_static_objects(self) -> list[Any]:
        """Everything that does not move."""
        static = STATIC_OBJECT_TYPES
        return [item for item in self.tracked_objects if item.tracked_object_type in static]

    def __iter__(self) -> Iterator[TrackedObject]:
        return iter(self.tracked_objects)

    def __len__(self) -> int:
        return len(self.tracked_objects)


# nuplan.planning.simulation.observation.observation_type


class CameraChannel(Enum):
    """Cameras of the recording car."""

    CAM_F0, CAM_B0, CAM_L0, CAM_L1 = "CAM_F0", "CAM_B0", "CAM_L0", "CAM_L1"
    CAM_L2, CAM_R0, CAM_R1, CAM_R2 = "CAM_L2", "CAM_R0", "CAM_R1", "CAM_R2"


class LidarChannel(Enum):
    """Point clouds of the recording car."""

    MERGED_PC = "MergedPointCloud"


@dataclass
class Observation(ABC):  # noqa: B024  # a mere common base, as in nuPlan
    """What a planner is shown of the surroundings."""

    @classmethod
    def detection_type(cls) -> str:
        return cls.__name__


@dataclass
class Sensors(Observation):
    """Point clouds and images. shiftsim has none: a planner that asks for them is refused."""

    pointcloud: dict[LidarChannel, Any] | None
    images: dict[CameraChannel, Any] | None


@dataclass
class DetectionsTracks(Observation):
    """The objects that were perceived."""

    tracked_objects: TrackedObjects


# nuplan.planning.simulation.observation.idm.utils
def get_agent_relative_angle(ego_state: StateSE2, agent_state: StateSE2) -> float:
    """Angle between the heading of a pose and the direction of another one, 0 … pi [rad]."""
    way = np.array((agent_state.x - ego_state.x, agent_state.y - ego_state.y))
    ahead = np.array((np.cos(ego_state.heading), np.sin(ego_state.heading)))
    return float(np.arccos(ahead @ (way / np.linalg.norm(way))))


def is_agent_ahead(ego_state: StateSE2, agent_state: StateSE2, angle_tolerance: float = 30) -> bool:
    """Whether a pose lies ahead of another, within an angle [deg]."""
    return get_agent_relative_angle(ego_state, agent_state) < np.deg2rad(angle_tolerance)


def is_agent_behind(
    ego_state: StateSE2, agent_state: StateSE2, angle_tolerance: float = 150
) -> bool:
    """Whether a pose lies behind another, beyond an angle [deg]."""
    return get_agent_relative_angle(ego_state, agent_state) > np.deg2rad(angle_tolerance)


def is_track_stopped(tracked_object: Any, stopped_speed_threshhold: float = 5e-2) -> bool:
    """Whether an object stands: its speed is at most the threshold [m/s], or it is no agent."""
    if not isinstance(tracked_object, Agent):
        return True
    return tracked_object.velocity.magnitude() <= stopped_speed_threshhold


def path_to_linestring(path: Sequence[Point2D]) -> shapely.LineString:
    """The line through points or poses."""
    return shapely.LineString([(point.x, point.y) for point in path])


def ego_path_to_se2(path: Sequence[Any]) -> list[StateSE2]:
    """Poses of the centres of ego states."""
    return [state.center for state in path]


def create_path_from_se2(states: list[StateSE2]) -> InterpolatedPath:
    """The path through poses, of which repeated ones count once."""
    path = convert_se2_path_to_progress_path(states)
    # nuPlan rule 611: the last pose is always left out
    steps = np.diff([pose.progress for pose in path])
    return InterpolatedPath(
        [pose for pose, step in zip(path, steps, strict=False) if not np.isclose(step, 0.0)]
    )
