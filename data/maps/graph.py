"""From lane pieces to lanes, roadblocks and connectors of the map: topology only.

A *group* holds pieces beside each other. Groups that follow each other one piece to one piece are
joined to a roadblock; each chain of pieces in it is a lane. Every other link becomes a connector:
along the connector pieces between two lanes, elsewhere over a short seam cut from the lane before.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.data.maps.opendrive.graph import MAX_GAP, SEAM_LENGTH, SEAM_SHARE
from shiftsim.data.maps.segments import LanePiece, Part, split_parts
from shiftsim.data.polygons import shared_areas
from shiftsim.errors import MapError

_MIN_OVERLAP, _OVERLAP_SHARE = 1.0, 0.1  # m², and share of the smaller piece: forks and merges
_RIM_LENGTH, _RIM_SHARE = 1.0, 0.25  # m, and share of a connector that becomes a lane at the rim
_MAX_CHAIN = 8  # pieces along one connector
_MAX_STEPS = 2_000  # in the search for ways from one lane through connectors
_START, _WHOLE, _END = range(3)  # which part of a piece


class _Node(NamedTuple):
    """A part of a piece that is a lane, or a part of one, or a connector."""

    piece: int
    place: int = _WHOLE


@dataclass
class Lane:
    """A lane of the map; `index` counts from the left within its roadblock."""

    parts: list[Part]  # in the direction of travel
    block: int  # the roadblock it lies in
    index: int


@dataclass(frozen=True)
class Connector:
    """A lane connector of the map."""

    parts: list[Part]  # in the direction of travel
    source: int  # lane it comes from
    target: int  # lane it leads to
    is_seam: bool  # whether it only joins lanes that no connector piece joins


@dataclass
class LaneGraph:
    """Lanes and connectors of the map."""

    lanes: list[Lane] = field(default_factory=list)  # those of a roadblock follow each other
    connectors: list[Connector] = field(default_factory=list)
    dropped: list[LanePiece] = field(default_factory=list)  # connectors that lead nowhere


def build_graph(pieces: Sequence[LanePiece], warnings: Counter[str]) -> LaneGraph:
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
        self.warnings, self.graph = warnings, LaneGraph()
        self.pieces = [piece for piece in pieces if piece.polygon.area > 0 and piece.length > 0]
        self._count("lane without area, left out", len(pieces) - len(self.pieces))
        self.index = {piece.id: i for i, piece in enumerate(self.pieces)}
        self.is_connector = self._find_connectors()
        self.left = self._find_neighbors()
        self.after: dict[_Node, list[_Node]] = defaultdict(list)
        self.before: dict[_Node, list[_Node]] = defaultdict(list)

    def _count(self, what: str, number: int) -> None:
        if number:
            self.warnings[what] += number

    def build(self) -> LaneGraph:
        self._link()
        self._cut_rims()
        self._build_lanes()
        self._build_connectors()
        self._cut_seams()
        return self.graph

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
                self._join(_Node(a), _Node(b))

    def _join(self, source: _Node, target: _Node) -> None:
        self.after[source].append(target)
        self.before[target].append(source)

    def _cut_rims(self) -> None:
        """Connectors at the rim of the map begin and end with a lane (see `_part`)."""
        self.nodes = []
        for number, is_connector in enumerate(self.is_connector):
            node = _Node(number)
            start, end = _Node(number, _START), _Node(number, _END)
            rims = [start] * (not self.before[node]) + [end] * (not self.after[node])
            for rim in rims if is_connector else ():
                self._join(*((rim, node) if rim == start else (node, rim)))
                self.nodes.append(rim)
            self.nodes.append(node)
        self.known = set(self.nodes)

    def _part(self, node: _Node) -> Part:
        piece = self.pieces[node.piece]
        rim = min(_RIM_LENGTH / piece.length, _RIM_SHARE)
        begin = rim if _Node(node.piece, _START) in self.known else 0.0
        end = 1.0 - rim if _Node(node.piece, _END) in self.known else 1.0
        spans = {_START: (0.0, begin), _WHOLE: (begin, end), _END: (end, 1.0)}
        return Part(piece, *spans[node.place])

    def _is_lane(self, node: _Node) -> bool:
        return node.place != _WHOLE or not self.is_connector[node.piece]

    def _groups(self) -> list[list[_Node]]:
        """Lanes beside each other, leftmost first."""
        lanes = [node for node in self.nodes if self._is_lane(node)]
        left = {}
        for node in lanes:
            beside = _Node(self.left[node.piece], node.place)
            if beside in self.known and self._is_lane(beside):
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

    def _build_lanes(self) -> None:
        groups = self._groups()
        self.group_of = {node: i for i, group in enumerate(groups) for node in group}
        onward = {
            i: following
            for i, group in enumerate(groups)
            if (following := self._continuation(group, groups)) is not None
        }
        self.first: dict[_Node, int] = {}  # lane that begins with a node
        self.last: list[_Node] = []  # last node of each lane
        has_previous, placed = set(onward.values()), set()
        order = [i for i in range(len(groups)) if i not in has_previous]
        for begin in [*order, *range(len(groups))]:
            if begin in placed:
                continue
            chain = [begin]
            placed.add(begin)
            while (following := onward.get(chain[-1], begin)) not in placed:
                chain.append(following)
                placed.add(following)
            block = self.graph.lanes[-1].block + 1 if self.graph.lanes else 0
            for index, nodes in enumerate(zip(*(groups[i] for i in chain), strict=True)):
                self.first[nodes[0]] = len(self.graph.lanes)
                self.last.append(nodes[-1])
                self.graph.lanes.append(Lane([self._part(node) for node in nodes], block, index))

    def _continuation(self, group: list[_Node], groups: list[list[_Node]]) -> int | None:
        """The group that continues a group lane by lane, or None."""
        if any(len(self.after[node]) != 1 for node in group):
            return None
        targets = [self.after[node][0] for node in group]
        if not self._is_lane(targets[0]):
            return None
        other = self.group_of[targets[0]]
        follow = all(self.before[t] == [n] for n, t in zip(group, targets, strict=True))
        return other if follow and groups[other] == targets and targets[0] != group[0] else None

    def _build_connectors(self) -> None:
        """One connector per way from a lane over connector pieces to a lane."""
        used: set[_Node] = set()
        for source, last in enumerate(self.last):
            stack: list[tuple[_Node, ...]] = [(node,) for node in reversed(self.after[last])]
            for _ in range(_MAX_STEPS):
                if not stack:
                    break
                path = stack.pop()
                if self._is_lane(path[-1]):
                    if len(path) > 1:
                        parts = [self._part(node) for node in path[:-1]]
                        target = self.first[path[-1]]
                        self.graph.connectors.append(Connector(parts, source, target, False))
                        used.update(path)
                elif len(path) <= _MAX_CHAIN:
                    following = self.after[path[-1]]
                    stack += [(*path, node) for node in reversed(following) if node not in path]
            if stack:
                self.warnings["too many ways through an intersection, the rest is left out"] += 1
        lost = [n for n in self.nodes if not self._is_lane(n) and n not in used]
        self._count("connector that leads from no lane to no lane, left out", len(lost))
        self.graph.dropped += [self.pieces[node.piece] for node in lost]

    def _cut_seams(self) -> None:
        """Short connectors between lanes that follow each other (nuPlan rule 504)."""
        lanes = self.graph.lanes
        links: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for number, last in enumerate(self.last):
            for node in self.after[last]:
                if self._is_lane(node):
                    links[lanes[number].block].append((number, self.first[node]))
        lengths = [sum(part.length for part in lane.parts) for lane in lanes]
        for pairs in links.values():
            cut = min(SEAM_LENGTH, SEAM_SHARE * min(lengths[i] for pair in pairs for i in pair))
            tails = {}
            for number in dict.fromkeys(number for number, _ in pairs):
                lanes[number].parts, tails[number] = split_parts(
                    lanes[number].parts, lengths[number] - cut
                )
            self.graph.connectors += [Connector(tails[a], a, b, True) for a, b in pairs]
