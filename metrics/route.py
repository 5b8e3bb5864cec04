"""Where the ego is on the road: driven route, corner routes, lane changes, leaving the road.

Everything later metrics ask of the map rests on these lists (nuplan-metrics.md §3, §4).
"""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.errors import MapError
from shiftsim.metrics import kernels_route
from shiftsim.world.map import VectorMap


@dataclass(frozen=True, slots=True)
class EdgeLists:
    """Edges that hold a point, for an array of points.

    Attributes:
        edges: (…, C) edge indices; only the first `counts` of each row mean anything.
        counts: (…) how many.
    """

    edges: IntArray
    counts: IntArray

    def at(self, *index: int) -> list[int]:
        """Edges of one point."""
        found: list[int] = self.edges[index][: self.counts[index]].tolist()
        return found

    def ids(self, road: VectorMap, *index: int) -> list[str]:
        """Ids of the edges of one point."""
        return [road.edges.ids[edge] for edge in self.at(*index)]


@dataclass(frozen=True, slots=True)
class LaneChanges:
    """Lane changes of one rollout.

    Attributes:
        states: (K,) number of edges that hold all corners, connected ones included; 0 when the
            ego is entirely outside lanes, -1 when its corners have none in common.
        start: (L,) opening sample of each change.
        end: (L,) closing sample.
        failed: (L,) whether the ego came back, left the road, or did not finish.
    """

    states: IntArray
    start: IntArray
    end: IntArray
    failed: BoolArray

    @property
    def is_common(self) -> BoolArray:
        """(K,) whether all corners are in the same or in connected lanes."""
        return self.states > 0


def driven_route(road: VectorMap, centers: FloatArray) -> EdgeLists:
    """Edges of a sequence of points, disambiguated over time.

    Args:
        road: The map.
        centers: (K, 3) box centres x [m], y [m], heading [rad].

    Returns:
        (K, C) lists, most relevant edge first.

    Raises:
        MapError: Several lanes hold one of the points, where nuPlan's own code stops too.
    """
    room = list_room(road)
    lists = EdgeLists(np.zeros((len(centers), room), np.int64), np.zeros(len(centers), np.int64))
    failed = kernels_route.driven_route(
        road.edges.polygons,
        road.num_lanes,
        road.incoming,
        road.outgoing,
        road.intersections.polygons,
        centers,
        lists.edges,
        lists.counts,
    )
    if failed >= 0:
        _raise_overlap(road, centers[failed, :2])
    return lists


def corner_routes(road: VectorMap, corners: FloatArray) -> EdgeLists:
    """Edges of the four corners of the ego over time.

    Args:
        road: The map.
        corners: (K, 4, 2) front-left, rear-left, rear-right, front-right [m].

    Returns:
        (K, 4, C) lists.

    Raises:
        MapError: Several lanes hold one of the corners.
    """
    room = list_room(road)
    lists = EdgeLists(
        np.zeros((len(corners), 4, room), np.int64), np.zeros((len(corners), 4), np.int64)
    )
    failed = kernels_route.corner_routes(
        road.edges.polygons, road.num_lanes, road.outgoing, corners, lists.edges, lists.counts
    )
    if failed >= 0:
        _raise_overlap(road, *corners[failed])
    return lists


def lane_changes(road: VectorMap, corners: EdgeLists) -> LaneChanges:
    """The lane-change helper on the (K, 4, C) lists of the corners."""
    num_samples, _, room = corners.edges.shape
    widest = int(np.diff(road.outgoing.ptr).max(initial=0))
    states = np.empty(num_samples, np.int64)
    changes = np.empty((num_samples, 3), np.int64)
    count = kernels_route.lane_states(
        corners.edges,
        corners.counts,
        road.incoming,
        road.outgoing,
        room * (1 + widest),
        states,
        changes,
    )
    start, end, failed = changes[:count].T
    return LaneChanges(states, start, end, failed > 0)


def list_room(road: VectorMap) -> int:
    """Upper bound on the number of edges that hold one point."""
    return max(2, int(np.diff(road.edges.polygons.cell_ptr).max(initial=0)))


def _raise_overlap(road: VectorMap, *points: FloatArray) -> None:
    for x, y in points:
        lanes = road.lanes_at(x, y)
        if len(lanes) > 1:
            names = " and ".join(repr(road.edges.ids[lane]) for lane in lanes)
            raise MapError(
                f"map {road.name!r}: lanes {names} overlap at ({x:.2f}, {y:.2f}), so the ego "
                "cannot be assigned to one",
                "mend the polygons of these lanes; nuPlan cannot score the scenario either",
            )
