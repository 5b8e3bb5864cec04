"""The drivable area that proposals are scored on: lanes and connectors, and car parks.

nuPlan puts them into a new spatial index at every step. Here a step names the areas that belong to
it. Every ring is sliced into horizontal slabs that list the edges in them, so that a
point-in-polygon test looks at the few edges that its ray can cross.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.rings import SLACK, ray_crossings
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.per_map import PerMap
from shiftsim.world.layers import Lists, Polygons, index_polygons, meeting, square_around
from shiftsim.world.map import VectorMap

EDGES_PER_SLAB = 2  # on average, if none spanned several
_NOTHING = np.empty((2, 0))
NODE_CAPACITY = 10  # of nuPlan's spatial indices


class ScanlineIndex(NamedTuple):
    """Areas sliced into horizontal slabs, each with the edges in it. M areas, S slabs, E edges."""

    bounds: FloatArray  # (M, 4) of the areas: min x, min y, max x, max y [m]
    scale: FloatArray  # (M,) slabs per metre
    slab_ptr: IntArray  # (M + 1,) first slab of each area, the lowest one
    edge_ptr: IntArray  # (S + 1,) first edge of each slab
    ends: FloatArray  # (2 E, 2) start and end of each edge in turn [m]
    # (S, 4) x within each slab: up to which and from which all is outside (first and last), and
    # between which all is inside [m]
    spans: FloatArray


class Areas(NamedTuple):
    """Areas of all lanes and connectors of a map, then of its car parks."""

    polygons: Polygons  # the areas
    slabs: ScanlineIndex  # the same, to find out what they hold
    on_route: BoolArray  # (M,) whether the route holds a lane of that id
    lane: IntArray  # (M,) the lane of that id; for a car park usually -1


def make_areas(road: VectorMap, route_lanes: list[int]) -> Areas:
    """Areas of a map, with the lanes of a route marked."""
    areas = _areas_on(road)
    return areas._replace(on_route=np.isin(areas.lane, np.array(route_lanes)))


def _make_unmarked(road: VectorMap) -> Areas:
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
    return areas_of(polygons, np.zeros(len(lane), np.bool_), lane)


_areas_on = PerMap(_make_unmarked)


def areas_of(polygons: Polygons, on_route: BoolArray, lane: IntArray) -> Areas:
    """Areas from polygons, and the fields of `Areas`."""
    num_slabs = np.diff(polygons.ring_ptr[polygons.poly_ptr]) // EDGES_PER_SLAB + 1
    slab_ptr = np.concatenate([[0], np.cumsum(num_slabs)])
    height = polygons.bounds[:, 3] - polygons.bounds[:, 1]
    scale = np.where(height > 0.0, num_slabs / np.where(height > 0.0, height, 1.0), 0.0)
    counts, fixed = np.zeros(slab_ptr[-1], np.int64), (polygons.bounds, scale, slab_ptr)
    _slice(
        polygons,
        ScanlineIndex(*fixed, counts, np.empty((0, 2)), np.empty((0, 4))),
        counts,
        _NOTHING,
    )
    edge_ptr = np.concatenate([[0], np.cumsum(counts)])
    ends, spans = np.empty((2 * edge_ptr[-1], 2)), np.empty((len(counts), 4))
    slabs, scratch = (
        ScanlineIndex(*fixed, edge_ptr, ends, spans),
        np.empty((2, counts.max(initial=0))),
    )
    _slice(polygons, slabs, edge_ptr[:-1].copy(), scratch)
    return Areas(polygons, slabs, on_route, lane)


@kernel
def _slice(polygons: Polygons, slabs: ScanlineIndex, fill: IntArray, scratch: FloatArray) -> None:
    """Add the edges of every slab to `fill`; write their ends and the spans, unless there are none.

    `scratch` (2, E) is for the edges of a slab.
    """
    xy, slab_ptr, scale, ends = polygons.xy, slabs.slab_ptr, slabs.scale, slabs.ends
    for area in range(len(scale)):
        low, last_slab = polygons.bounds[area, 1], slab_ptr[area + 1] - slab_ptr[area] - 1
        for ring in range(polygons.poly_ptr[area], polygons.poly_ptr[area + 1]):
            start, stop = polygons.ring_ptr[ring], polygons.ring_ptr[ring + 1]
            before = stop - 1
            for vertex in range(start, stop):
                bottom = min(xy[before, 1], xy[vertex, 1])
                top = max(xy[before, 1], xy[vertex, 1])
                first = min(int((bottom - low) * scale[area]), last_slab)
                last = min(int((top - low) * scale[area]), last_slab)
                for slab in range(slab_ptr[area] + first, slab_ptr[area] + last + 1):
                    edge = 2 * fill[slab]
                    for column in range(2 if len(ends) > 0 else 0):
                        ends[edge, column] = xy[before, column]
                        ends[edge + 1, column] = xy[vertex, column]
                    fill[slab] += 1
                before = vertex
    if len(slabs.spans) > 0:
        _span(slabs, scratch[0], scratch[1])


@kernel
def _span(slabs: ScanlineIndex, lows: FloatArray, highs: FloatArray) -> None:
    """Fill in the spans; `lows` and `highs` are scratch for the edges of a slab."""
    bounds, scale, slab_ptr, edge_ptr, ends, spans = slabs
    for area in range(len(scale)):
        height = 1.0 / scale[area] if scale[area] > 0.0 else 0.0
        for slab in range(slab_ptr[area], slab_ptr[area + 1]):
            bottom = bounds[area, 1] + (slab - slab_ptr[area]) * height
            first, count = edge_ptr[slab], edge_ptr[slab + 1] - edge_ptr[slab]
            spans[slab, 0], spans[slab, 3] = np.inf, -np.inf
            for edge in range(count):
                # least and greatest x where the edge is in the slab
                start = 2 * (first + edge)
                x, y, low, high = ends[start, 0], ends[start, 1], np.inf, -np.inf
                slope = (ends[start + 1, 0] - x) / (ends[start + 1, 1] - y)
                for end in range(2):
                    at, level = ends[start + end, 0], ends[start + end, 1]
                    if level < bottom - SLACK:
                        at = x + slope * (bottom - SLACK - y)
                    elif level > bottom + height + SLACK:
                        at = x + slope * (bottom + height + SLACK - y)
                    low, high = min(low, at), max(high, at)
                lows[edge], highs[edge] = low - SLACK, high + SLACK
                spans[slab, 0] = min(spans[slab, 0], lows[edge])
                spans[slab, 3] = max(spans[slab, 3], highs[edge])
            # the widest gap between edges, of those that are inside
            spans[slab, 1], spans[slab, 2] = np.inf, -np.inf
            middle, widest = bottom + 0.5 * height, 0.0
            for edge in range(count):
                left, right, is_inside = highs[edge], np.inf, False
                for other in range(count):
                    if lows[other] > left:
                        right = min(right, lows[other])
                        start = 2 * (first + other)
                        is_above = ends[start, 1] > middle
                        is_inside = is_inside != (is_above != (ends[start + 1, 1] > middle))
                    elif highs[other] > left:
                        right = left  # there is no gap
                if is_inside and right - left > widest:
                    spans[slab, 1], spans[slab, 2], widest = left, right, right - left


def select_areas(road: VectorMap, x: float, y: float, half_width: float) -> IntArray:
    """Areas of the blocks and the car parks that touch a square around (x, y) [m], in their order.

    Lanes come by block, in the order of the blocks.
    """
    lanes: IntArray = _select(road.blocks.polygons, road.block_edges, x, y, half_width)
    if not len(road.car_parks):
        return lanes
    parks = meeting(road.car_parks.polygons, square_around(x, y, half_width))
    return np.concatenate([lanes, parks + len(road.edges)])


@kernel
def _select(
    blocks: Polygons, block_edges: Lists, x: float, y: float, half_width: float
) -> IntArray:
    """Lanes of the blocks that touch a square."""
    near, count = meeting(blocks, square_around(x, y, half_width)), 0
    for block in near:
        count += block_edges.ptr[block + 1] - block_edges.ptr[block]
    out, count = np.empty(count, np.int64), 0
    for block in near:
        for entry in range(block_edges.ptr[block], block_edges.ptr[block + 1]):
            out[count] = block_edges.items[entry]
            count += 1
    return out


@kernel
def held_points(
    slabs: ScanlineIndex, area: int, points: FloatArray, first: int, stop: int
) -> tuple[int, int]:
    """Which of some points (K, 2) lie in the interior of an area, which on its boundary: bits."""
    bounds, scale, slab_ptr, edge_ptr, ends, spans = slabs
    inside = on_boundary = 0
    for point in range(first, stop):
        x, y, bit = points[point, 0], points[point, 1], 1 << point
        if not (
            bounds[area, 0] <= x <= bounds[area, 2] and bounds[area, 1] <= y <= bounds[area, 3]
        ):
            continue  # also where a coordinate is NaN
        slab = slab_ptr[area] + int((y - bounds[area, 1]) * scale[area])
        slab = min(slab, slab_ptr[area + 1] - 1)
        if spans[slab, 1] < x < spans[slab, 2]:
            inside |= bit
            continue
        if x < spans[slab, 0] or x > spans[slab, 3]:
            continue
        for edge in range(2 * edge_ptr[slab], 2 * edge_ptr[slab + 1], 2):
            ay, by = ends[edge, 1], ends[edge + 1, 1]
            if ay != y and by != y:  # nearly always
                if (ay > y) == (by > y):
                    continue
                ax, bx = ends[edge, 0], ends[edge + 1, 0]
                if ax < x and bx < x:
                    continue
                if ax > x and bx > x:
                    inside ^= bit
                    continue
            odd, on_edge = ray_crossings(ends, edge, edge + 1, edge + 2, x, y)
            if on_edge:
                on_boundary |= bit
                break
            if odd:
                inside ^= bit
    return inside & ~on_boundary, on_boundary


@kernel
def covering(slabs: ScanlineIndex, selected: IntArray, points: FloatArray, out: IntArray) -> int:
    """Write the selected areas that hold a point (1, 2), or have it on their boundary, into `out`.

    They keep their order; how many they are.
    """
    count = 0
    for area in selected:
        if held_points(slabs, area, points, 0, 1) != (0, 0):
            out[count] = area
            count += 1
    return count


def index_ranks(bounds: FloatArray) -> IntArray:
    """(M,) place of each box (M, 4) among the results of nuPlan's spatial index.

    The index is a packed tree that is walked depth first, so a query only leaves boxes out.
    """
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=NODE_CAPACITY)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    ranks = np.empty(len(bounds), np.int64)
    ranks[tree.query(shapely.box(*low, *high))] = np.arange(len(bounds))
    return ranks
