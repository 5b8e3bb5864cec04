"""Diffusion Planner: sampling, batches, makeshifts and plans, with deterministic weights."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, moved, standing_tracks, straight_road

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.errors import CheckpointError, PlannerError
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.sim.planner import scene_info
from shiftsim.world.state import AgentKind

torch = pytest.importorskip("torch")
pytestmark = pytest.mark.learned


from shiftsim.planners.learned.diffusion.network import DEFAULT_ARGS, build_network  # noqa: E402
from shiftsim.planners.learned.diffusion.planner import DiffusionPlanner  # noqa: E402

NUM_ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`
START = (60.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def planner():
    return DiffusionPlanner("deterministic:drive")


def traffic(rng, count):
    poses = np.column_stack([rng.uniform(20, 180, count), rng.uniform(-30, 30, (count, 2))])
    kinds = [AgentKind(int(kind)) for kind in rng.integers(0, 7, count)]
    return cruise_scenario(tracks=standing_tracks(NUM_ROWS, poses, kinds), start=START)


def first_plan(planner, scenario, seed=0):
    planner.reset(replace(scene_info(scenario), seed=seed))
    return planner.plan(Rollout(scenario, None, controller="log-playback").observe())


def features_of(planner, scenario):
    planner.reset(scene_info(scenario))
    return planner.features(Rollout(scenario, None, controller="log-playback").observe())


def test_a_plan_begins_with_the_present_and_has_eight_seconds(planner):
    scenario = cruise_scenario(start=START)
    plan = first_plan(planner, scenario)
    np.testing.assert_array_equal(plan.states[0], scenario.expert[0])
    assert plan.states.shape == (81, 11)
    assert plan.time_us[-1] - plan.time_us[0] == pytest.approx(8_000_000, abs=1)
    # these weights drive a ramp of 0.6 m per step straight on
    np.testing.assert_allclose(plan.states[1:, 0], 60 + 0.6 * np.arange(1, 81), atol=10.0)
    assert planner.degraded == ""


def test_the_same_seed_gives_the_same_bytes_and_another_one_does_not(planner):
    scenario = cruise_scenario(start=START)
    plans = [first_plan(planner, scenario, seed).states.tobytes() for seed in (3, 3, 4)]
    assert plans[0] == plans[1] != plans[2]


def test_every_iteration_has_its_own_noise(planner):
    scenario = cruise_scenario(start=START)
    planner.reset(scene_info(scenario))
    seen = Rollout(scenario, None, controller="log-playback").observe()
    noises = [planner.features(replace(seen, iteration=i)).noise for i in (0, 1, 0)]
    assert np.array_equal(noises[0], noises[2])
    assert not np.array_equal(noises[0], noises[1])


@pytest.mark.thorough
@pytest.mark.parametrize("weights", [pytest.param("base", marks=pytest.mark.thorough), "drive"])
def test_a_batch_agrees_with_one_by_one(weights, rng):
    planner = DiffusionPlanner(f"deterministic:{weights}")
    scenes = [cruise_scenario(start=START), traffic(rng, 3), traffic(rng, 80), bench_scene(40, 1)]
    features = [features_of(planner, scene) for scene in scenes]
    alone = np.array([planner.infer([one])[0] for one in features])
    together = np.array(planner.infer(features))
    np.testing.assert_allclose(together, alone, rtol=0.0, atol=2e-5)


@pytest.mark.parametrize("count", [0, 500])
def test_no_agents_and_five_hundred_are_driven_among(planner, rng, count):
    plan = first_plan(planner, traffic(rng, count))
    assert np.isfinite(plan.states).all()


def test_a_map_without_limits_and_borders_is_driven_on(planner):
    road = straight_road(None)
    nothing = road.left_boundaries._replace(
        xy=np.zeros((0, 2)), ptr=np.zeros_like(road.left_boundaries.ptr), arc=np.zeros(0)
    )
    for array in nothing:
        array.flags.writeable = False
    bare = replace(road, left_boundaries=nothing, right_boundaries=nothing)
    plan = first_plan(planner, cruise_scenario(road=bare, start=START))
    assert np.isfinite(plan.states).all()
    assert planner.degraded == ""


def test_the_plan_moves_with_the_world(planner):
    scenario = cruise_scenario(start=START)
    shift = np.array([664_430.0, 3_998_750.0])
    here = first_plan(planner, scenario)
    there = first_plan(planner, moved(scenario, 0.0, shift))
    # features are stored as 32 bit floats, of up to 200 m
    np.testing.assert_allclose(there.states[:, :2] - shift, here.states[:, :2], atol=1e-3)
    np.testing.assert_allclose(there.states[:, 2], here.states[:, 2], atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"route": ()}, "no route"),
        ({"route": ("nowhere",)}, "no route"),
        ({"start": (5000.0, 0.0, 0.0)}, "no lane"),
        ({"history_rows": 4}, "history has 3 samples"),
    ],
)
def test_where_the_official_planner_would_fail_the_plan_is_a_makeshift(planner, changes, reason):
    options = {name: value for name, value in changes.items() if name != "route"}
    scenario = cruise_scenario(**{"start": START, **options})
    scenario = replace(scenario, route=changes.get("route", scenario.route))
    plan = first_plan(planner, scenario)
    assert reason in planner.degraded
    assert np.isfinite(plan.states).all()
    with pytest.raises(PlannerError, match="fell back"):
        simulate(scenario, planner, strict=True)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["nonreactive", "reactive"])
def test_a_closed_loop_with_noise_comes_to_its_end(planner, rng, mode):
    log = simulate(
        cruise_scenario(iterations=8, start=START), planner, traffic=mode, noise="awgn-low"
    )
    assert len(log.ego) == 7
    assert not log.degraded.any()


@pytest.mark.slow
def test_scenarios_in_lock_step_go_the_same_way_as_alone(planner, rng):
    scenes = [cruise_scenario(iterations=6, start=START), cruise_scenario(iterations=4)]
    alone = [simulate(scene, planner) for scene in scenes]
    together = simulate_together([Rollout(scene, planner.fork()) for scene in scenes])
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_allclose(other.ego, one.ego, atol=2e-5)


def test_dimensions_and_units_come_from_the_settings():
    units = {"mean": [[[0.0] * 4]] * 11, "std": [[[1.0] * 4]] * 11}
    network = build_network({**DEFAULT_ARGS, "hidden_dim": 96, "state_normalizer": units})
    assert network.state_dict()["decoder.decoder.dit.preproj.fc2.weight"].shape == (96, 512)
    assert network.denormalise(torch.ones(4)).tolist() == [1.0] * 4
    assert build_network().state_dict().keys() == build_network(DEFAULT_ARGS).state_dict().keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lane_num": 80}, "lane_num is 80"),
        ({"diffusion_model_type": "score"}, "'score'"),
        ({"state_normalizer": {"mean": [0.0], "std": [1.0]}}, r"'state' has shape \(1,\)"),
        ({"observation_normalizer": {}}, "normaliser of 'ego_current_state'"),
    ],
)
def test_settings_of_another_network_are_refused(change, message):
    with pytest.raises(CheckpointError, match=message):
        build_network({**DEFAULT_ARGS, **change})


def test_missing_settings_are_named():
    with pytest.raises(CheckpointError, match="'num_heads' is missing"):
        build_network({name: value for name, value in DEFAULT_ARGS.items() if name != "num_heads"})
