"""Whom proposals touch, whose fault it is, and whom they come near, against a slow search."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from strategies import seeds

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm.parameters import DEFAULT
from shiftsim.planners.pdm.scorer import Place, score
from shiftsim.planners.proposals.areas import areas_of
from shiftsim.planners.proposals.contacts import Obstacles, first_faults, near_others
from shiftsim.planners.proposals.places import EgoBox, find_places
from shiftsim.world.layers import make_polygons
from shiftsim.world.state import HEADING, NUM_STATE, VX, VY

SIZE, STEPS, ROWS = EgoBox(4.0, 2.0, 1.0), 41, 25
ROAD = np.array([[-40.0, -2.0], [40.0, -2.0], [40.0, 2.0], [-40.0, 2.0]])
CROSSING = np.array([[-8.0, -8.0], [0.0, -8.0], [0.0, 8.0], [-8.0, 8.0]])
PLACE = Place(
    areas_of(make_polygons([[ROAD]]), np.array([True]), np.array([0])),
    np.array([0]),
    make_polygons([[CROSSING]]),
    make_path(np.array([[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0]])),
)


def driven(rng):
    """(2, 41, 11) straight drives that start near the origin, slow or standing at times."""
    states = np.zeros((2, STEPS, NUM_STATE))
    states[:, :, :3] = rng.uniform([-9.0, -3.0, -0.5], [9.0, 3.0, 0.5], (2, 1, 3))
    states[..., VX] = rng.choice([0.0, 0.004, 0.05, 0.06, 2.0, 6.0], (2, STEPS))
    states[..., VY] = rng.choice([0.0, 0.0, 0.5], (2, 1))
    way = 0.1 * np.cumsum(states[..., VX], axis=1)
    states[..., 0] += way * np.cos(states[..., HEADING])
    states[..., 1] += way * np.sin(states[..., HEADING])
    return states


def passing(rng, count=6):
    """Boxes that stand or move straight on, and are within 9 m of the origin at some time."""
    poses = rng.uniform([-9.0, -6.0, -3.0], [9.0, 6.0, 3.0], (count, 3))
    speed = rng.choice([0.0, 0.05, 0.06, 3.0, 60.0], count)
    is_agent = rng.random(count) < 0.7
    speed[~is_agent] = 0.0
    step = 0.2 * speed[:, None] * np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    sizes = rng.uniform(0.5, 5.0, (count, 2))
    rows = np.arange(ROWS)[:, None, None] - rng.integers(0, ROWS, (1, count, 1))
    centers = poses[:, :2] + rows * step
    heading = np.broadcast_to(poses[:, 2:], (ROWS, count, 1))
    return Obstacles(
        boxes_to_corners(np.concatenate([centers, heading], axis=-1), sizes),
        centers,
        centers,
        np.tile(speed, (ROWS, 1)),
        0.5 * np.hypot(*sizes.T),
        is_agent,
        rng.random(count) < 0.1,
    )


def bearing(state, point):
    """How far a point is from straight ahead of the rear axle [rad]."""
    angle = np.arctan2(point[1] - state[1], point[0] - state[0]) - state[HEADING]
    return abs((angle + np.pi) % (2.0 * np.pi) - np.pi)


def is_fault(state, box, off_lane, speed, point, other):
    """nuPlan's rules of who is to blame."""
    if np.hypot(state[VX], state[VY]) <= 0.05:
        return False
    if speed <= 0.05:
        return True
    if bearing(state, point) > np.deg2rad(150.0):
        return False
    front = shapely.LineString(box[[0, 3]])
    return front.intersects(shapely.Polygon(other)) or bool(off_lane)


def slow_faults(places, others, near, rows, first_only):
    scores, first = np.ones(len(places.states)), np.full(len(places.states), np.inf)
    for proposal, index in np.ndindex(len(scores), len(near)):
        other = near[index]
        for step in np.flatnonzero(rows >= 0):
            box, ring = places.corners[proposal, step], others.boxes[rows[step], other]
            if not shapely.Polygon(box).intersects(shapely.Polygon(ring)):
                continue
            state, off_lane = places.states[proposal, step], places.off_lane[proposal, step]
            speed, point = others.speeds[rows[step], other], others.centroids[rows[step], other]
            fault = is_fault(state, box, off_lane, speed, point, ring)
            if fault:
                factor = 0.0 if others.is_agent[other] else 0.5
                scores[proposal] = min(scores[proposal], factor)
                first[proposal] = min(first[proposal], step)
            if fault or first_only:
                break
    return scores, first


