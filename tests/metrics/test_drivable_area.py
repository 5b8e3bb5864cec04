"""Corners outside the drivable area: the verdict, and distances against shapely.

Small random areas first, then boxes about the borders of whole maps.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.synthetic.recordings import generate_town
from shiftsim.data.synthetic.store import DEMO_TOWNS
from shiftsim.errors import MapError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.metrics.drivable_area import DrivableArea, evaluate, measure
from shiftsim.metrics.result import NUPLAN, PROFILES, Violation
from shiftsim.metrics.route import EdgeLists, corner_routes, empty_lists
from shiftsim.world.layers import Layer, make_layer
from shiftsim.world.map import VectorMap

FAR = 1e7  # m, where no map is
TIMES = 1_000_000 + 100_000 * np.arange(3, dtype=np.int64)


def random_areas(rng: np.random.Generator, count: int) -> tuple[Layer, list[shapely.Polygon]]:
    """Small areas with much room between them; some have a hole."""
    shapes = []
    for _ in range(count):
        x, y = rng.uniform(0.0, 80.0, 2)
        width, height = rng.uniform(2.0, 15.0, 2)
        shape = shapely.box(x, y, x + width, y + height)
        hole = shapely.box(x + 0.3, y + 0.3, x + width - 0.3, y + height - 0.3)
        shapes.append(shape.difference(hole) if rng.random() < 0.3 else shape)
    return make_layer([str(index) for index in range(count)], shapes), shapes


@given(seeds)
def test_distances_are_those_of_shapely_to_the_nearest_area_or_edge_of_the_ego(seed: int) -> None:
    rng = np.random.default_rng(seed)
    areas, area_shapes = random_areas(rng, int(rng.integers(1, 12)))
    edges, edge_shapes = random_areas(rng, 5)
    road = SimpleNamespace(drivable_areas=areas, edges=edges)
    start, drift = rng.uniform(-20.0, 100.0, (4, 2)), rng.uniform(-8.0, 8.0, (8, 4, 2))
    footprints = start + np.cumsum(drift, axis=0)
    route = EdgeLists(rng.integers(0, 5, (8, 3)), rng.integers(0, 4, 8))
    inside = np.array(
        [[any(e.contains(shapely.Point(p)) for e in edge_shapes) for p in c] for c in footprints]
    )
    corners = EdgeLists(np.zeros((8, 4, 3), np.int64), inside.astype(np.int64))

    measured = measure(road, footprints, route, corners)

    for sample in range(8):
        mine = [edge_shapes[edge] for edge in route.at(sample)]
        for corner in range(4):
            point = shapely.Point(footprints[sample, corner])
            nearest = min(shape.distance(point) for shape in [*area_shapes, *mine])
            free = not inside[sample, corner] and not any(a.contains(point) for a in area_shapes)
            assert measured.outside[sample, corner] == free
            expected = nearest if free else 0.0
            assert measured.distances[sample, corner] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("count", [1, 2, 40])
def test_corners_on_all_sides_of_a_wide_area_find_it_again(count: int) -> None:
    # a ring of corners around the layer, and back: the grid is asked outside of its bounds
    shapes = [shapely.box(9.0 * n, 5.0 * n, 9.0 * n + 6.0, 5.0 * n + 3.0) for n in range(count)]
    layer = make_layer([str(n) for n in range(count)], shapes)
    road = SimpleNamespace(drivable_areas=layer, edges=make_layer(["0"], shapes[:1]))
    angle = np.linspace(0.0, 4.0 * np.pi, 60)
    wide = 4.5 * count + 12.0 * np.sin(3.0 * angle)
    ring = np.stack([4.5 * count + wide * np.cos(angle), 2.5 * count + wide * np.sin(angle)], -1)
    footprints = np.stack([np.roll(ring, shift, axis=0) for shift in (0, 15, 30, 45)], axis=1)
    footprints = np.ascontiguousarray(footprints)
    none = EdgeLists(np.zeros((60, 2), np.int64), np.zeros(60, np.int64))
    corners = EdgeLists(np.zeros((60, 4, 2), np.int64), np.zeros((60, 4), np.int64))
    measured = measure(road, footprints, none, corners)
    union = shapely.union_all(shapes)
    expected = shapely.distance(union, shapely.points(footprints))
    np.testing.assert_allclose(measured.distances, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("far", "score"), [(0.3, 0.0), (np.nextafter(0.3, 0.0), 1.0)])
def test_a_corner_at_the_tolerance_is_too_far(far: float, score: float) -> None:
    distances = np.zeros((3, 4))
    distances[1, 2], distances[2, 0] = far, 0.1
    compliance, corners = evaluate(DrivableArea(distances > 0.0, distances), TIMES, NUPLAN)
    assert (compliance.row.score, compliance.row.value) == (score, far)
    assert compliance.row.violation == (
        Violation(1, int(TIMES[1]), None, far) if score == 0.0 else None
    )
    assert compliance.statistics[0].value == score
    assert corners.row.violation == Violation(1, int(TIMES[1]), None, far)
    assert (corners.row.score, corners.row.value, corners.statistics[0].value) == (None, 2.0, 0.0)
    assert corners.series is not None
    assert corners.series.values.tolist() == [1.0, 0.0, 0.0]


def test_distances_of_corners_that_are_not_outside_do_not_count() -> None:
    part, corners = evaluate(
        DrivableArea(np.zeros((3, 4), np.bool_), np.ones((3, 4))), TIMES, NUPLAN
    )
    assert part.row.score == 1.0
    assert corners.statistics[0].value == 1.0


def rings_of(road: VectorMap) -> list[np.ndarray]:
    """Rings (V, 2) of lanes, connectors and drivable areas; as many holes as shells, if any."""
    layers = (road.edges, road.drivable_areas)
    all_rings = [layer.rings(index) for layer in layers for index in range(len(layer))]
    shells, holes = [rings[0] for rings in all_rings], [h for rings in all_rings for h in rings[1:]]
    return shells + holes * (len(shells) // max(len(holes), 1))


def boxes_near(road: VectorMap, count: int, rng: np.random.Generator) -> np.ndarray:
    """Corners (count, 4, 2) of boxes about the borders of a map; four in five touch one.

    A corner lies in a vertex, in an edge as far as numbers allow, or the least bit beside it; or a
    side of the box is an edge of the map.
    """
    rings = rings_of(road)
    poses = np.zeros((count, 3))
    poses[:, 2] = rng.choice([0.0, 0.5 * np.pi, 1.0], count) * rng.uniform(-np.pi, np.pi, count)
    sizes = rng.uniform([0.5, 0.4], [18.0, 3.0], (count, 2))
    corners = boxes_to_corners(poses, sizes)
    for index, box in enumerate(corners):
        ring = rings[rng.integers(len(rings))]
        at = rng.integers(len(ring))
        start, end = ring[at - 1], ring[at]
        how, corner = index % 5, rng.integers(4)
        if how == 0:
            box += end + rng.normal(0.0, 4.0, 2)
            continue
        point = end if how == 1 else start + rng.uniform() * (end - start)
        if how == 2:
            point = np.nextafter(point, point + rng.integers(-1, 2, 2))
        box += point - box[corner]
        box[corner] = point
        if how == 4:
            across = np.array([start[1] - end[1], end[0] - start[0]]) * rng.choice([-1.0, 1.0])
            box[:] = start, end, end + across, start + across
    return corners


def holding(layer: Layer, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of points (P, 2) and polygons that hold them in their interior, in this order."""
    tree = shapely.STRtree([layer.shape(index) for index in range(len(layer))])
    pairs = tree.query(shapely.points(points), predicate="within")
    return tuple(pairs[:, np.lexsort(pairs[::-1])])


