"""What the network of learned traffic reads of an agent: its motion, its lane, who is near.

Everything is in the agent's own frame and divided by what is usual, so that numbers are about 1.
Nothing of the future is used: at a fork the path goes on where the lanes bend least.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import point_on_polyline, project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.sim.traffic.lanes import CANDIDATES, NO_LANE, Lanes, choose_lane, next_lane
from shiftsim.world.state import AgentKind

AHEAD = np.array([3.0, 6.0, 10.0, 15.0, 22.0, 30.0, 40.0, 52.0])  # m along the path
NEIGHBOURS = 5  # nearest others that are described one by one
OWN, LANE, LEADER, OTHER = 9, 5, 5, 7  # numbers for the agent, its lane, who leads, each other
NUM_FEATURES = OWN + LANE + 2 * len(AHEAD) + LEADER + NEIGHBOURS * OTHER
PATH = OWN + LANE  # first feature of the path
REACH = 60.0  # m; what is farther away is not seen
_BEHIND = 2.0  # m that the path begins behind the agent
_MARGIN = 0.3  # m beside the boxes within which somebody ahead is in the way

VEHICLE, PEDESTRIAN, BICYCLE = (
    int(AgentKind.VEHICLE),
    int(AgentKind.PEDESTRIAN),
    int(AgentKind.BICYCLE),
)


class Motion(NamedTuple):
    """Agents as they are now, in one row. N agents."""

    present: BoolArray  # (N,) whether the agent is there
    poses: FloatArray  # (N, 3) box centre x [m], y [m], heading [rad]
    speeds: FloatArray  # (N,) along the heading [m/s]
    accelerations: FloatArray  # (N,) [m/s^2]
    turns: FloatArray  # (N,) yaw rates [rad/s]
    velocities: FloatArray  # (N, 2) in the map frame [m/s]
    sizes: FloatArray  # (N, 2) length, width [m]
    kinds: IntArray  # (N,) AgentKind


@kernel
def _trace(lanes: Lanes, edge: int, x: float, y: float, path: FloatArray) -> tuple[int, float]:
    """Write the path from a point on: (P, 3) x, y, distance along it; find the red light.

    The first point is `_BEHIND` the agent. Returns how many points there are, and the distance to
    the red light, inf if there is none.
    """
    lines = lanes.baselines
    start, stop = lines.ptr[edge], lines.ptr[edge + 1]
    along = project_on_polyline(lines.xy, lines.arc, start, stop, x, y)
    light, offset, count = np.inf, -along, 0  # offset: distance of the edge's start from the agent
    for place in range(len(path)):
        wanted = -_BEHIND if place == 0 else AHEAD[place - 1]
        while wanted - offset > lines.arc[lines.ptr[edge + 1] - 1]:
            after = next_lane(lanes, edge)
            if after == NO_LANE:
                return count, light
            offset += lines.arc[lines.ptr[edge + 1] - 1]
            edge = after
            if lanes.is_red[edge] and light == np.inf:
                light = max(offset, 0.0)
        begin, end = lines.ptr[edge], lines.ptr[edge + 1]
        px, py = point_on_polyline(lines.xy, lines.arc, begin, end, wanted - offset)
        path[place, 0], path[place, 1], path[place, 2] = px, py, wanted
        count = place + 1
    return count, light


@kernel
def _gap_ahead(path: FloatArray, count: int, reach: float, x: float, y: float) -> float:
    """Distance along a path (P, 3) to a point within `reach` of it [m]; inf if it is not."""
    for place in range(1, count):
        ax, ay, bx, by = path[place - 1, 0], path[place - 1, 1], path[place, 0], path[place, 1]
        dx, dy = bx - ax, by - ay
        square = dx * dx + dy * dy
        if square == 0.0:
            continue
        share = ((x - ax) * dx + (y - ay) * dy) / square
        if not 0.0 <= share <= 1.0:
            continue
        if abs((x - ax) * dy - (y - ay) * dx) <= reach * np.sqrt(square):
            return path[place - 1, 2] + share * (path[place, 2] - path[place - 1, 2])
    return np.inf


@kernel
def observe_agents(
    lanes: Lanes, motion: Motion, own: IntArray, followed: IntArray, out: FloatArray
) -> None:
    """Write the features (A, F) of the agents `own` (A,), and the lanes they follow (A,).

    Absent agents get zeros.
    """
    path, found = np.zeros((len(AHEAD) + 1, 3)), np.empty(CANDIDATES, np.int64)
    nearest, which = np.empty(NEIGHBOURS), np.empty(NEIGHBOURS, np.int64)
    for place in range(len(own)):
        agent, row = own[place], out[place]
        row[:] = 0.0
        if not motion.present[agent]:
            continue
        x, y, heading = motion.poses[agent]
        speed, kind = motion.speeds[agent], motion.kinds[agent]
        cos, sin = np.cos(heading), np.sin(heading)
        length, width = motion.sizes[agent]
        row[0], row[1], row[2] = (
            speed / 10.0,
            motion.accelerations[agent] / 3.0,
            motion.turns[agent],
        )
        row[3], row[4] = length / 5.0, width / 2.0
        row[5], row[6], row[7] = kind == VEHICLE, kind == PEDESTRIAN, kind == BICYCLE
        row[8] = speed < 0.3
        count, light = 0, np.inf
        if kind != PEDESTRIAN:
            followed[place] = choose_lane(lanes, x, y, heading, followed[place], found)
        if followed[place] >= 0:
            count, light = _trace(lanes, followed[place], x, y, path)
        if count > 1:
            limit = lanes.speed_limits[followed[place]]
            dx, dy = path[1, 0] - path[0, 0], path[1, 1] - path[0, 1]
            size = max(np.hypot(dx, dy), 1e-6)
            row[OWN] = 1.0
            row[OWN + 1] = 0.0 if np.isnan(limit) else limit / 10.0
            row[OWN + 2] = (dx * (y - path[0, 1]) - dy * (x - path[0, 0])) / size  # m to the left
            row[OWN + 3] = 1.0 - min(light, REACH) / REACH
            row[OWN + 4] = light < np.inf
        last = PATH
        for point in range(1, len(AHEAD) + 1):
            if point < count:
                dx, dy = path[point, 0] - x, path[point, 1] - y
                row[last] = (cos * dx + sin * dy) / 20.0
                row[last + 1] = (cos * dy - sin * dx) / 5.0
            else:  # straight on
                row[last] = AHEAD[point - 1] / 20.0
            last += 2
        nearest[:] = REACH
        which[:] = -1
        gap, leader = REACH, -1
        for other in range(len(motion.present)):
            if other == agent or not motion.present[other]:
                continue
            dx, dy = motion.poses[other, 0] - x, motion.poses[other, 1] - y
            distance = np.hypot(dx, dy)
            if distance >= REACH:
                continue
            slot = NEIGHBOURS
            while slot > 0 and distance < nearest[slot - 1]:
                slot -= 1
            if slot < NEIGHBOURS:
                for later in range(NEIGHBOURS - 1, slot, -1):
                    nearest[later], which[later] = nearest[later - 1], which[later - 1]
                nearest[slot], which[slot] = distance, other
            reach = 0.5 * (width + motion.sizes[other, 1]) + _MARGIN
            if count > 1:
                along = _gap_ahead(
                    path, count, reach, motion.poses[other, 0], motion.poses[other, 1]
                )
            else:
                along = cos * dx + sin * dy
                if abs(cos * dy - sin * dx) > reach:
                    along = np.inf
            if 0.0 < along and along - 0.5 * (length + motion.sizes[other, 0]) < gap:
                gap, leader = along - 0.5 * (length + motion.sizes[other, 0]), other
        if leader >= 0:
            vx, vy = motion.velocities[leader]
            lead = cos * vx + sin * vy
            row[last], row[last + 1] = 1.0, 1.0 - gap / REACH
            row[last + 2], row[last + 3] = (speed - lead) / 5.0, lead / 10.0
            row[last + 4] = 2.0 / max(gap + 1.0, 0.5)
        last += LEADER
        for slot in range(NEIGHBOURS):
            other = which[slot]
            if other >= 0:
                dx, dy = motion.poses[other, 0] - x, motion.poses[other, 1] - y
                vx, vy = motion.velocities[other]
                row[last] = 1.0
                row[last + 1] = (cos * dx + sin * dy) / 10.0
                row[last + 2] = (cos * dy - sin * dx) / 10.0
                row[last + 3] = (cos * vx + sin * vy - speed) / 5.0
                row[last + 4] = (cos * vy - sin * vx) / 5.0
                row[last + 5] = motion.sizes[other, 0] / 5.0
                row[last + 6] = motion.kinds[other] == PEDESTRIAN
            last += OTHER


@kernel
def move_agents(
    motion: Motion, own: IntArray, controls: FloatArray, span: float, moved: FloatArray
) -> None:
    """Where controls (A, 2), acceleration and yaw rate, take the agents `own` (A,) in `span` [s].

    Writes (A, 4) x, y, heading, speed. Who walks stops before another pedestrian.
    """
    for place in range(len(own)):
        agent = own[place]
        x, y, heading = motion.poses[agent]
        speed = max(motion.speeds[agent] + span * controls[place, 0], 0.0)
        turn = controls[place, 1] * span
        middle, way = heading + 0.5 * turn, 0.5 * (motion.speeds[agent] + speed) * span
        dx, dy = way * np.cos(middle), way * np.sin(middle)
        if motion.kinds[agent] == PEDESTRIAN and _walks_into(motion, agent, x + dx, y + dy):
            dx, dy, speed = 0.0, 0.0, 0.0
        moved[place, 0] = x + dx
        moved[place, 1] = y + dy
        moved[place, 2] = wrap_angle(heading + turn)
        moved[place, 3] = speed


@kernel
def _walks_into(motion: Motion, agent: int, x: float, y: float) -> bool:
    """Whether an agent comes nearer to a pedestrian, and too near, when it goes to a point."""
    own = np.hypot(motion.sizes[agent, 0], motion.sizes[agent, 1])
    for other in range(len(motion.present)):
        if other == agent or not motion.present[other] or motion.kinds[other] != PEDESTRIAN:
            continue
        there = motion.poses[other]
        apart = np.hypot(x - there[0], y - there[1])
        reach = 0.5 * (own + np.hypot(motion.sizes[other, 0], motion.sizes[other, 1]))
        before = np.hypot(motion.poses[agent, 0] - there[0], motion.poses[agent, 1] - there[1])
        if apart < reach and apart < before:
            return True
    return False
