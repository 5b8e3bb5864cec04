"""Lane pieces to the semantic map of nuPlan's kind."""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np
import shapely

from shiftsim.data.maps import segments
from shiftsim.data.maps.builder import LIGHT_KIND, PASS_THROUGH, BuiltMap, MapBuilder
from shiftsim.data.maps.graph import build_graph
from shiftsim.data.maps.opendrive.areas import drivable_tiles, linked_groups, merge_areas
from shiftsim.data.maps.opendrive.shapes import BASELINE_STEP
from shiftsim.data.maps.segments import MapSource, Part
from shiftsim.data.maps.topology import Connector
from shiftsim.data.polygons import shared_areas
from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.build import AreaSpec
from shiftsim.world.ranges import MAP_EXTENT, require

_SAME_PLACE = 1.0  # m², connectors that share more lie in one intersection
_CLOSING = 0.5  # m
_APPROACH = 5.0  # m before the end of a lane, where a stop polygon lies


def build_lane_map(source: MapSource) -> BuiltMap:
    """The semantic map of what a data set tells of its lanes.

    Raises:
        MapError: There is no lane, an id occurs twice, or the map spreads wider than one can.
    """
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
    return _PieceMapBuilder(source).build(source.name)


class _PieceMapBuilder(MapBuilder[Part]):
    larger = "bigger"

    def __init__(self, source: MapSource) -> None:
        warnings = Counter[str]()
        super().__init__(build_graph(source.pieces, warnings), segments, warnings)
        self.source = source
        self.lights = [self._find_light(connector) for connector in self.graph.connectors]

    def _find_light(self, connector: Connector[Part]) -> str | None:
        """The light of a connector: of its own pieces, else of the lane that leads to it."""
        before = self.graph.lanes[connector.source].segments[-1].piece
        inner = [part.piece for part in connector.segments if connector.junctions]
        return next((piece.light for piece in (*inner, before) if piece.light is not None), None)

    def light(self, number: int) -> str | None:
        return self.lights[number]

    def speed_limits(self, segment: Part) -> Iterable[tuple[float | None, float]]:
        return [(segment.piece.speed_limit, segment.length)]

    def sizes(self, polygons: Sequence[shapely.Polygon]) -> list[float]:
        return [polygon.area for polygon in polygons]

    def stop_areas(self, lanes: Sequence[shapely.Polygon]) -> list[tuple[shapely.Polygon, int]]:
        return [(area.polygon, area.kind) for area in self.source.stop_areas]

    def stops_of(self, number: int, before: FloatArray, line: FloatArray) -> list[int]:
        """Stop polygons where the lane before a connector with a light ends."""
        if self.lights[number] is None:
            return []
        approach = before[-int(_APPROACH / BASELINE_STEP) :]
        path = shapely.LineString(np.concatenate([approach, line]))
        lane = self.graph.lanes[self.graph.connectors[number].source]
        piece = lane.segments[-1].piece.id
        return [
            number
            for number, area in enumerate(self.source.stop_areas)
            if area.piece == piece or (area.piece is None and path.intersects(area.polygon))
        ]

    def groups(self, connectors: Sequence[shapely.Polygon]) -> IntArray:
        """Intersections: connectors of one pair of roadblocks, and those that overlap."""
        pairs = self.block_pairs
        links = [(i, pairs.index(pair)) for i, pair in enumerate(pairs)]
        links += [p for p, area in shared_areas(connectors).items() if area > _SAME_PLACE]
        return linked_groups(links, len(pairs))

    def kind(self, numbers: Sequence[int]) -> int:
        if any(self.lights[i] is not None for i in numbers):
            return LIGHT_KIND
        return PASS_THROUGH if not any(self.graph.connectors[i].junctions for i in numbers) else 0

    def areas(
        self, edges: Sequence[shapely.Polygon], intersections: Sequence[AreaSpec]
    ) -> dict[str, Sequence[shapely.Polygon]]:
        source = self.source
        drivable = [*source.drivable_areas, *drivable_tiles(source.paved)]
        if not drivable:  # what the pieces cover
            pieces = [piece.polygon for piece in source.pieces if piece.polygon.area > 0]
            drivable = drivable_tiles(merge_areas([*pieces, *source.car_parks], _CLOSING))
        return {
            "crosswalks": source.crosswalks,
            "walkways": source.walkways,
            "car_parks": source.car_parks,
            "drivable_areas": drivable,
        }
