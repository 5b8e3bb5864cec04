"""Traffic of the demo: drivers who follow, yield and stop, pedestrians who wait and cross.

Drivers keep to a path and follow what is on it (IDM), brake evenly towards places where they must
wait, and change their acceleration gradually. A junction admits one of two conflicting connectors
at a time; a crosswalk belongs to whoever is on it, then to pedestrians that vehicles can still stop
for. Steps are the frames of the recording.
"""

from dataclasses import dataclass, field
from math import cos, hypot, inf, sin, sqrt

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.demo_towns import STEP, Path, Town, Walk

DT = 0.08  # s, 12.5 Hz
_MAX_ACCEL, _BRAKING, _HARDEST = 1.3, 1.6, 3.2  # m/s^2
_JERK = 1.6  # m/s^3
_HEADWAY, _MIN_GAP = 1.5, 2.5  # s, m
_LOOK_AHEAD = 60.0  # m
_REQUEST = 6.0  # s before the stop line at which a driver asks to enter
_EVEN = 1.15  # m/s^2, even braking towards a place to wait begins here
_YIELDING = 1.8  # m/s^2, a driver stops for waiting pedestrians when this is enough
_SPARE = 0.9  # m, aimed at before the place to wait
_SIDE_MARGIN = 0.4  # m
_WALKING = 1.35  # m/s

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
    """One vehicle or bicycle under way.

    Attributes:
        category: DSC3D category.
        path: What it follows.
        s: Arc length of its box centre [m].
        v: Speed [m/s].
        eager: Factor on the desired speed.
        start: When it appears [s].
        a: Acceleration [m/s^2].
        holds: Whether it has been admitted to the junction.
        waiting: Places it has begun to brake for.
        patience: How long it will stand before others let it in [s].
    """

    category: str
    path: Path
    s: float
    v: float
    eager: float = 1.0
    start: float = 0.0
    a: float = 0.0
    holds: bool = False
    waiting: set[str] = field(default_factory=set)
    patience: float = 6.0
    token: int = 0

    @property
    def rank(self) -> int:
        """Order of priority at the junction now, smallest first."""
        return self.path.rank if self.patience > 0.0 else -1

    @property
    def length(self) -> float:
        """Length of the box [m]."""
        return SIZES[self.category][0]

    @property
    def front(self) -> float:
        """Arc length of the front bumper [m]."""
        return self.s + 0.5 * self.length

    @property
    def rear(self) -> float:
        """Arc length of the rear bumper [m]."""
        return self.s - 0.5 * self.length


@dataclass(eq=False)
class Walker:
    """One pedestrian.

    Attributes:
        walk: The way.
        start: When the pedestrian appears [s].
        s: Arc length [m].
        v: Speed [m/s].
        crossing: Whether the crosswalk has been entered.
    """

    walk: Walk
    start: float = 0.0
    s: float = 0.0
    v: float = _WALKING
    crossing: bool = False
    token: int = 0


@dataclass(frozen=True)
class Box:
    """One annotated box at one frame."""

    frame: int
    track: int
    category: str
    pose: tuple[float, float, float]
    speed: float
    accel: float
    yaw_rate: float


