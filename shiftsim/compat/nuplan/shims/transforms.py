"""Functions that move points and poses about, and measure between them."""

from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np

from shiftsim.compat.nuplan.shims.geometry import Point2D, ProgressStateSE2, StateSE2, StateVector2D
from shiftsim.geometry.boxes import STOPPED_EGO, STOPPED_TRACK
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.comfort import unwrap as phase_unwrap

# nuplan.common.geometry.transform


def rotate_2d(point: Point2D, rotation_matrix: FloatArray) -> Point2D:
    """A point as a row vector times a (2, 2) matrix."""
    return Point2D(*(point.array @ _square(rotation_matrix, 2)))


def translate(pose: StateSE2, translation: FloatArray) -> StateSE2:
    """A pose shifted by a vector (2,) [m]."""
    dx, dy = np.asarray(translation).reshape(2)
    return StateSE2(pose.x + dx, pose.y + dy, pose.heading)


def rotate(pose: StateSE2, rotation_matrix: FloatArray) -> StateSE2:
    """A pose's position as a row vector times a (2, 2) matrix; the heading turns by its angle."""
    matrix = _square(rotation_matrix, 2)
    x, y = np.array((pose.x, pose.y)) @ matrix
    return StateSE2(x, y, pose.heading + np.arctan2(matrix[1, 0], matrix[1, 1]))


def rotate_angle(pose: StateSE2, theta: float) -> StateSE2:
    """`rotate` by the rotation matrix of an angle [rad]."""
    cos, sin = np.cos(theta), np.sin(theta)
    return rotate(pose, np.array([[cos, -sin], [sin, cos]]))


def transform(pose: StateSE2, transform_matrix: FloatArray) -> StateSE2:
    """`rotate`, then `translate`, by the parts of a (3, 3) matrix."""
    return translate(rotate(pose, transform_matrix[:2, :2]), transform_matrix[:2, 2])


def translate_longitudinally(pose: StateSE2, distance: float) -> StateSE2:
    """A pose moved forward [m]."""
    x = pose.x + distance * np.cos(pose.heading)
    return StateSE2(x, pose.y + distance * np.sin(pose.heading), pose.heading)


def translate_laterally(pose: StateSE2, distance: float) -> StateSE2:
    """A pose moved to its left [m]."""
    return translate_longitudinally_and_laterally(pose, 0.0, distance)


def translate_longitudinally_and_laterally(pose: StateSE2, lon: float, lat: float) -> StateSE2:
    """A pose moved forward and to its left [m]."""
    # nuPlan rule 575: sine and cosine of heading + pi / 2 as they come out
    left = pose.heading + np.pi / 2.0
    x = pose.x + (lat * np.cos(left) + lon * np.cos(pose.heading))
    y = pose.y + (lat * np.sin(left) + lon * np.sin(pose.heading))
    return StateSE2(x, y, pose.heading)


def _square(matrix: FloatArray, size: int) -> FloatArray:
    assert matrix.shape == (size, size), f"a {size}x{size} matrix is needed, not {matrix.shape}"
    return matrix


# nuplan.common.geometry.convert


def matrix_from_pose(pose: StateSE2) -> FloatArray:
    """(3, 3) transform of a pose."""
    return pose.as_matrix()


def absolute_to_relative_poses(absolute_poses: Sequence[StateSE2]) -> list[StateSE2]:
    """Poses in the frame of the first one."""
    matrices = np.array([pose.as_matrix() for pose in absolute_poses])
    return [StateSE2.from_matrix(matrix) for matrix in np.linalg.inv(matrices[0]) @ matrices]


def relative_to_absolute_poses(
    origin_pose: StateSE2, relative_poses: Sequence[StateSE2]
) -> list[StateSE2]:
    """Poses in the frame of the origin, brought to the map."""
    matrices = [pose.as_matrix() for pose in relative_poses]
    return [StateSE2.from_matrix(origin_pose.as_matrix() @ matrix) for matrix in matrices]


def numpy_array_to_absolute_pose(origin_absolute_state: StateSE2, poses: Any) -> list[StateSE2]:
    """(N, 3) poses in the frame of the origin, brought to the map."""
    assert poses.shape[1] == 3, f"poses are (*, 3), not {poses.shape}"
    return relative_to_absolute_poses(origin_absolute_state, [StateSE2(*pose) for pose in poses])


def numpy_array_to_absolute_velocity(
    origin_absolute_state: StateSE2, velocities: Any
) -> list[StateVector2D]:
    """(N, 2) vectors put through `numpy_array_to_absolute_pose`."""
    assert velocities.shape[1] == 2, f"velocities are (*, 2), not {velocities.shape}"
    # nuPlan rule 576: the position of the origin is added to a velocity, too
    padded = np.c_[np.asarray(velocities, np.float64), np.zeros(len(velocities))]
    moved = numpy_array_to_absolute_pose(origin_absolute_state, padded)
    return [StateVector2D(pose.x, pose.y) for pose in moved]


