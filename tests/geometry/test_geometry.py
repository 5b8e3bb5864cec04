"""Our kernels against shapely on many pairs, degenerate ones and UTM coordinates included."""

import numpy as np
import pytest
import shapely
from boxes import boxes_intersect
from hypothesis import given
from strategies import OFFSETS, angles, rigid_motions, seeds

from shiftsim.geometry import boxes, polylines, rings
from shiftsim.kernels import kernel

NUM_PAIRS = 60_000  # twice, at both offsets: more than 1e5 pairs of each kind


def grid_points(rng, count, offset, step=0.5, reach=6.0):
    """Points of which many coincide, lie on common lines or touch."""
    points = rng.uniform(-reach, reach, (count, 2))
    half = count // 2
    points[:half] = np.round(points[:half] / step) * step
    return points + np.array(offset)


def some_boxes(rng, count, offset):
    """Half of the boxes axis-parallel on a grid (touching pairs abound), half arbitrary."""
    centers = grid_points(rng, count, offset)
    headings = rng.uniform(-np.pi, np.pi, count)
    headings[: count // 2] = rng.choice([0.0, np.pi / 2, -np.pi / 2, np.pi], count // 2)
    sizes = rng.choice([0.5, 1.0, 2.0, 4.5, 5.176, 2.297], (count, 2))
    return np.c_[centers, headings], sizes


@pytest.mark.parametrize("offset", OFFSETS)
def test_boxes_intersect_exactly_where_shapely_says_so(rng, offset):
    poses_a, sizes_a = some_boxes(rng, NUM_PAIRS, offset)
    poses_b, sizes_b = some_boxes(rng, NUM_PAIRS, offset)
    ours = boxes_intersect(poses_a, sizes_a, poses_b, sizes_b)
    theirs = shapely.intersects(
        shapely.polygons(boxes.boxes_to_corners(poses_a, sizes_a)),
        shapely.polygons(boxes.boxes_to_corners(poses_b, sizes_b)),
    )
    np.testing.assert_array_equal(ours, theirs)
    assert 0.1 < ours.mean() < 0.9


@kernel
def locate_many(xy, ring_ptr, points):
    out = np.empty(len(points), np.int64)
    for index in range(len(points)):
        out[index] = rings.locate_in_polygon(
            xy, ring_ptr, 0, len(ring_ptr) - 1, points[index, 0], points[index, 1]
        )
    return out


@kernel
def distance_many(xy, ring_ptr, points):
    out = np.empty(len(points))
    for index in range(len(points)):
        out[index] = rings.polygon_distance(
            xy, ring_ptr, 0, len(ring_ptr) - 1, points[index, 0], points[index, 1]
        )
    return out


def polygon_with_hole(offset):
    """A concave shell with a triangular hole: flat rings and the shapely polygon."""
    shell = np.array([[-5, -5], [5, -5], [5, 4], [1, 0.5], [-2, 4], [-5, 4.0]]) + offset
    hole = np.array([[-3, -3], [-1, -3], [-2, -1.5]]) + offset
    ring_ptr = np.array([0, len(shell), len(shell) + len(hole)])
    return np.concatenate([shell, hole]), ring_ptr, shapely.Polygon(shell, [hole])


@pytest.mark.parametrize("offset", OFFSETS)
def test_points_lie_in_a_polygon_exactly_where_shapely_says_so(rng, offset):
    xy, ring_ptr, polygon = polygon_with_hole(offset)
    points = grid_points(rng, NUM_PAIRS, offset)
    quarter = NUM_PAIRS // 4
    edge = rng.integers(0, 5, quarter)
    points[-quarter:] = xy[edge] + rng.uniform(0, 1, (quarter, 1)) * (xy[edge + 1] - xy[edge])
    located = locate_many(xy, ring_ptr, points)
    shapes = shapely.points(points)
    np.testing.assert_array_equal(located == rings.INTERIOR, shapely.contains(polygon, shapes))
    np.testing.assert_array_equal(located != rings.EXTERIOR, shapely.intersects(polygon, shapes))
    assert set(np.unique(located)) == {-1, 0, 1}


@pytest.mark.parametrize("offset", OFFSETS)
def test_distances_to_a_polygon_equal_those_of_shapely(rng, offset):
    xy, ring_ptr, polygon = polygon_with_hole(offset)
    points = grid_points(rng, 20_000, offset, reach=12.0)
    expected = shapely.distance(polygon, shapely.points(points))
    ours = distance_many(xy, ring_ptr, points)
    # coordinates of 4e6 are spaced by 5e-10
    np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-9 if offset[0] else 1e-12)


@kernel
def ring_distances(a, b):
    out = np.empty(len(a))
    for index in range(len(a)):
        out[index] = rings.ring_distance(a[index], b[index])
    return out


@pytest.mark.parametrize("offset", OFFSETS)
def test_distances_between_boxes_equal_those_of_shapely(rng, offset):
    a = boxes.boxes_to_corners(*some_boxes(rng, 20_000, offset))
    b = boxes.boxes_to_corners(*some_boxes(rng, 20_000, offset))
    expected = shapely.distance(shapely.polygons(a), shapely.polygons(b))
    np.testing.assert_allclose(ring_distances(a, b), expected, rtol=0, atol=2e-9)


@kernel
def segments_meet(a, b, c, d):
    out = np.empty(len(a), np.bool_)
    for index in range(len(a)):
        (ax, ay), (bx, by), (cx, cy), (dx, dy) = a[index], b[index], c[index], d[index]
        out[index] = rings.segments_meet(ax, ay, bx, by, cx, cy, dx, dy)
    return out


