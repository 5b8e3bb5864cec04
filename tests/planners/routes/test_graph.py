"""The cheapest lanes, the lane a pose is on, and parts of the path along lanes."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from strategies import seeds
from worlds import straight_road

from shiftsim.geometry.boxes import boxes_to_corners, wrap_angle
from shiftsim.geometry.polylines import make_path, pose_at, vertex_headings
from shiftsim.planners.routes.graph import (
    SAME_POINT,
    Search,
    centerline,
    deviation,
    lane_at,
    lane_path,
    search_cheapest,
    sub_path,
)
from shiftsim.world.layers import make_layer, make_polylines

XY = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [6.0, 3.0], [6.0, 8.0]])
PROGRESS = np.array([0.0, 2.0, 5.0, 9.0, 14.0])
HEADINGS = np.array([0.0, 0.5, 0.25, 1.0, 1.5])
PATH = make_path(np.column_stack([XY, HEADINGS]), PROGRESS)
VERTICES = np.column_stack([PATH.xy, PATH.heading])


@given(st.floats(0.0, 13.9), st.floats(0.05, 13.9))
def test_the_vertices_between_two_progresses_and_the_poses_at_both(low, length):
    high = min(low + length, 13.99)
    inside = VERTICES[(PROGRESS > low) & (PROGRESS < high)]
    expected = [pose_at(PATH, low), *inside, pose_at(PATH, high)]
    np.testing.assert_allclose(sub_path(PATH, low, high), expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("at", "rows"), [(0.0, [0, 1]), (14.0, [-2, -1])])
def test_at_the_ends_of_a_path_two_vertices_are_left(at, rows):
    np.testing.assert_array_equal(sub_path(PATH, at, at), VERTICES[rows])


def test_of_vertices_that_are_one_the_second_stays_and_the_last_of_all_is_lost():
    xy = np.array([[0.0, 0.0], [SAME_POINT, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 0.0], [4.0, 0.0]])
    road = SimpleNamespace(baselines=SimpleNamespace(at=lambda lane: xy))
    path = lane_path(road, [0])
    assert path.driven.progress.tolist() == [SAME_POINT, 1.0, 2.0]
    assert path.line_arc.tolist() == xy[:, 0].tolist()


@given(seeds)
def test_the_cheapest_path_is_that_of_repeated_relaxation(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 30))
    after = [rng.integers(0, count, rng.integers(1, 6)).tolist() for _ in range(count)]
    length, goals = rng.uniform(1.0, 9.0, count), set(rng.integers(0, 2 * count, 2).tolist())
    paths, costs = {0: [0]}, {0: 1.0}
    for _ in range(count):
        for lane in list(paths):
            for other in after[lane]:
                if costs[lane] + length[other] < costs.get(other, np.inf):
                    costs[other] = costs[lane] + length[other]
                    paths[other] = [*paths[lane], other]
    reached = [lane for lane in paths if lane in goals]
    found = search_cheapest(0, after.__getitem__, length.__getitem__, goals.__contains__)
    deepest = max(map(len, paths.values()))
    ends = reached or [lane for lane in paths if len(paths[lane]) == deepest]
    assert found == Search(paths[min(ends, key=costs.__getitem__)], bool(reached))


@pytest.mark.parametrize(("goals", "path"), [({3}, [0, 1, 3]), ({1, 2}, [0, 1]), ({9}, [0, 1, 3])])
def test_of_equal_costs_the_first_one_counts(goals, path):
    after = [[1, 2, 1], [3], [3], []]
    found = search_cheapest(0, after.__getitem__, lambda lane: 2.0, goals.__contains__)
    assert found == Search(path, goals != {9})


@given(seeds)
def test_deviations_are_those_from_the_nearest_vertex(seed):
    rng = np.random.default_rng(seed)
    lines = [rng.uniform(-9.0, 9.0, (count, 2)) for count in rng.integers(2, 9, 4)]
    (x, y), heading = rng.uniform(-9.0, 9.0, 2), float(rng.uniform(-3.0, 3.0))
    for lane, stride in np.ndindex(4, 3):
        away = np.hypot(*(lines[lane] - [x, y]).T)[:: stride + 1]
        nearest = (stride + 1) * int(away.argmin())
        turn = abs(wrap_angle(vertex_headings(lines[lane])[nearest] - heading))
        found = deviation(make_polylines(lines), lane, stride + 1, x, y, heading)
        assert found == pytest.approx((away.min(), turn), abs=1e-12)


@given(seeds)
def test_the_lane_of_a_pose_holds_it_or_is_the_nearest_to_its_box(seed):
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-20.0, -20.0, -3.0], [20.0, 20.0, 3.0], (8, 3))
    shapes = shapely.polygons(boxes_to_corners(poses, rng.uniform(2.0, 12.0, (8, 2))))
    road = SimpleNamespace(edges=make_layer([*"abcdefgh"], shapes.tolist()))
    lanes = rng.permutation(8)[:6]
    for center in rng.uniform([-40.0, -40.0, -3.0], [40.0, 40.0, 3.0], (6, 3)):
        holding = lanes[shapely.contains_xy(shapes[lanes], *center[:2])]
        box = shapely.Polygon(boxes_to_corners(center, np.array([5.0, 2.0])))
        nearest = lanes[shapely.distance(shapes[lanes], box).argmin()]
        assert lane_at(road, lanes, center, 5.0, 2.0) == [*holding, nearest][0]


def test_the_path_along_lanes_is_that_of_their_baselines():
    road = straight_road()
    lanes = [road.edges.index[name] for name in ("11", "21", "31")]
    poses = centerline(road, lanes)
    np.testing.assert_array_equal(poses[[0, 200, 201, -1], 0], [0.0, 200.0, 200.0, 420.0])
    np.testing.assert_array_equal(poses[:, 1:], 0.0)
    path = lane_path(road, lanes)
    assert [path.project(x, 3.0) for x in (-5.0, 210.5, 999.0)] == [0.0, 210.5, 420.0]
    assert path.end == 419.0
