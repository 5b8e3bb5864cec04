"""The lead of the IDM planner: the gap to it, and which one of several that are touched."""

import numpy as np
import pytest
import shapely
from corridors import bent_band, some_boxes

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.corridor import CLEAR, HIT
from shiftsim.geometry.rings import SLACK
from shiftsim.planners.routes.lead import (
    OVERLAPPING,
    Objects,
    bounds_of,
    find_lead,
    keep_one_overlap,
)


def objects_of(rings):
    nothing, ptr = np.zeros(len(rings)), np.cumsum([0, *map(len, rings)])
    xy = np.concatenate(rings)
    return Objects(xy, ptr, bounds_of(xy, ptr), nothing, nothing)


def test_the_gap_to_the_lead_is_the_distance_between_the_polygons(rng):
    footprint = boxes_to_corners(np.array([0.0, 0.0, 0.3]), np.array([5.176, 2.297]))
    rings = [*some_boxes(rng, rng.uniform(-12, 12, (400, 2)))]
    rings += [bent_band(rng, start) for start in rng.uniform(-15, 15, (100, 2))]
    objects = objects_of(rings)
    truth = shapely.distance([*map(shapely.Polygon, rings)], shapely.Polygon(footprint))
    for index in range(500):
        occupancy = np.full(500, CLEAR)
        occupancy[index] = HIT if truth[index] > 0.0 else OVERLAPPING
        found, gap = find_lead(footprint, objects, occupancy)
        assert found == index
        assert gap == pytest.approx(truth[index], abs=1e-12)
    found, gap = find_lead(footprint, objects, np.where(truth > 3.0, HIT, CLEAR))
    assert found == np.flatnonzero(truth > 3.0)[truth[truth > 3.0].argmin()]
    assert gap == pytest.approx(truth[truth > 3.0].min(), abs=1e-12)
    apart = np.flatnonzero(truth > 0.0)
    for few in (rng.choice(apart, size=5, replace=False) for _ in range(500)):
        occupancy = np.full(500, CLEAR)
        occupancy[few] = HIT
        assert find_lead(footprint, objects, occupancy)[0] == few[truth[few].argmin()]


def test_what_crosses_the_footprint_is_no_gap_away():
    footprint = boxes_to_corners(np.zeros(3), np.array([5.176, 2.297]))
    across = boxes_to_corners(np.array([0.0, 0.0, np.pi / 2.0]), np.array([9.0, 1.0]))
    objects = objects_of([across + 20.0, across])
    assert find_lead(footprint, objects, np.array([HIT, OVERLAPPING])) == (1, 0.0)


def test_of_two_objects_that_are_touched_the_lower_one_leads_whatever_their_order():
    footprint = boxes_to_corners(np.zeros(3), np.array([5.176, 2.297]))
    low, high, far = (footprint + shift for shift in ((1.0, -1.0), (-1.0, 1.0), (30.0, -9.0)))
    for rings, lead in (([high, far, low], 2), ([low, far, high], 0)):
        occupancy = np.array([OVERLAPPING, HIT, OVERLAPPING])
        keep_one_overlap(objects_of(rings), occupancy, footprint, {})
        assert occupancy.tolist() == [{1: HIT, lead: OVERLAPPING}.get(i, CLEAR) for i in range(3)]


@pytest.mark.parametrize("turned", [0, 1, 2, 3, 4])
@pytest.mark.parametrize(("tip", "gap"), [((5.0, 0.3), 3.0), ((5.0, 5.0), 5.0)])
def test_a_vertex_that_is_repeated_changes_no_gap(tip, gap, turned):
    footprint = boxes_to_corners(np.zeros(3), np.array([4.0, 2.0]))
    corner = np.array([tip, tip, [14.0, 5.5], [9.0, 14.0], [9.0, 14.0]])
    found = find_lead(footprint, objects_of([np.roll(corner, turned, axis=0)]), np.array([HIT]))
    assert found == (0, pytest.approx(gap, abs=1e-12))


@pytest.mark.parametrize("place", [(0.0, 0.0), (-128.0, -64.0), (-128.0, 64.0), (128.0, -64.0)])
def test_the_least_difference_of_gaps_decides(place):
    footprint = boxes_to_corners(np.array([*place, 0.0]), np.array([4.0, 2.0]))
    rings = [footprint + np.array([7.0 + more, 0.0]) for more in (0.0, -0.5 * SLACK, 0.5 * SLACK)]
    assert find_lead(footprint, objects_of(rings), np.full(3, HIT))[0] == 1
