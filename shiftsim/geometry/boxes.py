"""Oriented boxes: corners and overlap.

A box is (x, y, heading, length, width) with its centre pose; its corners run front-left, rear-left,
rear-right, front-right.
"""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, kernel, lean_kernel
from shiftsim.geometry.rings import convex_intersect


@lean_kernel
def box_corners(x: float, y: float, heading: float, length: float, width: float, out: FloatArray):  # type: ignore[no-untyped-def]
    """Write the corners of a box into `out` (4, 2): front-left, rear-left, rear-right, front-right.

    nuPlan: the lateral axis is evaluated literally at heading + pi/2 (nuplan-simulation.md §3).
    """
    lon_x, lon_y = np.cos(heading), np.sin(heading)
    lat_x, lat_y = np.cos(heading + np.pi / 2.0), np.sin(heading + np.pi / 2.0)
    for index in range(4):
        lon = 0.5 * length if index == 0 or index == 3 else -0.5 * length
        lat = 0.5 * width if index < 2 else -0.5 * width
        # nuPlan: the offset is summed first, which decides the last bit
        out[index, 0] = x + (lat * lat_x + lon * lon_x)
        out[index, 1] = y + (lat * lat_y + lon * lon_y)


def boxes_to_corners(poses: FloatArray, sizes: FloatArray) -> FloatArray:
    """Corners (..., 4, 2) of boxes given by poses (..., 3) and sizes (..., 2) length, width [m]."""
    heading = poses[..., 2]
    lon = np.stack([np.cos(heading), np.sin(heading)], -1)
    lat = np.stack([np.cos(heading + np.pi / 2.0), np.sin(heading + np.pi / 2.0)], -1)
    half_length = 0.5 * sizes[..., 0, None, None] * np.array([1.0, -1.0, -1.0, 1.0])[:, None]
    half_width = 0.5 * sizes[..., 1, None, None] * np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    corners: FloatArray = poses[..., None, :2] + (
        half_width * lat[..., None, :] + half_length * lon[..., None, :]
    )
    return corners


def boxes_intersect(
    poses_a: FloatArray, sizes_a: FloatArray, poses_b: FloatArray, sizes_b: FloatArray
) -> BoolArray:
    """(N,) whether box i of one list shares a point with box i of the other; touching counts."""
    return _pairs_intersect(boxes_to_corners(poses_a, sizes_a), boxes_to_corners(poses_b, sizes_b))


@kernel
def _pairs_intersect(a: FloatArray, b: FloatArray) -> BoolArray:
    out = np.empty(len(a), np.bool_)
    for index in range(len(a)):
        out[index] = convex_intersect(a[index], b[index])
    return out
