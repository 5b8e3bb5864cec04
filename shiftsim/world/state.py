"""Vehicle states, tracks, traffic lights, trajectories and commands.

Everything is an array with one row per time; the few objects here name the columns. The ego pose is
the rear axle, a track's pose is the centre of its box.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from shiftsim.kernels import BoolArray, FloatArray, IntArray, readonly

# Columns of an ego state row. Velocities and accelerations are in the body frame at the rear axle.
X, Y, HEADING = 0, 1, 2  # m, m, rad
VX, VY = 3, 4  # m/s
AX, AY = 5, 6  # m/s^2
STEERING, STEERING_RATE = 7, 8  # rad, rad/s
YAW_RATE, YAW_ACCEL = 9, 10  # rad/s, rad/s^2
NUM_STATE = 11
STATE_COLUMNS = (
    *("x", "y", "heading", "vx", "vy", "ax", "ay"),
    *("steering_angle", "steering_rate", "yaw_rate", "yaw_accel"),
)


@dataclass(frozen=True, slots=True)
class VehicleParameters:
    """Dimensions of the ego vehicle [m]."""

    width: float = 2.297  # overall width
    front_length: float = 4.049  # rear axle to front bumper
    rear_length: float = 1.127  # rear axle to rear bumper
    wheel_base: float = 3.089  # distance between the axles
    height: float = 1.777  # overall height

    @property
    def length(self) -> float:
        """Overall length [m]."""
        return self.front_length + self.rear_length

    @property
    def rear_axle_to_center(self) -> float:
        """Distance from the rear axle to the centre of the box [m]."""
        return self.length / 2.0 - self.rear_length


PACIFICA = VehicleParameters()


class AgentKind(IntEnum):
    """Type of a track, with nuPlan's numbers; the first three are agents, the others static."""

    VEHICLE = 0
    PEDESTRIAN = 1
    BICYCLE = 2
    TRAFFIC_CONE = 3
    BARRIER = 4
    CZONE_SIGN = 5
    GENERIC_OBJECT = 6


LAST_AGENT_KIND = AgentKind.BICYCLE  # kinds up to here have a velocity


class LightStatus(IntEnum):
    """State of a traffic light, with nuPlan's numbers; `ABSENT` marks a connector not listed."""

    ABSENT = -1
    GREEN = 0
    YELLOW = 1
    RED = 2
    UNKNOWN = 3


class TrackArrays(NamedTuple):
    """The arrays of `Tracks` over its rows, as kernels take them; or one row of each."""

    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray


@dataclass(frozen=True, slots=True)
class Tracks:
    """Everything that moves or stands except the ego, over a span of time.

    Attributes:
        valid: (T, N) whether the track is present.
        poses: (T, N, 3) box centre x [m], y [m], heading [rad]; NaN where not valid.
        velocities: (T, N, 2) in the map frame [m/s]; NaN where not valid and for static objects.
        sizes: (T, N, 2) length, width [m]; NaN where not valid.
        kinds: (N,) AgentKind codes.
        tokens: N stable ids, unique within the scenario. Order of tracks: as in the first row of
            the span, then by first appearance.

    Example:
        ```python
        tracks = shiftsim.open_store("demo")["01f13e"].tracks
        there = tracks.valid[0]
        print(tracks, tracks.poses[0, there, :2], tracks.kinds[there])
        ```
    """

    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray
    kinds: IntArray
    tokens: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.valid)

    def __repr__(self) -> str:
        codes, counts = np.unique(self.kinds, return_counts=True)
        kinds = ", ".join(
            f"{count} {AgentKind(code).name.lower()}"
            for code, count in zip(codes.tolist(), counts.tolist(), strict=True)
        )
        return f"<Tracks: {len(self)} rows of {self.num_tracks} tracks{kinds and f' ({kinds})'}>"

    @property
    def num_tracks(self) -> int:
        """Number of tracks, present or not."""
        return len(self.tokens)

    @property
    def arrays(self) -> TrackArrays:
        """The four arrays over the rows."""
        return TrackArrays(self.valid, self.poses, self.velocities, self.sizes)

    def map_arrays(self, change: Callable[[np.ndarray], np.ndarray]) -> "Tracks":
        """The same tracks, all four arrays over the rows changed."""
        return Tracks(*TrackArrays._make(map(change, self.arrays)), self.kinds, self.tokens)

    def rows(self, index: slice | IntArray) -> "Tracks":
        """The same tracks over other rows: a view for a slice, a copy for an index array."""
        return self.map_arrays(lambda array: array[index])

    def select(self, index: BoolArray | IntArray) -> "Tracks":
        """A subset (or another order) of the tracks, over the same rows."""
        where = np.flatnonzero(index) if index.dtype == np.bool_ else index
        tokens = tuple(self.tokens[i] for i in where)
        chosen = self.map_arrays(lambda array: array[:, where])
        return replace(chosen, kinds=self.kinds[where], tokens=tokens)

    def put(self, row: int, track: int | IntArray, *values: ArrayLike) -> None:
        """Write pose, velocity and size of tracks in a row, where they are present then."""
        for array, value in zip(self.arrays, (True, *values), strict=True):
            array[row, track] = value

    def copy(self) -> "Tracks":
        """The same tracks in arrays of their own, which can be written."""
        return self.map_arrays(np.copy)

    def readonly(self) -> "Tracks":
        """The same tracks in arrays that cannot be written."""
        return replace(self.map_arrays(readonly), kinds=readonly(self.kinds))

    @staticmethod
    def empty(num_rows: int) -> "Tracks":
        """No tracks at all, over `num_rows` rows."""
        return tracks_of_boxes(np.zeros((num_rows, 0, 7)), (), ())


