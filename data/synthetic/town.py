"""Towns from streets: junctions between them, ways of pedestrians, and parking spaces."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from shiftsim.data.synthetic import roads
from shiftsim.data.synthetic.agents import Walk, arc_at, resample
from shiftsim.kernels import FloatArray
from shiftsim.world.state import LightStatus

_CLOSE = 2.9  # m between the centres of connecting roads that conflict
_NARROW_ASIDE = 0.3  # m
_BAY_ANGLE = np.pi / 3  # of diagonal parking spaces
_PARKING_STEP, _BAY_STEP = 6.6, 3.1  # m along the street between parked cars, diagonal ones
_UNMARKED = 4.0  # m from a place to cross without a crosswalk to the middle of a parked car
_DIAGONAL = 3.0  # m, wider strips are for diagonal parking
_ROUNDING = 0.6  # m
_CLEARING = 2.0  # s between the yellow light of one phase and the green light of the next


@dataclass(frozen=True)
class Street:
    """A road between junctions."""

    name: str  # without digits at the end
    id: int  # from 1 to 9
    start: tuple[float, float, float]  # x [m], y [m], heading [rad]
    pieces: tuple[roads.Piece, ...]  # geometry
    width: float  # of every lane [m]
    limit: float  # speed limit [km/h]
    lanes: int = 1  # per direction
    is_one_way: bool = False  # whether there are only the lanes along the reference line
    is_main: bool = True  # whether it has priority
    junctions: tuple[int, int] = (0, 0)  # at its begin and its end, 0 for none
    stop: float = 9.0  # how far before a junction vehicles wait [m]
    crossings: tuple[tuple[float, float], ...] = ()  # first and last s of places to cross [m]
    is_marked: bool = True  # whether these are crosswalks of the map
    parking: float = 0.0  # width of the strip for parking on both sides, diagonal above 3 m [m]
    stalls: tuple[tuple[float, float], ...] = ()  # first and last s of parked cars [m]
    empty: tuple[int, ...] = ()  # numbers of the parking spaces that are free
    sidewalk: float = 3.0  # width, 0 for none [m]
    has_stop_sign: bool = False  # at its begin
    narrow: tuple[float, float] | None = None  # first and last s where vehicles cannot meet [m]
    # how far vehicles swing to the left there, along s and against it; who must more gives way [m]
    swings: tuple[float, float] = (_NARROW_ASIDE, _NARROW_ASIDE)
    obstacles: tuple[tuple[float, float], ...] = ()  # s and t of cars parked on the road [m]
    has_lights: bool = False  # whether traffic lights stand before its junctions

    @property
    def length(self) -> float:
        """Length [m]."""
        return sum(piece.length for piece in self.pieces)

    @property
    def half(self) -> float:
        """Half the carriageway, parking included [m]."""
        return self.lanes * self.width + self.parking

    def crossing_name(self, number: int) -> str:
        """Name of one of its crossings."""
        return f"crosswalk_{self.id}_{number}"

    @cached_property
    def road(self) -> roads.RoadSpec:
        """The same as a road of the map."""
        strips = [("driving", self.width)] * self.lanes
        strips += [("parking", self.parking)] if self.parking > 0.0 else []
        strips += [("sidewalk", self.sidewalk)] if self.sidewalk > 0.0 else []
        lanes = tuple(
            roads.LaneSpec(sign * number, kind, width, width)
            for sign in ((-1,) if self.is_one_way else (1, -1))
            for number, (kind, width) in enumerate(strips, start=1)
        )
        before, after = (("junction", x, "") if x else None for x in self.junctions)
        road = roads.RoadSpec(
            self.id, self.start, self.pieces, lanes, self.limit, -1, before, after
        )
        walks = [
            roads.CrosswalkSpec(self.crossing_name(number), *ends, self.half)
            for number, ends in enumerate(self.crossings if self.is_marked else ())
        ]
        sign = self.stop if self.has_stop_sign else None
        ends = ((self.stop, "-"), (road.length - self.stop, "+"))
        lights = [end for end, x in zip(ends, self.junctions, strict=True) if x and self.has_lights]
        return replace(road, crosswalks=tuple(walks), stop_sign=sign, lights=tuple(lights))


@dataclass(frozen=True)
class Lights:
    """The lights of one junction: streets take turns."""

    # connecting roads that are green together, phase after phase
    phases: tuple[frozenset[int], ...]
    green: tuple[float, ...]  # how long each phase is green [s]
    begun: float  # how long the cycle has been going on at time 0 [s]
    crossings: dict[str, int]  # phase of the vehicles that a crosswalk stops, by its name
    yellow: float = 3.0  # how long a phase is yellow [s]

    def status(self, phase: int, time: float) -> LightStatus:
        """What a phase shows at a time [s]."""
        wait = self.wait(phase, time)
        if wait > 0.0:
            return LightStatus.RED
        return LightStatus.GREEN if -wait < self.green[phase] else LightStatus.YELLOW

    def wait(self, phase: int, time: float) -> float:
        """Time until a phase becomes green; 0 and less, how long it has been, or yellow [s]."""
        spans = [green + self.yellow + _CLEARING for green in self.green]
        since = (self.begun + time - sum(spans[:phase])) % sum(spans)
        return -since if since < self.green[phase] + self.yellow else sum(spans) - since


@dataclass(frozen=True)
class Leg:
    """A street in one direction."""

    street: Street
    is_forward: bool

    @property
    def enters(self) -> int:
        """Junction it leads to."""
        return self.street.junctions[self.is_forward]

    def pose(self, lane: int, *, at_end: bool) -> FloatArray:
        """(3,) left border of a lane where the leg begins or ends."""
        road = self.street.road
        s = np.array([road.length if at_end == self.is_forward else 0.0])
        sign = -1.0 if self.is_forward else 1.0
        pose: FloatArray = road.at(s, sign * (lane - 1) * self.street.width)[0]
        pose[2] += 0.0 if self.is_forward else np.pi
        return pose

    def lane_id(self, lane: int) -> int:
        """Number of a lane in the map."""
        return -lane if self.is_forward else lane

    def centers(self, lane: int, s: FloatArray | Sequence[float] | None = None) -> FloatArray:
        """(n, 2) centre of a lane in its direction: at some places along the street, or all."""
        road = self.street.road
        places = np.arange(0.0, road.length, roads.STEP) if s is None else np.array(s)
        center = road.center_of(self.lane_id(lane), places)[:, :2]
        return center if self.is_forward else center[::-1]

    def turn_to(self, target: "Leg") -> float:
        """Change of heading through the junction between them [rad]."""
        turn = target.pose(1, at_end=False)[2] - self.pose(1, at_end=True)[2]
        return float((turn + np.pi) % (2 * np.pi) - np.pi)


class Turn(NamedTuple):
    """A way through a junction."""

    junction: int
    street: str  # that it comes from
    lane: int  # on which it leaves that street
    target: str  # the street that it leads to


@dataclass
class Town:
    """A generated town."""

    name: str  # of the town
    streets: dict[str, Street] = field(default_factory=dict)  # by name
    connectors: dict[Turn, roads.RoadSpec] = field(default_factory=dict)  # roads of junctions
    # connecting roads and narrow places that cannot be used at once
    conflicts: set[tuple[int, int]] = field(default_factory=set)
    walks: list[Walk] = field(default_factory=list)
    bays: dict[str, FloatArray] = field(default_factory=dict)  # (n, 3) parking spaces by street
    lights: tuple[Lights, ...] = ()  # of its junctions

    def xml(self) -> str:
        """The OpenDRIVE file of its roads."""
        streets = [street.road for street in self.streets.values()]
        return roads.town_xml(self.name, [*streets, *self.connectors.values()])

    def lit(self) -> dict[int, tuple[Lights, int]]:
        """Which lights, and their phase, by connecting road that has some."""
        return {
            number: (lights, phase)
            for lights in self.lights
            for phase, numbers in enumerate(lights.phases)
            for number in numbers
        }

    def parked(self) -> FloatArray:
        """(n, 3) poses of parked cars."""
        poses = [
            np.delete(bays, [x for x in self.streets[name].empty if x < len(bays)], axis=0)
            for name, bays in self.bays.items()
        ]
        for street in self.streets.values():
            for s, t in street.obstacles:
                pose = street.road.at(np.array([s]), t)
                pose[:, 2] += np.pi * (t > 0.0)
                poses.append(pose)
        return np.concatenate([np.zeros((0, 3)), *poses])


def build_town(name: str, streets: Sequence[Street]) -> Town:
    """A town from its streets; junctions connect all that meet there."""
    town = Town(name, {street.name: street for street in streets})
    legs = [Leg(street, True) for street in streets]
    legs += [Leg(street, False) for street in streets if not street.is_one_way]
    for source, target in product(legs, legs):
        meet = source.enters and source.enters == target.street.junctions[not target.is_forward]
        if meet and source.street is not target.street:
            _connect(town, source, target)
    for a, b in permutations(town.connectors.values(), 2):
        if a.junction == b.junction and a.incoming != b.incoming:
            gaps = np.hypot(*np.moveaxis(a.line[:, None] - b.line, -1, 0))
            if gaps.min() < _CLOSE:
                town.conflicts.add((a.id, b.id))
    for street in streets:
        if street.narrow:
            one, other = -2 * street.id, -2 * street.id - 1
            town.conflicts |= {(one, other), (other, one)}
        if not street.is_one_way:
            _add_walks(town, street)
        if street.parking > 0.0:
            town.bays[street.name] = _bays(street)
    return town


def _connect(town: Town, source: Leg, target: Leg) -> None:
    """Connecting roads from one street to another, one per lane that leads there."""
    turn, a, b = source.turn_to(target), source.street, target.street
    if abs(turn) < 0.5:
        pairs = [(n, n) for n in range(1, min(a.lanes, b.lanes) + 1)]
    else:
        pairs = [(1, 1)] if turn > 0.0 else [(a.lanes, b.lanes)]
    for from_lane, to_lane in pairs:
        number = 1000 * (source.enters - 100) + 100 * from_lane + 10 * a.id + b.id
        start = source.pose(from_lane, at_end=True).tolist()
        end = target.pose(to_lane, at_end=False).tolist()
        lanes = source.lane_id(from_lane), target.lane_id(to_lane)
        town.connectors[Turn(source.enters, a.name, from_lane, b.name)] = roads.RoadSpec(
            number,
            (start[0], start[1], start[2]),
            roads.connect(start, end, ease=turn > 0.0 and not a.is_one_way),
            (roads.LaneSpec(-1, "driving", a.width, b.width, *lanes),),
            min(a.limit, b.limit),
            junction=source.enters,
            predecessor=("road", a.id, "end" if source.is_forward else "start"),
            successor=("road", b.id, "start" if target.is_forward else "end"),
        )


def _add_walks(town: Town, street: Street) -> None:
    """Add ways over the crossings of a street, and along its sidewalks."""
    for number in range(len(street.crossings)):
        _add_crossing(town, street, number)
    road = street.road
    first = 0.5 * sum(street.crossings[0]) + 8.0 if street.crossings else 3.0
    s = np.arange(first, road.length - 3.0, roads.STEP)
    left, right = (road.at(s, sign * (street.half + 2.5))[:, :2] for sign in (1.0, -1.0))
    town.walks += [Walk(resample(points, _ROUNDING)) for points in (left, right[::-1])]


def _add_crossing(town: Town, street: Street, number: int) -> None:
    """Four ways over a crossing: two to either side, which never meet."""
    road = street.road
    half, middle = street.half, 0.5 * sum(street.crossings[number])
    far = min(middle + 30.0, road.length - 3.0)
    for sign, offsets in ((1.0, (-0.9, -0.2)), (-1.0, (0.5, 1.2))):
        aside = half + 1.2 + 0.4 * sign
        for at in (middle + offset for offset in offsets):
            before = road.at(np.arange(far, at, -roads.STEP), sign * aside)[:, :2]
            lateral = np.arange(aside, -aside, -roads.STEP)
            over = road.at(np.full(len(lateral), at), sign * lateral)[:, :2]
            after = road.at(np.arange(at, far - 6.0, roads.STEP), -sign * aside)[:, :2]
            points = resample(np.concatenate([before, over, after]), _ROUNDING)
            kerb = arc_at(points, over[0]) + (aside - half) - 0.6
            across = kerb + 2 * half + 1.4
            town.walks.append(Walk(points, street.crossing_name(number), kerb, across))


def _bays(street: Street) -> FloatArray:
    """(n, 3) poses of parking spaces, right ones first, away from crossings and junctions."""
    road = street.road
    step, clear = (_BAY_STEP, 4.0) if street.parking > _DIAGONAL else (_PARKING_STEP, 9.0)
    stalls = street.stalls or ((14.0, road.length - 8.0),)
    places = np.concatenate([np.arange(*ends, step) for ends in stalls])
    clear = clear if street.is_marked else min(clear, _UNMARKED)
    for first, last in street.crossings:
        places = places[(places < first - clear) | (places > last + clear)]
    aside = np.full(len(places), street.half - 0.5 * street.parking)
    right, left = road.at(places, -aside), road.at(places, aside)
    left[:, 2] += np.pi
    if street.parking > _DIAGONAL:
        right[:, 2] -= _BAY_ANGLE
        left[:, 2] -= _BAY_ANGLE
    return np.concatenate([right, left])
