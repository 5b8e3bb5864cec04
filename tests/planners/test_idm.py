from collections import deque
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import seeds
from worlds import (
    bent_points,
    cruise_scenario,
    mapped,
    standing_tracks,
    straight_road,
    with_velocities,
)

from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import boxes_to_corners, wrap_angles
from shiftsim.planners.idm import Idm
from shiftsim.planners.routes.graph import search_levels
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.layers import make_lists
from shiftsim.world.state import VX, AgentKind, TrafficLights

NUM_ROWS = 60 + 300 + 1 + 160  # of the toy scenario


def started(scenario) -> Idm:
    planner = Idm()
    planner.reset(scene_info(scenario))
    return planner


def roll_out(scenario, ego=None):
    planner = started(scenario)
    state = scenario.expert[0] if ego is None else ego
    return planner.roll_out(observe_log(scenario, 0, ego=state, samples=1))


def with_objects(*poses, kind=AgentKind.VEHICLE, **options):
    tracks = standing_tracks(NUM_ROWS, np.array(poses), [kind] * len(poses))
    return cruise_scenario(tracks=tracks, **options)


def test_a_slow_ego_on_a_free_road_follows_the_formula():
    centers, speeds = roll_out(cruise_scenario(speed=8.0))
    # the ego's centre starts at 11.461; the path ends at 419, one vertex early
    gap = 419.0 - 11.461 - 2.588
    desired = 1.0 + 8.0 * 1.5 + 8.0 * 8.0 / (2.0 * np.sqrt(3.0))
    accel = 1.0 - (8.0 / 15.0) ** 4 - (desired / gap) ** 2
    assert speeds[1] == pytest.approx(8.0 + 0.5 * accel, abs=1e-12)
    np.testing.assert_allclose(centers[:2, 0], [11.461, 15.461], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(centers[:, 1], 0.0)


def test_the_path_keeps_to_the_lane_it_starts_in_and_loses_its_last_vertex():
    scenario = cruise_scenario(start=(10.0, 3.5, 0.0))
    planner = started(scenario)
    planner.plan(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
    assert [scenario.map.edges.ids[e] for e in planner.route_plan.path] == ["10", "20", "30"]
    assert planner.route_plan.found
    assert planner.path.end == 419.0
    assert planner.path.line_arc[-1] == 420.0


def test_a_plan_starts_on_the_path_not_at_the_ego():
    ego = cruise_scenario().expert[0].copy()
    ego[1] = 0.8
    centers, _ = roll_out(cruise_scenario(), ego)
    np.testing.assert_allclose(centers[0], [11.461, 0.0, 0.0], rtol=0, atol=1e-9)


def test_a_standing_vehicle_ahead_stops_the_ego_before_it():
    centers, speeds = roll_out(with_objects((40.0, 0.0, 0.0)))
    assert speeds[-1] < 1.0
    assert centers[-1, 0] + 2.588 < 40.0 - 2.25


@pytest.mark.parametrize(
    "pose",
    [
        (40.0, 3.5, 0.0),  # the other lane
        (51.5, 0.0, 0.0),  # its centre is more than 40 m away
        (5.0, 0.0, 0.0),  # behind
    ],
)
def test_what_is_beside_behind_or_far_away_changes_nothing(pose):
    free, _ = roll_out(cruise_scenario())
    centers, _ = roll_out(with_objects(pose))
    np.testing.assert_array_equal(centers, free)


def test_an_object_that_touches_the_ego_from_behind_brakes_it_fully():
    _, speeds = roll_out(with_objects((8.0, 0.0, 0.0), kind=AgentKind.GENERIC_OBJECT))
    assert speeds[1] == 8.0 - 0.5 * 3.0


@pytest.mark.parametrize("speeds", [(0.0, 5.0), (5.0, 0.0)])
def test_of_two_that_are_touched_the_lower_one_leads(speeds):
    """At 0.5 m/s the ego does not brake for them as hard as it can."""
    scenario = with_objects((12.0, 1.5, 0.0), (12.0, -1.5, 0.0), speed=0.5)
    scenario = with_velocities(scenario, slice(2), np.column_stack([speeds, (0.0, 0.0)]))
    desired = 1.0 + 0.5 * 1.5 + 0.5 * (0.5 - speeds[1]) / (2.0 * np.sqrt(3.0))
    accel = 1.0 - (0.5 / 15.0) ** 4 - desired**2
    assert roll_out(scenario)[1][1] == pytest.approx(max(0.5 + 0.5 * accel, 0.0), abs=1e-12)


def accel_behind(speed, target, gap):
    """Of the model, behind what stands."""
    desired = 1.0 + speed * 1.5 + speed * speed / (2.0 * np.sqrt(3.0))
    return 1.0 - (speed / target) ** 4 - (desired / gap) ** 2


@pytest.mark.parametrize(("rear", "leads"), [(28.5, True), (28.7, False)])
def test_the_corridor_goes_on_by_half_a_width_after_eight_seconds(rear, leads):
    """It ends at 11.461 m + 8 s at 2 m/s + 1.1485 m, and the path at 419 m."""
    scenario = with_objects((rear + 2.25, 0.0, 0.0), speed=2.0, road=straight_road(2.0))
    accel = accel_behind(2.0, 2.0, (rear if leads else 419.0) - 11.461 - 2.588)
    assert roll_out(scenario)[1][1] == pytest.approx(2.0 + 0.5 * accel, abs=1e-9)


@pytest.mark.parametrize(("side", "leads"), [(1.14, True), (1.155, False)])
def test_what_lies_along_the_edge_of_the_corridor_is_decided_by_its_polygon(side, leads):
    """Half a width is 1.1485 m; what lies on the other side is another object."""
    scenario = with_objects((40.0, side + 1.0, 0.0), (40.0, -4.0, 0.0))
    accel = accel_behind(8.0, 15.0, (40.0 - 2.25 if leads else 419.0) - 11.461 - 2.588)
    assert roll_out(scenario)[1][1] == pytest.approx(8.0 + 0.5 * accel, abs=1e-9)


def test_a_fast_ego_sees_what_is_just_ahead_at_the_start_of_its_path():
    scenario = with_objects((6.75, 0.0, 0.0), speed=12.0, start=(-0.961, 0.0, 0.0))
    assert roll_out(scenario)[1][1] == 12.0 - 0.5 * 3.0


@pytest.mark.parametrize(("corner", "leads"), [((420.1, 1.1), True), ((420.2, 1.1), False)])
def test_the_corridor_has_square_corners_at_the_end_of_the_path(corner, leads):
    scenario = with_objects((corner[0] + 2.25, corner[1] + 1.0, 0.0), start=(395.0, 0.0, 0.0))
    accel = accel_behind(8.0, 15.0, (corner[0] if leads else 419.0) - 395.0 - 1.461 - 2.588)
    assert roll_out(scenario)[1][1] == pytest.approx(8.0 + 0.5 * accel, abs=1e-9)


def test_of_the_history_only_the_last_row_counts():
    now, tracks = 60, standing_tracks(NUM_ROWS, np.array([[45.0, 0.0, 0.0]]), [AgentKind.VEHICLE])
    tracks.poses[:now, 0, 0] += 9.0
    tracks.sizes[:now] *= 0.5
    tracks.velocities[:now] += 3.0
    scenario = cruise_scenario(tracks=tracks)
    seen = observe_log(scenario, 0, ego=scenario.expert[0], samples=5)
    np.testing.assert_array_equal(started(scenario).roll_out(seen)[1], roll_out(scenario)[1])


def test_rolling_back_the_ego_meets_what_is_just_behind_it():
    """Its rear left corner is at x = 9.512 m, and at 9.262 m after the first step."""
    scenario = with_objects((9.28 - 2.25, 1.14 + 1.0, 0.0), speed=-0.5, start=(10.639, 0.0, 0.0))
    free = cruise_scenario(speed=-0.5, start=(10.639, 0.0, 0.0))
    assert roll_out(scenario)[1][:3].tolist() == [-0.5, 0.0, 0.0]
    assert roll_out(free)[1][2] == pytest.approx(0.5, abs=1e-4)


def test_a_red_light_counts_as_a_standing_object_and_green_does_not():
    scenario = cruise_scenario(start=(170.0, 0.0, 0.0))
    status = np.full((NUM_ROWS, 2), 2, np.int8)
    red = replace(scenario, traffic_lights=TrafficLights(("21", "unknown"), status))
    green = replace(scenario, traffic_lights=TrafficLights(("21",), 0 * status[:, :1]))
    assert roll_out(red)[1][-1] < 2.0
    status[:, 1] = 0
    both = replace(scenario, traffic_lights=TrafficLights(("21", "21"), status))
    np.testing.assert_array_equal(roll_out(both)[1], roll_out(red)[1])
    np.testing.assert_array_equal(roll_out(green)[1], roll_out(scenario)[1])


def test_the_target_is_the_limit_or_the_default_but_never_below_the_start_speed():
    for limit, speed, target in ((15.0, 8.0, 15.0), (None, 8.0, 10.0), (5.0, 8.0, 8.0)):
        scenario = cruise_scenario(speed=speed, road=straight_road(limit))
        planner = started(scenario)
        planner.plan(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
        assert planner.target_velocity == target


def test_a_reset_forgets_the_path_and_the_target_of_the_scenario_before():
    planner = Idm()
    fast = cruise_scenario(road=straight_road(20.0))
    other = cruise_scenario(road=straight_road(None), start=(10.0, 3.5, 0.0))
    for scenario in (other, fast, other):
        planner.reset(scene_info(scenario))
        assert planner.path is planner.route_plan is None
        seen = observe_log(scenario, 0, ego=scenario.expert[0], samples=1)
        plan, alone = planner.plan(seen), started(scenario).plan(seen)
        np.testing.assert_array_equal(plan.states, alone.states)
        np.testing.assert_array_equal(plan.time_us, seen.time_us + 500_000 * np.arange(17))


def test_a_start_outside_the_route_takes_the_nearest_lane():
    scenario = cruise_scenario(start=(-20.0, -6.0, 0.0))
    planner = started(scenario)
    planner.plan(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
    assert scenario.map.edges.ids[planner.route_plan.path[0]] == "11"


@pytest.mark.parametrize("route", [("1", "2", "2", "3"), ("1", "3"), ("1", "2", "3", "1")])
def test_a_route_that_cannot_be_driven_block_by_block_falls_back(route):
    scenario = replace(cruise_scenario(), route=route)
    planner = started(scenario)
    planner.plan(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
    assert not planner.route_plan.found


@pytest.mark.parametrize(
    ("route", "message"),
    [
        ((), "has 0 roadblocks"),
        (("1",), "has 1 roadblocks"),
        (("x", "2", "3"), "no roadblock 'x', number 0"),
        (("1", "x", "3"), "no roadblock 'x', number 1"),
        (("1", "2", "x"), "no roadblock 'x', number 2"),
    ],
)
def test_a_route_nuplan_would_fail_on_is_refused(route, message):
    with pytest.raises(PlannerError, match=message):
        started(replace(cruise_scenario(), route=route))


def test_an_unknown_block_in_the_middle_of_a_route_is_passed_over():
    scenario = replace(cruise_scenario(), route=("1", "2", "x", "3"))
    planner = started(scenario)
    planner.plan(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))
    assert not planner.route_plan.found  # the depth does not fit any more


@given(x=st.floats(-1e5, 1e5), y=st.floats(-5e6, 5e6), speed=st.floats(0.0, 20.0))
def test_moving_the_world_does_not_change_the_speeds(x, y, speed):
    near = with_objects((45.0, 0.4, 0.1), speed=speed)
    far = with_objects(
        (45.0 + x, 0.4 + y, 0.1),
        speed=speed,
        road=straight_road(offset=(x, y)),
        start=(10.0 + x, y, 0.0),
    )
    # gaps are differences of coordinates of up to 5e6 m, spaced by 1e-9 m
    np.testing.assert_allclose(roll_out(far)[1], roll_out(near)[1], rtol=0, atol=1e-6)


def naive_search(road, start, goal_block, goal_depth, allowed):
    """The queue without a visited set, as nuPlan has it."""
    queue, parents, end, depth = deque([(start, 1)]), {}, (start, 1), 1
    found = False
    while queue:
        edge, depth = queue.popleft()
        if depth > goal_depth:
            break
        if road.block_of[edge] == goal_block and depth == goal_depth:
            end, found = (edge, depth), True
            break
        for after in road.outgoing.at(edge).tolist():
            if after in allowed:
                queue.append((after, depth + 1))
                parents[after, depth + 1] = (edge, depth)
                end = (after, depth + 1)
    path = [end[0]]
    while end in parents:
        end = parents[end]
        path.append(end[0])
    return path[::-1], found


@st.composite
def graphs(draw):
    count = draw(st.integers(2, 8))
    ids = st.integers(0, count - 1)
    rows = draw(st.lists(st.lists(ids, max_size=3), min_size=count, max_size=count))
    blocks = draw(st.lists(st.integers(0, 3), min_size=count, max_size=count))
    road = SimpleNamespace(outgoing=make_lists(rows), block_of=np.array(blocks))
    return road, draw(ids), draw(st.integers(0, 3)), draw(st.integers(1, 6)), draw(st.sets(ids))


@given(graphs())
def test_the_search_by_levels_equals_the_queue_without_a_visited_set(case):
    path, found = naive_search(*case)
    road, start, goal_block, goal_depth, allowed = case
    goals = set(np.flatnonzero(road.block_of == goal_block).tolist())
    plan = search_levels(
        lambda lane: [after for after in road.outgoing.at(lane).tolist() if after in allowed],
        start,
        goals,
        goal_depth,
        only_last=True,
    )
    assert plan == (path, found)


def test_speed_backwards_and_standing_still_give_finite_plans():
    for speed in (-0.5, 0.0):
        ego = cruise_scenario().expert[0].copy()
        ego[VX] = speed
        centers, speeds = roll_out(cruise_scenario(), ego)
        assert np.isfinite(centers).all()
        assert speeds[-1] > 0.0


BENT = mapped(straight_road(12.0), bent_points)  # headings pass through half a turn


def slow_roll_out(path, ego, objects, speeds, headings):
    """Box centres and speeds with shapely's corridors; None where several objects are touched."""
    line = np.column_stack([path.driven.xy, np.unwrap(path.driven.heading)])
    arc, end = path.driven.progress, path.driven.progress[-1]
    progress, speed, rows = path.project(*ego.center[:2]), float(ego.values[VX]), []
    for step in range(17):  # at first the ego is where it is, then on the path
        at = np.clip(progress, 0.0, end)
        x, y, heading = (np.interp(at, arc, column) for column in line.T)
        rows.append((x, y, wrap_angles(np.array([heading]))[0], speed))
        place = np.array([x, y, heading]) if step else ego.center
        box = shapely.Polygon(boxes_to_corners(place, np.array([5.176, 2.297])))
        far = min(at + 8.0 * 12.0, end)
        inner = line[(arc > at) & (arc < far), :2]
        ends = [[np.interp(s, arc, line[:, axis]) for axis in (0, 1)] for s in (at, far)]
        ahead = shapely.LineString([ends[0], *inner, ends[1]])
        corridor = ahead.buffer(0.5 * 2.297, cap_style="square").union(box)
        met = np.flatnonzero(shapely.intersects(corridor, objects))
        gap, lead_speed, away = end - progress - 2.588, 0.0, shapely.distance(objects, box)
        if (away == 0.0).sum() > 1:
            return None
        if len(met):
            lead = met[away[met].argmin()]
            gap, lead_speed = away[lead], speeds[lead] * np.cos(headings[lead] - place[2])
        closing = speed * (speed - lead_speed) / (2.0 * np.sqrt(3.0))
        wanted = 1.0 + 1.5 * speed + closing
        accel = 1.0 - (speed / 12.0) ** 4 - (wanted / max(gap, 1.0)) ** 2
        progress += 0.5 * speed
        speed = max(0.0, speed + 0.5 * np.clip(accel, -3.0, 1.0))
    return np.array(rows)


@settings(max_examples=15)
@given(seeds)
def test_plans_in_a_bend_are_those_of_a_slow_version(seed):
    rng = np.random.default_rng(seed)
    count, x0 = 5, float(rng.uniform(120.0, 280.0))
    along = x0 + rng.uniform(-6.0, 45.0, count)
    places = bent_points(np.column_stack([along, rng.uniform(-2.5, 2.5, count)]))
    tracks = standing_tracks(NUM_ROWS, np.c_[places, rng.uniform(-3, 3, count)], [AgentKind(0)] * 5)
    tracks.kinds[:] = rng.choice([0, 0, 1, 2, 4], count)
    tracks.velocities[:] = rng.uniform(-4.0, 4.0, (count, 2))
    tracks.sizes[:] = rng.uniform(0.5, 5.0, (count, 2))
    x, y = bent_points(np.array([x0, 0.3]))
    scenario = cruise_scenario(speed=float(rng.uniform(0.0, 12.0)), road=BENT, tracks=tracks)
    ego = scenario.expert[0].copy()
    ego[:3] = x, y, 2.0 + x0 / 150.0 + 0.1

    planner = started(scenario)
    seen = observe_log(scenario, 0, ego=ego, samples=1)
    centers, speeds = planner.roll_out(seen)

    poses, now = tracks.poses[60], seen.ego
    near = np.hypot(*(poses[:, :2] - now.center[:2]).T) < 40.0
    rings = shapely.polygons(boxes_to_corners(poses, tracks.sizes[60]))[near]
    fast = np.where(tracks.kinds > 2, 0.0, np.hypot(*tracks.velocities[60].T))[near]
    expected = slow_roll_out(planner.path, now, rings, fast, poses[near, 2])
    assume(expected is not None)
    np.testing.assert_allclose(centers[:, :2], expected[:, :2], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(centers[:, 2], expected[:, 2], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(speeds, expected[:, 3], rtol=0.0, atol=1e-6)
