"""The drivable area PDM-Closed knows: lanes and connectors of near blocks, and car parks (§5.4).

nuPlan puts them into a new spatial index at every step. Here a grid over the whole map is kept, and
a step marks the areas that belong to it. Edges of a ring are grouped in runs with bounds, so that
a point-in-polygon test looks at the few that its ray can cross.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry import (
    BOUNDARY,
    EXTERIOR,
    INTERIOR,
    locate_in_polygon,
    ray_crossings,
    segments_intersect,
)
from shiftsim.layers import Lists, Polygons, index_polygons
from shiftsim.map import VectorMap

RUN = 8  # edges of a ring per bound
MAX_HOLDERS = 16  # areas over one point; more are not told apart
NODE_CAPACITY = 10  # of nuPlan's spatial indices


class Areas(NamedTuple):
    """Areas of all edges of a map, then of its car parks.

    Attributes:
        polygons: The areas.
        run_ptr: (R + 1,) first run of each ring.
        runs: (C, 3) min y, max y, max x of each run of edges [m].
        on_route: (M,) whether the route holds an edge of that id.
        edge: (M,) the edge of that id; for a car park usually -1.
    """

    polygons: Polygons
    run_ptr: IntArray
    runs: FloatArray
    on_route: BoolArray
    edge: IntArray


class Admitted(NamedTuple):
    """The areas of one step.

    Attributes:
        mask: (M,) whether an area belongs to the step.
        order: Their indices in nuPlan's order.
    """

    mask: BoolArray
    order: IntArray


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
    run_ptr, runs = _bound_runs(polygons.xy, polygons.ring_ptr)
    return Areas(polygons, run_ptr, runs, np.isin(edge, np.array(route_lanes)), edge)


@kernel
def _bound_runs(xy: FloatArray, ring_ptr: IntArray) -> tuple[IntArray, FloatArray]:
    num_rings = len(ring_ptr) - 1
    run_ptr = np.zeros(num_rings + 1, np.int64)
    for ring in range(num_rings):
        run_ptr[ring + 1] = run_ptr[ring] + (ring_ptr[ring + 1] - ring_ptr[ring] + RUN - 1) // RUN
    runs = np.empty((run_ptr[-1], 3))
    for ring in range(num_rings):
        start, stop = ring_ptr[ring], ring_ptr[ring + 1]
        for run in range(run_ptr[ring], run_ptr[ring + 1]):
            first = start + (run - run_ptr[ring]) * RUN
            before = first - 1 if first > start else stop - 1
            low = high = xy[before, 1]
            right = xy[before, 0]
            for vertex in range(first, min(first + RUN, stop)):
                low, high = min(low, xy[vertex, 1]), max(high, xy[vertex, 1])
                right = max(right, xy[vertex, 0])
            runs[run, 0], runs[run, 1], runs[run, 2] = low, high, right
    return run_ptr, runs


def admit(road: VectorMap, areas: Areas, x: float, y: float, half_width: float) -> Admitted:
    """Areas of the blocks and the car parks that touch a square around (x, y) [m]."""
    mask = np.zeros(len(areas.edge), np.bool_)
    order = np.empty(len(areas.edge), np.int64)
    blocks, members = road.blocks.polygons, road.block_edges
    count = _admit(blocks, members, areas.polygons, len(road.edges), x, y, half_width, mask, order)
    return Admitted(mask, order[:count])


@kernel
def _admit(
    blocks: Polygons,
    block_edges: Lists,
    polygons: Polygons,
    num_edges: int,
    x: float,
    y: float,
    half_width: float,
    mask: BoolArray,
    order: IntArray,
) -> int:
    count = 0
    for block in range(len(blocks.bounds)):
        if touches_square(blocks, block, x, y, half_width):
            for entry in range(block_edges.ptr[block], block_edges.ptr[block + 1]):
                mask[block_edges.items[entry]] = True
                order[count] = block_edges.items[entry]
                count += 1
    for area in range(num_edges, len(mask)):
        if touches_square(polygons, area, x, y, half_width):
            mask[area] = True
            order[count] = area
            count += 1
    return count


@kernel
def touches_square(polygons: Polygons, poly: int, x: float, y: float, half_width: float) -> bool:
    """Whether a polygon shares a point with the axis-parallel square around (x, y)."""
    west, south, east, north = polygons.bounds[poly]
    if (
        west > x + half_width
        or east < x - half_width
        or south > y + half_width
        or north < y - half_width
    ):
        return False
    square = np.empty((4, 2))
    for corner in range(4):
        square[corner, 0] = x + half_width if corner == 0 or corner == 3 else x - half_width
        square[corner, 1] = y + half_width if corner < 2 else y - half_width
    first, last = polygons.poly_ptr[poly], polygons.poly_ptr[poly + 1]
    xy = polygons.xy
    for vertex in range(polygons.ring_ptr[first], polygons.ring_ptr[last]):
        if abs(xy[vertex, 0] - x) <= half_width and abs(xy[vertex, 1] - y) <= half_width:
            return True
    for corner in range(4):
        sx, sy = square[corner]
        if locate_in_polygon(xy, polygons.ring_ptr, first, last, sx, sy) != EXTERIOR:
            return True
    for ring in range(first, last):
        before = polygons.ring_ptr[ring + 1] - 1
        for vertex in range(polygons.ring_ptr[ring], polygons.ring_ptr[ring + 1]):
            for corner in range(4):
                if segments_intersect(xy[before], xy[vertex], square[corner - 1], square[corner]):
                    return True
            before = vertex
    return False


@kernel
def locate(areas: Areas, area: int, x: float, y: float) -> int:
    """Where a point lies relative to an area: INTERIOR, BOUNDARY or EXTERIOR."""
    polygons = areas.polygons
    if (
        x < polygons.bounds[area, 0]
        or y < polygons.bounds[area, 1]
        or x > polygons.bounds[area, 2]
        or y > polygons.bounds[area, 3]
    ):
        return EXTERIOR
    inside = False
    for ring in range(polygons.poly_ptr[area], polygons.poly_ptr[area + 1]):
        start, stop = polygons.ring_ptr[ring], polygons.ring_ptr[ring + 1]
        for run in range(areas.run_ptr[ring], areas.run_ptr[ring + 1]):
            if y < areas.runs[run, 0] or y > areas.runs[run, 1] or x > areas.runs[run, 2]:
                continue
            first = start + (run - areas.run_ptr[ring]) * RUN
            before = first - 1 if first > start else stop - 1
            odd, on_edge = ray_crossings(polygons.xy, before, first, min(first + RUN, stop), x, y)
            if on_edge:
                return BOUNDARY
            if odd:
                inside = not inside
    return INTERIOR if inside else EXTERIOR


@kernel
def holders(
    areas: Areas, mask: BoolArray, x: float, y: float, with_boundary: bool, out: IntArray
) -> int:
    """Write the areas of `mask` that hold a point into `out`, ascending, and return their number.

    At most `len(out)` are found.
    """
    polygons = areas.polygons
    fx = np.floor((x - polygons.grid[0]) / polygons.grid[2])
    fy = np.floor((y - polygons.grid[1]) / polygons.grid[2])
    if not (0.0 <= fx < polygons.shape[0] and 0.0 <= fy < polygons.shape[1]):
        return 0
    cell = int(fx) * polygons.shape[1] + int(fy)
    found = 0
    for entry in range(polygons.cell_ptr[cell], polygons.cell_ptr[cell + 1]):
        area = polygons.cell_items[entry]
        if not mask[area] or found == len(out):
            continue
        side = locate(areas, area, x, y)
        if side == INTERIOR or (with_boundary and side == BOUNDARY):
            out[found] = area
            found += 1
    return found


@kernel
def ego_areas(
    areas: Areas, mask: BoolArray, corners: FloatArray, centers: FloatArray, out: BoolArray
) -> None:
    """How every pose of every proposal lies on the road (§8.1).

    Args:
        areas: The areas.
        mask: (M,) those that count.
        corners: (P, T, 4, 2) corners of the ego [m].
        centers: (P, T, 2) its centres [m].
        out: (P, T, 3) receives: on multiple lanes, off the road, on no lane of the route.
    """
    found = np.empty(MAX_HOLDERS, np.int64)
    seen, corners_on = np.empty(4 * MAX_HOLDERS, np.int64), np.empty(4 * MAX_HOLDERS, np.int64)
    for proposal in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            num_seen, most, off_road = 0, 0, False
            for corner in range(4):
                x, y = corners[proposal, step, corner]
                count = holders(areas, mask, x, y, False, found)
                off_road = off_road or count == 0
                for area in found[:count]:
                    at = 0
                    while at < num_seen and seen[at] != area:
                        at += 1
                    if at == num_seen:
                        seen[at], corners_on[at] = area, 0
                        num_seen += 1
                    corners_on[at] += 1
                    most = max(most, corners_on[at])
            out[proposal, step, 0] = num_seen > 1 and most < 4
            out[proposal, step, 1] = off_road
            x, y = centers[proposal, step]
            count = holders(areas, mask, x, y, False, found)
            oncoming = True
            for area in found[:count]:
                if areas.on_route[area]:
                    oncoming = False
            out[proposal, step, 2] = oncoming


def index_ranks(bounds: FloatArray) -> IntArray:
    """(M,) place of each box (M, 4) among the results of nuPlan's spatial index.

    The index is a packed tree that is walked depth first, so a query only leaves boxes out.
    """
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=NODE_CAPACITY)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    ranks = np.empty(len(bounds), np.int64)
    ranks[tree.query(shapely.box(*low, *high))] = np.arange(len(bounds))
    return ranks
