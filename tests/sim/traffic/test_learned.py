"""Learned traffic, and traffic driven by planners."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, moved, standing_tracks, straight_road

from shiftsim.errors import CheckpointError, ConfigError, TrafficError
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.sim.traffic import lanes as following
from shiftsim.sim.traffic.learned import features, model
from shiftsim.sim.traffic.learned.model import LearnedTraffic
from shiftsim.sim.traffic.mixed import Mixed
from shiftsim.sim.traffic.planned import PlannedTraffic
from shiftsim.world.state import HEADING, NUM_STATE, VX, VY, YAW_RATE, AgentKind

ROAD = straight_road()
ROWS = 60 + 2 * 60 + 1 + 160
SPEED = 8.0


def scene(gap=30.0, lead_speed=0.0):
    """A car behind another one on the ego's lane, far ahead of it, and a cone and a pedestrian."""
    x = 60.0
    poses = np.array(
        [[x, 0.0, 0.0], [x + gap, 0.0, 0.0], [x + 20.0, 6.0, 0.0], [x - 20.0, 9.0, 1.0]]
    )
    kinds = [AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.TRAFFIC_CONE, AgentKind.PEDESTRIAN]
    tracks = standing_tracks(ROWS, poses, kinds)
    for column, speed in ((0, SPEED), (1, lead_speed)):
        tracks.poses[:, column, 0] += speed * 0.05 * (np.arange(ROWS) - 60)
        tracks.velocities[:, column, 0] = speed
    return cruise_scenario(
        speed=2.0, iterations=61, tracks=tracks, road=ROAD, start=(5.0, 0.0, 0.0)
    )


def drive(scenario, traffic):
    return simulate(scenario, None, controller="log-playback", traffic=traffic).tracks


def test_a_vehicle_stops_behind_one_that_stands():
    first = Mixed((lambda tracks: np.arange(tracks.num_tracks) == 0, LearnedTraffic()))
    tracks = drive(scene(), first)
    gap = tracks.poses[:, 1, 0] - tracks.poses[:, 0, 0]
    assert gap[-1] < gap[0] - 5.0  # it came nearer
    assert gap.min() > tracks.sizes[0, :2, 0].mean()  # and did not touch
    assert np.hypot(*tracks.velocities[-1, 0]) < 1.0
    assert np.abs(tracks.poses[:, 0, 1]).max() < 0.5  # it stays on its lane


def test_without_anyone_in_the_way_it_goes_on():
    tracks = drive(scene(gap=400.0), LearnedTraffic())
    assert tracks.poses[-1, 0, 0] - tracks.poses[0, 0, 0] > 0.6 * SPEED * 5.9


def test_static_objects_and_tracks_of_others_are_replayed():
    scenario = scene()
    tracks, model = drive(scenario, LearnedTraffic()), LearnedTraffic()
    rows = scenario.iteration_rows[: len(tracks)]
    np.testing.assert_array_equal(tracks.poses[:, 2], scenario.tracks.poses[rows, 2])
    buffer = scenario.tracks.rows(scenario.iteration_rows)
    model.start(scenario, buffer, 0, np.array([0, 2]))
    assert model.own.tolist() == [0]


def test_where_the_world_lies_and_who_is_listed_first_change_nothing():
    scenario = scene()
    one = drive(scenario, LearnedTraffic())
    order = np.array([3, 1, 0, 2])
    two = drive(replace(scenario, tracks=scenario.tracks.select(order)), LearnedTraffic())
    np.testing.assert_allclose(two.poses, one.poses[:, order], atol=1e-4)
    shift = np.array([1000.0, -500.0])
    three = drive(moved(scenario, 0.7, shift), LearnedTraffic())
    steps = np.hypot(*(one.poses[-1, :, :2] - one.poses[0, :, :2]).T)
    turned = np.hypot(*(three.poses[-1, :, :2] - three.poses[0, :, :2]).T)
    np.testing.assert_allclose(turned, steps, atol=1e-3)


def test_an_absent_agent_has_no_features_and_does_not_come():
    scenario = scene()
    valid = scenario.tracks.valid.copy()
    valid[:, 0] = False
    scenario = replace(scenario, tracks=replace(scenario.tracks, valid=valid))
    tracks = drive(scenario, LearnedTraffic())
    assert not tracks.valid[:, 0].any()
    assert tracks.valid[:, 1].all()


