"""Lane pieces to the semantic map of nuPlan's kind."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from shiftsim.data.maps.builder import (
    LIGHT_KIND,
    PASS_THROUGH,
    MapBuilder,
    ShapedConnector,
    ShapedLane,
    block_pairs,
)
from shiftsim.data.maps.graph import build_graph
from shiftsim.data.maps.opendrive.areas import drivable_tiles, linked_groups, merge_areas
from shiftsim.data.maps.opendrive.overlaps import subtract_overlaps
from shiftsim.data.maps.opendrive.shapes import BASELINE_STEP, bend_ends, lane_polygon
from shiftsim.data.maps.segments import MapSource, Part, baseline, joined_borders
from shiftsim.data.maps.topology import Connector
from shiftsim.data.polygons import shared_areas
from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import MAP_EXTENT, require

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
        MapError: There is no lane, an id occurs twice, or the map spreads wider than one can.
    """
    return _Maker(source).build()


class _Maker:
    def __init__(self, source: MapSource) -> None:
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
        self.source, self.warnings = source, Counter[str]()
        self.graph = build_graph(source.pieces, self.warnings)
        self.lights = [self._light(connector) for connector in self.graph.connectors]

    def build(self) -> PieceMap:
        source, graph = self.source, self.graph
        lanes = self._lanes()
        connectors = self._connectors([lane.line for lane in lanes])
        groups = self._groups([connector.polygon for connector in connectors])
        parts = MapBuilder(lanes, connectors, groups=groups, num_stops=len(source.stop_areas))
        road = build_map(
            source.name,
            edges=parts.edges(),
            blocks=parts.blocks(),
            intersections=parts.intersections(self._kind),
            stop_polygons=parts.stop_polygons((a.polygon, a.kind) for a in source.stop_areas),
            crosswalks=parts.areas(source.crosswalks),
            walkways=parts.areas(source.walkways),
            car_parks=parts.areas(source.car_parks),
            drivable_areas=parts.areas(self._drivable()),
        )
        ids = [*parts.lane_ids, *parts.connector_ids]
        runs = [lane.segments for lane in graph.lanes]
        runs += [connector.segments for connector in graph.connectors]
        origins = {i: tuple(p.piece.id for p in run) for i, run in zip(ids, runs, strict=True)}
        lit = zip(parts.connector_ids, self.lights, strict=True)
        lights = {i: name for i, name in lit if name is not None}
        return PieceMap(road, dict(self.warnings), lights, origins)

    def _lanes(self) -> list[ShapedLane]:
        lanes = self.graph.lanes
        borders = [joined_borders(lane.segments) for lane in lanes]
        polygons = [lane_polygon(*pair) for pair in borders]
        polygons, overlaps = subtract_overlaps(polygons, [p.area for p in polygons], set())
        if overlaps:
            self.warnings["overlap of two lanes, taken from the bigger one"] += overlaps
        return [
            ShapedLane(
                *borders[number],
                baseline(lane.segments),
                polygons[number],
                _limit(lane.segments),
                lane.block,
                lane.index,
                is_beside=True,
            )
            for number, lane in enumerate(lanes)
        ]

    def _connectors(self, lines: Sequence[FloatArray]) -> list[ShapedConnector]:
        """All connectors; `lines` are the baselines of the lanes."""
        out = []
        for connector, light in zip(self.graph.connectors, self.lights, strict=True):
            borders = joined_borders(connector.segments)
            before, after = lines[connector.source], lines[connector.target]
            line = bend_ends(baseline(connector.segments, before[-1], after[0]), before, after)
            stops: Sequence[int] = ()
            if light is not None:
                approach = before[-int(_APPROACH / BASELINE_STEP) :]
                way = shapely.LineString(np.concatenate([approach, line]))
                stops = self._stops(connector, way)
            out.append(
                ShapedConnector(
                    *borders,
                    line,
                    lane_polygon(*borders),
                    _limit(connector.segments),
                    connector.source,
                    connector.target,
                    has_light=light is not None,
                    stops=stops,
                )
            )
        return out

    def _light(self, connector: Connector[Part]) -> str | None:
        """The light of a connector: of its own pieces, else of the lane that leads to it."""
        source = self.graph.lanes[connector.source].segments[-1].piece
        own = [part.piece for part in connector.segments if connector.junctions]
        return next((piece.light for piece in (*own, source) if piece.light is not None), None)

    def _stops(self, connector: Connector[Part], way: shapely.LineString) -> list[int]:
        """Stop polygons where the lane before a connector ends."""
        piece = self.graph.lanes[connector.source].segments[-1].piece.id
        return [
            number
            for number, area in enumerate(self.source.stop_areas)
            if area.piece == piece or (area.piece is None and way.intersects(area.polygon))
        ]

    def _groups(self, polygons: Sequence[shapely.Polygon]) -> IntArray:
        """Intersections: connectors of one pair of roadblocks, and those that overlap."""
        pairs = block_pairs(self.graph.lanes, self.graph.connectors)
        links = [(i, pairs.index(pair)) for i, pair in enumerate(pairs)]
        links += [p for p, area in shared_areas(polygons).items() if area > _SAME_PLACE]
        return linked_groups(links, len(pairs))

    def _kind(self, numbers: Sequence[int]) -> int:
        """Kind of the intersection of some connectors."""
        if any(self.lights[i] is not None for i in numbers):
            return LIGHT_KIND
        return PASS_THROUGH if not any(self.graph.connectors[i].junctions for i in numbers) else 0

    def _drivable(self) -> list[shapely.Polygon]:
        """The drivable areas; what the pieces cover, for a source without."""
        found = [*self.source.drivable_areas, *drivable_tiles(self.source.paved)]
        if found:
            return found
        pieces = [piece.polygon for piece in self.source.pieces if piece.polygon.area > 0]
        return drivable_tiles(merge_areas([*pieces, *self.source.car_parks], _CLOSING))


def _limit(parts: Sequence[Part]) -> float | None:
    """The limit on most of a lane (nuPlan rule 507), the lower one on ties [m/s]."""
    lengths: dict[float, float] = defaultdict(float)
    for part in parts:
        limit = part.piece.speed_limit
        lengths[np.inf if limit is None else limit] += part.length
    best = min(lengths, key=lambda limit: (-round(lengths[limit], 6), limit))
    return None if np.isinf(best) else best
