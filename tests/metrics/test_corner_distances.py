"""Corners outside the drivable area: distances against shapely, the tolerance, the verdict."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds

from shiftsim.metrics.drivable_area import DrivableArea, judge, measure
from shiftsim.metrics.result import NUPLAN, Violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.world.layers import Layer, make_layer

TIMES = 1_000_000 + 100_000 * np.arange(3, dtype=np.int64)


def random_areas(rng: np.random.Generator, count: int) -> tuple[Layer, list[shapely.Polygon]]:
    """Small areas with much room between them; some have a hole."""
    shapes = []
    for _ in range(count):
        x, y = rng.uniform(0.0, 80.0, 2)
        width, height = rng.uniform(2.0, 15.0, 2)
        shape = shapely.box(x, y, x + width, y + height)
        hole = shapely.box(x + 0.3, y + 0.3, x + width - 0.3, y + height - 0.3)
        shapes.append(shape.difference(hole) if rng.random() < 0.3 else shape)
    return make_layer([str(index) for index in range(count)], shapes), shapes


@given(seeds)
def test_distances_are_those_of_shapely_to_the_nearest_area_or_edge_of_the_ego(seed: int) -> None:
    rng = np.random.default_rng(seed)
    areas, area_shapes = random_areas(rng, int(rng.integers(1, 12)))
    edges, edge_shapes = random_areas(rng, 5)
    road = SimpleNamespace(drivable_areas=areas, edges=edges)
    start, drift = rng.uniform(-20.0, 100.0, (4, 2)), rng.uniform(-8.0, 8.0, (8, 4, 2))
    footprints = start + np.cumsum(drift, axis=0)
    route = EdgeLists(rng.integers(0, 5, (8, 3)), rng.integers(0, 4, 8))
    inside = np.array(
        [[any(e.contains(shapely.Point(p)) for e in edge_shapes) for p in c] for c in footprints]
    )
    corners = EdgeLists(np.zeros((8, 4, 3), np.int64), inside.astype(np.int64))

    measured = measure(road, footprints, route, corners)

    for sample in range(8):
        mine = [edge_shapes[edge] for edge in route.at(sample)]
        for corner in range(4):
            point = shapely.Point(footprints[sample, corner])
            nearest = min(shape.distance(point) for shape in [*area_shapes, *mine])
            free = not inside[sample, corner] and not any(a.contains(point) for a in area_shapes)
            assert measured.outside[sample, corner] == free
            expected = nearest if free else 0.0
            assert measured.distances[sample, corner] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("count", [1, 2, 40])
def test_corners_on_all_sides_of_a_wide_area_find_it_again(count: int) -> None:
    # a ring of corners around the layer, and back: the grid is asked outside of its bounds
    shapes = [shapely.box(9.0 * n, 5.0 * n, 9.0 * n + 6.0, 5.0 * n + 3.0) for n in range(count)]
    layer = make_layer([str(n) for n in range(count)], shapes)
    road = SimpleNamespace(drivable_areas=layer, edges=make_layer(["0"], shapes[:1]))
    angle = np.linspace(0.0, 4.0 * np.pi, 60)
    wide = 4.5 * count + 12.0 * np.sin(3.0 * angle)
    ring = np.stack([4.5 * count + wide * np.cos(angle), 2.5 * count + wide * np.sin(angle)], -1)
    footprints = np.stack([np.roll(ring, shift, axis=0) for shift in (0, 15, 30, 45)], axis=1)
    footprints = np.ascontiguousarray(footprints)
    none = EdgeLists(np.zeros((60, 2), np.int64), np.zeros(60, np.int64))
    corners = EdgeLists(np.zeros((60, 4, 2), np.int64), np.zeros((60, 4), np.int64))
    measured = measure(road, footprints, none, corners)
    union = shapely.union_all(shapes)
    expected = shapely.distance(union, shapely.points(footprints))
    np.testing.assert_allclose(measured.distances, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("far", "score"), [(0.3, 0.0), (np.nextafter(0.3, 0.0), 1.0)])
def test_a_corner_at_the_tolerance_is_too_far(far: float, score: float) -> None:
    distances = np.zeros((3, 4))
    distances[1, 2], distances[2, 0] = far, 0.1
    compliance, corners = judge(DrivableArea(distances > 0.0, distances), TIMES, NUPLAN)
    assert (compliance.row.score, compliance.row.value) == (score, far)
    assert compliance.row.violation == (
        Violation(1, int(TIMES[1]), None, far) if score == 0.0 else None
    )
    assert compliance.statistics[0].value == score
    assert corners.row.violation == Violation(1, int(TIMES[1]), None, far)
    assert (corners.row.score, corners.row.value, corners.statistics[0].value) == (None, 2.0, 0.0)
    assert corners.series is not None
    assert corners.series.values.tolist() == [1.0, 0.0, 0.0]


def test_distances_of_corners_that_are_not_outside_do_not_count() -> None:
    part, corners = judge(DrivableArea(np.zeros((3, 4), np.bool_), np.ones((3, 4))), TIMES, NUPLAN)
    assert part.row.score == 1.0
    assert corners.statistics[0].value == 1.0
