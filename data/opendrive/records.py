"""What an OpenDRIVE file holds, as plain records: roads, lanes, junctions, objects, signals."""

from dataclasses import dataclass

from shiftsim.arrays import FloatArray

LINE, ARC, SPIRAL, POLY3, PARAM_POLY3 = "line", "arc", "spiral", "poly3", "paramPoly3"
SPEED_UNITS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}  # m/s

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
    """One record of a reference line.

    Attributes:
        s: Where it begins on the road [m].
        x: Start [m].
        y: Start [m].
        heading: At the start [rad].
        length: Along the curve [m].
        kind: `line`, `arc`, `spiral`, `poly3` or `paramPoly3`.
        coefficients: Curvature; curvatures at both ends [1/m]; a b c d; aU bU cU dU aV bV cV dV.
        p_end: Last value of the parameter of a paramPoly3.
    """

    s: float
    x: float
    y: float
    heading: float
    length: float
    kind: str
    coefficients: tuple[float, ...] = ()
    p_end: float = 0.0


@dataclass(frozen=True, slots=True)
class Speed:
    """A speed record.

    Attributes:
        s: Where it begins, from the start of the road or the lane section [m].
        limit: [m/s]; None where there is no limit.
    """

    s: float
    limit: float | None


@dataclass(frozen=True, slots=True)
class Lane:
    """One lane of one lane section.

    Attributes:
        id: Positive left of the reference line, negative right of it.
        type: As the file has it; `none` where it has none.
        widths: (n, 5) s from the section's start, then a b c d.
        borders: (n, 5) likewise.
        predecessors: Lanes of the previous section, or of the road before.
        successors: Lanes of the next section, or of the road after.
        speeds: Limits of this lane.
        access: Pairs (rule, restriction) such as ("deny", "car").
        direction: `standard`, `reversed` or `both`.
    """

    id: int
    type: str
    widths: FloatArray
    borders: FloatArray
    predecessors: tuple[int, ...] = ()
    successors: tuple[int, ...] = ()
    speeds: tuple[Speed, ...] = ()
    access: tuple[tuple[str, str], ...] = ()
    direction: str = "standard"


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
    """An object on a road. Position s, t, `heading` relative to the road [m, rad].

    Attributes:
        id: Object id.
        type: Type; empty where the file has none.
        subtype: Subtype.
        name: Name.
        s: Along the road [m].
        t: To the left [m].
        heading: Relative to the road [rad].
        length: Along the object's x axis [m]; None where not given.
        width: Across [m]; None where not given.
        outlines: Polygons; the box of length and width holds where there are none.
        repeats: Copies.
        lanes: Lanes it is valid for; empty for all.
    """

    id: str
    type: str
    subtype: str
    name: str
    s: float
    t: float
    heading: float
    length: float | None
    width: float | None
    outlines: tuple[Outline, ...] = ()
    repeats: tuple[Repeat, ...] = ()
    lanes: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal, or a reference to one that stands on another road (`reference`).

    Attributes:
        id: Signal id.
        name: Name.
        type: Type in the country's catalogue.
        subtype: Subtype; empty where the file says -1 or nothing.
        country: Catalogue.
        dynamic: Whether it changes, as lights do.
        s: Along the road [m].
        t: To the left [m].
        orientation: `+` for traffic along s, `-` against, `none` for both.
        value: Number on it; None where it has none.
        unit: Unit of the number.
        width: Across [m]; None where not given.
        lanes: Ranges of lanes it is valid for; empty for all.
        reference: Whether this is a signalReference.
    """

    id: str
    name: str
    type: str
    subtype: str
    country: str
    dynamic: bool
    s: float
    t: float
    orientation: str
    value: float | None
    unit: str
    width: float | None
    lanes: tuple[tuple[int, int], ...] = ()
    reference: bool = False


@dataclass(frozen=True, slots=True)
class Road:
    """One road.

    Attributes:
        id: Road id.
        length: The shorter of what it states and what its geometry has [m].
        stated_length: As the file has it [m].
        junction: Junction it lies in; None for a road outside.
        left_hand: Whether traffic keeps to the left.
        geometries: Reference line, by s.
        offsets: (n, 5) lane offset: s, a b c d.
        elevation: (n, 5) height of the reference line.
        sections: Lane sections, by s; some may have no length.
        predecessor: What lies before its start.
        successor: What lies after its end.
        types: By s.
        objects: Objects.
        signals: Signals.
    """

    id: str
    length: float
    stated_length: float
    junction: str | None
    left_hand: bool
    geometries: tuple[Geometry, ...]
    offsets: FloatArray
    elevation: FloatArray
    sections: tuple[LaneSection, ...]
    predecessor: RoadLink | None = None
    successor: RoadLink | None = None
    types: tuple[RoadType, ...] = ()
    objects: tuple[RoadObject, ...] = ()
    signals: tuple[Signal, ...] = ()

    def section_end(self, index: int) -> float:
        """Where lane section `index` ends [m]."""
        last = index + 1 == len(self.sections)
        end = self.length if last else min(self.sections[index + 1].s, self.length)
        return max(end, self.sections[index].s)


@dataclass(frozen=True, slots=True)
class Connection:
    """How one road enters a junction.

    Attributes:
        incoming: Road that leads to the junction.
        connecting: Road inside the junction, or the linked road of a direct junction.
        contact: Which end of the connecting road touches the incoming one.
        lane_links: Pairs (lane of the incoming road, lane of the connecting road).
    """

    incoming: str
    connecting: str
    contact: str | None
    lane_links: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Junction:
    """One junction. `type` is `default`, `direct`, `virtual` or `crossing`."""

    id: str
    type: str
    connections: tuple[Connection, ...]


@dataclass(frozen=True)
class OpenDrive:
    """One file.

    Attributes:
        source: Name of the file, for messages.
        revision: Major and minor version as written.
        geo_reference: As written; None where there is none.
        offset: Header offset x, y, z [m], heading [rad]; None where there is none.
        roads: By id, in the order of the file.
        junctions: By id, in the order of the file.
        counts: How many records of each kind the file holds, dropped ones included.
        warnings: What was repaired or left out: count by kind.
    """

    source: str
    revision: tuple[str, str]
    geo_reference: str | None
    offset: tuple[float, float, float, float] | None
    roads: dict[str, Road]
    junctions: dict[str, Junction]
    counts: dict[str, int]
    warnings: dict[str, int]
