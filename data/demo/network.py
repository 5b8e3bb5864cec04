"""Towns from streets: junctions between them, and the ways that traffic takes through them.

A way is written as the streets it follows, joined by hyphens, the first one with its lane:
`east2-west` begins on lane 2 of `east`, counted from the middle, and goes on to `west`. `mid1>2`
changes lanes on the way, `lot@7` ends in parking space 7 of `lot`, `-bicycle` keeps to the right.
"""

import re
from dataclasses import dataclass, field, replace
from itertools import permutations, product

import numpy as np

from shiftsim.data.demo import paths
from shiftsim.data.demo.roads import CrosswalkSpec, LaneSpec, Piece, RoadNetwork, RoadSpec, connect
from shiftsim.kernels import FloatArray

_CLOSE = 2.9  # m between the centres of connecting roads that conflict
_LANE_CHANGE = 45.0  # m
_NARROW_SPEED, _NARROW_ASIDE, _NARROW_RAMP = 5.5, 0.3, 12.0  # m/s, m, m
BAY_ANGLE = np.pi / 3  # of diagonal parking spaces


@dataclass(frozen=True)
class Street:
    """A road between junctions."""

    name: str  # without digits at the end
    id: int  # from 1 to 9
    start: tuple[float, float, float]  # x [m], y [m], heading [rad]
    pieces: tuple[Piece, ...]  # geometry
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
    wide: float = 0.0  # how far vehicles swing out to turn right at its junctions [m]
    obstacles: tuple[tuple[float, float], ...] = ()  # s and t of cars parked on the road [m]
    has_lights: bool = False  # whether traffic lights stand before its junctions

    @property
    def half(self) -> float:
        """Half the carriageway, parking included [m]."""
        return self.lanes * self.width + self.parking

    def crossing_name(self, number: int) -> str:
        """Name of one of its crossings."""
        return f"crosswalk_{self.id}_{number}"

    def road(self) -> RoadSpec:
        """The same as a road of the map."""
        strips = [("driving", self.width)] * self.lanes
        strips += [("parking", self.parking)] if self.parking > 0.0 else []
        strips += [("sidewalk", self.sidewalk)] if self.sidewalk > 0.0 else []
        lanes = tuple(
            LaneSpec(sign * number, kind, width, width)
            for sign in ((-1,) if self.is_one_way else (1, -1))
            for number, (kind, width) in enumerate(strips, start=1)
        )
        before, after = (("junction", x, "") if x else None for x in self.junctions)
        road = RoadSpec(self.id, self.start, self.pieces, lanes, self.limit, -1, before, after)
        walks = [
            CrosswalkSpec(self.crossing_name(number), *ends, self.half)
            for number, ends in enumerate(self.crossings if self.is_marked else ())
        ]
        sign = self.stop if self.has_stop_sign else None
        ends = ((self.stop, "-"), (road.length - self.stop, "+"))
        lights = [end for end, x in zip(ends, self.junctions, strict=True) if x and self.has_lights]
        return replace(road, crosswalks=tuple(walks), stop_sign=sign, lights=tuple(lights))


@dataclass(frozen=True)
class Leg:
    """A street in one direction."""

    street: Street
    is_forward: bool

    @property
    def leaves(self) -> int:
        """Junction it comes from."""
        return self.street.junctions[not self.is_forward]

    @property
    def enters(self) -> int:
        """Junction it leads to."""
        return self.street.junctions[self.is_forward]

    def pose(self, road: RoadSpec, lane: int, *, at_end: bool) -> FloatArray:
        """(3,) left border of a lane where the leg begins or ends."""
        s = np.array([road.length if at_end == self.is_forward else 0.0])
        sign = -1.0 if self.is_forward else 1.0
        pose: FloatArray = road.at(s, sign * (lane - 1) * self.street.width)[0]
        pose[2] += 0.0 if self.is_forward else np.pi
        return pose

    def lane(self, road: RoadSpec, lane: int) -> FloatArray:
        """(n, 2) centre of a lane, in its direction."""
        s = np.arange(0.0, road.length, paths.STEP)
        center = road.center_of(-lane if self.is_forward else lane, s)[:, :2]
        return center if self.is_forward else center[::-1]


@dataclass
class Town:
    """A generated town."""

    name: str  # of the town
    streets: dict[str, Street] = field(default_factory=dict)  # by name
    network: RoadNetwork = field(default_factory=lambda: RoadNetwork(""))  # all roads
    # connecting road and lane behind it by junction, street, lane, next street
    connectors: dict[tuple[int, str, int, str], tuple[int, int]] = field(default_factory=dict)
    # connecting roads and narrow places that cannot be used at once
    conflicts: set[tuple[int, int]] = field(default_factory=set)
    walks: dict[str, paths.Walk] = field(default_factory=dict)  # by name
    bays: dict[str, FloatArray] = field(default_factory=dict)  # (n, 3) parking spaces by street
    _paths: dict[str, paths.Path] = field(default_factory=dict)

    def parked(self) -> FloatArray:
        """(n, 3) poses of parked cars."""
        poses = [
            np.delete(bays, [x for x in self.streets[name].empty if x < len(bays)], axis=0)
            for name, bays in self.bays.items()
        ]
        for street in self.streets.values():
            for s, t in street.obstacles:
                pose = self.network.roads[street.id].at(np.array([s]), t)
                pose[:, 2] += np.pi * (t > 0.0)
                poses.append(pose)
        return np.concatenate([np.zeros((0, 3)), *poses])

    def path(self, way: str) -> paths.Path:
        """The path of a way."""
        if way not in self._paths:
            self._paths[way] = _make_way(self, way)
        return self._paths[way]


