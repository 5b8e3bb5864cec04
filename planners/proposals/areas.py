"""The drivable area that proposals are scored on: lanes and connectors, and car parks.

nuPlan puts them into a new spatial index at every step. Here a step names the areas that belong to
it.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.polylines import RUN
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.layers import Polygons, join_polygons, meeting, square_around
from shiftsim.world.map import PerMap, VectorMap

NODE_CAPACITY = 10  # of nuPlan's spatial indices


class Areas(NamedTuple):
    """Areas of all lanes and connectors of a map, then of its car parks. M areas, R rings."""

    polygons: Polygons  # the areas
    on_route: BoolArray  # (M,) whether the route holds a lane of that id
    lane: IntArray  # (M,) the lane of that id; for a car park usually -1
    run_ptr: IntArray  # (R + 1,) first run of 8 edges of each ring
    runs: FloatArray  # (runs, 3) least y, greatest y and greatest x of each run [m]


def make_areas(road: VectorMap, route_lanes: list[int]) -> Areas:
    """Areas of a map, with the lanes of a route marked."""
    areas = _areas_on(road)
    return areas._replace(on_route=np.isin(areas.lane, np.array(route_lanes)))


@PerMap
def _areas_on(road: VectorMap) -> Areas:
    polygons = road.edges.polygons
    if len(road.car_parks):
        polygons = join_polygons([polygons, road.car_parks.polygons])
    # nuPlan rule 181: membership is a test on ids, which car parks may share with lanes
    parks = [road.edges.index.get(name, -1) for name in road.car_parks.ids]
    lane = np.concatenate([np.arange(len(road.edges)), np.array(parks, np.int64)])
    return areas_of(polygons, np.zeros(len(lane), np.bool_), lane)


def areas_of(polygons: Polygons, on_route: BoolArray, lane: IntArray) -> Areas:
    """Areas from polygons, and the fields of `Areas`."""
    xy, ring_ptr = polygons.xy, polygons.ring_ptr
    counts = -(-np.diff(ring_ptr) // RUN)
    run_ptr = np.concatenate([[0], np.cumsum(counts)])
    starts = np.repeat(ring_ptr[:-1] - RUN * run_ptr[:-1], counts) + RUN * np.arange(run_ptr[-1])
    before = np.arange(len(xy)) - 1
    before[ring_ptr[:-1]] = ring_ptr[1:] - 1
    runs = np.zeros((len(starts), 3))
    if len(starts):
        runs[:, 0] = np.minimum.reduceat(np.minimum(xy, xy[before])[:, 1], starts)
        runs[:, 2:0:-1] = np.maximum.reduceat(np.maximum(xy, xy[before]), starts)
    return Areas(polygons, on_route, lane, run_ptr, runs)


def select_areas(road: VectorMap, x: float, y: float, half_width: float) -> IntArray:
    """Areas of the blocks and the car parks that touch a square around (x, y) [m], in their order.

    Lanes come by block, in the order of the blocks.
    """
    square = square_around(x, y, half_width)
    lanes = [road.block_edges.at(block) for block in meeting(road.blocks.polygons, square)]
    parks = meeting(road.car_parks.polygons, square) if len(road.car_parks) else np.zeros(0, int)
    return np.concatenate([*lanes, parks + len(road.edges)])


def index_ranks(bounds: FloatArray) -> IntArray:
    """(M,) place of each box (M, 4) among the results of nuPlan's spatial index.

    The index is a packed tree that is walked depth first, so a query only leaves boxes out.
    """
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=NODE_CAPACITY)
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    ranks = np.empty(len(bounds), np.int64)
    ranks[tree.query(shapely.box(*low, *high))] = np.arange(len(bounds))
    return ranks
