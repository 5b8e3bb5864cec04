"""Route correction, which PDM-Closed and the learned planners share.

They differ in where they look for the block the ego starts on, and in how often they correct. The
route may lack blocks at its start, have gaps, or cross itself.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.errors import PlannerError
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.routes.graph import HINT, deviation, search_levels
from shiftsim.world.layers import Lists, Polygons, Polylines, meeting, nearest_of, square_around
from shiftsim.world.map import VectorMap

MAX_HEADING_ERROR = np.pi / 4.0  # rad
MAX_DISPLACEMENT = 3.0  # m
BACKWARD_DEPTH, FORWARD_DEPTH = 15, 30  # blocks
NUM_GOALS = 3  # route blocks that a search forward may reach
MAX_OVERLAP = 1.0  # m^2, of two roadblock connectors of a route without loops


class Start(NamedTuple):
    """Where a route begins."""

    block: int  # the block the ego starts on
    others: list[int]  # blocks it may as well start on, once per lane that qualifies


def known_blocks(road: VectorMap, route: Sequence[str], token: str, planner: str) -> list[int]:
    """Block indices of a route, given by roadblock ids, each once.

    Raises:
        PlannerError: The route is empty or names a block that the map does not have.
    """
    if not route:
        raise PlannerError(f"{planner}: the route of scenario {token!r} is empty", hint=HINT)
    for name in route:
        if name not in road.blocks.index:
            raise PlannerError(
                f"{planner}: map {road.name!r} has no roadblock {name!r}, which is on the route "
                f"of scenario {token!r}",
                hint=HINT,
            )
    return [road.blocks.index[name] for name in dict.fromkeys(route)]


class RouteCorrector:
    """Corrects the route of one scenario as often as asked.

    The result depends on the start alone, and where the start is on the route not even on that, so
    what was once found is kept.
    """

    def __init__(self, road: VectorMap, blocks: list[int], half_width: float) -> None:
        """Take a route (`known_blocks`) and half the side of the square to search [m]."""
        self._road, self._blocks, self._half_width = road, blocks, half_width
        self._on_route = set(blocks)
        self._known: dict[tuple[int, ...], tuple[int, ...]] = {}

    def at(self, rear_axle: FloatArray) -> tuple[int, ...]:
        """The route corrected for a rear axle (3,); blocks may repeat."""
        square = square_around(float(rear_axle[0]), float(rear_axle[1]), self._half_width)
        start = find_start(self._road, self._blocks, rear_axle, square)
        key = (start.block, *start.others) if start.block not in self._on_route else ()
        if key not in self._known:
            self._known[key] = tuple(correct_route(self._road, self._blocks, start))
        return self._known[key]


def correct_route(road: VectorMap, route: list[int], start: Start) -> list[int]:
    """A route from the start on, without gaps and loops."""
    blocks = list(route)
    if start.block not in blocks:
        blocks = _lead_in(road, blocks, start)
    return _cut_loops(road, _fill_gaps(road, blocks))


def find_start(
    road: VectorMap, route: Sequence[int], rear_axle: FloatArray, area: FloatArray
) -> Start:
    """The block near the rear axle (3,) that fits its heading best, preferably on the route.

    `area` (4, 2) are the corners, counter-clockwise [m], of the box that blocks must touch; where
    none does, the nearest of either kind are taken.

    Raises:
        PlannerError: The map has no blocks.
    """
    found = _find_blocks(
        road.blocks.polygons,
        road.num_roadblocks,
        road.block_edges,
        road.baselines,
        np.array(route, np.int64),
        np.asarray(rear_axle[:3], np.float64),
        area,
    )
    blocks, best = found
    if not len(blocks):
        raise PlannerError(f"map {road.name!r} has no roadblocks")
    return Start(int(blocks[best]), blocks.tolist())


@kernel
def _find_blocks(
    blocks: Polygons,
    num_roadblocks: int,
    block_edges: Lists,
    baselines: Polylines,
    route: IntArray,
    rear_axle: FloatArray,
    area: FloatArray,
) -> tuple[IntArray, int]:
    """Blocks that touch the area, once per lane that qualifies, and which of them is the start.

    Only those on the route where any of them is.
    """
    x, y, heading = rear_axle[0], rear_axle[1], rear_axle[2]
    near = meeting(blocks, area)
    if len(near) == 0:
        # the nearest roadblock and the nearest roadblock connector, of those that there are
        roadblock = nearest_of(blocks, 0, num_roadblocks, x, y, np.inf)[0]
        connector = nearest_of(blocks, num_roadblocks, len(blocks.bounds), x, y, np.inf)[0]
        near = np.array([roadblock, connector])
        near = near[near >= 0]
    capacity = 0
    for block in near:
        capacity += block_edges.ptr[block + 1] - block_edges.ptr[block] + 1
    names, distances = np.empty((3, capacity), np.int64), np.empty((3, capacity))
    counts = np.zeros(3, np.int64)  # on the route, beside it, all
    for block in near:
        kind = 1
        for name in route:
            if name == block:
                kind = 0
        least = np.inf
        for entry in range(block_edges.ptr[block], block_edges.ptr[block + 1]):
            lane = block_edges.items[entry]
            displacement, error = deviation(baselines, lane, 1, x, y, heading)
            least = min(least, displacement)
            if error < MAX_HEADING_ERROR and displacement < MAX_DISPLACEMENT:
                names[kind, counts[kind]], distances[kind, counts[kind]] = block, displacement
                counts[kind] += 1
        names[2, counts[2]], distances[2, counts[2]] = block, least
        counts[2] += 1
    kind = 0 if counts[0] > 0 else (1 if counts[1] > 0 else 2)
    best = 0  # the first one on ties
    for index in range(counts[kind]):
        if distances[kind, index] < distances[kind, best]:
            best = index
    return names[kind, : counts[kind]].copy(), best


def _lead_in(road: VectorMap, blocks: list[int], start: Start) -> list[int]:
    """Blocks between the start and the route."""
    incoming = search_levels(road.block_incoming.at, blocks[0], set(start.others), BACKWARD_DEPTH)
    if incoming.found:
        return incoming.path[:0:-1] + blocks
    goals = blocks[:NUM_GOALS]
    outgoing = search_levels(road.block_outgoing.at, start.block, set(goals), FORWARD_DEPTH)
    if outgoing.found:
        return outgoing.path + blocks[goals.index(outgoing.path[-1]) + 1 :]
    return blocks


def _fill_gaps(road: VectorMap, blocks: list[int]) -> list[int]:
    """Blocks between consecutive ones that are not connected."""
    out = blocks[:1]
    for before, after in pairwise(blocks):
        if before not in road.block_incoming.at(after):
            bridge = search_levels(road.block_outgoing.at, before, {after}, FORWARD_DEPTH)
            if bridge.found:
                out += bridge.path[1:-1]
        out.append(after)
    return out


def _cut_loops(road: VectorMap, blocks: list[int]) -> list[int]:
    """The route up to the first connector that overlaps one before it."""
    passed: list[shapely.Polygon] = []
    for index, block in enumerate(blocks):
        if block < road.num_roadblocks:
            continue
        area = road.blocks.shape(block)
        if any(shapely.area(shapely.intersection(area, other)) > MAX_OVERLAP for other in passed):
            return blocks[:index]
        passed.append(area)
    return blocks
