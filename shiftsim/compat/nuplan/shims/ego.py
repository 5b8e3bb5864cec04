"""The state of the ego, waypoints, and the motion model."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import InitVar, dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np

from shiftsim.compat.nuplan.shims.boxes import CarFootprint, OrientedBox, VehicleParameters
from shiftsim.compat.nuplan.shims.geometry import StateSE2, StateVector2D, TimePoint, part
from shiftsim.compat.nuplan.shims.objects import AgentState, SceneObjectMetadata, TrackedObjectType
from shiftsim.compat.nuplan.shims.transforms import (
    absolute_to_relative_poses,
    approximate_derivatives,
    lateral_projection,
    longitudinal_projection,
    numpy_array_to_absolute_pose,
)
from shiftsim.kernels import FloatArray
from shiftsim.sim.dynamics.bicycle import step_bicycle


@dataclass
class SplitState:
    """A state as numbers that interpolate, angles that interpolate, and things that stay."""

    linear_states: list[Any]
    angular_states: list[float]
    fixed_states: list[Any]

    def __len__(self) -> int:
        return len(self.linear_states) + len(self.angular_states) + len(self.fixed_states)


class InterpolatableState(ABC):
    """A state at a moment, which an `InterpolatedTrajectory` can be made of."""

    time_point: TimePoint
    time_us = part("time_point.time_us", "Its moment [us].")

    @abstractmethod
    def to_split_state(self) -> SplitState:
        """Its parts."""

    @staticmethod
    @abstractmethod
    def from_split_state(split_state: SplitState) -> Any:
        """A state from parts."""


@dataclass
class Waypoint(InterpolatableState):
    """A box at a moment, with or without a velocity [m/s]."""

    time_point: TimePoint
    oriented_box: OrientedBox
    velocity: StateVector2D | None = None

    center = part("oriented_box.center", "Pose of the box's centre.")
    x = part("oriented_box.center.x", "Of the centre [m].")
    y = part("oriented_box.center.y", "Of the centre [m].")
    heading = part("oriented_box.center.heading", "Of the box [rad].")

    def _velocity(self) -> list[float | None]:
        return [None, None] if self.velocity is None else [self.velocity.x, self.velocity.y]

    def __iter__(self) -> Iterator[Any]:
        return iter((self.time_us, *self.center, *self._velocity()))

    def serialize(self) -> list[Any]:
        """Time [us], x, y, heading, length, width, height, velocity."""
        box = self.oriented_box
        size = (box.length, box.width, box.height)
        return [self.time_us, *self.center, *size, *self._velocity()]

    @staticmethod
    def deserialize(vector: Sequence[Any]) -> "Waypoint":
        time, x, y, heading, length, width, height, *velocity = vector
        return Waypoint(
            TimePoint(int(time)),
            OrientedBox(StateSE2(x, y, heading), length, width, height),
            None if None in velocity else StateVector2D(*velocity),
        )

    def to_split_state(self) -> SplitState:
        """Time, position and velocity; heading; width, length, height."""
        box = self.oriented_box
        linear = [self.time_us, box.center.x, box.center.y, *self._velocity()]
        return SplitState(linear, [box.center.heading], [box.width, box.length, box.height])

    @staticmethod
    def from_split_state(split_state: SplitState) -> "Waypoint":
        time, x, y, *velocity = split_state.linear_states
        width, length, height = split_state.fixed_states
        known = all(v is not None and not np.isnan(v) for v in velocity)
        moving = velocity if known else (None, None)
        pose = x, y, split_state.angular_states[0]
        return Waypoint.deserialize([time, *pose, length, width, height, *moving])


def get_velocity_shifted(
    displacement: StateVector2D, ref_velocity: StateVector2D, ref_angular_vel: float
) -> StateVector2D:
    """Velocity of a point of a rigid body, seen from another one [m/s]."""
    turning = -displacement.y * ref_angular_vel, displacement.x * ref_angular_vel
    return StateVector2D(ref_velocity.x + turning[0], ref_velocity.y + turning[1])


def get_acceleration_shifted(
    displacement: StateVector2D,
    ref_accel: StateVector2D,
    ref_angular_vel: float,
    ref_angular_accel: float,
) -> StateVector2D:
    """Acceleration of another point of the body [m/s^2]."""
    # nuPlan rule 573: not the formula for a rigid body
    shift = displacement.array * ref_angular_vel**2 + displacement.array * ref_angular_accel
    return StateVector2D(*(ref_accel.array + shift))


@dataclass(eq=False, repr=False)
class DynamicCarState:
    """Velocities and accelerations of a car, in its own frame."""

    rear_axle_to_center_dist: InitVar[float]
    rear_axle_velocity_2d: StateVector2D
    rear_axle_acceleration_2d: StateVector2D
    angular_velocity: float = 0.0
    angular_acceleration: float = 0.0
    tire_steering_rate: float = 0.0

    def __post_init__(self, rear_axle_to_center_dist: float) -> None:
        self._center = StateVector2D(rear_axle_to_center_dist, 0.0)

    @classmethod
    def build_from_rear_axle(cls, *values: Any, **named: Any) -> "DynamicCarState":
        return cls(*values, **named)

    @cached_property
    def center_velocity_2d(self) -> StateVector2D:
        """Velocity at the centre of the box [m/s]."""
        return get_velocity_shifted(self._center, self.rear_axle_velocity_2d, self.angular_velocity)

    @cached_property
    def center_acceleration_2d(self) -> StateVector2D:
        """Acceleration at the centre of the box [m/s^2]."""
        accel, turn = self.rear_axle_acceleration_2d, self.angular_velocity
        return get_acceleration_shifted(self._center, accel, turn, self.angular_acceleration)

    @property
    def speed(self) -> float:
        """Length of the rear axle's velocity [m/s]."""
        return self.rear_axle_velocity_2d.magnitude()

    @property
    def acceleration(self) -> float:
        """Length of the rear axle's acceleration [m/s^2]."""
        return self.rear_axle_acceleration_2d.magnitude()


