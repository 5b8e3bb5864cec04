"""A lane graph to a map: ids, links, roadblocks, intersections, whatever the source of the lanes.

`MapBuilder` asks a source only how its segments are shaped, and what governs traffic on them.
"""

from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, pairwise
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
import shapely

from shiftsim.data.maps.opendrive.areas import merge_closed
from shiftsim.data.maps.opendrive.overlaps import subtract_overlaps
from shiftsim.data.maps.opendrive.shapes import bend_ends, corners, lane_polygon, unfold_borders
from shiftsim.data.maps.topology import Connector, Lane, LaneGraph, S
from shiftsim.data.polygons import largest_part
from shiftsim.errors import FAILED
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap

LIGHT_KIND, STOP_SIGN_KIND, PASS_THROUGH = 1, 2, 5  # kinds of intersections
T = TypeVar("T")
_Spec = TypeVar("_Spec", EdgeSpec, BlockSpec, AreaSpec)
Pairs: TypeAlias = set[tuple[int, int]]
_CLOSING = 0.5  # m
_KINK, _END_GAP = 0.8, 0.3  # rad, and m, beyond which a baseline cannot be driven
_STRAIGHT_TURN, _U_TURN = np.deg2rad(30.0), np.deg2rad(150.0)


@dataclass(frozen=True)
class BuiltMap:
    """A map, and what became of its source."""

    road: VectorMap
    warnings: dict[str, int]  # what was repaired, inferred or left out: count by kind
    # by connector that has one: the name of its light
    lights: Mapping[str, str] = field(default_factory=dict)
    # by lane or connector: the segments of the source that it was made of, in order
    segments: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    # ids of pairs of lanes, and of roadblocks, that lie over each other on different levels
    stacked: frozenset[tuple[str, str]] = frozenset()


@dataclass(frozen=True)
class StopArea:
    """A stop polygon of a source."""

    polygon: shapely.Polygon  # its area
    kind: int  # type number of a stop polygon, as nuPlan counts them
    before: str | int | None = None  # piece or lane that ends at it; None: found by its place


class _Shape(NamedTuple):
    """A lane or connector of the graph, in the direction of travel."""

    left: FloatArray  # (K, 2) left border [m]
    right: FloatArray  # (K', 2) right border [m]
    baseline: FloatArray  # (K'', 2) [m]
    polygon: shapely.Polygon  # its area


