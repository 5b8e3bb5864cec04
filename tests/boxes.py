"""Boxes and frames, as tests look at them."""

import numpy as np

from shiftsim.geometry.boxes import boxes_to_corners, wrap_angles
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import kernel


def boxes_intersect(poses_a, sizes_a, poses_b, sizes_b):
    """(N,) whether box i of one list shares a point with box i of the other; touching counts."""
    return _pairs_intersect(boxes_to_corners(poses_a, sizes_a), boxes_to_corners(poses_b, sizes_b))


@kernel
def _pairs_intersect(a, b):
    out = np.empty(len(a), np.bool_)
    for index in range(len(a)):
        out[index] = convex_intersect(a[index], b[index])
    return out


def to_frame(poses, origin):
    """Poses (..., 3) of the map frame expressed in the frame of the pose `origin` (3,)."""
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = poses[..., 0] - origin[0], poses[..., 1] - origin[1]
    return np.stack(
        [cos * dx + sin * dy, -sin * dx + cos * dy, wrap_angles(poses[..., 2] - origin[2])], -1
    )
