"""From lane pieces to lanes, roadblocks and connectors of the map: which of them are which."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.data.maps.segments import LanePiece, Part
from shiftsim.data.maps.topology import MAX_GAP, LaneGraph, Topology
from shiftsim.data.polygons import shared_areas
from shiftsim.errors import MapError

_MIN_OVERLAP, _OVERLAP_SHARE = 1.0, 0.1  # m², and share of the smaller piece: forks and merges
# m, and share of a connector at the boundary of the map, that becomes a lane
_OUTER_LENGTH, _OUTER_SHARE = 1.0, 0.25
_MAX_CHAIN = 8  # pieces along one connector
_START, _WHOLE, _END = range(3)  # which part of a piece


class _Node(NamedTuple):
    """A part of a piece that is a lane, or a part of one, or a connector."""

    piece: int
    place: int = _WHOLE


def build_graph(pieces: Sequence[LanePiece], warnings: Counter[str]) -> LaneGraph[Part]:
    """Lanes, roadblocks and connectors of some pieces; counts what was inferred or left out.

    Raises:
        MapError: Two pieces have one id, or a border has fewer than two vertices.
    """
    return _Builder(pieces, warnings).build()


class _Builder:
    def __init__(self, pieces: Sequence[LanePiece], warnings: Counter[str]) -> None:
        ids = Counter(piece.id for piece in pieces)
        for piece in pieces:
            if ids[piece.id] > 1:
                raise MapError(f"lane {piece.id!r}: its id occurs twice", "give it one of its own")
            if min(len(piece.left), len(piece.right), len(piece.middle)) < 2:
                what = f"lane {piece.id!r}: a border or its centre line has fewer than two vertices"
                raise MapError(what, "leave the lane out, or repair the file")
        self.warnings = warnings
        self.pieces = [piece for piece in pieces if piece.polygon.area > 0 and piece.length > 0]
        self._count("lane without area, left out", len(pieces) - len(self.pieces))
        self.index = {piece.id: i for i, piece in enumerate(self.pieces)}
        self.is_connector = self._find_connectors()
        self.left = self._find_neighbors()
        self.topology: Topology[_Node, Part] = Topology(self._is_lane, warnings)

    def _count(self, what: str, number: int) -> None:
        if number:
            self.warnings[what] += number

    def build(self) -> LaneGraph[Part]:
        self._link()
        self._add_nodes()
        self.topology.build_lanes(self._groups())
        what = "connector that leads from no lane to no lane, left out"
        self.topology.build_connectors(_MAX_CHAIN, lambda nodes: frozenset({"intersection"}), what)
        self.topology.cut_connectors()
        return self.topology.graph

    def _is_lane(self, node: _Node) -> bool:
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
        pairs, unknown = [], 0
        for number, piece in enumerate(self.pieces):
            for name in dict.fromkeys(piece.successors):
                target = self.index.get(name, -1)
                unknown += target < 0
                if target >= 0 and target != number:
                    pairs.append((number, target))
        self._count("successor that is not in the map, left out", unknown)
        ends = [[self.pieces[a].left[-1], self.pieces[a].right[-1]] for a, _ in pairs]
        starts = [[self.pieces[b].left[0], self.pieces[b].right[0]] for _, b in pairs]
        gaps = np.zeros(0)
        if pairs:
            gaps = shapely.distance(shapely.linestrings(ends), shapely.linestrings(starts))
        far = f"lane link over a gap of more than {MAX_GAP:g} m, left out"
        self._count(far, int((gaps > MAX_GAP).sum()))
        for (a, b), gap in zip(pairs, gaps, strict=True):
            if gap <= MAX_GAP:
                self.topology.join(_Node(a), _Node(b))

    def _add_nodes(self) -> None:
        """All pieces; connectors at the boundary of the map begin and end with a lane."""
        topology = self.topology
        for number, piece in enumerate(self.pieces):
            start, node, end = (_Node(number, place) for place in (_START, _WHOLE, _END))
            begins = self.is_connector[number] and not topology.before[node]
            ends = self.is_connector[number] and not topology.after[node]
            share = min(_OUTER_LENGTH / piece.length, _OUTER_SHARE)
            first, last = share if begins else 0.0, 1.0 - share if ends else 1.0
            if begins:
                topology.join(start, node)
                topology.segments[start] = Part(piece, 0.0, first)
            if ends:
                topology.join(node, end)
                topology.segments[end] = Part(piece, last, 1.0)
            topology.segments[node] = Part(piece, first, last)

    def _groups(self) -> list[list[_Node]]:
        """Lanes beside each other, leftmost first."""
        lanes = [node for node in self.topology.segments if self._is_lane(node)]
        left = {}
        for node in lanes:
            beside = _Node(self.left[node.piece], node.place)
            if beside in self.topology.segments and self._is_lane(beside):
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
