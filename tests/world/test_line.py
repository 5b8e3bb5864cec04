"""The route as one line, Frenet coordinates, and what is ahead, with values worked by hand."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from worlds import cruise_scenario, moved_map, moved_poses, standing_tracks, straight_road

from shiftsim.errors import MapError
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.build import BlockSpec, EdgeSpec, build_map
from shiftsim.world.line import Line, find_lead, route_line
from shiftsim.world.state import PACIFICA, AgentKind, LightStatus, TrafficLights

ROAD = straight_road()
RADIUS = 20.0
FRONT, WIDTH = PACIFICA.front_length, PACIFICA.width


def along(poses):
    """A line through poses (K, 3)."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    count = len(poses)
    return Line(
        poses=np.asarray(poses, np.float64),
        arc=np.concatenate([[0.0], np.cumsum(steps)]),
        speed_limits=np.full(count, 10.0),
        widths=np.full(count, 3.5),
        lanes=np.array([0]),
        lane_ids=("a",),
        starts=np.zeros(1),
        successors=((),),
        route_end=float(steps.sum()),
        vehicle=PACIFICA,
    )


ANGLES = np.linspace(0.0, np.pi / 2, 33)  # a quarter of a circle to the left
BEND = along(np.c_[RADIUS * np.sin(ANGLES), RADIUS * (1 - np.cos(ANGLES)), ANGLES])
WORLD = (664_430.0, 3_998_750.0)


# --- Frenet coordinates


def test_a_point_beside_a_straight_line_has_its_arc_length_and_its_offset():
    line = route_line(ROAD, [0, 2, 1], np.array([10.0, 0.0, 0.0]), PACIFICA)
    np.testing.assert_allclose(line.to_frenet([30.25, 1.5, 0.2]), [30.25, 1.5, 0.2], atol=1e-12)
    np.testing.assert_allclose(line.to_frenet([[5.0, -2.0]]), [[5.0, -2.0]], atol=1e-12)
    np.testing.assert_allclose(line.to_poses([30.25, 1.5]), [30.25, 1.5, 0.0], atol=1e-12)


def test_beyond_its_ends_a_line_goes_straight_on():
    np.testing.assert_allclose(BEND.to_frenet([-3.0, 1.0, 0.1]), [-3.0, 1.0, 0.1], atol=1e-12)
    end = BEND.to_frenet([19.0, 24.0, 0.0])
    np.testing.assert_allclose(end, [BEND.arc[-1] + 4.0, 1.0, -np.pi / 2], atol=1e-12)
    np.testing.assert_allclose(BEND.to_poses(end), [19.0, 24.0, 0.0], atol=1e-12)


def test_in_a_bend_offsets_are_differences_of_radii():
    turn = np.pi / 4
    for offset in (-6.0, 0.0, 9.0):
        radius = RADIUS - offset
        point = [radius * np.sin(turn), RADIUS - radius * np.cos(turn), turn]
        s, d, heading = BEND.to_frenet(point)
        assert s == pytest.approx(RADIUS * turn, rel=1e-3)
        assert d == pytest.approx(offset, abs=1e-9)  # right beside a vertex
        assert heading == pytest.approx(0.0, abs=1e-9)


@given(st.floats(-20.0, 50.0), st.floats(-15.0, 15.0), st.floats(-3.1, 3.1), st.booleans())
def test_poses_come_back_from_frenet_coordinates(s, d, heading, is_far):
    shift = np.array([*(WORLD if is_far else (0.0, 0.0)), 0.0])
    line = along(BEND.poses + shift)
    poses = line.to_poses([[s, d, heading]])
    atol = 1e-6 if is_far else 1e-9  # of UTM, a nanometre is left
    found = line.to_frenet(poses)
    np.testing.assert_allclose(found, [[s, d, heading]], atol=atol)
    np.testing.assert_allclose(line.to_poses(found), poses, atol=atol)


