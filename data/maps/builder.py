"""Shaped lanes and connectors to the parts of a map: ids, links, roadblocks, intersections.

Whatever the source: readers of OpenDRIVE and of lane pieces shape lanes and connectors in their own
ways, and hand them over here.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Protocol, TypeVar

import numpy as np
import shapely

from shiftsim.data.maps.opendrive.areas import merge_closed
from shiftsim.data.maps.opendrive.overlaps import subtract_overlaps
from shiftsim.data.maps.opendrive.shapes import lane_polygon
from shiftsim.data.polygons import largest_part
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec

LIGHT_KIND, STOP_SIGN_KIND, PASS_THROUGH = 1, 2, 5  # kinds of intersections
T = TypeVar("T")
_CLOSING = 0.5  # m
_STRAIGHT_TURN, _U_TURN = np.deg2rad(30.0), np.deg2rad(150.0)


@dataclass(frozen=True)
class _Shape:
    left: FloatArray  # (K, 2) left border in the direction of travel [m]
    right: FloatArray  # (K', 2) right border [m]
    line: FloatArray  # (K'', 2) baseline [m]
    polygon: shapely.Polygon  # its area
    speed_limit: float | None  # [m/s]; None where the source has none


@dataclass(frozen=True)
class ShapedLane(_Shape):
    """A lane; those of a roadblock follow each other from left to right."""

    block: int  # number of its roadblock
    index: int  # place in it, 0 leftmost
    is_beside: bool  # whether it touches the one before, where that is in the same roadblock


@dataclass(frozen=True)
class ShapedConnector(_Shape):
    """A lane connector."""

    source: int  # lane it comes from
    target: int  # lane it leads to
    has_light: bool
    stops: Sequence[int]  # stop polygons that belong to it


class _Lane(Protocol):
    @property
    def block(self) -> int: ...


class _Connector(Protocol):
    @property
    def source(self) -> int: ...
    @property
    def target(self) -> int: ...


def block_pairs(lanes: Sequence[_Lane], connectors: Iterable[_Connector]) -> list[tuple[int, int]]:
    """Roadblocks that each connector comes from and leads to."""
    return [(lanes[c.source].block, lanes[c.target].block) for c in connectors]


class MapBuilder:
    """Parts of a map, with one series of ids for all of them."""

    def __init__(
        self,
        lanes: Sequence[ShapedLane],
        connectors: Sequence[ShapedConnector],
        *,
        groups: IntArray,
        num_stops: int,
        stacked: Collection[tuple[int, int]] = (),
    ) -> None:
        """Number everything.

        `groups` are the intersections of the connectors, 0 and up; `stacked` pairs of roadblocks
        lie on different levels.
        """
        self._lanes, self._connectors, self._stacked = lanes, connectors, set(stacked)
        self._next_id = map(str, count(1))
        self.lane_ids = self._new_ids(len(lanes))
        self.connector_ids = self._new_ids(len(connectors))
        self.block_ids = self._new_ids(max((lane.block for lane in lanes), default=-1) + 1)
        self._pairs = block_pairs(lanes, connectors)
        pairs = sorted(set(self._pairs))
        self._pair_ids = dict(zip(pairs, self._new_ids(len(pairs)), strict=True))
        self._groups = groups.tolist()
        self._group_ids = self._new_ids(int(groups.max(initial=-1)) + 1)
        self.stop_ids = self._new_ids(num_stops)

    def _new_ids(self, number: int) -> list[str]:
        return [next(self._next_id) for _ in range(number)]

    def edges(self) -> list[EdgeSpec]:
        """All lanes and connectors."""
        return [*self._lane_specs(), *self._connector_specs()]

    def _lane_specs(self) -> Iterator[EdgeSpec]:
        lanes = self._lanes
        outgoing, incoming = defaultdict(list), defaultdict(list)
        for connector_id, connector in zip(self.connector_ids, self._connectors, strict=True):
            outgoing[connector.source].append(connector_id)
            incoming[connector.target].append(connector_id)
        # neighbours share a border
        borders: dict[tuple[int, int], str] = defaultdict(lambda: next(self._next_id))
        beside = [
            i > 0 and lane.is_beside and lanes[i - 1].block == lane.block
            for i, lane in enumerate(lanes)
        ] + [False]
        for number, lane in enumerate(lanes):
            yield EdgeSpec(
                id=self.lane_ids[number],
                is_connector=False,
                polygon=lane.polygon,
                baseline=lane.line,
                block_id=self.block_ids[lane.block],
                incoming=incoming[number],
                outgoing=outgoing[number],
                left=lane.left,
                right=lane.right,
                left_id=borders[lane.block, lane.index],
                right_id=borders[lane.block, lane.index + 1],
                speed_limit=lane.speed_limit,
                lane_index=lane.index,
                left_lane=self.lane_ids[number - 1] if beside[number] else None,
                right_lane=self.lane_ids[number + 1] if beside[number + 1] else None,
            )

    def _connector_specs(self) -> Iterator[EdgeSpec]:
        for number, connector in enumerate(self._connectors):
            left_id, right_id = self._new_ids(2)
            yield EdgeSpec(
                id=self.connector_ids[number],
                is_connector=True,
                polygon=connector.polygon,
                baseline=connector.line,
                block_id=self._pair_ids[self._pairs[number]],
                incoming=[self.lane_ids[connector.source]],
                outgoing=[self.lane_ids[connector.target]],
                left=connector.left,
                right=connector.right,
                left_id=left_id,
                right_id=right_id,
                speed_limit=connector.speed_limit,
                intersection_id=self._group_ids[self._groups[number]],
                has_traffic_lights=connector.has_light,
                stop_lines=[self.stop_ids[i] for i in connector.stops],
                turn_type=turn_type(connector.line),
            )

    def blocks(self) -> list[BlockSpec]:
        """All roadblocks and roadblock connectors."""
        return [*self._roadblocks(), *self._roadblock_connectors()]

    def _roadblocks(self) -> Iterator[BlockSpec]:
        members = _grouped(lane.block for lane in self._lanes)
        order = sorted(members)
        polygons = [self._roadblock_polygon(members[block]) for block in order]
        polygons, _ = subtract_overlaps(polygons, [p.area for p in polygons], self._stacked)
        for block, polygon in zip(order, polygons, strict=True):
            yield BlockSpec(
                id=self.block_ids[block],
                is_connector=False,
                polygon=polygon,
                incoming=[i for pair, i in self._pair_ids.items() if pair[1] == block],
                outgoing=[i for pair, i in self._pair_ids.items() if pair[0] == block],
            )

    def _roadblock_polygon(self, numbers: Sequence[int]) -> shapely.Polygon:
        """The area of some lanes, with what lies between them where they do not touch."""
        lanes = [self._lanes[i] for i in numbers]
        union = shapely.union_all([lane.polygon for lane in lanes])
        if not isinstance(union, shapely.Polygon):
            union = shapely.union(union, lane_polygon(lanes[0].left, lanes[-1].right))
        return largest_part(union)

    def _roadblock_connectors(self) -> Iterator[BlockSpec]:
        members = _grouped(self._pairs)
        for pair, block_id in self._pair_ids.items():
            numbers = members[pair]
            yield BlockSpec(
                id=block_id,
                is_connector=True,
                polygon=self._merged(numbers, 0.1),
                incoming=[self.block_ids[pair[0]]],
                outgoing=[self.block_ids[pair[1]]],
                intersection_id=self._group_ids[self._groups[numbers[0]]],
            )

    def intersections(self, kind: Callable[[Sequence[int]], int]) -> list[AreaSpec]:
        """All intersections; `kind` tells the type number of the one of some connectors."""
        return [
            AreaSpec(
                self._group_ids[group],
                shapely.Polygon(self._merged(numbers, _CLOSING).exterior),
                kind(numbers),
            )
            for group, numbers in sorted(_grouped(self._groups).items())
        ]

    def _merged(self, numbers: Sequence[int], radius: float) -> shapely.Polygon:
        return merge_closed([self._connectors[i].polygon for i in numbers], radius)

    def stop_polygons(self, stops: Iterable[tuple[shapely.Polygon, int]]) -> list[AreaSpec]:
        """Stop polygons of some areas and type numbers, in the order of their numbers."""
        return [AreaSpec(i, *stop) for i, stop in zip(self.stop_ids, stops, strict=True)]

    def areas(self, polygons: Sequence[shapely.Polygon]) -> list[AreaSpec]:
        """The areas of a layer without links."""
        return [AreaSpec(next(self._next_id), polygon) for polygon in polygons]


def turn_type(line: FloatArray) -> int:
    """0 straight, 1 left, 2 right, 3 u-turn, by how much a line (K, 2) turns in all."""
    steps = np.diff(line, axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turn = float(headings[-1] - headings[0])
    if abs(turn) < _STRAIGHT_TURN:
        return 0
    if abs(turn) > _U_TURN:
        return 3
    return 1 if turn > 0 else 2


def _grouped(labels: Iterable[T]) -> dict[T, list[int]]:
    """Indices by label, in order."""
    out: dict[T, list[int]] = defaultdict(list)
    for index, label in enumerate(labels):
        out[label].append(index)
    return out
