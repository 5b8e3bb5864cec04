"""What the environment shows: CaRL's raster as the planner draws it, and the compact form."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from worlds import cruise_scenario, moved, standing_tracks

import shiftsim.env
from shiftsim.env.driving import DrivingEnv
from shiftsim.env.vector import LANE_STEP, METRES, ROUTE_STEP, SIZE, SPEED, greedy_line, parts_of
from shiftsim.planners.learned.carl.planner import Carl
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.state import AgentKind, LightStatus, TrafficLights

ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`
KINDS = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.BARRIER, AgentKind.BICYCLE]
POSES = np.array([[30.0, 3.5, 0.3], [25.0, -1.0, 0.0], [40.0, 0.0, 0.0], [18.0, 2.0, -1.0]])


def busy(start=(10.0, 0.0, 0.0)):
    tracks = standing_tracks(ROWS, POSES + np.array([start[0] - 10.0, 0.0, 0.0]), KINDS)
    tracks.velocities[:, [0, 1]] = 3.0, -1.0
    scenario = cruise_scenario(tracks=tracks, start=start)
    status = np.full((ROWS, 2), LightStatus.RED, np.int8)
    status[:, 1] = LightStatus.GREEN
    return replace(scenario, traffic_lights=TrafficLights(("21", "20"), status))


def look(scenario, source_of, observation, actions=()):
    """The last observation, and the environment."""
    env = DrivingEnv(store=source_of(scenario), observation=observation, terminate=False)
    seen, _ = env.reset()
    for action in actions:
        seen, *_ = env.step(action)
    assert seen in env.observation_space
    return (parts_of(seen) if observation == "vector" else seen), env


@pytest.mark.learned
def test_the_raster_is_what_carl_sees_at_inference(source_of):
    pytest.importorskip("torch")
    scenario, action = busy(start=(150.0, 0.0, 0.0)), np.array([0.5, 0.1], np.float32)
    seen, env = look(scenario, source_of, "raster", [action] * 7)
    planner = Carl("deterministic:drive")
    planner.reset(scene_info(scenario))
    planner.last_action = action
    features = planner.features(env.episode.observe())
    np.testing.assert_array_equal(seen["raster"], features.pictures)
    np.testing.assert_array_equal(seen["measurements"], features.measurements)
    assert (seen["raster"].max(axis=(1, 2)) > 0).tolist() == [True] * 4 + [False] + [True] * 4


def test_the_critic_sees_time_way_comfort_and_time_to_collision(source_of):
    scenario = cruise_scenario(tracks=standing_tracks(ROWS, POSES[2:3], KINDS[2:3]))
    first, _ = look(scenario, source_of, "raster")
    np.testing.assert_array_equal(first["value_measurements"], np.ones(4))
    seen, _ = look(scenario, source_of, "raster", [np.zeros(2)] * 30)
    expected = [1 - 30 / 151, 1 - 30 / 150, 1.0, 0.5]
    np.testing.assert_allclose(seen["value_measurements"], expected, atol=1e-6)


@pytest.mark.parametrize("observation", ["raster", "vector"])
def test_an_observation_is_not_written_to_later(source_of, observation):
    env = DrivingEnv(store=source_of(busy()), observation=observation)
    seen = [env.reset()[0]]
    copies = deepcopy(seen)
    for _ in range(3):
        seen.append(env.step(np.array([1.0, 0.1]))[0])
        copies.append(deepcopy(seen[-1]))
    env.reset()
    assert data_equivalence(seen, copies, exact=True)


def test_the_nearest_tracks_come_first_as_the_ego_sees_them(source_of):
    seen, env = look(busy(), source_of, "vector")
    tracks, center = seen.tracks, env.episode.log.ego[0, 0] + 1.461
    assert tracks[:, 0].tolist() == [1.0] * 4 + [0.0] * 12
    order = [3, 1, 0, 2]
    np.testing.assert_allclose(tracks[:4, 1] * METRES, POSES[order, 0] - center, atol=1e-5)
    np.testing.assert_allclose(tracks[:4, 2] * METRES, POSES[order, 1], atol=1e-5)
    np.testing.assert_allclose(tracks[:4, 3], np.cos(POSES[order, 2]), atol=1e-6)
    np.testing.assert_allclose(tracks[:4, 4], np.sin(POSES[order, 2]), atol=1e-6)
    np.testing.assert_allclose(tracks[1:3, 5:7] * SPEED, [[3.0, -1.0]] * 2, atol=1e-5)
    np.testing.assert_allclose(tracks[:4, 7:9] * METRES, [[4.5, 2.0]] * 4, atol=1e-5)
    assert tracks[:4, 9:].tolist() == [[1, 0], [1, 0], [0, 0], [0, 1]]
    assert not tracks[4:].any()


def test_more_tracks_than_there_is_room_for_leave_the_nearest(source_of, rng):
    poses = np.column_stack([rng.uniform(-80, 80, (50, 2)), np.zeros(50)])
    scenario = cruise_scenario(tracks=standing_tracks(ROWS, poses, [AgentKind.VEHICLE] * 50))
    seen, _ = look(scenario, source_of, "vector")
    away = np.hypot(poses[:, 0] - 11.461, poses[:, 1])
    found = np.hypot(*seen.tracks[:, 1:3].T) * METRES
    np.testing.assert_allclose(found, np.sort(away)[:16], rtol=1e-5)


def test_the_route_and_the_lanes_lie_ahead(source_of):
    scenario = busy(start=(180.0, 0.5, 0.0))
    seen, _ = look(scenario, source_of, "vector")
    ahead = np.arange(16) * ROUTE_STEP
    np.testing.assert_allclose(seen.route * METRES, np.c_[ahead, np.full(16, -0.5)], atol=1e-4)
    lanes = seen.lanes
    assert lanes[:, 0].tolist() == [1.0] * 6 + [0.0] * 2
    # the ego's own lane, that on the left, and the connectors before those behind them
    points = lanes[:, 4:].reshape(8, 6, 2) * METRES
    np.testing.assert_allclose(
        points[0, :, 0], np.minimum(np.arange(6) * LANE_STEP, 18.539), atol=1e-4
    )
    np.testing.assert_allclose(points[:6, 0, 1], [-0.5, 3.0, -0.5, 3.0, -0.5, 3.0], atol=1e-4)
    assert lanes[:6, 1].tolist() == [1.0] * 6
    np.testing.assert_allclose(lanes[:6, 2] * SPEED, 15.0, rtol=1e-6)
    assert lanes[:6, 3].tolist() == [0, 0, 1, 0, 0, 0]  # red is the connector of the right lane


def test_the_ego_sees_its_motion_and_its_last_action(source_of):
    action = np.array([0.5, -0.25], np.float32)
    seen, env = look(cruise_scenario(), source_of, "vector", [action] * 2)
    state = env.episode.log.ego[2]
    np.testing.assert_allclose(
        seen.ego, [state[3] / 20, state[5] / 5, state[6] / 5, *state[7:11], *action], rtol=1e-6
    )


def test_the_compact_form_does_not_depend_on_where_the_world_is(source_of):
    scenario = busy()
    turned = moved(scenario, 1.1, np.array([400.0, -300.0]))
    actions = [np.array([0.3, 0.02])] * 12
    one, other = (look(s, source_of, "vector", actions)[0] for s in (scenario, turned))
    for part, same in zip(one[:3], other[:3], strict=True):
        np.testing.assert_allclose(part, same, atol=1e-4)
    np.testing.assert_allclose(one.lanes[0], other.lanes[0], atol=1e-4)


def test_a_route_goes_on_where_lanes_do_not(source_of):
    scenario = cruise_scenario()
    road, center = scenario.map, np.array([11.0, 3.4, 0.0])
    scene = scene_info(scenario)
    line = greedy_line(scene, [0, 1], center)  # block 1 lies beyond the connectors
    np.testing.assert_allclose(line[[0, -1]], [[0.0, 3.5], [420.0, 3.5]])
    assert [road.blocks.ids[0], road.blocks.ids[1]] == ["1", "3"]
    nowhere = greedy_line(scene, [], center)
    np.testing.assert_allclose(nowhere, [[11.0, 3.4], [1011.0, 3.4]])


def test_many_compact_observations_are_taken_apart_at_once(rng):
    values = rng.normal(size=(5, 3, SIZE)).astype(np.float32)
    together, one = parts_of(values), parts_of(values[4, 1])
    for part, alone in zip(together, one, strict=True):
        np.testing.assert_array_equal(part[4, 1], alone)
    assert sum(alone.size for alone in one) == SIZE


@pytest.mark.parametrize("observation", ["raster", "vector"])
def test_a_planner_sees_what_a_policy_sees(observation, source_of):
    action = np.array([0.5, 0.1], np.float32)
    scenario = busy()
    env = DrivingEnv(store=source_of(scenario), observation=observation)
    first, _ = env.reset()
    shown = {"raster": shiftsim.env.raster_observation, "vector": shiftsim.env.vector_observation}
    scene = scene_info(scenario)
    for seen, given in ((first, []), (env.step(action)[0], [action])):
        found = shown[observation](
            scene, env.episode.observe() if given else observe_log(scenario, 0), *given
        )
        if observation == "vector":
            np.testing.assert_array_equal(found, seen)
        else:
            assert found.keys() == {"raster", "measurements"}
            for name, part in found.items():
                np.testing.assert_array_equal(part, seen[name])
