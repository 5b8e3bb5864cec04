"""Route, lanes, goal and expert of a scenario of interPlan."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import shapely

from shiftsim.edits.builder import EGO_SIZE
from shiftsim.edits.interplan.codes import COMMANDS
from shiftsim.edits.route import TOLERANCE, by_command, cut_by_time, edge_at, plan_lanes, plan_line
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import vertex_headings
from shiftsim.kernels import FloatArray
from shiftsim.world.lanes import nearest_heading, start_on
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import center_poses

_NEAR = 300.0  # m, how far from the ego lanes of a route may be
# lanes that box centres (K, 3) were on, in turn: metrics.interplan.driven_lanes
DrivenLanes: TypeAlias = Callable[[VectorMap, FloatArray], list[int]]


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
    driven_lanes: DrivenLanes,
) -> Plan:
    """Route, lanes, goal and expert from a state `initial` (11,), or a ConfigError without any."""
    road, center = scenario.map, center_poses(initial[None, :3])[0]
    expert = center_poses(scenario.expert[:, :3])
    letter = changes.get("goal")
    if letter is None:
        lanes = driven_lanes(road, expert)
        if not lanes:
            raise ConfigError("the expert is on no lane")
        line = plan_line(road, lanes, center)
        goal = scenario.expert[-1, :3].copy()
        return Plan(scenario.route, tuple(lanes), goal, line, expert, _end(line, goal))
    if letter not in COMMANDS:
        raise ConfigError(f"goal {letter!r} is not one of {', '.join(COMMANDS)}")
    command = COMMANDS[letter]
    text = (details.get("goal") or {}).get(command)
    beside = edges_under(road, center, EGO_SIZE)
    if not beside:
        raise ConfigError("the ego is on no lane at the start")
    first = int(road.block_of[nearest_heading(road, beside, center).edge])
    if text:
        x, y = (float(word) for word in str(text).split(","))
        blocks = road.blocks.within_box(float(center[0]), float(center[1]), _NEAR).tolist()
        edge = edge_at(road, x, y)
        if int(road.block_of[edge]) not in blocks:
            raise ConfigError("the goal is too far away")
    else:
        blocks = by_command(road, first, command, len(scenario.route))
        edge = int(road.block_edges.at(blocks[-1])[-1])
    lanes = plan_lanes(road, first, edge, blocks, keeps_oddities=True)
    if not lanes:
        raise ConfigError("no lanes lead to the goal from the last lane beside the ego")
    if text:
        blocks = list(dict.fromkeys(road.block_of[lanes].tolist()))
        goal = start_on(road, lanes[-1], x, y).pose
    else:
        lanes = cut_by_time(road, lanes, scenario.mapping[0])
        xy = road.baselines.at(lanes[-1])
        goal = np.array([*xy[-1], vertex_headings(xy)[-1]])
    line = plan_line(road, lanes, center)
    count = scenario.num_iterations
    # nuPlan rule 710: the expert goes from vertex to vertex, on to the end of the last lane
    centers = np.array([line[int(len(line) / count * i)] for i in range(count)])
    centers[0] = center
    route = tuple(road.blocks.ids[block] for block in blocks)
    return Plan(route, tuple(lanes), goal, line, centers, _end(line, goal))


def _end(line: FloatArray, goal: FloatArray) -> float:
    path = shapely.LineString(line[:, :2])
    return float(shapely.line_locate_point(path, shapely.Point(goal[:2]))) - TOLERANCE


def edges_under(road: VectorMap, pose: FloatArray, size: FloatArray) -> list[int]:
    """Lanes, else connectors, at a pose (3,); at a corner of a box (2,) there on a gap of them."""
    x, y = float(pose[0]), float(pose[1])
    is_lane = bool(road.lanes_at(x, y))
    if not is_lane and not len(road.intersections.containing(x, y)):
        return []
    at = road.lanes_at if is_lane else road.connectors_at
    points = [(x, y), *boxes_to_corners(pose, size).tolist()]
    return next(filter(None, (at(*point) for point in points)), [])
