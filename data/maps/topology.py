"""From lane segments that follow each other to lanes, roadblocks and connectors, for every source.

A *node* is a lane of a source, or a part of one. Nodes beside each other form a group. Groups that
follow each other node by node are joined to a roadblock; each chain of nodes in it is a lane. Every
other link becomes a connector: along the nodes of an intersection between two lanes, elsewhere over
a short piece that is cut from the lane before (nuPlan rule 504).
"""

from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, Self, TypeVar

import shapely

from shiftsim.kernels import FloatArray

MAX_GAP = 2.0  # m between lanes that are linked
_CUT_LENGTH, _CUT_SHARE = 3.0, 0.25  # m, and share of the shorter lane, that becomes a connector
_MAX_STEPS = 2_000  # in the search for ways from one lane through an intersection


class Segment(Protocol):
    """The part of a lane of a source that belongs to a node, in the direction of travel."""

    @property
    def length(self) -> float:
        """Length [m]."""

    def split(self, at: float) -> tuple[Self, Self]:
        """The parts before and after a distance from its start [m]."""


N = TypeVar("N", bound=Any)  # a node; nodes have an order
S = TypeVar("S", bound=Segment)


@dataclass
class Lane(Generic[S]):
    """A lane of the map."""

    segments: list[S]  # in the direction of travel
    block: int  # the roadblock it lies in
    index: int  # counts from the left within its roadblock


@dataclass(frozen=True)
class Connector(Generic[S]):
    """A lane connector of the map."""

    segments: list[S]  # in the direction of travel
    source: int  # lane it comes from
    target: int  # lane it leads to
    # labels of the intersections it lies in; empty where it was cut from the lane before
    junctions: frozenset[str] = frozenset()


@dataclass
class LaneGraph(Generic[S]):
    """Lanes and connectors of the map."""

    lanes: list[Lane[S]] = field(default_factory=list)  # those of a roadblock follow each other
    connectors: list[Connector[S]] = field(default_factory=list)
    dropped: list[S] = field(default_factory=list)  # what is part of neither