@pytest.mark.parametrize("offset", OFFSETS)
def test_segments_meet_exactly_where_shapely_says_so(rng, offset):
    a, b, c, d = (grid_points(rng, NUM_PAIRS, offset, step=1.0, reach=3.0) for _ in range(4))
    theirs = shapely.intersects(
        shapely.linestrings(np.stack([a, b], 1)), shapely.linestrings(np.stack([c, d], 1))
    )
    proper = (a != b).any(axis=1) & (c != d).any(axis=1)  # shapely has no line of length 0
    np.testing.assert_array_equal(segments_meet(a, b, c, d)[proper], theirs[proper])


def test_a_segment_of_length_zero_is_a_point(rng):
    a, c, d = (grid_points(rng, 20_000, OFFSETS[0], step=1.0, reach=3.0) for _ in range(3))
    proper = (c != d).any(axis=1)
    theirs = shapely.intersects(shapely.points(a), shapely.linestrings(np.stack([c, d], 1)))
    np.testing.assert_array_equal(segments_meet(a, a, c, d)[proper], theirs[proper])


@kernel
def project_many(xy, arc, points):
    out = np.empty(len(points))
    for index in range(len(points)):
        out[index] = polylines.project_on_polyline(
            xy, arc, 0, len(xy), points[index, 0], points[index, 1]
        )
    return out


@pytest.mark.parametrize("offset", OFFSETS)
def test_projections_on_a_polyline_equal_those_of_shapely(rng, offset):
    angle = np.linspace(0, 4.0, 40)
    xy = np.c_[8 * np.sin(angle), 5 - 8 * np.cos(angle)] + np.array(offset)
    arc = polylines.arc_lengths(xy, np.array([0, len(xy)]))
    points = grid_points(rng, 20_000, offset, reach=15.0)
    line = shapely.LineString(xy)
    ours = project_many(xy, arc, points)
    expected = shapely.line_locate_point(line, shapely.points(points))
    # where two parts of the line are equally near, either arc length is right
    reached = shapely.distance(shapely.line_interpolate_point(line, ours), shapely.points(points))
    np.testing.assert_allclose(reached, shapely.distance(line, shapely.points(points)), atol=2e-9)
    assert np.mean(np.abs(ours - expected) < 2e-9) > 0.999


def test_orientation_is_exact_on_nearly_collinear_points():
    base = 664_430.0
    tiny = 2.0**-33
    assert rings.orientation(base, base, base + 2, base + 2, base + 1, base + 1) == 0
    assert rings.orientation(base, base, base + 2, base + 2, base + 1, base + 1 + tiny) == 1
    assert rings.orientation(base, base, base + 2, base + 2, base + 1, base + 1 - tiny) == -1


def test_corners_run_front_left_rear_left_rear_right_front_right():
    corners = np.empty((4, 2))
    boxes.box_corners(10.0, 20.0, np.pi / 2, 4.0, 2.0, corners)
    np.testing.assert_allclose(corners, [[9, 22], [9, 18], [11, 18], [11, 22]], atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "sizes_shape"), [((), ()), ((0,), (0,)), ((7,), ()), ((3, 4), (3, 4)), ((3, 4), (4,))]
)
def test_corners_of_boxes_in_an_array_of_any_shape_are_those_of_each(rng, shape, sizes_shape):
    poses = rng.uniform([-9.0, -9.0, -4.0], [9.0, 9.0, 4.0], (*shape, 3))
    sizes = rng.uniform(0.2, 5.0, (*sizes_shape, 2))
    found, expected = boxes.boxes_to_corners(poses, sizes), np.empty((*shape, 4, 2))
    assert found.shape == expected.shape
    for place in np.ndindex(shape):
        length, width = np.broadcast_to(sizes, (*shape, 2))[place]
        boxes.box_corners(*poses[place], length, width, expected[place])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@given(angles, rigid_motions())
def test_frames_are_inverse_to_each_other(heading, motion):
    origin = np.array([motion[1], motion[2], motion[0]])
    poses = np.array([[3.0, -4.0, heading], [motion[2], motion[1], 0.5]])
    back = boxes.to_frame(boxes.from_frame(poses, origin), origin)
    np.testing.assert_allclose(back[:, :2], poses[:, :2], atol=1e-9)
    assert np.abs(boxes.wrap_angles(back[:, 2] - poses[:, 2])).max() < 1e-9


@given(seeds)
def test_intersection_of_boxes_is_symmetric(seed):
    rng = np.random.default_rng(seed)
    a, b = some_boxes(rng, 50, OFFSETS[1]), some_boxes(rng, 50, OFFSETS[1])
    forwards = boxes_intersect(*a, *b)
    np.testing.assert_array_equal(forwards, boxes_intersect(*b, *a))


@given(angles)
def test_wrapped_angles_lie_in_the_half_open_range(angle):
    wrapped = boxes.wrap_angle(angle + 6 * np.pi)
    assert -np.pi <= wrapped < np.pi
    assert abs(np.sin(wrapped - angle)) < 1e-12


@kernel
def boundary_distances(xy, points, limit):
    out = np.empty(len(points))
    for index in range(len(points)):
        out[index] = rings.boundary_distance_below(
            xy, 0, len(xy), points[index, 0], points[index, 1], limit
        )
    return out


@pytest.mark.parametrize("limit", [1.0, 4.0, np.inf])
@pytest.mark.parametrize("offset", OFFSETS)
def test_distances_to_a_boundary_are_capped_at_the_limit(rng, offset, limit):
    ring = polygon_with_hole(offset)[0][:6]
    points = grid_points(rng, 20_000, offset, reach=12.0)
    expected = shapely.distance(shapely.LinearRing(ring), shapely.points(points))
    ours = boundary_distances(ring, points, limit)
    np.testing.assert_allclose(ours, np.minimum(expected, limit), rtol=0, atol=1e-9)
