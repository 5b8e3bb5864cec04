"""The towns of the demo: roads, and the paths that traffic and pedestrians follow on them."""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.demo_roads import (
    CrosswalkSpec,
    LaneSpec,
    Link,
    Piece,
    RoadNetwork,
    RoadSpec,
    bend,
    connect,
    line,
)

STEP = 0.5  # m between the points of a path
_SMOOTHING = 2.5  # m, how far a driver rounds off the corners of the lane centres
_LATERAL_ACCEL = 1.8  # m/s^2, comfortable in curves
_BRAKING = 1.0  # m/s^2, comfortable before curves
_SIDEWALK = 3.0  # m


class _Track:
    points: FloatArray

    @cached_property
    def _rows(self) -> list[list[float]]:
        return self.points.tolist()

    def at(self, s: float) -> tuple[float, float, float]:
        """X [m], y [m] and heading [rad] at an arc length."""
        index = min(max(int(s / STEP), 0), len(self._rows) - 2)
        (x, y, heading), (bx, by, bh) = self._rows[index], self._rows[index + 1]
        share = s / STEP - index
        return x + share * (bx - x), y + share * (by - y), heading + share * (bh - heading)


@dataclass(frozen=True)
class Path(_Track):
    """What one vehicle can follow. n points, `STEP` apart.

    Attributes:
        points: (n, 3) x [m], y [m], heading, unwrapped [rad].
        speed: (n,) desired speed of an ordinary driver [m/s].
        entry: Where the junction begins; inf without one [m].
        exit: Where it ends [m].
        stop: Where a vehicle that must wait stops, 0 without a junction [m].
        connector: Id of the connecting road, -1 without a junction.
        rank: Order of priority, 0 first.
        crosswalks: Name, first and last arc length of the crosswalks on the way.
        origin: Name of the lane it starts on.
    """

    points: FloatArray
    speed: FloatArray
    entry: float = np.inf
    exit: float = np.inf
    stop: float = 0.0
    connector: int = -1
    rank: int = 0
    crosswalks: tuple[tuple[str, float, float], ...] = ()
    origin: str = ""

    @property
    def length(self) -> float:
        """Length of the path [m]."""
        return STEP * (len(self.points) - 1)


@dataclass(frozen=True)
class Walk(_Track):
    """A way of a pedestrian. n points, `STEP` apart.

    Attributes:
        points: (n, 3) x [m], y [m], heading [rad].
        crosswalk: Name of the crosswalk on it, empty for none.
        kerb: Where the pedestrian waits to cross [m].
        across: Where the other side is reached [m].
    """

    points: FloatArray
    crosswalk: str = ""
    kerb: float = np.inf
    across: float = np.inf


@dataclass
class Town:
    """A generated town.

    Attributes:
        network: Its roads.
        paths: By name: "east1-west" is from lane 1 of the arm east to the arm west.
        conflicts: Pairs of connecting roads that cannot be used at once.
        walks: By name.
        parking: (n, 3) poses of parking spaces.
    """

    network: RoadNetwork
    paths: dict[str, Path] = field(default_factory=dict)
    conflicts: set[tuple[int, int]] = field(default_factory=set)
    walks: dict[str, Walk] = field(default_factory=dict)
    parking: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True)
class _Arm:
    name: str
    id: int
    angle: float  # rad, outward
    pieces: tuple[Piece, ...]
    lanes: int  # per direction
    width: float  # m
    limit: float  # km/h
    is_main: bool
    crosswalk: tuple[float, float] = (3.0, 7.0)  # m along the arm
    parking: float = 0.0  # m, width of a parking lane on both sides
    radius: float = 16.0  # m from the centre of the junction

    @property
    def half(self) -> float:
        """Half the carriageway, parking included [m]."""
        return self.lanes * self.width + self.parking


_STOP = 9.0  # m along an arm, where vehicles wait at a junction
_PARKING_STEP = 6.6  # m between parked cars