@dataclass
class Traffic:
    """Everybody in a town, and the recording so far."""

    town: Town
    drivers: list[Driver]
    walkers: list[Walker]
    boxes: list[Box] = field(default_factory=list)

    def record(self, duration: float) -> list[Box]:
        """Simulate from time 0 and return the boxes of all frames."""
        for number, driver in enumerate(self.drivers, start=1):
            driver.token = number
        for number, walker in enumerate(self.walkers, start=len(self.drivers) + 1):
            walker.token = number
        waiting = list(self.drivers)
        active: list[Driver] = []
        for frame in range(round(duration / DT) + 1):
            time = frame * DT
            for driver in list(waiting):
                if driver.start <= time and _has_room(driver, active):
                    active.append(driver)
                    waiting.remove(driver)
            walkers = [w for w in self.walkers if w.start <= time and _is_under_way(w)]
            self._write(frame, active, walkers)
            self._step(active, walkers)
            active = [d for d in active if d.front < d.path.length - 1.0]
        return self.boxes

    def _write(self, frame: int, drivers: list[Driver], walkers: list[Walker]) -> None:
        for driver in drivers:
            x, y, heading = driver.path.at(driver.s)
            bend = (driver.path.at(driver.s + 0.5)[2] - driver.path.at(driver.s - 0.5)[2]) / 1.0
            self.boxes.append(
                Box(
                    frame,
                    driver.token,
                    driver.category,
                    (x, y, heading),
                    driver.v,
                    driver.a,
                    bend * driver.v,
                )
            )
        for walker in walkers:
            x, y, heading = _walk_pose(walker)
            self.boxes.append(
                Box(frame, walker.token, "pedestrian", (x, y, heading), walker.v, 0.0, 0.0)
            )
        count = len(self.drivers) + len(self.walkers)
        for number, pose in enumerate(self.town.parking, start=count + 1):
            category = "van" if number % 7 == 0 else "car"
            self.boxes.append(Box(frame, number, category, tuple(pose.tolist()), 0.0, 0.0, 0.0))

    def _step(self, drivers: list[Driver], walkers: list[Walker]) -> None:
        self._admit(drivers)
        bodies = _bodies(drivers)
        wanted = [self._acceleration(d, drivers, walkers, bodies) for d in drivers]
        self._let_walk(drivers, walkers)
        for driver, accel in zip(drivers, wanted, strict=True):
            driver.a += min(max(accel - driver.a, -1.5 * _JERK * DT), _JERK * DT)
            if driver.v + driver.a * DT < 0.0 or (driver.v < 0.02 and accel <= 0.0):
                driver.a = -driver.v / DT if driver.v > 0.02 else 0.0
                driver.s += 0.5 * driver.v * DT
                driver.v = 0.0
                driver.a = 0.0
                continue
            driver.s += driver.v * DT + 0.5 * driver.a * DT * DT
            driver.v += driver.a * DT
        for walker in walkers:
            walker.s += walker.v * DT

    def _admit(self, drivers: list[Driver]) -> None:
        """Let drivers into the junction, by priority, where nobody in it is in their way."""
        for driver in drivers:
            if driver.holds and (driver.rear > driver.path.exit or _is_yielding(driver)):
                driver.holds = False
        asking = [d for d in drivers if d.path.connector >= 0 and not d.holds and _is_before(d)]
        asking.sort(key=lambda d: (d.rank, _arrival(d), d.token))
        refused: list[Driver] = []
        for driver in asking:
            if driver.v < 0.3 and "junction" in driver.waiting:
                driver.patience -= DT
            if (
                _arrival(driver) > _REQUEST
                or _is_yielding(driver)
                or _must_queue(driver, drivers)
                or any(self._conflict(driver, d) for d in refused)
            ):
                continue
            rivals = [d for d in drivers if self._conflict(driver, d)]
            driver.holds = not any(d.holds or _goes_first(d, driver) for d in rivals)
            if not driver.holds and driver.patience <= 0.0:
                refused.append(driver)

    def _conflict(self, a: Driver, b: Driver) -> bool:
        return (a.path.connector, b.path.connector) in self.town.conflicts

    def _acceleration(
        self, driver: Driver, drivers: list[Driver], walkers: list[Walker], bodies: FloatArray
    ) -> float:
        index = min(int(driver.s / STEP), len(driver.path.speed) - 1)
        target = max(driver.eager * driver.path.speed[index], 0.5)
        free = _MAX_ACCEL * (1.0 - (driver.v / target) ** 4)
        accel = max(free, -1.8)
        gap, lead_speed = _leader(driver, drivers, bodies)
        if gap < inf:
            closing = driver.v * (driver.v - lead_speed) / (2 * sqrt(_MAX_ACCEL * _BRAKING))
            wanted = _MIN_GAP + max(0.0, driver.v * _HEADWAY + closing)
            following = free - _MAX_ACCEL * (wanted / max(gap, 0.3)) ** 2
            accel = min(accel, max(following, -_HARDEST))
        for name, place in self._places_to_wait(driver, walkers):
            accel = min(accel, _even_braking(driver, name, place))
        return accel

    def _places_to_wait(self, driver: Driver, walkers: list[Walker]) -> list[tuple[str, float]]:
        places = []
        path = driver.path
        if path.connector >= 0 and not driver.holds and _is_before(driver):
            places.append(("junction", path.stop))
        else:
            driver.waiting.discard("junction")
        for name, first, _ in path.crosswalks:
            place = first - 1.5
            before = driver.front <= first - 0.3
            if before and self._is_claimed(driver, name, place, walkers):
                places.append((name, place))
            else:
                driver.waiting.discard(name)
        return places

    def _is_claimed(self, driver: Driver, name: str, place: float, walkers: list[Walker]) -> bool:
        """Whether a driver must wait before a crosswalk."""
        for walker in walkers:
            if walker.walk.crosswalk != name or walker.s > walker.walk.across:
                continue
            if walker.crossing:
                return True
            near = walker.s > walker.walk.kerb - 2.5
            if near and (name in driver.waiting or _needed(driver, place) < _YIELDING):
                return True
        return False

    def _let_walk(self, drivers: list[Driver], walkers: list[Walker]) -> None:
        for walker in walkers:
            walk = walker.walk
            at_kerb = walk.kerb - 0.9 <= walker.s <= walk.kerb + 0.2
            if at_kerb and not walker.crossing and not self._may_cross(walker, drivers):
                walker.v = max(walker.v - 2.2 * DT, 0.0)
                continue
            if walker.s >= walk.kerb - 0.9:
                walker.crossing = walker.s <= walk.across
            walker.v = min(walker.v + 1.0 * DT, _WALKING)

    def _may_cross(self, walker: Walker, drivers: list[Driver]) -> bool:
        needed = (walker.walk.across - walker.walk.kerb) / _WALKING + 2.0
        for driver in drivers:
            for name, first, last in driver.path.crosswalks:
                if name != walker.walk.crosswalk or driver.rear > last + 0.5:
                    continue
                stands = driver.v < 0.3
                if driver.front > first - (0.4 if stands else 1.6):
                    return False
                far = (first - 1.5 - driver.front) / max(driver.v, 1.0) > needed
                gentle = _YIELDING + 0.1 if name in driver.waiting else _EVEN
                if not (stands or far or _needed(driver, first - 1.5) < gentle):
                    return False
        return True


