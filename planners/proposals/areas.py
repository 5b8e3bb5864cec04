"""The drivable area that proposals are scored on: lanes and connectors, and car parks.

nuPlan puts them into a new spatial index at every step. Here a step names the areas that belong to
it. Every ring is sliced into horizontal slabs that list the edges in them, so that a
point-in-polygon test looks at the few edges that its ray can cross.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import meets_bounds
from shiftsim.geometry.rings import BOUNDARY, EXTERIOR, INTERIOR, ray_crossings
from shiftsim.world.layers import Polygons, index_polygons, meeting, square_around
from shiftsim.world.map import VectorMap

EDGES_PER_SLAB = 2  # on average, if none spanned several
NODE_CAPACITY = 10  # of nuPlan's spatial indices
MULTIPLE, OFF_ROAD, OFF_ROUTE = 0, 1, 2  # flags of a pose
_ALL_CORNERS, _WHOLE = 0b1111, 0b11111  # corners on some area; all of them on one


class Slabs(NamedTuple):
    """Rings sliced into horizontal slabs. R rings, S slabs.

    Attributes:
        xy: (V, 2) vertices of all rings [m].
        rings: (R, 4) first vertex of each ring, one past its last, its first slab, number of slabs.
        grid: (R, 2) y of the lowest slab [m], slabs per metre.
        edge_ptr: (S + 1,) first entry of each slab in `edge_ends`.
        edge_ends: Vertices at which the edges of a slab end.
    """

    xy: FloatArray
    rings: IntArray
    grid: FloatArray
    edge_ptr: IntArray
    edge_ends: IntArray


class Areas(NamedTuple):
    """Areas of all edges of a map, then of its car parks.

    Attributes:
        polygons: The areas.
        slabs: Their rings.
        on_route: (M,) whether the route holds an edge of that id.
        edge: (M,) the edge of that id; for a car park usually -1.
    """

    polygons: Polygons
    slabs: Slabs
    on_route: BoolArray
    edge: IntArray


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
    edge = np.concatenate([np.arange(len(road.edges)), np.array(parks, np.int64)])
    return areas_of(polygons, np.isin(edge, np.array(route_lanes)), edge)


def areas_of(polygons: Polygons, on_route: BoolArray, edge: IntArray) -> Areas:
    """Areas from polygons, and the fields of `Areas`."""
    starts, stops = polygons.ring_ptr[:-1], polygons.ring_ptr[1:]
    num_slabs = (stops - starts) // EDGES_PER_SLAB + 1
    rings = np.column_stack([starts, stops, np.cumsum(num_slabs) - num_slabs, num_slabs])
    grid, counts = np.empty((len(rings), 2)), np.zeros(num_slabs.sum(), np.int64)
    _slice(polygons.xy, rings, grid, counts, np.zeros(0, np.int64))
    edge_ptr = np.concatenate([[0], np.cumsum(counts)])
    edge_ends, fill = np.empty(edge_ptr[-1], np.int64), edge_ptr[:-1].copy()
    _slice(polygons.xy, rings, grid, fill, edge_ends)
    return Areas(polygons, Slabs(polygons.xy, rings, grid, edge_ptr, edge_ends), on_route, edge)


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

    Edges come by block, in the order of the blocks.
    """
    square = square_around(x, y, half_width)
    edges = [road.block_edges.at(block) for block in meeting(road.blocks.polygons, square)]
    return np.concatenate([*edges, meeting(road.car_parks.polygons, square) + len(road.edges)])


def near_areas(areas: Areas, selected: IntArray, points: FloatArray) -> IntArray:
    """Those of the selected areas whose bounds overlap the bounds of points (..., 2)."""
    (x, y), bounds = points.reshape(-1, 2).T, areas.polygons.bounds[selected]
    near = (bounds[:, 0] <= x.max()) & (bounds[:, 2] >= x.min())
    near &= (bounds[:, 1] <= y.max()) & (bounds[:, 3] >= y.min())
    return selected[near]


