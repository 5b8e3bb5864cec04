"""What interPlan adds to nuPlan's metrics: lane changes to the goal, obstacles passed, its score.

Only scenarios edited by a code of interPlan have them; the metrics of nuPlan stay as they are.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from shiftsim.errors import DataError
from shiftsim.kernels import FloatArray
from shiftsim.metrics.progress import NAME as PROGRESS
from shiftsim.metrics.result import MetricRow, Statistic
from shiftsim.metrics.route import EdgeLists, driven_route
from shiftsim.metrics.score import MULTIPLIERS, WEIGHTS, MetricResult, closed_loop_score
from shiftsim.sim.log import SimulationLog
from shiftsim.world.events import RolloutEvents
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import center_poses

LANES = "lane_changes_to_goal"
SORTS = "ego_sorts_"
DIRECTION = "driving_direction_compliance"
_LANE_WEIGHT = 4.0
_UNKNOWN_START = 0.2607  # score where the lane changes needed at the start are not known
_BESIDE = 0.1  # m, between the ends of boundaries of lanes side by side


@dataclass(frozen=True, slots=True)
class LaneChanges:
    """Lane changes still needed to be in the lane of the goal; None where there is no way."""

    initial: int | None  # at the start
    final: int | None  # at the end

    @property
    def score(self) -> float:
        """Share of them that the ego made; a DataError where that is not known."""
        if self.initial == 0:
            return 1.0 if self.final == 0 else 0.5
        if self.initial is None:
            return _UNKNOWN_START
        if self.final is None:
            raise DataError("lane changes to the goal: the ego left the lanes beside the goal's")
        return max(0.0, 1.0 - self.final / self.initial)


def role_of(metric: str, sorts: str) -> tuple[str, float | None]:
    """Role (`multiplier`, `weighted`, empty) and weight of a metric; `sorts` as in `RolloutEvents`.

    nuPlan rule 714: where an obstacle is to be passed, passing it takes the place of the driving
    direction, which then is weighted; beside a pedestrian both are multipliers.
    """
    if metric.startswith(SORTS):
        return "multiplier", None
    if metric == DIRECTION and sorts and sorts != "jaywalking_pedestrian":
        return "weighted", 1.0
    if metric in MULTIPLIERS:
        return "multiplier", None
    if metric == LANES:
        return "weighted", _LANE_WEIGHT
    return "weighted", WEIGHTS.get(metric, 1.0)


def interplan_score(scores: Mapping[str, float | None], sorts: str) -> float:
    """Product of the multipliers times the weighted mean of the others, as `role_of` says."""
    return closed_loop_score(scores, lambda metric: role_of(metric, sorts)[1])


def final_score(types: Sequence[tuple[int, float]], weights: Sequence[float]) -> float:
    """Score of all scenarios, from number and mean score of each type, and weights of the types.

    nuPlan rule 715: the weight of the first type counts for all scores, the others only for their
    number.
    """
    weighted = sum(count * weight for (count, _), weight in zip(types, weights, strict=True))
    return sum(count * score * weights[0] for count, score in types) / weighted


def add_interplan(
    result: MetricResult, log: SimulationLog, road: VectorMap, script: RolloutEvents
) -> MetricResult:
    """The result with interPlan's metrics and score; a DataError where nobody was on the route."""
    lanes = lane_changes_to_goal(road, log)
    final = float("nan") if lanes.final is None else float(lanes.final)
    rows = [MetricRow(LANES, lanes.score, final, "count", 0.0, None)]
    statistics = [
        Statistic(LANES, f"number_of_{LANES}", "count", "COUNT", final),
        Statistic(LANES, "did_ego_got_to_goal_lane", "boolean", "BOOLEAN", float(final == 0.0)),
    ]
    if script.sorts:
        ratio = next(row.value for row in result.rows if row.metric == PROGRESS)
        needed = share_of_obstacles(log.expert_ego, script.obstacles)
        name, passed = SORTS + script.sorts, float(ratio >= needed)
        rows.append(MetricRow(name, passed, ratio, "ratio", needed, None))
        label = "ego_sorts_construction_zone"  # interPlan gives all three this name
        statistics.append(Statistic(name, label, "boolean", "BOOLEAN", passed))
    scores = {**result.scores, **{row.metric: row.score for row in rows}}
    return replace(
        result,
        score=interplan_score(scores, script.sorts),
        scores=scores,
        rows=(*result.rows, *rows),
        statistics=(*result.statistics, *statistics),
    )


