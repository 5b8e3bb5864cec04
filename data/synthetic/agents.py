"""Drivers and pedestrians of the demo, and what a driver knows about the place ahead."""

from dataclasses import dataclass, field
from math import cos, hypot, pi, sin

from shiftsim.data.synthetic.paths import Path, Walk, Zone

WALKING = 1.35  # m/s
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
    held: set[int] = field(default_factory=set)  # zones of its path it has been admitted to
    waiting: set[str] = field(default_factory=set)  # places it has begun to brake for
    patience: float = 6.0  # how long it will stand before others let it in [s]
    # arc length where it stops for a while, and how long [m, s]
    halt: tuple[float, float] = (0.0, 0.0)
    # share by which it slows down again and again, and how often that is [s]
    wave: tuple[float, float] = (0.0, 1.0)
    is_parked: bool = False  # whether it moves off beside the road, once nobody comes from behind
    token: int = 0  # number of its track
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x, y [m], heading [rad] of its centre

    def __post_init__(self) -> None:
        self.length, self.width, _ = SIZES[self.category]
        self.place = self.path.at(self.s)

    @property
    def front(self) -> float:
        """Arc length of the front bumper [m]."""
        return self.s + 0.5 * self.length

    @property
    def rear(self) -> float:
        """Arc length of the rear bumper [m]."""
        return self.s - 0.5 * self.length

    @property
    def has_arrived(self) -> bool:
        """Whether it leaves the recording."""
        return not self.path.is_parking and self.front >= self.path.length - 1.0

    def pace(self, time: float) -> float:
        """Factor on the desired speed at a time [s]."""
        depth, period = self.wave
        return self.eager * (1.0 - depth * (0.5 - 0.5 * cos(2.0 * pi * time / period)))

    def move_to(self, s: float) -> None:
        """Go on to an arc length."""
        self.s = s
        self.place = self.path.at(s)

    def is_before(self, zone: Zone) -> bool:
        """Whether the stop line of a zone has not been passed."""
        return self.front <= zone.stop + 2.0

    def next_zone(self) -> Zone | None:
        """The first zone ahead that it has not been admitted to."""
        ahead = (z for z in self.path.zones if z.id not in self.held and self.is_before(z))
        return next(ahead, None)

    def rank(self, zone: Zone) -> int:
        """Order of priority at a zone now, smallest first."""
        return zone.rank if self.patience > 0.0 else -1

    def arrival(self, zone: Zone) -> float:
        """Time until the stop line at the present speed [s]."""
        return max(zone.stop - self.front, 0.0) / max(self.v, 3.0)

    def is_yielding(self, zone: Zone) -> bool:
        """Whether it waits for pedestrians before a zone."""
        return bool(zone.crosswalk) and self.is_before(zone) and zone.crosswalk in self.waiting

    def is_held_up(self, zone: Zone) -> bool:
        """Whether it stands well before a zone, behind somebody."""
        return self.v < 0.5 and zone.stop - self.front > 4.0

    def needed(self, place: float) -> float:
        """Even deceleration that stops the front bumper at a place [m/s^2]."""
        return self.v**2 / (2.0 * max(place - _SPARE - self.front, 0.2))

    def aside(self, x: float, y: float) -> float:
        """How far a point lies to the left [m]."""
        px, py, heading = self.place
        return -(x - px) * sin(heading) + (y - py) * cos(heading)


@dataclass(eq=False)
class Walker:
    """One pedestrian."""

    walk: Walk  # the way
    start: float = 0.0  # when the pedestrian appears [s]
    s: float = 0.0  # arc length [m]
    v: float = WALKING  # speed [m/s]
    crossing: bool = False  # whether the road has been entered
    token: int = 0  # number of the track

    @property
    def is_under_way(self) -> bool:
        """Whether the end of the way has not been reached."""
        return self.s < self.walk.length - 0.5


def goes_first(driver: Driver, zone: Zone, other: Driver, wanted: Zone) -> bool:
    """Whether a driver with priority is too near for another one to enter before it."""
    clear = other.arrival(wanted) + (wanted.exit - wanted.stop + other.length) / 5.5
    return (
        driver.rank(zone) < other.rank(wanted)
        and driver.is_before(zone)
        and driver.v > 0.5
        and driver.arrival(zone) < clear + 1.0
    )


def must_queue(driver: Driver, zone: Zone, drivers: list[Driver]) -> bool:
    """Whether somebody ahead still has to enter, or stands behind the zone."""
    x, y, heading = driver.path.at(min(zone.exit + 6.0, driver.path.length))
    own = zone.stop - driver.front
    for other in drivers:
        if other is driver:
            continue
        ahead = other.next_zone()
        if ahead and ahead.origin == zone.origin and ahead.stop - other.front < own:
            return True
        ox, oy, turned = other.place
        if other.v < 2.0 and hypot(ox - x, oy - y) < 8.0 and cos(turned - heading) > 0.5:
            return True
    return False


def has_room(driver: Driver, active: list[Driver]) -> bool:
    """Whether nobody is near the place where a driver appears."""
    x, y, _ = driver.place
    for other in active:
        ox, oy, _ = other.place
        room = 0.5 * (driver.length + other.length) + 6.0 + 1.2 * driver.v
        if hypot(ox - x, oy - y) < room and abs(driver.aside(ox, oy)) < 2.5:
            return False
    return True
