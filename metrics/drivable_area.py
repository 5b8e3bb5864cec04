"""Drivable area: how far the corners of the ego leave the road."""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.metrics import kernels_route
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Statistic, Violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.metrics.thresholds import Thresholds
from shiftsim.world.map import VectorMap

NAME = "drivable_area_compliance"
CORNERS_NAME = "corners_in_drivable_area"


@dataclass(frozen=True, slots=True)
class DrivableArea:
    """Corners that leave the road.

    Attributes:
        outside: (K, 4) whether a corner is in no lane, connector or drivable area.
        distances: (K, 4) how far outside it is, 0 inside [m].
    """

    outside: BoolArray
    distances: FloatArray


def measure(
    road: VectorMap, footprints: FloatArray, route: EdgeLists, corners: EdgeLists
) -> DrivableArea:
    """Distance of every corner (K, 4, 2) from where it may be."""
    shape = corners.counts.shape
    out = DrivableArea(np.empty(shape, np.bool_), np.empty(shape))
    kernels_route.corner_violations(
        road.drivable_areas.polygons,
        road.edges.polygons,
        footprints,
        corners.counts,
        route.edges,
        route.counts,
        out.outside,
        out.distances,
    )
    return out


def judge(
    area: DrivableArea, time_us: IntArray, thresholds: Thresholds
) -> tuple[MetricPart, MetricPart]:
    """Score with the tolerance on the distance, and the unscored result without it."""
    bound = thresholds.max_drivable_area_violation
    far = np.any(area.outside & (area.distances >= bound), axis=1)
    furthest = area.distances.max(axis=1)
    score = float(not far.any())
    compliance = MetricPart(
        MetricRow(
            NAME, score, float(furthest.max()), "meters", bound, _first(far, furthest, time_us)
        ),
        (Statistic(NAME, NAME, "boolean", "BOOLEAN", score),),
    )
    outside = np.any(area.outside, axis=1)
    inside = float(not outside.any())
    first = _first(outside, furthest, time_us)
    corners = MetricPart(
        MetricRow(CORNERS_NAME, None, float(outside.sum()), "count", 0.0, first),
        (Statistic(CORNERS_NAME, CORNERS_NAME, "boolean", "BOOLEAN", inside),),
        Series("boolean", np.where(outside, 0.0, 1.0)),
    )
    return compliance, corners


def _first(broken: BoolArray, values: FloatArray, time_us: IntArray) -> Violation | None:
    if not broken.any():
        return None
    at = int(np.argmax(broken))
    return Violation(at, int(time_us[at]), None, float(values[at]))
