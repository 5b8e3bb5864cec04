"""Searches through blocks and lanes."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

from shiftsim.world.map import NONE

START_COST = 1.0  # nuPlan rule 184: the first lane costs 1, whatever its length
Neighbours = Callable[[int], Iterable[int]]


class Search(NamedTuple):
    """Result of a search."""

    # from the start to the goal; without one, to the place that comes nearest to it
    path: list[int]
    found: bool  # whether a goal was reached


def search_levels(
    neighbours: Neighbours, start: int, goals: set[int], max_depth: int, *, only_last: bool = False
) -> Search:
    """Breadth-first search by levels, the start being level 1 and `max_depth` the last.

    With `only_last` goals count on the last level only.
    """
    # nuPlan rule 150: no set of visited places is kept, so a place may be queued many times on one
    # level; its parent is the last one that queued it, the goal is the first one queued, and
    # without a goal the path leads to the place queued last. A level therefore holds each place
    # once, ordered by its first and by its last appearance.
    firsts, lasts = [start], [start]
    parents: list[dict[int, int]] = [{}]  # per level
    end = start
    for depth in range(1, max_depth + 1):
        if depth == max_depth or not only_last:
            reached = next((place for place in firsts if place in goals), NONE)
            if reached != NONE:
                return Search(_trace(parents, reached), True)
        queued = [(int(after), place) for place in lasts for after in neighbours(place)]
        if not queued:
            break
        end = queued[-1][0]
        parents.append(dict(queued))
        firsts = list(dict.fromkeys(int(after) for place in firsts for after in neighbours(place)))
        lasts = list(dict.fromkeys(after for after, _ in reversed(queued)))[::-1]
    return Search(_trace(parents, end), False)


def _trace(parents: list[dict[int, int]], place: int) -> list[int]:
    """Places from the start to `place`, which lies on the last level."""
    path = [place]
    for level in reversed(parents[1:]):
        path.append(level[path[-1]])
    return path[::-1]


def search_cheapest(
    start: int,
    neighbours: Neighbours,
    length: Callable[[int], float],
    is_goal: Callable[[int], bool],
) -> Search:
    """Dijkstra's search with an open list; the first of equal costs is expanded first."""
    opened, cost, parent = [start], {start: START_COST}, {start: NONE}
    depth = {start: 1}
    expanded: list[int] = []
    while opened:
        lane = min(opened, key=cost.__getitem__)
        opened.remove(lane)
        if is_goal(lane):
            return Search(_ancestry(parent, lane), True)
        expanded.append(lane)
        for after in neighbours(lane):
            total = cost[lane] + length(after)
            if after in cost and (after not in opened or total >= cost[after]):
                continue
            if after not in opened:
                opened.append(after)
            cost[after], parent[after], depth[after] = total, lane, depth[lane] + 1
    deepest = max(depth[lane] for lane in expanded)
    end = min((lane for lane in expanded if depth[lane] == deepest), key=cost.__getitem__)
    return Search(_ancestry(parent, end), False)


def _ancestry(parent: dict[int, int], lane: int) -> list[int]:
    path = [lane]
    while parent[path[-1]] != NONE:
        path.append(parent[path[-1]])
    return path[::-1]
