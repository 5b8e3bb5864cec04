"""Contacts of the ego with tracks, and time to collision (nuplan-metrics.md §6, §7).

A box is a row (x, y, cos h, sin h, cos(h + pi/2), sin(h + pi/2), half length, half width, half
diagonal). Most pairs are decided by distances with a margin; the rest exactly, on corners.
"""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.rings import EXTERIOR, convex_intersect, locate_in_ring, segments_intersect
from shiftsim.world.layers import Polygons, in_any

STOPPED_EGO, STOPPED_TRACK, ACTIVE_REAR, ACTIVE_FRONT, ACTIVE_LATERAL = 0, 1, 2, 3, 4
STOPPED_SPEED = 5e-2  # m/s, nuPlan at-fault collisions
_TTC_STOPPED_SPEED = 5e-3  # m/s, nuPlan time to collision
_BEHIND, _AHEAD = np.deg2rad(150.0), np.deg2rad(30.0)
TTC_STEP = 0.1  # s
TTC_HORIZON = 3.0  # s
_TTC_TESTS = 29  # nuPlan: the horizon itself is not tested, nuplan-metrics.md §13 Q9
_MARGIN = 1e-6  # m, far above rounding: gaps beyond it need no exact test
_BOX = 9


@lean_kernel
def _set_box(box: FloatArray, pose: FloatArray, length: float, width: float) -> None:
    box[0], box[1] = pose[0], pose[1]
    box[2], box[3] = np.cos(pose[2]), np.sin(pose[2])
    box[4], box[5] = np.cos(pose[2] + np.pi / 2.0), np.sin(pose[2] + np.pi / 2.0)
    _set_size(box, length, width)


@lean_kernel
def _set_size(box: FloatArray, length: float, width: float) -> None:
    box[6], box[7] = 0.5 * length, 0.5 * width
    box[8] = 0.5 * np.sqrt(length * length + width * width)


@lean_kernel
def _set_corners(box: FloatArray, out: FloatArray) -> None:
    for index in range(4):
        lon = box[6] if index == 0 or index == 3 else -box[6]
        lat = box[7] if index < 2 else -box[7]
        # nuPlan: the offset is summed first, as in geometry.box_corners
        out[index, 0] = box[0] + (lat * box[4] + lon * box[2])
        out[index, 1] = box[1] + (lat * box[5] + lon * box[3])