def _needed(driver: Driver, place: float) -> float:
    """Even deceleration that stops the front bumper at a place [m/s^2]."""
    return driver.v**2 / (2.0 * max(place - _SPARE - driver.front, 0.2))


def _even_braking(driver: Driver, name: str, place: float) -> float:
    needed = _needed(driver, place)
    if needed < _EVEN and name not in driver.waiting:
        return _MAX_ACCEL
    driver.waiting.add(name)
    if driver.v < 0.1 and place - driver.front > 3.0:
        driver.waiting.discard(name)  # stopped short of it behind somebody: close up
    return -min(needed, _HARDEST) if driver.v > 0.05 else -0.5


def _arrival(driver: Driver) -> float:
    """Time until the stop line at the present speed [s]."""
    return max(driver.path.stop - driver.front, 0.0) / max(driver.v, 3.0)


def _must_queue(driver: Driver, drivers: list[Driver]) -> bool:
    """Whether somebody ahead still has to enter, or stands behind the junction."""
    x, y, _ = driver.path.at(min(driver.path.exit + 6.0, driver.path.length))
    for other in drivers:
        if other is driver:
            continue
        same_start = other.path.origin == driver.path.origin
        if same_start and driver.s < other.s and not other.holds and _is_before(other):
            return True
        ox, oy, _ = other.path.at(other.s)
        if other.v < 2.0 and hypot(ox - x, oy - y) < 8.0 and other.s > other.path.exit - 4.0:
            return True
    return False