def junction_town() -> Town:
    """A four-armed junction: a main road with two lanes per direction, two narrow side roads."""
    arms = (
        _Arm("east", 1, 0.0, (line(108.0),), 2, 3.3, 50.0, True),
        _Arm(
            "north",
            2,
            np.pi / 2,
            (line(24.0), *bend(-0.5, -0.02, 14.0), line(45.0)),
            1,
            3.5,
            30.0,
            False,
        ),
        _Arm(
            "west", 3, np.pi, (line(30.0), *bend(0.45, 0.012, 20.0), line(25.0)), 2, 3.3, 50.0, True
        ),
        _Arm(
            "south",
            4,
            -np.pi / 2,
            (line(25.0), *connect((0.0, 0.0, 0.0), (62.0, 9.0, 0.0), ease=True), line(15.0)),
            1,
            3.5,
            30.0,
            False,
        ),
    )
    return _make_town("junction", arms)


def street_town() -> Town:
    """A winding street with cars parked on both sides, and a side street."""
    width, parking, radius = 3.4, 2.3, 12.0
    arms = (
        _Arm(
            "east",
            1,
            0.0,
            (
                line(22.0),
                *bend(1.1, 1 / 50, 18.0),
                line(38.0),
                *bend(-0.8, -1 / 55, 18.0),
                line(20.0),
            ),
            1,
            width,
            30.0,
            True,
            crosswalk=(84.0, 88.0),
            parking=parking,
            radius=radius,
        ),
        _Arm("side", 2, np.pi / 2, (line(45.0),), 1, 3.2, 20.0, False, radius=radius + 2.0),
        _Arm(
            "west",
            3,
            np.pi,
            (
                line(18.0),
                *bend(-0.9, -1 / 52, 18.0),
                line(30.0),
                *bend(0.7, 1 / 60, 16.0),
                line(25.0),
            ),
            1,
            width,
            30.0,
            True,
            crosswalk=(9.0, 13.0),
            parking=parking,
            radius=radius,
        ),
    )
    return _make_town("street", arms)


def _make_town(name: str, arms: tuple[_Arm, ...]) -> Town:
    town = Town(RoadNetwork(name))
    for arm in arms:
        town.network.roads[arm.id] = _arm_road(arm, town.network.junction)
    lines: dict[int, FloatArray] = {}
    for source in arms:
        for target in arms:
            if source is not target:
                _connect_arms(town, source, target, lines)
    for a, line_a in lines.items():
        for b, line_b in lines.items():
            if a != b and _closest(line_a, line_b) < 2.9 and not _same_lane(town.network, a, b):
                town.conflicts.add((a, b))
    parked = [_parking(town.network.roads[arm.id], arm) for arm in arms if arm.parking > 0.0]
    town.parking = np.concatenate([town.parking, *parked])
    for arm in arms:
        _add_walks(town, town.network.roads[arm.id], arm)
    return town


def _parking(road: RoadSpec, arm: _Arm) -> FloatArray:
    """(n, 3) poses of parked cars, away from crosswalk and junction."""
    first, last = arm.crosswalk
    places = np.arange(14.0, road.length - 8.0, _PARKING_STEP)
    places = places[(places < first - 9.0) | (places > last + 9.0)]
    lane = arm.lanes + 1
    right, left = road.center_of(-lane, places), road.center_of(lane, places)
    left[:, 2] += np.pi
    return np.concatenate([right, left])


def _arm_road(arm: _Arm, junction: int) -> RoadSpec:
    cos, sin = np.cos(arm.angle), np.sin(arm.angle)
    lanes = [("driving", arm.width)] * arm.lanes
    lanes += [("parking", arm.parking)] if arm.parking > 0.0 else []
    lanes += [("sidewalk", _SIDEWALK)]
    return RoadSpec(
        arm.id,
        (float(arm.radius * cos), float(arm.radius * sin), float(arm.angle)),
        arm.pieces,
        tuple(
            LaneSpec(sign * number, kind, width)
            for sign in (1, -1)
            for number, (kind, width) in enumerate(lanes, start=1)
        ),
        arm.limit,
        predecessor=("junction", junction, ""),
        crosswalks=(CrosswalkSpec(f"crosswalk_{arm.id}", *arm.crosswalk, arm.half),),
        stop_sign=None if arm.is_main else _STOP,
    )


