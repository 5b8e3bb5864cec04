"""Poses and oriented boxes: angles, frames, corners, and where a point lies as seen from a pose.

A pose is (x, y, heading); coordinates may be UTM, so differences are always taken first.
A box is (x, y, heading, length, width) with its centre pose; its corners run front-left, rear-left,
rear-right, front-right.
"""

import numpy as np

from shiftsim.geometry.rings import EXTERIOR, SLACK, convex_intersect, locate_in_ring, segments_meet
from shiftsim.kernels import FloatArray, kernel

# rad, bearings from the rear axle that at-fault tests compare with
BEHIND, AHEAD = np.deg2rad(150.0), np.deg2rad(30.0)
STOPPED_SPEED = 5e-2  # m/s, of the ego and of others in a collision
# how the ego and another box come into contact
STOPPED_EGO, STOPPED_TRACK, ACTIVE_REAR, ACTIVE_FRONT, ACTIVE_LATERAL = range(5)


@kernel
def box_corners(x: float, y: float, heading: float, length: float, width: float, out: FloatArray):  # type: ignore[no-untyped-def]
    """Write the corners of a box into `out` (4, 2), in the order named above [m]."""
    lon_x, lon_y = np.cos(heading), np.sin(heading)
    # nuPlan rule 1: the lateral axis is evaluated at heading + pi/2, and the offset is summed first
    lat_x, lat_y = np.cos(heading + np.pi / 2.0), np.sin(heading + np.pi / 2.0)
    for index in range(4):
        lon = 0.5 * length if index == 0 or index == 3 else -0.5 * length
        lat = 0.5 * width if index < 2 else -0.5 * width
        out[index, 0] = x + (lat * lat_x + lon * lon_x)
        out[index, 1] = y + (lat * lat_y + lon * lon_y)


@kernel
def circle_around(box: FloatArray) -> tuple[float, float, float]:
    """Centre and radius of a circle around a box (4, 2), a little larger than it [m]."""
    x, y = 0.5 * (box[0, 0] + box[2, 0]), 0.5 * (box[0, 1] + box[2, 1])
    return x, y, np.hypot(box[0, 0] - x, box[0, 1] - y) + 1e-6


@kernel
def boxes_touch(a: FloatArray, b: FloatArray) -> bool:
    """Whether two boxes (4, 2) share a point; touching counts."""
    # most that are near one another are clearly apart along an axis of the first
    x, y = 0.5 * (a[0, 0] + a[2, 0]), 0.5 * (a[0, 1] + a[2, 1])
    for axis in range(1, 4, 2):
        axis_x, axis_y = a[0, 0] - a[axis, 0], a[0, 1] - a[axis, 1]
        size = np.sqrt(axis_x * axis_x + axis_y * axis_y)
        least, most = np.inf, -np.inf
        for corner in range(4):
            along = axis_x * (b[corner, 0] - x) + axis_y * (b[corner, 1] - y)
            least, most = min(least, along), max(most, along)
        if max(least, -most) > size * (0.5 * size + SLACK):
            return False
    return convex_intersect(a, b)


@kernel
def bearing_cosine(cos: float, sin: float, dx: float, dy: float) -> float:
    """Cosine of a bearing, from that of the heading, its sine, and the way to the point [m]."""
    # nuPlan rule 3: the cosine is not clamped, so the angle may be NaN
    distance = np.sqrt(dx * dx + dy * dy)
    return cos * (dx / distance) + sin * (dy / distance)


