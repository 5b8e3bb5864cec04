"""What words and codes of data sets mean: categories, parts of lanes, lights, stop polygons."""

from dataclasses import dataclass
from typing import Any

from shiftsim.data.maps.segments import LanePiece
from shiftsim.data.readers.files import SourceFile
from shiftsim.world.state import AgentKind, LightStatus

LIGHT_STOP, OTHER_STOP = 2, 5  # types of stop polygons, as nuPlan counts them

# --- Categories of DSC3D and of tables of tracks


def _kinds(**names: str) -> dict[str, AgentKind]:
    return {word: AgentKind[kind.upper()] for kind, text in names.items() for word in text.split()}


CATEGORIES = _kinds(
    vehicle="car vehicle van pickup truck bus trailer tram train construction_vehicle"
    " agricultural_vehicle emergency_vehicle",
    bicycle="motorcycle bicycle cyclist scooter e_scooter escooter moped",
    pedestrian="pedestrian person stroller wheelchair",
    generic_object="animal bicycle_rack movable_object static_object generic_object",
)  # nuPlan rule 462: it has no class for motorcycles
KIND_NAMES = {kind.name.lower(): kind for kind in AgentKind}
KINDS = {
    **CATEGORIES,
    **_kinds(
        vehicle="truck_bus lorry automobile taxi hgv suv medium_vehicle heavy_vehicle",
        pedestrian="ped walker passer_by pedestrian/bicycle",
        bicycle="motorcyclist motorbike bike rider tricycle",
    ),
    **KIND_NAMES,
    "cone": AgentKind.TRAFFIC_CONE,
    "static": AgentKind.GENERIC_OBJECT,
    "unknown": AgentKind.GENERIC_OBJECT,
}
SAME = dict.fromkeys(("passenger", "automobile", "default_vehtype"), "car")  # other words
SIZES = {  # length and width of objects of unknown size [m]
    AgentKind.VEHICLE: (4.6, 1.9),
    AgentKind.BICYCLE: (1.8, 0.6),
    AgentKind.PEDESTRIAN: (0.7, 0.7),
    AgentKind.TRAFFIC_CONE: (0.4, 0.4),
    AgentKind.BARRIER: (2.0, 0.5),
    AgentKind.CZONE_SIGN: (0.5, 0.5),
    AgentKind.GENERIC_OBJECT: (1.0, 1.0),
}
_LONG = "bus truck lorry hgv truck_bus heavy_vehicle"
LARGE = {**dict.fromkeys(_LONG.split(), (12.0, 2.5)), "medium_vehicle": (6.0, 2.2)}  # by category


def normalise_category(name: str) -> str:
    """A category in lower case with underscores."""
    return name.strip().lower().replace(" ", "_").replace("-", "_")


# --- Argoverse 2 motion forecasting

# by type of object: kind, and usual length and width [m], which the files lack
TYPES = {
    "vehicle": (AgentKind.VEHICLE, 4.6, 1.9),
    "bus": (AgentKind.VEHICLE, 11.6, 2.9),
    "cyclist": (AgentKind.BICYCLE, 1.8, 0.6),
    "motorcyclist": (AgentKind.BICYCLE, 2.2, 0.8),
    "pedestrian": (AgentKind.PEDESTRIAN, 0.7, 0.7),
    "construction": (AgentKind.CZONE_SIGN, 0.5, 0.5),
    "riderless_bicycle": (AgentKind.GENERIC_OBJECT, 1.6, 0.5),
    "static": (AgentKind.GENERIC_OBJECT, 1.0, 1.0),
    "unknown": (AgentKind.GENERIC_OBJECT, 1.0, 1.0),
}

# --- CommonRoad

# by type of obstacle; others are generic objects
OBSTACLES = {
    **dict.fromkeys(
        "car truck bus taxi priorityVehicle parkedVehicle train".split(), AgentKind.VEHICLE
    ),
    **dict.fromkeys(("bicycle", "motorcycle"), AgentKind.BICYCLE),
    "pedestrian": AgentKind.PEDESTRIAN,
}
# by type of lanelet: those on which cars do not drive, and those of them where no car may be at all
NO_LANES = frozenset(
    "bicycleLane busStop sidewalk crosswalk shoulder parking border restricted_area".split()
)
UNPAVED = frozenset(("sidewalk", "crosswalk", "bicycleLane"))
SPEED_SIGNS = ("274", "R2-1", "r301")  # maximum speed, by country
COLORS = {  # by colour; others are unknown
    "green": LightStatus.GREEN,
    "yellow": LightStatus.YELLOW,
    "red": LightStatus.RED,
    "redYellow": LightStatus.RED,
}

