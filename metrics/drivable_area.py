"""Drivable area: how far the corners of the ego leave it."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.rings import boundary_distance_below
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Thresholds, first_violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.map import VectorMap

NAME = "drivable_area_compliance"
CORNERS_NAME = "corners_in_drivable_area"


class DrivableArea(NamedTuple):
    """Corners that leave the drivable area."""

    outside: BoolArray  # (K, 4) whether a corner is in no lane, connector or drivable area
    distances: FloatArray  # (K, 4) how far outside it is, 0 inside [m]


def measure(
    map: VectorMap, footprints: FloatArray, route: EdgeLists, corners: EdgeLists
) -> DrivableArea:
    """Distance of every corner (K, 4, 2) from where it may be."""
    shape = corners.counts.shape
    out = DrivableArea(np.empty(shape, np.bool_), np.empty(shape))
    areas, edges = map.drivable_areas.polygons, map.edges.polygons
    _corner_violations(areas, edges, footprints, corners.counts, route, out)
    return out


def evaluate(
    area: DrivableArea, time_us: IntArray, thresholds: Thresholds
) -> tuple[MetricPart, MetricPart]:
    """Score with the tolerance on the distance, and the unscored result without it."""
    bound = thresholds.max_drivable_area_violation
    far = np.any(area.outside & (area.distances >= bound), axis=1)
    furthest = area.distances.max(axis=1)
    first = first_violation(far, furthest, time_us)
    score = float(first is None)
    row = MetricRow(NAME, score, float(furthest.max()), "meters", bound, first)
    compliance = MetricPart.of(row, (NAME, "boolean", "BOOLEAN", score))
    outside = np.any(area.outside, axis=1)
    first = first_violation(outside, furthest, time_us)
    return compliance, MetricPart.of(
        MetricRow(CORNERS_NAME, None, float(outside.sum()), "count", 0.0, first),
        (CORNERS_NAME, "boolean", "BOOLEAN", first is None),
        series=Series("boolean", np.where(outside, 0.0, 1.0)),
    )


@kernel
def _corner_violations(
    drivable: Polygons,  # areas whose union is drivable
    edges: Polygons,  # areas of lanes and connectors
    corners: FloatArray,  # (K, 4, 2) [m]
    corner_counts: IntArray,  # (K, 4) number of edges that hold each corner
    route: EdgeLists,  # (K, C) edges of the ego centre
    # written; distances are to the nearest drivable area or edge of the ego centre [m]
    out: DrivableArea,
) -> None:
    """Write how far each corner is from where it may be."""
    outside, distances = out.outside, out.distances
    found = np.full(4, -1)  # nearest drivable area of each corner in the sample before
    for i in range(len(corners)):
        for corner in range(4):
            x, y = corners[i, corner, 0], corners[i, corner, 1]
            outside[i, corner] = corner_counts[i, corner] == 0 and not in_any(drivable, x, y)
            distances[i, corner] = 0.0
            if outside[i, corner]:
                best = np.inf
                for index in range(route.counts[i]):
                    best = _distance_below(edges, route.edges[i, index], x, y, best)
                if found[corner] >= 0:
                    best = _distance_below(drivable, found[corner], x, y, best)
                for poly in range(len(drivable.bounds)):
                    distance = _distance_below(drivable, poly, x, y, best)
                    if distance < best:
                        best, found[corner] = distance, poly
                distances[i, corner] = best


@kernel
def _distance_below(polygons: Polygons, poly: int, x: float, y: float, limit: float) -> float:
    """Distance of a point outside polygon `poly` from it, or `limit` where it is not below [m]."""
    dx = max(polygons.bounds[poly, 0] - x, 0.0, x - polygons.bounds[poly, 2])
    dy = max(polygons.bounds[poly, 1] - y, 0.0, y - polygons.bounds[poly, 3])
    best = limit
    if dx * dx + dy * dy < best * best * (1.0 + 1e-12):  # rounding, as for the edges
        for ring in range(polygons.poly_ptr[poly], polygons.poly_ptr[poly + 1]):
            start, stop = polygons.ring_ptr[ring], polygons.ring_ptr[ring + 1]
            best = boundary_distance_below(polygons.xy, start, stop, x, y, best)
    return best
