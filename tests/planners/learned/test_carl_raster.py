"""The rasteriser of CaRL against pictures drawn by OpenCV, and what its rules imply."""

from itertools import pairwise

import numpy as np
import places
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.planners.learned.carl.raster import draw_line, fill

GOLDEN = places.GOLDEN / "opencv_shapes.npz"
SIZE = 64
LINE, AREA, BOX = range(3)

near = st.integers(-40, 104)
inside = st.integers(0, SIZE - 1)
rings = st.lists(st.tuples(near, near), min_size=3, max_size=9)


def draw(kind, points):
    picture = np.zeros((SIZE, SIZE), np.uint8)
    xy = np.array(points, np.int64).reshape(-1, 2)
    if kind == LINE:
        for (x0, y0), (x1, y1) in pairwise(xy.tolist()):
            draw_line(picture, x0, y0, x1, y1, 1)
    elif kind == AREA:
        fill(picture, xy, 1, False)
    else:
        fill(picture, xy, 1, True)
    return picture


def stored_shapes():
    with np.load(GOLDEN) as stored:
        pictures = np.unpackbits(stored["bits"], axis=-1)
        rows = zip(stored["kind"].tolist(), stored["ptr"], stored["ptr"][1:], strict=False)
        return [
            (kind, stored["xy"][first:stop].astype(np.int64), picture)
            for (kind, first, stop), picture in zip(rows, pictures, strict=True)
        ]


@pytest.mark.golden
@pytest.mark.parametrize("kind", [LINE, AREA, BOX])
def test_shapes_have_the_pixels_that_opencv_sets(kind):
    cases = [case for case in stored_shapes() if case[0] == kind]
    assert len(cases) == 120
    for number, (_, xy, expected) in enumerate(cases):
        np.testing.assert_array_equal(draw(kind, xy), expected, err_msg=f"shape {number}")


@given(inside, inside, inside, inside)
def test_a_line_is_connected_and_as_long_as_its_longer_side(x0, y0, x1, y1):
    picture = draw(LINE, [(x0, y0), (x1, y1)])
    rows, columns = np.nonzero(picture)
    assert picture[y0, x0] == picture[y1, x1] == 1
    assert len(rows) == max(abs(x1 - x0), abs(y1 - y0)) + 1
    along, across = (columns, rows) if abs(x1 - x0) >= abs(y1 - y0) else (rows, columns)
    order = np.argsort(along)
    assert (np.diff(along[order]) == 1).all()
    assert (np.abs(np.diff(across[order])) <= 1).all()


@given(inside, inside, inside, inside)
def test_a_line_within_the_picture_is_the_same_from_either_end(x0, y0, x1, y1):
    forth, back = draw(LINE, [(x0, y0), (x1, y1)]), draw(LINE, [(x1, y1), (x0, y0)])
    np.testing.assert_array_equal(forth, back)


@given(near, near, near, near)
def test_a_line_that_leaves_the_picture_stays_close_to_the_true_one(x0, y0, x1, y1):
    picture = np.zeros((SIZE, SIZE), np.uint8)
    draw_line(picture, x0, y0, x1, y1, 1)
    rows, columns = np.nonzero(picture)
    length = np.hypot(x1 - x0, y1 - y0)
    if length > 0:
        off = ((columns - x0) * (y1 - y0) - (rows - y0) * (x1 - x0)) / length
        assert (np.abs(off) <= 1.5).all()


@given(rings)
def test_an_area_holds_its_outline_and_its_corners(ring):
    picture = draw(AREA, ring)
    closed = [*ring, ring[0]]
    for start, stop in pairwise(closed):
        # the way round decides how a line is cut at the border
        assert (picture >= draw(LINE, [start, stop])).all()
    for x, y in ring:
        if 0 <= x < SIZE and 0 <= y < SIZE:
            assert picture[y, x] == 1


@given(st.lists(st.tuples(inside, inside), min_size=3, max_size=9))
def test_away_from_its_outline_an_area_is_filled_by_the_even_odd_rule(ring):
    picture = draw(AREA, ring)
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(float)
    odd = np.zeros((SIZE, SIZE), bool)
    distance = np.full((SIZE, SIZE), np.inf)
    for (ax, ay), (bx, by) in zip(ring, [*ring[1:], ring[0]], strict=True):
        if ay != by:
            at = ax + (rows - ay) * (bx - ax) / (by - ay)
            odd ^= ((ay <= rows) != (by <= rows)) & (at > columns)
        square = (bx - ax) ** 2 + (by - ay) ** 2
        along = ((columns - ax) * (bx - ax) + (rows - ay) * (by - ay)) / max(square, 1)
        along = np.clip(along, 0.0, 1.0)
        gap = np.hypot(columns - ax - along * (bx - ax), rows - ay - along * (by - ay))
        distance = np.minimum(distance, gap)
    clear = distance > 1.5
    np.testing.assert_array_equal(picture[clear], odd[clear])


@given(
    st.tuples(st.floats(20, 44), st.floats(20, 44)),
    st.floats(0.3, 27.0),
    st.floats(0.3, 27.0),
    st.floats(-3.2, 3.2),
)
def test_every_row_of_a_box_within_the_picture_is_one_run_of_pixels(center, length, width, heading):
    ahead = 0.5 * length * np.array([np.cos(heading), np.sin(heading)])
    left = 0.5 * width * np.array([-np.sin(heading), np.cos(heading)])
    around = np.array([ahead + left, left - ahead, -ahead - left, ahead - left])
    picture = draw(BOX, np.trunc(around + center))
    for row in picture:
        filled = np.flatnonzero(row)
        assert len(filled) == 0 or filled[-1] - filled[0] + 1 == len(filled)


def test_a_square_of_three_pixels_is_filled_to_its_borders():
    for kind in (AREA, BOX):
        picture = draw(kind, [(2, 3), (4, 3), (4, 5), (2, 5)])
        assert picture.sum() == 9
        assert picture[3:6, 2:5].all()


def test_later_shapes_are_drawn_over_earlier_ones():
    picture = np.zeros((SIZE, SIZE), np.uint8)
    fill(picture, np.array([[1, 1], [9, 1], [9, 9], [1, 9]]), 7, False)
    draw_line(picture, 0, 4, 12, 4, 9)
    assert picture[4, :13].tolist() == [9] * 13
    assert picture[5, 5] == 7
