"""Time to collision: everything projected straight ahead for three seconds, and the bound on it."""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.metrics import kernels_collision
from shiftsim.metrics.collision import Contacts, Ego, FlatTracks
from shiftsim.metrics.result import (
    Collision,
    MetricPart,
    MetricRow,
    Series,
    Statistic,
    Violation,
)
from shiftsim.metrics.thresholds import Thresholds
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks

NAME = "time_to_collision_within_bound"


@dataclass(frozen=True, slots=True)
class TimeToCollision:
    """Time to collision of one rollout.

    Attributes:
        values: (K,) [s], inf where nothing is hit, 0 at an at-fault collision.
        partners: (K,) track that is hit, or -1.
        tokens: Tokens of the tracks.
    """

    values: FloatArray
    partners: IntArray
    tokens: tuple[str, ...]


def time_to_collision(
    ego: Ego,
    tracks: FlatTracks,
    contacts: Contacts,
    collisions: tuple[Collision, ...],
    is_common: BoolArray,
    road: VectorMap,
    named: Tracks,
) -> TimeToCollision:
    """Smallest time to collision at every sample.

    Args:
        ego: The driven states.
        tracks: The others.
        contacts: First contact with each of them.
        collisions: The same contacts with the verdict.
        is_common: (K,) whether all corners are in the same or in connected lanes.
        road: The map.
        named: The tracks, for their tokens.
    """
    num_samples = len(ego.speeds)
    at_fault = np.full(num_samples, -1, np.int64)
    for collision in reversed(collisions):
        if collision.at_fault:
            at_fault[collision.iteration] = named.tokens.index(collision.token)
    out = TimeToCollision(np.empty(num_samples), np.empty(num_samples, np.int64), named.tokens)
    kernels_collision.time_to_collision(
        ego.states,
        ego.speeds,
        ego.centers,
        ego.size,
        *tracks,
        contacts.first,
        at_fault,
        is_common,
        road.intersections.polygons,
        out.values,
        out.partners,
    )
    return out


def judge(ttc: TimeToCollision, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Score 1 where the bound is exceeded at every sample."""
    bound = thresholds.least_min_ttc
    lowest = float(ttc.values.min())
    within = bool((bound < ttc.values).all())
    violation = None
    if not within:
        at = int(np.argmin(bound < ttc.values))
        token = ttc.tokens[ttc.partners[at]] if ttc.partners[at] >= 0 else None
        violation = Violation(at, int(time_us[at]), token, float(ttc.values[at]))
    horizon = kernels_collision.TTC_HORIZON
    return MetricPart(
        MetricRow(NAME, float(within), lowest, "seconds", bound, violation),
        (
            Statistic(NAME, "min_time_to_collision", "seconds", "MIN", lowest),
            Statistic(NAME, NAME, "boolean", "BOOLEAN", float(within)),
        ),
        Series(f"time_to_collision_under_{horizon}_seconds [s]", ttc.values),
    )
