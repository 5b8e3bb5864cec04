"""Lane pieces to the semantic map of nuPlan's kind."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import TypeVar

import numpy as np
import shapely

from shiftsim.data.lanes.graph import Connector, build_graph
from shiftsim.data.lanes.pieces import MapSource, Part, baseline, joined_borders
from shiftsim.data.opendrive.areas import drivable_tiles, linked_groups, merge_areas, merge_closed
from shiftsim.data.opendrive.map import LIGHT_KIND, PASS_THROUGH, turn_type
from shiftsim.data.opendrive.overlaps import subtract_overlaps
from shiftsim.data.opendrive.shapes import BASELINE_STEP, bend_ends, lane_polygon
from shiftsim.data.polygons import largest_part, shared_areas
from shiftsim.errors import MapError
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import MAP_EXTENT, require

T = TypeVar("T")
_SAME_PLACE = 1.0  # m², connectors that share more lie in one intersection
_CLOSING = 0.5  # m
_APPROACH = 5.0  # m before the end of a lane, where a stop polygon lies


@dataclass(frozen=True)
class PieceMap:
    """A map, and what became of the pieces."""

    road: VectorMap
    warnings: dict[str, int]  # what was inferred or left out: count by kind
    lights: Mapping[str, str]  # by connector that has one: the name of its light
    origins: Mapping[str, tuple[str, ...]]  # by lane or connector: ids of its pieces


def build_lane_map(source: MapSource) -> PieceMap:
    """The semantic map of what a data set tells of its lanes.

    Raises:
        MapError: There is no lane, an id occurs twice, or the lanes spread wider than a map can.
    """
    return _Maker(source).build()


class _Maker:
    def __init__(self, source: MapSource) -> None:
        if not source.pieces:
            what = f"map {source.name!r} has no lane that cars may use"
            raise MapError(what, "leave this scene out: without lanes there is no route")
        points = np.concatenate([np.zeros((0, 2)), *(piece.left for piece in source.pieces)])
        extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
        require(MAP_EXTENT, "extent", extent, f"map {source.name!r}: the lanes'", error=MapError)
        self.source, self.warnings = source, Counter[str]()
        self.graph = build_graph(source.pieces, self.warnings)
        self._ids = map(str, count(1))

    def build(self) -> PieceMap:
        self._shape()
        self._number()
        edges, blocks = [*self._lanes(), *self._connectors()], [*self._blocks()]
        source = self.source
        road = build_map(
            source.name,
            edges=edges,
            blocks=[*blocks, *self._block_connectors()],
            intersections=list(self._intersections()),
            stop_polygons=[
                AreaSpec(i, area.polygon, area.kind)
                for i, area in zip(self.stop_ids, source.stop_areas, strict=True)
            ],
            crosswalks=self._areas(source.crosswalks),
            walkways=self._areas(source.walkways),
            car_parks=self._areas(source.car_parks),
            drivable_areas=self._areas(source.drivable_areas or self._covered()),
        )
        ids = [*self.lane_ids, *self.connector_ids]
        runs = [lane.parts for lane in self.graph.lanes]
        runs += [connector.parts for connector in self.graph.connectors]
        origins = {i: tuple(p.piece.id for p in run) for i, run in zip(ids, runs, strict=True)}
        lit = zip(self.connector_ids, self.lights, strict=True)
        lights = {i: name for i, name in lit if name is not None}
        return PieceMap(road, dict(self.warnings), lights, origins)

    def _new_ids(self, number: int) -> list[str]:
        return [next(self._ids) for _ in range(number)]

    def _shape(self) -> None:
        lanes, connectors = self.graph.lanes, self.graph.connectors
        self.lane_borders = [joined_borders(lane.parts) for lane in lanes]
        self.lane_lines = [baseline(lane.parts) for lane in lanes]
        polygons = [lane_polygon(*borders) for borders in self.lane_borders]
        sizes = [polygon.area for polygon in polygons]
        self.lane_polygons, overlaps = subtract_overlaps(polygons, sizes, set())
        if overlaps:
            self.warnings["overlap of two lanes, taken from the bigger one"] += overlaps
        self.borders = [joined_borders(connector.parts) for connector in connectors]
        self.polygons = [lane_polygon(*borders) for borders in self.borders]
        self.lines = []
        for connector in connectors:
            before, after = (self.lane_lines[i] for i in (connector.source, connector.target))
            line = baseline(connector.parts, before[-1], after[0])
            self.lines.append(bend_ends(line, before, after))

    def _number(self) -> None:
        lanes, connectors = self.graph.lanes, self.graph.connectors
        self.lane_ids = self._new_ids(len(lanes))
        self.block_ids = self._new_ids(lanes[-1].block + 1 if lanes else 0)
        self.connector_ids = self._new_ids(len(connectors))
        self.pairs = [(lanes[c.source].block, lanes[c.target].block) for c in connectors]
        pairs = sorted(set(self.pairs))
        self.pair_ids = dict(zip(pairs, self._new_ids(len(pairs)), strict=True))
        links = [(i, self.pairs.index(pair)) for i, pair in enumerate(self.pairs)]
        shared = shared_areas(self.polygons).items()
        links += [pair for pair, area in shared if area > _SAME_PLACE]
        self.groups = linked_groups(links, len(connectors))
        self.group_ids = self._new_ids(int(self.groups.max(initial=-1)) + 1)
        self.lights = [self._light(connector) for connector in connectors]
        self.stop_ids = self._new_ids(len(self.source.stop_areas))

    def _light(self, connector: Connector) -> str | None:
        """The light of a connector: of its own pieces, else of the lane that leads to it."""
        source = self.graph.lanes[connector.source].parts[-1].piece
        own = [part.piece for part in connector.parts if not connector.is_seam]
        return next((piece.light for piece in (*own, source) if piece.light is not None), None)

    def _limit(self, parts: Sequence[Part]) -> float | None:
        """The limit on most of a lane (nuPlan rule 507), the lower one on ties [m/s]."""
        lengths: dict[float, float] = defaultdict(float)
        for part in parts:
            limit = part.piece.speed_limit
            lengths[np.inf if limit is None else limit] += part.length
        best = min(lengths, key=lambda limit: (-round(lengths[limit], 6), limit))
        return None if np.isinf(best) else best

    def _stop_lines(self, number: int) -> list[str]:
        """Stop polygons of a connector with a light: where the lane before it ends."""
        source = self.graph.connectors[number].source
        if self.lights[number] is None:
            return []
        piece = self.graph.lanes[source].parts[-1].piece.id
        approach = self.lane_lines[source][-int(_APPROACH / BASELINE_STEP) :]
        line = shapely.LineString(np.concatenate([approach, self.lines[number]]))
        return [
            stop_id
            for stop_id, area in zip(self.stop_ids, self.source.stop_areas, strict=True)
            if area.piece == piece or (area.piece is None and line.intersects(area.polygon))
        ]

    def _lanes(self) -> Iterator[EdgeSpec]:
        lanes = self.graph.lanes
        outgoing, incoming = defaultdict(list), defaultdict(list)
        for connector_id, connector in zip(self.connector_ids, self.graph.connectors, strict=True):
            outgoing[connector.source].append(connector_id)
            incoming[connector.target].append(connector_id)
        blocks = [lane.block for lane in lanes]
        boundaries: dict[tuple[int, int], str] = defaultdict(lambda: next(self._ids))
        for number, lane in enumerate(lanes):
            beside = {step: number + step for step in (-1, 1)}
            neighbor = {
                step: self.lane_ids[i] if 0 <= i < len(lanes) and blocks[i] == lane.block else None
                for step, i in beside.items()
            }
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
                left_id=boundaries[lane.block, lane.index],
                right_id=boundaries[lane.block, lane.index + 1],
                speed_limit=self._limit(lane.parts),
                lane_index=lane.index,
                left_lane=neighbor[-1],
                right_lane=neighbor[1],
            )

    def _connectors(self) -> Iterator[EdgeSpec]:
        for number, connector in enumerate(self.graph.connectors):
            left, right = self.borders[number]
            left_id, right_id = self._new_ids(2)
            yield EdgeSpec(
                id=self.connector_ids[number],
                is_connector=True,
                polygon=self.polygons[number],
                baseline=self.lines[number],
                block_id=self.pair_ids[self.pairs[number]],
                incoming=[self.lane_ids[connector.source]],
                outgoing=[self.lane_ids[connector.target]],
                left=left,
                right=right,
                left_id=left_id,
                right_id=right_id,
                speed_limit=self._limit(connector.parts),
                intersection_id=self.group_ids[self.groups[number]],
                has_traffic_lights=self.lights[number] is not None,
                stop_lines=self._stop_lines(number),
                turn_type=turn_type(self.lines[number]),
            )

    def _blocks(self) -> Iterator[BlockSpec]:
        members = _grouped(lane.block for lane in self.graph.lanes)
        polygons = [self._block_polygon(members[block]) for block in range(len(members))]
        polygons, _ = subtract_overlaps(polygons, [p.area for p in polygons], set())
        for block, polygon in enumerate(polygons):
            yield BlockSpec(
                id=self.block_ids[block],
                is_connector=False,
                polygon=polygon,
                incoming=[i for pair, i in self.pair_ids.items() if pair[1] == block],
                outgoing=[i for pair, i in self.pair_ids.items() if pair[0] == block],
            )

    def _block_polygon(self, lanes: Sequence[int]) -> shapely.Polygon:
        """The area of some lanes, with what lies between them where they do not touch."""
        if len(lanes) == 1:
            return self.lane_polygons[lanes[0]]
        union = shapely.union_all([self.lane_polygons[i] for i in lanes])
        if not isinstance(union, shapely.Polygon):
            left, right = self.lane_borders[lanes[0]][0], self.lane_borders[lanes[-1]][1]
            union = shapely.union(union, lane_polygon(left, right))
        return largest_part(union)

    def _block_connectors(self) -> Iterator[BlockSpec]:
        for pair, numbers in _grouped(self.pairs).items():
            yield BlockSpec(
                id=self.pair_ids[pair],
                is_connector=True,
                polygon=merge_closed([self.polygons[i] for i in numbers], 0.1),
                incoming=[self.block_ids[pair[0]]],
                outgoing=[self.block_ids[pair[1]]],
                intersection_id=self.group_ids[self.groups[numbers[0]]],
            )

    def _intersections(self) -> Iterator[AreaSpec]:
        for group, numbers in sorted(_grouped(self.groups.tolist()).items()):
            polygon = merge_closed([self.polygons[i] for i in numbers], _CLOSING)
            kind = LIGHT_KIND if any(self.lights[i] is not None for i in numbers) else 0
            if not kind and all(self.graph.connectors[i].is_seam for i in numbers):
                kind = PASS_THROUGH
            yield AreaSpec(self.group_ids[group], shapely.Polygon(polygon.exterior), kind)

    def _covered(self) -> list[shapely.Polygon]:
        """What the pieces cover, for a source without drivable areas."""
        pieces = [piece.polygon for piece in self.source.pieces if piece.polygon.area > 0]
        return drivable_tiles(merge_areas([*pieces, *self.source.car_parks], _CLOSING))

    def _areas(self, polygons: Sequence[shapely.Polygon]) -> list[AreaSpec]:
        ids = self._new_ids(len(polygons))
        return [AreaSpec(i, polygon) for i, polygon in zip(ids, polygons, strict=True)]


def _grouped(labels: Iterable[T]) -> dict[T, list[int]]:
    """Indices by label, in order."""
    out: dict[T, list[int]] = defaultdict(list)
    for index, label in enumerate(labels):
        out[label].append(index)
    return out
