import numpy as np
import pytest
import shapely

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import (
    CLEAR,
    HIT,
    OPEN,
    corridor_polygon,
    make_path,
    vertex_headings,
)
from shiftsim.planners.routes.corridor import (
    MET,
    UNKNOWN,
    Index,
    Objects,
    find_lead,
    find_sides,
    is_tied,
    make_survey,
    start_survey,
)
from shiftsim.planners.routes.graph import sub_path

HALF_WIDTH = 1.1485  # m, of the ego


def objects_of(rings) -> Objects:
    nothing, ptr = np.zeros(len(rings)), np.cumsum([0, *map(len, rings)])
    return Objects(np.concatenate(rings), ptr, nothing, nothing)


def some_boxes(rng, centers):
    count = len(centers)
    poses = np.c_[centers, rng.uniform(-3, 3, count)]
    return boxes_to_corners(poses, rng.uniform(0.2, 5.0, (count, 2)))


def bent_band(rng, start, count=75):
    """The outline of a connector: two borders of many vertices."""
    turn = np.cumsum(np.full(count, rng.uniform(-0.03, 0.03))) + rng.uniform(-3, 3)
    line = start + np.cumsum(0.4 * np.c_[np.cos(turn), np.sin(turn)], axis=0)
    beside = 1.75 * np.c_[-np.sin(turn), np.cos(turn)]
    return np.concatenate([line + beside, (line - beside)[::-1]])


def sides_of(path, stretch, footprint, objects, survey):
    sides = np.full(len(objects.speeds), UNKNOWN)
    find_sides(path, *stretch, footprint, objects, survey, np.empty((4, 2)), sides)
    return sides


@pytest.mark.parametrize("offset", [(0.0, 0.0), (587_430.0, 4_475_309.0)])
def test_distances_decide_as_the_buffered_path_does_for_every_stretch_of_it(rng, offset):
    num_open = num_hit = count = 0
    for _ in range(40):
        turns = np.cumsum(rng.normal(0.0, rng.choice([0.0, 0.05, 0.8]), 60))
        steps = rng.uniform(0.2, 2.0, 60)
        line = np.cumsum(np.c_[steps * np.cos(turns), steps * np.sin(turns)], axis=0) + offset
        path = make_path(np.c_[line, vertex_headings(line)])
        end = path.progress[-1]
        near = line[rng.integers(0, 60, 80)] + rng.normal(0.0, 3.0, (80, 2))
        rings = [*some_boxes(rng, near[:70]), *(bent_band(rng, start) for start in near[70:])]
        objects, survey = objects_of(rings), make_survey(path, HALF_WIDTH, len(rings))
        low = np.sort(rng.choice([0.0, path.progress[7], *rng.uniform(0, end, 4)], 6))
        start_survey(survey, path, objects, low[0])
        for begin in low:
            stop = min(begin + rng.choice([0.3, 5.0, 30.0, 200.0]), end)
            ahead = sub_path(path, begin, stop)
            footprint = boxes_to_corners(ahead[0], np.array([5.176, 2.297]))
            sides = sides_of(path, (begin, stop), footprint, objects, survey)
            corridor = corridor_polygon(shapely.LineString(ahead[:, :2]), HALF_WIDTH)
            corridor = corridor.union(shapely.Polygon(footprint))
            polygons = [shapely.Polygon(ring) for ring in rings]
            truth = shapely.intersects(polygons, corridor)
            decided = sides != OPEN
            np.testing.assert_array_equal(sides[decided] != CLEAR, truth[decided])
            met = shapely.intersects(polygons, shapely.Polygon(footprint))
            np.testing.assert_array_equal(sides == MET, met)
            num_open, num_hit = num_open + int((~decided).sum()), num_hit + int(truth.sum())
            count += len(rings)
    assert 0 < num_open < 0.05 * count
    assert 0.1 * count < num_hit < 0.9 * count


