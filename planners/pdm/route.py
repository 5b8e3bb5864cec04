"""The lanes PDM-Closed follows: current lane, search along the route, centerline (§4)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.geometry.rings import (
    EXTERIOR,
    locate_in_ring,
    point_segment_distance,
    segments_intersect,
)
from shiftsim.world.layers import Polygons, Polylines, contains
from shiftsim.world.map import NONE, VectorMap

SEARCH_DEPTH = 30  # blocks of the route the centerline covers
START_COST = 1.0  # nuPlan: the first lane costs 1, whatever its length


@dataclass(frozen=True, slots=True)
class Lanes:
    """Result of a search along lanes.

    Attributes:
        edges: Lanes in driving order.
        found: Whether they lead to the goal.
    """

    edges: list[int]
    found: bool


@lean_kernel
def nearest_vertex(
    baselines: Polylines, edge: int, x: float, y: float, heading: float
) -> tuple[float, float]:
    """Distance [m] to the nearest vertex of a baseline, and the heading error there [rad].

    nuPlan: vertices, not the line between them; the last vertex has the heading of the one before
    it (pdm-closed.md §11 Q18).
    """
    start, stop = baselines.ptr[edge], baselines.ptr[edge + 1]
    best, found = np.inf, start
    for index in range(start, stop):
        distance = np.hypot(baselines.xy[index, 0] - x, baselines.xy[index, 1] - y)
        if distance < best:
            best, found = distance, index
    at = min(found, stop - 2)
    direction = np.arctan2(
        baselines.xy[at + 1, 1] - baselines.xy[at, 1], baselines.xy[at + 1, 0] - baselines.xy[at, 0]
    )
    return best, abs(wrap_angle(direction - heading))


def vertex_poses(baseline: FloatArray) -> FloatArray:
    """Vertices (K, 2) with the heading to the next one, (K, 3); the last repeats the one before."""
    step = np.diff(baseline, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.column_stack([baseline, np.append(heading, heading[-1])])


def centerline(road: VectorMap, edges: Iterable[int]) -> FloatArray:
    """Poses (K, 3) along the baselines of lanes x [m], y [m], heading [rad]."""
    return np.concatenate([vertex_poses(road.baselines.at(edge)) for edge in edges])


def follow_route(road: VectorMap, route: list[int], current: int) -> Lanes:
    """Lanes from the current one to the end of the route, or of its next 30 blocks (§4.2)."""
    block = int(road.block_of[current])
    # nuPlan: a lane whose block is not on the route starts at its first block (§11 Q20)
    start = route.index(block) if block in route else 0
    goal = route[start : start + SEARCH_DEPTH][-1]
    allowed = {edge for block in route for edge in road.block_edges.at(block).tolist()}
    lines = road.baselines
    return search_lanes(
        current,
        lambda edge: [e for e in road.outgoing.at(edge).tolist() if e in allowed],
        lines.length,
        lambda edge: bool(road.block_of[edge] == goal),
    )


def search_lanes(
    start: int,
    neighbours: Callable[[int], Iterable[int]],
    length: Callable[[int], float],
    is_goal: Callable[[int], bool],
) -> Lanes:
    """Dijkstra's search with an open list; the first of equal costs is expanded first."""
    opened, cost, parent = [start], {start: START_COST}, {start: NONE}
    depth = {start: 1}
    expanded: list[int] = []
    while opened:
        edge = min(opened, key=cost.__getitem__)
        opened.remove(edge)
        if is_goal(edge):
            return Lanes(_trace(parent, edge), True)
        expanded.append(edge)
        for after in neighbours(edge):
            total = cost[edge] + length(after)
            if after in cost and (after not in opened or total >= cost[after]):
                continue
            if after not in opened:
                opened.append(after)
            cost[after], parent[after], depth[after] = total, edge, depth[edge] + 1
    deepest = max(depth[edge] for edge in expanded)
    end = min((edge for edge in expanded if depth[edge] == deepest), key=cost.__getitem__)
    return Lanes(_trace(parent, end), False)


def _trace(parent: dict[int, int], edge: int) -> list[int]:
    edges = [edge]
    while parent[edges[-1]] != NONE:
        edges.append(parent[edges[-1]])
    return edges[::-1]


@kernel
def lane_off_road(
    polygons: Polygons, lanes: IntArray, center: FloatArray, length: float, width: float
) -> int:
    """The lane of a route nearest to an ego that is on none of them (§4.1).

    Args:
        polygons: Areas of lanes and connectors.
        lanes: Lanes of the route in order, at least one.
        center: (3,) centre of the ego x [m], y [m], heading [rad].
        length: Of the ego [m].
        width: Of the ego [m].
    """
    footprint = np.empty((4, 2))
    box_corners(center[0], center[1], center[2], length, width, footprint)
    best, found = np.inf, lanes[0]
    for lane in lanes:
        if contains(polygons, lane, center[0], center[1]):
            return lane
    radius = 0.5 * np.hypot(length, width)
    for lane in lanes:
        dx = max(polygons.bounds[lane, 0] - center[0], 0.0, center[0] - polygons.bounds[lane, 2])
        dy = max(polygons.bounds[lane, 1] - center[1], 0.0, center[1] - polygons.bounds[lane, 3])
        if np.hypot(dx, dy) > best + 1.001 * radius:
            continue
        shell = polygons.poly_ptr[lane]
        # a copy, since map arrays are read-only and would need kernels of their own
        ring = polygons.xy[polygons.ring_ptr[shell] : polygons.ring_ptr[shell + 1]].copy()
        distance = box_to_ring(footprint, ring)
        if distance < best:
            best, found = distance, lane
    return found


@lean_kernel
def box_to_ring(box: FloatArray, ring: FloatArray) -> float:
    """Distance between a box (4, 2) and the area of a simple ring (V, 2); 0 when they touch [m]."""
    if locate_in_ring(ring, box[0, 0], box[0, 1]) != EXTERIOR:
        return 0.0
    if locate_in_ring(box, ring[0, 0], ring[0, 1]) != EXTERIOR:
        return 0.0
    best = np.inf
    for i in range(4):
        for j in range(len(ring)):
            a, b, c, d = box[i - 1], box[i], ring[j - 1], ring[j]
            if segments_intersect(a, b, c, d):
                return 0.0
            best = min(best, point_segment_distance(b[0], b[1], c[0], c[1], d[0], d[1]))
            best = min(best, point_segment_distance(d[0], d[1], a[0], a[1], b[0], b[1]))
    return best
