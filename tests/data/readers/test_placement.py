"""Whether vehicles lie on a map, and where they would."""

import numpy as np
import pytest
import shapely
from worlds import straight_road

from shiftsim.data.readers.placement import are_drivable, direction_at, place_on_map
from shiftsim.world.build import AreaSpec, build_map

ROAD = straight_road()  # 420 m x 7 m from (0, -1.75) on
PLACES = np.column_stack([np.linspace(1.0, 419.0, 40), np.tile([-1.5, 5.0], 20)])


@pytest.mark.parametrize("shift", [(1000.0, -500.0), (-30.0, 12.0)])
def test_places_are_shifted_back_to_the_road_as_a_whole(shift):
    found = place_on_map(ROAD, PLACES + shift, 0.95)
    assert (found.num_points, found.num_drivable) == (40, 0)
    np.testing.assert_allclose(found.shift, np.negative(shift), rtol=0, atol=1.5)
    assert found.best_share == pytest.approx(1.0)


def test_places_that_are_right_stay():
    found = place_on_map(ROAD, PLACES, 0.95)
    assert (found.num_drivable, found.best_share, found.shift.tolist()) == (40, 1.0, [0.0, 0.0])


def test_lanes_and_other_drivable_areas_are_drivable():
    points = np.array([[5.0, 0.0], [5.0, 30.0], [5.0, 60.0]])
    assert are_drivable(ROAD, points).tolist() == [True, False, False]
    area = AreaSpec("90", shapely.box(0.0, 20.0, 9.0, 40.0))
    road = build_map("yard", edges=[], blocks=[], drivable_areas=[area])
    assert are_drivable(road, points).tolist() == [False, True, False]


@pytest.mark.parametrize("x", [-5.0, 0.0, 100.5, 200.0, 900.0])
def test_lanes_lead_along_the_nearest_segment(x):
    assert direction_at(ROAD.baselines, 0, x, 2.0) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("points", "looked_at"), [(0, 0), (2000, 2000), (4001, 2001), (6000, 2000)]
)
def test_at_most_some_thousand_places_are_looked_at(points, looked_at):
    found = place_on_map(ROAD, np.tile([5.0, 0.0], (points, 1)), 0.95)
    assert (found.num_points, found.num_drivable) == (looked_at, looked_at)
    assert found.best_share == float(points > 0)
    assert found.shift.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("enough", "is_moved"), [(0.5, False), (0.51, True)])
def test_a_better_place_is_looked_for_where_too_few_are_on_the_road(enough, is_moved):
    points = np.column_stack([np.linspace(100.0, 300.0, 40), np.tile([-1.0, -4.0], 20)])
    found = place_on_map(ROAD, points, enough)
    assert (found.num_drivable, bool(found.shift.any())) == (20, is_moved)
    assert found.best_share == (1.0 if is_moved else 0.5)
    assert found.shift.tolist() == [0.0, 2.25 * is_moved]  # the smallest one that does


def test_a_map_without_lanes_has_no_better_place():
    road = build_map("none", edges=[], blocks=[])
    found = place_on_map(road, PLACES, 0.95)
    assert (found.num_drivable, found.best_share, found.shift.tolist()) == (0, 0.0, [0.0, 0.0])