@kernel
def contact_type(
    pose: FloatArray,
    speed: float,
    box: FloatArray,
    x: float,
    y: float,
    other_speed: float,
    other: FloatArray,
) -> int:
    """STOPPED_EGO … ACTIVE_LATERAL: the kind of a contact of the ego with another box.

    The ego has the rear-axle pose (3,), a speed [m/s] and the box (4, 2), the other one the middle
    (x, y) that the bearing is taken to, a speed and the box (4, 2).
    """
    if speed <= STOPPED_SPEED:
        return STOPPED_EGO
    if other_speed <= STOPPED_SPEED:
        return STOPPED_TRACK
    cosine = bearing_cosine(np.cos(pose[2]), np.sin(pose[2]), x - pose[0], y - pose[1])
    if np.arccos(cosine) > BEHIND:
        return ACTIVE_REAR
    if locate_in_ring(other, box[0, 0], box[0, 1]) != EXTERIOR:
        return ACTIVE_FRONT
    ax, ay, bx, by = box[0, 0], box[0, 1], box[3, 0], box[3, 1]
    for index in range(len(other)):
        cx, cy, dx, dy = other[index - 1, 0], other[index - 1, 1], other[index, 0], other[index, 1]
        if segments_meet(ax, ay, bx, by, cx, cy, dx, dy):
            return ACTIVE_FRONT  # the front edge touches the other box
    return ACTIVE_LATERAL


@kernel
def meets_bounds(box: FloatArray, bounds: FloatArray) -> bool:
    """Whether the bounds of a box (4, 2) overlap `bounds` (4,) min x, min y, max x, max y."""
    return (
        max(box[0, 0], box[1, 0], box[2, 0], box[3, 0]) >= bounds[0]
        and max(box[0, 1], box[1, 1], box[2, 1], box[3, 1]) >= bounds[1]
        and min(box[0, 0], box[1, 0], box[2, 0], box[3, 0]) <= bounds[2]
        and min(box[0, 1], box[1, 1], box[2, 1], box[3, 1]) <= bounds[3]
    )


def boxes_to_corners(poses: FloatArray, sizes: FloatArray) -> FloatArray:
    """Corners (..., 4, 2) of boxes given by poses (..., 3) and sizes (..., 2) length, width [m]."""
    # x and y one after the other: NumPy is slow where the last axis is short
    heading, length, width = poses[..., 2], 0.5 * sizes[..., 0], 0.5 * sizes[..., 1]
    across = heading + np.pi / 2.0
    lon = length * np.cos(heading), length * np.sin(heading)
    lat = width * np.cos(across), width * np.sin(across)
    corners = np.empty((*lon[0].shape, 4, 2))
    for axis in range(2):
        center, a, b = poses[..., axis], lat[axis], lon[axis]
        for corner, offset in enumerate((a + b, a - b, -a - b, b - a)):
            np.add(center, offset, out=corners[..., corner, axis])
    return corners


@kernel
def wrap_angle(angle: float) -> float:
    """An angle wrapped to [-pi, pi) as nuPlan does: ((angle + pi) mod 2 pi) - pi [rad]."""
    turned = angle + np.pi
    if not 0.0 <= turned < 2.0 * np.pi:  # few are: most need no division
        turned %= 2.0 * np.pi
    return turned - np.pi


def wrap_angles(angles: FloatArray) -> FloatArray:
    """Angles of any shape wrapped to [-pi, pi) [rad]."""
    return (angles + np.pi) % (2.0 * np.pi) - np.pi


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


def to_frame(poses: FloatArray, origin: FloatArray) -> FloatArray:
    """Poses (..., 3) of the map frame expressed in the frame of the pose `origin` (3,)."""
    xy = turned(poses[..., :2] - origin[:2], origin[2])
    return np.concatenate([xy, wrap_angles(poses[..., 2:] - origin[2])], axis=-1)


def turned(vectors: FloatArray, heading: float) -> FloatArray:
    """Vectors (..., 2) in a frame that is turned to a heading [rad]: forward and left."""
    cos, sin = np.cos(heading), np.sin(heading)
    x, y = vectors[..., 0], vectors[..., 1]
    out = np.empty((*x.shape, 2))
    np.add(cos * x, sin * y, out=out[..., 0])
    np.subtract(cos * y, sin * x, out=out[..., 1])
    return out
