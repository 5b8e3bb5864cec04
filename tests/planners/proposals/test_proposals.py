"""Areas and the tracker of proposals, against slow obvious versions."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import straight_road

from shiftsim.planners.proposals.areas import areas_of, index_ranks, make_areas, select_areas
from shiftsim.planners.proposals.places import MULTIPLE, OFF_ROAD, OFF_ROUTE, EgoBox, find_places
from shiftsim.planners.proposals.tracker import fit_speed
from shiftsim.world.layers import make_layer, make_polygons
from shiftsim.world.state import NUM_STATE


def test_areas_and_their_order_are_those_of_the_map():
    road = straight_road()
    selected = select_areas(road, 195.0, 0.0, 10.0)
    ids = [road.edges.ids[i] for i in selected]
    assert ids == ["10", "11", "20", "21"]
    assert np.flatnonzero(make_areas(road, [1, 3]).on_route).tolist() == [1, 3]


def test_a_car_park_is_no_lane_but_may_bear_the_id_of_one():
    road = straight_road()
    names, ring = (*road.car_parks.ids, "77", "11"), np.array([[0.0, 9.0], [5.0, 9.0], [5.0, 14.0]])
    parks = make_layer(names, [shapely.Polygon(ring)] * len(names))
    areas = make_areas(replace(road, car_parks=parks), [0])
    assert areas.lane[-2:].tolist() == [-1, road.edges.index["11"]]
    assert np.flatnonzero(areas.on_route).tolist() == [0]


@pytest.mark.parametrize("place", [(100.0, 0.0), (-100.0, 0.0), (0.0, 100.0), (0.0, -100.0)])
def test_on_one_area_is_not_on_several_even_if_others_are_touched(place):
    """Two halves hold two corners each; what holds the whole ego comes last."""
    shapes = [shapely.box(-9, -9, 0, 9), shapely.box(0, -9, 9, 9), shapely.box(-5, -2, 5, 2)]
    rings = [shapely.get_coordinates(shape)[:-1] + place for shape in shapes]
    areas = areas_of(make_polygons([[r] for r in rings]), np.ones(3, bool), np.arange(3))
    states = np.zeros((1, 3, NUM_STATE))
    states[0, :, :2] = np.array([[0.5, 0.0], [0.5, 1.5], [4.0, 0.0]]) + place
    chosen, size = np.arange(3), EgoBox(4.0, 2.0, 0.0)
    places = find_places(states, size, areas, chosen, np.zeros(3), by_center=True)
    assert places.flags[0, :, MULTIPLE].tolist() == [False, True, False]
    assert not places.flags[..., OFF_ROAD].any()
    assert not places.flags[..., OFF_ROUTE].any()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_an_area_holds_the_points_that_shapely_says(seed):
    rng = np.random.default_rng(seed)
    rings = []
    for count in rng.integers(2, 60, 12).tolist():
        heading = np.cumsum(rng.normal(0.0, 0.1, count)) + rng.uniform(-3.0, 3.0)
        steps = np.column_stack([np.cos(heading), np.sin(heading)]) * rng.uniform(0.1, 9.0)
        middle = np.cumsum(steps, axis=0) + rng.uniform(-20.0, 20.0, 2)
        aside = rng.uniform(0.5, 2.0) * steps[:, ::-1] / np.hypot(*steps[0]) * [-1.0, 1.0]
        rings.append([np.concatenate([middle + aside, (middle - aside)[::-1]])])
    square = np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0], [5.0, 9.0], [5.0, 4.0], [0.0, 9.0]])
    rings += [[square], [square, np.array([[6.0, 1.0], [8.0, 1.0], [8.0, 3.0], [6.0, 3.0]])]]
    shapes = [shapely.Polygon(shell, holes) for shell, *holes in rings]
    rings = [ring for ring, shape in zip(rings, shapes, strict=True) if shape.is_valid]
    shapes = np.array([shape for shape in shapes if shape.is_valid])
    numbers = np.arange(len(rings))
    areas = areas_of(make_polygons(rings), numbers >= 0, numbers)
    corners = np.concatenate([ring for shape in rings for ring in shape])
    points = [corners, corners + np.array([1.0, 0.0]), 0.5 * (corners[:-1] + corners[1:])]
    points = np.concatenate([*points, rng.uniform(-30.0, 30.0, (300, 2))])
    expected = shapely.contains_properly(shapes[:, None], shapely.points(points))
    states = np.zeros((1, len(points), NUM_STATE))
    states[0, :, :2] = points
    size, limits = EgoBox(0.5, 0.3, 0.1), np.zeros(len(rings))
    for area, expected_of_area in enumerate(expected):
        selected = np.array([area])
        places = find_places(states, size, areas, selected, limits, by_center=False)
        np.testing.assert_array_equal(~places.flags[0, :, OFF_ROUTE], expected_of_area)
        within = shapely.contains_properly(shapes[area], shapely.points(places.corners[0]))
        np.testing.assert_array_equal(~places.flags[0, :, OFF_ROAD], within.all(axis=1))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_ranks_are_the_order_in_which_a_spatial_index_yields_boxes(seed):
    rng = np.random.default_rng(seed)
    low = rng.uniform(0, 100, (60, 2))
    bounds = np.hstack([low, low + rng.uniform(1, 30, (60, 2))])
    tree = shapely.STRtree(shapely.box(*bounds.T), node_capacity=10)
    yielded = tree.query(shapely.box(30, 30, 60, 60), predicate="intersects")
    assert (np.diff(index_ranks(bounds)[yielded]) > 0).all()


def test_the_speed_fit_is_the_one_of_the_reference_implementation(rng):
    poses = np.cumsum(rng.uniform(-0.1, 1.0, (41, 3)) * [1.0, 1.0, 0.1], axis=0)
    dt, penalty = 0.1, 1e-4
    # unknowns v_0, a_0 … a_38; rows of R are a_0 … a_36 and the last difference
    unknowns = np.hstack([np.ones((40, 1)), dt * np.tri(40, 39, -1)])
    rows = [dt * np.cos(poses[:-1, 2])[:, None] * unknowns]
    rows += [dt * np.sin(poses[:-1, 2])[:, None] * unknowns]
    matrix = np.vstack(rows)
    right = np.concatenate([np.diff(poses[:, 0]), np.diff(poses[:, 1])])
    regular = np.zeros((38, 40))
    regular[np.arange(37), np.arange(1, 38)] = 1.0
    regular[37, 38], regular[37, 39] = -1.0, 1.0
    solved = np.linalg.solve(matrix.T @ matrix + penalty * regular.T @ regular, matrix.T @ right)
    out = np.empty(40)
    fit_speed(poses, dt, penalty, out)
    np.testing.assert_allclose(out, unknowns @ solved, rtol=0, atol=1e-9)
