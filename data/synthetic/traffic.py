"""Traffic of the demo: drivers who follow, yield and stop, pedestrians who wait and cross.

Drivers keep to a path and follow what is on it (IDM), brake evenly towards places where they must
wait, and change their acceleration gradually. A zone (junction, narrow place) admits one of two
conflicting ways at a time; a crossing belongs to whoever is on it, then to pedestrians that
vehicles can still stop for. Steps are the frames of the recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import cos, inf, sin, sqrt

import numpy as np

from shiftsim.data.synthetic.agents import WALKING, Driver, Walker, goes_first, has_room, must_queue
from shiftsim.data.synthetic.lights import Lights
from shiftsim.data.synthetic.paths import STEP, Zone, arc_at
from shiftsim.data.synthetic.town import Town
from shiftsim.kernels import FloatArray

DT = 0.08  # s, 12.5 Hz
_MAX_ACCEL, _BRAKING, _HARDEST = 1.3, 1.6, 3.2  # m/s^2
_JERK = 1.6  # m/s^3
_HEADWAY, _MIN_GAP = 1.5, 2.5  # s, m
_LOOK_AHEAD = 60.0  # m
_REQUEST = 1.0  # s before braking would begin, a driver asks to enter a zone
_EVEN = 1.15  # m/s^2, even braking towards a place to wait begins here
_YIELDING = 1.8  # m/s^2, a driver stops for waiting pedestrians when this is enough
_AT_YELLOW, _REACTION = 2.6, 0.5  # m/s^2, s, likewise for a light that turns
_SIDE_MARGIN = 0.4  # m
_PASSED = 2.8  # m between a pedestrian who has crossed and the middle of a driver's way

Box = tuple[int, int, str, float, float, float, float, float, float]


@dataclass
class Traffic:
    """Everybody in a town, and the recording so far."""

    town: Town  # where
    drivers: list[Driver]  # in the order of their tracks
    walkers: list[Walker]  # the tracks after those
    # frame, track, category, x [m], y [m], heading [rad], speed [m/s], acceleration [m/s^2], yaw
    # rate [rad/s]
    boxes: list[Box] = field(default_factory=list)
    lights: Sequence[Lights] = ()  # of junctions
    _passing: dict[tuple[int, int], float] = field(default_factory=dict)
    _closed: set[int] = field(
        default_factory=set
    )  # connecting roads with a light that is not green
    # how long the light for vehicles will stay red, by crosswalk [s]
    _waits: dict[str, float] = field(default_factory=dict)

    def record(self, duration: float) -> list[Box]:
        """Simulate from time 0, once, and return the boxes of all frames."""
        if self.boxes:
            return self.boxes
        everybody: list[Driver | Walker] = [*self.drivers, *self.walkers]
        for number, agent in enumerate(everybody, start=1):
            agent.token = number
        waiting = list(self.drivers)
        active: list[Driver] = []
        for frame in range(round(duration / DT) + 1):
            time = frame * DT
            for driver in [d for d in waiting if d.start <= time]:
                if has_room(driver, active):
                    active.append(driver)
                    waiting.remove(driver)
            walkers = [w for w in self.walkers if w.start <= time and w.is_under_way]
            self._write(frame, active, walkers)
            self._step(active, walkers, time)
            active = [d for d in active if not d.has_arrived]
        return self.boxes

    def _write(self, frame: int, drivers: list[Driver], walkers: list[Walker]) -> None:
        for driver in drivers:
            rate = driver.path.bend(driver.s) * driver.v
            row = (frame, driver.token, driver.category, *driver.place, driver.v, driver.a, rate)
            self.boxes.append(row)
        for walker in walkers:
            place = walker.walk.at(walker.s)
            self.boxes.append((frame, walker.token, "pedestrian", *place, walker.v, 0.0, 0.0))

    def _step(self, drivers: list[Driver], walkers: list[Walker], time: float) -> None:
        self._closed = {number for lights in self.lights for number in lights.closed(time)}
        self._waits = {name: x for lights in self.lights for name, x in lights.waits(time).items()}
        self._admit(drivers)
        bodies = _bodies(drivers)
        wanted = [self._acceleration(d, drivers, walkers, bodies, time) for d in drivers]
        self._let_walk(drivers, walkers)
        for driver, accel in zip(drivers, wanted, strict=True):
            driver.a += min(max(accel - driver.a, -1.5 * _JERK * DT), _JERK * DT)
            if driver.v + driver.a * DT < 0.0 or (driver.v < 0.02 and accel <= 0.0):
                driver.move_to(driver.s + 0.5 * driver.v * DT)
                driver.v = driver.a = 0.0
                continue
            driver.move_to(driver.s + driver.v * DT + 0.5 * driver.a * DT * DT)
            driver.v += driver.a * DT
        for walker in walkers:
            walker.s += walker.v * DT

    def _admit(self, drivers: list[Driver]) -> None:
        """Let drivers into zones, by priority, where nobody in there is in their way."""
        for driver in drivers:
            for held in driver.path.zones if driver.held else ():
                waits = driver.is_yielding(held) or driver.is_held_up(held)
                if driver.rear > held.exit or waits or self._must_stop(driver, held):
                    driver.held.discard(held.id)
        asking = [(d, zone) for d in drivers if (zone := d.next_zone())]
        asking.sort(key=lambda x: (x[0].rank(x[1]), x[0].arrival(x[1]), x[0].token))
        refused: list[Zone] = []
        for driver, zone in asking:
            if zone.id in self._closed:
                continue
            if driver.v < 0.3 and _place_of(zone) in driver.waiting:
                driver.patience -= DT
            is_far = driver.arrival(zone) > _REQUEST + driver.v / (2.0 * _EVEN)
            waits = driver.is_yielding(zone) or driver.is_held_up(zone)
            refuses = any(self._conflict(zone, other) for other in refused)
            if is_far or waits or refuses or must_queue(driver, zone, drivers):
                continue
            if not any(self._is_in_the_way(d, driver, zone) for d in drivers if d is not driver):
                driver.held.add(zone.id)
                driver.patience = 6.0
            elif driver.patience <= 0.0:
                refused.append(zone)

    def _must_stop(self, driver: Driver, zone: Zone) -> bool:
        """Whether a light has turned, and who was let in before can still stop."""
        place = zone.stop - _REACTION * driver.v
        is_shut = zone.id in self._closed and driver.is_before(zone)
        return is_shut and driver.needed(place) < _AT_YELLOW

    def _is_in_the_way(self, other: Driver, driver: Driver, wanted: Zone) -> bool:
        return any(
            zone.id in other.held
            or (zone.id not in self._closed and goes_first(other, zone, driver, wanted))
            for zone in other.path.zones
            if self._conflict(wanted, zone)
        )

    def _conflict(self, a: Zone, b: Zone) -> bool:
        return (a.id, b.id) in self.town.conflicts

    def _acceleration(
        self,
        driver: Driver,
        drivers: list[Driver],
        walkers: list[Walker],
        bodies: FloatArray,
        time: float,
    ) -> float:
        index = min(int(driver.s / STEP), len(driver.path.speed) - 1)
        target = max(driver.pace(time) * float(driver.path.speed[index]), 0.5)
        free = _MAX_ACCEL * (1.0 - (driver.v / target) ** 4)
        accel = max(free, -1.8)
        gap, lead_speed = _leader(driver, drivers, bodies)
        if gap < inf:
            closing = driver.v * (driver.v - lead_speed) / (2 * sqrt(_MAX_ACCEL * _BRAKING))
            wanted = _MIN_GAP + max(0.0, driver.v * _HEADWAY + closing)
            following = free - _MAX_ACCEL * (wanted / max(gap, 0.3)) ** 2
            accel = min(accel, max(following, -_HARDEST))
        for name, place in self._places_to_wait(driver, drivers, walkers):
            accel = min(accel, _even_braking(driver, name, place))
        return accel

    def _places_to_wait(
        self, driver: Driver, drivers: list[Driver], walkers: list[Walker]
    ) -> list[tuple[str, float]]:
        places = []
        path = driver.path
        for zone in path.zones:
            if zone.id not in driver.held and driver.is_before(zone):
                places.append((_place_of(zone), zone.stop))
            else:
                driver.waiting.discard(_place_of(zone))
        for name, first, _ in path.crossings:
            place = first - 1.5
            before = driver.front <= first - 0.3
            if before and self._is_claimed(driver, name, place, walkers):
                places.append((name, place))
            else:
                driver.waiting.discard(name)
        if driver.halt[1] > 0.0 and driver.front <= driver.halt[0]:
            places.append(("halt", driver.halt[0]))
            waits = driver.is_parked and any(_comes(x, driver) for x in drivers)
            if driver.v < 0.1 and driver.halt[0] - driver.front < 3.0 and not waits:
                driver.halt = driver.halt[0], driver.halt[1] - DT
        if path.is_parking:
            places.append(("end", path.length + 0.5 * driver.length + 0.9))
        return places

    def _is_claimed(self, driver: Driver, name: str, place: float, walkers: list[Walker]) -> bool:
        """Whether a driver must wait before a crossing."""
        for walker in walkers:
            if walker.walk.crossing != name or walker.s > self._passed(driver, walker):
                continue
            if walker.crossing:
                return True
            if name in self._waits and not self._has_time(walker):
                continue
            near = walker.s > walker.walk.kerb - 2.5
            if near and (name in driver.waiting or driver.needed(place) < _YIELDING):
                return True
        return False

    def _passed(self, driver: Driver, walker: Walker) -> float:
        """Where on its way over a crossing a pedestrian has left the way of a driver [m]."""
        key = (id(driver.path), id(walker.walk))
        if key not in self._passing:
            near = (p for n, *p in driver.path.crossings if n == walker.walk.crossing)
            x, y, _ = driver.path.at(0.5 * sum(next(near)))
            place = arc_at(walker.walk.points, np.array([x, y]))
            self._passing[key] = min(place + _PASSED, walker.walk.across)
        return self._passing[key]

    def _let_walk(self, drivers: list[Driver], walkers: list[Walker]) -> None:
        for walker in walkers:
            walk = walker.walk
            at_kerb = walk.kerb - 0.9 <= walker.s <= walk.kerb + 0.2
            if at_kerb and not walker.crossing and not self._may_cross(walker, drivers):
                walker.v = max(walker.v - 2.2 * DT, 0.0)
                continue
            if walker.s >= walk.kerb - 0.9:
                walker.crossing = walker.s <= walk.across
            walker.v = min(walker.v + 1.0 * DT, WALKING)

    def _has_time(self, walker: Walker) -> bool:
        """Whether the light lets a pedestrian cross."""
        walk = walker.walk
        return self._waits.get(walk.crossing, inf) > (walk.across - walk.kerb) / WALKING

    def _may_cross(self, walker: Walker, drivers: list[Driver]) -> bool:
        if not self._has_time(walker):
            return False
        needed = (walker.walk.across - walker.walk.kerb) / WALKING + 2.0
        for driver in drivers:
            for name, first, last in driver.path.crossings:
                if name != walker.walk.crossing or driver.rear > last + 0.5:
                    continue
                stands = driver.v < 0.3
                if driver.front > first - (0.4 if stands else 1.6):
                    return False
                far = (first - 1.5 - driver.front) / max(driver.v, 1.0) > needed
                gentle = _YIELDING + 0.1 if name in driver.waiting else _EVEN
                if not (stands or far or driver.needed(first - 1.5) < gentle):
                    return False
        return True


def _place_of(zone: Zone) -> str:
    return f"zone {zone.id}"


def _even_braking(driver: Driver, name: str, place: float) -> float:
    needed = driver.needed(place)
    if needed < _EVEN and name not in driver.waiting:
        return _MAX_ACCEL
    driver.waiting.add(name)
    if driver.v < 0.1 and place - driver.front > 3.0:
        driver.waiting.discard(name)  # stopped short of it behind somebody: close up
    return -min(needed, _HARDEST) if driver.v > 0.05 else -0.5


def _bodies(drivers: list[Driver]) -> FloatArray:
    """(n, 3, 3) rear, middle and front of everybody, and half the width."""
    out = []
    for driver in drivers:
        x, y, heading = driver.place
        half = 0.5 * driver.length - 0.3
        dx, dy, wide = half * cos(heading), half * sin(heading), 0.5 * driver.width
        out.append(((x - dx, y - dy, wide), (x, y, wide), (x + dx, y + dy, wide)))
    return np.array(out).reshape(-1, 3, 3)


def _leader(driver: Driver, drivers: list[Driver], bodies: FloatArray) -> tuple[float, float]:
    """Gap to the nearest vehicle on the path ahead [m] and its speed along it [m/s]."""
    begin = int(driver.s / STEP)
    reach = min(12.0 + 4.0 * driver.v, _LOOK_AHEAD)
    points = driver.path.points[begin : begin + round(reach / STEP) : 2]
    near = [k for k, other in enumerate(drivers) if _may_lead(other, driver, reach)]
    if len(points) < 2 or not near:
        return inf, 0.0
    parts = bodies[near].reshape(-1, 3)
    dx = parts[:, :1] - points[:, 0]
    dy = parts[:, 1:2] - points[:, 1]
    square = dx * dx + dy * dy
    nearest = square.argmin(axis=1)
    aside = np.sqrt(square[np.arange(len(square)), nearest]) - parts[:, 2]
    along = driver.s + nearest * 2 * STEP
    own = 0.5 * driver.width + _SIDE_MARGIN
    best, speed = inf, 0.0
    for part in np.flatnonzero((aside < own) & (nearest > 0)).tolist():
        other = drivers[near[part // 3]]
        turn = other.place[2] - driver.path.at(float(along[part]))[2]
        gap = float(along[part]) - 0.3 - driver.front
        if abs(cos(turn)) < 0.7:
            gap -= parts[part, 2]
        if gap < best:
            best, speed = gap, max(0.0, other.v * cos(turn))
    return best, float(speed)


def _comes(other: Driver, driver: Driver) -> bool:
    """Whether somebody is beside or behind on the lane that a parked driver moves off to."""
    x, y, heading = driver.place
    dx, dy = other.place[0] - x, other.place[1] - y
    along = dx * cos(heading) + dy * sin(heading)
    near = -4.5 * other.v - 12.0 < along < 9.0 and 0.5 < driver.aside(*other.place[:2]) < 5.0
    return near and cos(other.place[2] - heading) > 0.5


def _may_lead(other: Driver, driver: Driver, reach: float) -> bool:
    """Whether somebody is near enough to be on the path ahead, and not behind."""
    (x, y, heading), (ox, oy, _) = driver.place, other.place
    dx, dy = ox - x, oy - y
    limit = reach + 0.5 * other.length + 2.0
    return (
        other is not driver
        and dx * dx + dy * dy < limit * limit
        and dx * cos(heading) + dy * sin(heading) > -0.5 * other.length
    )