def test_pedestrians_do_not_walk_into_one_another():
    poses = np.array([[60.0, 9.0, 0.0], [66.0, 9.0, np.pi]])
    tracks = standing_tracks(ROWS, poses, [AgentKind.PEDESTRIAN] * 2)
    way = 1.2 * 0.05 * (np.arange(ROWS) - 60)
    tracks.poses[:, :, 0] += np.c_[way, -way]
    tracks.velocities[:, :, 0] = 1.2, -1.2
    scenario = cruise_scenario(
        speed=2.0, iterations=61, tracks=tracks, road=ROAD, start=(5.0, 0.0, 0.0)
    )
    assert np.abs(way[-1]) > 3.0  # as recorded they pass through one another
    driven = drive(scenario, LearnedTraffic())
    apart = np.hypot(*(driven.poses[:, 0, :2] - driven.poses[:, 1, :2]).T)
    assert apart.min() > 0.9 * np.hypot(*driven.sizes[0, 0])


def test_features_say_who_leads_and_how_far():
    scenario, model = scene(), LearnedTraffic()
    buffer = scenario.tracks.rows(scenario.iteration_rows)
    model.start(scenario, buffer, 0)
    row = model.observe(0, scenario.ego[scenario.iteration_rows[0]], buffer, 0)[0]
    leader = features.PATH + 2 * len(features.AHEAD)
    gap = 30.0 - buffer.sizes[0, :2, 0].mean()
    assert row[0] == pytest.approx(SPEED / 10.0)
    assert row[features.OWN] == 1.0  # it is on a lane
    assert row[leader] == 1.0
    assert (1.0 - row[leader + 1]) * features.REACH == pytest.approx(gap, abs=0.5)
    assert row[leader + 2] * 5.0 == pytest.approx(SPEED)  # it comes nearer by its own speed


def pedestrian_off_the_road():
    """A pedestrian that heads for (cos 0.5, sin 0.5), two others, and one who is absent."""
    frame = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])  # ahead, left
    xy = np.array([[0.0, 0.0], [8.0, 1.0], [-3.0, 5.0], [4.0, 0.0]]) @ frame + [-100.0, 100.0]
    pedestrian, vehicle = features.PEDESTRIAN, features.VEHICLE
    return features.Motion(
        present=np.array([True, True, True, False]),
        poses=np.column_stack([xy, [0.5, 2.0, 1.0, 0.0]]),
        speeds=np.array([2.0, 3.0, 1.0, 0.0]),
        accelerations=np.array([0.6, 0.0, 0.0, 0.0]),
        turns=np.array([0.1, 0.0, 0.0, 0.0]),
        velocities=np.array([[2.0, 0.0], [1.5, 0.5], [-0.5, 1.0], [0.0, 0.0]]) @ frame,
        sizes=np.array([[0.8, 0.6], [4.5, 2.0], [0.7, 0.6], [4.5, 2.0]]),
        kinds=np.array([pedestrian, vehicle, pedestrian, vehicle]),
    )