def _connect_arms(town: Town, source: _Arm, target: _Arm, lines: dict[int, FloatArray]) -> None:
    """Connecting roads from one arm to another, one per lane that leads there."""
    turn = (target.angle - source.angle - np.pi + np.pi) % (2 * np.pi) - np.pi
    straight, left = abs(turn) < 0.1, turn > 0.1
    if straight:
        pairs = [(n, n) for n in range(1, source.lanes + 1)]
    elif left:
        pairs = [(1, 1)]
    else:
        pairs = [(source.lanes, target.lanes)]
    rank = (0 if source.is_main else 2) + (1 if left else 0)
    for from_lane, to_lane in pairs:
        number = 10 * source.id + target.id + 100 * from_lane
        road = _connecting_road(town.network, source, target, from_lane, to_lane, number)
        town.network.roads[number] = road
        town.network.links.append(Link(source.id, number, from_lane))
        into, out = town.network.roads[source.id], town.network.roads[target.id]
        inner = road.center_of(-1, np.arange(0.0, road.length, STEP))[:, :2]
        lines[number] = inner
        path = _make_path(
            [
                into.center_of(from_lane, np.arange(0.0, into.length, STEP))[::-1, :2],
                inner,
                out.center_of(-to_lane, np.arange(0.0, out.length, STEP))[:, :2],
            ],
            [source.limit, min(source.limit, target.limit), target.limit],
        )
        entry, exit = _arc_at(path.points, inner[0]), _arc_at(path.points, inner[-1])
        path = replace(
            path,
            entry=entry,
            exit=exit,
            stop=entry - _STOP,
            connector=number,
            rank=rank,
            crosswalks=(
                _crossing(path, into, source, from_lane),
                _crossing(path, out, target, -to_lane),
            ),
            origin=f"{source.name}{from_lane}",
        )
        name = f"{source.name}{from_lane}-{target.name}"
        town.paths[name] = path
        if from_lane == source.lanes:
            town.paths[f"{name}-bicycle"] = _shifted(path, -0.9)


def _crossing(path: Path, road: RoadSpec, arm: _Arm, lane: int) -> tuple[str, float, float]:
    """Name of an arm's crosswalk, and where a path along one of its lanes meets it."""
    ends = road.center_of(lane, np.array(arm.crosswalk))
    first, last = sorted(_arc_at(path.points, end[:2]) for end in ends)
    return f"crosswalk_{arm.id}", first, last


def _connecting_road(
    network: RoadNetwork, source: _Arm, target: _Arm, from_lane: int, to_lane: int, number: int
) -> RoadSpec:
    into, out = network.roads[source.id], network.roads[target.id]
    zero = np.zeros(1)
    start = into.at(zero, (from_lane - 1) * source.width)[0]
    end = out.at(zero, -(to_lane - 1) * target.width)[0]
    start[2] += np.pi
    turns_right = (target.angle - source.angle) % (2 * np.pi) < np.pi - 0.1
    return RoadSpec(
        number,
        (float(start[0]), float(start[1]), float(start[2])),
        connect(start.tolist(), end.tolist(), ease=not turns_right),
        (LaneSpec(-1, "driving", source.width, target.width, from_lane, -to_lane),),
        min(source.limit, target.limit),
        junction=network.junction,
        predecessor=("road", source.id, "start"),
        successor=("road", target.id, "start"),
    )


