"""A compact observation: the ego, its route, and the tracks and lanes nearest to it.

Everything is in the frame of the ego's box centre, scaled to about one and clipped at `LARGEST`:
metres by 50, m/s by 20, m/s^2 by 5.
"""

from math import prod
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import ArrayLike, NDArray

from shiftsim.env.episode import Episode, Observer, as_command
from shiftsim.geometry.polylines import arc_lengths, point_on_polyline, project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned.map_features import LightLookup
from shiftsim.planners.routes.graph import lane_at
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.layers import Polylines
from shiftsim.world.state import LAST_AGENT_KIND, PACIFICA, AgentKind, LightStatus, center_poses

METRES, SPEED, ACCEL, LARGEST = 50.0, 20.0, 5.0, 4.0
ROUTE_POINTS, ROUTE_STEP = 16, 5.0  # m
TRACKS, LANES = 16, 8
LANE_POINTS, LANE_STEP = 6, 5.0  # m
REACH = 50.0  # m, lanes farther away are left out
_VEHICLE, _RED, _LAST_AGENT = int(AgentKind.VEHICLE), int(LightStatus.RED), int(LAST_AGENT_KIND)
_TO_CENTER = PACIFICA.rear_axle_to_center

Values = NDArray[np.float32]


class Seen(NamedTuple):
    """The parts of one observation, or of several of them."""

    ego: Values  # (9,) vx, ax, ay, steering angle and rate, yaw rate and acceleration, last action
    route: Values  # (16, 2) points of the route's lanes from the ego on, 5 m apart
    # (16, 11) the nearest first: 1, x, y, cosine and sine of the heading, vx, vy, length, width,
    # whether it is a pedestrian or bicycle, whether it is a static object; zeros where none
    tracks: Values
    # (8, 16) the nearest first: 1, whether it is on the route, speed limit or 0, whether its light
    # is red, six points of the centre line from the ego on, 5 m apart; zeros where there is none
    lanes: Values


SHAPES = ((9,), (ROUTE_POINTS, 2), (TRACKS, 11), (LANES, 4 + 2 * LANE_POINTS))
SIZE = sum(prod(shape) for shape in SHAPES)


def parts_of(values: Values) -> Seen:
    """The parts of observations (…, 345), as views."""
    parts, start, lead = [], 0, values.shape[:-1]
    for shape in SHAPES:
        stop = start + prod(shape)
        parts.append(values[..., start:stop].reshape(lead + shape))
        start = stop
    return Seen(*parts)


class Route(NamedTuple):
    """The line along the route, and scratch for what is nearest to the ego."""

    xy: FloatArray  # (V, 2) vertices [m]
    arc: FloatArray  # (V,) arc length at each of them [m]
    nearest: FloatArray  # (16,) scratch: distances
    indices: IntArray  # (16,) scratch: of what


class Around(NamedTuple):
    """What is around the ego, as the kernel reads it. N tracks, E lanes and connectors."""

    valid: BoolArray  # (N,)
    poses: FloatArray  # (N, 3)
    velocities: FloatArray  # (N, 2)
    sizes: FloatArray  # (N, 2)
    kinds: IntArray  # (N,) AgentKind codes
    baselines: Polylines
    bounds: FloatArray  # (E, 4) [m]
    limits: FloatArray  # (E,) [m/s], NaN where the map has none
    on_route: BoolArray  # (E,)
    status: IntArray  # (E,) LightStatus


class VectorBuilder:
    """The compact observation in one scenario."""

    def __init__(self, scene: SceneInfo) -> None:
        """Find the route's lanes; the line along them begins at the first observation."""
        self._scene = scene
        self._route: Route | None = None
        self._on_route: BoolArray = np.isin(scene.map.block_of, scene.route_blocks)
        self._lights = LightLookup(scene.map, LightStatus.ABSENT, ranked=(LightStatus.RED,))

    def at(self, observation: Observation, action: ArrayLike) -> Values:
        """The parts of `Seen`, one after the other; `action` (2,) is the last one."""
        road, ego, tracks = self._scene.map, observation.history.ego[-1], observation.history.tracks
        route = self._route = self._route or self._start(ego)
        around = Around(
            # copies: the kernel sees one type of array
            *tracks.map_arrays(lambda array: array[-1].copy()).arrays,
            np.array(tracks.kinds),
            road.baselines,
            road.edges.polygons.bounds,
            road.speed_limits,
            self._on_route,
            self._lights.at(observation.lights),
        )
        values = np.zeros(SIZE, np.float32)
        seen = parts_of(values)
        _write_observation(around, route, np.array(ego), seen)
        seen.ego[7:] = action
        return values

    def _start(self, ego: FloatArray) -> Route:
        scene = self._scene
        line = greedy_line(scene, scene.route_blocks, center_poses(ego[:3]))
        arc, most = arc_lengths(line, np.array([0, len(line)])), max(TRACKS, LANES)
        return Route(line, arc, np.zeros(most), np.zeros(most, np.int64))


def vector_observation(
    scene: SceneInfo, observation: Observation, action: ArrayLike = (0.0, 0.0)
) -> Values:
    """(345,) what a policy of `observation="vector"` sees; `action` (2,) is the last one."""
    return scene.once(VectorBuilder).at(observation, action)


class VectorObserver(Observer):
    """The compact observation: the parts of `Seen`, one after the other."""

    space: Space[Any] = spaces.Box(-LARGEST, LARGEST, (SIZE,))

    def look(self, episode: Episode) -> Values:
        """The present observation."""
        return vector_observation(episode.scene, episode.observe(), as_command(episode.action))


