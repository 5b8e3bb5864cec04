"""Enumerations of the map, and what its objects have in common."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

import shapely

from shiftsim.compat.nuplan.shims.geometry import Point2D, derived


class SemanticMapLayer(IntEnum):
    """Layers of a map."""

    LANE, INTERSECTION, STOP_LINE, TURN_STOP, CROSSWALK, DRIVABLE_AREA, YIELD = range(7)
    TRAFFIC_LIGHT, STOP_SIGN, EXTENDED_PUDO, SPEED_BUMP, LANE_CONNECTOR = range(7, 12)
    BASELINE_PATHS, BOUNDARIES, WALKWAYS, CARPARK_AREA, PUDO = range(12, 17)
    ROADBLOCK, ROADBLOCK_CONNECTOR = 17, 18

    @classmethod
    def deserialize(cls, layer: str) -> "SemanticMapLayer":
        return cls[layer]


# numbered from 0, as in nuPlan's map
LaneConnectorType = IntEnum(
    "LaneConnectorType", ["STRAIGHT", "LEFT", "RIGHT", "UTURN", "UNKNOWN"], start=0
)
StopLineType = IntEnum(
    "StopLineType",
    ["PED_CROSSING", "STOP_SIGN", "TRAFFIC_LIGHT", "TURN_STOP", "YIELD", "UNKNOWN"],
    start=0,
)
IntersectionType = IntEnum(
    "IntersectionType",
    ["DEFAULT", "TRAFFIC_LIGHT", "STOP_SIGN", "LANE_BRANCH", "LANE_MERGE", "PASS_THROUGH"],
    start=0,
)


class TrafficLightStatusType(IntEnum):
    """What a traffic light shows."""

    GREEN, YELLOW, RED, UNKNOWN = range(4)

    def serialize(self) -> str:
        return self.name

    @classmethod
    def deserialize(cls, key: str) -> "TrafficLightStatusType":
        return cls[key]


@dataclass
class TrafficLightStatusData:
    """What the light of a lane connector shows at a moment [us]."""

    status: TrafficLightStatusType
    lane_connector_id: int
    timestamp: int

    def serialize(self) -> dict[str, Any]:
        return {**vars(self), "status": self.status.serialize()}

    @classmethod
    def deserialize(cls, data: dict[str, Any]) -> "TrafficLightStatusData":
        return cls(**{**data, "status": TrafficLightStatusType.deserialize(data["status"])})


class AbstractMap:
    """A map: `shiftsim.compat.nuplan.bridge.map` has the methods."""


class AbstractMapObject:
    """Something on a map, with an id that is unique within its layer."""

    def __init__(self, object_id: str) -> None:
        self.id = str(object_id)


MapObject: TypeAlias = Any


class PolygonMapObject(AbstractMapObject):
    """Something with an area, `polygon`."""

    polygon: Any

    def contains_point(self, point: Point2D) -> bool:
        """Whether a point is in the interior."""
        return bool(self.polygon.contains(shapely.Point(point.x, point.y)))


class PolylineMapObject(AbstractMapObject):
    """A line."""

    get_nearest_arc_length_from_position: Any
    get_curvature_at_arc_length: Any

    def get_nearest_curvature_from_position(self, point: Point2D) -> float:
        """Signed curvature where the line is nearest to a point [1/m]."""
        arc_length = self.get_nearest_arc_length_from_position(point)
        return float(self.get_curvature_at_arc_length(arc_length))


class GraphEdgeMapObject(PolygonMapObject):
    """Something that leads from somewhere to somewhere."""


class LaneGraphEdgeMapObject(GraphEdgeMapObject):
    """A lane or a lane connector."""

    get_roadblock_id: Any  # of its roadblock or roadblock connector

    def is_same_roadblock(self, other: "LaneGraphEdgeMapObject") -> bool:
        return bool(self.get_roadblock_id() == other.get_roadblock_id())


class Lane(LaneGraphEdgeMapObject):
    """A lane."""


class LaneConnector(LaneGraphEdgeMapObject):
    """A lane across an intersection."""


class RoadBlockGraphEdgeMapObject(GraphEdgeMapObject):
    """A roadblock or a roadblock connector."""


class StopLine(PolygonMapObject):
    """Where one stops."""

    def __init__(self, stop_line_id: str, stop_line_type: StopLineType) -> None:
        super().__init__(stop_line_id)
        self.stop_line_type = stop_line_type


class Intersection(PolygonMapObject):
    """Where roads meet."""

    def __init__(self, intersection_id: str, intersection_type: IntersectionType) -> None:
        super().__init__(intersection_id)
        self.intersection_type = intersection_type


Geometry: TypeAlias = shapely.Polygon | shapely.LineString


# nuplan.planning.simulation.occupancy_map
class OccupancyMap:
    """Geometries by id."""

    def __init__(self, geom_map: dict[str, Geometry]) -> None:
        self._geom_map = geom_map

    size = derived(lambda self: len(self._geom_map), "How many there are.")

    def __len__(self) -> int:
        return len(self._geom_map)

    def is_empty(self) -> bool:
        return not self._geom_map

    def contains(self, geometry_id: str) -> bool:
        return geometry_id in self._geom_map

    def get(self, geometry_id: str) -> Geometry:
        return self._geom_map[geometry_id]

    def insert(self, geometry_id: str, geometry: Geometry) -> None:
        """Add one, or replace it."""
        self._geom_map[geometry_id] = geometry

    set = insert

    def remove(self, geometry_ids: list[str]) -> None:
        """Remove some; all must be there."""
        for name in geometry_ids:
            assert name in self._geom_map, f"the occupancy map has no geometry {name!r}"
            del self._geom_map[name]

    def get_all_ids(self) -> list[str]:
        return list(self._geom_map)

    def get_all_geometries(self) -> list[Geometry]:
        return list(self._geom_map.values())

    def get_nearest_entry_to(self, geometry_id: str) -> tuple[str, Geometry, float]:
        """Id, geometry and distance [m] of what is nearest to one of the geometries."""
        assert self.contains(geometry_id), f"the occupancy map has no geometry {geometry_id!r}"
        # nuPlan rule 610: what it leaves out is every id that is a part of the given one
        others = {name: item for name, item in self._geom_map.items() if name not in geometry_id}
        geometry = self.get(geometry_id)
        tree, names = type(self)(others)._build_strtree()
        nearest = names[tree.nearest(geometry)]
        return nearest, self.get(nearest), float(geometry.distance(self.get(nearest)))

    def intersects(self, geometry: Geometry) -> "OccupancyMap":
        """The part of the map that shares a point with a geometry."""
        tree, names = self._build_strtree()
        found = [names[index] for index in tree.query(geometry, predicate="intersects")]
        return type(self)({name: self.get(name) for name in found})

    def _build_strtree(self) -> tuple[shapely.STRtree, dict[int, str]]:
        """Index of the geometries, and their ids by number; public planners call it."""
        return shapely.STRtree(self.get_all_geometries()), dict(enumerate(self._geom_map))


class STRTreeOccupancyMap(OccupancyMap):
    """The same."""


class STRTreeOccupancyMapFactory:
    """Makes occupancy maps."""

    @staticmethod
    def get_from_boxes(scene_objects: list[Any]) -> OccupancyMap:
        """The boxes of objects, by the tokens of their tracks; objects without one are left out."""
        boxes = ((item.track_token, item.box.geometry) for item in scene_objects)
        return STRTreeOccupancyMap({token: box for token, box in boxes if token is not None})

    @staticmethod
    def get_from_geometry(
        geometries: list[Geometry], geometry_ids: list[str] | None = None
    ) -> OccupancyMap:
        """Geometries by the ids given, or by their numbers."""
        names = range(len(geometries)) if geometry_ids is None else geometry_ids
        pairs = zip(names, geometries, strict=False)
        return STRTreeOccupancyMap({str(name): geometry for name, geometry in pairs})


# nuplan.planning.simulation.planner.utils.breadth_first_search
class BreadthFirstSearch:
    """Searches lane by lane for a roadblock, among lanes of given ids."""

    def __init__(self, start_edge: Any, candidate_lane_edge_ids: list[str]) -> None:
        self._start, self._candidates = start_edge, set(candidate_lane_edge_ids)

    def search(self, target_roadblock: Any, target_depth: int) -> tuple[list[Any], bool]:
        """Edges that lead to a roadblock, which is number `target_depth` of them, and True.

        Where there are none: the way to the edge that was found last, and False.
        """
        parents: list[dict[str, Any]] = [{}, {self._start.id: None}]  # by depth, the start has 1
        edge, depth, level = self._start, 1, [self._start]
        for here in range(1, target_depth + 1):
            parents.append({})
            following = []
            for current in level:
                is_there = current.get_roadblock_id() == target_roadblock.id
                if is_there and here == target_depth:
                    return self._way(current, here, parents), True
                for after in current.outgoing_edges:
                    if after.id in self._candidates:
                        following.append(after)
                        parents[here + 1][after.id] = current
                        edge, depth = after, here + 1
            level = following
        return self._way(edge, depth, parents), False

    @staticmethod
    def _way(edge: Any, depth: int, parents: list[dict[str, Any]]) -> list[Any]:
        way = [edge]
        while (edge := parents[depth][edge.id]) is not None:
            way.append(edge)
            depth -= 1
        return way[::-1]


# nuplan.common.maps.nuplan_map.utils
def get_distance_between_map_object_and_point(point: Point2D, map_object: Any) -> float:
    """Distance of a point from the area of an object, 0 inside [m]."""
    return float(shapely.Point(point.x, point.y).distance(map_object.polygon))
