"""What the Diffusion Planner's network reads.

The frame is that of the present rear axle. Lanes are resampled once per map; a step only picks the
nearest ones and turns them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from shiftsim.geometry.boxes import turned
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned.map_features import LightLookup, resample
from shiftsim.planners.routes.correction import RouteCorrector
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.layers import Polygons, Polylines, distance_to, meeting, square_around
from shiftsim.world.map import VectorMap
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, LightStatus, Tracks

RADIUS = 100.0  # m, half side of the square from which lanes are taken
LANES, ROUTE_LANES = 70, 25
POINTS, LANE_COLUMNS = 20, 12  # of a lane
AGENTS, SAMPLES, AGENT_COLUMNS = 32, 21, 11
OBJECTS, OBJECT_COLUMNS = 5, 10
SLOW_AGENTS = 10  # pedestrians and bicycles that are kept in a crowd
START_SQUARE = 1.0  # m, half side of the square that is searched for the start of the route

# one-hot position of each LightStatus; nuPlan rule 332: yellow counts as unknown
_LIGHT_COLUMN = np.array([0, 3, 2, 3])
# likewise of cone, barrier, sign and generic object
_OBJECT_COLUMN = np.array([8, 7, 6, 9])
_RANKED = (LightStatus.GREEN, LightStatus.RED)

Single = NDArray[np.float32]


class LaneLines(NamedTuple):
    """Every edge of a map as the network reads it, in the map frame. E edges."""

    # (E, POINTS, 8) x, y, step to the next point (0 at the last), offset to the left and to the
    # right boundary [m]
    rows: FloatArray
    limits: FloatArray  # (E,) speed limits [m/s], NaN where the map has none
    blocks: IntArray  # (E,) block of each edge, -1 where unknown
    connectors: shapely.STRtree  # centre lines of the connectors


@dataclass(frozen=True, slots=True)
class Features:
    """Inputs of the network, not normalised, and what they were made of."""

    neighbor_agents_past: Single  # (32, 21, 11) x, y, cos, sin, vx, vy, width, length, one-hot kind
    static_objects: Single  # (5, 10) x, y, cos, sin, width, length, one-hot kind
    # (70, 20, 12) x, y, step to the next point, offsets to the left and to the right boundary, one-
    # hot light
    lanes: Single
    lanes_speed_limit: Single  # (70, 1) [m/s], 0 where unknown
    lanes_has_speed_limit: BoolArray  # (70, 1)
    route_lanes: Single  # (25, 20, 12) those of the lanes that are on the route
    noise: Single  # (11, 80, 4) standard normal start noise of the sampler
    edges: IntArray  # edges behind the lanes
    agents: IntArray  # tracks behind the agents
    route: tuple[int, ...] | None  # corrected route, blocks; None where it cannot be corrected

    @property
    def ego_current_state(self) -> Single:
        """(10,) the ego in its own frame."""
        # nuPlan rule 331: without its motion
        out = np.zeros(10, np.float32)
        out[2] = 1.0
        return out


def lane_lines(road: VectorMap) -> LaneLines:
    """The edges of a map as the network reads them."""
    rows = resample_lanes(road.baselines, road.left_boundaries, road.right_boundaries)
    connectors = range(road.num_lanes, len(road.edges))
    lines = [shapely.LineString(road.baselines.at(edge)) for edge in connectors]
    return LaneLines(rows, road.speed_limits, road.block_of, shapely.STRtree(lines))


def resample_lanes(lines: Polylines, left: Polylines, right: Polylines) -> FloatArray:
    """Centre lines and boundaries at equally spaced arc lengths, as rows of `LaneLines`.

    A boundary that runs the other way is turned round; one that is missing or of one point is taken
    for the centre line.
    """
    rows = np.zeros((len(lines.ptr) - 1, POINTS, 8))
    center, side = np.empty((len(rows), POINTS, 2)), np.empty((len(rows), POINTS, 2))
    resample(lines, lines, center)
    rows[..., :2] = center
    rows[:, :-1, 2:4] = np.diff(center, axis=1)
    for column, boundary in ((4, left), (6, right)):
        resample(boundary, lines, side)
        apart = np.hypot(*np.moveaxis(side[:, [0, -1]] - center[:, :1], -1, 0))
        turned = apart[:, 1] < apart[:, 0]
        side[turned] = side[turned, ::-1]
        rows[..., column : column + 2] = side - center
    return rows


class FeatureBuilder:
    """Features of one scenario."""

    def __init__(self, scene: SceneInfo, lanes: LaneLines) -> None:
        self._road, self._lanes = scene.map, lanes
        blocks = scene.route_blocks
        self._corrector = RouteCorrector(scene.map, blocks, START_SQUARE) if blocks else None
        self._lights = LightLookup(scene.map, ranked=_RANKED)

    def __call__(self, seen: Observation, noise: Single) -> Features:
        """Features of an observation and the start noise that goes with them."""
        anchor = np.array(seen.history.ego[-1, :3])
        (x, y, _), areas = anchor.tolist(), self._road.edges.polygons
        square = square_around(x, y, RADIUS)
        near = lanes_in_square(areas, self._lanes.connectors, self._road.num_lanes, square)
        edges = nearest_lanes(near, areas, self._road.baselines, x, y, LANES)
        route = self._corrector.at(anchor) if self._corrector else None
        agents, objects, chosen = agent_features(seen.history.tracks, anchor)
        lights = _LIGHT_COLUMN[self._lights.at(seen.lights)[edges]]
        return Features(
            neighbor_agents_past=agents,
            static_objects=objects,
            **lane_inputs(self._lanes, edges, lights, anchor, route or ()),
            noise=noise,
            edges=edges,
            agents=chosen,
            route=route,
        )


def lanes_in_square(
    areas: Polygons, connectors: shapely.STRtree, num_lanes: int, square: FloatArray
) -> IntArray:
    """Lanes whose area, and connectors whose centre line shares a point with a square, ascending.

    `areas` are of all edges; `square` has the corners (4, 2), counter-clockwise [m].
    """
    lanes = meeting(areas, square)
    # nuPlan rule 334: the layer of lane connectors that is asked holds lines, not areas
    crossing = np.sort(connectors.query(shapely.polygons(square), predicate="intersects"))
    return np.concatenate([lanes[lanes < num_lanes], num_lanes + crossing])


def nearest_lanes(
    near: IntArray, areas: Polygons, lines: Polylines, x: float, y: float, most: int
) -> IntArray:
    """The nearest edges of a list, at most `most`.

    Sorted by the distance to the nearest vertex of the centre line (nuPlan rule 335); among equals,
    which are common where a lane and its connectors meet, by the distance to the area, then as
    listed.
    """
    to_vertex, to_area = _distances(near, areas, lines, x, y)
    return near[np.lexsort((to_area, to_vertex))[:most]]


@kernel
def _distances(
    edges: IntArray, areas: Polygons, lines: Polylines, x: float, y: float
) -> tuple[FloatArray, FloatArray]:
    """Distances (n,) from a point to the nearest vertex of centre lines, and to areas [m]."""
    to_vertex, to_area = np.empty(len(edges)), np.empty(len(edges))
    for index, edge in enumerate(edges):
        least = np.inf
        for vertex in range(lines.ptr[edge], lines.ptr[edge + 1]):
            dx, dy = lines.xy[vertex, 0] - x, lines.xy[vertex, 1] - y
            least = min(least, dx * dx + dy * dy)
        to_vertex[index], to_area[index] = np.sqrt(least), distance_to(areas, edge, x, y)
    return to_vertex, to_area


def lanes_on_route(blocks: IntArray, route: Sequence[int]) -> IntArray:
    """Positions of the chosen lanes whose block is on the route, in the order of the lanes."""
    # nuPlan rule 333: of the route counts one stretch without a gap, the first
    seen = set(blocks.tolist())
    stretch: set[int] = set()
    for block in route:
        if block in seen:
            stretch.add(block)
        elif stretch:
            break
    found = [i for i, block in enumerate(blocks.tolist()) if block in stretch]
    return np.array(found[:ROUTE_LANES], np.int64)


def lane_inputs(
    lanes: LaneLines, edges: IntArray, lights: IntArray, anchor: FloatArray, route: Sequence[int]
) -> dict[str, Any]:
    """The fields of `Features` about lanes: of the chosen edges, and of those on a route (blocks).

    `lights` has the one-hot position of the light of each chosen edge, `anchor` is as above.
    """
    count = len(edges)
    rows = np.zeros((LANES, POINTS, LANE_COLUMNS), np.float32)
    pairs = lanes.rows[edges].reshape(count, POINTS, 4, 2)
    pairs[:, :, 0] -= anchor[:2]
    rows[:count, :, :8] = turned(pairs, anchor[2]).reshape(count, POINTS, 8)
    rows[np.arange(count), :, 8 + lights] = 1.0
    known, limits = np.zeros((LANES, 1), np.bool_), np.zeros((LANES, 1), np.float32)
    known[:count, 0] = ~np.isnan(lanes.limits[edges])
    limits[:count, 0] = np.nan_to_num(lanes.limits[edges])
    on_route = lanes_on_route(lanes.blocks[edges], route)
    chosen = np.zeros((ROUTE_LANES, POINTS, LANE_COLUMNS), np.float32)
    chosen[: len(on_route)] = rows[on_route]
    limited = {"lanes_speed_limit": limits, "lanes_has_speed_limit": known}
    return {"lanes": rows, "route_lanes": chosen, **limited}


def agent_features(tracks: Tracks, anchor: FloatArray) -> tuple[Single, Single, IntArray]:
    """Agents (32, 21, 11), static objects (5, 10), and which tracks the agents are."""
    agents = np.zeros((AGENTS, SAMPLES, AGENT_COLUMNS), np.float32)
    objects = np.zeros((OBJECTS, OBJECT_COLUMNS), np.float32)
    kinds, present, now = tracks.kinds, tracks.valid[-1], tracks.poses[-1]
    chosen = _choose_agents(present, now, kinds, anchor)
    source = _samples_of(tracks.valid[:, chosen]), chosen
    rows = agents[: len(chosen)].swapaxes(0, 1)
    _fill_poses(rows, tracks.poses[source], anchor)
    rows[..., 4:6] = turned(tracks.velocities[source], anchor[2])
    rows[..., 6:8] = tracks.sizes[source][..., ::-1]
    agents[np.arange(len(chosen)), :, 8 + kinds[chosen]] = 1.0
    static = _by_distance(present & (kinds > LAST_AGENT_KIND), now, anchor)[:OBJECTS]
    rows = objects[: len(static)]
    _fill_poses(rows, now[static], anchor)
    rows[:, 4:6] = tracks.sizes[-1, static, ::-1]
    rows[np.arange(len(static)), _OBJECT_COLUMN[kinds[static] - AgentKind.TRAFFIC_CONE]] = 1.0
    return agents, objects, chosen


def _samples_of(valid: BoolArray) -> IntArray:
    """(21, n) samples whose values are read, of tracks valid (T, n) that are present now.

    A missing sample takes the values of the next later one (nuPlan rule 337); so do those before
    the oldest sample of a short history.
    """
    last = len(valid) - 1
    own = np.where(valid, np.arange(len(valid))[:, None], last)
    later = np.minimum.accumulate(own[::-1])
    return later[np.minimum(np.arange(SAMPLES)[::-1], last)]


def _fill_poses(rows: Single, poses: FloatArray, anchor: FloatArray) -> None:
    """Write poses (..., 3) in the frame of a rear axle (3,) as x, y, cos and sin of the heading."""
    local = poses - anchor
    rows[..., :2] = turned(local, anchor[2])
    rows[..., 2], rows[..., 3] = np.cos(local[..., 2]), np.sin(local[..., 2])


def _choose_agents(
    present: BoolArray, poses: FloatArray, kinds: IntArray, anchor: FloatArray
) -> Any:
    """Tracks that the network sees, nearest first."""
    order = _by_distance(present & (kinds <= LAST_AGENT_KIND), poses, anchor)
    if len(order) <= AGENTS:
        return order
    slow = kinds[order] != AgentKind.VEHICLE
    # nuPlan rule 336: of a crowd, few pedestrians and bicycles are kept
    allowed = max(SLOW_AGENTS, AGENTS - int(np.count_nonzero(~slow)))
    return order[~slow | (np.cumsum(slow) <= allowed)][:AGENTS]


def _by_distance(chosen: BoolArray, poses: FloatArray, anchor: FloatArray) -> IntArray:
    """Chosen tracks by their distance to the rear axle."""
    tracks = np.flatnonzero(chosen)
    dx, dy = (poses[tracks, :2] - anchor[:2]).T
    return tracks[np.argsort(np.sqrt(dx * dx + dy * dy), kind="stable")]
