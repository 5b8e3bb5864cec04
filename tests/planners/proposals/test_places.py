"""Where proposals are, against shapely."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.proposals.areas import areas_of
from shiftsim.planners.proposals.places import EgoBox, find_places
from shiftsim.world.layers import make_polygons
from shiftsim.world.state import NUM_STATE

SIZE = EgoBox(4.0, 2.0, 1.0)


def some_areas(rng, count):
    """Overlapping boxes, some of which hold an ego, one of them with a hole; and a star."""
    poses = rng.uniform([-12.0, -12.0, -3.0], [12.0, 12.0, 3.0], (count, 3))
    rings = [[ring] for ring in boxes_to_corners(poses, rng.uniform(3.0, 16.0, (count, 2)))]
    rings[0].append(poses[0, :2] + 0.1 * (rings[0][0] - poses[0, :2]))
    angles = np.arange(24) * np.pi / 12.0
    star = rng.uniform(2.0, 9.0, (24, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    rings[1] = [poses[1, :2] + star]
    return rings


@given(seeds)
def test_places_are_those_that_shapely_says(seed):
    rng = np.random.default_rng(seed)
    rings, numbers = some_areas(rng, 7), np.arange(7)
    shapes = np.array([shapely.Polygon(shell, holes) for shell, *holes in rings])
    on_route, limits = rng.random(7) < 0.5, rng.permutation(7) * 2.5
    chosen, by_center = rng.permutation(7)[: rng.integers(1, 7)], bool(rng.integers(2))
    states = np.zeros((3, 12, NUM_STATE))
    states[..., :3] = rng.uniform([-9.0, -9.0, -3.0], [9.0, 9.0, 3.0], (3, 12, 3))
    states[0, :, :2] = rings[1][0][::2]  # on a boundary is not within
    areas = areas_of(make_polygons(rings), on_route, numbers)
    places = find_places(states, SIZE, areas, chosen, limits, by_center=by_center)

    middle = states[..., :2] + np.stack([np.cos(states[..., 2]), np.sin(states[..., 2])], axis=-1)
    boxes = np.concatenate([middle, states[..., 2:3]], axis=-1)
    corners = boxes_to_corners(boxes.reshape(-1, 3), np.array([4.0, 2.0])).reshape(3, 12, 4, 2)
    np.testing.assert_allclose(places.centers, middle, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(places.corners, corners, rtol=0.0, atol=1e-12)
    area = shapes[chosen, None, None, None]
    held = shapely.contains_properly(area, shapely.points(corners))
    point = shapely.points(middle if by_center else states[..., :2])
    here = shapely.contains_properly(area[..., 0], point)
    whole, touched = held.all(axis=-1).any(axis=0), held.any(axis=-1).sum(axis=0)
    off_road = ~held.any(axis=0).all(axis=-1)
    np.testing.assert_array_equal(places.flags[..., 0], ~whole & (touched > 1))
    np.testing.assert_array_equal(places.flags[..., 1], off_road)
    np.testing.assert_array_equal(
        places.flags[..., 2], ~(here & on_route[chosen, None, None]).any(axis=0)
    )
    np.testing.assert_array_equal(places.off_lane, off_road | (~whole & (touched > 1)))
    np.testing.assert_array_equal(
        places.speed_limits, (here * limits[chosen, None, None]).max(axis=0)
    )


@pytest.mark.parametrize(("chosen", "limit"), [([1, 3], 9.0), ([3, 1], 9.0), ([1], 5.0), ([], 0.0)])
def test_the_limit_is_the_largest_of_all_areas_that_hold_the_ego(chosen, limit):
    ring = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
    areas = areas_of(make_polygons([[ring]] * 4), np.ones(4, np.bool_), np.arange(4))
    limits, numbers = np.array([0.0, 5.0, 0.0, 9.0]), np.array(chosen, np.int64)
    found = find_places(np.zeros((1, 3, NUM_STATE)), SIZE, areas, numbers, limits, by_center=True)
    assert found.speed_limits.tolist() == [[limit] * 3]
