"""OpenDRIVE to the semantic map of nuPlan's kind."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TypeVar

import numpy as np
import shapely

from shiftsim.arrays import FloatArray
from shiftsim.data.opendrive import areas, control
from shiftsim.data.opendrive.check import check_map
from shiftsim.data.opendrive.control import LIGHT, STOP, YIELD
from shiftsim.data.opendrive.graph import LaneGraph, Piece, build_lane_graph
from shiftsim.data.opendrive.lanes import LaneKey
from shiftsim.data.opendrive.overlaps import Levels, cut_crossings, overlapping, subtract_overlaps
from shiftsim.data.opendrive.preparation import prepare
from shiftsim.data.opendrive.records import OpenDrive
from shiftsim.data.opendrive.shapes import Shapes, bend_ends, lane_polygon, widen
from shiftsim.data.polygons import largest_part
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap

LIGHT_KIND, STOP_SIGN_KIND, PASS_THROUGH = 1, 2, 5  # kinds of intersections
STOP_KINDS = {LIGHT: 2, STOP: 1, YIELD: 4}  # kinds of stop polygons
_Spec = TypeVar("_Spec", EdgeSpec, BlockSpec, AreaSpec)
_STRAIGHT_TURN, _U_TURN = np.deg2rad(30.0), np.deg2rad(150.0)


@dataclass(frozen=True)
class Origin:
    """Where an edge of the map comes from: its id, and one piece of one OpenDRIVE lane."""

    id: str
    key: LaneKey
    begin: float
    end: float


@dataclass(frozen=True)
class MapReport:
    """What the conversion did."""

    warnings: dict[str, int]  # what was repaired, inferred or left out: count by kind
    origins: tuple[Origin, ...]  # pieces of OpenDRIVE lanes behind every lane and connector
    checks: dict[str, bool] = field(default_factory=dict)  # self-checks: whether the map passes
    figures: dict[str, float] = field(default_factory=dict)  # numbers behind the checks


def build_road_map(
    od: OpenDrive,
    *,
    name: str,
    offset: tuple[float, float] = (0.0, 0.0),
    epsg: int = 0,
    country: str = "DE",
) -> tuple[VectorMap, MapReport]:
    """The semantic map of an OpenDRIVE file.

    Args:
        od: The file.
        name: Name of the map.
        offset: Added to all coordinates: UTM position of the local origin [m].
        epsg: Code of the coordinate system that results; 0 for a local frame.
        country: Whose default speed limits hold where the file has none.

    Returns:
        The map, without lanes where the file has none that cars may use, and the report.

    Raises:
        MapError: The file has more road than one map can hold.
    """
    warnings = Counter(od.warnings)
    placed = prepare(od, warnings)
    graph = build_lane_graph(placed, warnings)
    return _Maker(placed, graph, warnings, country).build(name, np.array(offset), epsg)


def _chains(graph: LaneGraph) -> list[list[Piece]]:
    return [lane.pieces for lane in graph.lanes] + [c.pieces for c in graph.connectors]


def _shapes_of(od: OpenDrive, graph: LaneGraph) -> Shapes:
    return Shapes(od, [*chain.from_iterable(_chains(graph)), *graph.dropped])


class _Maker:
    def __init__(
        self, od: OpenDrive, graph: LaneGraph, warnings: Counter[str], country: str
    ) -> None:
        self.od, self.warnings, self.country = od, warnings, country
        self.shapes = _shapes_of(od, graph)
        self.graph, crossings = cut_crossings(od, graph, self.shapes)
        if crossings:
            warnings["lanes that cross without a junction, made an intersection"] += crossings
            self.shapes = _shapes_of(od, self.graph)
        self._next_id = 0

    def build(self, name: str, offset: FloatArray, epsg: int) -> tuple[VectorMap, MapReport]:
        self._shape_lanes()
        self._shape_connectors()
        self.controls = control.connector_controls(self.od, self.graph)
        self._number()
        edges = [*self._lane_specs(), *self._connector_specs()]
        blocks = [*self._roadblock_specs(), *self._block_connector_specs()]
        layers = self._areas()
        vector_map = build_map(
            name,
            edges=_moved(edges, offset),
            blocks=_moved(blocks, offset),
            epsg=epsg,
            **{layer: _moved(specs, offset) for layer, specs in layers.items()},
        )
        checks, figures = check_map(vector_map, self._stacked_ids())
        report = MapReport(dict(self.warnings), tuple(self._origins()), checks, figures)
        return vector_map, report

    def _stacked_ids(self) -> set[tuple[str, str]]:
        """Pairs of lanes, and of roadblocks, that lie on different levels."""
        pairs = {(self.lane_ids[i], self.lane_ids[j]) for i, j in self.stacked}
        blocks = self._stacked_blocks()
        return pairs | {(self.block_ids[a], self.block_ids[b]) for a, b in blocks}

    def _stacked_blocks(self) -> set[tuple[int, int]]:
        blocks = [lane.block for lane in self.graph.lanes]
        return {(min(blocks[i], blocks[j]), max(blocks[i], blocks[j])) for i, j in self.stacked}

    def _new_ids(self, count: int) -> list[str]:
        first = self._next_id
        self._next_id += count
        return [str(i + 1) for i in range(first, self._next_id)]

    def _shape_lanes(self) -> None:
        self.lane_borders = [self.shapes.joined_borders(lane.pieces) for lane in self.graph.lanes]
        polygons = [lane_polygon(*borders) for borders in self.lane_borders]
        levels = Levels(self.od, self.shapes, [lane.pieces for lane in self.graph.lanes], polygons)
        self.stacked = {pair for pair in overlapping(polygons) if levels.are_stacked(*pair)}
        lengths = [sum(piece.length for piece in lane.pieces) for lane in self.graph.lanes]
        self.lane_polygons, overlaps = subtract_overlaps(polygons, lengths, self.stacked)
        if overlaps:
            self.warnings["overlap of two lanes, taken from the longer one"] += overlaps
        self.lane_lines = [self.shapes.baseline(lane.pieces) for lane in self.graph.lanes]

    def _shape_connectors(self) -> None:
        self.connector_borders, self.connector_polygons, self.connector_lines = [], [], []
        for connector in self.graph.connectors:
            left, right = self.shapes.joined_borders(connector.pieces)
            before = self.shapes.widths(self.graph.lanes[connector.source].pieces)[1]
            after = self.shapes.widths(self.graph.lanes[connector.target].pieces)[0]
            left, right = widen(left, right, min(before, after))
            self.connector_borders.append((left, right))
            self.connector_polygons.append(lane_polygon(left, right))
            source, target = (self.lane_lines[i] for i in (connector.source, connector.target))
            line = self.shapes.baseline(connector.pieces, source[-1], target[0])
            self.connector_lines.append(bend_ends(line, source, target))

    def _number(self) -> None:
        lanes, connectors = self.graph.lanes, self.graph.connectors
        self.lane_ids = self._new_ids(len(lanes))
        self.connector_ids = self._new_ids(len(connectors))
        self.block_ids = self._new_ids(max((lane.block for lane in lanes), default=-1) + 1)
        self.pairs = [(lanes[c.source].block, lanes[c.target].block) for c in connectors]
        pairs = sorted(set(self.pairs))
        self.pair_ids = dict(zip(pairs, self._new_ids(len(pairs)), strict=True))
        levels = Levels(
            self.od, self.shapes, [c.pieces for c in connectors], self.connector_polygons
        )
        self.groups = areas.group_connectors(
            connectors, self.connector_polygons, self.pairs, levels.are_stacked
        )
        self.group_ids = self._new_ids(int(self.groups.max(initial=-1)) + 1)
        self.stop_lines = control.stop_lines(
            self.od, self.graph, self.shapes, self.controls, self.lane_polygons
        )
        self.stop_ids = self._new_ids(len(self.stop_lines))
        self.boundary_ids: dict[tuple[int, int], str] = {}

    def _boundary(self, block: int, index: int) -> str:
        """Id of the border left of lane `index` of a roadblock; neighbours share it."""
        key = block, index
        if key not in self.boundary_ids:
            self.boundary_ids[key] = self._new_ids(1)[0]
        return self.boundary_ids[key]

    def _lane_specs(self) -> Iterator[EdgeSpec]:
        outgoing, incoming = defaultdict(list), defaultdict(list)
        for number, connector in enumerate(self.graph.connectors):
            outgoing[connector.source].append(self.connector_ids[number])
            incoming[connector.target].append(self.connector_ids[number])
        for number, lane in enumerate(self.graph.lanes):
            left, right = self.lane_borders[number]
            yield EdgeSpec(
                id=self.lane_ids[number],
                is_connector=False,
                polygon=self.lane_polygons[number],
                baseline=self.lane_lines[number],
                block_id=self.block_ids[lane.block],
                incoming=incoming[number],
                outgoing=outgoing[number],
                left=left,
                right=right,
                left_id=self._boundary(lane.block, lane.index),
                right_id=self._boundary(lane.block, lane.index + 1),
                speed_limit=control.speed_limit(self.od, lane.pieces, self.country),
                lane_index=lane.index,
                left_lane=self._neighbor(number, -1),
                right_lane=self._neighbor(number, 1),
            )

    def _neighbor(self, number: int, step: int) -> str | None:
        """The lane beside another in its roadblock, where they touch."""
        other, lanes = number + step, self.graph.lanes
        if not 0 <= other < len(lanes) or lanes[other].block != lanes[number].block:
            return None
        numbers = [lanes[i].pieces[0].key.lane for i in (number, other)]
        gap = abs(numbers[0] - numbers[1]) - (1 if numbers[0] * numbers[1] < 0 else 0)
        return self.lane_ids[other] if gap == 1 else None

    def _connector_specs(self) -> Iterator[EdgeSpec]:
        for number, connector in enumerate(self.graph.connectors):
            left, right = self.connector_borders[number]
            left_id, right_id = self._new_ids(2)
            yield EdgeSpec(
                id=self.connector_ids[number],
                is_connector=True,
                polygon=self.connector_polygons[number],
                baseline=self.connector_lines[number],
                block_id=self.pair_ids[self.pairs[number]],
                incoming=[self.lane_ids[connector.source]],
                outgoing=[self.lane_ids[connector.target]],
                left=left,
                right=right,
                left_id=left_id,
                right_id=right_id,
                speed_limit=control.speed_limit(self.od, connector.pieces, self.country),
                intersection_id=self.group_ids[self.groups[number]],
                has_traffic_lights=bool(connector.junctions) and LIGHT in self.controls[number],
                stop_lines=[
                    stop_id
                    for stop_id, line in zip(self.stop_ids, self.stop_lines, strict=True)
                    if line.lane == connector.source and connector.junctions
                ],
                turn_type=turn_type(self.connector_lines[number]),
            )

    def _roadblock_specs(self) -> Iterator[BlockSpec]:
        members = defaultdict(list)
        for number, lane in enumerate(self.graph.lanes):
            members[lane.block].append(number)
        order = sorted(members)
        polygons = [self._roadblock_polygon(members[block]) for block in order]
        stacked = self._stacked_blocks()
        polygons, _ = subtract_overlaps(polygons, [p.area for p in polygons], stacked)
        for block, polygon in zip(order, polygons, strict=True):
            yield BlockSpec(
                id=self.block_ids[block],
                is_connector=False,
                polygon=polygon,
                incoming=[i for pair, i in self.pair_ids.items() if pair[1] == block],
                outgoing=[i for pair, i in self.pair_ids.items() if pair[0] == block],
            )

    def _roadblock_polygon(self, lanes: Sequence[int]) -> shapely.Polygon:
        """The area of some lanes, with what lies between them where they do not touch."""
        union = shapely.union_all([self.lane_polygons[i] for i in lanes])
        if not isinstance(union, shapely.Polygon):
            left, right = self.lane_borders[lanes[0]][0], self.lane_borders[lanes[-1]][1]
            union = shapely.union(union, lane_polygon(left, right))
        return largest_part(union)

    def _block_connector_specs(self) -> Iterator[BlockSpec]:
        members = defaultdict(list)
        for number, pair in enumerate(self.pairs):
            members[pair].append(number)
        for pair, block_id in self.pair_ids.items():
            numbers = members[pair]
            yield BlockSpec(
                id=block_id,
                is_connector=True,
                polygon=areas.merge_closed([self.connector_polygons[i] for i in numbers], 0.1),
                incoming=[self.block_ids[pair[0]]],
                outgoing=[self.block_ids[pair[1]]],
                intersection_id=self.group_ids[self.groups[numbers[0]]],
            )

    def _intersections(self) -> list[AreaSpec]:
        specs = []
        for group, group_id in enumerate(self.group_ids):
            numbers = np.flatnonzero(self.groups == group).tolist()
            polygon = areas.merge_closed([self.connector_polygons[i] for i in numbers], 0.5)
            specs.append(AreaSpec(group_id, shapely.Polygon(polygon.exterior), self._kind(numbers)))
        return specs

    def _kind(self, numbers: Sequence[int]) -> int:
        """Kind of the intersection of some connectors."""
        found = frozenset(control for i in numbers for control in self.controls[i])
        if not any(self.graph.connectors[i].junctions for i in numbers):
            return PASS_THROUGH
        return LIGHT_KIND if LIGHT in found else STOP_SIGN_KIND if STOP in found else 0

    def _areas(self) -> dict[str, list[AreaSpec]]:
        intersections = self._intersections()
        other = areas.lane_areas(self.od, self.shapes)
        spaces = areas.parking_spaces(self.od, self.shapes)
        car_parks = areas.merge_areas([*other.parking, *spaces], 0.5)
        pieces = [piece for piece in self.graph.dropped if piece.length > 0.01]
        dropped = [lane_polygon(*self.shapes.borders(piece)) for piece in pieces]
        edges = [*self.lane_polygons, *self.connector_polygons]
        inner = [spec.polygon for spec in intersections if spec.kind != PASS_THROUGH]
        drivable = areas.drivable_tiles([*edges, *inner, *other.paved, *car_parks, *dropped])
        return {
            "intersections": intersections,
            "stop_polygons": [
                AreaSpec(stop_id, line.polygon, STOP_KINDS[line.control])
                for stop_id, line in zip(self.stop_ids, self.stop_lines, strict=True)
            ],
            "crosswalks": self._specs(areas.crosswalk_polygons(self.od, self.shapes)),
            "walkways": self._specs(areas.merge_areas(other.walked, 0.05)),
            "car_parks": self._specs(car_parks),
            "drivable_areas": self._specs(drivable),
        }

    def _specs(self, polygons: Sequence[shapely.Polygon]) -> list[AreaSpec]:
        ids = self._new_ids(len(polygons))
        return [AreaSpec(i, polygon) for i, polygon in zip(ids, polygons, strict=True)]

    def _origins(self) -> Iterator[Origin]:
        ids, runs = [*self.lane_ids, *self.connector_ids], _chains(self.graph)
        for edge_id, pieces in zip(ids, runs, strict=True):
            for piece in pieces:
                yield Origin(edge_id, piece.key, piece.begin, piece.end)


def _moved(specs: Iterable[_Spec], offset: FloatArray) -> list[_Spec]:
    """Edges, blocks or areas at their place in the world."""
    out = []
    for spec in specs:
        lines = {name: getattr(spec, name, None) for name in ("baseline", "left", "right")}
        shapes = {name: line + offset for name, line in lines.items() if line is not None}
        polygon = shapely.transform(spec.polygon, lambda xy: xy + offset)
        out.append(replace(spec, polygon=polygon, **shapes))
    return out


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
