"""interPlan's metrics and score, by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from worlds import cruise_scenario, straight_road

from shiftsim.errors import DataError
from shiftsim.metrics import MULTIPLIERS, WEIGHTS, compute_metrics, interplan
from shiftsim.metrics.interplan import (
    LaneChanges,
    _at_the_end,
    _beside,
    add_interplan,
    changes_between,
    final_score,
    interplan_score,
    lane_changes_to_goal,
    role_of,
    share_of_obstacles,
    simplified,
)
from shiftsim.metrics.route import EdgeLists
from shiftsim.sim.log import as_recorded
from shiftsim.world.events import RolloutEvents
from shiftsim.world.layers import make_lists
from shiftsim.world.map import NONE

PERFECT = dict.fromkeys((*MULTIPLIERS, *WEIGHTS, "lane_changes_to_goal"), 1.0)


def test_the_driving_direction_is_weighted_where_an_obstacle_is_to_be_passed():
    scores = PERFECT | {"driving_direction_compliance": 0.5}
    assert interplan_score(scores, "") == 0.5
    passed = scores | {"ego_sorts_stopped_vehicle": 1.0}
    assert interplan_score(passed, "stopped_vehicle") == pytest.approx(20.5 / 21.0)
    jaywalker = scores | {"ego_sorts_jaywalking_pedestrian": 1.0}
    assert interplan_score(jaywalker, "jaywalking_pedestrian") == 0.5
    assert interplan_score(PERFECT | {"ego_sorts_stopped_vehicle": 0.0}, "stopped_vehicle") == 0.0


def test_a_metric_without_a_score_does_not_count():
    assert interplan_score(PERFECT | {"ego_lane_change": None}, "") == 1.0


def test_lane_changes_are_scored_by_the_share_that_was_made():
    assert LaneChanges(2, 1).score == 0.5
    assert LaneChanges(0, 3).score == 0.5
    assert LaneChanges(None, 0).score == 0.2607
    with pytest.raises(DataError, match="left the lanes"):
        LaneChanges(2, None).score  # noqa: B018


def test_lanes_side_by_side_are_one_change_apart():
    road = straight_road()
    assert changes_between(road, road.edge("10"), road.edge("11")) == 1
    assert changes_between(road, road.edge("11"), road.edge("11")) == 0
    assert changes_between(road, road.edge("10"), road.edge("31")) is None


def test_an_ego_in_the_lane_beside_the_experts_needs_a_change():
    log = as_recorded(cruise_scenario(speed=14.0))
    assert lane_changes_to_goal(straight_road(), log) == LaneChanges(0, 0)
    aside = log.ego.copy()
    aside[:, 1] = 3.5
    assert lane_changes_to_goal(straight_road(), replace(log, ego=aside)) == LaneChanges(1, 1)


def test_the_end_is_in_the_last_block_of_the_experts_that_the_ego_was_in():
    road = straight_road()
    first, beside, later = road.edge("10"), road.edge("11"), road.edge("31")
    assert road.block_of[first] == road.block_of[beside] != road.block_of[later]
    assert _at_the_end(road, [first, later], [first, later]) == (later, later)
    # the ego did not get as far as the expert, whose lane in that block counts
    assert _at_the_end(road, [first, later], [later, beside]) == (later, later)
    assert _at_the_end(road, [first], [later, beside]) == (first, beside)
    assert _at_the_end(road, [first], [beside, later]) == (first, beside)
    with pytest.raises(DataError, match="never on the route"):
        _at_the_end(road, [first], [later])


def test_the_experts_first_lane_comes_before_the_lanes_of_the_ego():
    log = as_recorded(cruise_scenario(speed=14.0))
    road, seen = straight_road(), []

    def note(road, expert, ego):
        seen.append((expert, ego))
        return expert[0], ego[0]

    aside = log.ego.copy()
    aside[:, 1] = 3.5
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interplan, "_at_the_end", note)
        lane_changes_to_goal(road, replace(log, ego=aside))
    ((expert, ego),) = seen
    assert ego[0] == expert[0]
    assert len(ego) > 1


def test_an_obstacle_is_where_the_experts_path_passes_it():
    scenario = cruise_scenario(speed=10.0, iterations=101)
    half = share_of_obstacles(scenario.expert, np.array([[61.461, 2.0], [20.0, 0.0]]))
    assert half == pytest.approx(0.5, abs=1e-3)


def test_the_weight_of_the_first_type_counts_for_all_scores():
    types = [(2, 0.8), (1, 0.2)]
    assert final_score(types, [1.0, 1.0]) == pytest.approx(0.6)
    assert final_score(types, [2.0, 1.0]) == pytest.approx(0.72)
    with pytest.raises(ValueError, match="shorter"):
        final_score(types, [1.0])


def lists(*rows):
    """Edges that hold points, as `route` gives them."""
    counts = np.array([len(row) for row in rows])
    edges = np.full((len(rows), 4), 99)
    for place, row in enumerate(rows):
        edges[place, : len(row)] = row
    return EdgeLists(edges, counts)


def test_a_list_that_shares_an_edge_with_the_one_before_is_left_out():
    assert simplified(lists([1, 2], [2, 3], [3, 0], [], [3, 5], [7])) == [[1, 2], [3, 0], [7]]
    assert simplified(lists([], [], [4])) == [[4]]
    assert simplified(lists([], [])) == []


def lanes(*, left, block=None, incoming=None, outgoing=None, ends=None, half=1.5):
    """A map of lanes at y = 0, -3, -6 … of 3 m; `left` has the left neighbour of each."""
    count = len(left)
    right = np.full(count, NONE)
    for lane, other in enumerate(left):
        if other != NONE:
            right[other] = lane
    y = -3.0 * np.arange(count) if ends is None else np.asarray(ends)
    members = [0] * count if block is None else block
    boundary = [np.array([[0.0, at], [9.0, at + half]]) for at in y]
    below = [np.array([[0.0, at], [9.0, at - half]]) for at in y]
    return SimpleNamespace(
        left_lane=np.array(left),
        right_lane=right,
        block_of=np.array(members),
        block_edges=make_lists(
            [[e for e in range(count) if members[e] == b] for b in range(max(members) + 1)]
        ),
        incoming=make_lists(incoming or [[]] * count),
        outgoing=make_lists(outgoing or [[]] * count),
        left_boundaries=SimpleNamespace(at=boundary.__getitem__),
        right_boundaries=SimpleNamespace(at=below.__getitem__),
    )


def test_changes_are_counted_from_lane_to_lane():
    road = lanes(left=[NONE, 0, 1, 2])
    found = [[changes_between(road, a, b) for b in range(4)] for a in range(4)]
    assert found == [[abs(a - b) for b in range(4)] for a in range(4)]
    assert changes_between(lanes(left=[NONE, NONE, 1, 2]), 0, 3) is None  # beside three others
    assert changes_between(lanes(left=[NONE, 0], block=[0, 1]), 0, 1) is None


def test_the_lane_beside_is_the_one_whose_boundary_ends_where_this_ones_does():
    road = lanes(left=[NONE, 0, 1])
    assert [_beside(road, lane, road.left_lane) for lane in range(3)] == [NONE, 0, 1]
    assert [_beside(road, lane, road.right_lane) for lane in range(3)] == [1, 2, NONE]
    for gap, found in ((0.099, 0), (0.101, NONE)):
        apart = lanes(left=[NONE, 0], ends=[gap, -3.0])
        assert _beside(apart, 1, apart.left_lane) == found
    for gap in (0.1, -0.1):  # the limit itself is near enough
        apart = lanes(left=[NONE, 0], ends=[gap, 0.0], half=0.0)
        assert _beside(apart, 1, apart.left_lane) == 0


def test_lanes_that_come_from_the_same_lane_or_its_neighbour_are_asked_too():
    # 3 leads to 0, and 4, to the right of 3, to 1 and 2; only that makes 0 and 1 neighbours
    apart = {"left": [NONE, NONE, NONE, NONE, 3], "ends": [0.0, -3.0, -6.0, 50.0, 47.0]}
    ways = {
        "incoming": [[3], [4], [4], [], []],
        "outgoing": [[], [], [], [0], [1, 2]],
    }
    road = lanes(**apart, **ways)
    assert _beside(road, 0, road.right_lane) == 1  # over the neighbour of where 0 comes from
    assert _beside(road, 1, road.right_lane) == 2  # from the same lane
    assert _beside(road, 2, road.left_lane) == 1
    assert _beside(road, 1, road.left_lane) == 0
    assert _beside(road, 2, road.right_lane) == NONE
    assert changes_between(lanes(**apart, **ways, block=[0, 0, 0, 1, 1]), 0, 2) == 2


def test_of_two_lanes_beside_the_nearer_counts_and_of_equal_ones_the_neighbour():
    ways = {"incoming": [[], [3], [3], []], "outgoing": [[], [], [], [1, 2]]}
    nearer = lanes(left=[NONE, 0, NONE, NONE], ends=[0.05, -3.0, 0.0, 90.0], **ways)
    assert _beside(nearer, 1, nearer.left_lane) == 2
    equal = lanes(left=[NONE, 0, NONE, NONE], ends=[0.0, -3.0, 0.0, 90.0], **ways)
    assert _beside(equal, 1, equal.left_lane) == 0


def test_the_roles_and_weights_of_metrics():
    assert role_of("driving_direction_compliance", "") == ("multiplier", None)
    assert role_of("driving_direction_compliance", "stopped_vehicle") == ("weighted", 1.0)
    assert role_of("lane_changes_to_goal", "") == ("weighted", 4.0)
    assert role_of("ego_is_comfortable", "") == ("weighted", 2.0)
    assert role_of("an_own_one", "") == ("weighted", 1.0)
    assert role_of("ego_sorts_stopped_vehicle", "stopped_vehicle") == ("multiplier", None)
    assert interplan_score({"an_own_one": 0.25}, "") == 0.25
    assert interplan_score(dict.fromkeys(MULTIPLIERS, 1.0), "") == 0.0


@pytest.mark.parametrize(("beyond", "passed"), [(-1e-6, 0.0), (0.0, 1.0), (1e-6, 1.0)])
def test_an_obstacle_is_passed_where_the_progress_is_as_far(beyond, passed):
    log = as_recorded(cruise_scenario(speed=10.0, iterations=101))
    road, result = straight_road(), compute_metrics(log, straight_road())
    place = np.array([[61.461, 2.0]])
    needed = share_of_obstacles(log.expert_ego, place)
    rows = tuple(
        row._replace(value=needed + beyond if row.metric == interplan.PROGRESS else -1.0)
        for row in result.rows
    )
    script = RolloutEvents("a", "b", "c", (), (), np.zeros(0, np.int64), sorts="stopped_vehicle")
    script = replace(script, obstacles=place)
    found = add_interplan(replace(result, rows=rows), log, road, script)
    lane, sorts = found.rows[-2:]
    assert (lane.metric, lane.score, lane.value, lane.unit) == (interplan.LANES, 1.0, 0.0, "count")
    assert (sorts.metric, sorts.score) == ("ego_sorts_stopped_vehicle", passed)
    assert (sorts.value, sorts.unit, sorts.threshold) == (needed + beyond, "ratio", needed)
    assert [(s.name, s.value) for s in found.statistics[-3:]] == [
        ("number_of_lane_changes_to_goal", 0.0),
        ("did_ego_got_to_goal_lane", 1.0),
        ("ego_sorts_construction_zone", passed),
    ]
    assert found.score == interplan_score(found.scores, "stopped_vehicle")
    assert set(found.scores) == {*result.scores, interplan.LANES, "ego_sorts_stopped_vehicle"}
    plain = add_interplan(result, log, road, replace(script, sorts=""))
    assert [row.metric for row in plain.rows[len(result.rows) :]] == [interplan.LANES]


def test_an_ego_that_does_not_get_to_the_lane_of_the_goal_scores_less():
    log = as_recorded(cruise_scenario(speed=14.0))
    aside = log.ego.copy()
    aside[:, 1] = 3.5
    log, road = replace(log, ego=aside), straight_road()
    script = RolloutEvents("a", "b", "c", (), (), np.zeros(0, np.int64))
    found = add_interplan(compute_metrics(log, road), log, road, script)
    assert found.rows[-1].score == 0.0
    assert [s.value for s in found.statistics[-2:]] == [1.0, 0.0]


def test_a_rollout_that_starts_beside_the_road_has_no_lane_changes():
    log = as_recorded(cruise_scenario(speed=14.0))
    for name in ("ego", "expert_ego"):
        states = getattr(log, name).copy()
        states[0, 1] = -40.0
        with pytest.raises(DataError, match="starts on no lane"):
            lane_changes_to_goal(straight_road(), replace(log, **{name: states}))
        states[:, 1] = -40.0
        with pytest.raises(DataError, match="starts on no lane"):
            lane_changes_to_goal(straight_road(), replace(log, **{name: states}))


# lanes 0 to 2 lead to 3 to 5; 6 and 7 are elsewhere
TWO_BLOCKS = {"left": [NONE, 0, 1, NONE, 3, 4, NONE, 6], "block": [0, 0, 0, 1, 1, 1, 2, 2]}


@pytest.mark.parametrize(
    ("expert", "ego", "initial", "final"),
    [
        # the expert's second lane counts where it is in the block of the first
        ([[0], [1], [2], [5]], [[2], [1], [1], [5]], 1, 0),
        ([[0], [3], [3]], [[1], [4], [4]], 1, 1),
        ([[0], [], [3]], [[2], [2], [5]], 2, 2),
        # of several edges the first
        ([[0, 3], [1, 5], [4]], [[2, 4], [2], [4]], 1, 0),
        # an expert who stays in a lane needs no change at the start
        ([[0], [0], [0]], [[1], [1], [1]], 0, 1),
        # an ego that leaves the route is compared where the route began
        ([[0], [3], [3]], [[6], [6], [6]], None, 0),
        ([[0], [3], [3]], [[6, 7], [6, 7], [6, 7]], None, 0),
        ([[0], [3], [4]], [[1], [6], [6]], 1, 1),
    ],
)
def test_lane_changes_to_the_goal(expert, ego, initial, final, monkeypatch):
    log = as_recorded(cruise_scenario(speed=14.0, iterations=len(ego) + 1))
    routes = iter([lists(*expert), lists(*ego)])
    monkeypatch.setattr(interplan, "driven_route", lambda *_: next(routes))
    assert lane_changes_to_goal(lanes(**TWO_BLOCKS), log) == LaneChanges(initial, final)
