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