@dataclass(eq=False)
class EgoState(InterpolatableState):
    """The ego at a moment."""

    car_footprint: CarFootprint
    dynamic_car_state: DynamicCarState
    tire_steering_angle: float
    is_in_auto_mode: bool
    time_point: TimePoint

    time_seconds = part("time_point.time_s", "Its moment [s].")
    center = part("car_footprint.center", "Pose of the box's centre.")
    rear_axle = part("car_footprint.rear_axle", "Pose of the rear axle.")

    @classmethod
    def build_from_rear_axle(
        cls,
        rear_axle_pose: StateSE2,
        rear_axle_velocity_2d: StateVector2D,
        rear_axle_acceleration_2d: StateVector2D,
        tire_steering_angle: float,
        time_point: TimePoint,
        vehicle_parameters: VehicleParameters,
        is_in_auto_mode: bool = True,
        angular_vel: float = 0.0,
        angular_accel: float = 0.0,
        tire_steering_rate: float = 0.0,
    ) -> "EgoState":
        footprint = CarFootprint.build_from_rear_axle(rear_axle_pose, vehicle_parameters)
        distance, velocity = footprint.rear_axle_to_center_dist, rear_axle_velocity_2d
        turning = (angular_vel, angular_accel, tire_steering_rate)
        motion = DynamicCarState(distance, velocity, rear_axle_acceleration_2d, *turning)
        return cls(footprint, motion, tire_steering_angle, is_in_auto_mode, time_point)

    @classmethod
    def build_from_center(
        cls,
        center: StateSE2,
        center_velocity_2d: StateVector2D,
        center_acceleration_2d: StateVector2D,
        tire_steering_angle: float,
        time_point: TimePoint,
        vehicle_parameters: VehicleParameters,
        is_in_auto_mode: bool = True,
        angular_vel: float = 0.0,
        angular_accel: float = 0.0,
    ) -> "EgoState":
        footprint = CarFootprint(center, vehicle_parameters)
        distance, turning = footprint.rear_axle_to_center_dist, (angular_vel, angular_accel)
        back = StateVector2D(-distance, 0.0)
        velocity = get_velocity_shifted(back, center_velocity_2d, angular_vel)
        accel = get_acceleration_shifted(back, center_acceleration_2d, *turning)
        motion = DynamicCarState(distance, velocity, accel, *turning)
        return cls(footprint, motion, tire_steering_angle, is_in_auto_mode, time_point)

    @property
    def scene_object_metadata(self) -> SceneObjectMetadata:
        return SceneObjectMetadata(self.time_us, "ego", -1, "ego")

    @cached_property
    def waypoint(self) -> Waypoint:
        """The box, with the velocity of the rear axle."""
        velocity = self.dynamic_car_state.rear_axle_velocity_2d
        return Waypoint(self.time_point, self.car_footprint, velocity)

    @cached_property
    def agent(self) -> AgentState:
        velocity = self.dynamic_car_state.center_velocity_2d
        metadata = self.scene_object_metadata
        return AgentState(TrackedObjectType.EGO, self.car_footprint, velocity, metadata)

    def _numbers(self) -> list[Any]:
        """Time, position, velocity, acceleration, steering angle: what interpolates linearly."""
        velocity = self.dynamic_car_state.rear_axle_velocity_2d
        accel = self.dynamic_car_state.rear_axle_acceleration_2d
        pose, steering = self.rear_axle, self.tire_steering_angle
        return [self.time_us, pose.x, pose.y, velocity.x, velocity.y, accel.x, accel.y, steering]

    def __iter__(self) -> Iterator[Any]:
        time, x, y, *others = self._numbers()
        return iter((time, x, y, self.rear_axle.heading, *others))

    @staticmethod
    def deserialize(vector: Sequence[float], vehicle: VehicleParameters) -> "EgoState":
        """From time [us], pose, velocity and acceleration of the rear axle, steering angle."""
        if len(vector) != 9:
            raise RuntimeError(f"an ego state has 9 numbers, not {len(vector)}")
        time, x, y, heading, *others = vector
        return EgoState.from_split_state(SplitState([time, x, y, *others], [heading], [vehicle]))

    def to_split_state(self) -> SplitState:
        """Numbers at the rear axle; heading; vehicle."""
        heading, vehicle = self.rear_axle.heading, self.car_footprint.vehicle_parameters
        return SplitState(self._numbers(), [heading], [vehicle])

    @staticmethod
    def from_split_state(split_state: SplitState) -> "EgoState":
        """A state from parts; yaw rate, yaw acceleration and steering rate are 0 then."""
        if len(split_state) != 10:
            raise RuntimeError(f"an ego state has 10 parts, not {len(split_state)}")
        time, x, y, vx, vy, ax, ay, steering = split_state.linear_states
        return EgoState.build_from_rear_axle(
            StateSE2(x, y, split_state.angular_states[0]),
            StateVector2D(vx, vy),
            StateVector2D(ax, ay),
            steering,
            TimePoint(int(time)),
            split_state.fixed_states[0],
        )