def test_any_number_of_poses_is_converted_at_once():
    many = np.tile([1.0, 2.0, 0.3], (2, 5, 1))
    assert BEND.to_frenet(many).shape == (2, 5, 3)
    assert BEND.to_frenet(many[..., :2]).shape == (2, 5, 2)
    assert BEND.to_poses(many[..., :2]).shape == (2, 5, 3)
    with pytest.raises(ValueError, match=r"rows of 2 or 3 numbers, got an array of shape \(4,\)"):
        BEND.to_frenet(np.zeros(4))


# --- lines along routes


def lanes_of(line):
    return list(line.lane_ids)


def test_a_line_follows_the_lane_under_the_pose_to_the_end_of_the_road():
    line = route_line(ROAD, [0, 2], np.array([10.0, 3.2, 0.1]), PACIFICA)
    assert lanes_of(line) == ["10", "20", "30"]  # block "3" is beyond the route
    np.testing.assert_allclose(line.starts, [0.0, 200.0, 220.0])
    assert line.route_end == 220.0
    assert line.successors == (("20",), ("30",), ())
    np.testing.assert_allclose(line.poses[[0, -1]], [[0.0, 3.5, 0.0], [420.0, 3.5, 0.0]])
    np.testing.assert_allclose(np.diff(line.arc), 1.0)
    np.testing.assert_array_equal(line.speed_limits, 15.0)
    np.testing.assert_allclose(line.widths, 3.5)
    assert repr(line) == "<Line: 420 m along 3 lanes and connectors>"


def test_without_a_pose_a_line_begins_in_the_first_block():
    assert lanes_of(route_line(ROAD, [2, 1], None, PACIFICA)) == ["20", "30"]


def test_without_a_route_a_line_goes_straight_on():
    line = route_line(ROAD, [], np.array([205.0, 0.1, 0.0]), PACIFICA)
    assert lanes_of(line) == ["21", "31"]
    assert line.route_end == 20.0
    with pytest.raises(MapError, match="has no lane for the line to begin in"):
        route_line(ROAD, [], None, PACIFICA)


def test_where_blocks_are_missing_the_line_bridges_the_gap():
    line = route_line(ROAD, [0, 1], np.array([10.0, 0.0, 0.0]), PACIFICA)
    assert lanes_of(line) == ["11", "31"]
    np.testing.assert_allclose(line.poses[:, 1], 0.0)
    assert line.arc[-1] == pytest.approx(420.0)


def forked():
    """Two lanes of 100 m; the left one leads on to block B, the right one to block C."""
    edges, blocks = [], []
    for name, start, y in (("A0", 0, 3.5), ("A1", 0, 0.0), ("B0", 100, 3.5), ("C0", 100, 0.0)):
        x = np.linspace(start, start + 100, 101)
        area = shapely.box(start, y - 1.75, start + 100, y + 1.75)
        after = {"A0": ["B0"], "A1": ["C0"]}.get(name, [])
        baseline = np.c_[x, np.full_like(x, y)]
        edges.append(EdgeSpec(name, False, area, baseline, name[0], outgoing=after))
    for name, after in (("A", ["B", "C"]), ("B", []), ("C", [])):
        area = shapely.union_all([edge.polygon for edge in edges if edge.block_id == name])
        blocks.append(BlockSpec(name, False, area, outgoing=after))
    return build_map("forked", edges=edges, blocks=blocks)


def test_a_line_moves_to_the_lane_that_leads_on():
    line = route_line(forked(), [0, 1], np.array([10.0, 0.0, 0.0]), PACIFICA)
    assert lanes_of(line) == ["A1", "B0"]
    y = np.interp([0.0, 80.0, 100.0, 120.0, 200.0], line.poses[:, 0], line.poses[:, 1])
    np.testing.assert_allclose(y, [0.0, 0.0, 1.75, 3.5, 3.5], atol=0.01)
    assert np.abs(line.poses[:, 2]).max() == pytest.approx(1.5 * 3.5 / 40.0, rel=0.01)
    assert np.isnan(line.speed_limits).all()


