"""The parts of PLUTO that need no network: reference lines, places, collisions, the brake."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from worlds import standing_tracks, straight_road

from shiftsim.planners.learned.pluto.planner import Output, best_proposals, predicted_agents
from shiftsim.planners.learned.pluto.reference import (
    areas_of_map,
    drivable_near,
    line_features,
    reference_lines,
    route_lanes,
)
from shiftsim.planners.learned.pluto.scoring import (
    Place,
    aggregate,
    brake,
    must_brake,
    normalise,
    on_road,
    score,
)
from shiftsim.planners.learned.pluto.world import Agents, make_world, static_objects
from shiftsim.planners.proposals.contacts import is_at_fault
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.state import AX, NUM_STATE, PACIFICA, VX, AgentKind, center_poses

NOBODY = Agents(np.zeros((0, 81, 3)), np.zeros((0, 81)), np.zeros((0, 2)))
NO_LIGHTS = np.zeros(0, np.int64)
FOOTPRINT = np.array([[5.0, 1.0], [0.0, 1.0], [0.0, -1.0], [5.0, -1.0]])


@pytest.fixture(scope="module")
def road():
    return straight_road()


def lanes_of(road, ids=("1", "2", "3")):
    return route_lanes(road, areas_of_map(road), [road.blocks.index[name] for name in ids])


def lines_from(road, x, y=0.0, heading=0.0, ids=("1", "2", "3")):
    rear = np.array([x, y, heading])
    return reference_lines(road, lanes_of(road, ids), rear, center_poses(rear))


def ego_state(x, y=0.0, heading=0.0, speed=8.0):
    state = np.zeros(NUM_STATE)
    state[:3], state[VX] = (x, y, heading), speed
    return state


def straight_proposals(speeds, x, y=0.0):
    """(P, 81, 3) poses along +x."""
    poses = np.zeros((len(speeds), 81, 3))
    poses[:, :, 0] = x + 0.1 * np.arange(81) * np.asarray(speeds)[:, None]
    poses[:, :, 1] = y
    return poses


def scores_of(road, poses, ego, static=None, agents=NOBODY, lights=NO_LIGHTS, ids=("1", "2", "3")):
    route = lanes_of(road, ids)
    center = center_poses(ego[:3])
    drivable = drivable_near(road, route, center[0], center[1])
    found = static_objects(
        static or standing_tracks(1, np.zeros((0, 3)), []), drivable, *center[:2]
    )
    corners = np.array([[2.588, 1.1485], [-2.588, 1.1485], [-2.588, -1.1485], [2.588, -1.1485]])
    world = make_world(found, agents, lights, corners + center[:2])
    line = np.array([[0.0, ego[1]], [420.0, ego[1]]])
    place = Place(drivable, road.edges.polygons, line)
    return score(poses, np.zeros(len(poses)), ego, world, place, PACIFICA)


def test_a_reference_line_starts_beside_the_rear_axle_and_is_120_m_long(road):
    lines = lines_from(road, 150.3, 0.4)
    assert len(lines) == 2  # both lanes are near
    for line in lines:
        np.testing.assert_allclose([line[0, 0], line[-1, 0]], [150.3, 270.3], atol=1e-9)
        assert set(line[:, 1]) == {line[0, 1]}
        assert (np.diff(line[:, 0]) > 0.0).all()


def test_the_last_vertex_of_a_way_is_left_out(road):
    line = lines_from(road, 300.0)[0]
    assert line[-1, 0] == 419.0


def test_there_is_no_line_against_the_traffic_nor_far_away_nor_off_the_route(road):
    assert lines_from(road, 150.0, heading=3.0) == []
    assert lines_from(road, 150.0, y=60.0) == []
    assert lines_from(road, 150.0, ids=("3",)) == []


def test_a_lane_that_follows_another_start_begins_no_line_of_its_own(road):
    assert len(lines_from(road, 198.0)) == 2  # two lanes and the connectors behind them are near


def fork(gap):
    """One lane that forks into two connectors, ending `gap` metres apart."""
    x = np.linspace(0.0, 100.0, 401)
    main = np.c_[x, np.zeros_like(x)]
    further = np.linspace(100.0, 300.0, 801)
    ways = [np.c_[further, sign * gap * (further - 100.0) / 200.0] for sign in (0.5, -0.5)]
    edges = [
        EdgeSpec(
            "a", False, shapely.box(0, -2, 100, 2), main, "A", outgoing=("b", "c"), speed_limit=5.0
        ),
        *(
            EdgeSpec(
                name, True, shapely.box(100, -9, 300, 9), way, "B", incoming=("a",), speed_limit=9.0
            )
            for name, way in zip("bc", ways, strict=True)
        ),
    ]
    blocks = [
        BlockSpec("A", False, shapely.box(0, -2, 100, 2), outgoing=("B",)),
        BlockSpec("B", True, shapely.box(100, -9, 300, 9), incoming=("A",)),
    ]
    parks = [AreaSpec("p", shapely.box(20, 5, 30, 15))]
    return build_map("fork", edges=edges, blocks=blocks, car_parks=parks)


@pytest.mark.parametrize(("gap", "count"), [(8.0, 2), (0.9, 1)])
def test_ways_that_run_together_count_once(gap, count):
    assert len(lines_from(fork(gap), 50.0, ids=("A", "B"))) == count


@pytest.mark.parametrize(("x", "limit"), [(25.0, 5.0), (70.0, 9.0)])
def test_a_car_park_has_the_speed_limit_of_the_last_lane(x, limit):
    forked = fork(8.0)
    near = drivable_near(forked, lanes_of(forked, ("A", "B")), x, 0.0)
    assert near.selected[-1] == len(forked.edges)
    assert near.limits[-1] == limit


@pytest.mark.parametrize(("given_limit", "limit"), [(None, 50.0), (0.0, 50.0), (7.0, 7.0)])
def test_lanes_without_a_speed_limit_count_as_free(given_limit, limit):
    road = straight_road(speed_limit=given_limit)
    assert (drivable_near(road, lanes_of(road), 210.0, 0.0).limits == limit).all()


def test_features_of_a_line_are_every_fourth_point_in_the_ego_frame(road):
    rear = np.array([150.0, 0.0, 0.0])
    line = lines_from(road, 150.0)[0]
    features = line_features([line], rear)
    count = features.valid_mask[0].sum()
    assert count == len(line[::4]) - 1
    expected = line[::4][:count, :2] - rear[:2]
    np.testing.assert_allclose(features.position[0, :count], expected, atol=1e-5)
    np.testing.assert_allclose(
        features.vector[0, : count - 1], np.diff(expected, axis=0), atol=1e-5
    )
    np.testing.assert_allclose(features.position[0, count:], np.tile(-rear[:2], (120 - count, 1)))


def test_static_objects_count_where_they_touch_a_lane(road):
    poses = np.array([[210.0, 0, 0], [210.0, 9.0, 0], [210.0, 6.0, 0], [400.0, 0, 0]])
    tracks = standing_tracks(1, poses, [AgentKind.BARRIER] * 3 + [AgentKind.CZONE_SIGN])
    drivable = drivable_near(road, lanes_of(road), 200.0, 0.0)
    found = static_objects(tracks, drivable, 200.0, 0.0)
    assert found.poses[:, 1].tolist() == [0.0, 6.0]
    assert found.categories.tolist() == [1, 1]


def test_a_proposal_on_its_lane_gets_full_marks(road):
    scores = scores_of(road, straight_proposals([8.0, 4.0], 100.0), ego_state(100.0))
    assert (scores.factors == 1.0).all()
    assert scores.terms[0, 0] == 1.0
    assert 0.0 < scores.terms[0, 1] < 1.0
    assert (scores.speed_limits == 15.0).all()
    assert not scores.flags.any()
    assert np.isinf(scores.fault_times).all()


def test_lanes_beside_each_other_and_the_grass_are_told_apart(road):
    between = scores_of(road, straight_proposals([8.0], 100.0, 1.75), ego_state(100.0, 1.75))
    assert between.flags[0, :, 0].all()
    assert not between.flags[0, :, 1].any()
    beside = scores_of(road, straight_proposals([8.0], 100.0, -1.5), ego_state(100.0, -1.5))
    assert beside.flags[0, :, 1].all()
    # all proposals are off the road from the start, so it does not count
    assert (beside.factors[1] == 1.0).all()


def test_driving_on_lanes_off_the_route_counts_by_distance(road):
    ego = ego_state(100.0, speed=10.0)
    poses = straight_proposals([10.0], 100.0)
    assert scores_of(road, poses, ego, ids=("3",)).factors[2, 0] == 0.0
    slow = ego_state(100.0, speed=2.0)
    assert scores_of(road, straight_proposals([2.0], 100.0), slow, ids=("3",)).factors[2, 0] == 0.5


@pytest.mark.parametrize(
    ("kind", "factor"), [(AgentKind.BARRIER, 0.5), (AgentKind.TRAFFIC_CONE, 0.5)]
)
def test_hitting_a_static_object_halves_the_score(road, kind, factor):
    static = standing_tracks(1, np.array([[120.0, 0.0, 0.0]]), [kind])
    scores = scores_of(road, straight_proposals([8.0, 0.5], 100.0), ego_state(100.0), static)
    assert scores.factors[0, 0] == factor
    assert 1.2 < scores.fault_times[0] < 2.2


def test_what_touches_the_ego_at_the_start_is_ignored(road):
    static = standing_tracks(1, np.array([[105.0, 0.0, 0.0]]), [AgentKind.BARRIER])
    scores = scores_of(road, straight_proposals([8.0], 100.0), ego_state(100.0), static)
    assert (scores.factors[0] == 1.0).all()
    assert (scores.terms[3] == 1.0).all()


def agent_at(x, y, speed):
    poses = np.zeros((1, 81, 3))
    poses[:, :, 0], poses[:, :, 1] = x + 0.1 * speed * np.arange(81), y
    return Agents(poses, np.full((1, 81), abs(speed)), np.array([[4.5, 2.0]]))


def test_an_agent_ahead_is_hit_and_one_behind_hits(road):
    poses, ego = straight_proposals([8.0], 100.0), ego_state(100.0)
    ahead = scores_of(road, poses, ego, agents=agent_at(115.0, 0.0, 1.0))
    behind = scores_of(road, poses, ego, agents=agent_at(90.0, 0.0, 10.5))
    assert ahead.factors[0, 0] == 0.0
    assert ahead.terms[3, 0] == 0.0
    assert behind.factors[0, 0] == 1.0


def test_a_red_connector_is_a_fault_also_when_the_ego_stands_on_it(road):
    light = np.array([road.edge("21")])
    ego = ego_state(210.0, speed=0.0)
    scores = scores_of(road, straight_proposals([0.0], 210.0), ego, lights=light)
    assert scores.factors[0, 0] == 0.0
    assert scores.fault_times[0] == pytest.approx(0.1)


@given(st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_a_standing_ego_is_never_at_fault_and_a_standing_object_never_to_blame(x, y):
    center = np.array([x + 2.5, y])
    box = FOOTPRINT + center - [2.5, 0.0]
    still, driving = ego_state(0.0, speed=0.0), ego_state(0.0, speed=5.0)
    assert not is_at_fault(still, FOOTPRINT, True, 3.0, center, box)
    assert is_at_fault(driving, FOOTPRINT, False, 0.0, center, box)


def test_progress_is_compared_only_if_anybody_makes_some():
    np.testing.assert_allclose(
        normalise(np.array([20.0, 10.0, 0.05]), np.array([1.0, 0.5, 1.0])), [1.0, 0.25, 0.0]
    )
    product = np.array([1.0, 0.5])
    np.testing.assert_array_equal(normalise(np.array([0.05, 0.0]), product), product)


@given(st.integers(0, 2**32 - 1))
def test_rule_scores_stay_between_0_and_1(seed):
    rng = np.random.default_rng(seed)
    terms = rng.random((4, 5))
    terms[2:] = terms[2:] > 0.5
    first, rule = aggregate(rng.choice([0.0, 0.5, 1.0], (3, 5)), terms, rng.random(5) * 30.0)
    assert (first >= 0.0).all()
    assert (first <= 1.0).all()
    assert (rule >= 0.0).all()
    assert (rule <= 1.0).all()


def test_leaving_the_road_counts_unless_everybody_is_off_at_once():
    off = np.zeros((2, 41), np.bool_)
    off[0, 1], off[1, 30] = True, True
    assert on_road(off).tolist() == [0.0, 0.0]
    off[1, 2] = True
    assert on_road(off).tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("speed", "time", "brakes"),
    [
        (5.0, 3.0, True),
        (5.0, 3.1, False),
        (7.9, 3.7, True),
        (8.1, 0.1, False),
        (0.0, np.inf, False),
    ],
)
def test_the_brake_is_for_slow_egos_with_a_fault_ahead(speed, time, brakes):
    assert must_brake(speed, time) == brakes


@pytest.mark.parametrize(("time", "low", "high"), [(0.1, -4.5, -4.4), (2.9, -4.0, -3.0)])
def test_the_brake_ends_in_standstill_and_is_soft_where_there_is_time(time, low, high):
    ego = ego_state(0.0, speed=5.0)
    states = brake(straight_proposals([5.0], 0.0)[0], ego, time, PACIFICA)
    np.testing.assert_array_equal(states[0], ego)
    assert low <= states[:, AX].min() <= high
    assert abs(states[-1, VX]) < 0.3


def test_proposals_are_sorted_by_logit_and_moved_to_the_map():
    rng = np.random.default_rng(0)
    trajectory = rng.standard_normal((2, 12, 80, 6)).astype(np.float32)
    logits = rng.standard_normal((2, 12)).astype(np.float32)
    free = rng.standard_normal((80, 4)).astype(np.float32)
    output = Output(trajectory, logits, np.zeros((0, 80, 6), np.float32), free)
    poses, scores = best_proposals(output, np.array([100.0, 50.0, np.pi / 2.0]))
    best = trajectory.reshape(-1, 80, 6)[logits.argmax()]
    np.testing.assert_allclose(poses[0, 1:, 0], 100.0 - best[:, 1], atol=1e-12)
    np.testing.assert_allclose(poses[0, 1:, 1], 50.0 + best[:, 0], atol=1e-12)
    assert poses.shape == (21, 81, 3)
    assert scores[0] == scores[:-1].max()


def test_agents_move_from_where_they_are():
    motion = np.zeros((1, 80, 6), np.float32)
    motion[..., 0], motion[..., 2], motion[..., 4] = 1.0, 1.0, 3.0
    output = Output(np.zeros(0), np.zeros(0), motion, np.zeros(0))
    rear = np.array([10.0, 0.0, np.pi / 2.0])
    local = np.array([[5.0, 0.0, 0.5]], np.float32)
    present = np.array([[10.0, 5.0, 0.5 + np.pi / 2.0]])
    poses, speeds = predicted_agents(output, local, present, np.array([[0.0, 2.0]]), rear)
    np.testing.assert_array_equal(poses[:, 0], present)
    np.testing.assert_allclose(poses[0, 1], [10.0, 6.0, 0.5 + np.pi / 2.0], atol=1e-6)
    assert speeds[0, :2].tolist() == [2.0, 3.0]