class KinematicBicycleModel:
    """The motion model of the simulation, with the constants that it has there."""

    def __init__(self, vehicle: VehicleParameters) -> None:
        self._vehicle = vehicle

    def propagate_state(
        self, state: EgoState, ideal_dynamic_state: DynamicCarState, sampling_time: TimePoint
    ) -> EgoState:
        """The next state, under the acceleration and steering rate of the ideal one."""
        time, *values = state
        turning = attrgetter("tire_steering_rate", "angular_velocity", "angular_acceleration")
        row = np.array([*values, *turning(state.dynamic_car_state)], np.float64)
        accel = float(ideal_dynamic_state.rear_axle_acceleration_2d.x)
        rate = float(ideal_dynamic_state.tire_steering_rate)
        step_bicycle(row, accel, rate, self._vehicle.wheel_base, sampling_time.time_s, row)
        *values, steering_rate, yaw_rate, yaw_accel = row.tolist()
        reached = EgoState.deserialize([time + sampling_time.time_us, *values], self._vehicle)
        motion = reached.dynamic_car_state
        motion.angular_velocity, motion.angular_acceleration = yaw_rate, yaw_accel
        motion.tire_steering_rate = steering_rate
        return reached


# nuplan.planning.simulation.planner.ml_planner.transform_utils
def _get_fixed_timesteps(
    state: EgoState, future_horizon: float, step_interval: float
) -> list[float]:
    """Times of a plan [s]: one interval after a state, and so on to the horizon."""
    steps = np.arange(0.0, future_horizon, step_interval) + step_interval
    return (steps + state.time_point.time_s).tolist()


