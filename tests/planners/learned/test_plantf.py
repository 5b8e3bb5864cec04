"""PlanTF with deterministic weights: what must not change a plan, and what it does without data."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plans import crowd, first_sight, in_ego_frame, plan_of
from worlds import cruise_scenario, moved, straight_road

from shiftsim.errors import PlannerError
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.sim.planner import Planner
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AX, HEADING, VX, LightStatus, Tracks, TrafficLights

pytest.importorskip("torch")

from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.learned.plantf.planner import MAX_STEER, PlanTF, current_state

pytestmark = pytest.mark.learned

NUM_ROWS = 60 + 2 * 20 + 1 + 160
BATCH_TOLERANCE = 2e-5  # m; on most machines there is no difference


@pytest.fixture(scope="module")
def planner():
    return PlanTF("deterministic:drive")


def scene(seed: int = 0, count: int = 6, **changes) -> Scenario:
    """Vehicles, pedestrians, bicycles and a cone around an ego in the middle of a short road."""
    rng = np.random.default_rng(seed)
    tracks = crowd(rng, NUM_ROWS, count, 4)
    tracks.poses[:, :, 0] += np.arange(NUM_ROWS)[:, None] * 0.05 * rng.uniform(-1, 3, count)
    tracks.velocities[..., 0] += rng.uniform(-1, 3, count)
    tracks.valid[:50] = rng.random((50, count)) < 0.7
    given = {"iterations": 21, "tracks": tracks, "start": (210.0, 0.3, 0.02), **changes}
    return cruise_scenario(**given)


def outputs(planner: Planner, scenarios: list[Scenario]):
    """What the network says of each, one by one and all at once."""
    forks = [planner.fork() for _ in scenarios]
    features = [
        fork.features(first_sight(scenario, fork))
        for fork, scenario in zip(forks, scenarios, strict=True)
    ]
    return [planner.infer([one])[0] for one in features], planner.infer(features)


def test_a_plan_is_the_present_state_and_eighty_poses_of_a_way_forward(planner):
    scenario = scene()
    plan = plan_of(planner, scenario)
    ego = scenario.expert[0]
    assert plan.states.shape == (81, 11)
    np.testing.assert_array_equal(plan.states[0], ego)
    ahead = in_ego_frame(plan, ego)[:, 0]
    assert (np.diff(ahead) > 0.0).all()
    assert planner.degraded == ""


def test_the_same_input_gives_the_same_plan(planner):
    scenario = scene()
    first, second = plan_of(planner, scenario), plan_of(PlanTF("deterministic:drive"), scenario)
    np.testing.assert_array_equal(first.states, second.states)


@settings(max_examples=6)
@given(
    st.floats(-3.0, 3.0),
    st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
)
def test_where_the_world_lies_does_not_matter_to_the_ego(planner, angle, shift):
    # however the world is turned, the same points are in range
    scenario = scene(start=(203.0, 0.0, 0.0))
    turned = moved(scenario, angle, np.array(shift))
    plan, other = plan_of(planner, scenario), plan_of(planner, turned)
    first = in_ego_frame(plan, scenario.expert[0])
    np.testing.assert_allclose(in_ego_frame(other, turned.expert[0]), first, atol=2e-4)


@settings(max_examples=6)
@given(st.permutations(range(6)))
def test_the_order_of_tracks_does_not_matter(planner, order):
    scenario = scene()
    shuffled = replace(scenario, tracks=scenario.tracks.select(np.array(order)))
    plan, other = plan_of(planner, scenario), plan_of(planner, shuffled)
    np.testing.assert_allclose(plan.states, other.states, atol=1e-4)


def test_agents_change_the_plan(planner):
    alone = plan_of(planner, scene(count=0)).states
    assert np.abs(alone - plan_of(planner, scene()).states).max() > 1e-3


def test_a_batch_agrees_with_one_by_one_whatever_its_sizes(planner):
    far = scene(2, 3, start=(60.0, 0.0, 0.0))
    scenarios = [scene(0, 0), scene(1, 40), far, scene(3, 7, start=(3000.0, 0.0, 0.0))]
    alone, together = outputs(planner, scenarios)
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_allclose(one.trajectory, other.trajectory, atol=BATCH_TOLERANCE)
        np.testing.assert_allclose(one.probability, other.probability, atol=BATCH_TOLERANCE)


def test_forks_do_not_disturb_each_other(planner):
    scenarios = [scene(0), scene(1, 2), scene(2, 9)]
    together = simulate_together([Rollout(one, planner.fork()) for one in scenarios])
    for log, scenario in zip(together, scenarios, strict=True):
        alone = simulate(scenario, planner)
        np.testing.assert_allclose(log.ego[:, :3], alone.ego[:, :3], atol=1e-4)


@pytest.mark.parametrize("count", [0, 1, 500])
def test_any_number_of_agents_will_do(planner, count):
    log = simulate(scene(5, count), planner)
    assert np.isfinite(log.ego).all()
    assert not log.degraded.any()


@pytest.mark.parametrize("samples", [1, 2, 20])
def test_a_short_history_gives_a_plan_that_counts_as_a_makeshift(planner, samples):
    scenario = scene(history_rows=2 * (samples - 1))
    tracks = scenario.tracks.rows(slice(0, len(scenario.time_us)))
    plan = plan_of(planner, replace(scenario, tracks=tracks))
    assert np.isfinite(plan.states).all()
    assert planner.degraded == f"the history has {samples} samples, not 21"


def test_without_any_road_in_range_heading_and_speed_are_kept(planner):
    scenario = scene(start=(3000.0, 50.0, 0.5))
    log = simulate(scenario, planner)
    assert log.degraded.all()
    np.testing.assert_allclose(log.ego[:, VX], 8.0, atol=1e-3)
    np.testing.assert_allclose(log.ego[:, HEADING], 0.5, atol=1e-3)
    with pytest.raises(PlannerError, match="no lane or crosswalk within 100 m"):
        simulate(scenario, planner, strict=True)


@pytest.mark.parametrize("route", [(), ("nowhere",)])
def test_without_a_route_on_the_map_it_drives_on(planner, route):
    plan = plan_of(planner, replace(scene(), route=route))
    assert np.isfinite(plan.states).all()
    assert planner.degraded == "the scenario has no route on the map"


def test_the_route_and_the_lights_are_seen(planner):
    scenario = scene()
    lights = TrafficLights(("20",), np.full((NUM_ROWS, 1), LightStatus.RED, np.int8))
    plain = planner.features(first_sight(scenario, planner)).road
    red = planner.features(first_sight(replace(scenario, traffic_lights=lights), planner)).road
    assert plain.on_route.all()
    assert (plain.light == LightStatus.UNKNOWN).all()
    assert red.light.tolist().count(LightStatus.RED) == 1
    elsewhere = planner.features(first_sight(replace(scenario, route=("3",)), planner)).road
    assert elsewhere.on_route.any()


def test_only_the_nearest_agents_are_seen(planner):
    features = planner.features(first_sight(scene(4, 500), planner))
    assert len(features.agents.valid) == 33


def test_the_steering_angle_follows_from_the_last_two_headings():
    scenario = scene()
    history = first_sight(scenario, ConstantVelocity()).history
    ego = history.ego.copy()
    ego[-1, HEADING] = ego[-2, HEADING] + 0.02
    ego[-1, AX] = -1.5
    turning = replace(history, ego=ego)
    expected = [0, 0, 0, 8.0, -1.5, np.arctan(0.2 * 3.089 / 8.0), 0.2]
    np.testing.assert_allclose(current_state(turning), expected, atol=1e-6)
    ego[-1, HEADING] = ego[-2, HEADING] + 3.0
    assert current_state(turning)[5] < MAX_STEER
    assert current_state(turning)[6] == np.float32(0.95)
    ego[-1, VX] = 0.1
    np.testing.assert_allclose(current_state(turning)[3:], [0.1, -1.5, 0, 0], atol=1e-6)


def test_perfect_tracking_follows_the_plan(planner):
    scenario = scene()
    log = simulate(scenario, planner, controller="perfect")
    plan = plan_of(planner, scenario)
    np.testing.assert_allclose(log.ego[1, :7], plan.states[1, :7], atol=1e-6)


def test_reactive_traffic_and_noise_are_no_obstacle(planner):
    log = simulate(scene(), planner, traffic="reactive", noise="ou-high", seed=3)
    assert np.isfinite(log.ego).all()


def test_a_map_without_speed_limits_will_do(planner):
    plan = plan_of(planner, scene(road=straight_road(speed_limit=None)))
    assert np.isfinite(plan.states).all()


def test_tracks_without_anybody_will_do(planner):
    plan = plan_of(planner, scene(count=0, tracks=Tracks.empty(NUM_ROWS)))
    assert planner.degraded == ""
    assert np.isfinite(plan.states).all()
