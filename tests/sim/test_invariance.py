"""What must not change a score: where the world lies, the order of tracks, who is far away."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import seeds
from worlds import cruise_scenario, join_tracks, moved, standing_tracks, straight_road

from shiftsim.metrics import compute_metrics
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.world.state import AgentKind, Tracks

NUM_ROWS = 60 + 2 * 80 + 1 + 160
ROAD = straight_road()


def scene(seed):
    """Cars, a cyclist, a pedestrian and a cone along the road; some in the ego's way."""
    rng = np.random.default_rng(seed)
    kinds = [AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.BICYCLE, AgentKind.PEDESTRIAN]
    kinds.append(AgentKind.TRAFFIC_CONE)
    poses = np.c_[rng.uniform(20, 120, 5), rng.uniform(-14, 18, 5), rng.uniform(-3, 3, 5)]
    tracks = standing_tracks(NUM_ROWS, poses, kinds)
    drift = np.arange(NUM_ROWS)[:, None] * 0.05 * rng.uniform(-1, 3, 5)[None]
    tracks.poses[:, :, 0] += drift
    tracks.velocities[:, :3, 0] = rng.uniform(0, 3, 3)
    start = (10.0, rng.uniform(-0.3, 1.0), rng.uniform(-0.01, 0.01))
    return cruise_scenario(
        speed=float(rng.uniform(3, 14)), iterations=81, tracks=tracks, road=ROAD, start=start
    )


def result(scenario, planner="constant-velocity", noise="awgn-low"):
    log = simulate(scenario, load_planner(planner, {}), noise=noise, seed=3)
    return compute_metrics(log, scenario.map)


def assert_same(first, second, atol):
    assert first.scores.keys() == second.scores.keys()
    for metric, score in first.scores.items():
        assert score == pytest.approx(second.scores[metric], abs=atol), metric
    assert first.score == pytest.approx(second.score, abs=atol)


@settings(max_examples=15)
@given(seeds, st.floats(-3, 3), st.sampled_from([(0.0, 0.0), (664_430.0, 3_998_750.0)]))
def test_scores_do_not_depend_on_where_the_world_lies(seed, angle, shift):
    scenario = scene(seed)
    assert_same(result(scenario), result(moved(scenario, angle, np.array(shift))), 1e-6)


@settings(max_examples=15)
@given(seeds, st.permutations(range(5)))
def test_scores_do_not_depend_on_the_order_of_tracks(seed, order):
    scenario = scene(seed)
    shuffled = replace(scenario, tracks=scenario.tracks.select(np.array(order)))
    assert_same(result(scenario), result(shuffled), 0.0)


@settings(max_examples=15)
@given(seeds, st.sampled_from(["constant-velocity", "idm"]))
def test_somebody_far_away_changes_nothing(seed, planner):
    scenario = scene(seed)
    far = standing_tracks(NUM_ROWS, np.array([[-900.0, 800.0, 1.0]]), [AgentKind.VEHICLE])
    stranger = Tracks(far.valid, far.poses, far.velocities, far.sizes, far.kinds, ("f" * 16,))
    crowd = replace(scenario, tracks=join_tracks([scenario.tracks, stranger]))
    assert_same(result(scenario, planner), result(crowd, planner), 0.0)


def test_the_scenes_of_this_file_differ_in_their_scores():
    scores = {round(result(scene(seed)).score, 3) for seed in range(12)}
    assert len(scores) > 3
    assert 0.0 in scores
