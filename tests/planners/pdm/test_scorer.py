"""Scores of PDM-Closed in small worlds made by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from worlds import standing_tracks

from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm.forecast import make_forecast, select_tracks, touched
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.planner import choose
from shiftsim.planners.pdm.scorer import (
    Place,
    Scores,
    _follow_route,
    normalise,
    score,
    weighted_mean,
)
from shiftsim.planners.proposals.areas import areas_of
from shiftsim.planners.proposals.places import OFF_ROUTE, ego_box, find_places
from shiftsim.planners.proposals.tracker import SCORED
from shiftsim.planners.routes.lead import red_lights
from shiftsim.world.layers import make_polygons
from shiftsim.world.state import NUM_STATE, PACIFICA, VX, VY, AgentKind, X

ROAD = np.array([[-50.0, -20.0], [150.0, -20.0], [150.0, 20.0], [-50.0, 20.0]])
AREAS = areas_of(make_polygons([[ROAD]]), np.array([True]), np.array([0]))
LINE = make_path(np.column_stack([np.linspace(-50.0, 150.0, 201), np.zeros((201, 2))]))
SIZE = ego_box(PACIFICA)


def driving(*speeds: float) -> np.ndarray:
    """(P, 41, 11) states along +x from the origin at steady speeds."""
    states = np.zeros((len(speeds), SCORED + 1, NUM_STATE))
    states[..., VX] = np.array(speeds)[:, None]
    states[..., X] = states[..., VX] * 0.1 * np.arange(SCORED + 1)
    return states


def forecast_of(poses: list, speed: float = 0.0):
    """Vehicles of 4.5 m x 2 m that drive along their headings."""
    poses = np.array(poses, np.float64)
    tracks = standing_tracks(1, poses, [AgentKind.VEHICLE] * len(poses))
    tracks.velocities[0] = speed * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    return make_forecast(tracks, np.arange(len(poses)), red_lights([], []))


def scored(states: np.ndarray, *poses, speed: float = 0.0) -> Scores:
    place = Place(AREAS, np.array([0]), make_polygons([]), LINE)
    return score(states, place, forecast_of(list(poses), speed).others, SIZE, DEFAULT)


def test_collisions_with_oncoming_traffic_are_seen_at_their_time():
    """Fronts 25.951 m apart close at 10 m/s; boxes are known every 0.2 s."""
    scores = scored(driving(5.0), (32.25, 0.0, np.pi), speed=5.0)
    assert scores.collision_index.tolist() == [26]
    assert scores.ttc_index.tolist() == [17]  # 0.9 s before
    assert (scores.no_collision.tolist(), scores.ttc.tolist()) == ([0.0], [0.0])


def test_time_to_collision_looks_beyond_the_last_state():
    """At the last state the front is at 44.049 m, and 0.9 s later at 53.049 m."""
    for rear, index in ((53.0, SCORED), (53.1, np.inf)):
        scores = scored(driving(10.0), (rear + 2.25, 0.0, 0.0))
        assert scores.ttc_index.tolist() == [index]
        assert scores.collision_index.tolist() == [np.inf]


def test_time_to_collision_counts_from_a_speed_of_five_millimetres_per_second_on():
    scores = scored(driving(0.005, 0.004), (5.0, 0.0, 0.0))
    assert scores.ttc_index.tolist() == [0, np.inf]


def test_what_touches_the_ego_from_behind_hides_nothing_and_is_not_ahead_later():
    """It drives through the ego at 20 m/s; another stands 4 m ahead of the front."""
    behind, ahead = (-3.0, 0.0, 0.0), (4.049 + 4.0 + 2.25, 0.0, 0.0)
    through = forecast_of([behind], speed=20.0).others
    place = Place(AREAS, np.array([0]), make_polygons([]), LINE)
    assert score(driving(5.0), place, through, SIZE, DEFAULT).ttc_index.tolist() == [np.inf]
    for poses in ([behind, ahead], [ahead, behind]):
        assert scored(driving(5.0), *poses).ttc_index.tolist() == [0]


@pytest.mark.parametrize(
    ("off", "direction"),
    [
        ([], 1.0),
        ([0, 1], 1.0),  # the way to the first state does not count
        ([3, 4], 0.5),  # 1.25 m, exactly the first limit
        ([3, 5, 7], 1.0),  # never twice in a row
        ([3, 5, 6, 7, 8], 0.0),  # 2.5 m, exactly the second
    ],
)
def test_oncoming_travel_is_the_longest_way_off_the_route_in_one_go(off, direction):
    places = find_places(driving(0.0), SIZE, AREAS, np.array([0]), np.zeros(1), by_center=True)
    places.centers[0] = 0.125 * np.outer(np.arange(SCORED + 1), [3.0, 4.0])  # 0.625 m a step
    places.flags[..., OFF_ROUTE] = np.isin(np.arange(SCORED + 1), off)
    progress, factors = _follow_route(places, LINE, (1.25, 2.5))
    assert progress.tolist() == pytest.approx([15.0])
    assert factors.tolist() == [direction]


def test_progress_is_compared_with_the_best_unless_nobody_moves():
    factor = np.array([1.0, 0.0, 0.5])
    assert normalise(np.array([4.0, 9.0, 4.0]), factor).tolist() == [1.0, 0.0, 0.5]
    assert normalise(np.array([0.1, 0.0, 0.0]), factor).tolist() == [1.0, 0.0, 1.0]


def test_what_is_touched_comes_in_the_order_of_the_index():
    ego, both = driving(0.0)[0, 0], [(4.0, 0.0, 0.0), (-1.0, 0.0, 0.0)]
    assert touched(forecast_of(both), ego, SIZE) == [1, 0]
    assert touched(forecast_of(both[::-1]), ego, SIZE) == [0, 1]


def test_tracks_are_seen_where_they_are_now():
    tracks = standing_tracks(2, np.zeros((1, 3)), [AgentKind.VEHICLE])
    tracks.poses[0] = 100.0
    tracks.valid[0] = False
    assert select_tracks(tracks, 0.0, 0.0, set(), DEFAULT).tolist() == [0]
    assert select_tracks(tracks, 100.0, 100.0, set(), DEFAULT).tolist() == []
    tracks.valid[:] = [[True], [False]]
    assert select_tracks(tracks, 0.0, 0.0, set(), DEFAULT).tolist() == []


@pytest.mark.parametrize(
    ("total", "collision", "speed", "chosen"),
    [
        ([0.1, 0.7, 0.7], 20.0, 5.0, (1, True)),  # 2 s and 5 m/s, exactly
        ([0.1, 0.7, 0.7], 21.0, 5.0, (1, False)),
        ([0.1, 0.7, 0.9], 0.0, 5.01, (2, False)),
        ([0.9, 0.7, 0.7], np.inf, 1.0, (0, False)),
    ],
)
def test_a_slow_ego_brakes_before_an_early_collision(total, collision, speed, chosen):
    ego = np.zeros(NUM_STATE)
    ego[[VX, VY]] = 0.6 * speed, -0.8 * speed
    scores = SimpleNamespace(
        total=np.array(total), collision_index=np.where(np.arange(3) == chosen[0], collision, 30.0)
    )
    best, braked = choose(scores, ego, DEFAULT)
    assert (best, braked) == chosen
    assert (type(best), type(braked)) == (int, bool)


def test_scores_are_weighted():
    params = replace(DEFAULT, progress_weight=3.0, ttc_weight=1.0, comfort_weight=4.0)
    mean = weighted_mean(*np.array([[1.0, 0.5], [0.0, 1.0], [0.5, 1.0]]), params)
    assert mean.tolist() == [5.0 / 8.0, 6.5 / 8.0]