def tracks_of_boxes(
    boxes: FloatArray, kinds: Sequence[int] | IntArray, tokens: Sequence[str]
) -> Tracks:
    """Tracks of what is known of them row by row; `kinds` (N,) are AgentKind codes.

    `boxes` (T, N, 7) are centre x [m], y [m], heading [rad], velocity x, y in the map frame [m/s],
    length, width [m]; x is NaN where a track is absent.
    """
    valid = ~np.isnan(boxes[..., 0])
    poses, velocities, sizes = map(np.ascontiguousarray, np.split(boxes, [3, 5], axis=-1))
    return Tracks(valid, poses, velocities, sizes, np.array(kinds, np.int64), tuple(tokens))


@dataclass(frozen=True, slots=True)
class TrafficLights:
    """Traffic light states of lane connectors over a span of time.

    A connector that some row lists n times, maybe with several states at once, has n columns, in
    the order in which its rows list it.
    """

    connector_ids: tuple[str, ...]  # C lane connector ids
    status: np.ndarray  # (T, C) LightStatus codes, int8; `ABSENT` where the connector is not listed

    def __repr__(self) -> str:
        return f"<TrafficLights: {len(self.status)} rows of {len(self.connector_ids)} connectors>"

    def rows(self, index: slice | IntArray) -> "TrafficLights":
        """The same connectors over other rows."""
        return TrafficLights(self.connector_ids, self.status[index])

    def readonly(self) -> "TrafficLights":
        """The same lights in an array that cannot be written."""
        return TrafficLights(self.connector_ids, readonly(self.status))

    def listed(self, row: int) -> list[tuple[str, LightStatus]]:
        """Connector ids and states that one row lists; an id may occur several times."""
        return [
            (name, LightStatus(code))
            for name, code in zip(self.connector_ids, self.status[row].tolist(), strict=True)
            if code != LightStatus.ABSENT
        ]

    def red(self, row: int) -> list[str]:
        """Connector ids with a red light in one row, in the order of the columns."""
        # nuPlan rule 429: one red entry is enough, whatever else is listed
        red = np.flatnonzero(self.status[row] == LightStatus.RED).tolist()
        return [self.connector_ids[column] for column in red]

    def at(self, row: int) -> dict[str, LightStatus]:
        """Status by connector id, of the connectors listed in one row; the last where several."""
        return dict(self.listed(row))

    @staticmethod
    def empty(num_rows: int) -> "TrafficLights":
        """No lights at all, over `num_rows` rows."""
        return TrafficLights((), np.zeros((num_rows, 0), np.int8))


@dataclass(frozen=True, slots=True)
class EgoState:
    """One ego state, as a view on a row of a state array.

    Attributes:
        time_us: Time stamp [us].
        values: (11,) the columns named by `STATE_COLUMNS`, at the rear axle.

    Example:
        ```python
        scenario = shiftsim.open_store("demo")["01f13e"]
        state = shiftsim.EgoState(0, scenario.ego[0])
        print(state.pose, state.speed, state.steering_angle)
        ```
    """

    time_us: int
    values: FloatArray

    def __repr__(self) -> str:
        x, y, heading = self.pose
        return (
            f"<EgoState: x {x:.2f} m, y {y:.2f} m, heading {heading:.3f} rad, "
            f"{self.speed:.2f} m/s, at {self.time_us} us>"
        )

    @property
    def pose(self) -> FloatArray:
        """(3,) rear axle x [m], y [m], heading [rad]."""
        return self.values[:3]

    @property
    def x(self) -> float:
        """Rear axle x [m]."""
        return float(self.values[X])

    @property
    def y(self) -> float:
        """Rear axle y [m]."""
        return float(self.values[Y])

    @property
    def heading(self) -> float:
        """Heading [rad]."""
        return float(self.values[HEADING])

    @property
    def center(self) -> FloatArray:
        """(3,) box centre x [m], y [m], heading [rad]."""
        return center_poses(self.values[None, :3])[0]

    @property
    def speed(self) -> float:
        """Speed at the rear axle [m/s], never negative."""
        return float(np.hypot(self.values[VX], self.values[VY]))

    @property
    def velocity(self) -> FloatArray:
        """(2,) velocity at the rear axle in the body frame [m/s]."""
        return self.values[VX : VY + 1]

    @property
    def acceleration(self) -> FloatArray:
        """(2,) acceleration at the rear axle in the body frame [m/s^2]."""
        return self.values[AX : AY + 1]

    @property
    def steering_angle(self) -> float:
        """Tyre angle [rad]."""
        return float(self.values[STEERING])


