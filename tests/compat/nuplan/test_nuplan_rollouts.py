"""Planners written for nuPlan drive as planners for shiftsim do."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from boxes import boxes_intersect
from worlds import cruise_scenario, moved, standing_tracks

from shiftsim.compat import nuplan
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.world.state import AgentKind, LightStatus, TrafficLights, Trajectory, center_poses

# the devkit's own footprint loses the last bit of the rear axle
TOLERANCE = 0.0 if nuplan.install() else 1e-9
import nuplan_planners as planners  # noqa: E402  # the names must exist first


def _same(one, other):
    for name in ("ego", "commands", "plans"):
        np.testing.assert_allclose(
            getattr(one, name), getattr(other, name), rtol=0, atol=TOLERANCE, err_msg=name
        )


def _turned(scenario):
    return moved(scenario, 0.7, np.array([300.0, -20.0]))


@pytest.mark.parametrize("noise", ["none", "ou-high"])
def test_a_coasting_planner_drives_as_our_own_to_the_last_bit(noise):
    scenario = _turned(cruise_scenario(iterations=40))
    ours = simulate(scenario, load_planner("constant-velocity"), noise=noise)
    theirs = simulate(scenario, load_planner("nuplan:nuplan_planners:Coast"), noise=noise)
    _same(theirs, ours)


def test_the_motion_model_makes_the_plans_of_our_simple_planner():
    scenario = _turned(cruise_scenario(iterations=40, speed=9.0))
    ours = simulate(scenario, load_planner("simple", {"max_velocity": "6"}))
    theirs = simulate(scenario, load_planner("nuplan:nuplan_planners:Roll", {"max_velocity": "6"}))
    np.testing.assert_allclose(theirs.ego, ours.ego, rtol=0, atol=1e-9)
    np.testing.assert_allclose(theirs.plans, ours.plans, rtol=0, atol=1e-9)
    assert ours.ego[-1, 3] < 8.0


def test_perfect_tracking_reads_the_velocities_of_the_plan():
    scenario = cruise_scenario(iterations=20)
    ours = simulate(scenario, load_planner("simple"), controller="perfect")
    theirs = simulate(scenario, load_planner("nuplan:nuplan_planners:Roll"), controller="perfect")
    np.testing.assert_allclose(theirs.ego, ours.ego, rtol=0, atol=1e-9)


def test_a_planner_finds_its_way_over_the_map():
    scenario = _turned(cruise_scenario(iterations=151, speed=14.0, start=(50.0, 0.4, 0.0)))
    wrapped = nuplan.wrap(planners.FollowRoute())
    log = simulate(scenario, wrapped)
    assert wrapped._planner.lanes == ["11", "21", "31"]
    baseline = shapely.LineString(scenario.map.baselines.at(scenario.map.edge("31")))
    assert baseline.distance(shapely.Point(log.ego[-1, :2])) < 0.02
    assert log.ego[-1, 3] == pytest.approx(15.0, abs=0.05)


class LeaderTwin:
    """`FollowLeader` on arrays."""

    def reset(self, scene):
        self._scene = scene

    def plan(self, observation):
        states = observation.history.ego
        now, before = states[-1, 3], states[-2, 3]
        wish = now + 0.5 * (now - before) + 0.1
        for gap in [*self._gaps(observation), *self._red(observation)]:
            wish = min(wish, max(0.0, 0.4 * (gap - 4.0)))
        x, y, heading = observation.ego.pose
        times = np.arange(41) * 0.1
        ahead = wish * 0.1 * np.arange(41)
        poses = np.c_[x + ahead * np.cos(heading), y + ahead * np.sin(heading), 0 * times + heading]
        return Trajectory.from_poses(times, poses)

    def _ahead(self, observation, point):
        x, y, heading = observation.ego.center
        return np.cos(heading) * (point[0] - x) + np.sin(heading) * (point[1] - y)

    def _gaps(self, observation):
        tracks, ego = observation.tracks, observation.ego
        center = ego.center.copy()
        center[:2] += 30.0 * np.array([np.cos(center[2]), np.sin(center[2])])
        for track in np.flatnonzero(tracks.valid[0] & (tracks.kinds == AgentKind.VEHICLE)):
            pose, size = tracks.poses[:, track], tracks.sizes[:, track]
            lane = np.array([[60.0, self._scene.vehicle.width]])
            if boxes_intersect(center[None], lane, pose, size)[0]:
                yield self._ahead(observation, pose[0])

    def _red(self, observation):
        road = self._scene.map
        for connector, status in observation.traffic_lights.items():
            start = road.baselines.at(road.edge(connector))[0]
            if status == LightStatus.RED and self._ahead(observation, start) > 0.0:
                yield self._ahead(observation, start)


def _with_leader(traffic_light=None):
    bare = cruise_scenario(iterations=100, speed=8.0, start=(120.0, 0.0, 0.0))
    rows = len(bare.time_us)
    poses = np.array([[260.0, 0.0, 0.0], [150.0, 3.5, 0.0], [180.0, 0.0, 0.0]])
    kinds = [AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.TRAFFIC_CONE]
    scenario = replace(bare, tracks=standing_tracks(rows, poses, kinds))
    if traffic_light is not None:
        status = np.full((rows, 1), int(traffic_light), np.int8)
        scenario = replace(scenario, traffic_lights=TrafficLights(("21",), status))
    return _turned(scenario)


@pytest.mark.parametrize("light", [None, LightStatus.GREEN, LightStatus.RED])
def test_a_planner_that_looks_at_tracks_and_lights_drives_as_its_twin_on_arrays(light):
    scenario = _with_leader(light)
    theirs = simulate(scenario, nuplan.wrap(planners.FollowLeader))
    ours = simulate(scenario, LeaderTwin())
    np.testing.assert_allclose(theirs.ego, ours.ego, rtol=0, atol=1e-9)


def test_the_light_and_not_the_cone_stops_the_planner():
    red, green = (
        simulate(_with_leader(light), nuplan.wrap(planners.FollowLeader))
        for light in (LightStatus.RED, LightStatus.GREEN)
    )
    driven = [np.hypot(*np.diff(log.ego[:, :2], axis=0).T).sum() for log in (red, green)]
    assert 60.0 < driven[0] < 78.0  # the line is 80 m ahead of the rear axle
    assert driven[1] > 82.0


def test_reactive_traffic_is_seen_where_it_drives():
    scenario = _with_leader()
    recorder = planners.Recorder()
    log = simulate(scenario, nuplan.wrap(recorder), traffic="reactive")
    for iteration, (_, observations) in enumerate(recorder.buffers):
        objects = {o.track_token: o for o in observations[-1].tracked_objects}
        present = np.flatnonzero(log.tracks.valid[iteration])
        assert set(objects) == {log.tracks.tokens[i] for i in present}
        for track in present:
            center = objects[log.tracks.tokens[track]].center
            np.testing.assert_array_equal([*center], log.tracks.poses[iteration, track])


def test_a_trajectory_of_another_class_is_followed_where_the_simulation_looks():
    scenario = cruise_scenario(iterations=60, speed=6.0)
    log = simulate(scenario, nuplan.wrap(planners.DriveInCircles))
    assert log.ego[-1, 2] == pytest.approx(6.0 * 5.8 / 40.0, abs=0.15)
    perfect = simulate(scenario, nuplan.wrap(planners.DriveInCircles), controller="perfect")
    assert perfect.ego[-1, 2] == pytest.approx(6.0 * 5.8 / 40.0, abs=1e-9)


def test_a_new_instance_drives_every_scenario_when_a_class_is_wrapped():
    wrapped = nuplan.wrap(planners.Recorder)
    scenario = cruise_scenario(iterations=10)
    simulate(scenario, wrapped)
    first = wrapped._planner
    simulate(scenario, wrapped)
    assert wrapped._planner is not first
    assert len(first.inputs) == len(wrapped._planner.inputs) == 9
    assert len(wrapped.report.compute_trajectory_runtimes) == 9
    assert wrapped.report.compute_summary_statistics()["compute_trajectory_runtimes_mean"] > 0.0


def test_the_history_is_that_of_nuplan():
    scenario = _with_leader(LightStatus.YELLOW)
    recorder = planners.Recorder()
    log = simulate(scenario, nuplan.wrap(recorder))
    first = recorder.inputs[0]
    assert all(given.history is first.history for given in recorder.inputs)
    start = int(scenario.iteration_times[0])
    for iteration, (egos, observations) in enumerate(recorder.buffers):
        now = int(scenario.iteration_times[iteration])
        assert [ego.time_us for ego in egos] == list(range(now - 2_100_000, now + 1, 100_000))
        assert len(observations) == 22
        np.testing.assert_array_equal([*egos[-1]][1:4], log.ego[iteration, :3])
    assert first.history.sample_interval == 0.1
    assert recorder.inputs[7].iteration.index == 7
    assert recorder.inputs[7].iteration.time_us == start + 700_000
    (light,) = recorder.inputs[7].traffic_light_data
    assert (light.lane_connector_id, light.status.name) == (21, "YELLOW")
    assert light.timestamp == start + 700_000


def test_an_ego_state_carries_everything_our_rows_do():
    scenario = _turned(cruise_scenario(iterations=12))
    recorder = planners.Recorder()
    log = simulate(scenario, nuplan.wrap(recorder), noise="ou-high")
    state, row = recorder.buffers[-1][0][-1], log.ego[-1]
    motion = state.dynamic_car_state
    got = [
        *state.rear_axle,
        *motion.rear_axle_velocity_2d.array,
        *motion.rear_axle_acceleration_2d.array,
        state.tire_steering_angle,
        motion.tire_steering_rate,
        motion.angular_velocity,
        motion.angular_acceleration,
    ]
    np.testing.assert_array_equal(got, row)
    np.testing.assert_array_equal([*state.center], center_poses(row[None, :3])[0])
    assert state.agent.tracked_object_type.name == "EGO"
