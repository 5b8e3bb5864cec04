"""Route, lanes, goal and expert of a scenario of interPlan."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from shiftsim.edits.draft import EGO_SIZE
from shiftsim.edits.interplan.codes import COMMANDS
from shiftsim.edits.route import TOLERANCE, by_command, cut_by_time, edge_at, plan_line
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import vertex_headings
from shiftsim.kernels import FloatArray
from shiftsim.metrics.interplan import simplified
from shiftsim.metrics.route import driven_route
from shiftsim.world.lanes import nearest_heading, start_on
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

_NEAR = 300.0  # m, how far from the ego lanes of a route may be
_FAR = 10000  # lanes


@dataclass(frozen=True, slots=True)
class Plan:
    """Where the ego is to go."""

    route: tuple[str, ...]  # roadblock ids
    lanes: tuple[int, ...]  # edges of the lane plan
    goal: FloatArray  # (3,) x [m], y [m], heading [rad]
    line: FloatArray  # (K, 3) vertices of the lane plan from the ego on, with headings
    centers: FloatArray  # (T, 3) box centres of the expert
    end: float  # arc length on the line behind which a rollout ends [m]


def make_plan(
    scenario: Scenario,
    changes: Mapping[str, Any],
    details: Mapping[str, Any],
    initial: FloatArray,
) -> Plan:
    """Route, lanes, goal and expert; the ego starts in the state `initial` (11,).

    Raises:
        ConfigError: interPlan finds none.
    """
    road, center = scenario.map, center_poses(initial[None, :3])[0]
    expert = center_poses(scenario.expert[:, :3])
    letter = changes.get("goal")
    if letter is None:
        lanes = _driven_lanes(road, expert)
        line = plan_line(road, lanes, center)
        goal = scenario.expert[-1, :3].copy()
        return Plan(scenario.route, tuple(lanes), goal, line, expert, _end(line, goal))
    if letter not in COMMANDS:
        raise ConfigError(f"goal {letter!r} is not one of {', '.join(COMMANDS)}")
    command = COMMANDS[letter]
    text = (details.get("goal") or {}).get(command)
    first = _first_block(road, center)
    if text:
        x, y = (float(word) for word in str(text).split(","))
        lanes = _to_goal(road, center, first, edge_at(road, x, y))
        blocks = list(dict.fromkeys(road.block_of[lanes].tolist()))
        goal = start_on(road, lanes[-1], x, y).pose
    else:
        blocks = by_command(road, first, command, len(scenario.route))
        lanes = _by_command(road, blocks)
        duration = scenario.mapping[0]
        lanes = cut_by_time(road, lanes, duration)
        goal = plan_line_end(road, lanes[-1])
    line = plan_line(road, lanes, center)
    count = scenario.num_iterations
    # nuPlan rule 710: the expert goes from vertex to vertex, on to the end of the last lane
    centers = np.array([line[int(len(line) / count * i)] for i in range(count)])
    centers[0] = center
    route = tuple(road.blocks.ids[block] for block in blocks)
    return Plan(route, tuple(lanes), goal, line, centers, _end(line, goal))


def plan_line_end(road: VectorMap, lane: int) -> FloatArray:
    """(3,) the last vertex of a lane with its heading."""
    xy = road.baselines.at(lane)
    return np.array([*xy[-1], vertex_headings(xy)[-1]])


def _end(line: FloatArray, goal: FloatArray) -> float:
    path = shapely.LineString(line[:, :2])
    return float(shapely.line_locate_point(path, shapely.Point(goal[:2]))) - TOLERANCE


def _driven_lanes(road: VectorMap, centers: FloatArray) -> list[int]:
    """The first edge of each stretch that the expert drove, as nuPlan simplifies a route."""
    lanes = [edges[0] for edges in simplified(driven_route(road, centers))]
    if not lanes:
        raise ConfigError("the expert is on no lane")
    return lanes


def _first_block(road: VectorMap, center: FloatArray) -> int:
    x, y = float(center[0]), float(center[1])
    is_lane = bool(road.lanes_at(x, y))
    points = [(x, y), *boxes_to_corners(center, EGO_SIZE).tolist()]
    if is_lane or len(road.intersections.containing(x, y)):
        for px, py in points:
            edges = road.lanes_at(px, py) if is_lane else road.connectors_at(px, py)
            if edges:
                return int(road.block_of[nearest_heading(road, edges, center).edge])
    raise ConfigError("the ego is on no lane at the start")


def _by_command(road: VectorMap, blocks: list[int]) -> list[int]:
    within = {int(edge) for block in blocks for edge in road.block_edges.at(block)}
    goal = int(road.block_edges.at(blocks[-1])[-1])
    return _plan(road, blocks[0], goal, within, len(blocks))


def _to_goal(road: VectorMap, center: FloatArray, first: int, goal: int) -> list[int]:
    near = road.blocks.within_box(float(center[0]), float(center[1]), _NEAR).tolist()
    within = {int(edge) for block in near for edge in road.block_edges.at(block)}
    if goal not in within:
        raise ConfigError("the goal is too far away")
    return _plan(road, first, goal, within, len(near))


def _plan(road: VectorMap, first: int, goal: int, within: set[int], depth: int) -> list[int]:
    lanes: list[int] = []
    found = False
    for start in road.block_edges.at(first).tolist():
        plan, found, has_change = _search(road, start, goal, within, depth)
        if found:
            lanes = plan
            if not has_change:
                break
        elif not lanes:
            unsuccessful = plan
    # nuPlan rule 711: the last lane tried decides
    if not found:
        raise ConfigError("no lanes lead to the goal from the last lane beside the ego")
    return lanes or unsuccessful


def _search(
    road: VectorMap, start: int, goal: int, within: set[int], depth: int
) -> tuple[list[int], bool, bool]:
    """Lanes from one to another, whether there is such a way, and whether it changes lane at last.

    nuPlan rule 711: an edge that is queued after a hit beside the goal takes its place.
    """
    queue: deque[int | None] = deque([start, None])
    parents: dict[tuple[int, int], int | None] = {(start, 1): None}
    level, end, end_level = 1, start, 1
    nearest, found, has_change = _FAR, False, False
    block = int(road.block_of[goal])
    while queue:
        edge = queue.popleft()
        if level > depth:
            break
        if edge is None:
            level += 1
            queue.append(None)
            if queue[0] is None:
                break
            continue
        if edge == goal:
            end, end_level, found, has_change = edge, level, True, False
            break
        if int(road.block_of[edge]) == block and not road.is_connector(goal):
            gap = abs(int(road.lane_index[goal]) - int(road.lane_index[edge]))
            if gap < nearest:
                nearest = gap
                parents[goal, level] = parents[edge, level]
                end, end_level, found, has_change = goal, level, True, True
        for after in road.outgoing.at(edge).tolist():
            if after in within:
                queue.append(after)
                parents[after, level + 1] = edge
                end, end_level = after, level + 1
    path = [end]
    while (before := parents[end, end_level]) is not None:
        path.append(before)
        end, end_level = before, end_level - 1
    return path[::-1], found, has_change
