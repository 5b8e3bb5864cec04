"""One step of all reactive agents, one after the other (nuplan-simulation.md §10.2).

Everything that can be in the way is an *obstacle*: first the agents, then the ego, then the
replayed objects; stop lines are looked up in the map. Later agents see the already moved earlier
ones.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry import box_corners, wrap_angle
from shiftsim.layers import Polygons
from shiftsim.state import LightStatus
from shiftsim.traffic.idm_buffer import buffer_curve
from shiftsim.traffic.idm_paths import (
    PROGRESS,
    Fleet,
    Roads,
    clamp_progress,
    extend_route,
    first_after,
    pose_on_path,
)
from shiftsim.traffic.idm_policy import idm_step
from shiftsim.traffic.idm_shapes import (
    MEETING,
    PIECE,
    UNSURE,
    bound_pieces,
    last_near_piece,
    num_pieces,
    ring_bounds,
    ring_gap,
    touches_corridor,
)

_RED = int(LightStatus.RED)
_BOX = 4  # vertices


class Obstacles(NamedTuple):
    """What agents must not run into. M obstacles: A agents, the ego, the replayed objects.

    Attributes:
        present: (M,) whether it is there.
        bounds: (M, 4) min x, min y, max x, max y [m].
        box: (M, 4, 2) corners [m].
        speed: (M,) along its heading [m/s]; agents' are in the fleet.
        heading: (M,) [rad]; agents' are in the fleet.
        curve: (A, V, 2) buffers of the path pieces just ahead of the agents [m].
        curve_size: (A,) how many vertices of them count; 0 before the first step.
    """

    present: BoolArray
    bounds: FloatArray
    box: FloatArray
    speed: FloatArray
    heading: FloatArray
    curve: FloatArray
    curve_size: IntArray


class Scratch(NamedTuple):
    """Room for intermediate results of one agent.

    Attributes:
        line: (K, 2) a piece of a path [m].
        keep: (K,) flags of its vertices.
        pieces: (C, 4) bounding boxes of the line's pieces [m].
        corridor: (W, 2) outline of the buffer of the path ahead [m].
        hits: (M,) obstacles in the corridor.
    """

    line: FloatArray
    keep: BoolArray
    pieces: FloatArray
    corridor: FloatArray
    hits: IntArray


class Driving(NamedTuple):
    """Parameters of the agents' policy; see `idm_policy`."""

    min_gap: float
    headway: float
    accel_max: float
    decel_max: float


@kernel
def set_box(
    obstacles: Obstacles,
    index: int,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
) -> None:
    """Put an obstacle without a path where its box is."""
    box_corners(x, y, heading, length, width, obstacles.box[index])
    obstacles.present[index] = True
    obstacles.heading[index] = heading
    _reset_bounds(obstacles, index)


@kernel
def place_replayed(
    obstacles: Obstacles,
    first: int,
    replayed: IntArray,
    valid: BoolArray,
    poses: FloatArray,
    sizes: FloatArray,
) -> int:
    """Put the replayed tracks that are present among the obstacles.

    Args:
        obstacles: The obstacles.
        first: Place of the first one.
        replayed: (R,) which tracks are replayed.
        valid: (N,) whether a track is present.
        poses: (N, 3) x [m], y [m], heading [rad].
        sizes: (N, 2) length, width [m].

    Returns:
        How many obstacles count now.
    """
    count = first
    for track in replayed:
        if valid[track]:
            x, y, heading = poses[track, 0], poses[track, 1], poses[track, 2]
            set_box(obstacles, count, x, y, heading, sizes[track, 0], sizes[track, 1])
            count += 1
    return count


@kernel
def set_speeds(
    obstacles: Obstacles, first: int, replayed: IntArray, valid: BoolArray, velocities: FloatArray
) -> None:
    """Give the replayed tracks, placed from `first` on, the speed they really have."""
    index = first
    for track in replayed:
        if valid[track]:
            vx, vy = velocities[track, 0], velocities[track, 1]
            speed = np.hypot(vx, vy)  # NaN for static objects
            obstacles.speed[index] = speed if speed > 0.0 else 0.0
            obstacles.heading[index] = np.arctan2(vy, vx) if speed > 0.0 else 0.0
            index += 1


