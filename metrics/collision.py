"""Collisions: first contact with every track, who is at fault, and the score."""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics import kernels_collision
from shiftsim.metrics.result import Collision, MetricPart, MetricRow, Statistic, Violation
from shiftsim.metrics.thresholds import Thresholds
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
GROUPS = {
    "VRUs": (AgentKind.PEDESTRIAN, AgentKind.BICYCLE),
    "vehicles": (AgentKind.VEHICLE,),
    "objects": (
        AgentKind.TRAFFIC_CONE,
        AgentKind.BARRIER,
        AgentKind.CZONE_SIGN,
        AgentKind.GENERIC_OBJECT,
    ),
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
    """First contact with each of N tracks.

    Attributes:
        first: (N,) sample, K where there is none.
        types: (N,) position in `COLLISION_TYPES`; meaningless where there is none.
        delta_v: (N,) [m/s]; meaningless where there is none.
    """

    first: IntArray
    types: IntArray
    delta_v: FloatArray


def flat_ego(states: FloatArray, vehicle: VehicleParameters) -> Ego:
    """The ego of a rollout: (K, 11) states of its rear axle."""
    centers = center_poses(states[:, :3], vehicle)
    size = np.array([vehicle.length, vehicle.width])
    corners = boxes_to_corners(centers, np.broadcast_to(size, (len(centers), 2)))
    return Ego(np.ascontiguousarray(states), speeds(states), centers, corners, size)


def flat_tracks(tracks: Tracks) -> FlatTracks:
    """Contiguous arrays of the tracks, without a copy where they already are."""
    return FlatTracks(
        np.ascontiguousarray(tracks.valid),
        np.ascontiguousarray(tracks.poses),
        np.ascontiguousarray(tracks.velocities),
        np.ascontiguousarray(tracks.sizes),
        tracks.kinds > LAST_AGENT_KIND,
    )


def first_contacts(ego: Ego, tracks: FlatTracks) -> Contacts:
    """When and how the ego first touches each track."""
    count = len(tracks.is_static)
    out = Contacts(np.empty(count, np.int64), np.zeros(count, np.int64), np.zeros(count))
    kernels_collision.first_contacts(*ego, *tracks, *out)
    return out


def classify(
    contacts: Contacts, time_us: IntArray, tracks: Tracks, is_common: BoolArray
) -> tuple[Collision, ...]:
    """The contacts in order of time, type and track, with the verdict on the ego."""
    hit = np.flatnonzero(contacts.first < len(time_us))
    # nuPlan: tracks of one sample are sorted by type
    order = hit[np.lexsort((tracks.kinds[hit], contacts.first[hit]))]
    found = []
    for track in order.tolist():
        sample, kind = int(contacts.first[track]), int(contacts.types[track])
        always = kind in (kernels_collision.STOPPED_TRACK, kernels_collision.ACTIVE_FRONT)
        # nuPlan: a lateral contact is the ego's fault only while it is between lanes or off road
        lateral = kind == kernels_collision.ACTIVE_LATERAL and not is_common[sample]
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


def judge(collisions: tuple[Collision, ...], thresholds: Thresholds) -> MetricPart:
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
    blamed = [c for c in collisions if c.at_fault]
    violation = None
    if blamed:
        worst = blamed[0]
        violation = Violation(worst.iteration, worst.time_us, worst.token, worst.delta_v)
    statistics = [
        Statistic(NAME, NAME, "boolean", "BOOLEAN", float(total == 0)),
        Statistic(NAME, "number_of_all_at_fault_collisions", "count", "COUNT", float(total)),
    ]
    for group, number in counts.items():
        name = f"number_of_at_fault_collisions_with_{group}"
        statistics.append(Statistic(NAME, name, "count", "COUNT", float(number)))
    for group, kinds in GROUPS.items():
        statistics += _energies(group, [c.delta_v for c in blamed if c.kind in kinds])
    row = MetricRow(NAME, score, float(total), "count", 0.0, violation)
    return MetricPart(row, tuple(statistics))


def _energies(group: str, values: list[float]) -> list[Statistic]:
    if not values:
        return []
    unit = "meters_per_second"
    return [
        Statistic(NAME, f"{how}_collision_energy_with_{group}", unit, how.upper(), float(value))
        for how, value in (("max", max(values)), ("min", min(values)), ("mean", np.mean(values)))
    ]