def edges_at(road: VectorMap, points: np.ndarray) -> list[list[int]]:
    """The lanes that hold each point (P, 2), the connectors where no lane does."""
    out = [[] for _ in points]
    for point, edge in zip(*holding(road.edges, points), strict=True):
        if edge < road.num_lanes or not out[point] or out[point][0] >= road.num_lanes:
            out[point].append(int(edge))
    return out


def without_overlaps(road: VectorMap, corners: np.ndarray) -> np.ndarray:
    """The boxes without a corner in two lanes, which is an error."""
    is_twice = np.array(
        [
            sum(e < road.num_lanes for e in edges) > 1
            for edges in edges_at(road, corners.reshape(-1, 2))
        ]
    )
    refused = is_twice.reshape(-1, 4).any(axis=1)
    for box in corners[refused]:
        with pytest.raises(MapError, match="overlap"):
            corner_routes(road, box[None])
    return corners[~refused]


def as_lists(road: VectorMap, edges: list[list[int]]) -> EdgeLists:
    out = empty_lists(road, len(edges))
    for index, some in enumerate(edges):
        out.counts[index] = len(some)
        out.edges[index, : len(some)] = some
    return out


def check(road: VectorMap, corners: np.ndarray) -> int:
    """Compare kernels with shapely for boxes (K, 4, 2); the number of corners that are outside."""
    points, centers = corners.reshape(-1, 2), corners.mean(axis=1)
    edges, route = edges_at(road, points), edges_at(road, centers)
    outside = np.array([not some for some in edges])
    outside[holding(road.drivable_areas, points)[0]] = False
    distances = np.zeros(len(points))
    areas = np.array([road.drivable_areas.shape(i) for i in range(len(road.drivable_areas))])
    lanes = [road.edges.shape(index) for index in range(len(road.edges))]
    tree = shapely.STRtree(areas)
    for index in np.flatnonzero(outside):
        point = shapely.Point(points[index])
        near = [lanes[edge].distance(point) for edge in route[index // 4]]
        reach = point.buffer(1.001 * areas[tree.nearest(point)].distance(point) + 1e-6)
        # several may be equally near but for rounding
        near += shapely.distance(areas[tree.query(reach)], point).tolist()
        distances[index] = min(near, default=np.inf)

    # the kernel remembers the edges of the sample before: one far away, here
    apart = np.full((2 * len(corners), 4, 2), FAR)
    apart[::2] = corners
    lists = corner_routes(road, apart)
    found = EdgeLists(lists.edges[::2], lists.counts[::2])
    assert [found.at(index // 4, index % 4) for index in range(len(points))] == edges
    area = measure(road, corners, as_lists(road, route), found)
    np.testing.assert_array_equal(area.outside.ravel(), outside)
    np.testing.assert_array_equal(area.distances.ravel(), distances)
    for profile in PROFILES.values():
        bound = profile.max_drivable_area_violation
        far = area.outside & (area.distances >= bound)
        np.testing.assert_array_equal(far.ravel(), outside & (distances >= bound))
    return int(outside.sum())


def check_files(paths: list[Path], count: int) -> int:
    """Compare for boxes on all maps, every second one at coordinates of UTM; number of holes."""
    rng, share, num_holes = np.random.default_rng(20260101), -(-count // len(paths)), 0
    for number, path in enumerate(paths):
        offset = (500_000.0, 5_400_000.0) if number % 2 else (0.0, 0.0)
        road = build_road_map(read_opendrive(path), name=path.stem, offset=offset)[0]
        corners = without_overlaps(road, boxes_near(road, share, rng))
        assert len(corners) > 0.95 * share
        num_outside = check(road, corners)
        assert 0.1 < num_outside / corners[..., 0].size < 0.9
        num_holes += len(road.drivable_areas.polygons.ring_ptr) - len(road.drivable_areas) - 1
    return num_holes


@pytest.mark.thorough
def test_ten_thousand_boxes_in_the_towns_of_the_demo_agree_with_shapely(tmp_path):
    for town in DEMO_TOWNS:
        xml = generate_town(town)[0].xml()
        (tmp_path / f"{town.name}.xodr").write_text(xml, "utf-8")
    check_files(sorted(tmp_path.glob("*.xodr")), 10_000)


@pytest.mark.slow
def test_a_hundred_thousand_boxes_on_real_maps_agree_with_shapely(shared):
    assert check_files(sorted((shared / "maps").glob("*.xodr")), 100_000) > 20
