"""The map interface over a `VectorMap`; a point is any object with x and y.

Objects of a map are made when asked for; each one knows its map and its index there. Their classes
have nuPlan's names, by which planners tell them apart.

nuPlan rule 578: the table of lane connectors that most queries read holds lines, their areas are in
another one: proximity, distance and `is_in_layer` mean lines, `get_all_map_objects` means areas.
"""

from collections import defaultdict
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple, NoReturn

import numpy as np
import shapely

from nuplan.common.actor_state.state_representation import Point2D, StateSE2
from nuplan.common.maps.abstract_map import AbstractMap, SemanticMapLayer
from nuplan.common.maps.abstract_map_objects import (
    Intersection,
    Lane,
    LaneConnector,
    PolygonMapObject,
    PolylineMapObject,
    RoadBlockGraphEdgeMapObject,
    StopLine,
)
from nuplan.common.maps.maps_datatypes import IntersectionType, LaneConnectorType, StopLineType
from shiftsim.compat.nuplan.shims.geometry import derived, part
from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray
from shiftsim.world.layers import Layer, Lists, nearest_of
from shiftsim.world.map import NONE, VectorMap

_LAYERS = SemanticMapLayer
_HEADING_STEP = 0.5  # m, nuPlan polyline map object
_CURVATURE_STEP = 2.0  # m, nuPlan polyline map object
_FLAT = 1e-6  # m^4, sixteen squared areas of a triangle below which a line counts as straight


def _not_in_nuplan(name: str) -> Any:
    """A property for what nuPlan's interface names and its own map does not have either."""

    def refuse(holder: Any) -> Any:
        raise NotImplementedError(f"{type(holder).__name__}.{name}: not in nuPlan either")

    return property(refuse)


class NuPlanPolylineMapObject(PolylineMapObject):
    """A line: baseline or boundary."""

    def __init__(self, line_id: str, xy: FloatArray) -> None:
        self.id = line_id
        self._xy = xy

    @cached_property
    def linestring(self) -> shapely.LineString:
        return shapely.LineString(self._xy)

    length = derived(lambda self: float(self.linestring.length), "Length [m].")

    @cached_property
    def discrete_path(self) -> list[Any]:
        """Poses at the vertices, heading for the next one; the last two have the same heading."""
        step = np.diff(self._xy, axis=0)
        headings = np.arctan2(step[:, 1], step[:, 0])
        rows = np.c_[self._xy, np.append(headings, headings[-1])]
        return [StateSE2(*row) for row in rows.tolist()]

    def get_nearest_arc_length_from_position(self, point: Point2D) -> float:
        """Where along the line it is nearest to a point [m]."""
        return float(self.linestring.project(shapely.Point(point.x, point.y)))

    def get_nearest_pose_from_position(self, point: Point2D) -> Any:
        """The nearest point of the line, heading for the point 0.5 m further on it."""
        # nuPlan rule 601: at the end of the line the heading is that of its last 0.5 m
        arc = self.get_nearest_arc_length_from_position(point)
        here, behind, ahead = (
            self._point(arc + offset) for offset in (0.0, -_HEADING_STEP, _HEADING_STEP)
        )
        step = here - behind if (here == ahead).all() else ahead - here
        return StateSE2(*here.tolist(), float(np.arctan2(step[1], step[0])))

    def get_curvature_at_arc_length(self, arc_length: float) -> float:
        """Curvature of the circle through three points 2 m apart, positive to the left [1/m].

        nuPlan rule 605: near the ends of the line the middle one is moved inward.
        """
        assert 0.0 <= arc_length <= self.length, f"{arc_length} m is not on the line"
        half = min(_CURVATURE_STEP, 0.5 * self.length)
        middle = min(max(arc_length, half), self.length - half)
        before, here, after = (self._point(middle + offset) for offset in (-half, 0.0, half))
        first, second = here - before, after - here
        a, b, c = np.hypot(*first), np.hypot(*second), np.hypot(*(before - after))
        # Heron: sixteen times the squared area of the triangle
        squared = (a + (b + c)) * (c - (a - b)) * (c + (a - b)) * (a + (b - c))
        if squared < _FLAT:
            return 0.0
        side = np.sign(first[0] * (after - before)[1] - first[1] * (after - before)[0])
        return float(side * np.sqrt(squared) / (a * b * c))

    def _point(self, arc: float) -> FloatArray:
        # negative distances would count from the end
        return np.array(self.linestring.interpolate(max(arc, 0.0)).coords[0])


class _Mapped:
    """An object of one of our layers, `id` its id there; `owner` is the `BridgeMap`."""

    def __init__(self, owner: Any, layer: Layer, index: int) -> None:
        self._map, self._layer, self._index = owner, layer, index
        self._source: VectorMap = owner.source
        self.id = layer.ids[index]

    @cached_property
    def polygon(self) -> shapely.Polygon:
        return self._layer.shape(self._index)


def _number(table: str, kind: Any, doc: str) -> Any:
    """A property: the number of this object in a table of the map, as a kind of numbers."""
    return derived(lambda mapped: kind(int(getattr(mapped._source, table)[mapped._index])), doc)


