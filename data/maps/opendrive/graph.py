"""From lanes of lane sections to lanes, roadblocks and connectors of the map: topology only.

A *group* holds the drivable lanes of one direction of one lane section. Groups that follow each
other one lane to one lane are joined to a run, which becomes a roadblock. Every other link becomes
a connector: through a junction along its connecting roads, elsewhere over a short seam cut from
the lanes before it.
"""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TypeAlias

import numpy as np
import shapely

from shiftsim.data.maps.opendrive.curves import ReferenceLine
from shiftsim.data.maps.opendrive.lanes import LaneKey, lane_links, runs_forward, section_borders
from shiftsim.data.maps.opendrive.records import DRIVABLE, Lane, OpenDrive
from shiftsim.kernels import FloatArray

MIN_LENGTH = 0.1  # m, shorter lanes are linked through
MIN_WIDTH = 0.5  # m, lanes never wider are linked through
SEAM_LENGTH, SEAM_SHARE = 3.0, 0.25  # m, and share of the shorter lane
MAX_GAP, INFER_GAP, SNAP_GAP = 2.0, 0.1, 0.05  # m
_MAX_CHAIN = 64  # lanes along one connector
_MAX_STEPS = 2_000  # in the search for ways from one lane through junctions
_Group: TypeAlias = tuple[str, int, bool]  # road, section, whether it runs along the road
_CARS = frozenset(("all", "car", "autonomousTraffic", "motorVehicle"))


@dataclass(frozen=True)
class Piece:
    """Part of a lane: travel enters at `begin` and leaves at `end`, distances on its road [m]."""

    key: LaneKey
    begin: float
    end: float

    @property
    def length(self) -> float:
        """Length along the reference line [m]."""
        return abs(self.end - self.begin)


@dataclass
class LaneRun:
    """A lane of the map: pieces in the direction of travel, and the roadblock it lies in.

    `index` counts from the left within the roadblock.
    """

    pieces: list[Piece]
    block: int
    index: int


@dataclass
class ConnectorRun:
    """A lane connector: pieces in the direction of travel, from one lane to another."""

    pieces: list[Piece]  # in the direction of travel
    source: int  # lane it comes from
    target: int  # lane it leads to
    junctions: frozenset[str] = frozenset()  # openDRIVE junctions it lies in; empty for a seam


@dataclass
class LaneGraph:
    """Lanes and connectors of the map."""

    lanes: list[LaneRun] = field(default_factory=list)  # those of a roadblock follow each other
    connectors: list[ConnectorRun] = field(default_factory=list)
    # drivable lanes that are part of neither: short, narrow, or dead ends in junctions
    dropped: list[Piece] = field(default_factory=list)


def is_drivable(lane: Lane) -> bool:
    """Whether cars may drive on a lane."""
    if lane.type not in DRIVABLE:
        return False
    denied = {what for rule, what in lane.access if rule == "deny"}
    allowed = {what for rule, what in lane.access if rule == "allow"}
    return not (denied & _CARS) and (not allowed or bool(allowed & _CARS))


def road_order(road: str) -> tuple[int, int, str]:
    """Sorting key of a road id: numbers by value, then other names."""
    return (0, int(road), "") if road.isdecimal() else (1, 0, road)


def build_lane_graph(od: OpenDrive, warnings: Counter[str]) -> LaneGraph:
    """Lanes, roadblocks and connectors of a file; counts what was inferred or dropped."""
    return _Builder(od, warnings).build()


