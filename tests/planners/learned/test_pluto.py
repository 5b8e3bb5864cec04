"""PLUTO with deterministic weights: what must not change a plan, and what it does without data."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import crowd, first_sight, in_ego_frame, plan_of
from worlds import cruise_scenario, moved, standing_tracks, straight_road

from shiftsim.errors import PlannerError
from shiftsim.sim.loop import simulate
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import HEADING, VX, AgentKind, LightStatus, TrafficLights

torch = pytest.importorskip("torch")

from shiftsim.planners.learned import network as layers  # noqa: E402  # needs torch
from shiftsim.planners.learned.pluto.network import build_network  # noqa: E402  # needs torch
from shiftsim.planners.learned.pluto.planner import NO_LINE, Pluto, make_batch  # noqa: E402

pytestmark = pytest.mark.learned

NUM_ROWS = 60 + 2 * 10 + 1 + 160
BATCH_TOLERANCE = 2e-5  # on most machines there is no difference
MIDDLE = (210.0, 0.3, 0.02)


@pytest.fixture(scope="module")
def planner():
    return Pluto("deterministic:drive")


@pytest.fixture(scope="module")
def rough():
    """With weights that make no way forward, but small numbers."""
    return Pluto("deterministic:base")


def scene(seed: int = 0, count: int = 6, **changes) -> Scenario:
    """Vehicles, pedestrians, bicycles and cones around an ego in the middle of a short road."""
    tracks = crowd(np.random.default_rng(seed), NUM_ROWS, count, 5)
    return cruise_scenario(**{"iterations": 11, "tracks": tracks, "start": MIDDLE, **changes})


def test_a_plan_is_eighty_poses_of_which_the_first_stands_for_now_as_well(planner):
    scenario = scene(count=0)
    plan = plan_of(planner, scenario)
    assert plan.states.shape == (81, 11)
    np.testing.assert_array_equal(plan.states[0], plan.states[1])
    assert plan.time_us[0] == scenario.iteration_times[0]
    assert (np.diff(in_ego_frame(plan, scenario.expert[0])[:, 0]) > 0.0).all()
    assert planner.degraded == ""


def test_the_chosen_candidate_has_the_best_score(planner):
    plan_of(planner, scene())
    choice = planner.choice
    assert len(choice.poses) == 21  # the best twenty of 24, and one without a reference line
    assert choice.best == np.argmax(choice.scores.total)
    np.testing.assert_allclose(choice.learned[:-1].sum(), 1.0, atol=1e-6)
    assert choice.learned[-1] == 0.25
    assert (np.diff(choice.learned[:-1]) <= 0.0).all()
    np.testing.assert_array_equal(choice.poses[:, 0], choice.poses[:, 1])


@settings(max_examples=4)
@given(st.floats(-3.0, 3.0), st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)))
def test_where_the_world_lies_does_not_matter_to_the_ego(planner, angle, shift):
    # between two vertices, so that no rounding decides where a reference line begins
    scenario = scene(count=0, start=(203.4, 0.0, 0.0))
    turned = moved(scenario, angle, np.array(shift))
    plan, other = plan_of(planner, scenario), plan_of(planner, turned)
    first = in_ego_frame(plan, scenario.expert[0])
    np.testing.assert_allclose(in_ego_frame(other, turned.expert[0]), first, atol=1e-3)


@settings(max_examples=4)
@given(st.permutations(range(8)))
def test_the_order_of_tracks_does_not_matter(planner, order):
    scenario = scene(3, 8)
    shuffled = replace(scenario, tracks=scenario.tracks.select(np.array(order)))
    plan, other = plan_of(planner, scenario), plan_of(planner, shuffled)
    np.testing.assert_allclose(plan.states[:, :3], other.states[:, :3], atol=1e-3)


def batch_of_unlike_scenes():
    """Different numbers of agents, static objects, polygons and reference lines."""
    yield scene(0, 0)
    yield scene(1, 40)
    yield scene(2, 3, start=(30.0, 0.0, 0.0))
    yield scene(3, 7, start=(3000.0, 0.0, 0.0))
    yield scene(4, 5, start=(210.0, -1.0, 3.1))


def test_a_batch_agrees_with_one_by_one_whatever_its_sizes(rough):
    forks = [rough.fork() for _ in range(5)]
    features = [
        fork.features(first_sight(scenario, fork))
        for fork, scenario in zip(forks, batch_of_unlike_scenes(), strict=True)
    ]
    assert len({len(one.line_valid) for one in features}) > 1
    assert len({len(one.object_valid) for one in features}) > 1
    assert len({len(one.kind) for one in features}) > 1
    together = rough.infer(features)
    for one, other in zip(features, together, strict=True):
        (alone,) = rough.infer([one])
        for mine, given_ in zip(alone, other, strict=True):
            assert mine.shape == given_.shape
            np.testing.assert_allclose(given_, mine, rtol=0.0, atol=BATCH_TOLERANCE)


def test_official_masks_of_a_batch_matter_only_where_numbers_of_lines_differ(rough):
    two = rough.features(first_sight(scene(0), rough))
    assert len(two.line_valid) == 2
    of_lines = [name for name in two._fields if name.startswith("line_")]
    one = two._replace(**{name: getattr(two, name)[:1] for name in of_lines})
    official, ours = build_network(), build_network()
    official.planning_decoder.misordered_masks = True
    for network in (official, ours):
        network.load_state_dict(rough.network.state_dict())
        network.eval()
    alike, unlike = (
        [network(make_batch(batch, "cpu")).trajectory for network in (official, ours)]
        for batch in ([two, two], [two, one])
    )
    assert torch.equal(*alike)
    assert not torch.equal(*unlike)


def test_filled_up_as_on_a_gpu_the_outputs_and_gradients_are_the_same(monkeypatch, rough):
    two = rough.features(first_sight(scene(0), rough))
    of_lines = [name for name in two._fields if name.startswith("line_")]
    one = two._replace(**{name: getattr(two, name)[:1] for name in of_lines})
    few = rough.features(first_sight(scene(3, 2), rough))
    ours = build_network()
    ours.load_state_dict(rough.network.state_dict())
    found = []
    for padded in (False, True):
        monkeypatch.setattr(layers, "pads", lambda x, padded=padded: padded)
        out = ours.eval()(make_batch([two, one, few], "cpu"))
        loss = out.trajectory.square().mean() + out.prediction.square().mean()
        gradients = torch.autograd.grad(loss, list(ours.parameters()), allow_unused=True)
        found.append([out.trajectory, out.probability, *(g for g in gradients if g is not None)])
    for packed, filled in zip(*found, strict=True):
        torch.testing.assert_close(packed, filled, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_any_number_of_agents_will_do(planner, count):
    log = simulate(scene(5, count), planner)
    assert np.isfinite(log.ego).all()
    assert not log.degraded.any()


def test_only_the_nearest_agents_are_seen(planner):
    plan_of(planner, scene(4, 500))
    assert len(planner.surroundings.agents.valid) == 49


@pytest.mark.parametrize("samples", [1, 20])
def test_a_short_history_gives_a_plan_that_counts_as_a_makeshift(planner, samples):
    scenario = scene(history_rows=2 * (samples - 1))
    plan = plan_of(planner, scenario)
    assert np.isfinite(plan.states).all()
    assert planner.degraded == f"the history has {samples} samples, not 21"


@pytest.mark.parametrize("start", [(3000.0, 50.0, 0.5), (210.0, 0.0, 3.1)])
def test_without_a_reference_line_the_free_trajectory_is_driven(planner, start):
    scenario = scene(start=start)
    log = simulate(scenario, planner)
    assert log.degraded.all()
    assert planner.degraded == NO_LINE
    assert planner.choice is None
    assert np.isfinite(log.ego).all()
    with pytest.raises(PlannerError, match="reference-free"):
        simulate(scenario, planner, strict=True)


@pytest.mark.parametrize("route", [(), ("nowhere",)])
def test_without_a_route_on_the_map_it_drives_on(planner, route):
    plan = plan_of(planner, replace(scene(), route=route))
    assert np.isfinite(plan.states).all()
    assert planner.degraded == "the scenario has no route on the map"


def test_a_map_without_speed_limits_counts_as_free(planner):
    plan_of(planner, scene(count=0, road=straight_road(speed_limit=None)))
    assert (planner.choice.scores.speed_limits[:, 0] == 50.0).all()
    assert not planner.surroundings.road.has_limit.any()


def test_a_red_light_on_the_way_is_a_fault(planner):
    scenario = scene(count=0, start=(190.0, 0.0, 0.0))
    lights = TrafficLights(("20", "21"), np.full((NUM_ROWS, 2), LightStatus.RED, np.int8))
    plan_of(planner, scenario)
    assert np.isinf(planner.choice.scores.fault_times).any()
    plan_of(planner, replace(scenario, traffic_lights=lights))
    assert (planner.choice.scores.factors[0] == 0.0).all()
    assert (planner.choice.scores.fault_times < 4.0).all()


def test_a_car_right_ahead_makes_a_slow_ego_brake(planner):
    tracks = standing_tracks(NUM_ROWS, np.array([[222.0, 0.0, 0.0]]), [AgentKind.VEHICLE])
    scenario = scene(tracks=tracks, speed=4.0, start=(210.0, 0.0, 0.0))
    plan = plan_of(planner, scenario)
    assert planner.choice.braked
    np.testing.assert_array_equal(plan.states[0, :7], scenario.expert[0, :7])
    assert plan.states[-1, VX] < 0.3
    np.testing.assert_allclose(plan.states[:, HEADING], 0.0, atol=0.1)


def test_the_same_input_gives_the_same_plan(planner):
    first = plan_of(planner, scene())
    simulate(scene(7, 20), planner)
    np.testing.assert_array_equal(first.states, plan_of(planner, scene()).states)


def test_reactive_traffic_and_noise_are_no_obstacle(planner):
    log = simulate(scene(), planner, traffic="reactive", noise="ou-high", seed=3)
    assert np.isfinite(log.ego).all()
