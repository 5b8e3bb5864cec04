"""Paths against shapely."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from shiftsim.geometry.polylines import make_path, pose_at, project, window


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_projection_is_the_nearest_point_of_the_line(seed):
    rng = np.random.default_rng(seed)
    xy = np.cumsum(rng.normal(0.0, 1.0, (50, 2)), axis=0)
    path = make_path(np.column_stack([xy, np.zeros(50)]))
    line = shapely.LineString(xy)
    for point in rng.uniform(-12, 12, (20, 2)):
        progress, distance, _ = project(path, *point, int(rng.integers(0, 7)))
        assert distance == pytest.approx(line.distance(shapely.Point(point)), abs=1e-9)
        at = line.interpolate(progress)
        assert at.distance(shapely.Point(point)) == pytest.approx(distance, abs=1e-9)


def test_poses_and_windows_are_clamped_to_the_path():
    path = make_path(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 4.0, np.pi / 2.0]]))
    assert path.progress.tolist() == [0.0, 2.0, 6.0]
    assert pose_at(path, -1.0) == (0.0, 0.0, 0.0)
    assert pose_at(path, 4.0) == (2.0, 2.0, np.pi / 4.0)
    assert pose_at(path, 9.0) == (2.0, 4.0, np.pi / 2.0)
    assert window(path, 1.0, 9.0) == (1, 3)
    assert window(path, 2.5, 3.0) == (2, 2)
