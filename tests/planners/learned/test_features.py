"""Features that learned planners share, against slow and obvious versions."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import savgol_filter
from strategies import seeds
from worlds import straight_road

from shiftsim.planners.learned.features import (
    SAMPLES,
    agent_features,
    map_poses,
    plan_of_poses,
    straight_on,
)
from shiftsim.planners.learned.map_features import (
    CONNECTOR,
    CROSSWALK,
    LANE,
    POINTS,
    LightLookup,
    oriented_rectangle,
    resample,
    road_features,
    road_objects,
)
from shiftsim.sim.planner import History
from shiftsim.world.build import AreaSpec, build_map
from shiftsim.world.layers import make_polylines
from shiftsim.world.map import PerMap, VectorMap
from shiftsim.world.state import AX, AY, VX, VY, LightStatus, Tracks, TrafficLights

ORIGIN = np.zeros(3)


def with_crosswalk(road: VectorMap, *areas: shapely.Polygon) -> VectorMap:
    specs = [AreaSpec(str(900 + i), area) for i, area in enumerate(areas)]
    extra = build_map("crosswalks", edges=[], blocks=[], crosswalks=specs)
    return replace(road, crosswalks=extra.crosswalks)


def history(
    *, samples: int = 22, speed: float = 8.0, heading: float = 0.0, tracks: Tracks | None = None
) -> History:
    times = 1_600_000_000_000_000 + 100_000 * np.arange(samples)
    ego = np.zeros((samples, 11))
    along = speed * 0.1 * (np.arange(samples) - samples + 1)
    ego[:, 0], ego[:, 1] = along * np.cos(heading), along * np.sin(heading)
    ego[:, 2], ego[:, VX] = heading, speed
    return History(times, ego, Tracks.empty(samples) if tracks is None else tracks)


def random_tracks(rng, count: int, samples: int = 22) -> Tracks:
    poses = rng.normal(0.0, 40.0, (samples, count, 3))
    kinds = rng.integers(0, 7, count)
    velocities = np.where(kinds[None, :, None] <= 2, rng.normal(0, 5, (samples, count, 2)), np.nan)
    sizes = np.tile(rng.uniform(0.5, 6.0, (1, count, 2)), (samples, 1, 1))
    valid = rng.random((samples, count)) < 0.8
    tokens = tuple(f"{i:04x}" for i in range(count))
    return Tracks(valid, poses, velocities, sizes, kinds, tokens)


def seen(road, ego=ORIGIN, radius=100.0, route=None):
    on_route = np.zeros(len(road.blocks), np.bool_) if route is None else route
    lights = LightLookup(road).at(TrafficLights.empty(1))
    return road_features(road, ego, ego, radius, lights, on_route)


def test_arrays_of_a_map_are_built_once_and_only_the_latest_maps_are_kept():
    roads = [straight_road() for _ in range(6)]
    built = []
    arrays = PerMap(lambda road: built.append(road) or len(built))
    assert [arrays(roads[0]), arrays(roads[1]), arrays(roads[0])] == [1, 2, 1]
    for road in roads[2:5]:
        arrays(road)
    assert arrays(roads[0]) == 1
    assert arrays(roads[1]) == 6


@given(seeds, st.integers(2, 40))
def test_resampled_polylines_have_equal_steps_along_the_chord(seed, count):
    rng = np.random.default_rng(seed)
    xy = np.array([6e5, 4e6]) + np.cumsum(rng.normal(0.0, 3.0, (count, 2)), axis=0)
    xy[count // 2] = xy[count // 2 - 1]  # a step without length
    arc = np.r_[0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T))]
    line, out = make_polylines([xy]), np.empty((1, POINTS + 1, 2))
    resample(line, line, out)
    wanted = np.linspace(0.0, arc[-1], POINTS + 1)
    expected = np.c_[np.interp(wanted, arc, xy[:, 0]), np.interp(wanted, arc, xy[:, 1])]
    np.testing.assert_allclose(out[0], expected, rtol=0, atol=1e-8)


def test_a_line_without_length_stays_where_it_is():
    line, out = make_polylines([np.full((3, 2), 7.0)]), np.empty((1, POINTS + 1, 2))
    resample(line, line, out)
    np.testing.assert_array_equal(out, 7.0)


def test_lanes_come_first_then_connectors_then_crosswalks():
    road = with_crosswalk(straight_road(speed_limit=None), shapely.box(60, -2, 64, 6))
    found = seen(road, np.array([150.0, 0.0, 0.0]))
    assert found.kind.tolist() == [LANE, LANE, LANE, LANE, CONNECTOR, CONNECTOR, CROSSWALK]
    assert found.objects.tolist() == list(range(7))
    assert not found.has_limit.any()
    assert not found.limit.any()
    assert found.light.tolist() == [LightStatus.UNKNOWN] * 7


def test_points_are_seen_from_the_rear_axle():
    found = seen(straight_road(), np.array([100.0, 0.0, np.pi / 2.0]))
    lane = found.objects.tolist().index(1)  # right lane of the first block: y = 0, x = 0 … 200
    x = np.arange(POINTS) * 10.0
    np.testing.assert_allclose(found.points[lane, 0, :, 1], 100.0 - x, atol=1e-4)
    np.testing.assert_allclose(found.points[lane, 0, :, 0], 0.0, atol=1e-4)
    np.testing.assert_allclose(found.points[lane, 1, :, 0], 1.75, atol=1e-4)  # left is ahead
    np.testing.assert_allclose(found.orientations[lane], -np.pi / 2.0, atol=1e-6)
    np.testing.assert_allclose(found.centers[lane], [0.0, 0.0, -np.pi / 2.0], atol=1e-4)
    assert found.valid[lane].tolist() == [0.0 < value < 200.0 for value in x]
    assert found.limit[lane] == 15.0


def test_only_blocks_on_the_route_are_marked():
    route = np.array([True, False, False])
    found = seen(straight_road(), np.array([210.0, 0.0, 0.0]), route=route)
    assert found.on_route.tolist() == [True, True, False, False, False, False]


def test_a_lane_without_boundaries_gets_its_centre_line_in_their_place():
    road = straight_road()
    empty = road.left_boundaries._replace(ptr=np.zeros_like(road.left_boundaries.ptr))
    bare = replace(road, left_boundaries=empty)
    lines = road_objects(bare).lines
    np.testing.assert_array_equal(lines[:, 1], lines[:, 0])
    assert not np.allclose(lines[:, 2], lines[:, 0])


@given(seeds)
def test_the_same_objects_are_found_as_by_shapely(seed):
    rng = np.random.default_rng(seed)
    areas = [
        shapely.Polygon(rng.uniform(-60, 60, 2) + rng.uniform(-30, 30, (3, 2))) for _ in range(30)
    ]
    road = with_crosswalk(straight_road(), *areas)
    ego = np.r_[rng.uniform(-50, 50, 2), rng.uniform(-3, 3)]
    radius = float(rng.uniform(5, 60))
    square = shapely.box(*(ego[:2] - radius), *(ego[:2] + radius))
    shapes = [road.edges.shape(i) for i in range(len(road.edges))] + areas
    touching = [i for i, shape in enumerate(shapes) if square.intersects(shape)]
    lines = road_objects(road).lines[:, 0, :POINTS] - ego[:2]
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    turned = lines @ np.array([[cos, -sin], [sin, cos]])
    inside = (np.abs(turned) < radius).all(-1).any(-1)
    found = seen(road, ego, radius)
    assert found.objects.tolist() == [i for i in touching if inside[i]]


@given(seeds, st.integers(3, 12))
def test_the_rectangle_around_a_polygon_is_the_smallest_one(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 20, (count, 2)) * [1.0, 4.0]
    corners = oriented_rectangle(points)
    rectangle = shapely.Polygon(corners)
    assert rectangle.exterior.is_ccw
    assert rectangle.buffer(1e-6).contains(shapely.MultiPoint(points))
    smallest = shapely.oriented_envelope(shapely.MultiPoint(points))
    assert rectangle.area == pytest.approx(smallest.area, rel=1e-6)
    # the first side lies along an edge of the hull
    hull = shapely.MultiPoint(points).convex_hull.exterior
    side = shapely.LineString(corners[:2])
    edges = np.diff(np.asarray(hull.coords), axis=0)
    along = np.diff(np.asarray(side.coords), axis=0)[0]
    across = edges[:, 0] * along[1] - edges[:, 1] * along[0]
    assert np.abs(across).min() < 1e-6 * np.hypot(*along)


def test_a_crosswalk_without_area_has_a_rectangle():
    corners = oriented_rectangle(np.array([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0]]))
    assert shapely.Polygon(corners).area < 0.1
    assert np.hypot(*(corners.max(0) - corners.min(0))) == pytest.approx(10.0, abs=0.01)


def test_a_light_belongs_to_its_connector_and_unknown_ids_are_left_out():
    road = straight_road()
    lookup = LightLookup(road)
    status = np.array([[LightStatus.RED, LightStatus.GREEN], [-1, LightStatus.GREEN]], np.int8)
    lights = TrafficLights(("20", "nowhere"), status)
    connector = road.edges.index["20"]
    red = lookup.at(lights.rows(slice(0, 1))).copy()
    assert red[connector] == LightStatus.RED
    assert (np.delete(red, connector) == LightStatus.UNKNOWN).all()
    assert (lookup.at(lights.rows(slice(1, 2))) == LightStatus.UNKNOWN).all()


def test_of_several_lights_at_once_the_last_or_the_highest_ranked_counts():
    road, green, red = straight_road(), LightStatus.GREEN, LightStatus.RED
    listed = (((red, green), green, red), ((green, red), red, red), ((red, -1), red, red))
    listed += (((green, LightStatus.YELLOW), LightStatus.YELLOW, green),)
    plain, ranked = LightLookup(road), LightLookup(road, ranked=(green, red))
    for codes, last, highest in listed:
        lights = TrafficLights(("20", "20"), np.array([codes], np.int8))
        assert plain.at(lights)[road.edges.index["20"]] == last
        assert ranked.at(lights)[road.edges.index["20"]] == highest


@given(seeds, st.integers(0, 60), st.integers(1, 25))
def test_agent_histories_are_as_computed_one_by_one(seed, count, samples):
    rng = np.random.default_rng(seed)
    tracks = random_tracks(rng, count, samples)
    past = history(samples=samples, heading=float(rng.uniform(-3, 3)), tracks=tracks)
    found = agent_features(past, np.array([1.5, 0.5, 0.0]), 32)
    ego = past.ego[-1]
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    turn = np.array([[cos, -sin], [sin, cos]])
    agents = [i for i in range(count) if tracks.kinds[i] <= 2 and tracks.valid[-1, i]]
    agents.sort(key=lambda i: np.hypot(*(tracks.poses[-1, i, :2] - [1.5, 0.5])))
    assert found.tracks.tolist() == agents[:32]
    for row, track in enumerate(agents[:32], start=1):
        assert found.category[row] == tracks.kinds[track] + 1
        for back in range(min(samples, SAMPLES)):
            here = tracks.valid[-1 - back, track]
            at = (row, SAMPLES - 1 - back)
            assert found.valid[at] == here
            position = (tracks.poses[-1 - back, track, :2] - ego[:2]) @ turn * here
            velocity = tracks.velocities[-1 - back, track] @ turn * here
            size = tracks.sizes[-1 - back, track, ::-1] * here
            np.testing.assert_allclose(found.position[at], position, atol=1e-4)
            np.testing.assert_allclose(found.velocity[at], velocity, atol=1e-4)
            np.testing.assert_allclose(found.shape[at], size, atol=1e-6)
    assert not found.valid[:, : max(0, SAMPLES - samples)].any()
    assert found.valid[0].sum() == min(samples, SAMPLES)


def test_a_plan_at_constant_speed_has_no_acceleration():
    plan = straight_on(history(speed=8.0, heading=0.4))
    assert plan.states.shape == (81, 11)
    assert (np.diff(plan.time_us) > 0).all()
    assert plan.time_us[-1] - plan.time_us[0] == pytest.approx(8_000_000, abs=2)
    np.testing.assert_allclose(plan.states[:, VX], 8.0, atol=1e-5)
    np.testing.assert_allclose(plan.states[:, [VY, AX, AY]], 0.0, atol=1e-4)


def test_the_lateral_velocity_of_a_plan_points_to_the_right():
    poses = np.zeros((80, 3))
    poses[:, 1] = 0.1 * np.arange(1, 81)  # to the left at 1 m/s, heading kept
    plan = plan_of_poses(poses, history(speed=0.0))
    np.testing.assert_allclose(plan.states[5:, VY], -1.0, atol=1e-5)


@given(seeds, st.integers(2, 22))
def test_the_motion_of_a_plan_is_that_of_scipys_filter(seed, samples):
    rng = np.random.default_rng(seed)
    past = history(samples=samples)
    time_us = past.time_us + rng.integers(-300, 300, samples)  # recorders jitter
    past = History(time_us, past.ego + rng.normal(0, 0.01, past.ego.shape), past.tracks)
    poses = np.cumsum(rng.normal([0.8, 0.0, 0.0], 0.02, (80, 3)), axis=0)
    plan = plan_of_poses(poses, past)
    seconds = time_us * 1e-6
    planned = seconds[-1] + 0.1 * np.arange(1, 81)
    grid = np.arange(seconds[-1], planned[-1] + 1e-6, seconds[-1] - seconds[-2])[1:]
    knots, values = np.r_[seconds[-1], planned], np.r_[past.ego[-1:, :3], poses]
    # numpy does not extrapolate; one more step of the same slope does the same
    knots, values = np.r_[knots, knots[-1] + 0.1], np.r_[values, [2 * values[-1] - values[-2]]]
    resampled = np.stack([np.interp(grid, knots, column) for column in values.T], axis=1)
    xy = np.r_[past.ego[:, :2], resampled[:, :2]]
    delta = np.diff(np.r_[seconds, grid]).mean()
    cos, sin = np.cos(resampled[:, 2]), np.sin(resampled[:, 2])
    for order, column in ((1, VX), (2, AX)):
        rate = savgol_filter(xy, 5, 2, deriv=order, delta=delta, axis=0)[samples:]
        forward, right = rate[:, 0] * cos + rate[:, 1] * sin, rate[:, 0] * sin - rate[:, 1] * cos
        inner = (planned >= grid[0]) & (planned <= grid[-1])
        for offset, expected in enumerate((forward, right)):
            ours = plan.states[1:, column + offset][inner]
            np.testing.assert_allclose(ours, np.interp(planned[inner], grid, expected), atol=1e-4)


def test_a_plan_can_be_made_with_no_past_at_all():
    plan = plan_of_poses(np.c_[0.8 * np.arange(1, 81), np.zeros((80, 2))], history(samples=1))
    assert np.isfinite(plan.states).all()
    np.testing.assert_allclose(plan.states[:, VX], 8.0, atol=1e-6)


def test_headings_of_plans_are_not_wrapped():
    pose = map_poses(np.array([[1.0, 2.0, 3.0]]), np.array([10.0, 20.0, np.pi / 2.0]))
    np.testing.assert_allclose(pose, [[8.0, 21.0, 3.0 + np.pi / 2.0]])
