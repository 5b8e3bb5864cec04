"""Red lights on a route, and the lead: the nearest object that touches the corridor ahead."""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.corridor import CLEAR
from shiftsim.geometry.rings import SLACK, distance_bound, point_segment_distance, ring_bounds
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.map import VectorMap
from shiftsim.world.state import TrafficLights


class RedLights(NamedTuple):
    """Lanes and connectors with a red light, in the order of the lights. L of them."""

    lanes: list[int]  # their indices
    xy: FloatArray  # (V, 2) vertices of their shells, not closed [m]
    ptr: IntArray  # (L + 1,) first vertex of each
    bounds: FloatArray  # (L, 4) min x, min y, max x, max y of each [m]


class LightWatch:
    """Tells which lights are red among some lanes and connectors of a map."""

    def __init__(self, road: VectorMap, lanes: Collection[int]) -> None:
        """Take the map and the lanes and connectors."""
        self._road, self._lanes = road, frozenset(lanes)
        self._seen, self._red = TrafficLights.empty(1), red_lights([], [])

    def at(self, lights: TrafficLights) -> RedLights:
        """The red ones in a row of lights; they are made again where lights have changed."""
        names, status = self._seen.connector_ids, self._seen.status
        if lights.connector_ids is not names or not np.array_equal(lights.status, status):
            red = [lane for lane in red_lanes(self._road, lights) if lane in self._lanes]
            self._red = red_lights(red, [self._road.edges.rings(lane)[0] for lane in red])
            self._seen = TrafficLights(lights.connector_ids, lights.status.copy())
        return self._red


def red_lanes(road: VectorMap, lights: TrafficLights) -> list[int]:
    """Lanes and connectors of the map whose light is red in one row, in the order of the lights."""
    index = road.edges.index
    return [index[name] for name in lights.red(0) if name in index]


def red_lights(lanes: list[int], rings: Sequence[FloatArray]) -> RedLights:
    """Red lights of some lanes and connectors with the shells (V, 2)."""
    xy = np.concatenate([np.zeros((0, 2)), *rings])
    ptr = np.cumsum([0, *map(len, rings)])
    return RedLights(lanes, xy, ptr, bounds_of(xy, ptr))


def bounds_of(xy: FloatArray, ptr: IntArray) -> FloatArray:
    """(M, 4) min x, min y, max x, max y of rings, of which each begins at a vertex `ptr` [m]."""
    return np.hstack([extreme.reduceat(xy, ptr[:-1]) for extreme in (np.minimum, np.maximum)])


# beside CLEAR, HIT and UNDECIDED: not asked yet, and touched by the ego's footprint itself
UNKNOWN, OVERLAPPING = -1, 3


class Objects(NamedTuple):
    """Polygons around the ego. M objects."""

    xy: FloatArray  # (V, 2) vertices of all rings, not closed [m]
    ptr: IntArray  # (M + 1,) first vertex of each ring
    bounds: FloatArray  # (M, 4) min x, min y, max x, max y [m]
    headings: FloatArray  # (M,) heading, 0 for a red light [rad]
    speeds: FloatArray  # (M,) speed, 0 for static objects and red lights [m/s]


@kernel
def find_lead(footprint: FloatArray, objects: Objects, occupancy: IntArray) -> tuple[int, float]:
    """The object nearest to the footprint (4, 2) and its gap [m]; (-1, inf) if all are CLEAR.

    It may be UNDECIDED; those farther away need not be decided. Of those that are OVERLAPPING it is
    the first. `occupancy` (M,) says of each object what it is to the corridor.
    """
    for index in range(len(occupancy)):
        if occupancy[index] == OVERLAPPING:
            return index, 0.0
    bounds = objects.bounds
    low_x, low_y, high_x, high_y = ring_bounds(footprint)
    found, best, best_gap = -1, np.inf, np.inf
    for index in range(len(occupancy)):
        apart_x = max(bounds[index, 0] - high_x, low_x - bounds[index, 2])
        apart_y = max(bounds[index, 1] - high_y, low_y - bounds[index, 3])
        if occupancy[index] != CLEAR and not max(apart_x, apart_y) > best + SLACK:
            ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
            distance, gap = _ring_gap(footprint, ring)
            if distance < best:
                found, best, best_gap = index, distance, gap
    return found, best_gap


def keep_one_overlap(
    objects: Objects,
    occupancy: IntArray,
    footprint: FloatArray,
    trees: dict[tuple[int, ...], shapely.STRtree],
) -> None:
    """Keep one of the objects that the footprint (4, 2) overlaps; the others become CLEAR.

    No entry of `occupancy` (M,) may be UNDECIDED. `trees` keeps the indices of these objects.
    """
    # nuPlan rule 159: the index of what is in the corridor answers with the first that it finds
    present, xy, ptr = tuple(np.flatnonzero(occupancy != CLEAR).tolist()), objects.xy, objects.ptr
    if present not in trees:
        trees[present] = shapely.STRtree(
            [shapely.Polygon(xy[ptr[i] : ptr[i + 1]]) for i in present]
        )
    lead = present[trees[present].nearest(shapely.polygons(footprint))]
    overlapping = np.flatnonzero(occupancy == OVERLAPPING)
    occupancy[overlapping[overlapping != lead]] = CLEAR


@kernel
def _ring_gap(a: FloatArray, b: FloatArray) -> tuple[float, float]:
    """Distance between a box and a ring, and the same measured between their nearest points [m].

    They do not touch.
    """
    # nuPlan rule 154: the gap is the latter, and the nearest point on an edge is rounded to what a
    # coordinate in UTM can hold; hence not `ring_distance`
    reach = distance_bound(a, b)
    low_x, low_y, high_x, high_y = ring_bounds(a)
    low_x, low_y, high_x, high_y = low_x - reach, low_y - reach, high_x + reach, high_y + reach
    best, gap = np.inf, np.inf
    # from the vertices of the box to the edges of the ring, then the other way round; on ties the
    # first pair counts
    for i in range(len(a)):
        before = len(b) - 1
        for j in range(len(b)):
            cx, cy, dx, dy = b[before, 0], b[before, 1], b[j, 0], b[j, 1]
            if not (
                max(cx, dx) < low_x
                or min(cx, dx) > high_x
                or max(cy, dy) < low_y
                or min(cy, dy) > high_y
            ):
                distance = point_segment_distance(a[i, 0], a[i, 1], cx, cy, dx, dy)
                if distance < best:
                    best, gap = distance, _gap_to_edge(a[i], b[before], b[j])
            before = j
    for i in range(len(b)):
        x, y = b[i, 0], b[i, 1]
        if low_x <= x <= high_x and low_y <= y <= high_y:
            for j in range(len(a)):
                cx, cy, dx, dy = a[j - 1, 0], a[j - 1, 1], a[j, 0], a[j, 1]
                distance = point_segment_distance(x, y, cx, cy, dx, dy)
                if distance < best:
                    best, gap = distance, _gap_to_edge(b[i], a[j - 1], a[j])
    return best, gap


@kernel
def _gap_to_edge(p: FloatArray, a: FloatArray, b: FloatArray) -> float:
    """Distance from a point p to the rounded point of the segment a-b that is nearest to it [m]."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    square = dx * dx + dy * dy
    along = ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / square if square > 0.0 else 0.0
    along = min(max(along, 0.0), 1.0)
    x = b[0] if along == 1.0 else a[0] + along * dx
    y = b[1] if along == 1.0 else a[1] + along * dy
    return np.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2)
