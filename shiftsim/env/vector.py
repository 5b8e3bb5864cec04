"""A compact observation: the ego, its route, and the tracks and lanes nearest to it.

Everything is in the frame of the ego's box centre, scaled to about one and cut at `LARGEST`: metres
by 50, m/s by 20, m/s^2 by 5.
"""

from math import prod
from typing import Any, NamedTuple

import numpy as np
from gymnasium import Space, spaces
from numpy.typing import NDArray

from shiftsim.arrays import BoolArray, FloatArray, IntArray, lean_kernel
from shiftsim.env.episode import Episode
from shiftsim.geometry.polylines import arc_lengths, point_on_polyline, project_on_polyline
from shiftsim.planners.learned.features import route_blocks
from shiftsim.planners.learned.map_features import LightLookup
from shiftsim.planners.routes.graph import lane_at, lanes_of
from shiftsim.sim.planner import SceneInfo
from shiftsim.world.layers import Polygons, Polylines
from shiftsim.world.map import VectorMap
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    PACIFICA,
    AgentKind,
    LightStatus,
    center_poses,
)

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


class Surroundings(NamedTuple):
    """What the kernel reads. K samples, N tracks, E edges."""

    ego: FloatArray
    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray
    kinds: IntArray
    edges: Polygons
    baselines: Polylines
    limits: FloatArray
    on_route: BoolArray  # (E,)
    route: FloatArray  # (V, 2) vertices of the route's centre line [m]
    route_arc: FloatArray  # (V,)
    nearest: FloatArray  # (16,) scratch
    indices: IntArray  # (16,) scratch


class VectorObserver:
    """The compact observation: the parts of `Seen`, one after the other."""

    space: Space[Any] = spaces.Box(-LARGEST, LARGEST, (SIZE,))

    def start(self, episode: Episode) -> None:
        """Find the route's lanes."""
        scene, log = episode.scene, episode.log
        road, tracks = scene.map, log.tracks
        blocks = route_blocks(scene)
        on_route = np.zeros(len(road.edges), np.bool_)
        on_route[lanes_of(road, blocks)] = True
        line = route_line(scene, blocks, center_poses(log.ego[0, :3]))
        self._lights = LightLookup(road, LightStatus.ABSENT)
        self._around = Surroundings(
            log.ego,
            tracks.valid,
            tracks.poses,
            tracks.velocities,
            tracks.sizes,
            tracks.kinds.copy(),
            road.edges.polygons,
            road.baselines,
            road.speed_limits,
            on_route,
            line,
            arc_lengths(line, np.array([0, len(line)])),
            np.zeros(max(TRACKS, LANES)),
            np.zeros(max(TRACKS, LANES), np.int64),
        )

    def look(self, episode: Episode) -> Values:
        """The present observation."""
        row = episode.iteration
        status = self._lights.at(episode.log.traffic_lights.rows(slice(row, row + 1)))
        values = np.zeros(SIZE, np.float32)
        seen = parts_of(values)
        _look(self._around, row, status, seen)
        if episode.action.shape == (2,):
            seen.ego[7:] = episode.action
        return values


def route_line(scene: SceneInfo, blocks: list[int], center: FloatArray) -> FloatArray:
    """(V, 2) a line along the lanes of the route from the ego on, V >= 2 [m].

    Where a lane does not lead on, the line goes on in the lane of the next block that begins
    nearest to its end.
    """
    road, size = scene.map, scene.vehicle
    lanes = lanes_of(road, blocks)
    if not lanes:
        ahead = 1e3 * np.array([np.cos(center[2]), np.sin(center[2])])
        return np.stack([center[:2], center[:2] + ahead])
    chain = [lane_at(road, np.array(lanes), center, size.length, size.width)]
    for block in blocks[blocks.index(int(road.block_of[chain[0]])) + 1 :]:
        chain += _next_lane(road, chain[-1], block)
    return np.concatenate([road.baselines.at(lane) for lane in chain])


def _next_lane(road: VectorMap, lane: int, block: int) -> list[int]:
    there = road.block_edges.at(block).tolist()
    after = [edge for edge in road.outgoing.at(lane).tolist() if edge in there]
    end = road.baselines.at(lane)[-1]
    starts = {edge: np.hypot(*(road.baselines.at(edge)[0] - end)) for edge in after or there}
    return [min(starts, key=starts.__getitem__)] if starts else []


