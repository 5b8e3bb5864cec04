"""Lanes of a route: which there are, which are red, and which one a pose is on or nearest to."""

from collections.abc import Iterable, Mapping

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.geometry.polylines import nearest_vertex, vertex_heading
from shiftsim.geometry.rings import ring_distance
from shiftsim.world.layers import Polygons, Polylines, contains
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import LightStatus

HINT = "correct the route of the scenario, or leave it out"  # of errors about routes


def lanes_of(road: VectorMap, blocks: Iterable[int]) -> list[int]:
    """Lanes and connectors of blocks, in their order; blocks that are NONE are passed over."""
    return [e for block in blocks if block != NONE for e in road.block_edges.at(block).tolist()]


def red_lanes(road: VectorMap, lights: Mapping[str, LightStatus]) -> list[int]:
    """Lanes and connectors of the map whose light is red, in the order of the lights."""
    red = [name for name, status in lights.items() if status == LightStatus.RED]
    return [road.edges.index[name] for name in red if name in road.edges.index]


@lean_kernel
def deviation(
    baselines: Polylines, lane: int, stride: int, x: float, y: float, heading: float
) -> tuple[float, float]:
    """Distance [m] to the nearest of every `stride`-th vertex of a baseline, and heading error."""
    # nuPlan rule 180: to vertices, not to the line between them
    start, stop = baselines.ptr[lane], baselines.ptr[lane + 1]
    found, distance = nearest_vertex(baselines.xy, start, stop, stride, x, y)
    return distance, abs(wrap_angle(vertex_heading(baselines.xy, found, stop) - heading))


@kernel
def lane_at(
    polygons: Polygons, lanes: IntArray, center: FloatArray, length: float, width: float
) -> int:
    """The first lane that holds the centre of a box, else the one nearest to the box.

    Args:
        polygons: Areas of lanes and connectors.
        lanes: Those that count, at least one.
        center: (3,) centre of the box x [m], y [m], heading [rad].
        length: Of the box [m].
        width: Of the box [m].
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
        distance = ring_distance(footprint, ring)
        if distance < best:
            best, found = distance, lane
    return found