@lean_kernel
def _gap(a: FloatArray, b: FloatArray) -> float:
    """Largest gap between two boxes along the axes of `a`; negative where they overlap [m]."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    cos, sin = abs(a[2] * b[2] + a[3] * b[3]), abs(a[2] * b[3] - a[3] * b[2])
    lon = abs(dx * a[2] + dy * a[3]) - a[6] - b[6] * cos - b[7] * sin
    lat = abs(dx * a[3] - dy * a[2]) - a[7] - b[6] * sin - b[7] * cos
    return max(lon, lat)


@lean_kernel
def _collide(a: FloatArray, b: FloatArray, corners: FloatArray) -> bool:
    dx, dy = b[0] - a[0], b[1] - a[1]
    reach = a[8] + b[8]
    if not dx * dx + dy * dy < reach * reach:
        return False
    gap = max(_gap(a, b), _gap(b, a))
    if abs(gap) > _MARGIN:
        return gap < 0.0
    _set_corners(a, corners[0])
    _set_corners(b, corners[1])
    return convex_intersect(corners[0], corners[1])


@lean_kernel
def _bearing(ego: FloatArray, x: float, y: float) -> float:
    """Angle between the ego heading and the vector from the rear axle to a point [rad].

    nuPlan: NaN for coincident points and where rounding lifts the cosine above 1
    (nuplan-metrics.md §13 Q10); the order of operations is nuPlan's for that reason.
    """
    dx, dy = x - ego[0], y - ego[1]
    norm = np.sqrt(dx * dx + dy * dy)
    return np.arccos(np.cos(ego[2]) * (dx / norm) + np.sin(ego[2]) * (dy / norm))


@kernel
def _contact_kind(
    state: FloatArray, speed: float, track: FloatArray, track_speed: float, corners: FloatArray
) -> int:
    if speed <= STOPPED_SPEED:
        return STOPPED_EGO
    if track_speed <= STOPPED_SPEED:
        return STOPPED_TRACK
    if _bearing(state, track[0], track[1]) > _BEHIND:
        return ACTIVE_REAR
    box = np.empty((4, 2))
    _set_corners(track, box)
    touches = locate_in_ring(box, corners[0, 0], corners[0, 1]) != EXTERIOR
    for edge in range(4):
        touches = touches or segments_intersect(
            corners[0], corners[3], box[edge], box[(edge + 1) % 4]
        )
    return ACTIVE_FRONT if touches else ACTIVE_LATERAL


@kernel
def first_contacts(
    states: FloatArray,
    speeds: FloatArray,
    centers: FloatArray,
    corners: FloatArray,
    size: FloatArray,
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
    is_static: BoolArray,
    first: IntArray,
    kinds: IntArray,
    delta_v: FloatArray,
) -> None:
    """Write the first contact of the ego with every track.

    Args:
        states: (K, 11) rear-axle states.
        speeds: (K,) ego speed at the rear axle [m/s].
        centers: (K, 3) ego box centres.
        corners: (K, 4, 2) ego corners [m].
        size: (2,) ego length and width [m].
        valid: (K, N) whether the track is present.
        poses: (K, N, 3) box centres.
        velocities: (K, N, 2) [m/s].
        sizes: (K, N, 2) length, width [m].
        is_static: (N,) whether the track is a static object.
        first: (N,) written: sample of the first contact, K where there is none.
        kinds: (N,) written: collision type.
        delta_v: (N,) written: change of speed of two equal masses [m/s].
    """
    ego, track, scratch = np.empty(_BOX), np.empty(_BOX), np.empty((2, 4, 2))
    num_samples, num_tracks = valid.shape
    for j in range(num_tracks):
        first[j] = num_samples
    for i in range(num_samples):
        _set_box(ego, centers[i], size[0], size[1])
        for j in range(num_tracks):
            if not valid[i, j] or first[j] < num_samples:
                continue
            dx, dy = poses[i, j, 0] - ego[0], poses[i, j, 1] - ego[1]
            reach = ego[8] + 0.5 * (sizes[i, j, 0] + sizes[i, j, 1])
            if dx * dx + dy * dy > reach * reach:
                continue
            _set_box(track, poses[i, j], sizes[i, j, 0], sizes[i, j, 1])
            if not _collide(ego, track, scratch):
                continue
            v = speeds[i]
            w = 0.0 if is_static[j] else np.hypot(velocities[i, j, 0], velocities[i, j, 1])
            first[j] = i
            kinds[j] = _contact_kind(states[i], v, track, w, corners[i])
            angle = states[i, 2] - poses[i, j, 2]
            delta_v[j] = 0.5 * np.sqrt(max(0.0, v * v + w * w - 2.0 * v * w * np.cos(angle)))


@kernel
def time_to_collision(
    states: FloatArray,
    speeds: FloatArray,
    centers: FloatArray,
    size: FloatArray,
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
    is_static: BoolArray,
    first: IntArray,
    at_fault: IntArray,
    is_common: BoolArray,
    intersections: Polygons,
    ttc: FloatArray,
    partners: IntArray,
) -> None:
    """Write the time to collision of every sample.

    Args:
        states: (K, 11) rear-axle states.
        speeds: (K,) ego speed at the rear axle [m/s].
        centers: (K, 3) ego box centres.
        size: (2,) ego length and width [m].
        valid: (K, N) whether the track is present.
        poses: (K, N, 3) box centres.
        velocities: (K, N, 2) [m/s].
        sizes: (K, N, 2) length, width [m].
        is_static: (N,) whether the track is a static object.
        first: (N,) sample of the first contact with each track, K where there is none.
        at_fault: (K,) track of an at-fault collision at this sample, else -1.
        is_common: (K,) whether all corners are in the same or connected lanes.
        intersections: The layer.
        ttc: (K,) written: [s], inf where nothing is hit.
        partners: (K,) written: the track that is hit, or -1.
    """
    num_samples, num_tracks = valid.shape
    boxes, steps = np.empty((num_tracks + 1, _BOX)), np.empty((num_tracks + 1, 2))
    kept, scratch = np.empty(num_tracks, np.int64), np.empty((2, 4, 2))
    for i in range(num_samples):
        ttc[i], partners[i] = np.inf, at_fault[i]
        if at_fault[i] >= 0:
            ttc[i] = 0.0
            continue
        # nuPlan: 0.005 m/s here, 0.05 m/s for collisions (nuplan-metrics.md §13 Q9)
        if speeds[i] <= _TTC_STOPPED_SPEED:
            continue
        num, beside = 0, 0  # beside: 0 not asked yet, 1 tracks beside count, -1 they do not
        _set_box(boxes[0], centers[i], size[0], size[1])
        _set_step(boxes[0], speeds[i], steps[0])
        for j in range(num_tracks):
            if not valid[i, j] or first[j] <= i:
                continue
            vx = 0.0 if is_static[j] else velocities[i, j, 0]
            vy = 0.0 if is_static[j] else velocities[i, j, 1]
            dx, dy = poses[i, j, 0] - centers[i, 0], poses[i, j, 1] - centers[i, 1]
            # generous: elongated boxes further apart than this cannot touch
            reach = boxes[0, 8] + 0.5 * (sizes[i, j, 0] + sizes[i, j, 1])
            reach += TTC_HORIZON * (speeds[i] + abs(vx) + abs(vy))
            if dx * dx + dy * dy > reach * reach:
                continue
            angle = _bearing(states[i], poses[i, j, 0], poses[i, j, 1])
            if not angle < _AHEAD:
                if angle > _BEHIND:
                    continue
                if beside == 0:
                    inside = not is_common[i] or in_any(intersections, states[i, 0], states[i, 1])
                    beside = 1 if inside else -1
                if beside < 0:
                    continue
            box = boxes[num + 1]
            _set_box(box, poses[i, j], sizes[i, j, 0], sizes[i, j, 1])
            speed = np.hypot(vx, vy)
            if _swept_collide(boxes[0], speeds[i], box, speed, scratch):
                _set_step(box, speed, steps[num + 1])
                kept[num] = j
                num += 1
        hit = _first_hit(boxes[: num + 1], steps, scratch)
        if hit[0] > 0:
            # nuPlan: the grid is numpy's arange, whose values are multiples of the step
            ttc[i], partners[i] = TTC_STEP * hit[0], kept[hit[1]]


@lean_kernel
def _set_step(box: FloatArray, speed: float, step: FloatArray) -> None:
    # nuPlan: along the heading, whatever the direction of the velocity (nuplan-metrics.md §13 Q9)
    step[0] = box[2] * speed * TTC_STEP
    step[1] = box[3] * speed * TTC_STEP


@lean_kernel
def _stretch(box: FloatArray, speed: float, out: FloatArray) -> None:
    distance = speed * TTC_HORIZON
    for index in range(_BOX):  # a slice assignment takes numba seconds to compile
        out[index] = box[index]
    out[0] += 0.5 * distance * box[2]
    out[1] += 0.5 * distance * box[3]
    _set_size(out, 2.0 * box[6] + distance, 2.0 * box[7])


@kernel
def _swept_collide(
    a: FloatArray, speed_a: float, b: FloatArray, speed_b: float, scratch: FloatArray
) -> bool:
    swept = np.empty((2, _BOX))
    _stretch(a, speed_a, swept[0])
    _stretch(b, speed_b, swept[1])
    return _collide(swept[0], swept[1], scratch)


@lean_kernel
def _first_hit(boxes: FloatArray, steps: FloatArray, scratch: FloatArray) -> tuple[int, int]:
    """First step at which box 0 meets another, and which; 0 when none does. Moves the boxes."""
    if len(boxes) < 2:
        return 0, 0
    for k in range(1, _TTC_TESTS + 1):
        for index in range(len(boxes)):
            # nuPlan: positions accumulate rounding step by step (nuplan-metrics.md §7)
            boxes[index, 0] += steps[index, 0]
            boxes[index, 1] += steps[index, 1]
        for index in range(1, len(boxes)):
            if _collide(boxes[0], boxes[index], scratch):
                return k, index - 1
    return 0, 0
