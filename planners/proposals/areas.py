"""The drivable area that proposals are scored on: lanes and connectors, and car parks.

nuPlan puts them into a new spatial index at every step. Here a step names the areas that belong to
it. Every ring is sliced into horizontal slabs that list the edges in them, so that a
point-in-polygon test looks at the few edges that its ray can cross.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, lean_kernel
from shiftsim.geometry.rings import BOUNDARY, EXTERIOR, INTERIOR, ray_crossings
from shiftsim.world.layers import Polygons, index_polygons, meeting, square_around
from shiftsim.world.map import VectorMap

EDGES_PER_SLAB = 2  # on average, if none spanned several
NODE_CAPACITY = 10  # of nuPlan's spatial indices


class Slabs(NamedTuple):
    """Rings sliced into horizontal slabs. R rings, S slabs."""

    xy: FloatArray  # (V, 2) vertices of all rings [m]
    # (R, 4) first vertex of each ring, one past its last, its first slab, number of slabs
    rings: IntArray
    grid: FloatArray  # (R, 2) y of the lowest slab [m], slabs per metre
    edge_ptr: IntArray  # (S + 1,) first entry of each slab in `edge_ends`
    edge_ends: IntArray  # vertices at which the edges of a slab end
    poly_ptr: IntArray  # (M + 1,) first ring of each area
    bounds: FloatArray  # (M, 4) of the areas: min x, min y, max x, max y [m]


class Areas(NamedTuple):
    """Areas of all lanes and connectors of a map, then of its car parks."""

    polygons: Polygons  # the areas
    slabs: Slabs  # their rings
    on_route: BoolArray  # (M,) whether the route holds a lane of that id
    lane: IntArray  # (M,) the lane of that id; for a car park usually -1


def make_areas(road: VectorMap, route_lanes: list[int]) -> Areas:
    """Areas of a map, with the lanes of a route marked."""
    first, second = road.edges.polygons, road.car_parks.polygons
    polygons = first
    if len(road.car_parks):
        polygons = index_polygons(
            np.concatenate([first.xy, second.xy]),
            np.concatenate([first.ring_ptr, second.ring_ptr[1:] + len(first.xy)]),
            np.concatenate([first.poly_ptr, second.poly_ptr[1:] + len(first.ring_ptr) - 1]),
        )
    # nuPlan rule 181: membership is a test on ids, which car parks may share with lanes
    parks = [road.edges.index.get(name, -1) for name in road.car_parks.ids]
    lane = np.concatenate([np.arange(len(road.edges)), np.array(parks, np.int64)])
    return areas_of(polygons, np.isin(lane, np.array(route_lanes)), lane)


def areas_of(polygons: Polygons, on_route: BoolArray, lane: IntArray) -> Areas:
    """Areas from polygons, and the fields of `Areas`."""
    starts, stops = polygons.ring_ptr[:-1], polygons.ring_ptr[1:]
    num_slabs = (stops - starts) // EDGES_PER_SLAB + 1
    rings = np.column_stack([starts, stops, np.cumsum(num_slabs) - num_slabs, num_slabs])
    grid, counts = np.empty((len(rings), 2)), np.zeros(num_slabs.sum(), np.int64)
    _slice(polygons.xy, rings, grid, counts, np.zeros(0, np.int64))
    edge_ptr = np.concatenate([[0], np.cumsum(counts)])
    edge_ends, fill = np.empty(edge_ptr[-1], np.int64), edge_ptr[:-1].copy()
    _slice(polygons.xy, rings, grid, fill, edge_ends)
    slabs = Slabs(polygons.xy, rings, grid, edge_ptr, edge_ends, polygons.poly_ptr, polygons.bounds)
    return Areas(polygons, slabs, on_route, lane)


@lean_kernel
def _slice(
    xy: FloatArray, rings: IntArray, grid: FloatArray, fill: IntArray, edge_ends: IntArray
) -> None:
    """Add the edges of every slab to `fill`, and write them to `edge_ends` unless that is empty."""
    for ring in range(len(rings)):
        start, stop, first_slab, num_slabs = rings[ring]
        low, high = np.inf, -np.inf
        for vertex in range(start, stop):
            low, high = min(low, xy[vertex, 1]), max(high, xy[vertex, 1])
        scale = num_slabs / (high - low) if high > low else 0.0
        grid[ring, 0], grid[ring, 1] = low, scale
        before = stop - 1
        for vertex in range(start, stop):
            bottom = min(xy[before, 1], xy[vertex, 1])
            top = max(xy[before, 1], xy[vertex, 1])
            first = min(int((bottom - low) * scale), num_slabs - 1)
            last = min(int((top - low) * scale), num_slabs - 1)
            for slab in range(first_slab + first, first_slab + last + 1):
                if len(edge_ends) > 0:
                    edge_ends[fill[slab]] = vertex
                fill[slab] += 1
            before = vertex


def select_areas(road: VectorMap, x: float, y: float, half_width: float) -> IntArray:
    """Areas of the blocks and the car parks that touch a square around (x, y) [m], in their order.

    Lanes come by block, in the order of the blocks.
    """
    square = square_around(x, y, half_width)
    lanes = [road.block_edges.at(block) for block in meeting(road.blocks.polygons, square)]
    return np.concatenate([*lanes, meeting(road.car_parks.polygons, square) + len(road.edges)])


def near_areas(areas: Areas, selected: IntArray, points: FloatArray) -> IntArray:
    """Those of the selected areas whose bounds overlap the bounds of points (..., 2)."""
    (x, y), bounds = points.reshape(-1, 2).T, areas.slabs.bounds[selected]
    near = (bounds[:, 0] <= x.max()) & (bounds[:, 2] >= x.min())
    near &= (bounds[:, 1] <= y.max()) & (bounds[:, 3] >= y.min())
    return selected[near]


@lean_kernel
def locate(slabs: Slabs, area: int, x: float, y: float) -> int:
    """Where a point lies relative to an area: INTERIOR, BOUNDARY or EXTERIOR."""
    xy, rings, grid, edge_ptr, edge_ends, poly_ptr, bounds = slabs
    if not (bounds[area, 0] <= x <= bounds[area, 2] and bounds[area, 1] <= y <= bounds[area, 3]):
        return EXTERIOR  # also where a coordinate is NaN
    inside = False
    for ring in range(poly_ptr[area], poly_ptr[area + 1]):
        place = (y - grid[ring, 0]) * grid[ring, 1]
        if not place >= 0.0:
            continue
        start, stop = rings[ring, 0], rings[ring, 1]
        slab = rings[ring, 2] + min(int(place), rings[ring, 3] - 1)
        for entry in range(edge_ptr[slab], edge_ptr[slab + 1]):
            end = edge_ends[entry]
            before = end - 1 if end > start else stop - 1
            ay, by = xy[before, 1], xy[end, 1]
            if ay != y and by != y:  # nearly always
                if (ay > y) == (by > y):
                    continue
                ax, bx = xy[before, 0], xy[end, 0]
                if ax < x and bx < x:
                    continue
                if ax > x and bx > x:
                    inside = not inside
                    continue
            odd, on_edge = ray_crossings(xy, before, end, end + 1, x, y)
            if on_edge:
                return BOUNDARY
            if odd:
                inside = not inside
    return INTERIOR if inside else EXTERIOR


@lean_kernel
def covering(areas: Areas, selected: IntArray, x: float, y: float, out: IntArray) -> int:
    """Write the selected areas that hold a point, boundary included, into `out`; their number.

    They are in the order of `selected`; at most `len(out)` are found.
    """
    found = 0
    for area in selected:
        if found < len(out) and locate(areas.slabs, area, x, y) != EXTERIOR:
            out[found] = area
            found += 1
    return found


def index_ranks(bounds: FloatArray) -> IntArray:
    """(M,) place of each box (M, 4) among the results of nuPlan's spatial index.

    The index is a packed tree that is walked depth first, so a query only leaves boxes out.
    """
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=NODE_CAPACITY)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    ranks = np.empty(len(bounds), np.int64)
    ranks[tree.query(shapely.box(*low, *high))] = np.arange(len(bounds))
    return ranks
