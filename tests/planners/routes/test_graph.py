"""Parts of a path between two progresses."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.geometry.polylines import make_path, pose_at
from shiftsim.planners.routes.graph import SAME_POINT, lane_path, sub_path

XY = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 3.0], [6.0, 3.0], [6.0, 8.0]])
PROGRESS = np.array([0.0, 2.0, 5.0, 9.0, 14.0])
HEADINGS = np.array([0.0, 0.5, 0.25, 1.0, 1.5])
PATH = make_path(np.column_stack([XY, HEADINGS]), PROGRESS)
VERTICES = np.column_stack([PATH.xy, PATH.heading])


@given(st.floats(0.0, 13.9), st.floats(0.05, 13.9))
def test_the_vertices_between_two_progresses_and_the_poses_at_both(low, length):
    high = min(low + length, 13.99)
    inside = VERTICES[(PROGRESS > low) & (PROGRESS < high)]
    expected = [pose_at(PATH, low), *inside, pose_at(PATH, high)]
    np.testing.assert_allclose(sub_path(PATH, low, high), expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(("at", "rows"), [(0.0, [0, 1]), (14.0, [-2, -1])])
def test_at_the_ends_of_a_path_two_vertices_are_left(at, rows):
    np.testing.assert_array_equal(sub_path(PATH, at, at), VERTICES[rows])


def test_of_vertices_that_are_one_the_second_stays_and_the_last_of_all_is_lost():
    xy = np.array([[0.0, 0.0], [SAME_POINT, 0.0], [1.0, 0.0], [1.0, 0.0], [2.0, 0.0], [4.0, 0.0]])
    road = SimpleNamespace(baselines=SimpleNamespace(at=lambda lane: xy))
    path = lane_path(road, [0])
    assert path.driven.progress.tolist() == [SAME_POINT, 1.0, 2.0]
    assert path.line_arc.tolist() == xy[:, 0].tolist()
