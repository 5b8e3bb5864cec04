"""Lane pieces to the semantic map of nuPlan's kind: which are lanes, and what governs them."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.data.maps import segments
from shiftsim.data.maps.builder import BuiltMap, MapBuilder, StopArea
from shiftsim.data.maps.opendrive.areas import drivable_tiles, linked_groups, merge_areas
from shiftsim.data.maps.opendrive.shapes import BASELINE_STEP
from shiftsim.data.maps.segments import LanePiece, MapSource, Part
from shiftsim.data.maps.topology import Connector, LaneGraph, Topology
from shiftsim.data.polygons import shared_areas
from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import AreaSpec
from shiftsim.world.ranges import MAP_EXTENT, require

_MIN_OVERLAP, _OVERLAP_SHARE = 1.0, 0.1  # m², and share of the smaller piece: forks and merges
# m, and share of a connector at the boundary of the map, that becomes a lane
_OUTER_LENGTH, _OUTER_SHARE = 1.0, 0.25
_MAX_CHAIN = 8  # pieces along one connector
_START, _WHOLE, _END = range(3)  # which part of a piece
_SAME_PLACE = 1.0  # m², connectors that share more lie in one intersection
_CLOSING = 0.5  # m
_APPROACH = 5.0  # m before the end of a lane, where a stop polygon lies


def build_lane_map(source: MapSource) -> BuiltMap:
    """The semantic map of what a data set tells of its lanes, or a MapError."""
    if not source.pieces:
        what = f"map {source.name!r} has no lane that cars may use"
        raise MapError(what, "leave this scene out: without lanes there is no route")
    lines = [line for p in source.pieces for line in (p.left, p.right, p.center)]
    areas = [*source.drivable_areas, *source.paved, *source.crosswalks, *source.walkways]
    areas += [*source.car_parks, *(stop.polygon for stop in source.stop_areas)]
    lines.append(shapely.get_coordinates(areas))
    points = np.concatenate([line for line in lines if line is not None])
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    require(MAP_EXTENT, "extent", extent, f"map {source.name!r}: its", error=MapError)
    return _PieceMapBuilder(source).build(source.name)


class _PieceMapBuilder(MapBuilder[Part]):
    larger = "bigger"

    def __init__(self, source: MapSource) -> None:
        warnings = Counter[str]()
        super().__init__(_PieceGraph(source.pieces, warnings).build(), segments, warnings)
        self.source = source
        self.lights = [self._find_light(connector) for connector in self.graph.connectors]
        self.stop_signs = [False] * len(self.lights)

    def _find_light(self, connector: Connector[Part]) -> str | None:
        """The light of a connector: of its own pieces, else of the lane that leads to it."""
        before = self.graph.lanes[connector.source].segments[-1].piece
        inner = [part.piece for part in connector.segments if connector.junctions]
        return next((piece.light for piece in (*inner, before) if piece.light is not None), None)

    def speed_limits(self, segment: Part) -> Iterable[tuple[float | None, float]]:
        return [(segment.piece.speed_limit, segment.length)]

    def stop_areas(self, lanes: Sequence[shapely.Polygon]) -> Sequence[StopArea]:
        return self.source.stop_areas

    def stops_of(self, number: int, before: FloatArray, line: FloatArray) -> list[int]:
        """Stop polygons where the lane before a connector with a light ends."""
        if self.lights[number] is None:
            return []
        approach = before[-int(_APPROACH / BASELINE_STEP) :]
        path = shapely.LineString(np.concatenate([approach, line]))
        lane = self.graph.lanes[self.graph.connectors[number].source]
        piece = lane.segments[-1].piece.id
        return [
            number
            for number, area in enumerate(self.stops)
            if area.before == piece or (area.before is None and path.intersects(area.polygon))
        ]

    def groups(self, connectors: Sequence[shapely.Polygon]) -> IntArray:
        """Intersections: connectors of one pair of roadblocks, and those that overlap."""
        pairs = self.block_pairs
        links = [(i, pairs.index(pair)) for i, pair in enumerate(pairs)]
        links += [p for p, area in shared_areas(connectors).items() if area > _SAME_PLACE]
        return linked_groups(links, len(pairs))

    def areas(
        self, edges: Sequence[shapely.Polygon], intersections: Sequence[AreaSpec]
    ) -> dict[str, Sequence[shapely.Polygon]]:
        source = self.source
        drivable = [*source.drivable_areas, *drivable_tiles(source.paved)]
        if not drivable:  # what the pieces cover
            pieces = [piece.polygon for piece in source.pieces if piece.polygon.area > 0]
            drivable = drivable_tiles(merge_areas([*pieces, *source.car_parks], _CLOSING))
        return {
            "crosswalks": source.crosswalks,
            "walkways": source.walkways,
            "car_parks": source.car_parks,
            "drivable_areas": drivable,
        }


class _Node(NamedTuple):
    """A part of a piece that is a lane, or a part of one, or a connector."""

    piece: int
    place: int = _WHOLE


class _PieceGraph(Topology[_Node, Part]):
    """Which pieces are lanes, roadblocks and connectors; counts what is inferred or left out."""

    def __init__(self, pieces: Sequence[LanePiece], warnings: Counter[str]) -> None:
        ids = Counter(piece.id for piece in pieces)
        for piece in pieces:
            if ids[piece.id] > 1:
                raise MapError(f"lane {piece.id!r}: its id occurs twice", "give it one of its own")
            if min(len(piece.left), len(piece.right), len(piece.middle)) < 2:
                what = f"lane {piece.id!r}: a border or its centre line has fewer than two vertices"
                raise MapError(what, "leave the lane out, or repair the file")
        super().__init__(warnings)
        self.pieces = [piece for piece in pieces if piece.polygon.area > 0 and piece.length > 0]
        if without := len(pieces) - len(self.pieces):
            warnings["lane without area, left out"] += without
        self.index = {piece.id: i for i, piece in enumerate(self.pieces)}
        self.is_connector = self._find_connectors()
        self.left = self._find_neighbors()

    def build(self) -> LaneGraph[Part]:
        self._link()
        self._add_nodes()
        self.build_lanes(self._groups())
        what = "connector that leads from no lane to no lane, left out"
        self.build_connectors(_MAX_CHAIN, lambda nodes: frozenset({"intersection"}), what)
        self.cut_connectors()
        return self.graph

    def is_lane(self, node: _Node) -> bool:
        return node.place != _WHOLE or not self.is_connector[node.piece]

    def _find_connectors(self) -> list[bool]:
        """Which pieces are connectors: flagged ones, and forks and merges, which share area."""
        out = [piece.is_connector for piece in self.pieces]
        free = [i for i, flagged in enumerate(out) if not flagged]
        areas = [self.pieces[i].polygon.area for i in free]
        for (a, b), area in shared_areas([self.pieces[i].polygon for i in free]).items():
            if area > max(_MIN_OVERLAP, _OVERLAP_SHARE * min(areas[a], areas[b])):
                out[free[a]] = out[free[b]] = True
        return out

    def _find_neighbors(self) -> list[int]:
        """The piece on the left of each, -1 without one: named by both, of one direction."""
        out = []
        for number, piece in enumerate(self.pieces):
            other = self.index.get(piece.left_neighbor or "", -1)
            is_mutual = other >= 0 and self.pieces[other].right_neighbor == piece.id
            along = is_mutual and float(self.pieces[other].chord @ piece.chord) > 0
            out.append(other if along and other != number else -1)
        return out

    def _link(self) -> None:
        """Successors as they are named; predecessors are the same links the other way."""
        for number, piece in enumerate(self.pieces):
            for name in dict.fromkeys(piece.successors):
                target = self.index.get(name)
                if target is None:
                    self.warnings["successor that is not in the map, left out"] += 1
                elif target != number:
                    self.join(_Node(number), _Node(target))
        self.drop_wide_gaps(lambda node: self.pieces[node.piece].ends)

    def _add_nodes(self) -> None:
        """All pieces; connectors at the boundary of the map begin and end with a lane."""
        for number, piece in enumerate(self.pieces):
            start, node, end = (_Node(number, place) for place in (_START, _WHOLE, _END))
            begins = self.is_connector[number] and not self.before[node]
            ends = self.is_connector[number] and not self.after[node]
            share = min(_OUTER_LENGTH / piece.length, _OUTER_SHARE)
            first, last = share if begins else 0.0, 1.0 - share if ends else 1.0
            if begins:
                self.join(start, node)
                self.segments[start] = Part(piece, 0.0, first)
            if ends:
                self.join(node, end)
                self.segments[end] = Part(piece, last, 1.0)
            self.segments[node] = Part(piece, first, last)

    def _groups(self) -> list[list[_Node]]:
        """Lanes beside each other, leftmost first."""
        lanes = [node for node in self.segments if self.is_lane(node)]
        left = {}
        for node in lanes:
            beside = _Node(self.left[node.piece], node.place)
            if beside in self.segments and self.is_lane(beside):
                left[node] = beside
        right = {b: a for a, b in left.items()}
        groups: list[list[_Node]] = []
        placed: set[_Node] = set()
        for first in [node for node in lanes if node not in left] + lanes:
            if first in placed:
                continue
            if first in left:
                self.warnings["lanes that are beside each other in a circle, cut"] += 1
            group = []
            at: _Node | None = first
            while at is not None and at not in placed:
                group.append(at)
                placed.add(at)
                at = right.get(at)
            groups.append(group)
        return sorted(groups, key=min)