@kernel
def write_agents(
    fleet: Fleet,
    tracks: IntArray,
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
) -> None:
    """Write the agents into a row of tracks: (N,), (N, 3), (N, 2), (N, 2); the gone as absent."""
    for agent in range(len(tracks)):
        track = tracks[agent]
        alive = fleet.alive[agent]
        heading, speed = fleet.pose[agent, 2], fleet.speed[agent]
        valid[track] = alive
        for column in range(3):
            poses[track, column] = fleet.pose[agent, column] if alive else np.nan
        velocities[track, 0] = speed * np.cos(heading) if alive else np.nan
        velocities[track, 1] = speed * np.sin(heading) if alive else np.nan
        for column in range(2):
            sizes[track, column] = fleet.size[agent, column] if alive else np.nan


@kernel
def remove_far(fleet: Fleet, obstacles: Obstacles, x: float, y: float, radius: float) -> None:
    """Remove agents whose centre is farther than `radius` from (x, y), for good."""
    for agent in range(len(fleet.alive)):
        dx, dy = fleet.pose[agent, 0] - x, fleet.pose[agent, 1] - y
        if fleet.alive[agent] and np.sqrt(dx * dx + dy * dy) > radius:
            fleet.alive[agent] = False
            obstacles.present[agent] = False


@kernel
def extend_routes(
    fleet: Fleet, roads: Roads, status: IntArray, min_length: float, headway: float
) -> int:
    """Extend the routes of all agents (see `extend_route`); 0, or the room a path needs."""
    for agent in range(len(fleet.alive)):
        if fleet.alive[agent]:
            needed = extend_route(fleet, agent, roads, status, min_length, headway)
            if needed > 0:
                return needed
    return 0


@kernel
def _reset_bounds(obstacles: Obstacles, index: int) -> None:
    bounds = obstacles.bounds[index]
    bounds[0], bounds[1], bounds[2], bounds[3] = np.inf, np.inf, -np.inf, -np.inf
    ring_bounds(obstacles.box[index], _BOX, bounds)


@kernel
def remaining_path(fleet: Fleet, agent: int, line: FloatArray) -> int:
    """Write the path ahead of an agent into `line` (K, 2); returns its number of vertices."""
    path, size = fleet.path[agent], fleet.path_size[agent]
    progress = clamp_progress(path, size, fleet.progress[agent])
    after = first_after(path, size, progress)
    if after == size:
        return _copy(path, size - 2, size, line, 0)  # §12 Q13
    x, y, _ = pose_on_path(path, size, progress)
    line[0, 0], line[0, 1] = x, y
    return _copy(path, after, size, line, 1)


@kernel
def path_piece(fleet: Fleet, agent: int, start: float, stop: float, line: FloatArray) -> int:
    """Write the path between two progresses, clamped to it, into `line` (K, 2)."""
    path, size = fleet.path[agent], fleet.path_size[agent]
    first, last = clamp_progress(path, size, start), clamp_progress(path, size, stop)
    after = first_after(path, size, first)
    if after == size:
        return _copy(path, size - 2, size, line, 0)
    if not path[0, PROGRESS] < last:
        return _copy(path, 0, 2, line, 0)
    x, y, _ = pose_on_path(path, size, first)
    line[0, 0], line[0, 1] = x, y
    end = after
    while end < size and path[end, PROGRESS] < last:
        end += 1
    count = _copy(path, after, end, line, 1)
    x, y, _ = pose_on_path(path, size, last)
    line[count, 0], line[count, 1] = x, y
    return count + 1


@kernel
def _copy(path: FloatArray, start: int, stop: int, line: FloatArray, count: int) -> int:
    for vertex in range(start, stop):
        line[count, 0] = path[vertex, 0]
        line[count, 1] = path[vertex, 1]
        count += 1
    return count


