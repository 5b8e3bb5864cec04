"""Collisions: first contact with every track, who is at fault, and the score.

In kernels a box is a row (x, y, cos h, sin h, h, half length, half width, half diagonal).
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import (
    ACTIVE_FRONT,
    ACTIVE_LATERAL,
    STOPPED_TRACK,
    box_corners,
    contact_type,
)
from shiftsim.geometry.rings import SLACK, convex_intersect
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics.result import Collision, MetricPart, MetricRow, Thresholds, Violation
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    AgentKind,
    Tracks,
    VehicleParameters,
    center_poses,
    speeds,
)

NAME = "no_ego_at_fault_collisions"
COLLISION_TYPES = ("stopped_ego", "stopped_track", "active_rear", "active_front", "active_lateral")
BOX_SIZE = 8  # numbers that make a box in kernels
GROUPS = {
    "VRUs": (AgentKind.PEDESTRIAN, AgentKind.BICYCLE),
    "vehicles": (AgentKind.VEHICLE,),
    "objects": tuple(kind for kind in AgentKind if kind > LAST_AGENT_KIND),
}


class Ego(NamedTuple):
    """The ego as the kernels read it: (K, …) states, speeds, centres and corners, (2,) size."""

    states: FloatArray
    speeds: FloatArray
    centers: FloatArray
    corners: FloatArray
    size: FloatArray


class FlatTracks(NamedTuple):
    """Tracks as the kernels read them: contiguous (K, N, …) arrays, (N,) static or not."""

    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray
    is_static: BoolArray


class Contacts(NamedTuple):
    """First contact with each of N tracks."""

    first: IntArray  # (N,) sample, K where there is none
    types: IntArray  # (N,) position in `COLLISION_TYPES`; meaningless where there is none
    delta_v: FloatArray  # (N,) [m/s]; meaningless where there is none


def flat_ego(states: FloatArray, vehicle: VehicleParameters) -> Ego:
    """The ego of a rollout: (K, 11) states of its rear axle."""
    centers = center_poses(states[:, :3], vehicle)
    size, corners = np.array([vehicle.length, vehicle.width]), np.empty((len(centers), 4, 2))
    _footprints(centers, size, corners)
    return Ego(np.ascontiguousarray(states), speeds(states), centers, corners, size)


def flat_tracks(tracks: Tracks) -> FlatTracks:
    """Contiguous arrays of the tracks, without a copy where they already are."""
    arrays = tracks.map_arrays(np.ascontiguousarray).arrays
    return FlatTracks(*arrays, tracks.kinds > LAST_AGENT_KIND)


def classify(
    contacts: Contacts, time_us: IntArray, tracks: Tracks, is_common: BoolArray
) -> tuple[Collision, ...]:
    """The contacts in order of time, type and track, with the verdict on the ego."""
    hit = np.flatnonzero(contacts.first < len(time_us))
    # nuPlan rule 60: tracks that are hit at one sample are sorted by kind
    order = hit[np.lexsort((tracks.kinds[hit], contacts.first[hit]))]
    found = []
    for track in order.tolist():
        sample, kind = int(contacts.first[track]), int(contacts.types[track])
        always = kind in (STOPPED_TRACK, ACTIVE_FRONT)
        # nuPlan rule 61: a track that stands is hit at fault, from wherever the ego comes
        # nuPlan rule 62: a contact at the side is at fault only between lanes or off them
        lateral = kind == ACTIVE_LATERAL and not is_common[sample]
        found.append(
            Collision(
                sample,
                int(time_us[sample]),
                tracks.tokens[track],
                int(tracks.kinds[track]),
                COLLISION_TYPES[kind],
                float(contacts.delta_v[track]),
                bool(always or lateral),
            )
        )
    return tuple(found)


def at_fault_counts(collisions: tuple[Collision, ...]) -> dict[str, int]:
    """Number of at-fault collisions per group of kinds."""
    return {
        group: sum(c.at_fault and c.kind in kinds for c in collisions)
        for group, kinds in GROUPS.items()
    }


def evaluate(collisions: tuple[Collision, ...], thresholds: Thresholds) -> MetricPart:
    """Score of the collisions: the product over the groups."""
    counts = at_fault_counts(collisions)
    allowed = (
        thresholds.allowed_vru_collisions,
        thresholds.allowed_vehicle_collisions,
        thresholds.allowed_object_collisions,
    )
    score = 1.0
    for number, free in zip(counts.values(), allowed, strict=True):
        score *= max(0.0, 1.0 - number / (free + 1))
    total = sum(counts.values())
    at_fault = [c for c in collisions if c.at_fault]
    violation = None
    if at_fault:
        worst = at_fault[0]
        violation = Violation(worst.iteration, worst.time_us, worst.token, worst.delta_v)
    energies = []
    for group, kinds in GROUPS.items():
        if values := [c.delta_v for c in at_fault if c.kind in kinds]:
            for how, value in ("max", max(values)), ("min", min(values)), ("mean", np.mean(values)):
                name = f"{how}_collision_energy_with_{group}"
                energies.append((name, "meters_per_second", how.upper(), float(value)))
    return MetricPart.of(
        MetricRow(NAME, score, float(total), "count", 0.0, violation),
        (NAME, "boolean", "BOOLEAN", total == 0),
        ("number_of_all_at_fault_collisions", "count", "COUNT", total),
        *((f"number_of_at_fault_collisions_with_{g}", "count", "COUNT", counts[g]) for g in counts),
        *energies,
    )


@kernel
def _footprints(centers: FloatArray, size: FloatArray, out: FloatArray) -> None:
    """Write the corners (K, 4, 2) of boxes of one size at poses (K, 3) [m]."""
    for i in range(len(centers)):
        box_corners(centers[i, 0], centers[i, 1], centers[i, 2], size[0], size[1], out[i])


@kernel
def set_box(box: FloatArray, pose: FloatArray, length: float, width: float) -> None:
    """Write a box (8,) from its pose (3,) and size [m]."""
    box[0], box[1], box[4] = pose[0], pose[1], pose[2]
    box[2], box[3] = np.cos(pose[2]), np.sin(pose[2])
    box[5], box[6] = 0.5 * length, 0.5 * width
    box[7] = 0.5 * np.sqrt(length * length + width * width)


@kernel
def collide(a: FloatArray, b: FloatArray, corners: FloatArray) -> bool:
    """Whether two boxes (8,) touch; `corners` (2, 4, 2) is scratch."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    reach = a[7] + b[7]
    if not dx * dx + dy * dy < reach * reach:
        return False
    # most that are near one another are clearly apart along an axis of the first
    cos, sin = abs(a[2] * b[2] + a[3] * b[3]), abs(a[2] * b[3] - a[3] * b[2])
    lon = abs(dx * a[2] + dy * a[3]) - a[5] - b[5] * cos - b[6] * sin
    lat = abs(dx * a[3] - dy * a[2]) - a[6] - b[5] * sin - b[6] * cos
    if max(lon, lat) > SLACK:
        return False
    box_corners(a[0], a[1], a[4], 2.0 * a[5], 2.0 * a[6], corners[0])
    box_corners(b[0], b[1], b[4], 2.0 * b[5], 2.0 * b[6], corners[1])
    return convex_intersect(corners[0], corners[1])