@lean_kernel
def _look(around: Surroundings, row: int, status: IntArray, seen: Seen) -> None:
    """Write one observation into zeros."""
    ego = around.ego[row]
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    x, y = ego[0] + _TO_CENTER * cos, ego[1] + _TO_CENTER * sin
    seen.ego[0] = _cut(ego[3] / SPEED)
    seen.ego[1], seen.ego[2] = _cut(ego[5] / ACCEL), _cut(ego[6] / ACCEL)
    for index in range(4):
        seen.ego[3 + index] = _cut(ego[7 + index])
    arc, last = around.route_arc, len(around.route_arc)
    start = project_on_polyline(around.route, arc, 0, last, x, y)
    for point in range(ROUTE_POINTS):
        px, py = point_on_polyline(around.route, arc, 0, last, start + point * ROUTE_STEP)
        _place(px - x, py - y, cos, sin, METRES, seen.route[point])
    _look_at_tracks(around, row, x, y, cos, sin, seen.tracks)
    _look_at_lanes(around, status, x, y, cos, sin, seen.lanes)


@lean_kernel
def _look_at_tracks(
    around: Surroundings, row: int, x: float, y: float, cos: float, sin: float, out: Values
) -> None:
    count = 0
    for track in range(len(around.kinds)):
        if around.valid[row, track]:
            dx, dy = around.poses[row, track, 0] - x, around.poses[row, track, 1] - y
            count = _keep(around, count, len(out), np.hypot(dx, dy), track)
    for place in range(count):
        track, line = around.indices[place], out[place]
        pose, size = around.poses[row, track], around.sizes[row, track]
        line[0] = 1.0
        _place(pose[0] - x, pose[1] - y, cos, sin, METRES, line[1:3])
        _place(np.cos(pose[2]), np.sin(pose[2]), cos, sin, 1.0, line[3:5])
        if around.kinds[track] <= _LAST_AGENT:
            velocity = around.velocities[row, track]
            _place(velocity[0], velocity[1], cos, sin, SPEED, line[5:7])
            line[9] = 0.0 if around.kinds[track] == _VEHICLE else 1.0
        else:
            line[10] = 1.0
        line[7], line[8] = _cut(size[0] / METRES), _cut(size[1] / METRES)


@lean_kernel
def _look_at_lanes(
    around: Surroundings, status: IntArray, x: float, y: float, cos: float, sin: float, out: Values
) -> None:
    bounds, lines, count = around.edges.bounds, around.baselines, 0
    for edge in range(len(bounds)):
        dx = max(bounds[edge, 0] - x, 0.0, x - bounds[edge, 2])
        dy = max(bounds[edge, 1] - y, 0.0, y - bounds[edge, 3])
        limit = REACH if count < len(out) else around.nearest[count - 1]
        if dx * dx + dy * dy < limit * limit:
            first, stop = lines.ptr[edge], lines.ptr[edge + 1]
            along = project_on_polyline(lines.xy, lines.arc, first, stop, x, y)
            px, py = point_on_polyline(lines.xy, lines.arc, first, stop, along)
            distance = np.hypot(px - x, py - y)
            if distance < REACH:
                count = _keep(around, count, len(out), distance, edge)
    for place in range(count):
        edge, line = around.indices[place], out[place]
        limit = around.limits[edge]
        line[0] = 1.0
        line[1] = 1.0 if around.on_route[edge] else 0.0
        line[2] = 0.0 if np.isnan(limit) else _cut(limit / SPEED)
        line[3] = 1.0 if status[edge] == _RED else 0.0
        first, stop = lines.ptr[edge], lines.ptr[edge + 1]
        along = project_on_polyline(lines.xy, lines.arc, first, stop, x, y)
        for point in range(LANE_POINTS):
            ahead = along + point * LANE_STEP
            px, py = point_on_polyline(lines.xy, lines.arc, first, stop, ahead)
            _place(px - x, py - y, cos, sin, METRES, line[4 + 2 * point : 6 + 2 * point])


@lean_kernel
def _keep(around: Surroundings, count: int, most: int, distance: float, index: int) -> int:
    """Sort something into the nearest ones; how many there are then."""
    nearest, indices = around.nearest, around.indices
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


@lean_kernel
def _place(dx: float, dy: float, cos: float, sin: float, unit: float, out: Values) -> None:
    """Write a vector of the map frame in that of the ego, in a unit."""
    out[0] = _cut((cos * dx + sin * dy) / unit)
    out[1] = _cut((cos * dy - sin * dx) / unit)


@lean_kernel
def _cut(value: float) -> float:
    return min(max(value, -LARGEST), LARGEST)
