"""Diffusion Planner's features: which lanes and agents it sees, and in what form."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import rigid_motions
from worlds import cruise_scenario, moved, standing_tracks, straight_road

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.planners.learned.diffusion.features import (
    FeatureBuilder,
    agent_features,
    lane_inputs,
    lane_lines,
    lanes_in_square,
    lanes_on_route,
    nearest_lanes,
    resample_lanes,
)
from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import scene_info
from shiftsim.world.layers import make_layer, make_polylines, square_around
from shiftsim.world.state import AgentKind, LightStatus, TrafficLights

NUM_ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`
START = (100.0, 0.0, 0.0)
VEHICLE, PEDESTRIAN, CONE = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE


def first_look(scenario, lights=None):
    """Features of the first iteration, and what they were made of."""
    seen = Rollout(scenario, None, controller="log-playback").observe()
    seen = seen if lights is None else replace(seen, lights=lights)
    return FeatureBuilder(scene_info(scenario), lane_lines(scenario.map))(seen, None), seen


def crowd(rng, count, kinds=tuple(AgentKind)):
    poses = np.column_stack([rng.uniform(20, 180, count), rng.uniform(-40, 40, (count, 2))])
    chosen = [kinds[i] for i in rng.integers(0, len(kinds), count)]
    return cruise_scenario(tracks=standing_tracks(NUM_ROWS, poses, chosen), start=START)


def test_lanes_within_the_square_come_by_their_nearest_vertex():
    scenario = cruise_scenario(start=START)
    features, _ = first_look(scenario)
    ids = [scenario.map.edges.ids[edge] for edge in features.edges]
    # the right lane's vertex is under the ego, the left lane's 3.5 m beside it; the connectors
    # begin where the lanes end, on the edge of the square
    assert ids[:2] == ["11", "10"]
    assert set(ids[2:]) == {"20", "21"}


def test_a_lane_has_twenty_points_with_steps_borders_and_its_light():
    features, _ = first_look(cruise_scenario(start=START))
    lane = features.lanes[0]
    np.testing.assert_allclose(lane[:, 0], np.linspace(-100, 100, 20), atol=1e-5)
    np.testing.assert_allclose(lane[:-1, 2], 200 / 19, atol=1e-5)
    assert (lane[-1, 2:4] == 0).all()
    np.testing.assert_allclose(lane[:, 4:8], [[0, 1.75, 0, -1.75]] * 20, atol=1e-5)
    assert (lane[:, 8:] == [0, 0, 0, 1]).all()  # unknown
    assert features.lanes_speed_limit[0] == 15.0
    assert (features.lanes[4:] == 0).all()


def test_red_overwrites_green_and_yellow_counts_as_unknown():
    lights = TrafficLights(
        ("20", "21", "77"),
        np.array([[LightStatus.RED, LightStatus.YELLOW, LightStatus.GREEN]], np.int8),
    )
    scenario = cruise_scenario(start=(150.0, 0.0, 0.0))
    features, _ = first_look(scenario, lights)
    ids = [scenario.map.edges.ids[edge] for edge in features.edges]
    assert (features.lanes[ids.index("20"), :, 8:] == [0, 0, 1, 0]).all()
    assert (features.lanes[ids.index("21"), :, 8:] == [0, 0, 0, 1]).all()


def test_a_map_without_speed_limits_has_none_known():
    features, _ = first_look(cruise_scenario(start=START, road=straight_road(None)))
    assert not features.lanes_has_speed_limit.any()
    assert (features.lanes_speed_limit == 0).all()


def test_lanes_of_the_route_are_copied_in_the_order_of_the_lanes():
    features, _ = first_look(cruise_scenario(start=(150.0, 0.0, 0.0)))
    count = len(features.edges)
    np.testing.assert_array_equal(features.route_lanes[:count], features.lanes[:count])
    assert (features.route_lanes[count:] == 0).all()


def test_only_the_first_stretch_of_the_route_counts():
    blocks = np.array([3, 5, 7, 3, 9])
    assert lanes_on_route(blocks, [1, 3, 5, 2, 7, 9]).tolist() == [0, 1, 3]
    assert lanes_on_route(blocks, []).tolist() == []


def test_a_scenario_without_agents_has_zero_rows():
    features, _ = first_look(cruise_scenario(start=START))
    assert (features.neighbor_agents_past == 0).all()
    assert (features.static_objects == 0).all()


def test_agents_come_with_width_before_length_and_the_kind(rng):
    poses = np.array([[110.0, 0, 0], [130.0, 3, np.pi / 2], [120.0, -3, 0]])
    tracks = standing_tracks(NUM_ROWS, poses, [VEHICLE, PEDESTRIAN, CONE])
    features, _ = first_look(cruise_scenario(tracks=tracks, start=START))
    first, second, third = features.neighbor_agents_past[:3, -1]
    np.testing.assert_allclose(first, [10, 0, 1, 0, 0, 0, 2, 4.5, 1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(second, [30, 3, 0, 1, 0, 0, 2, 4.5, 0, 1, 0], atol=1e-6)
    assert (third == 0).all()
    np.testing.assert_allclose(
        features.static_objects[0], [20, -3, 1, 0, 2, 4.5, 0, 0, 1, 0], atol=1e-6
    )


def test_a_crowd_is_cut_as_a_slow_reference_does(rng):
    for count in (5, 40, 500):
        features, seen = first_look(crowd(rng, count))
        tracks = seen.history.tracks
        kinds, here = tracks.kinds, tracks.poses[-1, :, :2]
        away = np.linalg.norm(here - seen.history.ego[-1, :2], axis=1)
        near = [i for i in np.argsort(away, kind="stable") if kinds[i] <= AgentKind.BICYCLE]
        slow = [i for i in near if kinds[i] != VEHICLE]
        fast = [i for i in near if kinds[i] == VEHICLE]
        most = max(10, 32 - len(fast))
        kept = near if len(near) <= 32 else sorted(fast + slow[:most], key=lambda i: away[i])
        assert features.agents.tolist() == kept[:32]


def test_missing_samples_take_the_next_later_ones():
    tracks = standing_tracks(22, np.zeros((2, 3)), [VEHICLE, VEHICLE])
    tracks.poses[:, :, 0] = np.arange(22)[:, None]
    tracks.valid[5:9, 0] = False
    tracks.poses[5:9, 0] = np.nan
    tracks.valid[:15, 1] = False
    agents, _, chosen = agent_features(tracks, np.zeros(3))
    assert chosen.tolist() == [0, 1]
    assert agents[0, :, 0].tolist() == [1, 2, 3, 4, 9, 9, 9, 9, *range(9, 22)]
    assert agents[1, :, 0].tolist() == [15] * 14 + list(range(15, 22))


def test_a_short_history_is_filled_with_its_oldest_sample():
    tracks = standing_tracks(3, np.zeros((1, 3)), [VEHICLE])
    tracks.poses[:, 0, 0] = [7, 8, 9]
    agents, _, _ = agent_features(tracks, np.zeros(3))
    assert agents[0, :, 0].tolist() == [7] * 19 + [8, 9]


@given(rigid_motions())
def test_agents_do_not_depend_on_where_the_world_lies(motion):
    scenario = crowd(np.random.default_rng(7), 40)
    angle, *shift = motion
    there, _ = first_look(moved(scenario, angle, np.array(shift)))
    here, _ = first_look(scenario)
    np.testing.assert_allclose(there.neighbor_agents_past, here.neighbor_agents_past, atol=1e-4)
    np.testing.assert_allclose(there.static_objects, here.static_objects, atol=1e-4)


@given(rigid_motions())
@settings(max_examples=10)
def test_rows_of_given_lanes_do_not_depend_on_where_the_world_lies(motion):
    scenario = cruise_scenario(start=START)
    angle, *shift = motion
    there = moved(scenario, angle, np.array(shift))
    edges, lights = np.arange(6), np.full(6, 3)
    rows = [
        lane_inputs(lane_lines(one.map), edges, lights, one.expert[0, :3].copy(), ())["lanes"]
        for one in (scenario, there)
    ]
    np.testing.assert_allclose(rows[1], rows[0], atol=1e-4)


def lines_of(rng, count):
    steps = rng.normal(size=(count, 15, 2)) * 20
    return [
        one + np.cumsum(step, axis=0)
        for one, step in zip(rng.normal(size=(count, 1, 2)) * 150, steps, strict=True)
    ]


def test_resampled_lines_are_those_of_shapely(rng):
    lines = lines_of(rng, 20)
    packed = make_polylines(lines)
    rows = resample_lanes(packed, packed, packed)
    for row, line in zip(rows, lines, strict=True):
        string = shapely.LineString(line)
        points = [string.interpolate(at).coords[0] for at in np.linspace(0, string.length, 20)]
        np.testing.assert_allclose(row[:, :2], points, atol=1e-9)
        assert (row[:, 4:] == 0).all()  # both borders are the line itself


def test_a_border_that_runs_the_other_way_is_turned_round():
    line = make_polylines([np.array([[0.0, 0], [10, 0]])])
    left = make_polylines([np.array([[10.0, 2], [0, 2]])])
    right = make_polylines([np.zeros((0, 2))])
    (row,) = resample_lanes(line, left, right)
    np.testing.assert_allclose(row[:, 4:], [[0, 2, 0, 0]] * 20, atol=1e-12)


@given(st.integers(0, 2**32 - 1))
def test_lanes_count_by_area_and_connectors_by_line(seed):
    rng = np.random.default_rng(seed)
    lines = lines_of(rng, 12)
    shapes = [shapely.LineString(line).buffer(5.0) for line in lines]
    areas = make_layer(map(str, range(12)), shapes).polygons
    connectors = shapely.STRtree([shapely.LineString(line) for line in lines[6:]])
    found = lanes_in_square(areas, connectors, 6, square_around(0.0, 0.0, 100.0))
    square = shapely.box(-100, -100, 100, 100)
    expected = [i for i in range(6) if shapes[i].intersects(square)]
    expected += [i for i in range(6, 12) if shapely.LineString(lines[i]).intersects(square)]
    assert found.tolist() == expected


def test_lanes_that_share_their_nearest_vertex_come_by_area_then_as_listed():
    line = np.array([[10.0, 0], [20, 0]])
    lines = make_polylines([line, line, line[::-1] + np.array([1, 0]), line])
    shapes = [shapely.box(low, -1, 30, 1) for low in (9, 5, 0, 5)]
    areas = make_layer("abcd", shapes).polygons
    order = nearest_lanes(np.arange(4), areas, lines, 0.0, 0.0, 70)
    assert order.tolist() == [1, 3, 0, 2]
    assert nearest_lanes(np.arange(4), areas, lines, 0.0, 0.0, 2).tolist() == [1, 3]


@pytest.mark.thorough
def test_in_a_city_seventy_lanes_are_seen():
    scenario = bench_scene(100, 0)
    features, _ = first_look(scenario)
    assert len(set(features.edges.tolist())) == 70
    assert (features.lanes[:, :, 8:].sum(axis=-1) == 1).all()