# nuplan.common.geometry.compute


def lateral_distance(reference: StateSE2, other: Point2D) -> float:
    """How far a point is to the left of a pose [m]."""
    cos, sin = np.cos(reference.heading), np.sin(reference.heading)
    return float(-sin * (other.x - reference.x) + cos * (other.y - reference.y))


def longitudinal_distance(reference: StateSE2, other: Point2D) -> float:
    """How far a point is ahead of a pose [m]."""
    cos, sin = np.cos(reference.heading), np.sin(reference.heading)
    return float(cos * (other.x - reference.x) + sin * (other.y - reference.y))


def principal_value(angle: Any, min_: float = -np.pi) -> Any:
    """Angles brought to [min_, min_ + 2 pi)."""
    assert np.all(np.isfinite(angle)), "an angle is not finite"
    return (angle - min_) % (2 * np.pi) + min_


class AngularInterpolator:
    """Angles over an abscissa: unwrapped, piecewise linear, brought to [-pi, pi)."""

    def __init__(self, states: Any, angular_states: Any) -> None:
        from scipy.interpolate import interp1d  # takes long to import, and few planners need it

        angles = np.unwrap(np.asarray(angular_states, np.float64), axis=0)
        self._angles = interp1d(states, angles, axis=0)

    def interpolate(self, sampled_state: Any) -> FloatArray:
        return np.asarray(principal_value(self._angles(sampled_state)))


# nuplan.planning.simulation.path
class AbstractPath:
    """Poses over the distance along a path [m]."""


class InterpolatedPath(AbstractPath):
    """Linear between poses."""

    def __init__(self, path: list[ProgressStateSE2]) -> None:
        assert len(path) > 1, "a path needs at least two poses"
        self._path = path
        self._progress = [pose.progress for pose in path]
        self._headings = AngularInterpolator(self._progress, [pose.heading for pose in path])

    def get_start_progress(self) -> float:
        return self._path[0].progress

    def get_end_progress(self) -> float:
        return self._path[-1].progress

    def get_state_at_progress(self, progress: float) -> ProgressStateSE2:
        return self.get_state_at_progresses([progress])[0]

    def get_state_at_progresses(self, progresses: list[float]) -> list[ProgressStateSE2]:
        first, last = self.get_start_progress(), self.get_end_progress()
        inside = first <= min(progresses) and max(progresses) <= last
        assert inside, f"{progresses} m are not on the path, {first} … {last} m"
        x, y = (
            np.interp(progresses, self._progress, [getattr(pose, axis) for pose in self._path])
            for axis in "xy"
        )
        rows = np.c_[progresses, x, y, self._headings.interpolate(progresses)]
        return [ProgressStateSE2(*row) for row in rows.tolist()]

    def get_sampled_path(self) -> list[ProgressStateSE2]:
        return self._path


def calculate_progress(path: Sequence[Point2D]) -> list[float]:
    """Distances along a path, 0 at its first point [m]."""
    steps = np.linalg.norm(np.diff([(point.x, point.y) for point in path], axis=0), axis=1)
    return np.cumsum(np.r_[0.0, steps]).tolist()


def convert_se2_path_to_progress_path(path: Sequence[StateSE2]) -> list[ProgressStateSE2]:
    """Poses with their distances along the path."""
    pairs = zip(calculate_progress(path), path, strict=True)
    return [ProgressStateSE2(progress, *pose.serialize()) for progress, pose in pairs]


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
    return savgol_filter(y, window, **order, delta=steps.mean(), axis=axis)


def extract_ego_time_point(ego_states: Sequence[Any]) -> IntArray:
    """(K,) times [us]."""
    return np.array([state.time_us for state in ego_states])


def extract_ego_heading(ego_states: Sequence[Any]) -> FloatArray:
    """(K,) headings [rad]."""
    return np.array([state.rear_axle.heading for state in ego_states])


def extract_ego_velocity(ego_states: Sequence[Any]) -> FloatArray:
    """(K,) speeds of the rear axle [m/s]."""
    return np.array([state.dynamic_car_state.speed for state in ego_states])


def extract_ego_acceleration(
    ego_states: Sequence[Any],
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
    ego_states: Sequence[Any],
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
    ego_states: Sequence[Any],
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
    return np.cos(headings) * state_vectors[:, 0] + np.sin(headings) * state_vectors[:, 1]


def lateral_projection(state_vectors: FloatArray, headings: FloatArray) -> FloatArray:
    """(K,) parts of vectors (K, 2) to the left of headings (K,)."""
    return -np.sin(headings) * state_vectors[:, 0] + np.cos(headings) * state_vectors[:, 1]
