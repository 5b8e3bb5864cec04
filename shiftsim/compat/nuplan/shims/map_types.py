"""Enumerations of the map, and what its objects have in common."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, TypeAlias

import shapely

from shiftsim.compat.nuplan.shims.geometry import Point2D


class SemanticMapLayer(IntEnum):
    """Layers of a map."""

    LANE, INTERSECTION, STOP_LINE, TURN_STOP, CROSSWALK, DRIVABLE_AREA, YIELD = range(7)
    TRAFFIC_LIGHT, STOP_SIGN, EXTENDED_PUDO, SPEED_BUMP, LANE_CONNECTOR = range(7, 12)
    BASELINE_PATHS, BOUNDARIES, WALKWAYS, CARPARK_AREA, PUDO = range(12, 17)
    ROADBLOCK, ROADBLOCK_CONNECTOR = 17, 18

    @classmethod
    def deserialize(cls, layer: str) -> "SemanticMapLayer":
        """A layer by its name."""
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
        """Its name."""
        return self.name

    @classmethod
    def deserialize(cls, key: str) -> "TrafficLightStatusType":
        """A status by its name."""
        return cls[key]


@dataclass
class TrafficLightStatusData:
    """What the light of a lane connector shows at a moment [us]."""

    status: TrafficLightStatusType
    lane_connector_id: int
    timestamp: int

    def serialize(self) -> dict[str, Any]:
        """As plain values."""
        return {**vars(self), "status": self.status.serialize()}

    @classmethod
    def deserialize(cls, data: dict[str, Any]) -> "TrafficLightStatusData":
        """From plain values."""
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

    left_boundary: Any
    right_boundary: Any

    def get_roadblock_id(self) -> str:
        """Id of its roadblock or roadblock connector."""
        raise NotImplementedError

    def is_same_roadblock(self, other: "LaneGraphEdgeMapObject") -> bool:
        """Whether another one is of the same roadblock."""
        return self.get_roadblock_id() == other.get_roadblock_id()

    def is_adjacent_to(self, other: "LaneGraphEdgeMapObject") -> bool:
        """Whether another one of the same roadblock shares a boundary."""
        return self.is_same_roadblock(other) and (
            self.right_boundary.id == other.left_boundary.id
            or self.left_boundary.id == other.right_boundary.id
        )


class Lane(LaneGraphEdgeMapObject):
    """A lane."""

    stop_lines: Any = ()

    def has_traffic_lights(self) -> bool:
        """False: lights belong to connectors."""
        return False


class LaneConnector(LaneGraphEdgeMapObject):
    """A lane across an intersection."""

    adjacent_edges: Any = (None, None)


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
