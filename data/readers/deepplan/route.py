"""Routes of recorded egos through a map, and whether map and tracks lie on each other.

Route: nuPlan's rule over the ego's path, then gaps are closed and the road ahead is appended.
Blocks are indices of `VectorMap.blocks` here, ids only at the end.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shiftsim.data.readers.deepplan.windows import ConversionConfig
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import project_on_polyline
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.layers import Polygons, Polylines, containing, distance_to, in_any
from shiftsim.world.map import VectorMap

_MAX_AT_POINT = 16  # blocks looked at per point
_MAX_GAP_BLOCKS = 3  # blocks that a repair may add in one gap
_MIN_BLOCKS = 2  # that nuPlan's own route planners ask for; a longer road ahead does not replace it
_MAX_POINTS = 2000  # moving vehicles looked at for the placement of the map
_MAX_CELLS = 1_000_000  # of the raster that finds a better placement


@dataclass(frozen=True)
class Route:
    """A route."""

    ids: tuple[str, ...]  # roadblock and roadblock connector ids, in order
    num_driven: int  # how many of them the ego drives on; the others were appended
    is_linked: bool  # whether each of them follows the one before on the map


@dataclass(frozen=True)
class Placement:
    """How well moving vehicles and drivable area lie on each other."""

    share: float  # share of the points on drivable area
    shift: FloatArray  # (2,) what to add to the points for the best fit [m]
    best_share: float  # share of the points on drivable area then, as far as a raster tells


def find_route(road: VectorMap, poses: FloatArray, config: ConversionConfig) -> Route | None:
    """The route of an ego, or None where it touches no roadblock.

    `poses` (R, 3) are its rear axle from t0 on: x [m], y [m], heading [rad].
    """
    driven = close_gaps(road, follow_blocks(road, poses[:, :2]))
    if not driven:
        return None
    ahead = _extend(road, driven, poses[-1], config)
    names = road.blocks.ids
    is_linked = all(b in road.block_outgoing.at(a) for a, b in pairwise(driven))
    return Route(tuple(names[block] for block in (*driven, *ahead)), len(driven), is_linked)


def follow_blocks(road: VectorMap, points: FloatArray) -> list[int]:
    """Blocks along points (R, 2), by nuPlan rule 455; neighbours may be unlinked."""
    at = np.full((len(points), _MAX_AT_POINT), -1, np.int64)
    _containing_points(road.blocks.polygons, np.ascontiguousarray(points), at)
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


def close_gaps(road: VectorMap, blocks: list[int]) -> list[int]:
    """Fill gaps between unlinked blocks by the shortest successor path, if there is a short one."""
    out = blocks[:1]
    for block in blocks[1:]:
        if block != out[-1]:
            out += [*_path_between(road, out[-1], block), block]
    return out


def nearest_lane(
    road: VectorMap, pose: FloatArray, config: ConversionConfig
) -> tuple[int, float] | None:
    """The edge an ego can start on, and its distance [m]; None where none is near and along it."""
    edge, distance = _start_edge(
        road.edges.polygons, road.baselines, pose, config.max_lane_distance, config.max_lane_angle
    )
    return None if edge < 0 else (edge, distance)


def place_on_map(road: VectorMap, points: FloatArray, enough: float) -> Placement:
    """Compare moving vehicles with the drivable area, and look for a better place if need be.

    `points` (n, 2) are their box centres in the frame of the map [m]; where the share `enough` is
    on drivable area, no better place is looked for.
    """
    if len(points) == 0:
        return Placement(1.0, np.zeros(2), 1.0)
    points = np.ascontiguousarray(points[:: max(1, len(points) // _MAX_POINTS)])
    share = float(_on_drivable(road, points).mean())
    if share >= enough:
        return Placement(share, np.zeros(2), share)
    shift, best = _best_shift(road, points)
    return Placement(share, shift, best)


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
        grown = []
        for path in paths:
            for block in road.block_outgoing.at(path[-1]).tolist():
                if block == goal:
                    return path[1:]
                if block not in path:
                    grown.append([*path, block])
        paths = grown
    return []


def _extend(
    road: VectorMap, driven: list[int], last_pose: FloatArray, config: ConversionConfig
) -> list[int]:
    """Blocks ahead along the straightest way (nuPlan rule 456)."""
    edge = _edge_on(road, driven[-1], last_pose)
    ahead = road.baselines.length(edge) - road.progress_on(edge, last_pose[0], last_pose[1])
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


def _edge_on(road: VectorMap, block: int, pose: FloatArray) -> int:
    """The edge of a block nearest to a pose."""
    polygons = road.edges.polygons
    edges = road.block_edges.at(block).tolist()
    return min(edges, key=lambda e: (distance_to(polygons, e, pose[0], pose[1]), e))


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


def _on_drivable(road: VectorMap, points: FloatArray) -> FloatArray:
    """(n,) 1 where a point is on a lane, a connector or another drivable polygon, else 0."""
    out = np.zeros(len(points))
    _mark_inside(road.edges.polygons, points, out)
    _mark_inside(road.drivable_areas.polygons, points, out)
    return out


def _best_shift(road: VectorMap, points: FloatArray) -> tuple[FloatArray, float]:
    """The shift of the points that puts most of them on drivable area, by correlating rasters."""
    bounds = road.edges.polygons.bounds
    if len(bounds) == 0:
        return np.zeros(2), 0.0
    low, high = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    own_low, own_high = points.min(axis=0), points.max(axis=0)
    extent = (high - low) + np.minimum(own_high - own_low, high - low)
    cell = max(1.0, float(np.sqrt(np.prod(extent) / _MAX_CELLS)))
    num_map = np.ceil((high - low) / cell).astype(np.int64) + 1
    index = np.floor((points - own_low) / cell).astype(np.int64)
    kept = index[(index < num_map).all(axis=1)]
    num = 2 * num_map
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in num_map), indexing="ij"), -1)
    centers = low + (grid.reshape(-1, 2) + 0.5) * cell
    area = _on_drivable(road, np.ascontiguousarray(centers)).reshape(num_map)
    counts = np.zeros(num_map)
    np.add.at(counts, (kept[:, 0], kept[:, 1]), 1.0)
    product = np.fft.rfft2(area, num) * np.conj(np.fft.rfft2(counts, num))
    match = np.rint(np.fft.irfft2(product, num))
    ties = np.argwhere(match == match.max())
    steps = np.where(ties >= num_map, ties - num, ties)
    shifts = low + steps * cell - own_low
    best = shifts[np.argmin(np.abs(shifts).sum(axis=1))]
    return best, float(match.max() / len(points))


@kernel
def _start_edge(
    polygons: Polygons, baselines: Polylines, pose: FloatArray, reach: float, max_angle: float
) -> tuple[int, float]:
    """The nearest edge that leads along a pose, and its distance [m]; (-1, inf) without one."""
    found, best = -1, np.inf
    x, y = pose[0], pose[1]
    for edge in range(len(polygons.bounds)):
        low_x, low_y, high_x, high_y = polygons.bounds[edge]
        if x + reach < low_x or x - reach > high_x or y + reach < low_y or y - reach > high_y:
            continue
        distance = distance_to(polygons, edge, x, y)
        if distance > reach or distance >= best:
            continue
        first, last = baselines.ptr[edge], baselines.ptr[edge + 1]
        along = project_on_polyline(baselines.xy, baselines.arc, first, last, x, y)
        segment = int(np.searchsorted(baselines.arc[first:last], along, side="right")) - 1
        at = first + min(max(segment, 0), last - first - 2)
        dx = baselines.xy[at + 1, 0] - baselines.xy[at, 0]
        dy = baselines.xy[at + 1, 1] - baselines.xy[at, 1]
        if abs(wrap_angle(pose[2] - np.arctan2(dy, dx))) < max_angle:
            found, best = edge, distance
    return found, best


@kernel
def _containing_points(polygons: Polygons, points: FloatArray, out: IntArray) -> None:
    """Write the polygons that hold each point (n, 2) into the rows of `out`, filled with -1."""
    for index in range(len(points)):
        containing(polygons, points[index, 0], points[index, 1], out[index])


@kernel
def _mark_inside(polygons: Polygons, points: FloatArray, out: FloatArray) -> None:
    for index in range(len(points)):
        if in_any(polygons, points[index, 0], points[index, 1]):
            out[index] = 1.0