class MapBuilder(ABC, Generic[S]):
    """Makes the map of a lane graph, with one series of ids for all of its parts."""

    larger: str  # what the lane is, of two that overlap, that gives way: bigger or longer
    lights: Sequence[str | None]  # light of each connector: its name, empty where unknown; or None
    stop_signs: Sequence[bool]  # whether a stop sign governs each connector

    def __init__(self, graph: LaneGraph[S], shaper: Any, warnings: Counter[str]) -> None:
        """`shaper` has `joined_borders` and `baseline`; `warnings` count what is repaired."""
        self.graph, self.shaper, self.warnings = graph, shaper, warnings
        lanes = graph.lanes
        # roadblocks that each connector comes from and leads to
        self.block_pairs = [
            (lanes[c.source].block, lanes[c.target].block) for c in graph.connectors
        ]
        self._next_id = map(str, count(1))

    def connector_borders(self, connector: Connector[S]) -> tuple[FloatArray, FloatArray]:
        """Left and right border (K, 2), (K', 2) of a connector [m]."""
        left, right = self.shaper.joined_borders(connector.segments)
        return left, right

    @abstractmethod
    def speed_limits(self, segment: S) -> Iterable[tuple[float | None, float]]:
        """Limits on a segment [m/s], None for none, and the length over which each holds [m]."""

    def stacked_lanes(self, polygons: Sequence[shapely.Polygon]) -> Pairs:
        """Pairs i < j of lanes that lie on different levels."""
        return set()

    def are_adjacent(self, left: Lane[S], right: Lane[S]) -> bool:
        """Whether two lanes touch that follow each other in a roadblock."""
        return True

    @abstractmethod
    def stop_areas(self, lanes: Sequence[shapely.Polygon]) -> Sequence[StopArea]:
        """Stop polygons; `lanes` are the areas of the lanes."""

    @abstractmethod
    def stops_of(self, number: int, before: FloatArray, line: FloatArray) -> Sequence[int]:
        """Stop polygons of a connector, by its baseline and that of the lane before it."""

    @abstractmethod
    def groups(self, connectors: Sequence[shapely.Polygon]) -> IntArray:
        """Number of the intersection of each connector, 0 and up."""

    @abstractmethod
    def areas(
        self, edges: Sequence[shapely.Polygon], intersections: Sequence[AreaSpec]
    ) -> dict[str, Sequence[shapely.Polygon]]:
        """Layers without links; `edges` are the areas of all lanes and connectors."""

    def build(self, name: str, *, epsg: int = 0, offset: FloatArray | None = None) -> BuiltMap:
        """The map, moved by `offset` (2,) [m]."""
        graph = self.graph
        self._shape_lanes()
        self.stops = self.stop_areas([lane.polygon for lane in self._lanes])
        self._connectors = [self._shape_connector(connector) for connector in graph.connectors]
        self._groups = self.groups([c.polygon for c in self._connectors]).tolist()
        self._lane_ids = self._new_ids(len(graph.lanes))
        self._connector_ids = self._new_ids(len(graph.connectors))
        self._block_ids = self._new_ids(max((lane.block for lane in graph.lanes), default=-1) + 1)
        pairs = sorted(set(self.block_pairs))
        self._pair_ids = dict(zip(pairs, self._new_ids(len(pairs)), strict=True))
        self._group_ids = self._new_ids(max(self._groups, default=-1) + 1)
        self._stop_ids = self._new_ids(len(self.stops))
        edges = [*self._lane_specs(), *self._connector_specs()]
        blocks = [*self._roadblocks(), *self._roadblock_connectors()]
        layers = {"intersections": list(self._intersections())}
        stops = zip(self._stop_ids, self.stops, strict=True)
        layers["stop_polygons"] = [AreaSpec(i, stop.polygon, stop.kind) for i, stop in stops]
        polygons = [edge.polygon for edge in edges]
        for layer, shapes in self.areas(polygons, layers["intersections"]).items():
            layers[layer] = [AreaSpec(next(self._next_id), shape) for shape in shapes]
        road = build_map(
            name,
            edges=_moved(edges, offset),
            blocks=_moved(blocks, offset),
            epsg=epsg,
            **{layer: _moved(specs, offset) for layer, specs in layers.items()},
        )
        return self._report(road)

    def _report(self, road: VectorMap) -> BuiltMap:
        self.warnings.update(line_faults(road))
        stacked = {(self._lane_ids[i], self._lane_ids[j]) for i, j in self._stacked}
        stacked |= {(self._block_ids[a], self._block_ids[b]) for a, b in self._stacked_blocks()}
        runs = [lane.segments for lane in self.graph.lanes]
        runs += [connector.segments for connector in self.graph.connectors]
        segments = dict(zip([*self._lane_ids, *self._connector_ids], runs, strict=True))
        named = zip(self._connector_ids, self.lights, strict=True)
        lights = {i: light for i, light in named if light}
        return BuiltMap(road, dict(self.warnings), lights, segments, frozenset(stacked))

    def _stacked_blocks(self) -> Pairs:
        blocks = [lane.block for lane in self.graph.lanes]
        pairs = [(blocks[i], blocks[j]) for i, j in self._stacked]
        return {(min(pair), max(pair)) for pair in pairs}

    def _new_ids(self, number: int) -> list[str]:
        return [next(self._next_id) for _ in range(number)]

    def _shape_lanes(self) -> None:
        borders: list[tuple[FloatArray, FloatArray]]
        borders = [self.shaper.joined_borders(lane.segments) for lane in self.graph.lanes]
        polygons = [lane_polygon(*pair) for pair in borders]
        borders = [unfold_borders(*b, area) for b, area in zip(borders, polygons, strict=True)]
        self._stacked = self.stacked_lanes(polygons)
        lengths = [sum(s.length for s in lane.segments) for lane in self.graph.lanes]
        sizes = lengths if self.larger == "longer" else [area.area for area in polygons]
        polygons, overlaps = subtract_overlaps(polygons, sizes, self._stacked)
        if overlaps:
            self.warnings[f"overlap of two lanes, taken from the {self.larger} one"] += overlaps
        self._lanes = [
            _Shape(*pair, self.shaper.baseline(lane.segments), polygon)
            for pair, lane, polygon in zip(borders, self.graph.lanes, polygons, strict=True)
        ]

    def _shape_connector(self, connector: Connector[S]) -> _Shape:
        borders = self.connector_borders(connector)
        before, after = (self._lanes[i].baseline for i in (connector.source, connector.target))
        line = self.shaper.baseline(connector.segments, before[-1], after[0])
        area = lane_polygon(*borders)
        return _Shape(*unfold_borders(*borders, area), bend_ends(line, before, after), area)

    def _lane_specs(self) -> Iterator[EdgeSpec]:
        lanes = self.graph.lanes
        outgoing, incoming = defaultdict(list), defaultdict(list)
        for connector_id, connector in zip(self._connector_ids, self.graph.connectors, strict=True):
            outgoing[connector.source].append(connector_id)
            incoming[connector.target].append(connector_id)
        # neighbours share a border
        borders: dict[tuple[int, int], str] = defaultdict(lambda: next(self._next_id))
        left_lane, right_lane = dict[int, str](), dict[int, str]()
        for number, (left, right) in enumerate(pairwise(lanes)):
            if left.block == right.block and self.are_adjacent(left, right):
                left_lane[number + 1] = self._lane_ids[number]
                right_lane[number] = self._lane_ids[number + 1]
        for number, (lane, shape) in enumerate(zip(lanes, self._lanes, strict=True)):
            yield EdgeSpec(
                **shape._asdict(),
                id=self._lane_ids[number],
                is_connector=False,
                speed_limit=self._speed_limit(lane.segments),
                block_id=self._block_ids[lane.block],
                incoming=incoming[number],
                outgoing=outgoing[number],
                left_id=borders[lane.block, lane.index],
                right_id=borders[lane.block, lane.index + 1],
                lane_index=lane.index,
                left_lane=left_lane.get(number),
                right_lane=right_lane.get(number),
            )

    def _connector_specs(self) -> Iterator[EdgeSpec]:
        for number, shape in enumerate(self._connectors):
            connector = self.graph.connectors[number]
            left_id, right_id = self._new_ids(2)
            stops = self.stops_of(number, self._lanes[connector.source].baseline, shape.baseline)
            yield EdgeSpec(
                **shape._asdict(),
                id=self._connector_ids[number],
                is_connector=True,
                speed_limit=self._speed_limit(connector.segments),
                block_id=self._pair_ids[self.block_pairs[number]],
                incoming=[self._lane_ids[connector.source]],
                outgoing=[self._lane_ids[connector.target]],
                left_id=left_id,
                right_id=right_id,
                intersection_id=self._group_ids[self._groups[number]],
                has_traffic_lights=self.lights[number] is not None,
                stop_lines=[self._stop_ids[i] for i in stops],
                turn_type=turn_type(shape.baseline),
            )

    def _speed_limit(self, segments: Sequence[S]) -> float | None:
        """The limit on most of a lane (nuPlan rule 507), the lower one on ties [m/s]."""
        lengths: dict[float, float] = defaultdict(float)
        for segment in segments:
            for limit, length in self.speed_limits(segment):
                lengths[np.inf if limit is None else limit] += length
        best = min(lengths, key=lambda limit: (-round(lengths[limit], 6), limit), default=np.inf)
        return None if np.isinf(best) else best

    def _roadblocks(self) -> Iterator[BlockSpec]:
        members = _grouped(lane.block for lane in self.graph.lanes)
        order = sorted(members)
        polygons = [self._roadblock_polygon(members[block]) for block in order]
        areas = [polygon.area for polygon in polygons]
        polygons, _ = subtract_overlaps(polygons, areas, self._stacked_blocks())
        for block, polygon in zip(order, polygons, strict=True):
            yield BlockSpec(
                id=self._block_ids[block],
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
        members = _grouped(self.block_pairs)
        for pair, block_id in self._pair_ids.items():
            numbers = members[pair]
            yield BlockSpec(
                id=block_id,
                is_connector=True,
                polygon=self._merged(numbers, 0.1),
                incoming=[self._block_ids[pair[0]]],
                outgoing=[self._block_ids[pair[1]]],
                intersection_id=self._group_ids[self._groups[numbers[0]]],
            )

    def _intersections(self) -> Iterator[AreaSpec]:
        for group, numbers in sorted(_grouped(self._groups).items()):
            area = shapely.Polygon(self._merged(numbers, _CLOSING).exterior)
            yield AreaSpec(self._group_ids[group], area, self._kind(numbers))

    def _kind(self, numbers: Sequence[int]) -> int:
        """Kind of the intersection of some connectors."""
        if any(self.lights[i] is not None for i in numbers):
            return LIGHT_KIND
        if any(self.stop_signs[i] for i in numbers):
            return STOP_SIGN_KIND
        return 0 if any(self.graph.connectors[i].junctions for i in numbers) else PASS_THROUGH

    def _merged(self, numbers: Sequence[int], radius: float) -> shapely.Polygon:
        return merge_closed([self._connectors[i].polygon for i in numbers], radius)


def line_faults(road: VectorMap) -> dict[str, int]:
    """What is wrong with the baselines of a map: count by kind."""
    lines = [line[:, :2] for line in map(road.baselines.at, range(len(road.edges)))]
    pairs = [(i, int(j)) for i in range(len(road.edges)) for j in road.outgoing.at(i)]
    gaps = [float(np.hypot(*(lines[i][-1] - lines[j][0]))) for i, j in pairs]
    joints = [np.concatenate([lines[i][-2:], lines[j][:2]]) for i, j in pairs]
    kinks = sum(bool((corners(line)[1] > _KINK).any()) for line in lines)
    bends = sum(bool((corners(joint)[1] > _KINK).any()) for joint in joints)
    found = {
        f"{FAILED}centre line that turns by more than {_KINK:g} rad at a point": kinks,
        f"{FAILED}lanes that meet at an angle of more than {_KINK:g} rad": bends,
        f"{FAILED}lanes that are linked over a gap of more than {_END_GAP:g} m": sum(
            gap > _END_GAP for gap in gaps
        ),
    }
    return {kind: number for kind, number in found.items() if number}


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


def _moved(specs: Iterable[_Spec], offset: FloatArray | None) -> list[_Spec]:
    """Edges, blocks or areas at their place in the world."""
    if offset is None:
        return list(specs)
    out = []
    for spec in specs:
        lines = {name: getattr(spec, name, None) for name in ("baseline", "left", "right")}
        shapes = {name: line + offset for name, line in lines.items() if line is not None}
        polygon = shapely.transform(spec.polygon, lambda xy: xy + offset)
        out.append(replace(spec, polygon=polygon, **shapes))
    return out
