"""Routes of centre and corners on a small crossing, against a slow version with lists."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds

from shiftsim.errors import MapError
from shiftsim.metrics.route import corner_routes, driven_route
from shiftsim.world.layers import make_layer, make_lists

# four lanes behind a crossing of 20 m, four before it, and connectors that overlap in it
LANES = [shapely.box(x, y, x + 20.0, y + 4.0) for x in (40.0, 0.0) for y in (0.0, 4.0, 8.0, 12.0)]
CROSSING = shapely.box(20.0, 0.0, 40.0, 16.0)


def between(start: int, end: int, width: float) -> shapely.Polygon:
    """The area of a connector from one row of lanes to another."""
    ends = [(18.0, 4.0 * start + 2.0), (22.0, 4.0 * start + 2.0)]
    ends += [(38.0, 4.0 * end + 2.0), (42.0, 4.0 * end + 2.0)]
    return shapely.LineString(ends).buffer(width, cap_style="flat", join_style="mitre")


class Crossing:
    """A map as `route` reads it, and the routes as its description says."""

    def __init__(self, rng: np.random.Generator) -> None:
        pairs = [(int(a), int(b)) for a, b in rng.integers(0, 4, (10, 2))]
        self.shapes = [*LANES, *(between(a, b, rng.uniform(1.0, 2.5)) for a, b in pairs)]
        self.num_lanes = len(LANES)
        count = len(self.shapes)
        self.out: list[list[int]] = [[] for _ in range(count)]
        for index, (start, end) in enumerate(pairs, self.num_lanes):
            self.out[4 + start].append(index)
            self.out[index].append(end)
            if rng.random() < 0.3:
                self.out[4 + start].append(int(rng.integers(self.num_lanes, count)))
        self.into = [[a for a in range(count) if b in self.out[a]] for b in range(count)]
        self.crossing = [shapely.box(20.0, 3.0, 40.0, 13.0)]
        self.map = SimpleNamespace(
            name="toy",
            edges=make_layer([str(n) for n in range(count)], self.shapes),
            intersections=make_layer(["9"], self.crossing),
            num_lanes=self.num_lanes,
            incoming=make_lists(self.into),
            outgoing=make_lists(self.out),
        )

    def holding(self, edges: list[int], point: np.ndarray) -> list[int]:
        held = shapely.Point(point)
        return [e for e in dict.fromkeys(edges) if self.shapes[e].contains(held)]

    def narrowed(self, known: list[int], point: np.ndarray) -> list[int]:
        found = self.holding(known, point)
        return self.holding(self.out[known[0]], point) if not found and len(known) == 1 else found

    def searched(self, point: np.ndarray) -> list[int]:
        lanes = self.holding(list(range(self.num_lanes)), point)
        return lanes or self.holding(list(range(self.num_lanes, len(self.shapes))), point)

    def is_connector(self, edges: list[int]) -> bool:
        return bool(edges) and edges[0] >= self.num_lanes

    def driven(self, points: np.ndarray) -> list[list[int]]:
        lists: list[list[int]] = []
        for sample, point in enumerate(points):
            before = lists[-1] if lists else []
            found = self.narrowed(before, point)
            if not found:
                found = self.searched(point)
                lost = not found and any(c.contains(shapely.Point(point)) for c in self.crossing)
                if sample > 1 and self.is_connector(before) and (self.is_connector(found) or lost):
                    here = shapely.Point(point)
                    found = [e for e in before if self.shapes[e].distance(here) < 5.0] or found
            lists.append(found)
        for sample in range(len(lists) - 2, -1, -1):
            edges, after = lists[sample], lists[sample + 1]
            if len(edges) < 2:
                continue
            if set(after) < set(edges):
                lists[sample] = after
            if after and not self.is_connector(after):
                leading = [edge for edge in edges if edge in self.into[after[0]]]
                lists[sample] = leading or lists[sample]
        return lists

    def of_corners(self, corners: np.ndarray) -> list[list[list[int]]]:
        rows: list[list[list[int]]] = []
        for sample, points in enumerate(corners):
            known = list(dict.fromkeys(edge for edges in (rows or [[]])[-1] for edge in edges))
            row = []
            for point in points:
                found = self.narrowed(known, point)
                if not found:
                    found = self.searched(point)
                    if sample == 1:
                        known = list(dict.fromkeys([*known, *found]))
                row.append(found)
            rows.append(row)
        return rows


def random_walk(rng: np.random.Generator, samples: int) -> np.ndarray:
    """Points (samples, 2) across the map, one way or the other, with jumps now and then."""
    # also walks that begin or end on the connectors
    x = np.sort(rng.uniform(rng.choice([5.0, 25.0]), rng.choice([35.0, 55.0]), samples))
    y = np.clip(rng.uniform(1.0, 15.0) + np.cumsum(rng.normal(0.0, 1.0, samples)), -3.0, 19.0)
    jumps = rng.random(samples) < 0.1
    y[jumps] = rng.uniform(-5.0, 21.0, int(jumps.sum()))
    return np.c_[x, y][:: rng.choice([1, -1])]


@given(seeds)
def test_the_driven_route_is_that_of_a_slow_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    road = Crossing(rng)
    for _ in range(4):
        points = random_walk(rng, int(rng.integers(1, 20)))
        route = driven_route(road.map, np.c_[points, np.zeros(len(points))])
        assert [route.at(sample) for sample in range(len(points))] == road.driven(points)


@given(seeds)
def test_the_routes_of_the_corners_are_those_of_a_slow_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    road = Crossing(rng)
    for _ in range(2):
        points = random_walk(rng, int(rng.integers(1, 15)))
        corners = points[:, None] + np.array([[2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0], [2.0, -1.0]])
        routes = corner_routes(road.map, corners)
        found = [[routes.at(n, corner) for corner in range(4)] for n in range(len(corners))]
        assert found == road.of_corners(corners)
        assert routes.ids(road.map, 0, 0) == [str(edge) for edge in found[0][0]]


@pytest.mark.parametrize("sample", [0, 3])
def test_the_first_point_in_two_lanes_is_named(sample: int) -> None:
    shapes = [shapely.box(0.0, 0.0, 50.0, 4.0), shapely.box(30.0, 3.0, 50.0, 7.0)]
    layer = make_layer(["a", "b"], shapes)
    road = SimpleNamespace(
        name="toy",
        edges=layer,
        intersections=make_layer([], []),
        num_lanes=2,
        incoming=make_lists([[], []]),
        outgoing=make_lists([[], []]),
        lanes_at=lambda x, y: layer.containing(x, y).tolist(),
    )
    points = np.tile([-5.0, 1.0], (5, 1))
    points[sample] = [40.0, 3.5]
    points[4] = [45.0, 3.5]
    with pytest.raises(MapError, match=r"lanes 'a' and 'b' overlap at \(40.00, 3.50\)"):
        driven_route(road, np.c_[points, np.zeros(5)])
    corners = np.tile(points[:, None], (1, 4, 1))
    corners[sample, :2] = [1.0, 1.0]
    with pytest.raises(MapError, match=r"lanes 'a' and 'b' overlap at \(40.00, 3.50\)"):
        corner_routes(road, corners)