# --- py123d


def _codes(count: int, text: str) -> dict[int, AgentKind]:
    """Kind of every label; those that the text does not name are generic objects."""
    out = dict.fromkeys(range(count), AgentKind.GENERIC_OBJECT)
    for kind, *codes in map(str.split, text.split(";")):
        out |= dict.fromkeys(map(int, codes), AgentKind[kind.upper()])
    return out


LABELS = {  # by class of labels
    "DefaultBoxDetectionLabel": _codes(
        12, "vehicle 0 1 2; bicycle 3; pedestrian 4; traffic_cone 7; barrier 9"
    ),
    "WODMotionBoxDetectionLabel": _codes(5, "vehicle 1; pedestrian 2; bicycle 3"),
    "WODPerceptionBoxDetectionLabel": _codes(5, "vehicle 1; pedestrian 2; bicycle 4"),
    "NuScenesBoxDetectionLabel": _codes(
        23,
        "vehicle 0 1 2 3 4 5 6 7; bicycle 8 9; pedestrian 10 11 12 13 14 15 16; traffic_cone 17;"
        "barrier 18",
    ),
    "AV2SensorBoxDetectionLabel": _codes(
        30,
        "vehicle 1 5 6 10 17 18 19 24 25 26; bicycle 3 14 29; pedestrian 15 16 22 27;"
        "traffic_cone 7 8; czone_sign 12",
    ),
    "NuPlanBoxDetectionLabel": _codes(
        7, "vehicle 0; bicycle 1; pedestrian 2; traffic_cone 3; barrier 4; czone_sign 5"
    ),
}
LIGHTS = dict(enumerate((LightStatus.GREEN, LightStatus.YELLOW, LightStatus.RED)))
# type of a stop polygon
STOPS: dict[int | None, int] = dict(enumerate((OTHER_STOP, LIGHT_STOP, 1, 4, 0, 3)))
_LAYERS = "lane, lane group, intersection, crosswalk, walkway, car park, drivable area, stop zone"
LAYERS = dict(enumerate(_LAYERS.split(", ")))  # of the map
BIKE_LANE = 3  # type of a lane
LICENCES = {  # by what names of data sets begin with
    "av2": "CC BY-NC-SA 4.0",
    "nuscenes": "CC BY-NC-SA 4.0",
    "wod": "Waymo Open Dataset License Agreement for Non-Commercial Use",
}

# --- Parts of lanes


@dataclass(frozen=True)
class LaneNames:
    """What a data set calls the parts of a lane in the direction of travel."""

    line: Any  # form of a line, see `SourceFile.expect`
    borders: tuple[str, str]  # left and right, as `line`
    center: str  # as `line`; may be missing
    successors: str  # list of ids, may be missing
    neighbors: tuple[str, str]  # left and right, ids, may be missing
    speed_limit: str | None = None  # [m/s], may be missing

    @property
    def form(self) -> dict[Any, Any]:
        """The form of a lane."""
        return {
            **dict.fromkeys(self.borders, self.line),
            self.center: (self.line,),
            self.successors: ([int],),
            **dict.fromkeys(self.neighbors, (int,)),
            self.speed_limit: (float,),
        }

    def piece(self, source: SourceFile, lane: dict[Any, Any], name: str, **more: Any) -> LanePiece:
        """The piece that a lane of this form is; `more` are fields with names of their own."""
        lines = [key for key in (*self.borders, self.center) if lane.get(key) is not None]
        left, right, *center = (source.line(lane[i], f"lane {name}: {i!r}") for i in lines)
        limit = lane.get(self.speed_limit)
        if limit is not None:
            source.require("speed limit", limit, f"lane {name}: {self.speed_limit!r}")
        beside = [None if lane.get(i) is None else str(lane[i]) for i in self.neighbors]
        return LanePiece(
            name,
            left,
            right,
            next(iter(center), None),
            successors=tuple(map(str, lane.get(self.successors) or ())),
            left_neighbor=beside[0],
            right_neighbor=beside[1],
            speed_limit=limit,
            **more,
        )