def slow_violations(places, others):
    """First steps at which the projected ego touches something ahead, or beside where it counts."""
    first = np.full(len(places.states), np.inf)
    for proposal, other in np.ndindex(len(first), len(others.radii)):
        for step, ahead in np.ndindex(STEPS, 4):
            state, row = places.states[proposal, step], (step + 3 * ahead) // 2
            speed = np.hypot(state[VX], state[VY])
            if others.ignored[other] or speed < 0.005:
                continue
            way = 0.3 * ahead * speed
            shift = way * np.array([np.cos(state[HEADING]), np.sin(state[HEADING])])
            box = shapely.Polygon(places.corners[proposal, step] + shift)
            if not box.intersects(shapely.Polygon(others.boxes[row, other])):
                continue
            angle = bearing(state, others.centroids[row, other])
            beside = places.off_lane[proposal, step]
            beside |= shapely.contains_xy(shapely.Polygon(CROSSING), *state[:2])
            if angle < np.deg2rad(30.0) or (angle <= np.deg2rad(150.0) and beside):
                first[proposal] = min(first[proposal], step)
            break
    return first


@settings(max_examples=8)
@given(seeds)
def test_faults_and_times_to_collision_are_those_of_a_slow_search(seed):
    rng = np.random.default_rng(seed)
    states, others = driven(rng), passing(rng)
    places = find_places(states, SIZE, PLACE.areas, np.array([0]), np.zeros(1), by_center=True)
    near = np.flatnonzero(~others.ignored)
    for rows, first_only in ((np.arange(STEPS) // 2, True), (np.arange(STEPS) // 2, False)):
        rows[rng.random(STEPS) < 0.2] = -1
        found = first_faults(places, others, near, rows, first_only)
        np.testing.assert_array_equal(found, slow_faults(places, others, near, rows, first_only))
    scores = score(states, PLACE, others, SIZE, DEFAULT)
    faults = slow_faults(places, others, near, np.arange(STEPS) // 2, True)
    np.testing.assert_array_equal((scores.no_collision, scores.collision_index), faults)
    np.testing.assert_array_equal(scores.ttc_index, slow_violations(places, others))
    np.testing.assert_array_equal(scores.ttc, np.isinf(scores.ttc_index))
    off_road = places.flags[..., 1].any(axis=1)
    np.testing.assert_array_equal(scores.drivable, ~off_road)


def test_what_comes_into_the_way_at_the_last_moment_counts():
    states = np.zeros((1, STEPS, NUM_STATE))
    states[..., VX], states[..., 0] = 1.0, 0.1 * np.arange(STEPS)
    centers = np.full((ROWS, 1, 2), 900.0)
    centers[-1, 0] = 8.85, 0.0  # at last the front is at 7.0 m, and at 7.9 m 0.9 s later
    boxes = boxes_to_corners(np.dstack([centers, np.zeros((ROWS, 1))]), np.array([2.0, 2.0]))
    no, speeds = np.zeros(1, np.bool_), np.full((ROWS, 1), 1e4)
    others = Obstacles(boxes, centers, centers, speeds, np.sqrt([2.0]), ~no, no)
    scores = score(states, PLACE, others, SIZE, DEFAULT)
    assert (scores.ttc_index.tolist(), scores.collision_index.tolist()) == ([40.0], [np.inf])


@given(seeds)
def test_near_is_what_reaches_into_the_square_around_all_proposals(seed):
    rng = np.random.default_rng(seed)
    states, others = driven(rng), passing(rng)
    places = find_places(states, SIZE, PLACE.areas, np.array([0]), np.zeros(1), by_center=True)
    reach = 0.9 * np.hypot(states[..., VX], states[..., VY])[..., None, None]
    low = (places.corners - reach).min(axis=(0, 1, 2))
    high = (places.corners + reach).max(axis=(0, 1, 2))
    radius = others.radii[:, None]
    for rows in (1, ROWS):
        inside = (others.centers[:rows] >= low - radius) & (others.centers[:rows] <= high + radius)
        expected = inside.all(axis=-1).any(axis=0) & ~others.ignored
        found = near_others(places, others, rows, 0.9)
        assert found.tolist() == np.flatnonzero(expected).tolist()


@pytest.mark.parametrize("off", [0.0, 0.5])
def test_a_box_that_just_touches_at_a_corner_counts(off):
    states = np.zeros((1, 1, NUM_STATE))
    states[..., VX] = 1.0
    places = find_places(states, SIZE, PLACE.areas, np.array([0]), np.zeros(1), by_center=True)
    # the ego reaches from -1 m to 3 m, and 1 m to either side
    ring = boxes_to_corners(np.array([[[4.0 + off, 2.0, 0.0]]]), np.array([2.0, 2.0]))
    one, zeros = np.ones((1, 1)), np.zeros(1, np.bool_)
    middle = np.array([[[4.0 + off, 2.0]]])
    others = Obstacles(ring, middle, middle, one, np.sqrt([2.0]), ~zeros, zeros)
    found = first_faults(places, others, np.array([0]), np.array([0]), True)
    assert [array.tolist() for array in found] == [
        [0.0 if off == 0.0 else 1.0],
        [0.0 if off == 0.0 else np.inf],
    ]