@dataclass(frozen=True, slots=True)
class Command:
    """What the motion model executes when a planner drives without a tracker.

    Attributes:
        acceleration: Commanded longitudinal acceleration [m/s^2].
        steering_rate: Commanded rate of the steering angle [rad/s].

    Example:
        ```python
        gentle_brake = shiftsim.Command(acceleration=-1.0, steering_rate=0.0)
        ```
    """

    acceleration: float
    steering_rate: float


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A plan: ego states at times.

    Attributes:
        time_us: (H,) strictly increasing; log time stamps, or offsets from the moment of planning
            where `relative` is true [us].
        states: (H, 11) the columns of `STATE_COLUMNS`, rear axle. The LQR tracker reads the poses
            only; perfect tracking also reads velocities, accelerations and the steering angle.
        relative: Whether `time_us` counts from the moment of planning.

    Example:
        ```python
        times = [0.1 * i for i in range(11)]
        straight = [(5.0 * t, 0.0, 0.0) for t in times]  # in the frame of the map
        plan = shiftsim.Trajectory.from_poses(times, straight)
        ```
    """

    time_us: IntArray
    states: FloatArray
    relative: bool = False

    def __repr__(self) -> str:
        seconds = (self.time_us - (0 if self.relative else self.time_us[:1])) * 1e-6
        span = f" over {seconds[-1]:.1f} s" if len(seconds) else ""
        return f"<Trajectory: {len(seconds)} states{span}>"

    @staticmethod
    def from_poses(times: ArrayLike, poses: ArrayLike) -> "Trajectory":
        """A plan from poses alone.

        Args:
            times: (H,) seconds from now, strictly increasing, usually 0, 0.1, 0.2, …
            poses: (H, 3) rear axle x [m], y [m], heading [rad].

        Returns:
            The trajectory; velocities along the heading follow from the positions.

        Raises:
            ValueError: The shapes do not fit.
        """
        seconds = np.asarray(times, np.float64)
        pose = np.asarray(poses, np.float64)
        if seconds.ndim != 1 or pose.shape != (len(seconds), 3):
            what = f"need times (H,) and poses (H, 3), got {seconds.shape} and {pose.shape}"
            raise ValueError(what)
        states = np.zeros((len(seconds), NUM_STATE))
        states[:, :3] = pose
        if len(seconds) > 1:
            step = np.diff(pose[:, :2], axis=0) / np.diff(seconds)[:, None]
            forward = step[:, 0] * np.cos(pose[:-1, 2]) + step[:, 1] * np.sin(pose[:-1, 2])
            states[:-1, VX] = forward
            states[-1, VX] = forward[-1]
        return Trajectory(np.rint(seconds * 1e6).astype(np.int64), states, relative=True)

    def starting_at(self, now_us: int) -> "Trajectory":
        """The same plan with log time stamps."""
        return Trajectory(self.time_us + now_us, self.states) if self.relative else self


def center_poses(rear_poses: FloatArray, vehicle: VehicleParameters = PACIFICA) -> FloatArray:
    """Box centres of rear-axle poses, both (..., 3) x [m], y [m], heading [rad]."""
    return _moved_ahead(rear_poses, vehicle.rear_axle_to_center)


def rear_poses(centers: FloatArray, vehicle: VehicleParameters = PACIFICA) -> FloatArray:
    """Rear-axle poses of box centres, both (..., 3) x [m], y [m], heading [rad]."""
    return _moved_ahead(centers, -vehicle.rear_axle_to_center)


def _moved_ahead(poses: FloatArray, distance: float) -> FloatArray:
    out = np.array(poses, np.float64)
    out[..., 0] += distance * np.cos(poses[..., 2])
    out[..., 1] += distance * np.sin(poses[..., 2])
    return out


def center_velocities(states: FloatArray, vehicle: VehicleParameters = PACIFICA) -> FloatArray:
    """(..., 2) velocity at the box centre in the body frame [m/s], from (..., 11) states."""
    out = states[..., VX : VY + 1].copy()
    out[..., 1] += vehicle.rear_axle_to_center * states[..., YAW_RATE]
    return out


def map_velocity(state: FloatArray) -> FloatArray:
    """(2,) velocity of the box centre in the frame of the map [m/s], from a state (11,)."""
    (along, aside), heading = center_velocities(state[None])[0], state[HEADING]
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([cos * along - sin * aside, sin * along + cos * aside])


def center_accelerations(states: FloatArray, vehicle: VehicleParameters = PACIFICA) -> FloatArray:
    """(..., 2) acceleration at the box centre in the body frame [m/s^2], from (..., 11) states."""
    # nuPlan rule 19: the centripetal and the angular term both go to the longitudinal part, with a
    # plus sign; the comfort metrics read it
    out = states[..., AX : AY + 1].copy()
    distance = vehicle.rear_axle_to_center
    out[..., 0] += distance * states[..., YAW_RATE] ** 2 + distance * states[..., YAW_ACCEL]
    return out


def speeds(states: FloatArray) -> FloatArray:
    """(...) speed at the rear axle [m/s], from (..., 11) states."""
    return np.hypot(states[..., VX], states[..., VY])