@kernel
def first_contacts(ego: Ego, tracks: FlatTracks) -> Contacts:
    """When and how the ego first touches each track."""
    # nuPlan rule 83: only the first contact with a track is classified
    box, other, scratch = np.empty(BOX_SIZE), np.empty(BOX_SIZE), np.empty((2, 4, 2))
    valid, poses, sizes = tracks.valid, tracks.poses, tracks.sizes
    num_samples, num_tracks = valid.shape
    first, types = np.full(num_tracks, num_samples), np.zeros(num_tracks, np.int64)
    delta_v = np.zeros(num_tracks)
    for i in range(num_samples):
        set_box(box, ego.centers[i], ego.size[0], ego.size[1])
        for j in range(num_tracks):
            if not valid[i, j] or first[j] < num_samples:
                continue
            dx, dy = poses[i, j, 0] - box[0], poses[i, j, 1] - box[1]
            reach = box[7] + 0.5 * (sizes[i, j, 0] + sizes[i, j, 1])
            if dx * dx + dy * dy > reach * reach:
                continue
            set_box(other, poses[i, j], sizes[i, j, 0], sizes[i, j, 1])
            if not collide(box, other, scratch):
                continue
            v, w = ego.speeds[i], 0.0
            if not tracks.is_static[j]:
                w = np.hypot(tracks.velocities[i, j, 0], tracks.velocities[i, j, 1])
            # `collide` left the corners of the track
            kind = contact_type(ego.states[i], v, ego.corners[i], other[0], other[1], w, scratch[1])
            first[j], types[j] = i, kind
            angle = ego.states[i, 2] - poses[i, j, 2]
            delta_v[j] = 0.5 * np.sqrt(max(0.0, v * v + w * w - 2.0 * v * w * np.cos(angle)))
    return Contacts(first, types, delta_v)
