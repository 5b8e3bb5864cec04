"""Edits of scenarios: what each of them changes, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.edits.apply import apply_edit
from shiftsim.edits.density import safe_speed
from shiftsim.edits.places import ego_path
from shiftsim.edits.spec import At, make_edit
from shiftsim.errors import ConfigError
from shiftsim.sim.loop import simulate
from shiftsim.world.events import MIXED, STOPPED
from shiftsim.world.scenario import duration_class
from shiftsim.world.state import VX, AgentKind, Command, LightStatus, center_poses


@pytest.fixture
def scene():
    """An ego at 8 m/s on the right lane from x = 10 m; a car ahead, a pedestrian, another car."""
    bare = cruise_scenario(iterations=61)
    poses = np.array([[60.0, 0.0, 0.0], [40.0, 3.5, 0.0], [150.0, -3.0, 1.5]])
    kinds = [AgentKind.VEHICLE, AgentKind.VEHICLE, AgentKind.PEDESTRIAN]
    return replace(bare, tracks=standing_tracks(len(bare.time_us), poses, kinds))


@pytest.fixture
def moving(scene):
    """The same, the car ahead at 6 m/s."""
    tracks = scene.tracks.rows(np.arange(len(scene.time_us)))
    seconds = (scene.time_us - scene.iteration_times[0]) * 1e-6
    tracks.poses[:, 0, 0] = 60.0 + 6.0 * seconds
    tracks.velocities[:, 0] = 6.0, 0.0
    return replace(scene, tracks=tracks)


def now(scenario):
    return int(scenario.iteration_rows[0])


def pose_of(scenario, token, iteration=0):
    column = scenario.tracks.tokens.index(token)
    return scenario.tracks.poses[scenario.iteration_rows[iteration], column]


class Coast:
    """Goes straight on."""

    def reset(self, scene):
        pass

    def plan(self, observation):
        return Command(0.0, 0.0)


def test_a_parked_vehicle_stands_in_all_rows_where_it_was_put(scene):
    parked = scene.edited(
        "parked", spawn={"at": {"ahead_m": 20.0, "left_m": -1.2}, "behavior": "stopped"}
    )
    x = center_poses(scene.expert[:1, :3])[0, 0] + 20.0
    column = parked.tracks.tokens.index("parked.vehicle0")
    assert parked.token == "0123456789abcdef-parked"
    np.testing.assert_allclose(parked.tracks.poses[:, column], [[x, -1.2, 0.0]] * 341, atol=1e-9)
    assert (parked.tracks.velocities[:, column] == 0.0).all()
    assert parked.script.behaviors[column] == STOPPED
    assert scene.tracks.num_tracks == 3  # the recorded one is as it was
    assert parked.script.words == ("spawn: 20 m ahead, 1.2 m right, stopped",)


def test_tracks_stay_ordered_by_kind(scene):
    edited = scene.edited(
        spawn=[
            {"kind": "traffic_cone", "at": {"ahead_m": 70.0}},
            {"at": {"ahead_m": 80.0}, "behavior": "stopped"},
        ]
    )
    assert (np.diff(edited.tracks.kinds) >= 0).all()


def test_tracks_are_removed_by_kind_place_and_share(scene):
    assert scene.edited(remove={"kinds": ["vehicle"]}).tracks.num_tracks == 1
    near = scene.edited(remove={"near": [40.0, 3.5, 5.0]})
    assert near.tracks.tokens == (scene.tracks.tokens[0], scene.tracks.tokens[2])
    half = [scene.edited(remove={"kinds": ["vehicle"], "share": 0.5}, seed=s) for s in range(9)]
    assert {len(edited.tracks.tokens) for edited in half} == {2}
    assert len({edited.tracks.tokens for edited in half}) == 2
    again = scene.edited(remove={"kinds": ["vehicle"], "share": 0.5}, seed=3)
    assert again.tracks.tokens == half[3].tracks.tokens


def test_a_track_is_moved_in_its_own_frame(moving):
    token = moving.tracks.tokens[0]
    edited = moving.edited(move={"tokens": [token], "ahead_m": 5.0, "left_m": 1.0})
    for iteration in (0, 30):
        shift = pose_of(edited, token, iteration) - pose_of(moving, token, iteration)
        np.testing.assert_allclose(shift, [5.0, 1.0, 0.0], atol=1e-9)


def test_a_slowed_track_goes_half_as_far_from_then_on(moving):
    token = moving.tracks.tokens[0]
    edited = moving.edited(slow={"tokens": [token], "factor": 0.5, "from_s": 2.0})
    assert pose_of(edited, token, 10)[0] == pytest.approx(66.0)
    assert pose_of(edited, token, 40)[0] == pytest.approx(60.0 + 12.0 + 6.0)
    velocities = edited.tracks.velocities[edited.iteration_rows[40], 0]
    np.testing.assert_allclose(velocities, [3.0, 0.0], atol=1e-6)


def test_a_stopping_track_needs_its_braking_distance(moving):
    token = moving.tracks.tokens[0]
    edited = moving.edited(stop={"tokens": [token], "from_s": 1.0, "decel_mps2": 3.0})
    # 6 m/s at 3 m/s^2: 2 s and 6 m
    assert pose_of(edited, token, 60)[0] == pytest.approx(60.0 + 6.0 + 6.0, abs=1e-6)
    assert edited.tracks.velocities[edited.iteration_rows[40], 0, 0] == pytest.approx(0.0, abs=1e-6)


def test_a_lane_is_closed_by_cones_at_even_distances(scene):
    closed = scene.edited(
        block_lane={"at": {"ahead_m": 60.0}, "length_m": 12.0, "spacing_m": 3.0, "taper_m": 6.0}
    )
    cones = closed.tracks.kinds == AgentKind.TRAFFIC_CONE
    poses = closed.tracks.poses[now(closed), cones]
    start = center_poses(scene.expert[:1, :3])[0, 0] + 60.0
    np.testing.assert_allclose(poses[-5:, 0] - start, [0.0, 3.0, 6.0, 9.0, 12.0], atol=1e-9)
    np.testing.assert_allclose(poses[-5:, 1], 0.0, atol=1e-9)
    assert poses[0, 1] == pytest.approx(-1.5)  # the taper begins at the border of the lane
    assert poses[0, 0] == pytest.approx(start - 6.0)


def test_a_walk_at_a_time_is_in_the_tracks(scene):
    walk = {"from": {"ahead_m": 40.0, "left_m": -4.0}, "to": {"ahead_m": 40.0, "left_m": 4.0}}
    edited = scene.edited(walk=walk | {"start_s": 1.0, "speed_mps": 2.0})
    token = "edited.pedestrian0"
    assert [pose_of(edited, token, i)[1] for i in (0, 10, 20, 60)] == pytest.approx([-4, -4, -2, 4])
    hidden = scene.edited(walk=walk | {"start_s": 1.0, "visible": False})
    column = hidden.tracks.tokens.index(token)
    there = hidden.tracks.valid[hidden.iteration_rows, column]
    assert not there[:10].any()
    assert there[10:].all()


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive", "constant-velocity"])
def test_a_walk_waits_for_the_ego(scene, traffic):
    walk = {"from": {"ahead_m": 40.0, "left_m": -4.0}, "to": {"ahead_m": 40.0, "left_m": 4.0}}
    edited = scene.edited(remove={}, walk=walk | {"ego_within_m": 20.4, "speed_mps": 1.0})
    log = simulate(edited, Coast(), traffic=traffic)
    column = edited.tracks.tokens.index("edited.pedestrian0")
    y = log.tracks.poses[:, column, 1]
    # 40 m ahead, 4 m aside: within 20.4 m after 20 m, at 8 m/s after 2.5 s; a step passes until
    # it has moved
    begun = int(np.argmax(y > -4.0))
    assert begun == 26
    assert y[begun] == pytest.approx(-3.9)
    assert y[begun + 10] == pytest.approx(-2.9)


def test_lights_are_red_for_a_while(scene):
    road = replace(
        scene.map, has_traffic_lights=np.arange(len(scene.map.edges)) >= scene.map.num_lanes
    )
    lit = replace(scene, map=road).edited(
        light={"route": True, "status": "red", "from_s": 1.0, "to_s": 2.0}
    )
    lights = lit.traffic_lights
    assert set(lights.connector_ids) == {"20", "21"}
    status = lights.status[lit.iteration_rows]
    assert (status[10:20] == LightStatus.RED).all()
    assert (status[:10] == LightStatus.ABSENT).all()
    assert (status[20:] == LightStatus.ABSENT).all()


def test_speeds_of_ego_limits_and_tracks(moving):
    edited = moving.edited(speed={"limit": 0.5, "tracks": 0.5, "ego_mps": 3.0})
    assert edited.expert[0, VX] == 3.0
    np.testing.assert_array_equal(edited.map.speed_limits, 0.5 * moving.map.speed_limits)
    assert pose_of(edited, moving.tracks.tokens[0], 20)[0] == pytest.approx(66.0)


def test_a_shorter_window_has_fewer_iterations(scene):
    edited = scene.edited(window_s=3.0)
    assert edited.num_iterations == 31
    assert edited.duration_class == "3 s"
    with pytest.raises(ConfigError, match=r"60 s is longer than the 14\.0 s that are recorded"):
        scene.edited(window_s=60.0)


@pytest.mark.parametrize(
    ("iterations", "name"),
    [(150, "15 s"), (151, "15 s"), (149, "14 s"), (200, "20 s"), (201, "20 s"), (301, "30 s")],
)
def test_a_window_that_is_not_15_s_is_a_class_of_its_own(iterations, name):
    assert duration_class(np.arange(iterations) * 100_000) == name


def test_density_leaves_space_and_depends_on_the_seed_alone(scene):
    dense = scene.edited(remove={}, density={"level": "high"}, seed=4)
    again = scene.edited(remove={}, density={"level": "high"}, seed=4)
    other = scene.edited(remove={}, density={"level": "high"}, seed=5)
    poses = dense.tracks.poses[now(dense)]
    assert len(poses) >= 4
    np.testing.assert_array_equal(poses, again.tracks.poses[now(again)])
    assert not np.array_equal(poses, other.tracks.poses[now(other)])
    for y in (0.0, 3.5):
        gaps = np.diff(np.sort(poses[np.isclose(poses[:, 1], y), 0]))
        assert (gaps >= 10.0 - 1e-6).all()
        assert (gaps <= 2 * 33.0).all()
    log = simulate(dense, Coast(), traffic="reactive")
    assert log.tracks.valid[-1].any()


def test_a_mover_came_along_its_lane(scene):
    edited = scene.edited(spawn={"at": {"ahead_m": 80.0}, "speed_mps": 5.0})
    column = edited.tracks.tokens.index("edited.vehicle0")
    row = now(edited)
    past = edited.tracks.poses[[row - 20, row], column, 0]
    assert past[1] - past[0] == pytest.approx(5.0)
    assert not edited.tracks.valid[row + 1 :, column].any()  # traffic drives it from here on


def test_speeds_of_density_let_a_vehicle_stop():
    assert safe_speed(5.0, 20.0, 0.25) == pytest.approx(7.0232, abs=1e-4)
    assert safe_speed(0.0, 10.0, 0.25) == pytest.approx(3.4886, abs=1e-4)
    assert safe_speed(10.0, 10.0, 0.25) == 5.0  # two seconds apart


def test_a_goal_in_the_other_lane_ends_the_rollout_there(scene):
    edited = scene.edited(remove={}, reroute={"goal": [50.0, 3.5]})
    assert edited.route == ("1",)
    np.testing.assert_allclose(edited.mission_goal, [50.0, 3.5, 0.0], atol=1e-9)
    log = simulate(edited, Coast(), traffic="nonreactive")
    # the ego's centre, at 11.461 m, has 38.44 m to go: 4.9 s at 8 m/s, and that sample is kept
    assert len(log.ego) == 50
    assert center_poses(log.ego[-1:, :3])[0, 0] > 49.9
    on = scene.edited(remove={}, reroute={"goal": [50.0, 3.5]}, end_at_goal=False)
    assert len(simulate(on, Coast(), traffic="nonreactive").ego) == 60
    assert edited.expert[-1, 0] == pytest.approx(50.0 - 1.461)


def test_agents_may_look_where_the_ego_will_be(scene):
    assert scene.edited(agents="mixed", window_s=3.0).script.yielding == MIXED


def test_the_path_goes_on_beyond_the_recording(scene):
    short = replace(scene, ego=np.where(np.arange(11) < 2, scene.ego[now(scene)], scene.ego))
    path = ego_path(short)
    np.testing.assert_allclose(path.pose(At(100.0, 1.0, 0.1))[1:], [1.0, 0.1], atol=1e-9)


_WALK = {"from": {"ahead_m": 40.0, "left_m": -4.0}, "to": {"ahead_m": 40.0, "left_m": 4.0}}


@pytest.mark.parametrize(
    ("tables", "reason"),
    [
        ({"spawn": {"at": {"ahead_m": 0.0}, "behavior": "stopped"}}, "on the ego"),
        (
            {"spawn": {"at": {"ahead_m": 49.0}, "behavior": "stopped"}},
            "on track '0000000000000000'",
        ),
        ({"spawn": {"pose": [60.0, 900.0, 0.0], "behavior": "stopped"}}, "m from any lane"),
        ({"spawn": {"at": {"ahead_m": 30.0, "left_m": 12.0}}}, "is on no lane"),
        ({"remove": {"tokens": ["nobody"]}}, "there is no track 'nobody'"),
        ({"light": {"connectors": ["10"], "status": "red"}}, "'10' is a lane"),
        ({"light": {"route": True, "status": "red", "from_s": 6.0}}, "light: from_s is 6, the"),
        (
            {"stop": {"tokens": ["0" * 16], "from_s": 99.0}},
            "from_s is 99, the scenario ends at 6.0 s",
        ),
        ({"slow": {"factor": 0.5, "kinds": ["vehicle"], "from_s": 6.0}}, "slow: from_s is 6"),
        ({"remove": {"share": 0.0}}, "nothing changes in the 6.0 s of the scenario"),
        ({"remove": {"near": [0.0, 0.0, 5.0]}}, "nothing changes"),
        ({"remove": {"kinds": ["barrier"]}}, "nothing changes"),
        ({"move": {"tokens": ["0" * 16]}}, "nothing changes"),
        ({"slow": {"factor": 1.0, "kinds": ["vehicle"]}}, "nothing changes"),
        ({"slow": {"factor": 0.5, "kinds": ["barrier"]}}, "nothing changes"),
        ({"speed": {}}, "nothing changes"),
        ({"speed": {"limit": 1.0, "tracks": 1.0}}, "nothing changes"),
        ({"walk": _WALK | {"start_s": 13.0, "visible": False}}, "nothing changes"),
        ({"window_s": 0.1}, "a window of 0.1 s is too short"),
        ({"reroute": {"route": ["3"]}}, "does not hold roadblock '1' of the ego"),
        ({"reroute": {"goal": [5.0, 0.0]}}, "no lanes lead|the goal is"),
    ],
)
def test_what_cannot_be_applied_names_scenario_edit_and_reason(scene, tables, reason):
    with pytest.raises(ConfigError, match=f"edit 'mine' of scenario '0123456789abcdef'.*{reason}"):
        scene.edited("mine", **tables)


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ({"spwan": []}, "key 'spwan' unknown"),
        ({"spawn": [{"behaviour": "stopped"}]}, "spawn: key 'behaviour' unknown"),
        ({"spawn": [{"behavior": "asleep"}]}, "behavior 'asleep' unknown"),
        ({"spawn": [{}]}, "give either pose or a place"),
        ({"spawn": [{"pose": [1.0, 2.0]}]}, "pose has 2 values, not 3"),
        ({"spawn": [{"at": {}, "speed_mps": -1.0}]}, "speed_mps -1.0 must be 0 or more"),
        (
            {"slow": [{"factor": -1.0, "kinds": ["vehicle"]}]},
            "slow: factor -1.0 must be from 0 to 1",
        ),
        ({"spawn": [{"at": {"ahead_m": float("nan")}}]}, "ahead_m nan must be finite"),
        (
            {"light": [{"status": "red", "route": True, "from_s": 10, "to_s": 5}]},
            "to_s is not after",
        ),
        ({"block_lane": [{"at": {}, "length_m": 0}]}, "block_lane: length_m 0 must be above 0"),
        ({"stop": [{"tokens": ["a"], "decel_mps2": 0}]}, "stop: decel_mps2 0 must be above 0"),
        ({"spawn": [{"at": {}, "behavior": "stopped", "speed_mps": 8}]}, "speed_mps is for"),
        ({"spawn": [{"at": {}, "kind": "barrier", "speed_mps": 8}]}, "speed_mps is for"),
        ({"walk": _WALK | {"start_s": 1, "ego_within_m": 20}}, "either start_s or ego_within_m"),
        ({"spawn": [{"at": {}, "speed_mps": "fast"}]}, "speed_mps is 'fast'; it must be a number"),
        ({"spawn": [{"at": {}, "speed_mps": 10**400}]}, "it must be a number that is not so large"),
        ({"slow": [{"factor": 2.0, "kinds": ["vehicle"]}]}, "factor is above 1"),
        ({"walk": [{"from": {"ahead_m": 1.0}}]}, "end is missing"),
        ({"code": "dl", "remove": [{}]}, "code and remove exclude each other"),
        ({}, "nothing is edited"),
    ],
)
def test_a_wrong_table_is_one_error(table, reason):
    with pytest.raises(ConfigError, match=reason):
        make_edit({"name": "mine", **table}, "edit 1")


def test_a_name_is_a_plain_word():
    with pytest.raises(ConfigError, match="letters, digits and underscores"):
        make_edit({"name": "a/b", "remove": [{}]}, "edit 1")


def test_equal_content_has_an_equal_digest(scene):
    table = {"name": "mine", "spawn": [{"at": {"ahead_m": 20}, "behavior": "stopped"}]}
    one, same = make_edit(table, "a"), make_edit(dict(reversed(table.items())), "b")
    other = make_edit({**table, "seed": 1}, "c")
    assert one.digest == same.digest != other.digest
    assert apply_edit(scene, one).script.digest == one.digest