@kernel
def find_hits(
    fleet: Fleet, agent: int, obstacles: Obstacles, count: int, scratch: Scratch
) -> tuple[int, int]:
    """Obstacles that meet the corridor along the path ahead of an agent.

    Returns:
        How many there are (in `scratch.hits`), and the number of vertices of the path ahead (in
        `scratch.line`).
    """
    half_width = 0.5 * fleet.size[agent, 1]
    size = remaining_path(fleet, agent, scratch.line)
    bound_pieces(scratch.line, size, scratch.pieces)
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for piece in range(num_pieces(size)):
        bounds = scratch.pieces[piece]
        low_x, low_y = min(low_x, bounds[0]), min(low_y, bounds[1])
        high_x, high_y = max(high_x, bounds[2]), max(high_y, bounds[3])
    margin = 1.1 * half_width
    low_x, low_y, high_x, high_y = low_x - margin, low_y - margin, high_x + margin, high_y + margin
    hits = 0
    for other in range(count):
        bounds = obstacles.bounds[other]
        if (
            other == agent
            or not obstacles.present[other]
            or bounds[0] > high_x
            or bounds[1] > high_y
            or bounds[2] < low_x
            or bounds[3] < low_y
        ):
            continue
        hit = False
        if other < len(obstacles.curve) and obstacles.curve_size[other]:
            curve, curve_size = obstacles.curve[other], obstacles.curve_size[other]
            hit = _meets(half_width, curve, curve_size, bounds, size, scratch)
        if hit or _meets(half_width, obstacles.box[other], _BOX, bounds, size, scratch):
            scratch.hits[hits] = other
            hits += 1
    return hits, size


@kernel
def _meets(
    half_width: float,
    ring: FloatArray,
    ring_size: int,
    bounds: FloatArray,
    size: int,
    scratch: Scratch,
) -> bool:
    """Whether a ring meets the corridor along the first `size` vertices of `scratch.line`."""
    line, pieces = scratch.line, scratch.pieces
    found = touches_corridor(line, size, pieces, half_width, ring, ring_size, bounds)
    if found != UNSURE:
        return found == MEETING
    # of the exact corridor only what comes up to the ring is needed, and a piece to spare
    near = min((last_near_piece(pieces, size, half_width, bounds) + 2) * PIECE + 1, size)
    outline = buffer_curve(line, near, half_width, scratch.keep, scratch.corridor)
    return ring_gap(ring, ring_size, scratch.corridor, outline, 1e-3) == 0.0


@kernel
def footprint_gap(
    obstacles: Obstacles, agent: int, ring: FloatArray, ring_size: int, limit: float
) -> float:
    """Distance from an agent's footprint to a ring, at most `limit` [m]."""
    best = limit
    if obstacles.curve_size[agent]:
        size = obstacles.curve_size[agent]
        best = ring_gap(obstacles.curve[agent], size, ring, ring_size, best)
    if best > 0.0:
        best = ring_gap(obstacles.box[agent], _BOX, ring, ring_size, best)
    return best


@kernel
def _bounds_apart(bounds: FloatArray, a: int, b: int) -> float:
    """Lower bound of the distance between two obstacles [m]."""
    apart_x = max(bounds[a, 0] - bounds[b, 2], bounds[b, 0] - bounds[a, 2])
    apart_y = max(bounds[a, 1] - bounds[b, 3], bounds[b, 1] - bounds[a, 3])
    return max(apart_x, apart_y)


@kernel
def find_lead(
    fleet: Fleet,
    agent: int,
    obstacles: Obstacles,
    count: int,
    roads: Roads,
    stops: Polygons,
    status: IntArray,
    scratch: Scratch,
) -> tuple[int, float]:
    """The nearest obstacle in the corridor ahead of an agent, and the gap to it.

    Returns:
        Its index, `count` for a stop line, -1 where the corridor is free; the gap between the
        footprints [m].
    """
    half_width = 0.5 * fleet.size[agent, 1]
    hits, size = find_hits(fleet, agent, obstacles, count, scratch)
    best, lead = np.inf, -1
    for index in range(hits):
        other = scratch.hits[index]
        if best == 0.0:
            break
        if _bounds_apart(obstacles.bounds, agent, other) >= best:
            continue
        gap = best
        if other < len(obstacles.curve) and obstacles.curve_size[other]:
            curve, curve_size = obstacles.curve[other], obstacles.curve_size[other]
            gap = footprint_gap(obstacles, agent, curve, curve_size, gap)
        gap = footprint_gap(obstacles, agent, obstacles.box[other], _BOX, gap)
        if gap < best:
            best, lead = gap, other
    for segment in range(fleet.route_size[agent]):
        edge = fleet.route[agent, segment]
        if status[edge] != _RED:
            continue
        for entry in range(roads.stop_lines.ptr[edge], roads.stop_lines.ptr[edge + 1]):
            stop = roads.stop_lines.items[entry]
            first = stops.ring_ptr[stops.poly_ptr[stop]]
            last = stops.ring_ptr[stops.poly_ptr[stop] + 1]
            ring = stops.xy[first:last]
            if _meets(half_width, ring, last - first, stops.bounds[stop], size, scratch):
                gap = footprint_gap(obstacles, agent, ring, last - first, best)
                if gap < best:
                    best, lead = gap, count
    return lead, best


