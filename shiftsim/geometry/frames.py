"""Angles and frames: SE(2).

A pose is (x, y, heading); coordinates may be UTM, so differences are always taken first.
"""

import numpy as np

from shiftsim.arrays import FloatArray, lean_kernel


@lean_kernel
def wrap_angle(angle: float) -> float:
    """An angle wrapped to [-pi, pi) as nuPlan does: ((angle + pi) mod 2 pi) - pi [rad]."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def wrap_angles(angles: FloatArray) -> FloatArray:
    """Angles of any shape wrapped to [-pi, pi) [rad]."""
    wrapped: FloatArray = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped


def from_frame(poses: FloatArray, origin: FloatArray) -> FloatArray:
    """Poses (..., 3) in the frame of the pose `origin` (3,) expressed in the map frame."""
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    x, y = poses[..., 0], poses[..., 1]
    return np.stack(
        [
            origin[0] + cos * x - sin * y,
            origin[1] + sin * x + cos * y,
            wrap_angles(poses[..., 2] + origin[2]),
        ],
        -1,
    )
