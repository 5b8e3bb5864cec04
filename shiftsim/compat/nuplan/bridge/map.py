"""The map interface over a `VectorMap`; a point is any object with x and y.

nuPlan rule 578: the table of lane connectors that most queries read holds lines, their areas are in
another one: proximity, distance and `is_in_layer` mean lines, `get_all_map_objects` means areas.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple, NoReturn

import numpy as np
import shapely

from nuplan.common.maps.abstract_map import AbstractMap
from nuplan.common.maps.maps_datatypes import SemanticMapLayer, StopLineType
from shiftsim.compat.nuplan.bridge.map_objects import CONNECTORS, KINDS
from shiftsim.kernels import FloatArray
from shiftsim.world.layers import Layer, nearest_of
from shiftsim.world.map import VectorMap

_LAYERS = SemanticMapLayer
_WHOLE = {  # layers of nuPlan that are one of ours
    _LAYERS.STOP_LINE: "stop_polygons",
    _LAYERS.INTERSECTION: "intersections",
    _LAYERS.CROSSWALK: "crosswalks",
    _LAYERS.WALKWAYS: "walkways",
    _LAYERS.CARPARK_AREA: "car_parks",
    _LAYERS.DRIVABLE_AREA: "drivable_areas",
}


class _Span(NamedTuple):
    """One of nuPlan's layers: the objects `first` … `stop` - 1 of one of ours, by its name."""

    name: str
    layer: Layer
    first: int
    stop: int


class BridgeMap(AbstractMap):
    """A `VectorMap` behind nuPlan's map interface."""

    def __init__(self, source: VectorMap) -> None:
        self.source = source
        self._by_index: dict[tuple[str, int], Any] = {}

    @property
    def map_name(self) -> str:
        return self.source.name

    @cached_property
    def _spans(self) -> dict[Any, _Span]:
        source = self.source
        lanes, edges = source.num_lanes, len(source.edges)
        roads, blocks = source.num_roadblocks, len(source.blocks)
        spans = {
            _LAYERS.LANE: _Span("edges", source.edges, 0, lanes),
            _LAYERS.LANE_CONNECTOR: _Span("edges", source.edges, lanes, edges),
            _LAYERS.ROADBLOCK: _Span("blocks", source.blocks, 0, roads),
            _LAYERS.ROADBLOCK_CONNECTOR: _Span("blocks", source.blocks, roads, blocks),
        }
        for kind, name in _WHOLE.items():
            layer: Layer = getattr(source, name)
            spans[kind] = _Span(name, layer, 0, len(layer))
        return spans

    @cached_property
    def _connector_lines(self) -> shapely.STRtree:
        lines = self.source.baselines
        connectors = range(self.source.num_lanes, len(self.source.edges))
        return shapely.STRtree([shapely.LineString(lines.at(edge)) for edge in connectors])

    def object(self, layer: str, index: int) -> Any:
        """Object number `index` of one of our layers, always the same one."""
        found = self._by_index.get((layer, index))
        if found is None:
            first = {"edges": self.source.num_lanes, "blocks": self.source.num_roadblocks}
            kinds = CONNECTORS if index >= first.get(layer, np.inf) else KINDS
            found = self._by_index[layer, index] = kinds[layer](
                self, getattr(self.source, layer), index
            )
        return found

    def objects(self, layer: Any) -> list[Any]:
        """All objects of a layer, in the order of the source; not part of nuPlan's interface."""
        span = self._span(layer)
        return [self.object(span.name, index) for index in range(span.first, span.stop)]

    def get_available_map_objects(self) -> list[Any]:
        """Layers whose objects can be asked for."""
        return [layer for layer in self._spans if layer != _LAYERS.DRIVABLE_AREA]

    def get_map_object(self, object_id: str, layer: Any) -> Any:
        """The object of that id, or None."""
        span = self._objects(layer)
        index = span.layer.index.get(str(object_id), -1)
        return self.object(span.name, index) if span.first <= index < span.stop else None

    def get_all_map_objects(self, point: Any, layer: Any) -> list[Any]:
        """The objects whose areas hold a point in their interior."""
        span = self._objects(layer)
        return [self.object(span.name, index) for index in self._holding(span, point)]

    def get_one_map_object(self, point: Any, layer: Any) -> Any:
        """The only object whose area holds a point, or None."""
        found = self.get_all_map_objects(point, layer)
        several = f"{len(found)} objects of layer {layer.name} hold the point"
        assert len(found) < 2, f"{several}; get_all_map_objects() gives them all"
        return found[0] if found else None

    def get_proximal_map_objects(
        self, point: Any, radius: float, layers: Sequence[Any]
    ) -> dict[Any, list[Any]]:
        """Per layer the objects that meet an axis-parallel square of half width `radius` [m]."""
        unknown = [layer.name for layer in layers if layer not in self.get_available_map_objects()]
        assert not unknown, f"layers without objects: {', '.join(unknown)}"
        return {layer: self._near(point, radius, layer) for layer in layers}

    def _near(self, point: Any, radius: float, layer: Any) -> list[Any]:
        span, x, y = self._objects(layer), float(point.x), float(point.y)
        if layer == _LAYERS.LANE_CONNECTOR:
            square = shapely.box(x - radius, y - radius, x + radius, y + radius)
            found = self._connector_lines.query(square, predicate="intersects")
            near = sorted((span.first + found).tolist())
        else:
            near = span.layer.within_box(x, y, float(radius)).tolist()
        return [self.object(span.name, i) for i in near if span.first <= i < span.stop]

    def is_in_layer(self, point: Any, layer: Any) -> bool:
        """Whether an object of a layer holds a point in its interior."""
        if layer == _LAYERS.TURN_STOP:
            kinds = self.source.stop_kinds
            lines = self._holding(self._span(_LAYERS.STOP_LINE), point)
            return any(kinds[line] == int(StopLineType.TURN_STOP) for line in lines)
        if layer == _LAYERS.LANE_CONNECTOR:
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
        if layer == _LAYERS.LANE_CONNECTOR:
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

    def get_raster_map_layer(self, *layers: Any, **named: Any) -> NoReturn:
        """Not possible: raises NotImplementedError."""
        raise NotImplementedError("maps of shiftsim have no raster layers")

    get_raster_map = get_distance_to_nearest_raster_layer = get_raster_map_layer

    def _get_roadblock(self, roadblock_id: str) -> Any:  # private, and yet used by public planners
        return self.get_map_object(roadblock_id, _LAYERS.ROADBLOCK)

    def _get_roadblock_connector(self, roadblock_connector_id: str) -> Any:
        return self.get_map_object(roadblock_connector_id, _LAYERS.ROADBLOCK_CONNECTOR)

    def _span(self, layer: Any) -> _Span:
        try:
            return self._spans[layer]
        except KeyError:
            raise ValueError(f"maps of shiftsim have no layer {layer.name}") from None

    def _objects(self, layer: Any) -> _Span:
        span = self._span(layer)
        if layer == _LAYERS.DRIVABLE_AREA:
            raise ValueError(f"layer {layer.name} has no objects to ask for")
        return span

    def _holding(self, span: _Span, point: Any) -> list[int]:
        found = span.layer.containing(float(point.x), float(point.y)).tolist()
        return [index for index in found if span.first <= index < span.stop]
