"""What words and codes of open data sets mean: kinds of objects, lanes, lights, stop polygons."""

from shiftsim.world.state import AgentKind, LightStatus

LIGHT_STOP, OTHER_STOP = 2, 5  # types of stop polygons, as nuPlan counts them

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


def _codes(count: int, **groups: str) -> dict[int, AgentKind]:
    out = dict.fromkeys(range(count), AgentKind.GENERIC_OBJECT)
    for kind, codes in groups.items():
        out |= dict.fromkeys(map(int, codes.split()), AgentKind[kind.upper()])
    return out


# by class of labels: kind of every label
LABELS = {
    "DefaultBoxDetectionLabel": _codes(
        12, vehicle="0 1 2", bicycle="3", pedestrian="4", traffic_cone="7", barrier="9"
    ),
    "WODMotionBoxDetectionLabel": _codes(5, vehicle="1", pedestrian="2", bicycle="3"),
    "WODPerceptionBoxDetectionLabel": _codes(5, vehicle="1", pedestrian="2", bicycle="4"),
    "NuScenesBoxDetectionLabel": _codes(
        23,
        vehicle="0 1 2 3 4 5 6 7",
        bicycle="8 9",
        pedestrian="10 11 12 13 14 15 16",
        traffic_cone="17",
        barrier="18",
    ),
    "AV2SensorBoxDetectionLabel": _codes(
        30,
        vehicle="1 5 6 10 17 18 19 24 25 26",
        bicycle="3 14 29",
        pedestrian="15 16 22 27",
        traffic_cone="7 8",
        czone_sign="12",
    ),
    "NuPlanBoxDetectionLabel": _codes(
        7, vehicle="0", bicycle="1", pedestrian="2", traffic_cone="3", barrier="4", czone_sign="5"
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
