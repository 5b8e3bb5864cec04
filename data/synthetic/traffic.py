"""Traffic of the demo: drivers who follow, yield and stop, pedestrians who wait and cross.

Drivers keep to a path and follow what is on it (IDM), brake evenly towards places where they must
wait, and change their acceleration gradually. A zone (junction, narrow place) admits one of two
conflicting ways at a time; a crossing belongs to whoever is on it, then to pedestrians that
vehicles can still stop for. Steps are the frames of the recording.
"""

from dataclasses import dataclass, field
from math import cos, hypot, inf, pi, sin, sqrt

import numpy as np

from shiftsim.data.synthetic.agents import WALKING, Driver, Pedestrian, Zone, arc_at
from shiftsim.data.synthetic.roads import STEP
from shiftsim.data.synthetic.town import Town
from shiftsim.kernels import FloatArray
from shiftsim.world.state import LightStatus

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
    pedestrians: list[Pedestrian]  # the tracks after those
    # frame, track, category, x [m], y [m], heading [rad], speed [m/s], acceleration [m/s^2], yaw
    # rate [rad/s]
    boxes: list[Box] = field(default_factory=list)
    # who is there now
    _driving: list[Driver] = field(default_factory=list)
    _on_foot: list[Pedestrian] = field(default_factory=list)
    # where pedestrians on a way over a crossing have left the way of drivers on a path [m]
    _passed: dict[tuple[int, int], float] = field(default_factory=dict)
    # connecting roads with a light that is not green
    _closed: set[int] = field(default_factory=set)
    # how long the vehicles before a crosswalk will see red [s]
    _waits: dict[str, float] = field(default_factory=dict)

    def record(self, duration: float) -> list[Box]:
        """Simulate from time 0, once, and return the boxes of all frames."""
        if self.boxes:
            return self.boxes
        everybody: list[Driver | Pedestrian] = [*self.drivers, *self.pedestrians]
        for number, agent in enumerate(everybody, start=1):
            agent.track = number
        waiting = list(self.drivers)
        for frame in range(round(duration / DT) + 1):
            time = frame * DT
            for driver in [d for d in waiting if d.start <= time]:
                if driver.has_room(self._driving):
                    self._driving.append(driver)
                    waiting.remove(driver)
            begun = [x for x in self.pedestrians if x.start <= time]
            self._on_foot = [x for x in begun if x.s < x.walk.length - 0.5]
            for x in self._driving:
                yaw_rate = x.path.curvature(x.s) * x.v
                self.boxes.append((frame, x.track, x.category, *x.pose, x.v, x.a, yaw_rate))
            for y in self._on_foot:
                place = y.walk.at(y.s)
                self.boxes.append((frame, y.track, "pedestrian", *place, y.v, 0.0, 0.0))
            self._step(time)
            self._driving = [
                x for x in self._driving if x.path.is_parking or x.front < x.path.length - 1.0
            ]
        return self.boxes

    def _step(self, time: float) -> None:
        lit, green = self.town.lit().items(), LightStatus.GREEN
        self._closed = {number for number, (x, k) in lit if x.status(k, time) != green}
        crossings = ((x, pair) for x in self.town.lights for pair in x.crossings.items())
        self._waits = {name: x.wait(phase, time) for x, (name, phase) in crossings}
        self._admit()
        bodies = _bodies(self._driving)
        wanted = [self._acceleration(driver, bodies, time) for driver in self._driving]
        self._let_walk()
        for driver, accel in zip(self._driving, wanted, strict=True):
            driver.a += min(max(accel - driver.a, -1.5 * _JERK * DT), _JERK * DT)
            if driver.v + driver.a * DT < 0.0 or (driver.v < 0.02 and accel <= 0.0):
                driver.move_to(driver.s + 0.5 * driver.v * DT)
                driver.v = driver.a = 0.0
                continue
            driver.move_to(driver.s + driver.v * DT + 0.5 * driver.a * DT * DT)
            driver.v += driver.a * DT
        for pedestrian in self._on_foot:
            pedestrian.s += pedestrian.v * DT

    def _admit(self) -> None:
        """Let drivers into zones, by priority, where nobody in there is in their way."""
        drivers = self._driving
        for driver in drivers:
            for admitted in driver.path.zones if driver.admitted else ():
                must_stop = (  # a light has turned, and who was let in before can still stop
                    admitted.id in self._closed
                    and driver.is_before(admitted)
                    and driver.needed(admitted.stop - _REACTION * driver.v) < _AT_YELLOW
                )
                if driver.rear > admitted.exit or driver.waits(admitted) or must_stop:
                    driver.admitted.discard(admitted.id)
        asking = [(d, zone) for d in drivers if (zone := d.next_zone())]
        asking.sort(key=lambda x: (x[0].rank(x[1]), x[0].arrival(x[1]), x[0].track))
        refused: list[Zone] = []
        for driver, zone in asking:
            if zone.id in self._closed:
                continue
            if driver.v < 0.3 and zone.id in driver.waiting:
                driver.patience -= DT
            is_far = driver.arrival(zone) > _REQUEST + driver.v / (2.0 * _EVEN)
            refuses = any((zone.id, other.id) in self.town.conflicts for other in refused)
            if is_far or driver.waits(zone) or refuses or _must_queue(driver, zone, drivers):
                continue
            if not any(self._is_in_the_way(d, driver, zone) for d in drivers if d is not driver):
                driver.admitted.add(zone.id)
                driver.patience = 6.0
            elif driver.patience <= 0.0:
                refused.append(zone)

    def _is_in_the_way(self, other: Driver, driver: Driver, wanted: Zone) -> bool:
        return any(
            zone.id in other.admitted
            or (zone.id not in self._closed and _goes_first(other, zone, driver, wanted))
            for zone in other.path.zones
            if (wanted.id, zone.id) in self.town.conflicts
        )

    def _acceleration(self, driver: Driver, bodies: FloatArray, time: float) -> float:
        index = min(int(driver.s / STEP), len(driver.path.speed) - 1)
        depth, period = driver.wave
        pace = driver.eager * (1.0 - depth * (0.5 - 0.5 * cos(2.0 * pi * time / period)))
        target = max(pace * float(driver.path.speed[index]), 0.5)
        free = _MAX_ACCEL * (1.0 - (driver.v / target) ** 4)
        accel = max(free, -1.8)
        gap, lead_speed = _leader(driver, self._driving, bodies)
        if gap < inf:
            closing = driver.v * (driver.v - lead_speed) / (2 * sqrt(_MAX_ACCEL * _BRAKING))
            wanted = _MIN_GAP + max(0.0, driver.v * _HEADWAY + closing)
            following = free - _MAX_ACCEL * (wanted / max(gap, 0.3)) ** 2
            accel = min(accel, max(following, -_HARDEST))
        for name, place in self._places_to_wait(driver):
            accel = min(accel, _even_braking(driver, name, place))
        return accel

    def _places_to_wait(self, driver: Driver) -> list[tuple[int | str, float]]:
        """Zones by number, other places by name, and the arc lengths to stop at [m]."""
        places: list[tuple[int | str, float]] = []
        path = driver.path
        for zone in path.zones:
            if zone.id not in driver.admitted and driver.is_before(zone):
                places.append((zone.id, zone.stop))
            else:
                driver.waiting.discard(zone.id)
        for name, first, _ in path.crossings:
            place = first - 1.5
            if driver.front <= first - 0.3 and self._is_claimed(driver, name, place):
                places.append((name, place))
            else:
                driver.waiting.discard(name)
        if driver.halt[1] > 0.0 and driver.front <= driver.halt[0]:
            places.append(("halt", driver.halt[0]))
            waits = driver.is_parked and any(_comes(x, driver) for x in self._driving)
            if driver.v < 0.1 and driver.halt[0] - driver.front < 3.0 and not waits:
                driver.halt = driver.halt[0], driver.halt[1] - DT
        if path.is_parking:
            places.append(("end", path.length + 0.5 * driver.length + 0.9))
        return places

    def _is_claimed(self, driver: Driver, name: str, place: float) -> bool:
        """Whether a driver must wait before a crossing."""
        for pedestrian in [x for x in self._on_foot if x.walk.crossing == name]:
            if pedestrian.s > self._place_passed(driver, pedestrian):
                continue
            if pedestrian.is_crossing:
                return True
            if name in self._waits and not self._has_time(pedestrian):
                continue
            near = pedestrian.s > pedestrian.walk.kerb - 2.5
            if near and (name in driver.waiting or driver.needed(place) < _YIELDING):
                return True
        return False

    def _place_passed(self, driver: Driver, pedestrian: Pedestrian) -> float:
        """Where on its way over a crossing a pedestrian has left the way of a driver [m]."""
        key = (id(driver.path), id(pedestrian.walk))
        if key not in self._passed:
            near = (p for n, *p in driver.path.crossings if n == pedestrian.walk.crossing)
            x, y, _ = driver.path.at(0.5 * sum(next(near)))
            place = arc_at(pedestrian.walk.points, np.array([x, y]))
            self._passed[key] = min(place + _PASSED, pedestrian.walk.across)
        return self._passed[key]

    def _let_walk(self) -> None:
        for pedestrian in self._on_foot:
            walk = pedestrian.walk
            at_kerb = walk.kerb - 0.9 <= pedestrian.s <= walk.kerb + 0.2
            if at_kerb and not pedestrian.is_crossing and not self._may_cross(pedestrian):
                pedestrian.v = max(pedestrian.v - 2.2 * DT, 0.0)
                continue
            if pedestrian.s >= walk.kerb - 0.9:
                pedestrian.is_crossing = pedestrian.s <= walk.across
            pedestrian.v = min(pedestrian.v + 1.0 * DT, WALKING)

    def _has_time(self, pedestrian: Pedestrian) -> bool:
        """Whether the light lets a pedestrian cross."""
        walk = pedestrian.walk
        return self._waits.get(walk.crossing, inf) > (walk.across - walk.kerb) / WALKING

    def _may_cross(self, pedestrian: Pedestrian) -> bool:
        if not self._has_time(pedestrian):
            return False
        needed = (pedestrian.walk.across - pedestrian.walk.kerb) / WALKING + 2.0
        for driver in self._driving:
            for name, first, last in driver.path.crossings:
                if name != pedestrian.walk.crossing or driver.rear > last + 0.5:
                    continue
                stands = driver.v < 0.3
                if driver.front > first - (0.4 if stands else 1.6):
                    return False
                far = (first - 1.5 - driver.front) / max(driver.v, 1.0) > needed
                gentle = _YIELDING + 0.1 if name in driver.waiting else _EVEN
                if not (stands or far or driver.needed(first - 1.5) < gentle):
                    return False
        return True