def _goes_first(driver: Driver, other: Driver) -> bool:
    """Whether a driver with priority is too near for another one to enter before it."""
    clear = _arrival(other) + (other.path.exit - other.path.stop + other.length) / 4.5
    return (
        driver.rank < other.rank
        and _is_before(driver)
        and driver.v > 0.5
        and _arrival(driver) < clear + 1.0
    )


def _is_yielding(driver: Driver) -> bool:
    """Whether a driver waits for pedestrians before the junction."""
    return _is_before(driver) and driver.path.crosswalks[0][0] in driver.waiting


def _is_before(driver: Driver) -> bool:
    """Whether a driver has not passed the stop line."""
    return driver.front <= driver.path.stop + 2.0


def _has_room(driver: Driver, active: list[Driver]) -> bool:
    """Whether nobody is near the place where a driver appears."""
    x, y, _ = driver.path.at(driver.s)
    for other in active:
        ox, oy, _ = other.path.at(other.s)
        room = 0.5 * (driver.length + other.length) + 6.0 + 1.2 * driver.v
        if hypot(ox - x, oy - y) < room and abs(_aside(driver, ox, oy)) < 2.5:
            return False
    return True


def _aside(driver: Driver, x: float, y: float) -> float:
    px, py, heading = driver.path.at(driver.s)
    return float(-(x - px) * sin(heading) + (y - py) * cos(heading))


def _bodies(drivers: list[Driver]) -> FloatArray:
    """(3 n, 3) rear, middle and front of everybody, and half the width."""
    out = []
    for driver in drivers:
        x, y, heading = driver.path.at(driver.s)
        half = 0.5 * driver.length - 0.3
        dx, dy, wide = half * cos(heading), half * sin(heading), 0.5 * SIZES[driver.category][1]
        out += [(x - dx, y - dy, wide), (x, y, wide), (x + dx, y + dy, wide)]
    return np.array(out).reshape(-1, 3)


def _leader(driver: Driver, drivers: list[Driver], bodies: FloatArray) -> tuple[float, float]:
    """Gap to the nearest vehicle on the path ahead [m] and its speed along it [m/s]."""
    begin = int(driver.s / STEP)
    reach = min(12.0 + 4.0 * driver.v, _LOOK_AHEAD)
    points = driver.path.points[begin : begin + round(reach / STEP) : 2]
    if len(points) < 2 or len(drivers) < 2:
        return inf, 0.0
    dx = bodies[:, :1] - points[:, 0]
    dy = bodies[:, 1:2] - points[:, 1]
    square = dx * dx + dy * dy
    nearest = square.argmin(axis=1)
    aside = np.sqrt(square[np.arange(len(square)), nearest]) - bodies[:, 2]
    along = driver.s + nearest * 2 * STEP
    own = 0.5 * SIZES[driver.category][1] + _SIDE_MARGIN
    best, speed = inf, 0.0
    for part in np.flatnonzero((aside < own) & (nearest > 0)).tolist():
        other = drivers[part // 3]
        if other is driver:
            continue
        turn = other.path.at(other.s)[2] - driver.path.at(along[part])[2]
        gap = float(along[part]) - 0.3 - driver.front
        if abs(cos(turn)) < 0.7:
            gap -= bodies[part, 2]
        if gap < best:
            best, speed = gap, max(0.0, other.v * cos(turn))
    return best, speed


def _walk_pose(walker: Walker) -> tuple[float, float, float]:
    return walker.walk.at(walker.s)


def _is_under_way(walker: Walker) -> bool:
    return walker.s < STEP * (len(walker.walk.points) - 1) - 0.5
