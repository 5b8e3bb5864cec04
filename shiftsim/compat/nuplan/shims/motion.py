"""Signals of ego states, plans made of predicted poses, and the interface of scenarios."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from shiftsim.compat.nuplan.shims.boxes import VehicleParameters
from shiftsim.compat.nuplan.shims.ego import EgoState
from shiftsim.compat.nuplan.shims.geometry import (
    Point2D,
    StateSE2,
    StateVector2D,
    TimeDuration,
    TimePoint,
    derived,
)
from shiftsim.compat.nuplan.shims.objects import DetectionsTracks
from shiftsim.compat.nuplan.shims.transforms import (
    numpy_array_to_absolute_pose,
)
from shiftsim.geometry.boxes import (
    STOPPED_EGO,
    STOPPED_TRACK,
)
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.comfort import unwrap as phase_unwrap

# nuplan.planning.metrics.utils


class CollisionType(IntEnum):
    """Kinds of collisions."""

    STOPPED_EGO_COLLISION, STOPPED_TRACK_COLLISION = STOPPED_EGO, STOPPED_TRACK
    # numbered as in nuPlan, not as in shiftsim
    ACTIVE_FRONT_COLLISION, ACTIVE_REAR_COLLISION, ACTIVE_LATERAL_COLLISION = 2, 3, 4


def approximate_derivatives(
    y: Any,
    x: Any,
    window_length: int = 5,
    poly_order: int = 2,
    deriv_order: int = 1,
    axis: int = -1,
) -> FloatArray:
    """Derivatives by polynomials fitted to windows; the distances of x count as equal."""
    from scipy.signal import savgol_filter  # takes long to import

    window = min(window_length, len(x))
    if poly_order >= window:
        raise ValueError(f"a fit of degree {poly_order} needs more than {window} samples")
    steps = np.diff(x)
    if not (steps > 0).all():
        raise RuntimeError("the abscissa does not increase")
    order = {"polyorder": poly_order, "deriv": deriv_order}
    found: FloatArray = savgol_filter(y, window, **order, delta=steps.mean(), axis=axis)
    return found


def extract_ego_time_point(ego_states: Sequence[EgoState]) -> IntArray:
    """(K,) times [us]."""
    return np.array([state.time_us for state in ego_states])


def extract_ego_center(ego_states: Sequence[EgoState]) -> list[Point2D]:
    """Positions of the centres."""
    return [state.center.point for state in ego_states]


def extract_ego_center_with_heading(ego_states: Sequence[EgoState]) -> list[StateSE2]:
    """Poses of the centres."""
    return [state.center for state in ego_states]


def extract_ego_corners(ego_states: Sequence[EgoState]) -> list[list[Point2D]]:
    """Corners of the footprints."""
    return [state.car_footprint.all_corners() for state in ego_states]


def extract_ego_heading(ego_states: Sequence[EgoState]) -> FloatArray:
    """(K,) headings [rad]."""
    return np.array([state.rear_axle.heading for state in ego_states])


def extract_ego_velocity(ego_states: Sequence[EgoState]) -> FloatArray:
    """(K,) speeds of the rear axle [m/s]."""
    return np.array([state.dynamic_car_state.speed for state in ego_states])


def extract_ego_acceleration(
    ego_states: Sequence[EgoState],
    acceleration_coordinate: str,
    decimals: int = 8,
    poly_order: int = 2,
    window_length: int = 8,
) -> FloatArray:
    """(K,) smoothed acceleration [m/s^2]: `x`, `y` at the centre, `magnitude` at the rear axle."""
    from scipy.signal import savgol_filter

    motions = [state.dynamic_car_state for state in ego_states]
    if acceleration_coordinate == "magnitude":
        values = [motion.acceleration for motion in motions]
    elif acceleration_coordinate in ("x", "y"):
        values = [getattr(one.center_acceleration_2d, acceleration_coordinate) for one in motions]
    else:
        raise ValueError(f"acceleration_coordinate {acceleration_coordinate!r}: x, y or magnitude")
    smooth = savgol_filter(values, min(window_length, len(values)), poly_order)
    return np.round(smooth, decimals)


def extract_ego_jerk(
    ego_states: Sequence[EgoState],
    acceleration_coordinate: str,
    decimals: int = 8,
    deriv_order: int = 1,
    poly_order: int = 2,
    window_length: int = 15,
) -> FloatArray:
    """(K,) derivative of the smoothed acceleration [m/s^3]."""
    accel = extract_ego_acceleration(ego_states, acceleration_coordinate)
    times = extract_ego_time_point(ego_states) / 1e6
    jerk = approximate_derivatives(accel, times, window_length, poly_order, deriv_order)
    return np.round(jerk, decimals)


def extract_ego_yaw_rate(
    ego_states: Sequence[EgoState],
    deriv_order: int = 1,
    poly_order: int = 2,
    decimals: int = 8,
    window_length: int = 15,
) -> FloatArray:
    """(K,) derivative of the heading [rad/s]; the window has 5 samples whatever is asked for."""
    headings = phase_unwrap(extract_ego_heading(ego_states))
    times = extract_ego_time_point(ego_states) / 1e6
    order = {"poly_order": poly_order, "deriv_order": deriv_order}
    return np.round(approximate_derivatives(headings, times, **order), decimals)


def longitudinal_projection(state_vectors: FloatArray, headings: FloatArray) -> FloatArray:
    """(K,) parts of vectors (K, 2) along headings (K,)."""
    found: FloatArray = np.cos(headings) * state_vectors[:, 0]
    return found + np.sin(headings) * state_vectors[:, 1]


def lateral_projection(state_vectors: FloatArray, headings: FloatArray) -> FloatArray:
    """(K,) parts of vectors (K, 2) to the left of headings (K,)."""
    found: FloatArray = -np.sin(headings) * state_vectors[:, 0]
    return found + np.cos(headings) * state_vectors[:, 1]


# nuplan.planning.simulation.planner.ml_planner.transform_utils


def _get_fixed_timesteps(
    state: EgoState, future_horizon: float, step_interval: float
) -> list[float]:
    """Times of a plan [s]: one interval after a state, and so on to the horizon."""
    steps = np.arange(0.0, future_horizon, step_interval) + step_interval
    times: list[float] = (steps + state.time_point.time_s).tolist()
    return times


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
    inverse = np.linalg.inv(origin_absolute_state.as_matrix())
    moved = (StateSE2.from_matrix(inverse @ pose.as_matrix()) for pose in absolute_states)
    return np.array([pose.serialize() for pose in moved], np.float32)


# nuplan.planning.scenario_builder.abstract_scenario


class AbstractScenario(ABC):
    """A recorded scenario. For annotations and subclasses: planners are not given one."""

    @abstractmethod
    def get_number_of_iterations(self) -> int:
        """How many iterations it has."""

    @abstractmethod
    def get_time_point(self, iteration: int) -> TimePoint:
        """Moment of an iteration."""

    @abstractmethod
    def get_ego_state_at_iteration(self, iteration: int) -> EgoState:
        """Where the recorded driver was."""

    @abstractmethod
    def get_tracked_objects_at_iteration(
        self, iteration: int, future_trajectory_sampling: Any = None
    ) -> DetectionsTracks:
        """The objects there were."""

    start_time = derived(lambda self: self.get_time_point(0), "Moment of iteration 0.")
    end_time = derived(
        lambda self: self.get_time_point(self.get_number_of_iterations() - 1),
        "Moment of the last iteration.",
    )
    duration_s = derived(
        lambda self: TimeDuration.from_s(self.end_time.time_s - self.start_time.time_s),
        "How long it lasts.",
    )
    initial_ego_state = derived(
        lambda self: self.get_ego_state_at_iteration(0), "The recorded driver at iteration 0."
    )
    initial_tracked_objects = derived(
        lambda self: self.get_tracked_objects_at_iteration(0), "The objects at iteration 0."
    )

    def get_ego_trajectory_slice(self, start_idx: int, end_idx: int) -> Iterator[EgoState]:
        """The recorded driver at iterations `start_idx` … `end_idx` - 1."""
        return (self.get_ego_state_at_iteration(index) for index in range(start_idx, end_idx))

    def get_expert_ego_trajectory(self) -> Iterator[EgoState]:
        """The recorded driver at all iterations."""
        return self.get_ego_trajectory_slice(0, self.get_number_of_iterations())
