"""Which lanes the ego is in: the driven route of its centre, and the routes of its corners.

Everything later metrics ask of the map rests on these lists. Every sample has a short list of
edges, stored as a row of a (…, C) index array with its length; C is the largest number of edges
that can hold one point. Lanes come before connectors.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.errors import MapError
from shiftsim.geometry.rings import INTERIOR, locate_in_polygon
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.layers import Lists, Polygons, containing, distance_to, in_any, in_bounds
from shiftsim.world.map import VectorMap

_KEEP_DISTANCE = 5.0  # m, how far a connector is kept for inside an intersection
_OVERLAP = -1  # several lanes hold the point


class EdgeLists(NamedTuple):
    """Edges that hold a point, for an array of points."""

    edges: IntArray  # (…, C) edge indices; only the first `counts` of each row mean anything
    counts: IntArray  # (…) how many

    def at(self, *index: int) -> list[int]:
        """Edges of one point."""
        found: list[int] = self.edges[index][: self.counts[index]].tolist()
        return found

    def ids(self, map: VectorMap, *index: int) -> list[str]:
        """Ids of the edges of one point."""
        return [map.edges.ids[edge] for edge in self.at(*index)]


class Lanes(NamedTuple):
    """What kernels read of the lanes and connectors of a map. E edges."""

    polygons: Polygons  # their areas
    num_lanes: int  # how many of them are lanes; the others are connectors
    incoming: Lists  # edges that lead into an edge
    outgoing: Lists  # edges an edge leads to


def lanes_of(map: VectorMap) -> Lanes:
    """The lanes and connectors of a map."""
    return Lanes(map.edges.polygons, map.num_lanes, map.incoming, map.outgoing)


def empty_lists(map: VectorMap, *shape: int) -> EdgeLists:
    """Lists of a given shape with nothing in them, long enough for any point of a map."""
    capacity = max(2, map.edges.most_at_a_point)
    return EdgeLists(np.zeros((*shape, capacity), np.int64), np.zeros(shape, np.int64))


def driven_route(map: VectorMap, centers: FloatArray) -> EdgeLists:
    """Edges (K, C) of box centres (K, 3), disambiguated over time, most relevant edge first.

    Raises:
        MapError: Several lanes hold one of the points, where nuPlan's own code stops too.
    """
    lists = empty_lists(map, len(centers))
    failed = _driven_route(lanes_of(map), map.intersections.polygons, centers, lists)
    if failed >= 0:
        _raise_overlap(map, centers[failed, :2])
    return lists


def corner_routes(map: VectorMap, corners: FloatArray) -> EdgeLists:
    """Edges (K, 4, C) of the corners (K, 4, 2) of the ego over time.

    Raises:
        MapError: Several lanes hold one of the corners.
    """
    lists = empty_lists(map, len(corners), 4)
    failed = _corner_routes(lanes_of(map), corners, lists)
    if failed >= 0:
        _raise_overlap(map, *corners[failed])
    return lists


def _raise_overlap(map: VectorMap, *points: FloatArray) -> None:
    for x, y in points:
        lanes = map.lanes_at(x, y)
        if len(lanes) > 1:
            names = " and ".join(repr(map.edges.ids[lane]) for lane in lanes)
            raise MapError(
                f"map {map.name!r}: lanes {names} overlap at ({x:.2f}, {y:.2f}), so the ego "
                "cannot be assigned to one",
                "repair the polygons of these lanes; nuPlan cannot score the scenario either",
            )


@kernel
def has(items: IntArray, count: int, value: int) -> bool:
    """Whether `value` is among the first `count` items."""
    for index in range(count):
        if items[index] == value:
            return True
    return False


@kernel
def _search(lanes: Lanes, x: float, y: float, out: IntArray) -> int:
    """Write the lane that holds a point, else the connectors; how many, or _OVERLAP."""
    found = containing(lanes.polygons, x, y, out)
    if found > 1 and out[1] < lanes.num_lanes:
        return _OVERLAP
    if found > 0 and out[0] < lanes.num_lanes:
        return 1
    return found


@kernel
def _narrow(
    lanes: Lanes, points: FloatArray, known: IntArray, count: int, out: IntArray, counts: IntArray
) -> None:
    """Write which of the first `count` known edges, or the successors of one, hold each point."""
    areas, after, ptr = lanes.polygons, lanes.outgoing.items, lanes.outgoing.ptr
    xy, ring_ptr, poly_ptr, bounds = areas.xy, areas.ring_ptr, areas.poly_ptr, areas.bounds
    more = ptr[known[0] + 1] - ptr[known[0]] if count == 1 else 0
    for point in range(len(points)):
        x, y, found = points[point, 0], points[point, 1], 0
        for index in range(count + more):
            if index == count and found > 0:
                break
            edge = known[index] if index < count else after[ptr[known[0]] + index - count]
            if in_bounds(bounds, edge, x, y) and not has(out[point], found, edge):
                first, last = poly_ptr[edge], poly_ptr[edge + 1]
                if locate_in_polygon(xy, ring_ptr, first, last, x, y) == INTERIOR:
                    out[point, found] = edge
                    found += 1
        counts[point] = found


@kernel
def _driven_route(lanes: Lanes, intersections: Polygons, poses: FloatArray, out: EdgeLists) -> int:
    """Write the edges that hold each point (K, 3); -1, or the first sample in several lanes."""
    lists, counts = out.edges, out.counts
    for i in range(len(poses)):
        x, y = poses[i, 0], poses[i, 1]
        count = 0
        if i > 0 and counts[i - 1] > 0:
            here = slice(i, i + 1)
            _narrow(lanes, poses[here], lists[i - 1], counts[i - 1], lists[here], counts[here])
            count = counts[i]
        if count == 0:
            count = _search(lanes, x, y, lists[i])
            if count == _OVERLAP:
                return i
            if i > 1 and counts[i - 1] > 0 and lists[i - 1, 0] >= lanes.num_lanes:
                in_crossing = count > 0 and lists[i, 0] >= lanes.num_lanes
                if in_crossing or (count == 0 and in_any(intersections, x, y)):
                    num_left = 0
                    for index in range(counts[i - 1]):
                        edge = lists[i - 1, index]
                        if distance_to(lanes.polygons, edge, x, y) < _KEEP_DISTANCE:
                            lists[i, num_left] = edge
                            num_left += 1
                    # nuPlan rule 69: an empty selection leaves the list as it was found
                    count = num_left if num_left > 0 else count
        counts[i] = count
    # then the list of each sample is narrowed down by that of the next one, from the end on
    for i in range(len(counts) - 2, -1, -1):
        if counts[i] < 2:
            continue
        after, size = lists[i + 1], counts[i + 1]
        count = counts[i]
        original = np.empty(count, np.int64)
        for index in range(count):
            original[index] = lists[i, index]
        subset = count > size
        for index in range(size):
            subset = subset and has(original, count, after[index])
        if subset:
            # nuPlan rule 68: also when the next list is empty
            for index in range(size):
                lists[i, index] = after[index]
            counts[i] = size
        if size > 0 and after[0] < lanes.num_lanes:
            incoming = lanes.incoming
            leading = incoming.items[incoming.ptr[after[0]] : incoming.ptr[after[0] + 1]]
            num_left = 0
            for index in range(count):
                if has(leading, len(leading), original[index]):
                    lists[i, num_left] = original[index]
                    num_left += 1
            counts[i] = num_left if num_left > 0 else counts[i]
    return -1


@kernel
def _corner_routes(lanes: Lanes, corners: FloatArray, out: EdgeLists) -> int:
    """Write the edges that hold each corner (K, 4, 2); -1, or the first sample in several lanes."""
    lists, counts = out.edges, out.counts
    known = np.empty(8 * lists.shape[2], np.int64)
    for i in range(len(corners)):
        size = 0
        if i > 0:
            for corner in range(4):
                size = _add(known, size, lists[i - 1, corner], counts[i - 1, corner])
        _narrow(lanes, corners[i], known, size, lists[i], counts[i])
        for corner in range(4):
            if counts[i, corner] == 0:
                x, y, found = corners[i, corner, 0], corners[i, corner, 1], lists[i, corner]
                count = counts[i, corner] = _search(lanes, x, y, found)
                if count == _OVERLAP:
                    return i
                if i == 1:  # nuPlan rule 70: only here
                    size, rest = _add(known, size, found, count), corner + 1
                    _narrow(
                        lanes, corners[i, rest:], known, size, lists[i, rest:], counts[i, rest:]
                    )
    return -1


@kernel
def _add(items: IntArray, size: int, more: IntArray, count: int) -> int:
    """Append what is not among the first `size` items yet; returns how many there are then."""
    for index in range(count):
        if not has(items, size, more[index]):
            items[size] = more[index]
            size += 1
    return size
