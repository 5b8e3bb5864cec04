"""interPlan's metrics and score, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, straight_road

from shiftsim.errors import DataError
from shiftsim.metrics import MULTIPLIERS, WEIGHTS, interplan
from shiftsim.metrics.interplan import (
    LaneChanges,
    _at_the_end,
    changes_between,
    final_score,
    interplan_score,
    lane_changes_to_goal,
    share_of_obstacles,
)
from shiftsim.sim.log import as_recorded

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
