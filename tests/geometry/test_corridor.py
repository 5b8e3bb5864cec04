"""Which rings touch a corridor, against the polygon that nuPlan makes of it."""

import numpy as np
import pytest
import shapely
from corridors import bent_band, some_boxes

from shiftsim.geometry.corridor import (
    CLEAR,
    HIT,
    UNDECIDED,
    Corridor,
    corridor_polygon,
    line_distance,
    occupancy,
)
from shiftsim.geometry.polylines import make_path, vertex_headings
from shiftsim.geometry.rings import ring_bounds

HALF_WIDTH = 1.1485  # m, of the ego


@pytest.mark.parametrize("square_ends", [True, False])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (587_430.0, 4_475_309.0)])
def test_distances_decide_as_the_buffered_line_does(rng, offset, square_ends):
    answers = []
    for _ in range(40):
        turns = np.cumsum(rng.normal(0.0, rng.choice([0.0, 0.05, 0.4]), 60))
        steps = rng.uniform(0.2, 2.0, 60)
        line = np.cumsum(np.c_[steps * np.cos(turns), steps * np.sin(turns)], axis=0) + offset
        path = make_path(np.c_[line, vertex_headings(line)])
        begin = int(rng.integers(0, 30))
        corridor = Corridor(path.xy, path.runs, begin, int(rng.integers(begin + 2, 61)), HALF_WIDTH)
        stretch = shapely.LineString(line[corridor.begin : corridor.end])
        polygon = corridor_polygon(stretch, HALF_WIDTH)
        if not square_ends:
            polygon = stretch.buffer(HALF_WIDTH, quad_segs=16, cap_style="flat")
        near = line[rng.integers(0, 60, 80)] + rng.normal(0.0, 3.0, (80, 2))
        rings = [*some_boxes(rng, near[:70]), *(bent_band(rng, start) for start in near[70:])]
        shapes = shapely.polygons([shapely.LinearRing(ring) for ring in rings])
        decided = np.array([occupancy(corridor, ring, square_ends) for ring in rings])
        sure = decided != UNDECIDED
        np.testing.assert_array_equal(decided[sure] == HIT, polygon.intersects(shapes)[sure])
        apart = [line_distance(corridor, ring, ring_bounds(ring), 0.0, np.inf) for ring in rings]
        np.testing.assert_allclose(apart, stretch.distance(shapes), rtol=0, atol=1e-7)
        answers += decided.tolist()
    shares = [answers.count(answer) / len(answers) for answer in (HIT, UNDECIDED, CLEAR)]
    assert shares[0] > 0.1
    assert shares[1] < (0.05 if square_ends else 0.2)


def test_a_corridor_without_length_is_not_decided():
    line = np.c_[np.arange(21.0), np.zeros(21)]
    path, ring = (
        make_path(np.c_[line, np.zeros(21)]),
        np.array([[3.0, 3.0], [4.0, 3.0], [4.0, 4.0]]),
    )
    assert occupancy(Corridor(path.xy, path.runs, 5, 6, HALF_WIDTH), ring, True) == UNDECIDED
    assert occupancy(Corridor(path.xy, path.runs, 5, 7, HALF_WIDTH), ring, True) == CLEAR