def greedy_line(scene: SceneInfo, blocks: list[int], center: FloatArray) -> FloatArray:
    """(V, 2) a line along the lanes of the route from the ego on, V >= 2 [m].

    It goes on in the lane of the next block that begins nearest to its end. Policies have learned
    from this one; `SceneInfo.route_line` looks further and ends elsewhere.
    """
    road, size = scene.map, scene.vehicle
    lanes = road.lanes_of(blocks)
    if not lanes:
        ahead = 1e3 * np.array([np.cos(center[2]), np.sin(center[2])])
        return np.stack([center[:2], center[:2] + ahead])
    chain = [lane_at(road, np.array(lanes), center, size.length, size.width)]
    for block in blocks[blocks.index(int(road.block_of[chain[0]])) + 1 :]:
        end, there = road.baselines.at(chain[-1])[-1], road.block_edges.at(block).tolist()
        away = {lane: np.hypot(*(road.baselines.at(lane)[0] - end)) for lane in there}
        chain += [min(away, key=away.__getitem__)] if away else []
    return np.concatenate([road.baselines.at(lane) for lane in chain])


@kernel
def _write_observation(around: Around, route: Route, ego: FloatArray, seen: Seen) -> None:
    """Write one observation of an ego in a state (11,) into zeros."""
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    x, y = ego[0] + _TO_CENTER * cos, ego[1] + _TO_CENTER * sin
    seen.ego[0] = _clip(ego[3] / SPEED)
    seen.ego[1], seen.ego[2] = _clip(ego[5] / ACCEL), _clip(ego[6] / ACCEL)
    for index in range(4):
        seen.ego[3 + index] = _clip(ego[7 + index])
    last = len(route.arc)
    start = project_on_polyline(route.xy, route.arc, 0, last, x, y)
    for point in range(ROUTE_POINTS):
        px, py = point_on_polyline(route.xy, route.arc, 0, last, start + point * ROUTE_STEP)
        _write_vector(px - x, py - y, cos, sin, METRES, seen.route[point])
    count = 0
    for track in range(len(around.kinds)):
        if around.valid[track]:
            dx, dy = around.poses[track, 0] - x, around.poses[track, 1] - y
            count = _insert_nearest(route, count, TRACKS, np.hypot(dx, dy), track)
    for place in range(count):
        track, line = route.indices[place], seen.tracks[place]
        pose, size = around.poses[track], around.sizes[track]
        line[0] = 1.0
        _write_vector(pose[0] - x, pose[1] - y, cos, sin, METRES, line[1:3])
        _write_vector(np.cos(pose[2]), np.sin(pose[2]), cos, sin, 1.0, line[3:5])
        if around.kinds[track] <= _LAST_AGENT:
            velocity = around.velocities[track]
            _write_vector(velocity[0], velocity[1], cos, sin, SPEED, line[5:7])
            line[9] = 0.0 if around.kinds[track] == _VEHICLE else 1.0
        else:
            line[10] = 1.0
        line[7], line[8] = _clip(size[0] / METRES), _clip(size[1] / METRES)
    bounds, lines, count = around.bounds, around.baselines, 0
    for edge in range(len(bounds)):
        dx = max(bounds[edge, 0] - x, 0.0, x - bounds[edge, 2])
        dy = max(bounds[edge, 1] - y, 0.0, y - bounds[edge, 3])
        limit = REACH if count < LANES else route.nearest[count - 1]
        if dx * dx + dy * dy < limit * limit:
            first, stop = lines.ptr[edge], lines.ptr[edge + 1]
            along = project_on_polyline(lines.xy, lines.arc, first, stop, x, y)
            px, py = point_on_polyline(lines.xy, lines.arc, first, stop, along)
            distance = np.hypot(px - x, py - y)
            if distance < REACH:
                count = _insert_nearest(route, count, LANES, distance, edge)
    for place in range(count):
        edge, line = route.indices[place], seen.lanes[place]
        limit = around.limits[edge]
        line[0] = 1.0
        line[1] = 1.0 if around.on_route[edge] else 0.0
        line[2] = 0.0 if np.isnan(limit) else _clip(limit / SPEED)
        line[3] = 1.0 if around.status[edge] == _RED else 0.0
        first, stop = lines.ptr[edge], lines.ptr[edge + 1]
        along = project_on_polyline(lines.xy, lines.arc, first, stop, x, y)
        for point in range(LANE_POINTS):
            ahead = along + point * LANE_STEP
            px, py = point_on_polyline(lines.xy, lines.arc, first, stop, ahead)
            vector = line[4 + 2 * point : 6 + 2 * point]
            _write_vector(px - x, py - y, cos, sin, METRES, vector)


@kernel
def _insert_nearest(route: Route, count: int, most: int, distance: float, index: int) -> int:
    """Sort something into the nearest ones; how many there are then."""
    nearest, indices = route.nearest, route.indices
    if count == most:
        if not distance < nearest[most - 1]:
            return count
        count -= 1
    place = count
    while place > 0 and nearest[place - 1] > distance:
        nearest[place], indices[place] = nearest[place - 1], indices[place - 1]
        place -= 1
    nearest[place], indices[place] = distance, index
    return count + 1


@kernel
def _write_vector(dx: float, dy: float, cos: float, sin: float, unit: float, out: Values) -> None:
    """Write a vector of the map frame in that of the ego, in a unit."""
    out[0] = _clip((cos * dx + sin * dy) / unit)
    out[1] = _clip((cos * dy - sin * dx) / unit)


@kernel
def _clip(value: float) -> float:
    return min(max(value, -LARGEST), LARGEST)
