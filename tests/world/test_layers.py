"""Point queries of a map layer against brute force with shapely."""

import numpy as np
import pytest
import shapely
from strategies import OFFSETS

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.world import layers


def random_layer(rng, offset, count=60):
    """Overlapping polygons, some with holes."""
    shapes = []
    for _ in range(count):
        x, y = rng.uniform(0, 80, 2) + offset
        disc = shapely.Point(x, y).buffer(rng.uniform(3, 12), quad_segs=3)
        hole = shapely.Point(x, y).buffer(1.5, quad_segs=2)
        shapes.append(disc.difference(hole) if rng.random() < 0.4 else disc)
    return layers.make_layer([str(i) for i in range(count)], shapes), np.array(shapes)


@pytest.mark.parametrize("offset", OFFSETS)
def test_containing_polygons_are_those_of_shapely_in_order(rng, offset):
    layer, shapes = random_layer(rng, offset)
    for x, y in rng.uniform(-10, 90, (400, 2)) + offset:
        expected = np.flatnonzero(shapely.contains_xy(shapes, x, y))
        np.testing.assert_array_equal(layer.containing(x, y), expected)


@pytest.mark.parametrize("offset", OFFSETS)
def test_the_nearest_polygon_is_that_of_shapely(rng, offset):
    layer, shapes = random_layer(rng, offset, count=12)
    for x, y in rng.uniform(-40, 120, (200, 2)) + offset:
        distances = shapely.distance(shapes, shapely.Point(x, y))
        found, distance = layers.nearest(layer.polygons, x, y, np.inf)
        assert distance == pytest.approx(distances.min(), abs=2e-9)
        assert distances[found] == pytest.approx(distances.min(), abs=2e-9)


def test_nothing_is_nearest_beyond_the_limit(rng):
    layer, _ = random_layer(rng, (0.0, 0.0))
    assert layers.nearest(layer.polygons, 500.0, 0.0, 10.0) == (-1, np.inf)


@pytest.mark.parametrize("offset", OFFSETS)
def test_polygons_in_a_square_are_those_of_shapely(rng, offset):
    layer, shapes = random_layer(rng, offset)
    for x, y in rng.uniform(0, 80, (50, 2)) + offset:
        square = shapely.box(x - 5, y - 5, x + 5, y + 5)
        expected = np.flatnonzero(shapely.intersects(shapes, square))
        np.testing.assert_array_equal(layer.within_box(x, y, 5.0), expected)


def test_an_empty_layer_answers_that_nothing_is_there():
    layer = layers.make_layer([], [])
    assert len(layer.containing(0.0, 0.0)) == 0
    assert layers.nearest(layer.polygons, 0.0, 0.0, np.inf) == (-1, np.inf)


def test_a_point_that_is_not_a_number_is_nowhere(rng):
    layer, _ = random_layer(rng, (0.0, 0.0))
    assert len(layer.containing(np.nan, 3.0)) == 0


def test_rings_and_shapes_survive_the_flat_form(rng):
    layer, shapes = random_layer(rng, OFFSETS[1], count=10)
    for index, shape in enumerate(shapes):
        assert layer.shape(index).equals(shape)


def test_polylines_know_their_arc_lengths():
    lines = layers.make_polylines([np.array([[0, 0], [3, 4], [3, 10.0]]), np.zeros((0, 2))])
    assert lines.length(0) == 11.0
    assert len(lines.at(1)) == 0


@pytest.mark.parametrize("offset", OFFSETS)
def test_polygons_that_meet_a_turned_box_are_those_of_shapely(rng, offset):
    layer, shapes = random_layer(rng, offset)
    for x, y in rng.uniform(0, 80, (50, 2)) + offset:
        pose, size = np.array([x, y, rng.uniform(-4, 4)]), rng.uniform(0.5, 30.0, 2)
        corners = boxes_to_corners(pose, size)
        expected = np.flatnonzero(shapely.intersects(shapes, shapely.Polygon(corners)))
        np.testing.assert_array_equal(layers.meeting(layer.polygons, corners), expected)


def test_touching_a_box_from_outside_counts():
    layer = layers.make_layer(["0", "1"], [shapely.box(0, 0, 2, 2), shapely.box(3, 3, 4, 4)])
    assert layers.meeting(layer.polygons, layers.square_around(3.0, 1.0, 1.0)).tolist() == [0]
    assert layers.meeting(layer.polygons, layers.square_around(2.5, 2.5, 0.5)).tolist() == [0, 1]


def test_a_grid_that_would_fill_the_memory_is_refused():
    square = np.array([[0.0, 0.0], [1e5, 0.0], [1e5, 1e5], [0.0, 1e5]])
    starts = [np.arange(count + 1) for count in (4, 100)]
    few = layers.index_polygons(np.tile(square, (4, 1)), starts[0] * 4, starts[0])
    assert few.shape.tolist() == [1563, 1563]
    with pytest.raises(ValueError, match="too many polygons cover too much"):
        layers.index_polygons(np.tile(square, (100, 1)), starts[1] * 4, starts[1])
