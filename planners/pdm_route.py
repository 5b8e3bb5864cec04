"""Route correction of PDM-Closed, once per scenario (pdm-closed.md §3).

The route may lack blocks at its start, have gaps, or cross itself. nuPlan's searches keep no set of
visited blocks; here each level of a search holds a block once, ordered by its first and by its last
appearance, which decides the same things at linear cost.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.errors import PlannerError
from shiftsim.layers import distance_to
from shiftsim.map import NONE, VectorMap
from shiftsim.planners.pdm_centerline import nearest_vertex

MAX_HEADING_ERROR = np.pi / 4.0  # rad
MAX_DISPLACEMENT = 3.0  # m
PROXIMITY = 1.0  # m, half side of the square around the rear axle
BACKWARD_DEPTH, FORWARD_DEPTH = 15, 30  # blocks
NUM_GOALS = 3  # route blocks that a search forward may reach
MAX_OVERLAP = 1.0  # m^2, of two roadblock connectors of a route without loops


@dataclass(frozen=True, slots=True)
class Start:
    """Where a route begins.

    Attributes:
        block: The block the ego starts on.
        candidates: Blocks it may as well start on, once per lane that qualifies.
    """

    block: int
    candidates: list[int]


def known_blocks(road: VectorMap, route: Sequence[str], token: str) -> list[int]:
    """Block indices of a route, each once.

    Raises:
        PlannerError: The route is empty or names a block that the map does not have.
    """
    if not route:
        raise PlannerError(
            f"pdm-closed: the route of scenario {token!r} is empty",
            hint="correct the route of the scenario, or leave it out",
        )
    for name in route:
        if name not in road.blocks.index:
            raise PlannerError(
                f"pdm-closed: map {road.name!r} has no roadblock {name!r}, which is on the route "
                f"of scenario {token!r}",
                hint="correct the route of the scenario, or leave it out",
            )
    return [road.blocks.index[name] for name in dict.fromkeys(route)]


def correct_route(road: VectorMap, route: list[int], start: Start) -> list[int]:
    """A route from the start on, without gaps and loops."""
    blocks = list(route)
    if start.block not in blocks:
        blocks = _lead_in(road, blocks, start)
    return _cut_loops(road, _fill_gaps(road, blocks))


def find_start(road: VectorMap, route: Iterable[int], rear_axle: FloatArray) -> Start:
    """The block under the rear axle (3,) that fits its heading best, preferably on the route.

    Raises:
        PlannerError: The map has no blocks.
    """
    allowed = set(route)
    x, y = float(rear_axle[0]), float(rear_axle[1])
    nearby = road.blocks.within_box(x, y, PROXIMITY).tolist() or _nearest_blocks(road, x, y)
    on_route: list[tuple[float, int]] = []
    others: list[tuple[float, int]] = []
    closest: list[tuple[float, int]] = []
    for block in nearby:
        least = np.inf
        for edge in road.block_edges.at(block).tolist():
            displacement, error = nearest_vertex(road.baselines, edge, x, y, float(rear_axle[2]))
            least = min(least, displacement)
            if error < MAX_HEADING_ERROR and displacement < MAX_DISPLACEMENT:
                (on_route if block in allowed else others).append((displacement, block))
        closest.append((least, block))
    if not closest:
        raise PlannerError(f"pdm-closed: map {road.name!r} has no roadblocks")
    chosen = on_route or others or closest
    best = min(chosen, key=lambda pair: pair[0])  # the first one on ties
    return Start(best[1], [block for _, block in chosen])


def _nearest_blocks(road: VectorMap, x: float, y: float) -> list[int]:
    """The nearest roadblock and the nearest roadblock connector."""
    out = []
    for first, last in ((0, road.num_roadblocks), (road.num_roadblocks, len(road.blocks))):
        distances = [distance_to(road.blocks.polygons, block, x, y) for block in range(first, last)]
        if distances:
            out.append(first + int(np.argmin(distances)))
    return out


def _lead_in(road: VectorMap, blocks: list[int], start: Start) -> list[int]:
    """Blocks between the start and the route (§3.2)."""
    incoming = search(road.block_incoming.at, blocks[0], set(start.candidates), BACKWARD_DEPTH)
    if incoming.found:
        return incoming.path[:0:-1] + blocks
    goals = blocks[:NUM_GOALS]
    outgoing = search(road.block_outgoing.at, start.block, set(goals), FORWARD_DEPTH)
    if outgoing.found:
        return outgoing.path + blocks[goals.index(outgoing.path[-1]) + 1 :]
    return blocks


def _fill_gaps(road: VectorMap, blocks: list[int]) -> list[int]:
    """Blocks between consecutive ones that are not connected (§3.3)."""
    out = blocks[:1]
    for before, after in pairwise(blocks):
        if before not in road.block_incoming.at(after):
            bridge = search(road.block_outgoing.at, before, {after}, FORWARD_DEPTH)
            if bridge.found:
                out += bridge.path[1:-1]
        out.append(after)
    return out


def _cut_loops(road: VectorMap, blocks: list[int]) -> list[int]:
    """The route up to the first connector that overlaps one before it (§3.4)."""
    passed: list[shapely.Polygon] = []
    for index, block in enumerate(blocks):
        if block < road.num_roadblocks:
            continue
        area = road.blocks.shape(block)
        if any(shapely.area(shapely.intersection(area, other)) > MAX_OVERLAP for other in passed):
            return blocks[:index]
        passed.append(area)
    return blocks


@dataclass(frozen=True, slots=True)
class Search:
    """Result of a search through blocks.

    Attributes:
        path: Blocks from the start to the goal, or to the block queued last.
        found: Whether a goal was reached.
    """

    path: list[int]
    found: bool


def search(
    neighbours: Callable[[int], Iterable[int]], start: int, goals: set[int], max_depth: int
) -> Search:
    """Breadth-first search by levels, the start being level 1 (§3.5).

    A goal is seen when its level is expanded, the first one queued wins; the parent of a block on a
    level is the last block that queued it.
    """
    firsts, lasts = [start], [start]
    parents: list[dict[int, int]] = [{}]
    end = start
    for _ in range(max_depth):
        reached = next((block for block in firsts if block in goals), NONE)
        if reached != NONE:
            return Search(_trace(parents, reached), True)
        queued = [(int(after), block) for block in lasts for after in neighbours(block)]
        if not queued:
            break
        end = queued[-1][0]
        parents.append(dict(queued))
        firsts = list(dict.fromkeys(int(after) for block in firsts for after in neighbours(block)))
        lasts = list(dict.fromkeys(after for after, _ in reversed(queued)))[::-1]
    return Search(_trace(parents, end), False)


def _trace(parents: list[dict[int, int]], block: int) -> list[int]:
    """Blocks from the start to `block`, which lies on the last level."""
    blocks = [block]
    for level in reversed(parents[1:]):
        blocks.append(level[blocks[-1]])
    return blocks[::-1]
