"""Vehicles and pedestrians of synthetic towns, and the smooth lines that they follow."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import cos, hypot, sin

import numpy as np

from shiftsim.data.synthetic.roads import STEP
from shiftsim.kernels import FloatArray

WALKING = 1.35  # m/s
_SMOOTHING = 2.5  # m, how far a driver rounds off the corners of the lane centres
_LATERAL_ACCEL = 1.8  # m/s^2, comfortable in curves
_BRAKING = 1.0  # m/s^2, comfortable before curves
_SPARE = 0.9  # m, aimed at before the place to wait

SIZES = {
    "car": (4.5, 1.85, 1.5),
    "van": (5.3, 2.0, 2.2),
    "pickup": (5.4, 2.0, 1.9),
    "truck": (8.2, 2.4, 3.3),
    "bus": (11.0, 2.5, 3.1),
    "motorcycle": (2.2, 0.8, 1.4),
    "bicycle": (1.8, 0.6, 1.7),
    "pedestrian": (0.6, 0.6, 1.75),
}


@dataclass(frozen=True)
class Line:
    """A smooth line, given by n points `STEP` apart."""

    points: FloatArray  # (n, 3) x [m], y [m], heading, unwrapped [rad]

    @cached_property
    def _rows(self) -> list[list[float]]:
        return self.points.tolist()

    @property
    def length(self) -> float:
        """Length of the line [m]."""
        return STEP * (len(self.points) - 1)

    def curvature(self, s: float) -> float:
        """Curvature at an arc length [1/m]."""
        index = min(max(int(s / STEP), 1), len(self._rows) - 2)
        return (self._rows[index + 1][2] - self._rows[index - 1][2]) / (2.0 * STEP)

    def at(self, s: float) -> tuple[float, float, float]:
        """X [m], y [m] and heading [rad] at an arc length."""
        index = min(max(int(s / STEP), 0), len(self._rows) - 2)
        (x, y, heading), (bx, by, bh) = self._rows[index], self._rows[index + 1]
        share = s / STEP - index
        return x + share * (bx - x), y + share * (by - y), heading + share * (bh - heading)


@dataclass(frozen=True)
class Zone:
    """A stretch of a path that must be entered one after the other: a junction, a narrow place."""

    id: int  # of the connecting road; negative for narrow places
    rank: int  # order of priority, 0 first
    origin: str  # lane it is entered from
    entry: float = 0.0  # where it begins [m]
    exit: float = 0.0  # where it ends [m]
    stop: float = 0.0  # where a vehicle that must wait stops [m]
    crosswalk: str = ""  # name of the crosswalk between stop and entry, empty without one


@dataclass(frozen=True)
class Path(Line):
    """What one vehicle can follow."""

    speed: FloatArray  # (n,) desired speed of an ordinary driver [m/s]
    zones: tuple[Zone, ...] = ()  # on the way, in order
    # name, first and last arc length of the places where pedestrians cross [m]
    crossings: tuple[tuple[str, float, float], ...] = ()
    is_parking: bool = False  # whether vehicles stay at its end


@dataclass(frozen=True)
class Walk(Line):
    """A way of a pedestrian."""

    crossing: str = ""  # name of the place where it crosses a road, empty for none
    kerb: float = np.inf  # where the pedestrian waits to cross [m]
    across: float = np.inf  # where the other side is reached [m]


def path_along(parts: Sequence[FloatArray], limits_kmh: Sequence[float]) -> Path:
    """A path along lane centres (n, 2) [m], with comfortable speeds and no zones yet."""
    points = resample(np.concatenate(parts), _SMOOTHING)
    arc = STEP * np.arange(len(points))
    edges = np.cumsum([STEP * len(part) for part in parts])
    limit = np.array(limits_kmh)[np.minimum(np.searchsorted(edges, arc), len(parts) - 1)] / 3.6
    bending = np.abs(np.gradient(points[:, 2], STEP))
    speed = np.minimum(0.94 * limit, np.sqrt(_LATERAL_ACCEL / np.maximum(bending, 1e-4)))
    return Path(points, brake_in_time(speed))


def brake_in_time(speed: FloatArray) -> FloatArray:
    """(n,) speeds no higher than those given, that fall gently enough along a path."""
    out = speed.copy()
    for index in range(len(out) - 2, -1, -1):
        out[index] = min(out[index], np.sqrt(out[index + 1] ** 2 + 2 * _BRAKING * STEP))
    return out


def shifted(path: Path, aside: FloatArray | float) -> Path:
    """The same path, further to the left by `aside` [m]."""
    points = path.points.copy()
    points[:, 0] -= aside * np.sin(points[:, 2])
    points[:, 1] += aside * np.cos(points[:, 2])
    points[:, 2] = points[:, 2] + np.arctan(np.gradient(aside + np.zeros(len(points)), STEP))
    return replace(path, points=points)


def resample(xy: FloatArray, smoothing: float) -> FloatArray:
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
    tangent = np.gradient(smooth, fine, axis=0)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return np.column_stack([np.interp(at, arc, column) for column in (*smooth.T, heading)])


def arc_at(points: FloatArray, xy: FloatArray) -> float:
    """Arc length of the point of a line nearest to `xy` [m]."""
    return STEP * float(np.argmin(np.hypot(*(points[:, :2] - xy).T)))


@dataclass(eq=False)
class Driver:
    """One vehicle or bicycle under way."""

    category: str  # DSC3D category
    path: Path  # what it follows
    s: float  # arc length of its box centre [m]
    v: float  # speed [m/s]
    eager: float = 1.0  # factor on the desired speed
    start: float = 0.0  # when it appears [s]
    a: float = 0.0  # acceleration [m/s^2]
    admitted: set[int] = field(default_factory=set)  # zones of its path that it may enter
    waiting: set[int | str] = field(default_factory=set)  # places it has begun to brake for
    patience: float = 6.0  # how long it will stand before others let it in [s]
    # arc length where it stops for a while, and how long [m, s]
    halt: tuple[float, float] = (0.0, 0.0)
    # share by which it slows down again and again, and how often that is [s]
    wave: tuple[float, float] = (0.0, 1.0)
    is_parked: bool = False  # whether it moves off beside the road, once nobody comes from behind
    track: int = 0  # number of its track
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y [m], heading [rad] of its centre

    def __post_init__(self) -> None:
        self.length, self.width, _ = SIZES[self.category]
        self.pose = self.path.at(self.s)

    @property
    def front(self) -> float:
        """Arc length of the front bumper [m]."""
        return self.s + 0.5 * self.length

    @property
    def rear(self) -> float:
        """Arc length of the rear bumper [m]."""
        return self.s - 0.5 * self.length

    def move_to(self, s: float) -> None:
        """Go on to an arc length."""
        self.s = s
        self.pose = self.path.at(s)

    def is_before(self, zone: Zone) -> bool:
        """Whether the stop line of a zone has not been passed."""
        return self.front <= zone.stop + 2.0

    def next_zone(self) -> Zone | None:
        """The first zone ahead that it has not been admitted to."""
        ahead = (z for z in self.path.zones if z.id not in self.admitted and self.is_before(z))
        return next(ahead, None)

    def rank(self, zone: Zone) -> int:
        """Order of priority at a zone now, smallest first."""
        return zone.rank if self.patience > 0.0 else -1

    def arrival(self, zone: Zone) -> float:
        """Time until the stop line at the present speed [s]."""
        return max(zone.stop - self.front, 0.0) / max(self.v, 3.0)

    def waits(self, zone: Zone) -> bool:
        """Whether it waits for pedestrians before a zone, or well before it behind somebody."""
        yields = zone.crosswalk in self.waiting and self.is_before(zone)
        return yields or (self.v < 0.5 and zone.stop - self.front > 4.0)

    def needed(self, place: float) -> float:
        """Even deceleration that stops the front bumper at a place [m/s^2]."""
        return self.v**2 / (2.0 * max(place - _SPARE - self.front, 0.2))

    def offset(self, x: float, y: float) -> tuple[float, float]:
        """How far a point lies ahead, and to the left [m]."""
        px, py, heading = self.pose
        dx, dy = x - px, y - py
        return dx * cos(heading) + dy * sin(heading), dy * cos(heading) - dx * sin(heading)

    def has_room(self, others: Sequence["Driver"]) -> bool:
        """Whether nobody is near the place where it appears."""
        x, y, _ = self.pose
        for other in others:
            ox, oy, _ = other.pose
            room = 0.5 * (self.length + other.length) + 6.0 + 1.2 * self.v
            if hypot(ox - x, oy - y) < room and abs(self.offset(ox, oy)[1]) < 2.5:
                return False
        return True


@dataclass(eq=False)
class Pedestrian:
    """One pedestrian."""

    walk: Walk  # the way
    start: float = 0.0  # when the pedestrian appears [s]
    s: float = 0.0  # arc length [m]
    v: float = WALKING  # speed [m/s]
    is_crossing: bool = False  # whether the road has been entered
    track: int = 0  # number of the track