def _se2_vel_acc_to_ego_state(
    state: StateSE2,
    velocity: Sequence[float],
    acceleration: Sequence[float],
    timestamp: float,
    vehicle: VehicleParameters,
) -> EgoState:
    """The state of a rear axle at a time [s]; it steers straight ahead."""
    moving = StateVector2D(*velocity), StateVector2D(*acceleration)
    return EgoState.build_from_rear_axle(
        state, *moving, 0.0, TimePoint(int(timestamp * 1e6)), vehicle
    )


def _get_velocity_and_acceleration(
    ego_poses: Sequence[StateSE2], ego_history: Sequence[EgoState], timesteps: list[float]
) -> tuple[FloatArray, FloatArray]:
    """(H, 2) velocities and accelerations along and across planned poses, from all positions."""
    from scipy.interpolate import interp1d

    def line(times: Any, values: FloatArray) -> Any:
        return interp1d(times, values, axis=0, fill_value="extrapolate")

    past = [state.time_point.time_s for state in ego_history]
    driven = np.array([state.rear_axle.serialize() for state in ego_history])
    planned = np.array([pose.serialize() for pose in ego_poses])
    # as far apart as the samples of the history
    times = np.arange(past[-1], timesteps[-1] + 1e-6, past[-1] - past[-2])
    poses = line([past[-1], *timesteps], np.r_[driven[-1:], planned])(times)[1:]
    every, xy = [*past, *times[1:]], np.r_[driven, poses][:, :2]
    found = []
    for order in (1, 2):
        rates = approximate_derivatives(xy, every, deriv_order=order, axis=0)[len(past) :]
        along = longitudinal_projection(rates, poses[:, 2])
        # nuPlan rule 612: positive to the right, elsewhere to the left
        across = -lateral_projection(rates, poses[:, 2])
        found.append(line(times[1:], np.c_[along, across])(timesteps))
    return found[0], found[1]


def transform_predictions_to_states(
    predicted_poses: FloatArray,
    ego_history: Sequence[EgoState],
    future_horizon: float,
    step_interval: float,
    include_ego_state: bool = True,
) -> list[EgoState]:
    """Ego states from (H, 3) poses in the frame of the present rear axle, the present one first."""
    ego = ego_history[-1]
    times = _get_fixed_timesteps(ego, future_horizon, step_interval)
    poses = numpy_array_to_absolute_pose(ego.rear_axle, predicted_poses)
    moving = _get_velocity_and_acceleration(poses, ego_history, times)
    vehicle = ego.car_footprint.vehicle_parameters
    states = [
        _se2_vel_acc_to_ego_state(*row, vehicle) for row in zip(poses, *moving, times, strict=False)
    ]
    return [ego, *states] if include_ego_state else states


# nuplan.planning.training.preprocessing.features.trajectory_utils
def convert_absolute_to_relative_poses(
    origin_absolute_state: StateSE2, absolute_states: Sequence[StateSE2]
) -> Any:
    """(N, 3) float32 poses in the frame of an origin."""
    _, *moved = absolute_to_relative_poses([origin_absolute_state, *absolute_states])
    return np.array([pose.serialize() for pose in moved], np.float32)