def share_of_obstacles(expert: FloatArray, obstacles: FloatArray) -> float:
    """How far along the expert's path the last of some places (M, 2) is, as a share of it.

    nuPlan rule 716: the ego has passed it where its progress ratio is as large, wherever it is.
    """
    path = shapely.LineString(center_poses(expert[:, :3])[:, :2])
    places = [shapely.line_locate_point(path, shapely.Point(x, y)) for x, y in obstacles.tolist()]
    return float(max(places) / path.length)


def lane_changes_to_goal(road: VectorMap, log: SimulationLog) -> LaneChanges:
    """Lane changes needed at the start and the end; a DataError where nobody was on the route."""
    count = len(log.ego)
    # nuPlan rule 717: the expert counts only as long as the ego drove
    expert = driven_route(road, center_poses(log.expert_ego[:count, :3]))
    ego = driven_route(road, center_poses(log.ego[:, :3]))
    expert_lanes = [edges[0] for edges in simplified(expert)]
    found = simplified(ego)
    if not expert_lanes or not found or not ego.counts[0] or not expert.counts[0]:
        raise DataError("lane changes to the goal: the ego or the expert starts on no lane")
    known = set(expert_lanes)
    lanes = [lane for edges in found for lane in edges if len(edges) == 1 or lane in known]
    goal, last = _at_the_end(road, expert_lanes, [expert_lanes[0], *lanes])
    starts = [expert.at(0), expert.at(1)]
    same = starts[1] and road.block_of[starts[0][0]] == road.block_of[starts[1][0]]
    initial: int | None = 0
    if len(expert_lanes) > 1:
        initial = changes_between(road, ego.at(0)[0], starts[1 if same else 0][0])
    return LaneChanges(initial, changes_between(road, goal, last))


def _at_the_end(road: VectorMap, expert: list[int], ego: list[int]) -> tuple[int, int]:
    """Lanes of expert and ego in the last roadblock of the expert's that the ego was in."""
    blocks = [int(road.block_of[lane]) for lane in ego]
    if blocks[-1] == int(road.block_of[expert[-1]]):
        return expert[-1], ego[-1]
    for lane in reversed(expert):
        block = int(road.block_of[lane])
        if block in blocks:
            return lane, ego[len(blocks) - 1 - blocks[::-1].index(block)]
    raise DataError("lane changes to the goal: the ego was never on the route")


def simplified(route: EdgeLists) -> list[list[int]]:
    """Lists of edges, without those that share an edge with the one before."""
    out: list[list[int]] = []
    for sample in range(len(route.counts)):
        edges = route.at(sample)
        if edges and (not out or set(edges).isdisjoint(out[-1])):
            out.append(edges)
    return out


def driven_lanes(road: VectorMap, centers: FloatArray) -> list[int]:
    """The first edge of each stretch that box centres (K, 3) were on, as nuPlan simplifies it."""
    return [edges[0] for edges in simplified(driven_route(road, centers))]


def changes_between(road: VectorMap, lane: int, goal: int) -> int | None:
    """Lane changes from a lane to another one; None where there is no way.

    nuPlan rule 718: it is looked for from the goal on, only within the roadblock of both.
    """
    if lane == goal:
        return 0
    if goal not in road.block_edges.at(int(road.block_of[lane])).tolist():
        return None
    queue, seen = [(goal, 0)], {goal}
    while queue:
        at, changes = queue.pop(0)
        for side in (road.left_lane, road.right_lane):
            beside = _beside(road, at, side)
            if beside == lane:
                return changes + 1
            if beside != NONE and beside not in seen:
                seen.add(beside)
                queue.append((beside, changes + 1))
    return None


def _beside(road: VectorMap, lane: int, side: np.ndarray) -> int:
    """The lane on one side: a neighbour, or a lane from where this one comes; NONE without."""
    neighbour = int(side[lane])
    found = [] if neighbour == NONE else [neighbour]
    before = road.incoming.at(lane).tolist()
    before += [int(side[edge]) for edge in before if int(side[edge]) != NONE]
    for edge in before:
        found += road.outgoing.at(edge).tolist()
    is_left = side is road.left_lane
    own, other = road.left_boundaries, road.right_boundaries
    if not is_left:
        own, other = other, own
    best, nearest = np.inf, NONE
    for candidate in dict.fromkeys(found):
        if candidate == lane:
            continue
        gap = float(np.hypot(*(other.at(candidate)[-1] - own.at(lane)[-1])))
        if gap < best:
            best, nearest = gap, candidate
    return nearest if best <= _BESIDE else NONE