def build_town(name: str, streets: tuple[Street, ...]) -> Town:
    """A town from its streets; junctions connect all that meet there."""
    town = Town(name, {street.name: street for street in streets}, RoadNetwork(name))
    legs = [Leg(street, True) for street in streets]
    legs += [Leg(street, False) for street in streets if not street.is_one_way]
    for street in streets:
        town.network.roads[street.id] = street.road()
    lines: dict[int, FloatArray] = {}
    for source, target in product(legs, legs):
        meet = source.enters and source.enters == target.leaves
        if meet and source.street is not target.street:
            _connect(town, source, target, lines)
    starts = {number: (street, lane) for street, number, lane in town.network.links}
    for a, b in permutations(lines, 2):
        same = town.network.roads[a].junction == town.network.roads[b].junction
        if same and starts[a] != starts[b] and _closest(lines[a], lines[b]) < _CLOSE:
            town.conflicts.add((a, b))
    for street in streets:
        if street.narrow:
            one, other = -2 * street.id, -2 * street.id - 1
            town.conflicts |= {(one, other), (other, one)}
    return town


def _connect(town: Town, source: Leg, target: Leg, lines: dict[int, FloatArray]) -> None:
    """Connecting roads from one street to another, one per lane that leads there."""
    turn, roads = _turn(town, source, target), town.network.roads
    a, b = source.street, target.street
    if abs(turn) < 0.5:
        pairs = [(n, n) for n in range(1, min(a.lanes, b.lanes) + 1)]
    else:
        pairs = [(1, 1)] if turn > 0.0 else [(a.lanes, b.lanes)]
    for from_lane, to_lane in pairs:
        number = 1000 * (source.enters - 100) + 100 * from_lane + 10 * a.id + b.id
        start = source.pose(roads[a.id], from_lane, at_end=True)
        end = target.pose(roads[b.id], to_lane, at_end=False)
        incoming = -from_lane if source.is_forward else from_lane
        outgoing = -to_lane if target.is_forward else to_lane
        road = RoadSpec(
            number,
            (float(start[0]), float(start[1]), float(start[2])),
            connect(start.tolist(), end.tolist(), ease=turn > 0.0 and not a.is_one_way),
            (LaneSpec(-1, "driving", a.width, b.width, incoming, outgoing),),
            min(a.limit, b.limit),
            junction=source.enters,
            predecessor=("road", a.id, "end" if source.is_forward else "start"),
            successor=("road", b.id, "start" if target.is_forward else "end"),
        )
        roads[number] = road
        town.network.links.append((a.id, number, incoming))
        town.connectors[source.enters, a.name, from_lane, b.name] = (number, to_lane)
        lines[number] = road.center_of(-1, np.arange(0.0, road.length, paths.STEP))[:, :2]


def _turn(town: Town, source: Leg, target: Leg) -> float:
    """Change of heading through a junction [rad]."""
    a = source.pose(town.network.roads[source.street.id], 1, at_end=True)
    b = target.pose(town.network.roads[target.street.id], 1, at_end=False)
    return float((b[2] - a[2] + np.pi) % (2 * np.pi) - np.pi)


