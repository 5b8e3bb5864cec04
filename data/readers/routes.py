"""Routes of recorded egos through a map.

A route is nuPlan's rule over the ego's path, then gaps are closed and the road ahead is appended.
Blocks are indices of `VectorMap.blocks` here, ids only at the end.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from shiftsim.data.readers.placement import containing_polygons, direction_at
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray
from shiftsim.world.layers import distance_to
from shiftsim.world.map import VectorMap

_MAX_AT_POINT = 16  # blocks looked at per point
_MAX_GAP_BLOCKS = 3  # blocks that a repair may add in one gap
_MIN_BLOCKS = 2  # that nuPlan's own route planners ask for; a longer road ahead does not replace it


@dataclass(frozen=True)
class Route:
    """A route."""

    ids: tuple[str, ...]  # roadblock and roadblock connector ids, in order
    num_driven: int  # how many of them the ego drives on; the others were appended
    is_linked: bool  # whether each of them follows the one before on the map


def find_route(road: VectorMap, poses: FloatArray, config: ConversionConfig) -> Route | None:
    """The route of an ego, or None where it touches no roadblock.

    `poses` (R, 3) are its rear axle from t0 on: x [m], y [m], heading [rad].
    """
    driven: list[int] = []
    for block in follow_blocks(road, poses[:, :2]):
        if driven and block != driven[-1]:
            driven += _path_between(road, driven[-1], block)  # closes a short gap
        if not driven or block != driven[-1]:
            driven.append(block)
    if not driven:
        return None
    ahead = _blocks_ahead(road, driven, poses[-1], config)
    names = road.blocks.ids
    is_linked = all(b in road.block_outgoing.at(a) for a, b in pairwise(driven))
    return Route(tuple(names[block] for block in (*driven, *ahead)), len(driven), is_linked)


def with_known_blocks(
    route: Route, road: VectorMap, segments: Mapping[str, Sequence[Any]], known: Sequence[str]
) -> Route:
    """The route with the blocks that lanes of the source lie in, if there are two or more.

    `segments` are those of `BuiltMap`, `known` the ids of the lanes, in order.
    """
    edges: dict[str, list[int]] = {}
    for number, name in enumerate(road.edges.ids):
        for part in segments.get(name, ()):
            edges.setdefault(part.piece.id, []).append(number)
    blocks = [int(road.block_of[edge]) for lane in known for edge in edges.get(lane, ())]
    ids = dict.fromkeys(road.blocks.ids[block] for block in blocks if block >= 0)
    return replace(route, ids=tuple(ids)) if len(ids) >= _MIN_BLOCKS else route


def follow_blocks(road: VectorMap, points: FloatArray) -> list[int]:
    """Blocks along points (R, 2), by nuPlan rule 455; neighbours may be unlinked."""
    at = containing_polygons(road.blocks.polygons, np.ascontiguousarray(points), _MAX_AT_POINT)
    # Only the first two of equal rows matter: the second may settle what the first left open.
    same = (at[1:] == at[:-1]).all(axis=1)
    changes = np.ones(len(at), np.bool_)
    changes[2:] = ~(same[1:] & same[:-1])
    at = at[changes]
    route: list[int] = []
    open_ends: list[int] = []  # connectors, one of which the ego is on; later points tell
    for row in at:
        here = [block for block in row.tolist() if block >= 0]
        if not here or (route and not open_ends and route[-1] in here):
            continue
        if open_ends:
            open_ends = _narrow(road, route, open_ends, here)
            continue
        successors = [b for b in here if route and b in road.block_outgoing.at(route[-1])]
        blocks = [b for b in here if b < road.num_roadblocks]
        if len(successors) == 1:
            route.append(successors[0])
        elif successors:
            open_ends = successors
        elif blocks:
            route.append(blocks[0])
        else:
            open_ends = here
    if open_ends:
        route.append(_straightest(road, open_ends))
    return route


def starts_on_lane(road: VectorMap, pose: FloatArray, config: ConversionConfig) -> bool:
    """Whether a lane is near a pose (3,) x [m], y [m], heading [rad], and leads along it."""
    polygons, reach = road.edges.polygons, config.max_lane_distance
    x, y, heading = pose.tolist()
    low, high = polygons.bounds[:, :2] - reach, polygons.bounds[:, 2:] + reach
    near = (low <= pose[:2]).all(axis=1) & (pose[:2] <= high).all(axis=1)
    for edge in np.flatnonzero(near).tolist():
        if distance_to(polygons, edge, x, y) <= reach:
            dx, dy = direction_at(road.baselines, edge, x, y)
            if abs(wrap_angle(heading - np.arctan2(dy, dx))) < config.max_lane_angle:
                return True
    return False


def _narrow(road: VectorMap, route: list[int], open_ends: list[int], here: list[int]) -> list[int]:
    """Connectors that remain after a point; where it settles them, `route` grows."""
    still = [block for block in open_ends if block in here]
    blocks = [b for b in here if b < road.num_roadblocks]
    if still and not blocks:
        return still
    following = [b for b in open_ends if any(n in road.block_outgoing.at(b) for n in blocks)]
    chosen = _straightest(road, following or open_ends)
    route.append(chosen)
    if blocks:
        linked = [n for n in blocks if n in road.block_outgoing.at(chosen)]
        route.append((linked or blocks)[0])
    return []


def _path_between(road: VectorMap, start: int, goal: int) -> list[int]:
    """Blocks strictly between two blocks on the shortest way; empty where linked or too far."""
    paths = [[start]]
    for _ in range(_MAX_GAP_BLOCKS + 1):
        grown = [[*p, b] for p in paths for b in road.block_outgoing.at(p[-1]).tolist()]
        for path in grown:
            if path[-1] == goal:
                return path[1:-1]
        paths = [path for path in grown if path[-1] not in path[:-1]]
    return []


def _blocks_ahead(
    road: VectorMap, driven: list[int], last_pose: FloatArray, config: ConversionConfig
) -> list[int]:
    """Blocks ahead along the straightest way (nuPlan rule 456)."""
    x, y = last_pose[:2].tolist()
    edges = road.block_edges.at(driven[-1]).tolist()
    edge = min(edges, key=lambda e: (distance_to(road.edges.polygons, e, x, y), e))
    ahead = road.baselines.length(edge) - road.progress_on(edge, x, y)
    added: list[int] = []
    while len(added) < config.route_extension_blocks and (
        ahead < config.route_extension or len(driven) + len(added) < _MIN_BLOCKS
    ):
        following = [
            e
            for e in road.outgoing.at(edge).tolist()
            if road.block_of[e] >= 0 and road.block_of[e] not in (*driven, *added)
        ]
        if not following:
            break
        edge = min(following, key=lambda e: (abs(_turn(road, e)), e))
        added.append(int(road.block_of[edge]))
        ahead += road.baselines.length(edge)
    return added


def _straightest(road: VectorMap, blocks: list[int]) -> int:
    """The block whose edges turn least."""
    return min(
        blocks, key=lambda b: (min(abs(_turn(road, e)) for e in road.block_edges.at(b).tolist()), b)
    )


def _turn(road: VectorMap, edge: int) -> float:
    """Heading change along the baseline of an edge [rad]."""
    step = np.diff(road.baselines.at(edge), axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return float(wrap_angle(heading[-1] - heading[0]))
