"""What the Diffusion Planner's network reads.

The frame is that of the present rear axle. Lanes are resampled once per map; a step only picks the
nearest ones and turns them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.planners.learned.diffusion import kernels
from shiftsim.planners.learned.features import route_blocks
from shiftsim.planners.learned.map_features import LightLookup
from shiftsim.planners.routes.correction import RouteCorrector
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.layers import square_around
from shiftsim.world.map import VectorMap
from shiftsim.world.state import LightStatus, Tracks

RADIUS = 100.0  # m, half side of the square from which lanes are taken
LANES, ROUTE_LANES = 70, 25
SLOW_AGENTS = 10  # pedestrians and bicycles that are kept in a crowd
START_SQUARE = 1.0  # m, half side of the square that is searched for the start of the route

# one-hot position of each LightStatus; nuPlan rule 332: yellow counts as unknown
_LIGHT_COLUMN = np.array([kernels.GREEN, kernels.UNKNOWN, kernels.RED, kernels.UNKNOWN])
# likewise of cone, barrier, sign and generic object
_OBJECT_COLUMN = np.array([8, 7, 6, 9])
_RANKED = (LightStatus.GREEN, LightStatus.RED)

Single = NDArray[np.float32]


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
    route_lanes_speed_limit: Single  # (25, 1); the network does not read it
    route_lanes_has_speed_limit: BoolArray  # (25, 1); the network does not read it
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


def lane_lines(road: VectorMap) -> kernels.LaneLines:
    """The edges of a map as the network reads them."""
    rows = kernels.resample_lanes(road.baselines, road.left_boundaries, road.right_boundaries)
    return kernels.LaneLines(
        rows, kernels.line_bounds(road.baselines), road.speed_limits, road.block_of
    )


class FeatureBuilder:
    """Features of one scenario."""

    def __init__(self, scene: SceneInfo, lanes: kernels.LaneLines) -> None:
        self._road, self._lanes = scene.map, lanes
        blocks = route_blocks(scene)
        self._corrector = RouteCorrector(scene.map, blocks, START_SQUARE) if blocks else None
        self._lights = LightLookup(scene.map, ranked=_RANKED)

    def __call__(self, seen: Observation, noise: Single) -> Features:
        """Features of an observation and the start noise that goes with them."""
        anchor = np.array(seen.history.ego[-1, :3])
        road = self._road
        edges = lanes_around(road, self._lanes.bounds, anchor)
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


def lanes_around(road: VectorMap, bounds: FloatArray, anchor: FloatArray) -> IntArray:
    """Edges seen from a rear axle (3,), nearest first; `bounds` as in `LaneLines`."""
    x, y = float(anchor[0]), float(anchor[1])
    areas, lines, square = road.edges.polygons, road.baselines, square_around(x, y, RADIUS)
    near = kernels.lanes_in_square(areas, lines, bounds, road.num_lanes, square)
    return np.asarray(kernels.nearest_lanes(near, areas, lines, x, y, LANES))


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
    lanes: kernels.LaneLines,
    edges: IntArray,
    lights: IntArray,
    anchor: FloatArray,
    route: Sequence[int],
) -> dict[str, Any]:
    """The fields of `Features` about lanes: of the chosen edges, and of those on a route (blocks).

    `lights` has the one-hot position of the light of each chosen edge, `anchor` is as above.
    """
    out = (
        np.zeros((LANES, kernels.POINTS, kernels.LANE_COLUMNS), np.float32),
        np.zeros((LANES, 1), np.float32),
        np.zeros((LANES, 1), np.bool_),
    )
    kernels.fill_lanes(lanes, edges, lights, anchor, out)
    named = dict(zip(("lanes", "lanes_speed_limit", "lanes_has_speed_limit"), out, strict=True))
    on_route = lanes_on_route(lanes.blocks[edges], route)
    return {**named, **{f"route_{name}": _first_rows(named[name], on_route) for name in named}}


def _first_rows(array: Any, rows: IntArray) -> Any:
    """(25, ...) some rows of an array, then zeros."""
    out = np.zeros((ROUTE_LANES, *array.shape[1:]), array.dtype)
    out[: len(rows)] = array[rows]
    return out


def agent_features(tracks: Tracks, anchor: FloatArray) -> tuple[Single, Single, IntArray]:
    """Agents (32, 21, 11), static objects (5, 10), and which tracks the agents are."""
    agents = np.zeros((kernels.AGENTS, kernels.SAMPLES, kernels.AGENT_COLUMNS), np.float32)
    kinds, valid = _plain(tracks.kinds), _plain(tracks.valid)
    poses, sizes = _plain(tracks.poses), _plain(tracks.sizes)
    present, now = valid[-1], poses[-1]
    chosen = _choose_agents(present, now, kinds, anchor)
    velocities = _plain(tracks.velocities)
    kernels.fill_agents(chosen, valid, poses, velocities, sizes, kinds, anchor, agents)
    static = _by_distance(present & (kinds >= kernels.CONE), now, anchor)[: kernels.OBJECTS]
    return agents, _object_rows(now[static], sizes[-1, static], kinds[static], anchor), chosen


def _object_rows(
    poses: FloatArray, sizes: FloatArray, kinds: IntArray, anchor: FloatArray
) -> Single:
    """(5, 10) static objects, at most as many, in the frame of the rear axle (3,)."""
    out = np.zeros((kernels.OBJECTS, kernels.OBJECT_COLUMNS), np.float32)
    rows, local = out[: len(poses)], poses - anchor
    cos, sin = np.cos(anchor[2]), np.sin(anchor[2])
    rows[:, 0] = cos * local[:, 0] + sin * local[:, 1]
    rows[:, 1] = cos * local[:, 1] - sin * local[:, 0]
    rows[:, 2], rows[:, 3] = np.cos(local[:, 2]), np.sin(local[:, 2])
    rows[:, 4:6] = sizes[:, ::-1]
    rows[np.arange(len(rows)), _OBJECT_COLUMN[kinds - kernels.CONE]] = 1.0
    return out


def _choose_agents(
    present: BoolArray, poses: FloatArray, kinds: IntArray, anchor: FloatArray
) -> Any:
    """Tracks that the network sees, nearest first."""
    order = _by_distance(present & (kinds <= kernels.BICYCLE), poses, anchor)
    if len(order) <= kernels.AGENTS:
        return order
    slow = kinds[order] != kernels.VEHICLE
    # nuPlan rule 336: of a crowd, few pedestrians and bicycles are kept
    allowed = max(SLOW_AGENTS, kernels.AGENTS - int(np.count_nonzero(~slow)))
    return order[~slow | (np.cumsum(slow) <= allowed)][: kernels.AGENTS]


def _by_distance(chosen: BoolArray, poses: FloatArray, anchor: FloatArray) -> IntArray:
    """Chosen tracks by their distance to the rear axle."""
    tracks = np.flatnonzero(chosen)
    dx, dy = (poses[tracks, :2] - anchor[:2]).T
    return tracks[np.argsort(np.sqrt(dx * dx + dy * dy), kind="stable")]


def _plain(array: Any) -> Any:
    """The array, or a contiguous writable copy: kernels are compiled for that kind alone."""
    return array if array.flags.carray else array.copy()