def test_a_move_begins_at_the_ego_where_little_room_is_left():
    pose = np.array([94.0 - PACIFICA.rear_axle_to_center, 0.0, 0.0])
    line = route_line(forked(), [0, 1], pose, PACIFICA)
    y = np.interp([94.0, 114.0, 134.0], line.poses[:, 0], line.poses[:, 1])
    np.testing.assert_allclose(y, [0.0, 1.75, 3.5], atol=0.01)


def test_without_a_pose_the_line_begins_where_no_move_is_needed():
    road = forked()
    assert lanes_of(route_line(road, [0, 1], None, PACIFICA)) == ["A0", "B0"]
    assert lanes_of(route_line(road, [0, 2], None, PACIFICA)) == ["A1", "C0"]


def test_a_line_does_not_depend_on_where_the_world_is():
    angle, shift = 1.1, np.array([400.0, -300.0])
    pose = np.array([[10.0, 0.2, 0.1]])
    one = route_line(ROAD, [0, 2, 1], pose[0], PACIFICA)
    turned = moved_poses(pose, angle, shift)[0]
    other = route_line(moved_map(ROAD, angle, shift), [0, 2, 1], turned, PACIFICA)
    np.testing.assert_allclose(moved_poses(one.poses, angle, shift), other.poses, atol=1e-9)
    np.testing.assert_allclose(other.to_frenet(turned), one.to_frenet(pose[0]), atol=1e-9)


# --- what a planner asks


def scene_with(poses=(), kinds=(), **changes):
    """A scenario with tracks that stand, and its scene and first observation."""
    scenario = cruise_scenario()
    if len(poses):
        rows = len(scenario.time_us)
        scenario = replace(scenario, tracks=standing_tracks(rows, np.array(poses), [*kinds]))
    scenario = replace(scenario, **changes)
    return scene_info(scenario), observe_log(scenario, 0)


def test_a_scene_knows_its_lanes_and_where_it_starts():
    scene, observation = scene_with()
    road = scene.map
    assert [road.blocks.ids[block] for block in scene.route_blocks] == ["1", "2", "3"]
    assert [road.edges.ids[e] for e in scene.route_lanes] == ["10", "11", "20", "21", "30", "31"]
    np.testing.assert_array_equal(scene.start, observation.ego.pose)
    assert lanes_of(scene.route_line()) == ["11", "21", "31"]
    assert lanes_of(scene.route_line(np.array([50.0, 3.5, 0.0]))) == ["10", "20", "30"]


def test_what_is_made_of_a_scene_is_made_once():
    scene, _ = scene_with()
    assert scene.once(lambda_line) is scene.once(lambda_line)
    assert replace(scene, seed=1).once(lambda_line) is not scene.once(lambda_line)


def lambda_line(scene):
    return scene.route_line()


VEHICLE, PEDESTRIAN, CONE = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE


def test_the_lead_is_the_nearest_box_in_the_corridor():
    # behind, beside us in the next lane, in that lane ahead, and two ahead in our own
    poses = [[0, 0, 0], [12, 3.5, 0], [30, 3.5, 0], [60, 0, 0], [50, 0.5, 0]]
    scene, observation = scene_with(poses, [VEHICLE] * 5)
    lead = observation.lead(scene.route_line())
    assert lead.token == observation.tracks.tokens[4]
    assert lead.gap == pytest.approx(50 - 2.25 - (10 + FRONT))
    assert lead.speed == 0.0


@pytest.mark.parametrize(("y", "is_in"), [(0.5 * WIDTH + 0.99, True), (0.5 * WIDTH + 1.01, False)])
def test_the_corridor_is_as_wide_as_the_ego(y, is_in):
    scene, observation = scene_with([[40.0, y, 0.0]], [VEHICLE])
    assert (observation.lead(scene.route_line()) is not None) == is_in