@kernel
def move_agent(
    fleet: Fleet,
    agent: int,
    obstacles: Obstacles,
    scratch: Scratch,
    headway: float,
) -> int:
    """Pose and footprint of an agent from its progress; returns -1 where a curve is too long."""
    path, size = fleet.path[agent], fleet.path_size[agent]
    progress = fleet.progress[agent]
    x, y, heading = pose_on_path(path, size, clamp_progress(path, size, progress))
    fleet.pose[agent, 0], fleet.pose[agent, 1], fleet.pose[agent, 2] = x, y, heading
    length, width = fleet.size[agent, 0], fleet.size[agent, 1]
    set_box(obstacles, agent, x, y, heading, length, width)
    front = progress + 0.5 * length + fleet.speed[agent] * headway
    points = path_piece(fleet, agent, progress - 0.5 * length, front, scratch.line)
    curve = obstacles.curve[agent]
    made = buffer_curve(scratch.line, points, 0.5 * width, scratch.keep, curve)
    obstacles.curve_size[agent] = max(made, 0)
    ring_bounds(curve, obstacles.curve_size[agent], obstacles.bounds[agent])
    return made


@kernel
def step_agents(
    fleet: Fleet,
    obstacles: Obstacles,
    count: int,
    roads: Roads,
    stops: Polygons,
    status: IntArray,
    driving: Driving,
    span: float,
    scratch: Scratch,
    first: int,
) -> int:
    """Move every agent from `first` on by one step; routes must be long enough already.

    Args:
        fleet: The agents.
        obstacles: Agents, ego and replayed objects of this step.
        count: How many obstacles count.
        roads: The map.
        stops: Its stop polygons.
        status: (E,) LightStatus codes.
        driving: Parameters of the policy.
        span: Length of the step [s].
        scratch: Room.
        first: Agent to begin with.

    Returns:
        The number of agents; or the agent whose footprint does not fit into `obstacles.curve`: give
        it more room, repeat `move_agent` and go on with the next agent.
    """
    for agent in range(first, len(fleet.alive)):
        if not fleet.alive[agent]:
            continue
        path, size = fleet.path[agent], fleet.path_size[agent]
        lead, gap = find_lead(fleet, agent, obstacles, count, roads, stops, status, scratch)
        lead_speed, lead_heading = 0.0, fleet.pose[agent, 2]
        if lead < 0:
            # nuPlan: on a free road the agent brakes for the end of its path (§10.2)
            gap = path[size - 1, PROGRESS] - fleet.progress[agent] - 0.5 * fleet.size[agent, 0]
        elif lead < len(fleet.alive):
            lead_speed, lead_heading = fleet.speed[lead], fleet.pose[lead, 2]
        elif lead < count:
            lead_speed, lead_heading = obstacles.speed[lead], obstacles.heading[lead]
        limit = roads.speed_limits[fleet.route[agent, fleet.route_size[agent] - 1]]
        if limit > 0.0:
            fleet.target[agent] = limit
        distance, speed = idm_step(
            fleet.speed[agent],
            gap,
            lead_speed * np.cos(wrap_angle(lead_heading - fleet.pose[agent, 2])),
            fleet.target[agent],
            driving.min_gap,
            driving.headway,
            driving.accel_max,
            driving.decel_max,
            span,
        )
        fleet.progress[agent] += distance
        fleet.speed[agent] = max(speed, 0.0)
        if move_agent(fleet, agent, obstacles, scratch, driving.headway) < 0:
            return agent
    return len(fleet.alive)
