"""Lanes that lie over each other: crossings without a junction, slivers, bridges.

No point may lie inside two lanes. Where lanes cross, both roadblocks
are cut and the pieces in between become connectors of an intersection. Other overlaps are taken
away from the longer lane (nuPlan rule 505). Lanes on different levels stay as they are.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.data.maps.opendrive.graph import Connector, Graph, Lane, LaneSegment
from shiftsim.data.maps.opendrive.lanes import evaluate_cubics
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.maps.opendrive.shapes import Shapes, lane_polygon
from shiftsim.data.maps.topology import split_segments
from shiftsim.data.polygons import largest_part, shared_areas
from shiftsim.kernels import FloatArray

OVERLAP = 1e-6  # m², less is a shared border
LEVEL = 3.0  # m of height between lanes that do not meet, nuPlan rule 512
_CROSSING_ANGLE = np.deg2rad(20.0)  # flatter overlaps are merges, not crossings
_MARGIN, _MIN_LANE = 0.5, 1.0  # m around a crossing; shorter lanes beside it join it
_SAMPLE = 1.0  # m
_MAX_VANISHED = 8  # lanes in a row that lie within crossings


@dataclass(frozen=True)
class Trace:
    """Points along a chain of pieces, to find places on it."""

    xy: FloatArray  # (K, 2) centre points [m]
    distance: FloatArray  # (K,) along the reference lines from the start [m]
    height: FloatArray  # (K,) of the road [m]

    def nearest(self, points: FloatArray) -> list[int]:
        """Index of the nearest point for each of `points` (N, 2)."""
        from scipy.spatial import cKDTree  # takes long to import, and few maps need it

        index: list[int] = cKDTree(self.xy).query(points)[1].tolist()
        return index

    def heading(self, index: int) -> float:
        """Direction of the chain at a point [rad]."""
        last = len(self.xy) - 1
        step = self.xy[min(index + 1, last)] - self.xy[max(index - 1, 0)]
        return float(np.arctan2(step[1], step[0]))


def overlapping(polygons: Sequence[shapely.Polygon]) -> list[tuple[int, int]]:
    """Pairs (i, j), i < j, of polygons that share more than a border."""
    return [pair for pair, area in shared_areas(polygons).items() if area > OVERLAP]


class Levels:
    """Tells which chains of pieces pass over each other; each chain is traced once."""

    def __init__(
        self,
        od: OpenDrive,
        shapes: Shapes,
        chains: Sequence[Sequence[LaneSegment]],
        polygons: Sequence[shapely.Polygon],
    ) -> None:
        self._od, self._shapes, self._chains, self._polygons = od, shapes, chains, polygons
        self._traces: dict[int, Trace] = {}
        self._is_flat = not any(road.elevation[:, 1:].any() for road in od.roads.values())

    def trace(self, chain: int) -> Trace:
        """Points along one chain, one per metre."""
        if chain in self._traces:
            return self._traces[chain]
        parts, done = [], 0.0
        for piece in self._chains[chain]:
            share = np.linspace(0.0, 1.0, max(int(np.ceil(piece.length / _SAMPLE)), 1) + 1)
            s = piece.begin + share * (piece.end - piece.begin)
            height = evaluate_cubics(self._od.roads[piece.key.road].elevation, s, s)
            parts.append((self._shapes.centers(piece, s), done + share * piece.length, height))
            done += piece.length
        self._traces[chain] = Trace(*map(np.concatenate, zip(*parts, strict=True)))
        return self._traces[chain]

    def region(self, first: int, second: int) -> shapely.Geometry:
        """The common area of two chains."""
        return shapely.intersection(self._polygons[first], self._polygons[second])

    def _middles(self, first: int, second: int) -> list[tuple[Trace, int]]:
        """Each of two chains, with its point next to the middle of their common area."""
        middle = self.region(first, second).centroid
        point = np.array([[middle.x, middle.y]])
        return [(t, t.nearest(point)[0]) for t in (self.trace(first), self.trace(second))]

    def are_stacked(self, first: int, second: int) -> bool:
        """Whether two chains pass their common area on different levels."""
        if self._is_flat:
            return False
        (one, i), (other, j) = self._middles(first, second)
        return bool(abs(one.height[i] - other.height[j]) > LEVEL)

    def cross(self, first: int, second: int) -> bool:
        """Whether two chains cross at an angle, on one level."""
        (one, i), (other, j) = self._middles(first, second)
        angle = abs((one.heading(i) - other.heading(j) + np.pi) % (2 * np.pi) - np.pi)
        is_steep = _CROSSING_ANGLE < angle < np.pi - _CROSSING_ANGLE
        return is_steep and not self.are_stacked(first, second)


def cut_crossings(od: OpenDrive, graph: Graph, shapes: Shapes) -> tuple[Graph, int]:
    """The graph with intersections where lanes cross on one level, and how many pairs cross."""
    polygons = [lane_polygon(*shapes.joined_borders(lane.segments)) for lane in graph.lanes]
    levels = Levels(od, shapes, [lane.segments for lane in graph.lanes], polygons)
    intervals: dict[int, list[tuple[float, float]]] = defaultdict(list)
    crossings = 0
    for pair in overlapping(polygons):
        if graph.lanes[pair[0]].block == graph.lanes[pair[1]].block:
            continue
        if not levels.cross(*pair):
            continue
        crossings += 1
        corners = shapely.get_coordinates(levels.region(*pair))
        for lane in pair:
            points = levels.trace(lane)
            along = points.distance[points.nearest(corners)]
            span = float(along.min()) - _MARGIN, float(along.max()) + _MARGIN
            intervals[graph.lanes[lane].block].append(span)
    return (_cut_graph(graph, intervals) if crossings else graph), crossings


class _Cut(NamedTuple):
    """What becomes of a lane: lanes that are left of it, and what lies in crossings."""

    lanes: list[tuple[int, list[LaneSegment]]]  # which part of its roadblock each is, and segments
    # before, between and after these lanes; all of the lane where none is left
    crossed: list[list[LaneSegment]]


def _cut_lane(lane: Lane, spans: Sequence[tuple[float, float]]) -> _Cut:
    length = sum(piece.length for piece in lane.segments)
    spans = _merge(spans, length)
    if not spans:
        return _Cut([(0, lane.segments)], [[], []])
    stops = [0.0, *(stop for span in spans for stop in span), length]
    parts = enumerate(zip(stops[::2], stops[1::2], strict=True))
    free = [(part, begin, end) for part, (begin, end) in parts if end > begin]
    if not free:
        return _Cut([], [lane.segments])
    lanes = [(part, _pieces_between(lane.segments, *ends)) for part, *ends in free]
    begins, ends = [0.0, *(end for *_, end in free)], [*(begin for _, begin, _ in free), length]
    gaps = zip(begins, ends, strict=True)
    return _Cut(lanes, [_pieces_between(lane.segments, *gap) for gap in gaps])


def _cut_graph(graph: Graph, intervals: dict[int, list[tuple[float, float]]]) -> Graph:
    """The graph with its roadblocks cut at intervals; what lies in them becomes connectors."""
    cuts = [_cut_lane(lane, intervals.get(lane.block, [])) for lane in graph.lanes]
    blocks: dict[tuple[int, int], int] = {}
    lanes: list[Lane] = []
    inner: list[Connector] = []
    ends: dict[int, tuple[int, int]] = {}  # first and last new lane of an old one
    for number, (lane, cut) in enumerate(zip(graph.lanes, cuts, strict=True)):
        first = len(lanes)
        for part, pieces in cut.lanes:
            block = blocks.setdefault((lane.block, part), len(blocks))
            lanes.append(Lane(pieces, block, lane.index))
        for k, ((part, _), pieces) in enumerate(zip(cut.lanes[1:], cut.crossed[1:], strict=False)):
            label = frozenset({f"crossing before part {part} of block {lane.block}"})
            inner.append(Connector(pieces, first + k, first + k + 1, label))
        if cut.lanes:
            ends[number] = first, len(lanes) - 1
    outer = [
        replace(connector, source=ends[connector.source][1], target=ends[connector.target][0])
        for connector in _outer_connectors(graph.connectors, cuts)
    ]
    sources, targets = {c.source for c in outer}, {c.target for c in outer}
    dropped = list(graph.dropped)  # part of the drivable area in any case
    for number, (first, last) in ends.items():
        dropped += cuts[number].crossed[0] if first not in targets else []
        dropped += cuts[number].crossed[-1] if last not in sources else []
    dropped += [piece for cut in cuts if not cut.lanes for piece in cut.crossed[0]]
    order = sorted(range(len(lanes)), key=lambda i: (lanes[i].block, i))
    place = {old: new for new, old in enumerate(order)}
    connectors = [
        replace(c, source=place[c.source], target=place[c.target]) for c in (*outer, *inner)
    ]
    return Graph([lanes[i] for i in order], connectors, dropped)


def _outer_connectors(connectors: Sequence[Connector], cuts: Sequence[_Cut]) -> Iterator[Connector]:
    """Connectors between lanes that are left, longer where these were cut at their ends."""
    onward: dict[int, list[Connector]] = defaultdict(list)
    for connector in connectors:
        onward[connector.source].append(connector)

    def extend(connector: Connector, passed: tuple[int, ...] = ()) -> Iterator[Connector]:
        """A connector up to the next lane that is left, through lanes that vanished."""
        cut, pieces, lane = cuts[connector.target], connector.segments, connector.target
        if cut.lanes:
            yield replace(connector, segments=[*pieces, *cut.crossed[0]])
            return
        for following in onward[lane]:
            if following.target not in passed and len(passed) < _MAX_VANISHED:
                label = connector.junctions | following.junctions | {f"crossing over lane {lane}"}
                longer = [*pieces, *cut.crossed[0], *following.segments]
                longest = Connector(longer, connector.source, following.target, label)
                yield from extend(longest, (*passed, following.target))

    for connector in connectors:
        if cuts[connector.source].lanes:
            pieces = [*cuts[connector.source].crossed[-1], *connector.segments]
            yield from extend(replace(connector, segments=pieces))


def _merge(spans: Sequence[tuple[float, float]], length: float) -> list[tuple[float, float]]:
    """Spans within a lane, in order, without lanes too short to stay between them."""
    merged: list[tuple[float, float]] = []
    for begin, end in sorted(spans):
        begin = 0.0 if begin < _MIN_LANE else begin
        end = length if end > length - _MIN_LANE else end
        if begin >= length or end <= 0.0:
            continue
        if merged and begin - merged[-1][1] < _MIN_LANE:
            merged[-1] = (merged[-1][0], max(end, merged[-1][1]))
        else:
            merged.append((begin, end))
    return merged


def _pieces_between(pieces: list[LaneSegment], begin: float, end: float) -> list[LaneSegment]:
    if end <= begin:
        return []
    _, tail = split_segments(pieces, begin)
    return split_segments(tail, end - begin)[0]


def subtract_overlaps(
    polygons: Sequence[shapely.Polygon], lengths: Sequence[float], stacked: set[tuple[int, int]]
) -> tuple[list[shapely.Polygon], int]:
    """Polygons without overlaps, which go to the shorter of two unless `stacked`; how many."""
    out = list(polygons)
    pairs = [pair for pair in overlapping(polygons) if pair not in stacked]
    for i, j in pairs:
        longer, other = (i, j) if lengths[i] >= lengths[j] else (j, i)
        for loser, keeper in ((longer, other), (other, longer)):
            rest = largest_part(out[loser].difference(out[keeper]))
            if rest.area > 0.01:
                out[loser] = rest
                break
    return out, len(pairs)