def _linked(table: str, layer: str) -> Any:
    """A property: the objects of a layer that a table of the map lists for this one."""

    def find(mapped: _Mapped) -> list[Any]:
        found: Lists = getattr(mapped._source, table)
        return [mapped._map.object(layer, i) for i in found.at(mapped._index).tolist()]

    return cached_property(find)


def _boundary(side: int, name: str) -> Any:
    """A property: the line on the left (0) or right (1) of an edge."""

    def find(edge: _Mapped) -> NuPlanPolylineMapObject:
        xy: FloatArray = getattr(edge._source, f"{name}_boundaries").at(edge._index)
        if len(xy) < 2:
            raise MapError(f"map {edge._map.map_name!r}: {edge.id!r} has no {name} boundary")
        return NuPlanPolylineMapObject(edge._source.boundary_ids[edge._index][side], xy)

    return cached_property(find)


class _Edge(_Mapped):
    """What lanes and lane connectors share."""

    parallel_edges = _not_in_nuplan("parallel_edges")
    get_width_left_right = _not_in_nuplan("get_width_left_right")
    oriented_distance = _not_in_nuplan("oriented_distance")

    incoming_edges = _linked("incoming", "edges")
    outgoing_edges = _linked("outgoing", "edges")
    stop_lines = _linked("stop_lines", "stop_polygons")  # where its lights make one stop
    left_boundary = _boundary(0, "left")
    right_boundary = _boundary(1, "right")

    @cached_property
    def baseline_path(self) -> NuPlanPolylineMapObject:
        return NuPlanPolylineMapObject(self.id, self._source.baselines.at(self._index))

    @property
    def speed_limit_mps(self) -> float | None:
        """[m/s]; None where the map has none."""
        limit = float(self._source.speed_limits[self._index])
        return None if np.isnan(limit) else limit

    @property
    def parent(self) -> Any:
        """Its roadblock or roadblock connector; None where the map names an unknown one."""
        block = int(self._source.block_of[self._index])
        return None if block == NONE else self._map.object("blocks", block)

    def get_roadblock_id(self) -> str:
        return "" if self.parent is None else str(self.parent.id)

    def has_traffic_lights(self) -> bool:
        return bool(self._source.has_traffic_lights[self._index])


class NuPlanLane(_Edge, Lane):
    """A lane."""

    index = _number("lane_index", int, "Position in the roadblock, 0 leftmost.")

    def is_left_of(self, other: Any) -> bool:
        """Whether it is further left in the same roadblock."""
        assert self.is_same_roadblock(other), "lanes of different roadblocks"
        return self.index < other.index

    def is_right_of(self, other: Any) -> bool:
        """Whether it is further right in the same roadblock."""
        assert self.is_same_roadblock(other), "lanes of different roadblocks"
        return self.index > other.index

    def is_adjacent_to(self, other: Any) -> bool:
        """Whether it is the next one on the left or right in the same roadblock."""
        return other in self.adjacent_edges and self.is_same_roadblock(other)

    @property
    def adjacent_edges(self) -> tuple[Any, Any]:
        """The lanes on the left and on the right, or None."""
        source, index = self._source, self._index
        sides = int(source.left_lane[index]), int(source.right_lane[index])
        left, right = (None if side == NONE else self._map.object("edges", side) for side in sides)
        return left, right


class NuPlanLaneConnector(_Edge, LaneConnector):
    """A lane across an intersection."""

    adjacent_edges = (None, None)
    turn_type = _number("turn_type", LaneConnectorType, "Where it leads.")

    def is_left_of(self, other: Any) -> bool:
        """False: connectors have no neighbours."""
        return False

    is_right_of = is_left_of


class _Block(_Mapped, RoadBlockGraphEdgeMapObject):
    """What roadblocks and roadblock connectors share."""

    parallel_edges = _not_in_nuplan("parallel_edges")
    children_stop_lines = _not_in_nuplan("children_stop_lines")

    incoming_edges = _linked("block_incoming", "blocks")
    outgoing_edges = _linked("block_outgoing", "blocks")
    interior_edges = _linked("block_edges", "edges")  # its lanes or lane connectors

    @property
    def intersection(self) -> Any:
        """The intersection of a roadblock connector, or None."""
        edges = self._source.block_edges.at(self._index).tolist()
        where = {int(self._source.intersection_of[i]) for i in edges} - {NONE}
        return self._map.object("intersections", min(where)) if where else None


class NuPlanRoadBlock(_Block):
    """A roadblock."""


class NuPlanRoadBlockConnector(_Block):
    """A roadblock connector."""


class NuPlanStopLine(_Mapped, StopLine):
    """Where one stops."""

    intersection_from = _not_in_nuplan("intersection_from")
    parent = _not_in_nuplan("parent")
    layer_type = stop_line_type = _number("stop_kinds", StopLineType, "What one stops for.")


