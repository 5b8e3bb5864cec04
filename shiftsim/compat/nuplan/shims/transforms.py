"""Functions that move points and poses about, and measure between them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from shiftsim.compat.nuplan.shims.geometry import Point2D, StateSE2, StateVector2D
from shiftsim.kernels import FloatArray

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


def pose_from_matrix(transform_matrix: FloatArray) -> StateSE2:
    """The pose of a (3, 3) transform."""
    if transform_matrix.shape != (3, 3):
        raise RuntimeError(f"a 3x3 transform is needed, not {transform_matrix.shape}")
    return StateSE2.from_matrix(transform_matrix)


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


def vector_2d_from_magnitude_angle(magnitude: float, angle: float) -> StateVector2D:
    """A vector from its length and direction [rad]."""
    return StateVector2D(np.cos(angle) * magnitude, np.sin(angle) * magnitude)


# nuplan.common.geometry.compute


def lateral_distance(reference: StateSE2, other: Point2D) -> float:
    """How far a point is to the left of a pose [m]."""
    cos, sin = np.cos(reference.heading), np.sin(reference.heading)
    return float(-sin * (other.x - reference.x) + cos * (other.y - reference.y))


def longitudinal_distance(reference: StateSE2, other: Point2D) -> float:
    """How far a point is ahead of a pose [m]."""
    cos, sin = np.cos(reference.heading), np.sin(reference.heading)
    return float(cos * (other.x - reference.x) + sin * (other.y - reference.y))


def compute_distance(lhs: StateSE2, rhs: StateSE2) -> float:
    """Distance between two positions [m]."""
    return lhs.distance_to(rhs)


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
        """Angles at one place or many."""
        return np.asarray(principal_value(self._angles(sampled_state)))