def _make_way(town: Town, way: str) -> paths.Path:
    names = way.split("-")
    if names[-1] == "bicycle":
        return paths.for_bicycles(town.path(way.removesuffix("-bicycle")))
    steps = [re.fullmatch(r"([a-z]+)(\d*)(?:>(\d+))?(?:@(\d+))?", name) for name in names]
    parts, limits, zones, crossings = [], [], [], []
    lane, is_forward = 1, False
    for number, step in enumerate(steps):
        assert step, way
        street = town.streets[step[1]]
        if number == 0:
            after = town.streets[re.split(r"[\d>@]", names[1])[0]]
            lane, is_forward = int(step[2]), street.junctions[1] in (set(after.junctions) - {0})
        leg, road = Leg(street, is_forward), town.network.roads[street.id]
        line = leg.lane(road, lane)
        origin = f"{street.name}{lane}"
        if step[3]:
            line, lane = _change_lanes(line, leg.lane(road, int(step[3]))), int(step[3])
        if step[4]:
            line = _into_bay(line, town.bays[street.name][int(step[4])])
        parts.append(line)
        limits.append(street.limit)
        crossings += [
            (street.crossing_name(n), *_ends(road, leg, lane, ends))
            for n, ends in enumerate(street.crossings)
        ]
        if street.narrow:
            ends = _ends(road, leg, lane, street.narrow)
            zones.append((_narrow_zone(leg), *ends, 2.0, street.swings[not is_forward]))
        if number < len(steps) - 1:
            following = re.split(r"[\d>@]", names[number + 1])[0]
            connector, to_lane = town.connectors[leg.enters, street.name, lane, following]
            onward = town.streets[following]
            target = Leg(onward, leg.enters == onward.junctions[0])
            inner = town.network.roads[connector]
            is_left = _turn(town, leg, target) > 0.5 and not street.is_one_way
            rank = (0 if street.is_main else 2) + is_left
            points = inner.center_of(-1, np.arange(0.0, inner.length, paths.STEP))[:, :2]
            parts.append(points)
            limits.append(min(street.limit, onward.limit))
            zone = paths.Zone(connector, 0.0, 0.0, 0.0, rank, origin)
            swing = street.wide if _turn(town, leg, target) < -0.5 else 0.0
            zones.append((zone, points[0], points[-1], street.stop, swing))
            lane, is_forward = to_lane, target.is_forward
    path = paths.make_path(parts, limits)
    return _with_places(path, zones, crossings, is_parking=bool(steps[-1] and steps[-1][4]))


def _with_places(
    path: paths.Path,
    zones: list[tuple[paths.Zone, FloatArray, FloatArray, float, float]],
    crossings: list[tuple[str, FloatArray, FloatArray]],
    *,
    is_parking: bool,
) -> paths.Path:
    """A path with its zones and crossings, narrow places driven past with care."""
    arc = paths.STEP * np.arange(len(path.points))
    aside, speed = np.zeros(len(arc)), path.speed
    places, made = [], []
    for name, *ends in crossings:
        first, last = sorted(paths.arc_at(path.points, end) for end in ends)
        places.append((name, first, last))
    for zone, begin, end, stop, swing in zones:
        entry, leave = paths.arc_at(path.points, begin), paths.arc_at(path.points, end)
        between = [x for x in places if entry - stop - 0.5 < x[1] and x[2] < entry]
        crosswalk = between[-1][0] if between else ""
        made.append(replace(zone, entry=entry, exit=leave, stop=entry - stop, crosswalk=crosswalk))
        if swing or zone.id < 0:
            outside = np.maximum(np.maximum(entry - arc, arc - leave), 0.0) / _NARROW_RAMP
            share = np.clip(1.0 - outside, 0.0, 1.0)
            aside += swing * share * share * (3.0 - 2.0 * share)
        if zone.id < 0:
            speed = np.where(share > 0.5, np.minimum(speed, _NARROW_SPEED), speed)
    path = paths.shifted(replace(path, speed=paths.brake_in_time(speed)), aside)
    order = tuple(sorted(made, key=lambda zone: zone.entry))
    return replace(path, zones=order, crossings=tuple(places), is_parking=is_parking)


def _narrow_zone(leg: Leg) -> paths.Zone:
    number = -2 * leg.street.id - leg.is_forward
    name = f"{leg.street.name}{'>' if leg.is_forward else '<'}"
    ahead, back = leg.street.swings
    goes_first = leg.is_forward if ahead == back else (ahead < back) == leg.is_forward
    return paths.Zone(number, 0.0, 0.0, 0.0, 1 - goes_first, name)


def _ends(
    road: RoadSpec, leg: Leg, lane: int, ends: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Centre of a lane at two places, in the direction of the leg."""
    points = road.center_of(-lane if leg.is_forward else lane, np.array(ends))[:, :2]
    return (points[0], points[1]) if leg.is_forward else (points[1], points[0])


def _change_lanes(first: FloatArray, second: FloatArray) -> FloatArray:
    """(n, 2) a line that goes over from one lane to another, halfway."""
    count = min(len(first), len(second))
    along = (paths.STEP * (np.arange(count) - 0.5 * count)) / _LANE_CHANGE + 0.5
    share = np.clip(along, 0.0, 1.0)[:, None]
    share = share * share * (3.0 - 2.0 * share)
    return (1.0 - share) * first[:count] + share * second[:count]


def _into_bay(line: FloatArray, bay: FloatArray) -> FloatArray:
    """(n, 2) a line that turns off into a parking space."""
    along = np.array([np.cos(bay[2]), np.sin(bay[2])])
    offset = line - bay[:2]
    beside = offset[:, 0] * along[1] - offset[:, 1] * along[0]
    near = np.hypot(*offset.T) < 15.0
    corner = int(np.argmin(np.where(near, np.abs(beside), np.inf)))
    reach = float(np.hypot(*offset[corner]))
    into = line[corner] + np.arange(paths.STEP, reach, paths.STEP)[:, None] * along
    return np.concatenate([line[:corner], into, bay[None, :2]])


def _closest(a: FloatArray, b: FloatArray) -> float:
    gaps = a[:, None] - b[None]
    return float(np.hypot(gaps[..., 0], gaps[..., 1]).min())
