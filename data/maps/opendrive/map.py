"""OpenDRIVE to the semantic map of nuPlan's kind."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TypeVar

import numpy as np
import shapely

from shiftsim.data.maps.builder import (
    LIGHT_KIND,
    PASS_THROUGH,
    STOP_SIGN_KIND,
    MapBuilder,
    ShapedConnector,
    ShapedLane,
    block_pairs,
)
from shiftsim.data.maps.opendrive import areas, control, records
from shiftsim.data.maps.opendrive.control import LIGHT, STOP, YIELD
from shiftsim.data.maps.opendrive.curves import ReferenceLine, length_error
from shiftsim.data.maps.opendrive.graph import Graph, LaneSegment, build_lane_graph
from shiftsim.data.maps.opendrive.lanes import LaneKey, border_is_mirrored
from shiftsim.data.maps.opendrive.overlaps import (
    Levels,
    cut_crossings,
    overlapping,
    subtract_overlaps,
)
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.maps.opendrive.shapes import Shapes, bend_ends, lane_polygon, widen
from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import MAP_EXTENT, require

STOP_KINDS = {LIGHT: 2, STOP: 1, YIELD: 4}  # kinds of stop polygons
GAP_NOTED, GAP_SERIOUS = 0.01, 0.5  # m
MAX_LENGTH_ERROR = 3.0  # as a share; a cubic that far from its stated length is nonsense
MAX_LANE_LENGTH = 3e6  # m, of all lanes together
_Spec = TypeVar("_Spec", EdgeSpec, BlockSpec, AreaSpec)


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
    # ids of pairs of lanes, and of roadblocks, that lie over each other on different levels
    stacked: frozenset[tuple[str, str]] = frozenset()


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
    placed = _prepare(od, warnings)
    graph = build_lane_graph(placed, warnings)
    return _Maker(placed, graph, warnings, country).build(name, np.array(offset), epsg)


def _prepare(od: records.OpenDrive, warnings: Counter[str]) -> records.OpenDrive:
    """The file in the frame of its header, without roads that cannot be drawn; counts them.

    Raises:
        MapError: The file has more road than one map can hold.
    """
    roads = {}
    for name, road in od.roads.items():
        errors = [length_error(geometry) for geometry in road.geometries]
        if max(errors) > MAX_LENGTH_ERROR:
            warnings["road left out: paramPoly3 far from its stated length"] += 1
            continue
        wrong = sum(error > 0 for error in errors)
        if wrong:
            warnings["paramPoly3 that is not as long as it says, stretched"] += wrong
        _note_gaps(road, warnings)
        _note_lanes(road, warnings)
        roads[name] = _placed(road, od.offset) if od.offset else road
    starts = [(g.x, g.y) for road in roads.values() for g in road.geometries]
    extent = np.ptp(starts, axis=0).max() if starts else 0.0
    require(MAP_EXTENT, "extent", extent, f"{od.source}: the roads'", error=MapError)
    total = sum(
        (road.section_end(index) - section.s) * len(section.lanes)
        for road in roads.values()
        for index, section in enumerate(road.sections)
    )
    if total > MAX_LANE_LENGTH:
        raise MapError(
            f"{od.source}: {total / 1000:.0f} km of lanes, more than {MAX_LANE_LENGTH / 1000:.0f}",
            "cut the map into smaller files",
        )
    return replace(od, roads=roads, offset=None)


def _placed(road: records.Road, offset: tuple[float, float, float, float]) -> records.Road:
    """A road with the header's offset applied to its reference line."""
    x, y, _, turn = offset
    cos, sin = np.cos(turn), np.sin(turn)
    geometries = tuple(
        replace(
            g,
            x=float(x + cos * g.x - sin * g.y),
            y=float(y + sin * g.x + cos * g.y),
            heading=g.heading + turn,
        )
        for g in road.geometries
    )
    return replace(road, geometries=geometries)


def _note_gaps(road: records.Road, warnings: Counter[str]) -> None:
    gaps, _ = ReferenceLine(road.geometries).joints()
    for low, high in ((GAP_NOTED, GAP_SERIOUS), (GAP_SERIOUS, np.inf)):
        count = int(((gaps > low) & (gaps <= high)).sum())
        if count:
            warnings[f"gap of more than {low:g} m between geometries"] += count