class _Builder:
    def __init__(self, od: OpenDrive, warnings: Counter[str]) -> None:
        self.od = od
        self.warnings = warnings
        self.nodes: dict[LaneKey, Piece] = {}
        self.gates: dict[LaneKey, tuple[FloatArray, FloatArray]] = {}  # first and last cross-line
        self.after: dict[LaneKey, set[LaneKey]] = defaultdict(set)
        self.before: dict[LaneKey, set[LaneKey]] = defaultdict(set)
        self.graph = LaneGraph()

    def build(self) -> LaneGraph:
        narrow = self._collect_nodes()
        for source, target in lane_links(self.od, self.warnings):
            if source in self.nodes and target in self.nodes:
                self._join(source, target)
        self._infer_links()
        for key in sorted(narrow):
            self._link_through(key)
        self._drop_wide_gaps()
        self._build_lanes()
        self._cut_seams()
        self._build_connectors()
        return self.graph

    def _join(self, source: LaneKey, target: LaneKey) -> None:
        self.after[source].add(target)
        self.before[target].add(source)

    def _part(self, source: LaneKey, target: LaneKey) -> None:
        self.after[source].discard(target)
        self.before[target].discard(source)

    def _collect_nodes(self) -> list[LaneKey]:
        """Fill nodes and gates; returns the lanes that are too short or too narrow to keep."""
        unfit = []
        for road in self.od.roads.values():
            line = ReferenceLine(road.geometries)
            for index, section in enumerate(road.sections):
                begin, end = section.s, road.section_end(index)
                s = np.linspace(begin, end, 9)
                borders = section_borders(road, index, s, repair=True)
                poses = line.evaluate(s[[0, -1]])
                for number, lane in section.lanes.items():
                    if not is_drivable(lane):
                        continue
                    key = LaneKey(road.id, index, number)
                    inner, outer = borders.inner[number], borders.outer[number]
                    left, right = poses.offset(inner[[0, -1]]), poses.offset(outer[[0, -1]])
                    gates = [np.stack([left[i], right[i]]) for i in (0, 1)]
                    forward = runs_forward(road, index, number)
                    self.nodes[key] = Piece(key, begin, end) if forward else Piece(key, end, begin)
                    self.gates[key] = (gates[0], gates[1]) if forward else (gates[1], gates[0])
                    widest = float(np.abs(outer - inner).max())
                    if end - begin < MIN_LENGTH or widest < MIN_WIDTH:
                        unfit.append(key)
                    if widest > 15.0:
                        self.warnings["driving lane wider than 15 m"] += 1
        return unfit

    def _infer_links(self) -> None:
        """Links between sections of a road that the file forgot: same number, same place."""
        inferred = 0
        for key in self.nodes:
            onward = LaneKey(key.road, key.section + 1, key.lane)
            if onward not in self.nodes:
                continue
            is_forward = self._is_forward(key)
            source, target = (key, onward) if is_forward else (onward, key)
            linked = self.after[source] or self.before[target]
            if linked or self._is_forward(onward) != is_forward:
                continue
            if np.abs(self.gates[source][1] - self.gates[target][0]).max() < INFER_GAP:
                self._join(source, target)
                inferred += 1
        if inferred:
            self.warnings["lane link missing between sections, inferred"] += inferred

    def _is_forward(self, key: LaneKey) -> bool:
        return runs_forward(self.od.roads[key.road], key.section, key.lane)

    def _link_through(self, key: LaneKey) -> None:
        """Take a lane out and join what lies before it to what follows (nuPlan rule 514)."""
        sources, targets = sorted(self.before[key]), sorted(self.after[key])
        for source in sources:
            self._part(source, key)
        for target in targets:
            self._part(key, target)
        for source, target in product(sources, targets):
            if source != target:
                self._join(source, target)
        self.graph.dropped.append(self.nodes.pop(key))
        what = "drivable lane shorter than 0.1 m or narrower than 0.5 m, linked through"
        self.warnings[what] += 1

    def _drop_wide_gaps(self) -> None:
        pairs = [(a, b) for a in sorted(self.nodes) for b in sorted(self.after[a])]
        if not pairs:
            return
        ends = shapely.linestrings(np.stack([self.gates[a][1] for a, _ in pairs]))
        starts = shapely.linestrings(np.stack([self.gates[b][0] for _, b in pairs]))
        for (a, b), gap in zip(pairs, shapely.distance(ends, starts), strict=True):
            if gap > MAX_GAP:
                self._part(a, b)
                self.warnings[f"lane link over a gap of more than {MAX_GAP:g} m, dropped"] += 1
            elif gap > SNAP_GAP:
                self.warnings[f"lane link over a gap of more than {SNAP_GAP:g} m"] += 1

    def _in_junction(self, key: LaneKey) -> bool:
        return self.od.roads[key.road].junction is not None

    def _group_of(self, key: LaneKey) -> _Group:
        return key.road, key.section, self._is_forward(key)

    def _build_lanes(self) -> None:
        groups: dict[_Group, list[LaneKey]] = defaultdict(list)
        for key in self.nodes:
            if not self._in_junction(key):
                groups[self._group_of(key)].append(key)
        for (_, _, forward), keys in groups.items():  # leftmost first, seen in travel direction
            keys.sort(key=lambda key: -key.lane if forward else key.lane)
        order = sorted(groups, key=lambda g: (road_order(g[0]), g[1], g[2]))
        onward = {g: h for g in order if (h := self._continuation(groups[g], groups)) is not None}
        has_previous = set(onward.values())
        placed: set[_Group] = set()
        block = 0
        for first in [g for g in order if g not in has_previous] + order:
            if first in placed:
                continue
            chain = [first]
            placed.add(first)
            while (g := onward.get(chain[-1])) is not None and g not in placed:
                chain.append(g)
                placed.add(g)
            for index in range(len(groups[first])):
                pieces = [self.nodes[groups[g][index]] for g in chain]
                self.graph.lanes.append(LaneRun(pieces, block, index))
            block += 1

    def _continuation(
        self, keys: list[LaneKey], groups: dict[_Group, list[LaneKey]]
    ) -> _Group | None:
        """The group that continues a group lane by lane, or None."""
        if any(len(self.after[key]) != 1 for key in keys):
            return None
        targets = [next(iter(self.after[key])) for key in keys]
        if self._in_junction(targets[0]):
            return None
        group = self._group_of(targets[0])
        is_group = groups[group] == targets and group != self._group_of(keys[0])
        follow = all(self.before[t] == {k} for k, t in zip(keys, targets, strict=True))
        return group if is_group and follow else None

    def _cut_seams(self) -> None:
        """Short connectors between lanes that no junction joins (nuPlan rule 504)."""
        lanes = self.graph.lanes
        by_first = {lane.pieces[0].key: i for i, lane in enumerate(lanes)}
        links: dict[int, list[tuple[int, int]]] = defaultdict(list)
        for number, lane in enumerate(lanes):
            for onward in sorted(self.after[lane.pieces[-1].key]):
                if onward in by_first:
                    links[lane.block].append((number, by_first[onward]))
        lengths = [sum(piece.length for piece in lane.pieces) for lane in lanes]
        for block in sorted(links):
            shortest = min(lengths[i] for pair in links[block] for i in pair)
            cut = min(SEAM_LENGTH, SEAM_SHARE * shortest)
            tails = {}
            for number in sorted({number for number, _ in links[block]}):
                lanes[number].pieces, tails[number] = split_pieces(
                    lanes[number].pieces, lengths[number] - cut
                )
            for number, target in links[block]:
                self.graph.connectors.append(ConnectorRun(list(tails[number]), number, target))

    def _build_connectors(self) -> None:
        by_first = {lane.pieces[0].key: i for i, lane in enumerate(self.graph.lanes)}
        used: set[LaneKey] = set()
        last_keys = [lane.pieces[-1].key for lane in self.graph.lanes]
        for source, last in enumerate(last_keys):
            stack: list[tuple[LaneKey, ...]] = [
                (target,) for target in sorted(self.after[last], reverse=True)
            ]
            steps = 0
            while stack:
                path = stack.pop()
                steps += 1
                if steps > _MAX_STEPS:
                    self.warnings["junction with too many ways through, the rest is left out"] += 1
                    break
                if not self._in_junction(path[-1]):
                    if len(path) > 1:
                        self._add_connector(source, by_first[path[-1]], path[:-1])
                        used.update(path)
                    continue
                if len(path) < _MAX_CHAIN:
                    onward = sorted(self.after[path[-1]], reverse=True)
                    stack += [(*path, target) for target in onward if target not in path]
        for key in sorted(self.nodes):
            if self._in_junction(key) and key not in used:
                self.warnings["connector without both ends, dropped"] += 1
                self.graph.dropped.append(self.nodes[key])

    def _add_connector(self, source: int, target: int, path: Sequence[LaneKey]) -> None:
        junctions = {self.od.roads[key.road].junction for key in path}
        inside = frozenset(junction for junction in junctions if junction is not None)
        pieces = [self.nodes[key] for key in path]
        self.graph.connectors.append(ConnectorRun(pieces, source, target, inside))


def split_pieces(pieces: list[Piece], at: float) -> tuple[list[Piece], list[Piece]]:
    """Cut pieces at a distance from their start [m], measured along the reference lines."""
    head: list[Piece] = []
    for number, piece in enumerate(pieces):
        if at >= piece.length and number + 1 < len(pieces):
            head.append(piece)
            at -= piece.length
            continue
        cut = piece.begin + np.sign(piece.end - piece.begin) * at
        tail = [replace(piece, begin=float(cut)), *pieces[number + 1 :]]
        if at > 0:
            head.append(replace(piece, end=float(cut)))
        return head, tail
    return head, []