@pytest.mark.parametrize("stretch", [(20.0, 20.0), (0.0, 0.0), (7.5, 7.5)])
def test_a_stretch_without_length_leaves_all_but_the_footprint_open(stretch):
    line = np.c_[np.arange(21.0), np.zeros(21)]
    path = make_path(np.c_[line, np.zeros(21)])
    footprint = boxes_to_corners(np.array([stretch[0], 0.0, 0.0]), np.array([5.176, 2.297]))
    objects = objects_of([footprint + 0.5, footprint + 200.0])
    survey = make_survey(path, HALF_WIDTH, 2)
    start_survey(survey, path, objects, 0.0)
    # at an end of the path its last, or first, segment is the stretch
    far = OPEN if stretch[0] == 7.5 else CLEAR
    assert sides_of(path, stretch, footprint, objects, survey).tolist() == [MET, far]


def test_the_gap_to_the_lead_is_the_distance_between_the_polygons(rng):
    footprint = boxes_to_corners(np.array([0.0, 0.0, 0.3]), np.array([5.176, 2.297]))
    rings = [*some_boxes(rng, rng.uniform(-12, 12, (400, 2)))]
    rings += [bent_band(rng, start) for start in rng.uniform(-15, 15, (100, 2))]
    objects = objects_of(rings)
    bounds = np.array([[*ring.min(axis=0), *ring.max(axis=0)] for ring in rings])
    truth = shapely.distance([*map(shapely.Polygon, rings)], shapely.Polygon(footprint))
    for index in range(500):
        sides = np.full(500, CLEAR)
        sides[index] = HIT if truth[index] > 0.0 else MET
        found, gap = find_lead(footprint, objects, bounds, sides)
        assert found == index
        assert gap == pytest.approx(truth[index], abs=1e-12)
    found, gap = find_lead(footprint, objects, bounds, np.where(truth > 3.0, HIT, CLEAR))
    assert found == np.flatnonzero(truth > 3.0)[truth[truth > 3.0].argmin()]
    assert gap == pytest.approx(truth[truth > 3.0].min(), abs=1e-12)


def test_of_two_objects_that_are_touched_the_lower_one_leads_whatever_their_order():
    footprint = boxes_to_corners(np.zeros(3), np.array([5.176, 2.297]))
    low, high, far = (footprint + shift for shift in ((1.0, -1.0), (-1.0, 1.0), (30.0, -9.0)))
    for rings, lead in (([high, far, low], 2), ([low, far, high], 0)):
        sides, answers = np.array([MET, HIT, MET]), np.array([1.0, 9.0, 3.0])
        assert is_tied(sides, answers, 0)
        Index(objects_of(rings)).settle(sides, footprint)
        assert sides.tolist() == [{1: HIT, lead: MET}.get(i, CLEAR) for i in range(3)]
        assert not is_tied(sides, answers, lead)


def test_an_index_that_was_asked_before_answers_as_a_new_one(rng):
    centers = np.cumsum(rng.uniform(-0.5, 1.0, (12, 2)), axis=0)
    boxes = [boxes_to_corners(np.r_[xy, 0.1], np.array([5.176, 2.297])) for xy in centers]
    rings = [*some_boxes(rng, rng.uniform(-2, 6, (60, 2)))]
    objects, polygons = objects_of(rings), [shapely.Polygon(ring) for ring in rings]
    index, leads = Index(objects), set()
    for present in (np.full(60, True), rng.random(60) < 0.3, np.full(60, True)):
        for footprint in boxes:
            met = present & shapely.intersects(polygons, shapely.Polygon(footprint))
            assert met.sum() > 1
            asked, anew = (np.where(met, MET, np.where(present, HIT, CLEAR)) for _ in range(2))
            index.settle(asked, footprint)
            Index(objects).settle(anew, footprint)
            np.testing.assert_array_equal(asked, anew)
            np.testing.assert_array_equal(asked == HIT, present & ~met)
            assert met[asked == MET].tolist() == [True]
            leads.add(int(np.flatnonzero(asked == MET)[0]))
    assert len(leads) > 2


def test_objects_of_one_answer_are_no_tie():
    sides = np.array([MET, MET, HIT])
    assert not is_tied(sides, np.array([0.0, 0.0, 1.0]), 0)
    assert is_tied(sides, np.array([0.0, 1.0, 0.0]), 0)
    # a lead without a number for an answer is no tie with itself
    assert not is_tied(np.array([MET, HIT]), np.full(2, np.nan), 0)