def _goes_first(driver: Driver, zone: Zone, other: Driver, wanted: Zone) -> bool:
    """Whether a driver with priority is too near for another one to enter before it."""
    clear = other.arrival(wanted) + (wanted.exit - wanted.stop + other.length) / 5.5
    return (
        driver.rank(zone) < other.rank(wanted)
        and driver.is_before(zone)
        and driver.v > 0.5
        and driver.arrival(zone) < clear + 1.0
    )


def _must_queue(driver: Driver, zone: Zone, drivers: list[Driver]) -> bool:
    """Whether somebody ahead still has to enter, or stands behind the zone."""
    x, y, heading = driver.path.at(min(zone.exit + 6.0, driver.path.length))
    for other in drivers:
        if other is driver:
            continue
        ahead = other.next_zone()
        is_first = ahead and ahead.stop - other.front < zone.stop - driver.front
        if ahead and is_first and ahead.origin == zone.origin:
            return True
        ox, oy, other_heading = other.pose
        if other.v < 2.0 and hypot(ox - x, oy - y) < 8.0 and cos(other_heading - heading) > 0.5:
            return True
    return False


def _even_braking(driver: Driver, name: int | str, place: float) -> float:
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
        x, y, heading = driver.pose
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
    half_way = 0.5 * driver.width + _SIDE_MARGIN
    best, speed = inf, 0.0
    for part in np.flatnonzero((aside < half_way) & (nearest > 0)).tolist():
        other = drivers[near[part // 3]]
        turn = other.pose[2] - driver.path.at(float(along[part]))[2]
        gap = float(along[part]) - 0.3 - driver.front
        if abs(cos(turn)) < 0.7:
            gap -= parts[part, 2]
        if gap < best:
            best, speed = gap, max(0.0, other.v * cos(turn))
    return best, float(speed)


def _comes(other: Driver, driver: Driver) -> bool:
    """Whether somebody is beside or behind on the lane that a parked driver moves off to."""
    x, y, heading = other.pose
    along, aside = driver.offset(x, y)
    near = -4.5 * other.v - 12.0 < along < 9.0 and 0.5 < aside < 5.0
    return near and cos(heading - driver.pose[2]) > 0.5


def _may_lead(other: Driver, driver: Driver, reach: float) -> bool:
    """Whether somebody is near enough to be on the path ahead, and not behind."""
    (x, y, _), (ox, oy, _) = driver.pose, other.pose
    dx, dy = ox - x, oy - y
    limit = reach + 0.5 * other.length + 2.0
    is_near = other is not driver and dx * dx + dy * dy < limit * limit
    return is_near and driver.offset(ox, oy)[0] > -0.5 * other.length