def _add_walks(town: Town, road: RoadSpec, arm: _Arm) -> None:
    """Ways over the crosswalk of a road, and along its sidewalks."""
    half, middle = arm.half, 0.5 * sum(arm.crosswalk)
    far = min(middle + 30.0, road.length - 3.0)
    for name, sign in ((f"{road.id}-cross-right", 1.0), (f"{road.id}-cross-left", -1.0)):
        aside = half + 1.2 + 0.4 * sign  # opposite ways never meet
        for suffix, offset in (("", -0.9), ("-b", -0.2)) if sign > 0 else (("", 0.5), ("-b", 1.2)):
            at = middle + offset
            before = road.at(np.arange(far, at, -STEP), sign * aside)[:, :2]
            across = np.arange(aside, -aside, -STEP)
            over = road.at(np.full(len(across), at), sign * across)[:, :2]
            after = road.at(np.arange(at, far - 6.0, STEP), -sign * aside)[:, :2]
            points = _resample(np.concatenate([before, over, after]), 0.6)
            kerb = _arc_at(points, over[0]) + (aside - half) - 0.6
            town.walks[name + suffix] = Walk(
                points, f"crosswalk_{road.id}", kerb, kerb + 2 * half + 1.4
            )
    for name, sign in ((f"{road.id}-along-left", 1.0), (f"{road.id}-along-right", -1.0)):
        s = np.arange(middle + 8.0, road.length - 3.0, STEP)
        points = road.at(s, sign * (half + 2.5))[:, :2]
        town.walks[name] = Walk(_resample(points if sign > 0 else points[::-1], 0.6))


def _make_path(parts: list[FloatArray], limits_kmh: list[float]) -> Path:
    points = _resample(np.concatenate(parts), _SMOOTHING)
    arc = STEP * np.arange(len(points))
    edges = np.cumsum([STEP * len(part) for part in parts])
    limit = np.array(limits_kmh)[np.minimum(np.searchsorted(edges, arc), len(parts) - 1)] / 3.6
    bending = np.abs(np.gradient(points[:, 2], STEP))
    speed = np.minimum(0.94 * limit, np.sqrt(_LATERAL_ACCEL / np.maximum(bending, 1e-4)))
    for index in range(len(speed) - 2, -1, -1):  # brake in time
        speed[index] = min(speed[index], np.sqrt(speed[index + 1] ** 2 + 2 * _BRAKING * STEP))
    return Path(points, speed)


def _shifted(path: Path, aside: float) -> Path:
    """The same path, further to the left by `aside`; slow enough for a bicycle."""
    points = path.points.copy()
    points[:, 0] -= aside * np.sin(points[:, 2])
    points[:, 1] += aside * np.cos(points[:, 2])
    return replace(path, points=points, speed=np.minimum(path.speed, 4.5))


def _resample(xy: FloatArray, smoothing: float) -> FloatArray:
    """(n, 3) points `STEP` apart along a smoothed polyline, with headings."""
    step = np.hypot(*np.diff(xy, axis=0).T)
    xy = xy[np.r_[True, step > 1e-6]]
    arc = np.r_[0.0, np.cumsum(np.hypot(*np.diff(xy, axis=0).T))]
    fine = 0.1
    dense = np.column_stack([np.interp(np.arange(0, arc[-1], fine), arc, xy[:, k]) for k in (0, 1)])
    reach = round(3 * smoothing / fine)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) * fine / smoothing) ** 2)
    weights /= weights.sum()
    head = dense[0] + np.arange(-reach, 0)[:, None] * (dense[1] - dense[0])
    tail = dense[-1] + np.arange(1, reach + 1)[:, None] * (dense[-1] - dense[-2])
    padded = np.concatenate([head, dense, tail])
    smooth = np.column_stack([np.convolve(padded[:, k], weights, "valid") for k in (0, 1)])
    arc = np.r_[0.0, np.cumsum(np.hypot(*np.diff(smooth, axis=0).T))]
    at = np.arange(0.0, arc[-1], STEP)
    out = np.column_stack([np.interp(at, arc, smooth[:, 0]), np.interp(at, arc, smooth[:, 1])])
    tangent = np.gradient(smooth, fine, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return np.column_stack([out, np.interp(at, arc, heading)])


def _arc_at(points: FloatArray, xy: FloatArray) -> float:
    return STEP * float(np.argmin(np.hypot(*(points[:, :2] - xy).T)))


def _closest(a: FloatArray, b: FloatArray) -> float:
    gaps = a[:, None] - b[None]
    return float(np.hypot(gaps[..., 0], gaps[..., 1]).min())


def _same_lane(network: RoadNetwork, a: int, b: int) -> bool:
    """Whether two connecting roads start from the same lane."""
    starts = {link.connecting: (link.incoming, link.from_lane) for link in network.links}
    return starts[a] == starts[b]
