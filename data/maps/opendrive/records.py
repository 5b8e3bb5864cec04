"""What an OpenDRIVE file holds, as plain records: roads, lanes, junctions, objects, signals."""

from dataclasses import dataclass

from shiftsim.kernels import FloatArray

SHAPES = LINE, ARC, SPIRAL, POLY3, PARAM_POLY3 = "line", "arc", "spiral", "poly3", "paramPoly3"
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}  # m/s
SPEED_UNITS |= {"kmh": 1 / 3.6, "kph": 1 / 3.6, "mi/h": 0.44704, "mps": 1.0}  # as some write them

# Types of lanes by what they are used for.
DRIVABLE = frozenset(
    "driving entry exit onRamp offRamp connectingRamp slipLane bidirectional HOV bus taxi "
    "mwyEntry mwyExit".split()
)
PAVED = frozenset(("shoulder", "stop", "parking", "roadWorks", "restricted"))
WALKED = frozenset(("sidewalk", "walking"))
SEAMS = frozenset(("border", "curb"))  # merged into a neighbouring walkway where narrow
UNUSED = frozenset(("none", "biking", "median", "tram", "rail", "special1", "special2", "special3"))


@dataclass(frozen=True, slots=True)
class Geometry:
    """One record of a reference line."""

    s: float  # where it begins on the road [m]
    x: float  # start [m]
    y: float  # start [m]
    heading: float  # at the start [rad]
    length: float  # along the curve [m]
    kind: str  # `line`, `arc`, `spiral`, `poly3` or `paramPoly3`
    # curvature; curvatures at both ends [1/m]; a b c d; aU bU cU dU aV bV cV dV
    coefficients: tuple[float, ...] = ()
    p_end: float = 0.0  # last value of the parameter of a paramPoly3


@dataclass(frozen=True, slots=True)
class Speed:
    """A speed record."""

    s: float  # where it begins, from the start of the road or the lane section [m]
    limit: float | None  # [m/s]; None where there is no limit


@dataclass(frozen=True, slots=True)
class Lane:
    """One lane of one lane section."""

    id: int  # positive left of the reference line, negative right of it
    type: str  # as the file has it; `none` where it has none
    widths: FloatArray  # (n, 5) s from the section's start, then a b c d
    borders: FloatArray  # (n, 5) likewise
    predecessors: tuple[int, ...] = ()  # lanes of the previous section, or of the road before
    successors: tuple[int, ...] = ()  # lanes of the next section, or of the road after
    speeds: tuple[Speed, ...] = ()  # limits of this lane
    access: tuple[tuple[str, str], ...] = ()  # pairs (rule, restriction) such as ("deny", "car")
    direction: str = "standard"  # `standard`, `reversed` or `both`


@dataclass(frozen=True, slots=True)
class LaneSection:
    """Lanes from `s` to the next section [m], without the centre lane."""

    s: float
    lanes: dict[int, Lane]


@dataclass(frozen=True, slots=True)
class RoadLink:
    """What lies before or after a road: `road` or `junction`, its id, and the end that touches."""

    kind: str
    id: str
    contact: str | None


@dataclass(frozen=True, slots=True)
class RoadType:
    """Kind of road from `s` on [m], and its speed limit where it states one."""

    s: float
    type: str
    country: str
    speed: Speed | None


@dataclass(frozen=True, slots=True)
class Outline:
    """Corners of an object: (n, 2), s and t on the road, or u and v in the object's frame [m]."""

    on_road: bool
    corners: FloatArray


@dataclass(frozen=True, slots=True)
class Repeat:
    """Copies of an object: from `s` over `length` every `distance`; t changes linearly [m]."""

    s: float
    length: float
    distance: float
    t_start: float
    t_end: float


@dataclass(frozen=True, slots=True)
class RoadObject:
    """An object on a road. Position s, t, `heading` relative to the road [m, rad]."""

    id: str  # object id
    type: str  # type; empty where the file has none
    subtype: str  # subtype
    name: str  # name
    s: float  # along the road [m]
    t: float  # to the left [m]
    heading: float  # relative to the road [rad]
    length: float | None  # along the object's x axis [m]; None where not given
    width: float | None  # across [m]; None where not given
    outlines: tuple[Outline, ...] = ()  # where there are none, the box of length and width holds
    repeats: tuple[Repeat, ...] = ()  # copies
    lanes: tuple[tuple[int, int], ...] = ()  # lanes it is valid for; empty for all


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal, or a reference to one that stands on another road (`reference`)."""

    id: str  # signal id
    name: str  # name
    type: str  # type in the country's catalogue
    subtype: str  # subtype; empty where the file says -1 or nothing
    country: str  # catalogue
    dynamic: bool  # whether it changes, as lights do
    s: float  # along the road [m]
    t: float  # to the left [m]
    orientation: str  # `+` for traffic along s, `-` against, `none` for both
    value: float | None  # number on it; None where it has none
    unit: str  # unit of the number
    width: float | None  # across [m]; None where not given
    lanes: tuple[tuple[int, int], ...] = ()  # ranges of lanes it is valid for; empty for all
    reference: bool = False  # whether this is a signalReference


@dataclass(frozen=True, slots=True)
class Road:
    """One road."""

    id: str  # road id
    length: float  # the shorter of what it states and what its geometry has [m]
    junction: str | None  # junction it lies in; None for a road outside
    left_hand: bool  # whether traffic keeps to the left
    geometries: tuple[Geometry, ...]  # reference line, by s
    offsets: FloatArray  # (n, 5) lane offset: s, a b c d
    elevation: FloatArray  # (n, 5) height of the reference line
    sections: tuple[LaneSection, ...]  # lane sections, by s; some may have no length
    predecessor: RoadLink | None = None  # what lies before its start
    successor: RoadLink | None = None  # what lies after its end
    types: tuple[RoadType, ...] = ()  # by s
    objects: tuple[RoadObject, ...] = ()  # objects
    signals: tuple[Signal, ...] = ()  # signals

    def section_end(self, index: int) -> float:
        """Where lane section `index` ends [m]."""
        last = index + 1 == len(self.sections)
        end = self.length if last else min(self.sections[index + 1].s, self.length)
        return max(end, self.sections[index].s)


@dataclass(frozen=True, slots=True)
class Connection:
    """How one road enters a junction."""

    incoming: str  # road that leads to the junction
    connecting: str  # road inside the junction, or the linked road of a direct junction
    contact: str | None  # which end of the connecting road touches the incoming one
    lane_links: tuple[tuple[int, int], ...]  # pairs (incoming lane, connecting lane)


@dataclass(frozen=True, slots=True)
class Junction:
    """One junction. `type` is `default`, `direct`, `virtual` or `crossing`."""

    id: str
    type: str
    connections: tuple[Connection, ...]


@dataclass(frozen=True)
class OpenDrive:
    """One file."""

    source: str  # name of the file, for messages
    revision: tuple[str, str]  # major and minor version as written
    geo_reference: str | None  # as written; None where there is none
    offset: tuple[float, float, float, float] | None  # of the header: x, y, z [m], heading [rad]
    roads: dict[str, Road]  # by id, in the order of the file
    junctions: dict[str, Junction]  # by id, in the order of the file
    warnings: dict[str, int]  # what was repaired or left out: count by kind
    left_hand: frozenset[str] = frozenset()  # roads whose traffic keeps left by vendor data alone