@lean_kernel
def _locate(slabs: Slabs, first: int, last: int, x: float, y: float) -> int:
    """Where a point lies relative to rings `first` … `last` - 1: INTERIOR, BOUNDARY or EXTERIOR.

    The point must be within their bounds.
    """
    xy, rings, grid, edge_ptr, edge_ends = slabs
    inside = False
    for ring in range(first, last):
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
    bounds, poly_ptr = areas.polygons.bounds, areas.polygons.poly_ptr
    found = 0
    for area in selected:
        if found < len(out) and _in_bounds(bounds[area], x, y):
            if _locate(areas.slabs, poly_ptr[area], poly_ptr[area + 1], x, y) != EXTERIOR:
                out[found] = area
                found += 1
    return found


@kernel
def find_places(
    areas: Areas,
    near: IntArray,
    limits: FloatArray,
    corners: FloatArray,
    points: FloatArray,
    flags: BoolArray,
    speed_limits: FloatArray,
) -> None:
    """On which areas every pose of every proposal is.

    Args:
        areas: All areas of the map.
        near: Those that count.
        limits: (M,) speed limits of all areas [m/s].
        corners: (P, T, 4, 2) corners of the ego [m].
        points: (P, T, 2) where the ego is on the route or off it, and which limit it has [m].
        flags: (P, T, 3) receives whether the ego is on several lanes, off the road, off the route.
        speed_limits: (P, T) receives the largest limit at its point, 0 off the road [m/s].
    """
    slabs, bounds, poly_ptr = areas.slabs, areas.polygons.bounds, areas.polygons.poly_ptr
    highest = 0.0
    for area in near:
        highest = max(highest, limits[area])
    guess = -1  # the area that held the whole ego last is tried first
    for row in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            box = corners[row, step]
            x, y = points[row, step, 0], points[row, step, 1]
            num_touched, held, is_on_route, limit = 0, 0, False, 0.0
            for entry in range(-1, len(near)):
                area = guess if entry < 0 else near[entry]
                if area < 0 or (entry >= 0 and area == guess):
                    continue
                is_known = is_on_route and limit >= highest
                if (held == _WHOLE and is_known) or not meets_bounds(box, bounds[area]):
                    continue
                first, last = poly_ptr[area], poly_ptr[area + 1]
                if not is_known and _holds(slabs, bounds[area], first, last, x, y):
                    limit = max(limit, limits[area])
                    is_on_route = is_on_route or areas.on_route[area]
                if held == _WHOLE:
                    continue
                only_whole = num_touched > 1 and held == _ALL_CORNERS  # may change anything
                within = _corners_within(slabs, bounds[area], first, last, box, only_whole)
                if within == _ALL_CORNERS:
                    held, guess = _WHOLE, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            flags[row, step, MULTIPLE] = num_touched > 1 and held != _WHOLE
            flags[row, step, OFF_ROAD] = held != _WHOLE and held != _ALL_CORNERS
            flags[row, step, OFF_ROUTE] = not is_on_route
            speed_limits[row, step] = limit


@lean_kernel
def _corners_within(
    slabs: Slabs, bounds: FloatArray, first: int, last: int, box: FloatArray, only_all: bool
) -> int:
    """Which corners of a box (4, 2) the rings `first` … `last` - 1 hold, a bit for each.

    With `only_all` the search ends at the first corner that they do not hold.
    """
    within = 0
    for corner in range(4):
        if _holds(slabs, bounds, first, last, box[corner, 0], box[corner, 1]):
            within |= 1 << corner
        elif only_all:
            return 0
    return within


@lean_kernel
def _holds(slabs: Slabs, bounds: FloatArray, first: int, last: int, x: float, y: float) -> bool:
    """Whether the rings `first` … `last` - 1 hold a point in their interior."""
    return _in_bounds(bounds, x, y) and _locate(slabs, first, last, x, y) == INTERIOR


@lean_kernel
def _in_bounds(bounds: FloatArray, x: float, y: float) -> bool:
    return bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]


def index_ranks(bounds: FloatArray) -> IntArray:
    """(M,) place of each box (M, 4) among the results of nuPlan's spatial index.

    The index is a packed tree that is walked depth first, so a query only leaves boxes out.
    """
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=NODE_CAPACITY)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    ranks = np.empty(len(bounds), np.int64)
    ranks[tree.query(shapely.box(*low, *high))] = np.arange(len(bounds))
    return ranks
