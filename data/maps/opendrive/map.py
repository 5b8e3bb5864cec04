"""OpenDRIVE to the semantic map of nuPlan's kind."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import shapely

from shiftsim.data.maps.builder import PASS_THROUGH, BuiltMap, MapBuilder, Pairs, StopArea
from shiftsim.data.maps.opendrive import areas, control, graph, records
from shiftsim.data.maps.opendrive.control import LIGHT, STOP, TOWN
from shiftsim.data.maps.opendrive.curves import ReferenceLine, length_error, total_turn
from shiftsim.data.maps.opendrive.lanes import border_is_mirrored
from shiftsim.data.maps.opendrive.overlaps import Levels, cut_crossings, overlapping
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.maps.opendrive.shapes import Shapes, lane_polygon, widen
from shiftsim.errors import ConversionError, MapError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import AreaSpec
from shiftsim.world.map import VectorMap
from shiftsim.world.ranges import MAP_EXTENT, require

GAP_NOTED, GAP_SERIOUS = 0.01, 0.5  # m
MAX_LENGTH_ERROR = 3.0  # as a share; a cubic that far from its stated length is nonsense
MAX_TURN = 3 * np.pi  # rad in one geometry; no road winds further within its plane
MAX_TOWN_SPEED = 45.0  # m/s; more than 162 km/h in a town is km/h without a unit
MAX_LANE_LENGTH = 3e6  # m, of all lanes together


def build_road_map(
    od: OpenDrive,
    *,
    name: str,
    offset: tuple[float, float] = (0.0, 0.0),  # UTM position of the local origin [m]
    epsg: int = 0,  # code of the coordinate system that results; 0 for a local frame
    country: str = "DE",  # whose default speed limits hold where the file has none
) -> tuple[VectorMap, BuiltMap]:
    """The semantic map of an OpenDRIVE file, and the report.

    It has no lanes where the file has none that cars may use. Raises MapError: the file has more
    road than one map can hold.
    """
    warnings = Counter(od.warnings)
    placed = _prepare(od, warnings)
    lane_graph = graph.build_lane_graph(placed, warnings)
    shapes = Shapes(placed, lane_graph)
    lane_graph, crossings = cut_crossings(placed, lane_graph, shapes)
    if crossings:
        warnings["lanes that cross without a junction, made an intersection"] += crossings
        shapes = Shapes(placed, lane_graph)
    builder = _RoadMapBuilder(placed, lane_graph, shapes, warnings, country)
    built = builder.build(name, epsg=epsg, offset=np.array(offset))
    return built.road, built


def require_lanes(od: OpenDrive, built: BuiltMap) -> None:
    """A ConversionError where a map has no lanes; the message says why."""
    if built.road.num_lanes:
        return
    reasons = Counter({kind: n for kind, n in built.warnings.items() if "road left out" in kind})
    for found in od.roads.values():
        for lane in (lane for section in found.sections for lane in section.lanes.values()):
            if lane.type not in records.DRIVABLE:
                reasons[f"lanes of type {lane.type!r}"] += 1
            elif not graph.is_drivable(lane):
                reasons["lanes that are closed to cars"] += 1
            elif not len(lane.widths) and not len(lane.borders):
                reasons["lanes without width"] += 1
            elif found.junction is not None:
                reasons[f"lanes of roads with junction={found.junction!r}"] += 1
            else:
                reasons["lanes that are too short or too narrow"] += 1
    why = ", ".join(f"{what} ({count})" for what, count in reasons.items()) or "it has no lanes"
    hint = "give a map with roads for cars, each with widths, outside of junctions junction='-1'"
    raise ConversionError(f"{od.source} has no drivable lane: {why}", hint)


def _prepare(od: records.OpenDrive, warnings: Counter[str]) -> records.OpenDrive:
    """The file in the frame of its header, without roads that cannot be drawn; or a MapError."""
    roads = {}
    fast: list[str] = []  # roads of towns with limits that cannot be meant
    for name, road in od.roads.items():
        road = replace(road, left_hand=road.left_hand or name in od.left_hand)
        errors = [length_error(geometry) for geometry in road.geometries]
        if max(errors) > MAX_LENGTH_ERROR:
            warnings["road left out: paramPoly3 far from its stated length"] += 1
            continue
        if max(map(total_turn, road.geometries)) > MAX_TURN:
            warnings["road left out: one geometry turns more than one and a half times"] += 1
            continue
        if wrong := sum(error > 0 for error in errors):
            warnings["paramPoly3 that is not as long as it says, stretched"] += wrong
        fast += [name] * _count_fast(road)
        _note_gaps(road, warnings)
        _note_lanes(road, warnings)
        roads[name] = _placed(road, od.offset) if od.offset else road
    if fast:
        what = f"speed limit above {MAX_TOWN_SPEED:g} m/s in a town, the first on road {fast[0]!r}"
        warnings[f"{what}: is it in km/h?"] += len(fast)
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


def _count_fast(road: records.Road) -> int:
    """How many speed records of a road in a town are too high for any town."""
    found = [kind.speed for kind in road.types if kind.type in TOWN]
    lanes = [lane for section in road.sections for lane in section.lanes.values()]
    found += [speed for lane in lanes for speed in lane.speeds] if found else []
    return sum(speed is not None and (speed.limit or 0.0) > MAX_TOWN_SPEED for speed in found)


def _note_gaps(road: records.Road, warnings: Counter[str]) -> None:
    gaps, _ = ReferenceLine(road.geometries).joints()
    for low, high in ((GAP_NOTED, GAP_SERIOUS), (GAP_SERIOUS, np.inf)):
        if count := int(((gaps > low) & (gaps <= high)).sum()):
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


class _RoadMapBuilder(MapBuilder[graph.LaneSegment]):
    larger = "longer"

    def __init__(
        self,
        od: OpenDrive,
        lane_graph: graph.Graph,
        shapes: Shapes,
        warnings: Counter[str],
        country: str,
    ) -> None:
        super().__init__(lane_graph, shapes, warnings)
        self.od, self.shapes, self.country = od, shapes, country
        self.controls = control.connector_controls(od, lane_graph)
        self.lights = ["" if LIGHT in found else None for found in self.controls]
        self.stop_signs = [STOP in found for found in self.controls]

    def connector_borders(self, connector: graph.Connector) -> tuple[FloatArray, FloatArray]:
        lanes = self.graph.lanes
        before = self.shapes.widths(lanes[connector.source].segments)[1]
        after = self.shapes.widths(lanes[connector.target].segments)[0]
        return widen(*self.shapes.joined_borders(connector.segments), min(before, after))

    def speed_limits(self, segment: graph.LaneSegment) -> Iterable[tuple[float | None, float]]:
        return control.speed_limits(self.od, segment, self.country)

    def _levels(
        self, edges: Sequence[graph.Lane | graph.Connector], areas: Sequence[shapely.Polygon]
    ) -> Levels:
        return Levels(self.od, self.shapes, [edge.segments for edge in edges], areas)

    def stacked_lanes(self, polygons: Sequence[shapely.Polygon]) -> Pairs:
        levels = self._levels(self.graph.lanes, polygons)
        return {pair for pair in overlapping(polygons) if levels.are_stacked(*pair)}

    def are_adjacent(self, left: graph.Lane, right: graph.Lane) -> bool:
        """Whether no lane of another use lies between two lanes of one section."""
        one, other = (lane.segments[0].key.lane for lane in (left, right))
        return abs(one - other) - (one * other < 0) == 1

    def stop_areas(self, lanes: Sequence[shapely.Polygon]) -> list[StopArea]:
        return control.stop_lines(self.od, self.graph, self.shapes, self.controls, lanes)

    def stops_of(self, number: int, before: FloatArray, line: FloatArray) -> list[int]:
        connector = self.graph.connectors[number]
        if not connector.junctions:
            return []
        return [i for i, stop in enumerate(self.stops) if stop.before == connector.source]

    def groups(self, connectors: Sequence[shapely.Polygon]) -> IntArray:
        levels = self._levels(self.graph.connectors, connectors)
        return areas.group_connectors(
            self.graph.connectors, connectors, self.block_pairs, levels.are_stacked
        )

    def areas(
        self, edges: Sequence[shapely.Polygon], intersections: Sequence[AreaSpec]
    ) -> dict[str, Sequence[shapely.Polygon]]:
        other = areas.lane_areas(self.od, self.shapes)
        spaces = areas.parking_spaces(self.od, self.shapes)
        car_parks = areas.merge_areas([*other["parking"], *spaces], 0.5)
        segments = [segment for segment in self.graph.dropped if segment.length > 0.01]
        dropped = [lane_polygon(*self.shapes.borders(segment)) for segment in segments]
        inner = [spec.polygon for spec in intersections if spec.kind != PASS_THROUGH]
        return {
            "crosswalks": areas.crosswalk_polygons(self.od, self.shapes),
            "walkways": areas.merge_areas(other["walked"], 0.05),
            "car_parks": car_parks,
            "drivable_areas": areas.drivable_tiles(
                [*edges, *inner, *other["paved"], *car_parks, *dropped]
            ),
        }
