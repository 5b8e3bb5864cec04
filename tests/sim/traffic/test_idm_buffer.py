"""Buffers of paths have the vertices that GEOS gives them."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from strategies import offsets, seeds

from shiftsim.sim.traffic.idm.buffer import buffer_curve, curve_capacity
from shiftsim.sim.traffic.idm.gaps import ring_gap


def outline(line: np.ndarray, distance: float) -> np.ndarray:
    out = np.zeros((curve_capacity(len(line)), 2))
    return out[: buffer_curve(line, distance, out)]


def crooked_line(seed: int, offset: tuple[float, float]) -> np.ndarray:
    """A path as lanes make them: bends, kinks and very short segments."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 40))
    heading = np.cumsum(rng.normal(0, rng.choice([0.0, 0.005, 0.02, 0.1]), count))
    heading[count // 2 :] += rng.choice([0.0, 0.0, 0.3, -0.8, 1.5])
    step = rng.choice([0.3, 1.0, 3.0]) * rng.uniform(0.3, 1.0, count)
    step[rng.integers(count)] *= rng.choice([1.0, 0.01])
    xy = np.cumsum(np.c_[step * np.cos(heading), step * np.sin(heading)], axis=0)
    return np.ascontiguousarray(xy + offset)


def test_a_straight_line_is_buffered_to_its_rectangle() -> None:
    corners = outline(np.array([[0.0, 0.0], [4.0, 0.0]]), 1.0)

    np.testing.assert_allclose(corners, [[4, 1], [4, -1], [0, -1], [0, 1]])


@pytest.mark.parametrize("direction", [(0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (0.6, 0.8)])
def test_vertices_on_one_place_or_line_change_nothing(direction: tuple[float, float]) -> None:
    ways = np.array([0.0, 2.0, 2.0, 2.0, 3.0, 4.0, 4.0])[:, None] * direction
    corners = shapely.Polygon(outline(ways, 1.0))

    rectangle = shapely.LineString(ways[[0, -1]]).buffer(1.0, cap_style="flat")
    assert corners.symmetric_difference(rectangle).area < 1e-9


@given(seed=seeds, offset=offsets, distance=st.floats(0.3, 1.2))
def test_curve_and_geos_buffer_agree(
    seed: int, offset: tuple[float, float], distance: float
) -> None:
    line = crooked_line(seed, offset)

    curve = outline(line, distance)

    area = shapely.LineString(line).buffer(distance, cap_style="flat")
    ring = shapely.LinearRing(curve)
    assert shapely.distance(ring, shapely.points(shapely.get_coordinates(area))).max() < 1e-8
    assert shapely.distance(area, shapely.points(curve)).max() < 1e-8


@given(seed=seeds, other=seeds, shift=st.floats(-12, 12))
def test_gap_between_outlines_is_the_distance_of_their_areas(
    seed: int, other: int, shift: float
) -> None:
    first, second = crooked_line(seed, (0.0, 0.0)), crooked_line(other, (3.0, shift))
    curves = outline(first, 1.0), outline(second, 1.1)

    gap = ring_gap(curves[0], curves[1], np.inf)

    areas = [
        shapely.LineString(line).buffer(distance, cap_style="flat")
        for line, distance in ((first, 1.0), (second, 1.1))
    ]
    assert gap == pytest.approx(areas[0].distance(areas[1]), abs=1e-8)
    assert (gap == 0.0) == areas[0].intersects(areas[1])


def test_gap_inside_a_larger_ring_is_zero() -> None:
    box = np.array([[5.0, 5.0], [-5.0, 5.0], [-5.0, -5.0], [5.0, -5.0]])

    assert ring_gap(0.1 * box, box, np.inf) == 0.0
    assert ring_gap(box, 0.1 * box, np.inf) == 0.0
    wide, narrow = (outline(np.array([[0.0, 0.0], [9.0, 9.0]]), by) for by in (2.0, 1.0))
    assert ring_gap(wide, 0.5 * narrow + 2.0, np.inf) == 0.0


def test_gap_beyond_the_limit_is_the_limit() -> None:
    box = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])

    far = box + np.array([7.0, 0.0])
    assert ring_gap(box, far, 3.0) == 3.0
    assert ring_gap(box, far, 9.0) == 5.0
