"""Lanes of a route: which there are, which are red, and which one a pose is on or nearest to."""

from collections.abc import Iterable, Mapping

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.geometry.polylines import nearest_vertex, vertex_heading
from shiftsim.geometry.rings import ring_distance
from shiftsim.world.layers import Polylines, contains
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


def lane_at(
    road: VectorMap, lanes: IntArray, center: FloatArray, length: float, width: float
) -> int:
    """The first lane that holds the centre of a box, else the one nearest to the box.

    Args:
        road: The map.
        lanes: Lanes and connectors that count, at least one.
        center: (3,) centre of the box x [m], y [m], heading [rad].
        length: Of the box [m].
        width: Of the box [m].
    """
    x, y, heading = center
    bounds = road.edges.polygons.bounds[lanes]
    away_x = np.maximum(np.maximum(bounds[:, 0] - x, x - bounds[:, 2]), 0.0)
    away_y = np.maximum(np.maximum(bounds[:, 1] - y, y - bounds[:, 3]), 0.0)
    away = np.hypot(away_x, away_y)
    for lane in lanes[away == 0.0].tolist():
        if contains(road.edges.polygons, lane, x, y):
            return int(lane)
    footprint = np.empty((4, 2))
    box_corners(x, y, heading, length, width, footprint)
    best = (np.inf, 0)  # the first one on ties
    for place in np.argsort(away).tolist():
        if away[place] > best[0] + 0.51 * np.hypot(length, width):
            break
        ring = road.edges.rings(lanes[place])[0].copy()  # read-only ones would need a kernel more
        best = min(best, (float(ring_distance(footprint, ring)), place))
    return int(lanes[best[1]])