def _note_lanes(road: records.Road, warnings: Counter[str]) -> None:
    known = records.DRIVABLE | records.PAVED | records.WALKED | records.SEAMS | records.UNUSED
    for section in road.sections:
        for lane in section.lanes.values():
            if lane.type in ("tram", "rail"):
                warnings["tram or rail lane left out"] += 1
            elif lane.type not in known:
                warnings["lane of unknown type left out"] += 1
            if border_is_mirrored(lane):
                warnings["border of a right lane given on the left, mirrored"] += 1


def _chains(graph: Graph) -> list[list[LaneSegment]]:
    return [lane.segments for lane in graph.lanes] + [c.segments for c in graph.connectors]


def _shapes_of(od: OpenDrive, graph: Graph) -> Shapes:
    return Shapes(od, [*chain.from_iterable(_chains(graph)), *graph.dropped])


class _Maker:
    def __init__(self, od: OpenDrive, graph: Graph, warnings: Counter[str], country: str) -> None:
        self.od, self.warnings, self.country = od, warnings, country
        self.shapes = _shapes_of(od, graph)
        self.graph, crossings = cut_crossings(od, graph, self.shapes)
        if crossings:
            warnings["lanes that cross without a junction, made an intersection"] += crossings
            self.shapes = _shapes_of(od, self.graph)
        self.controls = control.connector_controls(od, self.graph)

    def build(self, name: str, offset: FloatArray, epsg: int) -> tuple[VectorMap, MapReport]:
        lanes, stacked = self._lanes()
        polygons = [lane.polygon for lane in lanes]
        stops = control.stop_lines(self.od, self.graph, self.shapes, self.controls, polygons)
        connectors = self._connectors([lane.line for lane in lanes], stops)
        blocks = [lane.block for lane in lanes]
        stacked_blocks = {
            (min(blocks[i], blocks[j]), max(blocks[i], blocks[j])) for i, j in stacked
        }
        parts = MapBuilder(
            lanes,
            connectors,
            groups=self._groups([connector.polygon for connector in connectors]),
            num_stops=len(stops),
            stacked=stacked_blocks,
        )
        edges, block_specs = parts.edges(), parts.blocks()
        layers = self._areas(parts, [edge.polygon for edge in edges])
        layers["stop_polygons"] = parts.stop_polygons(
            (line.polygon, STOP_KINDS[line.control]) for line in stops
        )
        vector_map = build_map(
            name,
            edges=_moved(edges, offset),
            blocks=_moved(block_specs, offset),
            epsg=epsg,
            **{layer: _moved(specs, offset) for layer, specs in layers.items()},
        )
        levels = {(parts.lane_ids[i], parts.lane_ids[j]) for i, j in stacked}
        levels |= {(parts.block_ids[a], parts.block_ids[b]) for a, b in stacked_blocks}
        origins = tuple(self._origins([*parts.lane_ids, *parts.connector_ids]))
        return vector_map, MapReport(dict(self.warnings), origins, frozenset(levels))

    def _lanes(self) -> tuple[list[ShapedLane], set[tuple[int, int]]]:
        """All lanes, and the pairs of them that lie on different levels."""
        lanes = self.graph.lanes
        borders = [self.shapes.joined_borders(lane.segments) for lane in lanes]
        polygons = [lane_polygon(*pair) for pair in borders]
        levels = Levels(self.od, self.shapes, [lane.segments for lane in lanes], polygons)
        stacked = {pair for pair in overlapping(polygons) if levels.are_stacked(*pair)}
        lengths = [sum(piece.length for piece in lane.segments) for lane in lanes]
        polygons, overlaps = subtract_overlaps(polygons, lengths, stacked)
        if overlaps:
            self.warnings["overlap of two lanes, taken from the longer one"] += overlaps
        shaped = [
            ShapedLane(
                *borders[number],
                self.shapes.baseline(lane.segments),
                polygons[number],
                control.speed_limit(self.od, lane.segments, self.country),
                lane.block,
                lane.index,
                number > 0 and _touch(lanes[number - 1].segments[0], lane.segments[0]),
            )
            for number, lane in enumerate(lanes)
        ]
        return shaped, stacked

    def _connectors(
        self, lines: Sequence[FloatArray], stops: Sequence[control.StopLine]
    ) -> list[ShapedConnector]:
        """All connectors; `lines` are the baselines of the lanes."""
        lanes, out = self.graph.lanes, []
        for connector, controls in zip(self.graph.connectors, self.controls, strict=True):
            left, right = self.shapes.joined_borders(connector.segments)
            before = self.shapes.widths(lanes[connector.source].segments)[1]
            after = self.shapes.widths(lanes[connector.target].segments)[0]
            left, right = widen(left, right, min(before, after))
            source, target = lines[connector.source], lines[connector.target]
            line = self.shapes.baseline(connector.segments, source[-1], target[0])
            here = [i for i, stop in enumerate(stops) if stop.lane == connector.source]
            out.append(
                ShapedConnector(
                    left,
                    right,
                    bend_ends(line, source, target),
                    lane_polygon(left, right),
                    control.speed_limit(self.od, connector.segments, self.country),
                    connector.source,
                    connector.target,
                    has_light=bool(connector.junctions) and LIGHT in controls,
                    stops=here if connector.junctions else (),
                )
            )
        return out

    def _groups(self, polygons: Sequence[shapely.Polygon]) -> IntArray:
        connectors = self.graph.connectors
        levels = Levels(self.od, self.shapes, [c.segments for c in connectors], polygons)
        pairs = block_pairs(self.graph.lanes, connectors)
        return areas.group_connectors(connectors, polygons, pairs, levels.are_stacked)

    def _kind(self, numbers: Sequence[int]) -> int:
        """Kind of the intersection of some connectors."""
        found = frozenset(control for i in numbers for control in self.controls[i])
        if not any(self.graph.connectors[i].junctions for i in numbers):
            return PASS_THROUGH
        return LIGHT_KIND if LIGHT in found else STOP_SIGN_KIND if STOP in found else 0

    def _areas(
        self, parts: MapBuilder, edges: Sequence[shapely.Polygon]
    ) -> dict[str, list[AreaSpec]]:
        """Layers without links; `edges` are the areas of all lanes and connectors."""
        intersections = parts.intersections(self._kind)
        other = areas.lane_areas(self.od, self.shapes)
        spaces = areas.parking_spaces(self.od, self.shapes)
        car_parks = areas.merge_areas([*other.parking, *spaces], 0.5)
        pieces = [piece for piece in self.graph.dropped if piece.length > 0.01]
        dropped = [lane_polygon(*self.shapes.borders(piece)) for piece in pieces]
        inner = [spec.polygon for spec in intersections if spec.kind != PASS_THROUGH]
        drivable = areas.drivable_tiles([*edges, *inner, *other.paved, *car_parks, *dropped])
        return {
            "intersections": intersections,
            "crosswalks": parts.areas(areas.crosswalk_polygons(self.od, self.shapes)),
            "walkways": parts.areas(areas.merge_areas(other.walked, 0.05)),
            "car_parks": parts.areas(car_parks),
            "drivable_areas": parts.areas(drivable),
        }

    def _origins(self, ids: Sequence[str]) -> Iterator[Origin]:
        for edge_id, pieces in zip(ids, _chains(self.graph), strict=True):
            for piece in pieces:
                yield Origin(edge_id, piece.key, piece.begin, piece.end)


def _touch(left: LaneSegment, right: LaneSegment) -> bool:
    """Whether no lane of another use lies between two lanes of one section."""
    one, other = left.key.lane, right.key.lane
    return abs(one - other) - (1 if one * other < 0 else 0) == 1


def _moved(specs: Iterable[_Spec], offset: FloatArray) -> list[_Spec]:
    """Edges, blocks or areas at their place in the world."""
    out = []
    for spec in specs:
        lines = {name: getattr(spec, name, None) for name in ("baseline", "left", "right")}
        shapes = {name: line + offset for name, line in lines.items() if line is not None}
        polygon = shapely.transform(spec.polygon, lambda xy: xy + offset)
        out.append(replace(spec, polygon=polygon, **shapes))
    return out
