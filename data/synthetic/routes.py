"""Random routes through a town, from the streets that lead into it, and the paths along them."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from shiftsim.data.synthetic.agents import (
    STEP,
    Path,
    Zone,
    arc_at,
    brake_in_time,
    path_along,
    shifted,
)
from shiftsim.data.synthetic.town import Leg, Street, Town
from shiftsim.kernels import FloatArray

_CHANGING = 70.0  # m, shortest street to change lanes on
_CHANGES = 0.3  # chance of a lane change that no turn asks for
_PARKS = 0.35  # chance that who drives through a car park stays there
_TRIES = 6
_LANE_CHANGE = 45.0  # m
_WIDE = 0.3  # m, how far drivers swing out to turn right
_CYCLING, _CYCLING_ASIDE = 4.5, -0.9  # m/s; m, near the right border of the lane
_NARROW_SPEED, _NARROW_RAMP = 5.5, 12.0  # m/s, m


class Route(NamedTuple):
    """The streets that somebody follows, and where they change lanes."""

    lane: int  # on the first street, from 1 on, counted from the middle
    streets: tuple[str, ...]  # names
    lane_changes: tuple[int, ...]  # lane that is changed to on each street, 0 for none
    bay: int | None = None  # parking space of the last street in which it ends
    is_bicycle: bool = False  # whether it keeps to the right


class RandomRoutes:
    """Random routes, some streets more liked than others."""

    def __init__(self, town: Town, rng: np.random.Generator) -> None:
        self.town, self.rng = town, rng
        streets = town.streets.items()
        self.entries = tuple(name for name, x in streets if x.junctions[0] and not x.junctions[1])
        likes = rng.gamma(2.0, 0.5, len(town.streets)).tolist()
        self._paths: dict[Route, Path] = {}
        self.likes: dict[str, float] = dict(zip(town.streets, likes, strict=True))

    def path(self, entry: str, category: str) -> Path | None:
        """The path of a random route from an entry; None where none was found."""
        for _ in range(_TRIES):
            route = self._draw(entry, category)
            if route is not None:
                if route not in self._paths:
                    self._paths[route] = make_path(self.town, route)
                return self._paths[route]
        return None

    def _draw(self, entry: str, category: str) -> Route | None:
        """A random route; None where it ends at a dead end."""
        rng, town = self.rng, self.town
        street = town.streets[entry]
        lane = first_lane = int(rng.integers(1, street.lanes + 1))
        names, lane_changes = [entry], []
        junction = street.junctions[0]
        is_bicycle = category == "bicycle"
        while junction:
            ahead = self._ahead(junction, street, set(names))
            is_long = street.length >= _CHANGING
            if not is_long or is_bicycle:
                ahead = {name: lanes for name, lanes in ahead.items() if lane in lanes}
            if not ahead:
                return None
            weights = np.array([self.likes[name] for name in ahead])
            target = str(rng.choice(list(ahead), p=weights / weights.sum()))
            lanes = sorted(ahead[target], key=lambda x: (abs(x - lane), x))
            changes = lanes[0] != lane or (len(lanes) > 1 and is_long and rng.random() < _CHANGES)
            if changes:
                near = [x for x in lanes if abs(x - lane) == 1]
                if not near:
                    return None
                lane = near[0]
            lane_changes.append(lane if changes else 0)
            _, lane = town.connectors[junction, street.name, lane, target]
            street = town.streets[target]
            names.append(target)
            is_forward = junction == street.junctions[0]
            if target in town.bays and street.junctions[1] and rng.random() < _PARKS:
                bay = self._bay(street, is_forward=is_forward)
                if bay is not None:
                    return Route(first_lane, tuple(names), (*lane_changes, 0), bay)
            junction = street.junctions[is_forward]
        return Route(first_lane, tuple(names), (*lane_changes, 0), is_bicycle=is_bicycle)

    def _ahead(self, junction: int, street: Street, seen: set[str]) -> dict[str, list[int]]:
        """Lanes of a street that lead through a junction, by the next street."""
        ahead: dict[str, list[int]] = {}
        for at, name, lane, target in self.town.connectors:
            if at == junction and name == street.name and target not in seen:
                ahead.setdefault(target, []).append(lane)
        return ahead

    def _bay(self, street: Street, *, is_forward: bool) -> int | None:
        """A free parking space of a car park, on the right of the way where there is one."""
        count = len(self.town.bays[street.name])
        free = [x for x in street.empty if x < count]
        right = [x for x in free if (x < count // 2) == is_forward]
        return int(self.rng.choice(right or free)) if free else None


def make_path(town: Town, route: Route) -> Path:
    """The path of a route, with its zones and crossings."""
    parts, limits, zones, crossings = [], [], [], []
    lane = route.lane
    first, second = (town.streets[name] for name in route.streets[:2])
    leg = Leg(first, first.junctions[1] in (set(second.junctions) - {0}))
    for number, name in enumerate(route.streets):
        street = town.streets[name]
        line, origin = leg.centers(lane), f"{name}{lane}"
        if route.lane_changes[number]:
            line = _change_lanes(line, leg.centers(route.lane_changes[number]))
            lane = route.lane_changes[number]
        is_last = number == len(route.streets) - 1
        if is_last and route.bay is not None:
            line = _into_bay(line, town.bays[name][route.bay])
        parts.append(line)
        limits.append(street.limit)
        crossings += [
            (street.crossing_name(n), *leg.centers(lane, ends))
            for n, ends in enumerate(street.crossings)
        ]
        if street.narrow:
            begin, end = leg.centers(lane, street.narrow)
            zones.append((_narrow_zone(leg), begin, end, 2.0, street.swings[not leg.is_forward]))
        if is_last:
            break
        onward = town.streets[route.streets[number + 1]]
        connector, to_lane = town.connectors[leg.enters, name, lane, onward.name]
        target, inner = Leg(onward, leg.enters == onward.junctions[0]), town.connecting[connector]
        turn = leg.turn_to(target)
        rank = (0 if street.is_main else 2) + (turn > 0.5 and not street.is_one_way)
        points = inner.center_of(-1, np.arange(0.0, inner.length, STEP))[:, :2]
        parts.append(points)
        limits.append(min(street.limit, onward.limit))
        zone = Zone(connector, rank, origin)
        swing = _WIDE if turn < -0.5 and not street.is_one_way else 0.0
        zones.append((zone, points[0], points[-1], street.stop, swing))
        leg, lane = target, to_lane
    path = path_along(parts, limits)
    path = _with_places(path, zones, crossings, is_parking=route.bay is not None)
    if route.is_bicycle:
        speed = np.minimum(path.speed, _CYCLING)
        path = replace(shifted(path, _CYCLING_ASIDE), speed=speed)
    return path


def _with_places(
    path: Path,
    zones: list[tuple[Zone, FloatArray, FloatArray, float, float]],
    crossings: list[tuple[str, FloatArray, FloatArray]],
    *,
    is_parking: bool,
) -> Path:
    """A path with its zones and crossings, narrow places driven past with care."""
    arc = STEP * np.arange(len(path.points))
    aside, speed = np.zeros(len(arc)), path.speed
    places, placed_zones = [], []
    for name, *ends in crossings:
        first, last = sorted(arc_at(path.points, end) for end in ends)
        places.append((name, first, last))
    for zone, begin, end, stop, swing in zones:
        entry, leave = arc_at(path.points, begin), arc_at(path.points, end)
        between = [x for x in places if entry - stop - 0.5 < x[1] and x[2] < entry]
        crosswalk = between[-1][0] if between else ""
        zone = replace(zone, entry=entry, exit=leave, stop=entry - stop, crosswalk=crosswalk)
        placed_zones.append(zone)
        if swing or zone.id < 0:
            outside = np.maximum(np.maximum(entry - arc, arc - leave), 0.0) / _NARROW_RAMP
            share = np.clip(1.0 - outside, 0.0, 1.0)
            aside += swing * share * share * (3.0 - 2.0 * share)
        if zone.id < 0:
            speed = np.where(share > 0.5, np.minimum(speed, _NARROW_SPEED), speed)
    path = shifted(replace(path, speed=brake_in_time(speed)), aside)
    order = tuple(sorted(placed_zones, key=lambda zone: zone.entry))
    return replace(path, zones=order, crossings=tuple(places), is_parking=is_parking)


def _narrow_zone(leg: Leg) -> Zone:
    number = -2 * leg.street.id - leg.is_forward
    name = f"{leg.street.name}{'>' if leg.is_forward else '<'}"
    ahead, back = leg.street.swings
    goes_first = leg.is_forward if ahead == back else (ahead < back) == leg.is_forward
    return Zone(number, 1 - goes_first, name)


def _change_lanes(first: FloatArray, second: FloatArray) -> FloatArray:
    """(n, 2) a line that goes over from one lane to another, halfway."""
    count = min(len(first), len(second))
    along = (STEP * (np.arange(count) - 0.5 * count)) / _LANE_CHANGE + 0.5
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
    into = line[corner] + np.arange(STEP, reach, STEP)[:, None] * along
    return np.concatenate([line[:corner], into, bay[None, :2]])