def test_of_a_box_across_the_lane_the_part_in_the_corridor_counts():
    # 4.5 m x 2 m at 45 degrees: its rear edge enters the corridor from the left
    scene, observation = scene_with([[40.0, 2.0, np.pi / 4]], [VEHICLE])
    lead = observation.lead(scene.route_line())
    half, x = 0.5 * WIDTH, 40.0
    # the rear left corner is outside, the rear right one inside
    corner = np.array([x, 2.0]) + np.array([[-2.25, 1.0], [-2.25, -1.0]]) @ (
        np.array([[1.0, 1.0], [-1.0, 1.0]]) / np.sqrt(2.0)
    )
    assert corner[0, 1] > half or corner[1, 1] < half
    edge = np.linspace(corner[0], corner[1], 100_001)
    entry = edge[np.abs(edge[:, 1]) <= half][:, 0].min()
    assert lead.gap == pytest.approx(entry - (10 + FRONT), abs=1e-3)


def test_a_long_box_that_crosses_with_both_ends_outside_is_in_the_way():
    scene, observation = scene_with([[40.0, 0.0, np.pi / 2]], [VEHICLE])
    assert observation.lead(scene.route_line()).gap == pytest.approx(40 - 1.0 - (10 + FRONT))


def test_a_box_beside_the_front_has_no_gap():
    scene, observation = scene_with([[14.5, 1.5, 0.0]], [VEHICLE])
    assert observation.lead(scene.route_line()).gap == 0.0
    scene, observation = scene_with([[6.0, 1.5, 0.0]], [VEHICLE])  # behind our middle
    assert observation.lead(scene.route_line()) is None


def test_the_speed_of_a_lead_is_that_along_the_line():
    scene, observation = scene_with([[40, 0, np.pi], [60, 0, 0]], [VEHICLE, CONE])
    tracks = observation.tracks
    velocities = np.array([[[-3.0, 4.0], [np.nan, np.nan]]])
    line, pose = scene.route_line(), observation.ego.pose
    assert find_lead(line, pose, replace(tracks, velocities=velocities)).speed == pytest.approx(
        -3.0
    )
    cone = tracks.select(np.array([1]))
    assert find_lead(line, pose, cone).speed == 0.0


def test_nothing_ahead_is_no_lead():
    scene, observation = scene_with()
    assert observation.lead(scene.route_line()) is None
    assert observation.lights_on(scene.route_line()) is None


def red_at(x, *statuses):
    """What a planner sees at x of the lights of both connectors, which begin at 200 m."""
    scenario = cruise_scenario(start=(x, 0.0, 0.0))
    status = np.tile(np.array(statuses, np.int8), (len(scenario.time_us), 1))
    lights = TrafficLights(("20", "21", "21")[: len(statuses)], status)
    scenario = replace(scenario, traffic_lights=lights)
    return observe_log(scenario, 0).lights_on(scene_info(scenario).route_line())


def test_the_next_red_light_is_where_its_connector_begins():
    red, green = LightStatus.RED, LightStatus.GREEN
    light = red_at(100.0, green, red)
    assert light.connector == "21"
    assert light.gap == pytest.approx(100.0 - FRONT)
    assert red_at(100.0, red, green) is None  # that of the other lane
    assert red_at(100.0, green, red, green) == light  # one red entry is enough


def test_a_stop_that_was_passed_holds_for_a_metre():
    red = LightStatus.RED
    assert red_at(200.5 - FRONT, red, red).gap == pytest.approx(-0.5)
    assert red_at(201.5 - FRONT, red, red) is None


def test_others_are_seen_from_the_rear_axle():
    scenario = cruise_scenario(start=(10.0, 0.0, np.pi / 2))
    rows = len(scenario.time_us)
    tracks = standing_tracks(rows, np.array([[10.0, 5.0, np.pi], [0.0, 0.0, 0.0]]), [VEHICLE] * 2)
    tracks.velocities[:, 0] = 1.0, 2.0
    tracks.valid[:, 1] = False
    seen = observe_log(replace(scenario, tracks=tracks), 0).in_ego_frame()
    assert seen.tokens == tracks.tokens[:1]
    np.testing.assert_allclose(seen.poses, [[[5.0, 0.0, np.pi / 2]]], atol=1e-12)
    np.testing.assert_allclose(seen.velocities, [[[2.0, -1.0]]], atol=1e-12)
    np.testing.assert_array_equal(seen.sizes, [[[4.5, 2.0]]])
