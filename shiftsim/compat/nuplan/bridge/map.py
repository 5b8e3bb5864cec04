"""The map interface over a `VectorMap`; a point is any object with x and y.

In nuPlan the table of lane connectors that most queries read holds lines; their areas are in
another one: proximity, distance and `is_in_layer` mean lines, `get_all_map_objects` means areas.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NamedTuple, NoReturn

import numpy as np
import shapely
from nuplan.common.maps.abstract_map import AbstractMap
from nuplan.common.maps.maps_datatypes import SemanticMapLayer, StopLineType

from shiftsim.arrays import FloatArray
from shiftsim.compat.nuplan.bridge.map_objects import (
    BridgeArea,
    BridgeIntersection,
    BridgeLane,
    BridgeLaneConnector,
    BridgeRoadBlock,
    BridgeStopLine,
)
from shiftsim.world.layers import Layer, nearest_of
from shiftsim.world.map import VectorMap


class _Span(NamedTuple):
    """One of nuPlan's layers: the objects `first` … `stop` - 1 of one of ours."""

    layer: Layer
    first: int
    stop: int
    make: Callable[[int], Any] | None


class BridgeMap(AbstractMap):
    """A `VectorMap` behind nuPlan's map interface.

    Attributes:
        source: The map.
    """

    def __init__(self, source: VectorMap) -> None:
        self.source = source
        self._made: dict[tuple[str, int], Any] = {}

    @property
    def map_name(self) -> str:
        """Name of the map."""
        return self.source.name

    @cached_property
    def _spans(self) -> dict[Any, _Span]:
        road, layers = self.source, SemanticMapLayer
        edges, blocks = road.edges, road.blocks
        lanes, roads = road.num_lanes, road.num_roadblocks
        spans = {
            layers.LANE: _Span(edges, 0, lanes, self.edge),
            layers.LANE_CONNECTOR: _Span(edges, lanes, len(edges), self.edge),
            layers.ROADBLOCK: _Span(blocks, 0, roads, self.block),
            layers.ROADBLOCK_CONNECTOR: _Span(blocks, roads, len(blocks), self.block),
        }
        wholes = {
            layers.STOP_LINE: (road.stop_polygons, self.stop_line),
            layers.INTERSECTION: (road.intersections, self.intersection),
            layers.CROSSWALK: (road.crosswalks, self._area_of("crosswalks")),
            layers.WALKWAYS: (road.walkways, self._area_of("walkways")),
            layers.CARPARK_AREA: (road.car_parks, self._area_of("car_parks")),
            layers.DRIVABLE_AREA: (road.drivable_areas, None),
        }
        for name, (layer, make) in wholes.items():
            spans[name] = _Span(layer, 0, len(layer), make)
        return spans

    @cached_property
    def _connector_lines(self) -> shapely.STRtree:
        lines = self.source.baselines
        connectors = range(self.source.num_lanes, len(self.source.edges))
        return shapely.STRtree([shapely.LineString(lines.at(edge)) for edge in connectors])

    def edge(self, index: int) -> Any:
        """Lane or lane connector number `index` of the map."""
        kind = BridgeLaneConnector if self.source.is_connector(index) else BridgeLane
        return self._once("edge", index, lambda: kind(self, index))

    def block(self, index: int) -> Any:
        """Roadblock or roadblock connector number `index` of the map."""
        return self._once("block", index, lambda: BridgeRoadBlock(self, index))

    def stop_line(self, index: int) -> Any:
        """Stop polygon number `index` of the map."""
        return self._once("stop line", index, lambda: BridgeStopLine(self, index))

    def intersection(self, index: int) -> Any:
        """Intersection number `index` of the map."""
        return self._once("intersection", index, lambda: BridgeIntersection(self, index))

    def _area_of(self, name: str) -> Callable[[int], Any]:
        layer: Layer = getattr(self.source, name)
        return lambda index: self._once(
            name, index, lambda: BridgeArea(layer.ids[index], layer.shape(index))
        )

    def _once(self, kind: str, index: int, make: Callable[[], Any]) -> Any:
        found = self._made.get((kind, index))
        if found is None:
            found = self._made[kind, index] = make()
        return found

    def get_available_map_objects(self) -> list[Any]:
        """Layers whose objects can be asked for."""
        return [layer for layer, span in self._spans.items() if span.make is not None]

    def get_map_object(self, object_id: str, layer: Any) -> Any:
        """The object of that id, or None."""
        span, make = self._objects(layer)
        index = span.layer.index.get(str(object_id), -1)
        return make(index) if span.first <= index < span.stop else None

    def get_all_map_objects(self, point: Any, layer: Any) -> list[Any]:
        """The objects whose areas hold a point in their interior."""
        span, make = self._objects(layer)
        return [make(index) for index in self._holding(span, point)]

    def get_one_map_object(self, point: Any, layer: Any) -> Any:
        """The only object whose area holds a point, or None."""
        found = self.get_all_map_objects(point, layer)
        assert len(found) < 2, (
            f"{len(found)} objects of layer {layer.name} hold the point; "
            "get_all_map_objects() gives them all"
        )
        return found[0] if found else None

    def get_proximal_map_objects(
        self, point: Any, radius: float, layers: Sequence[Any]
    ) -> dict[Any, list[Any]]:
        """Per layer the objects that meet an axis-parallel square of half width `radius` [m]."""
        unknown = [layer.name for layer in layers if layer not in self.get_available_map_objects()]
        assert not unknown, f"layers without objects: {', '.join(unknown)}"
        return {layer: self._near(point, radius, layer) for layer in layers}

    def _near(self, point: Any, radius: float, layer: Any) -> list[Any]:
        span, make = self._objects(layer)
        if layer == SemanticMapLayer.LANE_CONNECTOR:
            x, y = point.x, point.y
            square = shapely.box(x - radius, y - radius, x + radius, y + radius)
            found = self._connector_lines.query(square, predicate="intersects")
            return [make(span.first + line) for line in sorted(found.tolist())]
        near = span.layer.within_box(float(point.x), float(point.y), float(radius)).tolist()
        return [make(index) for index in near if span.first <= index < span.stop]

    def is_in_layer(self, point: Any, layer: Any) -> bool:
        """Whether an object of a layer holds a point in its interior."""
        if layer == SemanticMapLayer.TURN_STOP:
            kinds = self.source.stop_kinds
            lines = self._holding(self._span(SemanticMapLayer.STOP_LINE), point)
            return any(kinds[line] == int(StopLineType.TURN_STOP) for line in lines)
        if layer == SemanticMapLayer.LANE_CONNECTOR:
            place, lines = shapely.Point(point.x, point.y), self._connector_lines
            near = lines.geometries[lines.query(place)]
            return bool(shapely.contains(near, place).any())
        return bool(self._holding(self._span(layer), point))

    def get_distance_to_nearest_map_object(
        self, point: Any, layer: Any
    ) -> tuple[str | None, float | None]:
        """Id of the nearest object of a layer and its distance [m]; None where there is none."""
        span = self._span(layer)
        if span.first == span.stop:
            return None, None
        if layer == SemanticMapLayer.LANE_CONNECTOR:
            place, lines = shapely.Point(point.x, point.y), self._connector_lines
            index = int(lines.nearest(place))
            distance = float(lines.geometries[index].distance(place))
            return span.layer.ids[span.first + index], distance
        x, y = float(point.x), float(point.y)
        index, distance = nearest_of(span.layer.polygons, span.first, span.stop, x, y, np.inf)
        return span.layer.ids[index], float(distance)

    def get_distances_matrix_to_nearest_map_object(
        self, points: Sequence[Any], layer: Any
    ) -> FloatArray | None:
        """(N,) distances of points to the nearest object of a layer [m]."""
        found = [self.get_distance_to_nearest_map_object(point, layer)[1] for point in points]
        return None if None in found else np.array(found, np.float64)

    def initialize_all_layers(self) -> None:
        """Nothing to load."""

    def get_available_raster_layers(self) -> list[Any]:
        """None: a shiftsim map has no rasters."""
        return []

    def get_raster_map_layer(self, layer: Any) -> NoReturn:
        """Not possible.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError("maps of shiftsim have no raster layers")

    def get_raster_map(self, layers: Sequence[Any]) -> NoReturn:
        """Not possible; see `get_raster_map_layer`."""
        self.get_raster_map_layer(None)

    def get_distance_to_nearest_raster_layer(self, point: Any, layer: Any) -> NoReturn:
        """Not possible; see `get_raster_map_layer`."""
        self.get_raster_map_layer(layer)

    def _get_roadblock(self, roadblock_id: str) -> Any:  # private, and yet used by public planners
        return self.get_map_object(roadblock_id, SemanticMapLayer.ROADBLOCK)

    def _get_roadblock_connector(self, roadblock_connector_id: str) -> Any:
        return self.get_map_object(roadblock_connector_id, SemanticMapLayer.ROADBLOCK_CONNECTOR)

    def _span(self, layer: Any) -> _Span:
        try:
            return self._spans[layer]
        except KeyError:
            raise ValueError(f"maps of shiftsim have no layer {layer.name}") from None

    def _objects(self, layer: Any) -> tuple[_Span, Callable[[int], Any]]:
        span = self._span(layer)
        if span.make is None:
            raise ValueError(f"layer {layer.name} has no objects to ask for")
        return span, span.make

    def _holding(self, span: _Span, point: Any) -> list[int]:
        found = span.layer.containing(float(point.x), float(point.y)).tolist()
        return [index for index in found if span.first <= index < span.stop]
