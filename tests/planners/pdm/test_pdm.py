"""PDM-Closed on a straight road, and its kernels against slow obvious versions."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import (
    cruise_scenario,
    moved,
    moved_poses,
    standing_tracks,
    straight_road,
    with_velocities,
)

from shiftsim.errors import ConfigError, PlannerError
from shiftsim.geometry.corridor import HIT, UNDECIDED
from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm.corridor import Corridors, corridor_shape, fill_corridor
from shiftsim.planners.pdm.forecast import make_forecast, ring_of, select_tracks
from shiftsim.planners.pdm.parameters import DEFAULT, PdmParameters
from shiftsim.planners.pdm.planner import PdmClosed
from shiftsim.planners.registry import load_planner
from shiftsim.planners.routes.lead import red_lights
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.state import AgentKind, LightStatus, TrafficLights

NUM_ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`
VEHICLE, PEDESTRIAN, CONE = AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE


def one_step(scenario, lights=None, **arguments):
    planner = PdmClosed(**arguments)
    planner.reset(scene_info(scenario))
    seen = observe_log(scenario, 0, ego=scenario.expert[0], samples=1)
    return planner, planner.step(seen if lights is None else replace(seen, lights=lights))


def scenario_with(poses, kinds, **options):
    tracks = standing_tracks(NUM_ROWS, np.array(poses, float).reshape(-1, 3), kinds)
    return cruise_scenario(tracks=tracks, **options)


def test_an_empty_road_is_driven_at_the_limit_on_the_centerline():
    _, step = one_step(cruise_scenario())
    assert (step.best, step.braked) == (4, False)
    np.testing.assert_allclose(step.poses[:, 1:], 0.0, atol=1e-9)
    # nuPlan rule 193: every proposal brakes in its first 0.1 s, then it speeds up
    advance = np.diff(step.poses[:, 0])
    assert advance[0] == pytest.approx(0.8)
    assert advance[1] == pytest.approx(0.1 * (8.0 - 0.3))
    assert (np.diff(advance[1:]) > 0.0).all()


def test_a_standing_vehicle_is_not_reached():
    _, step = one_step(scenario_with([[80.0, 0.0, 0.0]], [VEHICLE], start=(40.0, 0.0, 0.0)))
    assert not step.braked
    assert step.poses[-1, 0] + 4.049 < 80.0 - 2.25


def test_the_emergency_brake_replaces_a_plan_that_hits_at_low_speed():
    scenario = scenario_with([[20.0, 0.0, 0.0]], [VEHICLE], speed=4.9, start=(13.0, 0.0, 0.0))
    _, step = one_step(scenario)
    assert step.braked
    # v = 4.9 m/s: 1.1 (4.9 - 4.05) along the heading
    np.testing.assert_allclose(step.poses[:, 0], 13.0 + 0.935 * 0.1 * np.arange(81), atol=1e-9)


def test_a_red_connector_is_stopped_for_and_a_green_one_is_not():
    scenario = cruise_scenario(start=(170.0, 0.0, 0.0))
    ends = []
    for status in (LightStatus.RED, LightStatus.GREEN):
        lights = TrafficLights(("21",), np.array([[status]], np.int8))
        ends.append(one_step(scenario, lights)[1].poses[-1, 0] + 4.049)
    assert ends[0] < 200.0 < ends[1]


def test_an_object_that_touches_the_ego_is_ignored_from_then_on():
    scenario = scenario_with([[16.0, 0.5, 0.0]], [VEHICLE])
    planner, step = one_step(scenario)
    assert planner.collided == ["0" * 16]
    assert np.isinf(step.scores.collision_index).all()
    again = planner.step(observe_log(scenario, 1, ego=scenario.expert[1], samples=1))
    assert planner.seen.tokens == []
    assert again.best == 4


def test_a_plan_holds_the_poses_of_its_step():
    scenario, planner = cruise_scenario(), PdmClosed()
    planner.reset(scene_info(scenario))
    seen = observe_log(scenario, 0, ego=scenario.expert[0], samples=1)
    plan = planner.plan(seen)
    np.testing.assert_array_equal(plan.time_us, seen.time_us + 100_000 * np.arange(81))
    np.testing.assert_array_equal(plan.states[:, :3], one_step(scenario)[1].poses)
    assert not plan.states[:, 3:].any()


def test_a_negative_share_of_the_limit_looks_as_far_ahead():
    """The ratio of speeds is raised to an even power."""
    scenario = scenario_with([[40.0, 0.0, 0.0]], [VEHICLE])
    plans = [one_step(scenario, speed_fractions=(share,))[1].poses for share in (0.8, -0.8)]
    np.testing.assert_array_equal(*plans)


def test_a_far_object_changes_nothing():
    _, alone = one_step(cruise_scenario())
    _, step = one_step(scenario_with([[-200.0, 0.0, 0.0]], [VEHICLE]))
    np.testing.assert_array_equal(alone.driven.states, step.driven.states)


@settings(max_examples=8)
@given(st.permutations(range(5)), st.integers(0, 2**32 - 1))
def test_the_order_of_pedestrians_and_cones_does_not_matter(order, seed):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(20, 55, 5), rng.uniform(-3, 6, 5), rng.uniform(-3, 3, 5)])
    kinds = [PEDESTRIAN, PEDESTRIAN, CONE, CONE, PEDESTRIAN]
    order = list(order)
    _, step = one_step(scenario_with(poses, kinds))
    _, other = one_step(scenario_with(poses[order], [kinds[i] for i in order]))
    np.testing.assert_array_equal(step.scores.total, other.scores.total)
    np.testing.assert_array_equal(step.poses, other.poses)


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1))
def test_moving_the_whole_world_moves_the_plan(seed):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(30, 60, 3), rng.uniform(-3, 6, 3), rng.uniform(-3, 3, 3)])
    shift = (512.0, -2048.0)
    moved = poses + np.array([*shift, 0.0])
    kinds = [VEHICLE, PEDESTRIAN, CONE]
    _, step = one_step(scenario_with(poses, kinds))
    there = scenario_with(
        moved, kinds, road=straight_road(offset=shift), start=(10.0 + shift[0], shift[1], 0.0)
    )
    _, other = one_step(there)
    np.testing.assert_allclose(other.scores.total, step.scores.total, atol=1e-9)
    np.testing.assert_allclose(other.poses - [*shift, 0.0], step.poses, atol=1e-9)


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.5, -2.2, 3.0]))
def test_turning_the_whole_world_turns_the_plan(seed, angle):
    # random objects are neither exactly ahead, where bearings may be NaN, nor at equal distances
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(30, 60, 3), rng.uniform(-3, 6, 3), rng.uniform(-3, 3, 3)])
    scenario = scenario_with(poses, [VEHICLE, PEDESTRIAN, CONE])
    scenario = with_velocities(scenario, slice(2), rng.uniform(-3.0, 3.0, (2, 2)))
    shift = np.array([512.0, -2048.0])

    _, step = one_step(scenario)
    _, other = one_step(moved(scenario, angle, shift))

    assert (other.best, other.braked) == (step.best, step.braked)
    np.testing.assert_allclose(other.scores.total, step.scores.total, atol=1e-9)
    expected = moved_poses(step.poses, angle, shift)
    np.testing.assert_allclose(other.poses[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.sin(other.poses[:, 2] - expected[:, 2]), 0.0, atol=1e-9)


def test_errors_name_what_to_mend():
    with pytest.raises(PlannerError, match="before reset"):
        PdmClosed().plan(observe_log(cruise_scenario(), 0, ego=np.zeros(11), samples=1))
    scenario = replace(cruise_scenario(), route=("1", "nowhere"))
    with pytest.raises(PlannerError, match="no roadblock 'nowhere'"):
        PdmClosed().reset(scene_info(scenario))
    with pytest.raises(PlannerError, match="is empty"):
        PdmClosed().reset(scene_info(replace(scenario, route=())))
    with pytest.raises(ConfigError, match="not a list of numbers"):
        load_planner("pdm-closed", {"speed_fractions": "fast"})
    with pytest.raises(ConfigError, match="map_radius"):
        PdmParameters(map_radius=0.0)
    for wrong in ((), (0.5, np.nan), (np.inf,)):
        with pytest.raises(ConfigError, match="speed_fractions"):
            PdmParameters(speed_fractions=wrong)


def test_parameters_are_plain_data():
    assert PdmClosed().parameters == PdmParameters() == DEFAULT
    planner = load_planner("pdm-closed", {"speed_fractions": "0.5,1", "lateral_offsets": ""})
    scenario = cruise_scenario()
    planner.reset(scene_info(scenario))
    step = planner.step(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
    assert step.driven.states.shape == (2, 41, 11)
    assert planner.parameters == PdmParameters(speed_fractions=(0.5, 1.0), lateral_offsets=())


def test_the_speed_limit_of_zero_gives_a_plan_without_numbers_that_are_not_finite():
    planner = PdmClosed()
    scenario = cruise_scenario(road=straight_road(speed_limit=0.0))
    planner.reset(scene_info(scenario))
    plan = planner.plan(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
    assert np.isfinite(plan.states).all()


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_tracks_of_a_corridor_are_those_its_polygon_touches(seed):
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0.0, 0.05, 60))
    steps = np.column_stack([np.cos(heading), np.sin(heading)])
    path = make_path(np.column_stack([np.cumsum(steps, axis=0), heading]))
    count = 160  # of fewer than that a tenth may be undecided by chance
    places = path.xy[rng.integers(0, 60, count)] + rng.uniform(-4, 4, (count, 2))
    poses = np.column_stack([places, heading[np.arange(count) % 40]])
    tracks = standing_tracks(1, poses, [VEHICLE] * count)
    tracks.velocities[:, 10:] = rng.normal(0.0, 3.0, (1, count - 10, 2))  # the others stand still
    forecast = make_forecast(tracks, np.arange(count), red_lights([], []))
    unknown = np.zeros((1, 41, count), np.int64), np.zeros((1, 41, count))
    corridors = Corridors(np.array([[10.3, 42.0]]), 1.1485, *unknown)
    for first, last in ((1, 11), (11, 21)):
        fill_corridor(path, corridors, forecast, 0, first, last)
    polygon = corridor_shape(path, 10.3, 42.0, 1.1485)
    for row in range(1, 21):
        touches = [
            polygon.intersects(shapely.Polygon(ring_of(forecast, i, row))) for i in range(count)
        ]
        ours = corridors.occupancy[0, row]
        decided = ours != UNDECIDED
        assert decided.mean() > 0.9
        np.testing.assert_array_equal((ours == HIT)[decided], np.array(touches)[decided])


def test_the_nearest_of_each_kind_are_seen_static_objects_first():
    poses = [[float(x), 0.0, 0.0] for x in range(1, 61)]
    tracks = standing_tracks(1, np.array(poses), [VEHICLE] * 55 + [CONE] * 5)
    chosen = select_tracks(tracks, 0.0, 0.0, {f"{2:016x}"}, replace(DEFAULT, map_radius=58.0))
    assert chosen.tolist() == [55, 56, 57, *(i for i in range(51) if i != 2)]


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_tracks_are_seen_by_group_and_distance_also_where_some_are_equally_far(seed, is_tied):
    rng = np.random.default_rng(seed)
    poses = rng.uniform(-60.0, 60.0, (120, 3))
    if is_tied:
        poses = np.rint(poses / 10.0)
    kinds = rng.integers(0, 7, 120)
    tracks = standing_tracks(1, poses, [AgentKind(kind) for kind in kinds.tolist()])
    tracks.valid[0] = rng.uniform(size=120) < 0.8
    distance = np.hypot(poses[:, 0], poses[:, 1])
    expected = []
    for members, most in ((kinds > 2, 50), (kinds == 0, 50), (kinds == 1, 25), (kinds == 2, 10)):
        here = np.flatnonzero(members & tracks.valid[0] & (distance <= DEFAULT.map_radius))
        here = here[np.argsort(kinds[here], kind="stable")]
        expected += here[np.argsort(distance[here])[:most]].tolist()
    assert select_tracks(tracks, 0.0, 0.0, set(), DEFAULT).tolist() == expected