class NuPlanIntersection(_Mapped, Intersection):
    """Where roads meet."""

    interior_edges = _not_in_nuplan("interior_edges")
    incoming_edges = _not_in_nuplan("incoming_edges")
    is_signaled = _not_in_nuplan("is_signaled")
    # nuPlan rule 577: its map never says of which kind an intersection is
    intersection_type = IntersectionType.DEFAULT


class NuPlanPolygonMapObject(_Mapped, PolygonMapObject):
    """A crosswalk, a walkway, a car park or a drivable area."""


# by layer of nuPlan: ours that it is or is a part of, and the class of its objects
_KINDS: dict[Any, tuple[str, type[Any]]] = {
    _LAYERS.LANE: ("edges", NuPlanLane),
    _LAYERS.LANE_CONNECTOR: ("edges", NuPlanLaneConnector),
    _LAYERS.ROADBLOCK: ("blocks", NuPlanRoadBlock),
    _LAYERS.ROADBLOCK_CONNECTOR: ("blocks", NuPlanRoadBlockConnector),
    _LAYERS.STOP_LINE: ("stop_polygons", NuPlanStopLine),
    _LAYERS.INTERSECTION: ("intersections", NuPlanIntersection),
    _LAYERS.CROSSWALK: ("crosswalks", NuPlanPolygonMapObject),
    _LAYERS.WALKWAYS: ("walkways", NuPlanPolygonMapObject),
    _LAYERS.CARPARK_AREA: ("car_parks", NuPlanPolygonMapObject),
    _LAYERS.DRIVABLE_AREA: ("drivable_areas", NuPlanPolygonMapObject),
}


class _Span(NamedTuple):
    """One of nuPlan's layers: the objects `first` … `stop` - 1 of one of ours, by its name."""

    name: str
    layer: Layer
    first: int
    stop: int
    kind: type[Any]  # class of its objects


class BridgeMap(AbstractMap):
    """A `VectorMap` behind nuPlan's map interface."""

    def __init__(self, source: VectorMap) -> None:
        self.source = source
        self._by_index: dict[tuple[str, int], Any] = {}
        self._trees: dict[int, shapely.STRtree] = {}

    map_name = part("source.name", "Its name.")

    @cached_property
    def _spans(self) -> dict[Any, _Span]:
        firsts = {"edges": self.source.num_lanes, "blocks": self.source.num_roadblocks}
        spans = {}
        for key, (name, kind) in _KINDS.items():
            layer: Layer = getattr(self.source, name)
            middle = firsts.get(name, len(layer))  # connectors come last
            first, stop = (middle, len(layer)) if "CONNECTOR" in key.name else (0, middle)
            spans[key] = _Span(name, layer, first, stop, kind)
        return spans

    def _lines(self, first: int) -> shapely.STRtree:
        """The baselines of edges from a number on."""
        if first not in self._trees:
            lines = map(self.source.baselines.at, range(first, len(self.source.edges)))
            self._trees[first] = shapely.STRtree([shapely.LineString(line) for line in lines])
        return self._trees[first]

    def object(self, layer: str, index: int) -> Any:
        """Object number `index` of one of our layers, always the same one."""
        found = self._by_index.get((layer, index))
        if found is None:
            spans = (span for span in self._spans.values() if span.name == layer)
            span = next(span for span in spans if span.first <= index < span.stop)
            found = self._by_index[layer, index] = span.kind(self, span.layer, index)
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
        return defaultdict(list, {layer: self._near(point, radius, layer) for layer in layers})

    def _near(self, point: Any, radius: float, layer: Any) -> list[Any]:
        span, x, y = self._objects(layer), float(point.x), float(point.y)
        if layer == _LAYERS.LANE_CONNECTOR:
            square = shapely.box(x - radius, y - radius, x + radius, y + radius)
            found = self._lines(span.first).query(square, predicate="intersects")
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
            place = shapely.Point(point.x, point.y)
            return bool(self._lines(self.source.num_lanes).query(place, predicate="within").size)
        return bool(self._holding(self._span(layer), point))

    def get_distance_to_nearest_map_object(
        self, point: Any, layer: Any
    ) -> tuple[str | None, float | None]:
        """Id of the nearest object of a layer and its distance [m]; None where there is none."""
        is_any_line = layer == _LAYERS.BASELINE_PATHS  # which has the id of its edge
        span = self._span(_LAYERS.LANE if is_any_line else layer)
        if span.first == span.stop:
            return None, None
        if is_any_line or layer == _LAYERS.LANE_CONNECTOR:
            place, lines = shapely.Point(point.x, point.y), self._lines(span.first)
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
        if layer not in self._spans:
            raise ValueError(f"maps of shiftsim have no layer {layer.name}")
        return self._spans[layer]

    def _objects(self, layer: Any) -> _Span:
        span = self._span(layer)
        if layer == _LAYERS.DRIVABLE_AREA:
            raise ValueError(f"layer {layer.name} has no objects to ask for")
        return span

    def _holding(self, span: _Span, point: Any) -> list[int]:
        found = span.layer.containing(float(point.x), float(point.y)).tolist()
        return [index for index in found if span.first <= index < span.stop]
