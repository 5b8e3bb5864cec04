"""The drivable area PDM-Closed knows: lanes and connectors of near blocks, and car parks (§5.4).

nuPlan puts them into a new spatial index at every step. Here a step names the areas that belong to
it. Every ring is sliced into horizontal slabs that list the edges in them, so that a
point-in-polygon test looks at the few edges that its ray can cross.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.rings import BOUNDARY, EXTERIOR, INTERIOR, ray_crossings
from shiftsim.world.layers import Lists, Polygons, index_polygons, meets_convex, square_around
from shiftsim.world.map import VectorMap

EDGES_PER_SLAB = 2  # on average, if none spanned several
NODE_CAPACITY = 10  # of nuPlan's spatial indices


class Areas(NamedTuple):
    """Areas of all edges of a map, then of its car parks.

    Attributes:
        polygons: The areas.
        rings: (R, 4) first vertex of each ring, one past its last, its first slab, number of slabs.
        slab_grid: (R, 2) y of the lowest slab [m], slabs per metre.
        edge_ptr: (S + 1,) first entry of each slab in `edge_ends`.
        edge_ends: Vertices at which the edges of a slab end.
        on_route: (M,) whether the route holds an edge of that id.
        edge: (M,) the edge of that id; for a car park usually -1.
    """

    polygons: Polygons
    rings: IntArray
    slab_grid: FloatArray
    edge_ptr: IntArray
    edge_ends: IntArray
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
    # nuPlan: membership is a test on ids, which car parks share with lanes (pdm-closed.md §11 Q11)
    parks = [road.edges.index.get(name, -1) for name in road.car_parks.ids]
    edge = np.concatenate([np.arange(len(road.edges)), np.array(parks, np.int64)])
    return areas_of(polygons, np.isin(edge, np.array(route_lanes)), edge)


def areas_of(polygons: Polygons, on_route: BoolArray, edge: IntArray) -> Areas:
    """Areas from polygons, and the fields of `Areas`."""
    starts, stops = polygons.ring_ptr[:-1], polygons.ring_ptr[1:]
    num_slabs = (stops - starts) // EDGES_PER_SLAB + 1
    rings = np.column_stack([starts, stops, np.cumsum(num_slabs) - num_slabs, num_slabs])
    slab_grid, counts = np.empty((len(rings), 2)), np.zeros(num_slabs.sum(), np.int64)
    _slice(polygons.xy, rings, slab_grid, counts, np.zeros(0, np.int64))
    edge_ptr = np.concatenate([[0], np.cumsum(counts)])
    edge_ends, fill = np.empty(edge_ptr[-1], np.int64), edge_ptr[:-1].copy()
    _slice(polygons.xy, rings, slab_grid, fill, edge_ends)
    return Areas(polygons, rings, slab_grid, edge_ptr, edge_ends, on_route, edge)


@lean_kernel
def _slice(
    xy: FloatArray, rings: IntArray, slab_grid: FloatArray, fill: IntArray, edge_ends: IntArray
) -> None:
    """Add the edges of every slab to `fill`, and write them to `edge_ends` where it has room."""
    for ring in range(len(rings)):
        start, stop, first_slab, num_slabs = rings[ring]
        low, high = np.inf, -np.inf
        for vertex in range(start, stop):
            low, high = min(low, xy[vertex, 1]), max(high, xy[vertex, 1])
        scale = num_slabs / (high - low) if high > low else 0.0
        slab_grid[ring, 0], slab_grid[ring, 1] = low, scale
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


def admit(road: VectorMap, areas: Areas, x: float, y: float, half_width: float) -> IntArray:
    """Areas of the blocks and the car parks that touch a square around (x, y) [m], in their order.

    Edges come by block, in the order of the blocks.
    """
    out = np.empty(len(areas.edge), np.int64)
    blocks, members = road.blocks.polygons, road.block_edges
    count = _admit(blocks, members, areas.polygons, len(road.edges), x, y, half_width, out)
    return out[:count]


@kernel
def _admit(
    blocks: Polygons,
    block_edges: Lists,
    polygons: Polygons,
    num_edges: int,
    x: float,
    y: float,
    half_width: float,
    out: IntArray,
) -> int:
    count = 0
    square = square_around(x, y, half_width)
    for layer in range(2):
        layer_polygons = blocks if layer == 0 else polygons
        bounds = layer_polygons.bounds
        for index in range(0 if layer == 0 else num_edges, len(bounds)):
            if (
                bounds[index, 0] > x + half_width
                or bounds[index, 2] < x - half_width
                or bounds[index, 1] > y + half_width
                or bounds[index, 3] < y - half_width
                or not meets_convex(layer_polygons, index, square)
            ):
                continue
            if layer == 1:
                out[count] = index
                count += 1
                continue
            for entry in range(block_edges.ptr[index], block_edges.ptr[index + 1]):
                out[count] = block_edges.items[entry]
                count += 1
    return count


@lean_kernel
def locate(
    slabs: tuple[FloatArray, IntArray, FloatArray, IntArray, IntArray],
    first: int,
    last: int,
    x: float,
    y: float,
) -> int:
    """Where a point lies relative to rings `first` … `last` - 1: INTERIOR, BOUNDARY or EXTERIOR.

    The point must be within their bounds. `slabs` are the vertices and the fields of `Areas` from
    `rings` to `edge_ends`; the whole of `Areas` takes longer to pass than to use.
    """
    xy, rings, slab_grid, edge_ptr, edge_ends = slabs
    inside = False
    for ring in range(first, last):
        place = (y - slab_grid[ring, 0]) * slab_grid[ring, 1]
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
def covering(areas: Areas, admitted: IntArray, x: float, y: float, out: IntArray) -> int:
    """Write the admitted areas that hold a point, boundary included, into `out`; their number.

    They are in the order of `admitted`; at most `len(out)` are found.
    """
    slabs = (areas.polygons.xy, areas.rings, areas.slab_grid, areas.edge_ptr, areas.edge_ends)
    bounds, poly_ptr = areas.polygons.bounds, areas.polygons.poly_ptr
    found = 0
    for area in admitted:
        if (
            x < bounds[area, 0]
            or y < bounds[area, 1]
            or x > bounds[area, 2]
            or y > bounds[area, 3]
            or found == len(out)
        ):
            continue
        if locate(slabs, poly_ptr[area], poly_ptr[area + 1], x, y) != EXTERIOR:
            out[found] = area
            found += 1
    return found


@kernel
def near_areas(areas: Areas, admitted: IntArray, points: FloatArray) -> IntArray:
    """Those of the admitted areas whose bounds overlap the bounds of points (..., 2)."""
    flat = points.reshape(-1, 2)
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for row in range(len(flat)):
        low_x, high_x = min(low_x, flat[row, 0]), max(high_x, flat[row, 0])
        low_y, high_y = min(low_y, flat[row, 1]), max(high_y, flat[row, 1])
    bounds = areas.polygons.bounds
    out = np.empty(len(admitted), np.int64)
    count = 0
    for area in admitted:
        if (
            bounds[area, 0] <= high_x
            and bounds[area, 2] >= low_x
            and bounds[area, 1] <= high_y
            and bounds[area, 3] >= low_y
        ):
            out[count] = area
            count += 1
    return out[:count]


@kernel
def cover_poses(
    areas: Areas,
    near: IntArray,
    corners: FloatArray,
    centers: FloatArray,
    off_road: BoolArray,
    oncoming: BoolArray,
) -> None:
    """Whether every pose of every proposal lies on the road, and on the route (§8.1).

    Args:
        areas: The areas.
        near: Those that count.
        corners: (P, T, 4, 2) corners of the ego [m].
        centers: (P, T, 2) its centres [m].
        off_road: (P, T) receives whether a corner is on no area.
        oncoming: (P, T) receives whether the centre is on no area of the route.
    """
    slabs = (areas.polygons.xy, areas.rings, areas.slab_grid, areas.edge_ptr, areas.edge_ends)
    bounds, poly_ptr = areas.polygons.bounds, areas.polygons.poly_ptr
    on_route = np.empty(len(near), np.int64)
    count = 0
    for area in near:
        if areas.on_route[area]:
            on_route[count] = area
            count += 1
    on_route = on_route[:count]
    last = np.full(5, -1)  # the area that held each point one step before is tried first
    for proposal in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            is_off = False
            for corner in range(4):
                x, y = corners[proposal, step, corner, 0], corners[proposal, step, corner, 1]
                last[corner] = _find_holder(slabs, bounds, poly_ptr, near, last[corner], x, y)
                is_off = is_off or last[corner] < 0
            off_road[proposal, step] = is_off
            x, y = centers[proposal, step, 0], centers[proposal, step, 1]
            last[4] = _find_holder(slabs, bounds, poly_ptr, on_route, last[4], x, y)
            oncoming[proposal, step] = last[4] < 0


@lean_kernel
def _find_holder(
    slabs: tuple[FloatArray, IntArray, FloatArray, IntArray, IntArray],
    bounds: FloatArray,
    poly_ptr: IntArray,
    near: IntArray,
    guess: int,
    x: float,
    y: float,
) -> int:
    """An area that holds a point in its interior, tried from `guess` on; -1 if none does."""
    for attempt in range(-1, len(near)):
        area = guess if attempt < 0 else near[attempt]
        if area < 0 or not (
            bounds[area, 0] <= x <= bounds[area, 2] and bounds[area, 1] <= y <= bounds[area, 3]
        ):
            continue  # also where a coordinate is NaN
        if locate(slabs, poly_ptr[area], poly_ptr[area + 1], x, y) == INTERIOR:
            return area
    return -1


@lean_kernel
def on_multiple_lanes(areas: Areas, near: IntArray, box: FloatArray) -> bool:
    """Whether the corners (4, 2) of the ego are on several areas, none of which has all (§8.1)."""
    slabs = (areas.polygons.xy, areas.rings, areas.slab_grid, areas.edge_ptr, areas.edge_ends)
    bounds, poly_ptr = areas.polygons.bounds, areas.polygons.poly_ptr
    num_touched = 0
    for entry in range(len(near)):
        num_held = 0
        for corner in range(4):
            x, y = box[corner, 0], box[corner, 1]
            this = near[entry : entry + 1]
            if _find_holder(slabs, bounds, poly_ptr, this, -1, x, y) >= 0:
                num_held += 1
        if num_held == 4:
            return False
        if num_held > 0:
            num_touched += 1
    return num_touched > 1


def index_ranks(bounds: FloatArray) -> IntArray:
    """(M,) place of each box (M, 4) among the results of nuPlan's spatial index.

    The index is a packed tree that is walked depth first, so a query only leaves boxes out.
    """
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=NODE_CAPACITY)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    ranks = np.empty(len(bounds), np.int64)
    ranks[tree.query(shapely.box(*low, *high))] = np.arange(len(bounds))
    return ranks
