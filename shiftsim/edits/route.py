"""Another route: found by a command at every junction, by a goal, or given as roadblocks."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import shapely
from shapely.ops import split

from shiftsim.edits.builder import ScenarioBuilder
from shiftsim.edits.places import poses_along
from shiftsim.edits.spec import Reroute
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import arc_lengths, vertex_headings
from shiftsim.kernels import FloatArray
from shiftsim.world.events import TerminationCondition
from shiftsim.world.lanes import find_start, pose_on_line
from shiftsim.world.map import VectorMap
from shiftsim.world.state import NUM_STATE, VX, rear_poses

TURNS = {"left": math.pi / 2.0, "straight": 0.0, "right": -math.pi / 2.0}  # rad
DEFAULT_LIMIT = 15.0  # m/s, where the map has none
TOLERANCE = 0.1  # m, before the goal
_MAX_DEPTH = 200  # lanes of a route
_MIN_LENGTH = 5.0  # m


def reroute(builder: ScenarioBuilder, wanted: Reroute, *, ends: bool) -> None:
    """Change route, goal and expert, who drives evenly along its lanes; or a ConfigError."""
    road, center = builder.scenario.map, builder.center
    start = find_start(road, center)
    if start is None:
        raise ConfigError("reroute: the ego is on no lane at the start")
    first = int(road.block_of[start.edge])
    if wanted.goal:
        goal_edge = edge_at(road, *wanted.goal)
        lanes = plan_lanes(road, first, goal_edge, range(len(road.blocks)), depth=_MAX_DEPTH)
    else:
        blocks = _blocks(road, wanted, first, max(3, len(builder.scenario.route)))
        goal_edge = int(road.block_edges.at(blocks[-1])[-1])
        lanes = plan_lanes(road, first, goal_edge, blocks)
    if not lanes:
        what = wanted.command or wanted.goal or "the roadblocks given"
        raise ConfigError(f"reroute: no lanes lead from the ego to {what}")
    if wanted.command:
        times = builder.scenario.iteration_times
        lanes = cut_by_time(road, lanes, float(times[-1] - times[0]) * 1e-6)
    line = plan_line(road, lanes, center)[:, :2]
    end = line[-1] if not wanted.goal else np.array(wanted.goal)
    path = shapely.LineString(line)
    total, goal = pose_on_line(path, float(end[0]), float(end[1]))
    if total < _MIN_LENGTH:
        raise ConfigError(f"reroute: the goal is {total:.1f} m ahead, at least 5 m are needed")
    ids = [road.blocks.ids[block] for block in dict.fromkeys(road.block_of[lanes].tolist())]
    builder.change(ego=_drive(builder, line, total), route=tuple(ids), mission_goal=goal)
    if ends:
        builder.termination = TerminationCondition(
            line, total - TOLERANCE, int(road.block_of[lanes[-1]])
        )


def _blocks(road: VectorMap, wanted: Reroute, first: int, count: int) -> list[int]:
    if not wanted.route:
        return by_command(road, first, wanted.command, count)
    lost = [name for name in wanted.route if name not in road.blocks.index]
    if lost:
        raise ConfigError(f"reroute: map {road.name!r} has no roadblock {lost[0]!r}")
    blocks = [road.blocks.index[name] for name in wanted.route]
    if first not in blocks:
        what = f"reroute: the route does not hold roadblock {road.blocks.ids[first]!r} of the ego"
        raise ConfigError(what)
    return blocks[blocks.index(first) :]


def _drive(builder: ScenarioBuilder, line: FloatArray, total: float) -> FloatArray:
    """(R, 11) ego states that go evenly along a path (K, 2) in the window, and stand at its end."""
    scenario, now = builder.scenario, builder.now
    ego, seconds = np.array(scenario.ego), builder.seconds
    duration = seconds[scenario.iteration_rows[-1]]
    after = np.arange(now + 1, len(ego))
    along = np.minimum(seconds[after] / duration, 1.0) * total
    poses = poses_along(line, arc_lengths(line, np.array([0, len(line)])), along)
    ego[after] = np.zeros((len(after), NUM_STATE))
    ego[after, :3] = rear_poses(poses)
    ego[after, VX] = np.where(along < total, total / duration, 0.0)
    return ego


def edge_at(road: VectorMap, x: float, y: float) -> int:
    """The lane at a point, else its only connector (or a ConfigError), else the nearest lane."""
    edges = road.lanes_at(x, y) or road.connectors_at(x, y)
    if len(edges) > 1:
        raise ConfigError(f"goal ({x:.1f}, {y:.1f}) is on {len(edges)} lanes or connectors")
    if edges:
        return edges[0]
    point = shapely.Point(x, y)
    return min(range(road.num_lanes), key=lambda lane: road.edges.shape(lane).distance(point))


def by_command(road: VectorMap, first: int, command: str, count: int) -> list[int]:
    """Up to `count` roadblocks, each the successor that turns most like the command."""
    blocks = [first]
    while len(blocks) < count:
        following = road.block_outgoing.at(blocks[-1]).tolist()
        if not following:
            break
        heading = _end_heading(road, blocks[-1])
        turn = TURNS[command]
        errors = [
            abs(turn - wrap_angle(_end_heading(road, block) - heading)) for block in following
        ]
        blocks.append(following[int(np.argmin(errors))])
    return blocks


def _end_heading(road: VectorMap, block: int) -> float:
    """Heading at the end of the first lane of a roadblock [rad]."""
    line = road.baselines.at(int(road.block_edges.at(block)[0]))
    return float(vertex_headings(line)[-1])


def plan_lanes(
    road: VectorMap,
    first: int,
    goal: int,
    blocks: Sequence[int],
    *,
    depth: int = 0,
    keeps_oddities: bool = False,
) -> list[int]:
    """Lanes from a roadblock to an edge, without a lane change where there is such a way.

    They are those of `blocks`, at most `depth`, or one of each block where that is 0. The last
    change of lane, where one is needed, is within the roadblock of the goal. Empty where there is
    no way, and with interPlan's oddities where there is none from the last lane tried: nuPlan rule
    711.
    """
    candidates = {int(edge) for block in blocks for edge in road.block_edges.at(block)}
    depth = depth or len(blocks)
    lanes: list[int] = []
    found = False
    for start in road.block_edges.at(first).tolist():
        plan, found, has_change = _search(road, start, goal, candidates, depth, keeps_oddities)
        lanes = plan if found else lanes
        if found and not has_change:
            break
    return [] if keeps_oddities and not found else lanes


def _search(
    road: VectorMap, start: int, goal: int, candidates: set[int], depth: int, keeps_oddities: bool
) -> tuple[list[int], bool, bool]:
    """Breadth first from an edge to the goal, else to the edge beside it that comes nearest.

    nuPlan rule 711: interPlan visits an edge as often as it is reached, and an edge that is queued
    after a hit beside the goal takes its place.

    Returns:
        The edges, whether the goal was found, and whether with a change of lane at the end.
    """
    end = (start, 1)  # an edge, and how many edges lead to it
    parents: dict[tuple[int, int], tuple[int, int] | None] = {end: None}
    queue, seen = deque([end]), {start}
    block, nearest, found, has_change = int(road.block_of[goal]), math.inf, False, False
    while queue:
        edge, level = at = queue.popleft()
        if level > depth:
            break
        if edge == goal:
            end, found, has_change = at, True, False
            break
        is_beside = int(road.block_of[edge]) == block
        if is_beside and not (keeps_oddities and road.is_connector(goal)):
            gap = abs(int(road.lane_index[goal]) - int(road.lane_index[edge]))
            if gap < nearest:
                nearest, end, found, has_change = gap, (goal, level), True, True
                if keeps_oddities or end not in parents:
                    parents[end] = parents[at]
        for after in road.outgoing.at(edge).tolist():
            if after in candidates and (keeps_oddities or after not in seen):
                seen.add(after)
                queue.append((after, level + 1))
                parents[after, level + 1] = at
                end = (after, level + 1) if keeps_oddities else end
    path = [end]
    while (before := parents[path[-1]]) is not None:
        path.append(before)
    return [edge for edge, _ in path[::-1]], found, has_change


def cut_by_time(road: VectorMap, lanes: Sequence[int], seconds: float) -> list[int]:
    """The lanes that are driven within a time at their speed limits, the last one whole."""
    time = 0.0
    for index, lane in enumerate(lanes):
        limit = float(road.speed_limits[lane])
        has_limit = not math.isnan(limit) and limit != 0.0
        time += road.baselines.length(lane) / (limit if has_limit else DEFAULT_LIMIT)
        if time > seconds:
            return list(lanes[: index + 1])
    return list(lanes)


def plan_line(road: VectorMap, lanes: Sequence[int], center: FloatArray) -> FloatArray:
    """(K, 3) vertices of the centre lines of lanes with headings, the first cut at the ego."""
    line = shapely.LineString(road.baselines.at(lanes[0]))
    _, pose = pose_on_line(line, float(center[0]), float(center[1]))
    # cut by a tiny disc, as interPlan does: its vertices are those of the reference
    pieces = split(line, shapely.Point(pose[0], pose[1]).buffer(0.0001))
    first = np.array(pieces.geoms[-1].coords)
    parts = [first, *(road.baselines.at(lane) for lane in lanes[1:])]
    return np.concatenate([np.column_stack([xy, vertex_headings(xy)]) for xy in parts])