class Topology(ABC, Generic[N, S]):
    """Nodes and their links, and the lane graph that is made of them."""

    def __init__(self, warnings: Counter[str]) -> None:
        """Without nodes."""
        self.warnings = warnings
        self.segments: dict[N, S] = {}
        self.after: dict[N, list[N]] = defaultdict(list)
        self.before: dict[N, list[N]] = defaultdict(list)
        self.graph: LaneGraph[S] = LaneGraph()
        self._first: dict[N, int] = {}  # lane that begins with a node
        self._last: list[N] = []  # last node of each lane

    @abstractmethod
    def is_lane(self, node: N) -> bool:
        """Whether a node is a lane, and not within an intersection."""

    def join(self, source: N, target: N) -> None:
        """Add a link, once."""
        if target not in self.after[source]:
            self.after[source].append(target)
            self.before[target].append(source)

    def separate(self, source: N, target: N) -> None:
        """Remove a link."""
        self.after[source].remove(target)
        self.before[target].remove(source)

    def drop_wide_gaps(
        self, ends: Callable[[N], tuple[FloatArray, FloatArray]], noted: float = MAX_GAP
    ) -> None:
        """Remove links over gaps that are too wide; counts them, and those wider than `noted` [m].

        `ends` gives the first and the last cross-section (2, 2) of a node [m].
        """
        pairs = [(a, b) for a in sorted(self.after) for b in sorted(self.after[a])]
        if not pairs:
            return
        last, first = ([ends(pair[i])[1 - i] for pair in pairs] for i in (0, 1))
        gaps = shapely.distance(shapely.linestrings(last), shapely.linestrings(first))
        for pair, gap in zip(pairs, gaps, strict=True):
            if gap > MAX_GAP:
                self.separate(*pair)
                self.warnings[f"lane link over a gap of more than {MAX_GAP:g} m, left out"] += 1
            elif gap > noted:
                self.warnings[f"lane link over a gap of more than {noted:g} m"] += 1

    def build_lanes(self, groups: Sequence[list[N]]) -> None:
        """Join groups, leftmost node first, to roadblocks; fills the lanes of the graph."""
        group_of = {node: i for i, group in enumerate(groups) for node in group}
        onward = {}
        for number, group in enumerate(groups):
            following = self._continuation(group)
            if following and groups[group_of[following[0]]] == following:
                onward[number] = group_of[following[0]]
        has_previous = set(onward.values())
        placed: set[int] = set()
        starts = [i for i in range(len(groups)) if i not in has_previous]
        for block, begin in enumerate(
            start for start in [*starts, *range(len(groups))] if start not in placed
        ):
            chain = [begin]
            placed.add(begin)
            while (following_group := onward.get(chain[-1], begin)) not in placed:
                chain.append(following_group)
                placed.add(following_group)
            for index, nodes in enumerate(zip(*(groups[i] for i in chain), strict=True)):
                self._first[nodes[0]] = len(self.graph.lanes)
                self._last.append(nodes[-1])
                segments = [self.segments[node] for node in nodes]
                self.graph.lanes.append(Lane(segments, block, index))

    def _continuation(self, group: list[N]) -> list[N]:
        """The lanes that continue a group node by node, and follow nothing else; or nothing."""
        if any(len(self.after[node]) != 1 for node in group):
            return []
        targets = [self.after[node][0] for node in group]
        follow = all(self.before[t] == [n] for n, t in zip(group, targets, strict=True))
        return targets if follow and self.is_lane(targets[0]) and targets != group else []

    def build_connectors(
        self, max_chain: int, label: Callable[[Sequence[N]], frozenset[str]], what: str
    ) -> None:
        """One connector per way from a lane over `max_chain` nodes of intersections to a lane.

        `label` gives the intersections of nodes; those without both ends are counted as `what`.
        """
        used: set[N] = set()
        for source, last in enumerate(self._last):
            stack: list[tuple[N, ...]] = [(node,) for node in reversed(self.after[last])]
            for _ in range(_MAX_STEPS):
                if not stack:
                    break
                path = stack.pop()
                if self.is_lane(path[-1]):
                    if len(path) > 1:
                        segments = [self.segments[node] for node in path[:-1]]
                        target = self._first[path[-1]]
                        connector = Connector(segments, source, target, label(path[:-1]))
                        self.graph.connectors.append(connector)
                        used.update(path)
                elif len(path) <= max_chain:
                    following = self.after[path[-1]]
                    stack += [(*path, node) for node in reversed(following) if node not in path]
            if stack:
                self.warnings["intersection with too many ways through, the rest left out"] += 1
        for node in sorted(self.segments):
            if not self.is_lane(node) and node not in used:
                self.warnings[what] += 1
                self.graph.dropped.append(self.segments[node])

    def cut_connectors(self) -> None:
        """Short connectors between lanes that follow each other without an intersection."""
        lanes = self.graph.lanes
        links: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for number, last in enumerate(self._last):
            for node in self.after[last]:
                if node in self._first:
                    links[lanes[number].block].append((number, self._first[node]))
        lengths = [sum(segment.length for segment in lane.segments) for lane in lanes]
        for pairs in links.values():
            shortest = min(lengths[i] for pair in pairs for i in pair)
            cut = min(_CUT_LENGTH, _CUT_SHARE * shortest)
            tails = {}
            for number in dict.fromkeys(number for number, _ in pairs):
                lanes[number].segments, tails[number] = split_segments(
                    lanes[number].segments, lengths[number] - cut
                )
            self.graph.connectors += [Connector(tails[a], a, b) for a, b in pairs]


def split_segments(segments: Sequence[S], at: float) -> tuple[list[S], list[S]]:
    """Cut segments that follow each other at a distance from their start [m]."""
    head: list[S] = []
    for number, segment in enumerate(segments):
        if at >= segment.length and number + 1 < len(segments):
            head.append(segment)
            at -= segment.length
            continue
        before, after = segment.split(at)
        return ([*head, before] if at > 0 else head), [after, *segments[number + 1 :]]
    return head, []