def test_features_are_in_the_frame_of_the_agent_and_nearest_others_come_first():
    out, lanes = np.full((2, features.NUM_FEATURES), 7.0), following.lanes_of(ROAD)
    features.observe_agents(
        lanes, pedestrian_off_the_road(), np.array([0, 3]), np.full(2, following.NO_LANE), out
    )
    own = [0.2, 0.2, 0.1, 0.16, 0.3, 0.0, 1.0, 0.0, 0.0]
    lane, path = np.zeros(features.LANE), np.column_stack([features.AHEAD / 20.0, np.zeros(8)])
    leader = [1.0, 1.0 - 5.35 / 60.0, 0.1, 0.15, 2.0 / 6.35]  # 8 m less half of 0.8 m and 4.5 m
    others = np.zeros((features.NEIGHBOURS, features.OTHER))
    others[0] = 1.0, -0.3, 0.5, -0.5, 0.2, 0.14, 1.0
    others[1] = 1.0, 0.8, 0.1, -0.1, 0.1, 0.9, 0.0
    expected = np.concatenate([own, lane, path.ravel(), leader, others.ravel()])
    np.testing.assert_allclose(out[0], expected, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(out[1], 0.0)


def test_agents_move_along_the_middle_of_their_turn():
    moved, controls = np.empty((1, 4)), np.array([[1.0, 0.4]])
    features.move_agents(pedestrian_off_the_road(), np.array([0]), controls, 0.5, moved)
    way = 0.5 * (2.0 + 2.5) * 0.5
    xy = -100.0 + way * np.cos(0.6), 100.0 + way * np.sin(0.6)
    np.testing.assert_allclose(moved[0], [*xy, 0.7, 2.5], rtol=0, atol=1e-12)


def test_changes_are_measured_over_three_rows_and_the_ego_moves_as_its_centre():
    scenario, model = scene(), LearnedTraffic()
    tracks, squares = scenario.tracks.rows(scenario.iteration_rows), np.arange(61.0) ** 2
    tracks.velocities[:, 0, 0] = 0.1 * squares
    tracks.poses[:, 3, 2] = 0.01 * squares
    model.start(scenario, tracks, 0)
    ego = np.zeros(NUM_STATE)
    ego[[HEADING, VX, VY, YAW_RATE]] = 0.3, 5.0, 0.2, 0.4
    motion = model._seen(6, ego, tracks, 6)
    assert motion.accelerations[0] == pytest.approx(0.1 * (36.0 - 9.0) / 0.3)
    assert motion.turns[3] == pytest.approx(0.01 * (36.0 - 9.0) / 0.3)
    ahead, left = 5.0, 0.2 + 1.461 * 0.4
    cos, sin = np.cos(0.3), np.sin(0.3)
    expected = [cos * ahead - sin * left, sin * ahead + cos * left]
    np.testing.assert_allclose(motion.velocities[-1], expected, rtol=0, atol=1e-12)


def test_a_red_light_ahead_is_seen():
    lanes = following.lanes_of(ROAD)
    path, edge = np.zeros((len(features.AHEAD) + 1, 3)), int(ROAD.outgoing.items[0])
    before = int(np.flatnonzero([edge in ROAD.outgoing.at(i) for i in range(len(ROAD.edges))])[0])
    x, y = ROAD.baselines.at(before)[-1]
    heading = following.heading_at(ROAD.baselines, before, 1e9)
    x, y = x - 12.0 * np.cos(heading), y - 12.0 * np.sin(heading)
    assert features._trace(lanes, before, x, y, path)[1] == np.inf
    lanes.is_red[following.next_lane(lanes, before)] = True
    assert features._trace(lanes, before, x, y, path)[1] == pytest.approx(12.0, abs=0.2)


def test_weights_of_something_else_are_refused(tmp_path):
    with pytest.raises(CheckpointError, match="no weights of learned traffic"):
        LearnedTraffic(tmp_path / "none.npz")
    arrays = {name: np.zeros(shape) for name, shape in model.SHAPES.items()}
    np.savez(tmp_path / "short.npz", **(arrays | {"last_bias": np.zeros(3)}))
    with pytest.raises(CheckpointError, match=r"'last_bias' has shape \(3,\), not \(2,\)"):
        LearnedTraffic(tmp_path / "short.npz")


def test_a_planner_drives_the_other_vehicles():
    tracks = drive(scene(), PlannedTraffic(lambda: load_planner("idm")))
    gap = tracks.poses[:, 1, 0] - tracks.poses[:, 0, 0]
    assert gap.min() > tracks.sizes[0, :2, 0].mean()
    assert tracks.poses[-1, 0, 0] - tracks.poses[0, 0, 0] > 10.0
    # the second has nobody ahead, and drives on
    assert tracks.poses[-1, 1, 0] - tracks.poses[0, 1, 0] > 10.0


def test_a_driven_vehicle_stops_behind_the_ego():
    poses = np.array([[5.0, 0.0, 0.0]])
    tracks = standing_tracks(ROWS, poses, [AgentKind.VEHICLE])
    scenario = cruise_scenario(
        speed=0.0, iterations=61, tracks=tracks, road=ROAD, start=(35.0, 0.0, 0.0)
    )
    driven = drive(scenario, PlannedTraffic(lambda: load_planner("idm"))).poses[:, 0, 0]
    assert 10.0 < driven[-1] < 35.0 - 3.5


def test_a_driver_is_told_the_time():
    seen = []

    class Watch(ConstantVelocity):
        def plan(self, observation):
            seen.append((observation.time_us, observation.history.time_us[-1]))
            return super().plan(observation)

    scenario = scene()
    drive(scenario, PlannedTraffic(Watch))
    times = scenario.iteration_times[: len(seen) // 2].tolist()
    assert len(times) >= 59
    assert seen[::2] == seen[1::2] == [(time, time) for time in times]


def test_what_a_driver_does_wrong_names_the_vehicle():
    class Nothing:
        def reset(self, scene):
            pass

        def plan(self, observation):
            return None

    with pytest.raises(TrafficError, match=r"the planner of vehicle .* failed at iteration 0"):
        drive(scene(), PlannedTraffic(Nothing))


def test_a_planner_by_name_needs_a_run():
    with pytest.raises(ConfigError, match="needs the planner itself"):
        simulate(scene(), load_planner("idm"), traffic="planner:idm")
