"""Random routes through a town, from the streets that lead into it, and the paths along them."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from shiftsim.data.synthetic.agents import Path, Zone, arc_at, brake_in_time, path_along, shifted
from shiftsim.data.synthetic.roads import STEP, RoadSpec
from shiftsim.data.synthetic.town import Leg, Street, Town, Turn
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
    """What somebody follows: turns from street to street, and lanes."""

    lane: int  # on the first street, from 1 on, counted from the middle
    turns: tuple[Turn, ...]  # each on the lane on which the street is left
    bay: int | None = None  # parking space of the last street in which it ends
    is_bicycle: bool = False  # whether it keeps to the right


_SHARES = {
    "car": 0.50,
    "van": 0.06,
    "pickup": 0.05,
    "truck": 0.04,
    "bus": 0.03,
    "motorcycle": 0.07,
    "bicycle": 0.25,
}


class RandomRoutes:
    """Random routes, some streets more liked than others."""

    def __init__(self, town: Town, rng: np.random.Generator, crowd: float = 1.0) -> None:
        """`crowd` times as many as elsewhere cycle, for each that drives."""
        self.town, self.rng = town, rng
        self._shares = np.array(list(_SHARES.values()))
        self._shares[list(_SHARES).index("bicycle")] *= crowd
        self._shares /= 1.0 + _SHARES["bicycle"] * (crowd - 1.0)
        streets = town.streets.items()
        self.entries = tuple(name for name, x in streets if x.junctions[0] and not x.junctions[1])
        likes = rng.gamma(2.0, 0.5, len(town.streets)).tolist()
        self._paths: dict[Route, Path] = {}
        self.likes: dict[str, float] = dict(zip(town.streets, likes, strict=True))

    def category(self) -> str:
        """A random one of those who drive."""
        return str(self.rng.choice(list(_SHARES), p=self._shares))

    def path(self, entry: str, category: str) -> Path | None:
        """The path of a random route from an entry; None where none was found."""
        for _ in range(_TRIES):
            route = self._draw(entry, is_bicycle=category == "bicycle")
            if route is not None:
                if route not in self._paths:
                    self._paths[route] = make_path(self.town, route)
                return self._paths[route]
        return None

    def _draw(self, entry: str, *, is_bicycle: bool) -> Route | None:
        """A random route; None where it ends at a dead end."""
        rng, town = self.rng, self.town
        street = town.streets[entry]
        lane = first_lane = int(rng.integers(1, street.lanes + 1))
        turns: list[Turn] = []
        junction = street.junctions[0]
        while junction:
            ahead: dict[str, list[Turn]] = {}  # turns from the lanes of the street, by the next one
            seen, is_long = {entry, *(x.target for x in turns)}, street.length >= _CHANGING
            for turn in town.connectors:
                if turn[:2] == (junction, street.name) and turn.target not in seen:
                    ahead.setdefault(turn.target, []).append(turn)
            if not is_long or is_bicycle:
                ahead = {k: found for k, found in ahead.items() if lane in {x.lane for x in found}}
            if not ahead:
                return None
            weights = np.array([self.likes[name] for name in ahead])
            target = str(rng.choice(list(ahead), p=weights / weights.sum()))
            found = sorted(ahead[target], key=lambda x: (abs(x.lane - lane), x.lane))
            turn = found[0]
            if turn.lane != lane or (len(found) > 1 and is_long and rng.random() < _CHANGES):
                near = [x for x in found if abs(x.lane - lane) == 1]
                if not near:
                    return None
                turn = near[0]
            turns.append(turn)
            lane = town.connectors[turn].lane_behind
            street = town.streets[target]
            is_forward = junction == street.junctions[0]
            if target in town.bays and street.junctions[1] and rng.random() < _PARKS:
                bay = self._bay(street, is_forward=is_forward)
                if bay is not None:
                    return Route(first_lane, tuple(turns), bay)
            junction = street.junctions[is_forward]
        return Route(first_lane, tuple(turns), is_bicycle=is_bicycle)

    def _bay(self, street: Street, *, is_forward: bool) -> int | None:
        """A free parking space of a car park, on the right of the way where there is one."""
        count = len(self.town.bays[street.name])
        free = [x for x in street.empty if x < count]
        right = [x for x in free if (x < count // 2) == is_forward]
        return int(self.rng.choice(right or free)) if free else None


# a street of a route, the lanes at its begin and its end, the road behind it, and the next street
_Stage: TypeAlias = tuple[Leg, int, int, RoadSpec | None, Leg | None]


def _stages(town: Town, route: Route) -> Iterator[_Stage]:
    lane = route.lane
    for turn in route.turns:
        street, onward = town.streets[turn.street], town.streets[turn.target]
        leg = Leg(street, turn.junction == street.junctions[1])
        target = Leg(onward, turn.junction == onward.junctions[0])
        connector = town.connectors[turn]
        yield leg, lane, turn.lane, connector, target
        lane = connector.lane_behind
    yield target, lane, lane, None, None


def make_path(town: Town, route: Route) -> Path:
    """The path of a route, with its zones and crossings."""
    stages = list(_stages(town, route))
    parts, limits = [], []
    for leg, lane, last_lane, connector, _ in stages:
        line = leg.centers(lane)
        if last_lane != lane:
            line = _change_lanes(line, leg.centers(last_lane))
        if connector is None and route.bay is not None:
            line = _into_bay(line, town.bays[leg.street.name][route.bay])
        parts += [line, connector.line] if connector else [line]
        limits += [leg.street.limit, connector.limit_kmh] if connector else [leg.street.limit]
    path = path_along(parts, limits)
    crossings = []
    for leg, _, lane, *_ in stages:
        for number, ends in enumerate(leg.street.crossings):
            first, last = sorted(arc_at(path.points, x) for x in leg.centers(lane, ends))
            crossings.append((leg.street.crossing_name(number), first, last))
    path = replace(path, crossings=tuple(crossings), is_parking=route.bay is not None)
    path = _with_zones(path, [x for stage in stages for x in _zones(path, stage)])
    if route.is_bicycle:
        speed = np.minimum(path.speed, _CYCLING)
        path = replace(shifted(path, _CYCLING_ASIDE), speed=speed)
    return path


def _zones(path: Path, stage: _Stage) -> Iterator[tuple[Zone, float]]:
    """Zones on a street and behind it, and how far to the left vehicles swing there [m]."""
    leg, lane, last_lane, connector, target = stage
    street = leg.street

    def place(number: int, rank: int, origin: str, ends: FloatArray, stop: float) -> Zone:
        entry, leave = arc_at(path.points, ends[0]), arc_at(path.points, ends[-1])
        between = [x for x in path.crossings if entry - stop - 0.5 < x[1] and x[2] < entry]
        crosswalk = between[-1][0] if between else ""
        return Zone(number, rank, origin, entry, leave, entry - stop, crosswalk)

    if street.narrow:
        ahead, back = street.swings
        goes_first = leg.is_forward if ahead == back else (ahead < back) == leg.is_forward
        number, origin = -2 * street.id - leg.is_forward, f"{street.name}{'<>'[leg.is_forward]}"
        ends = leg.centers(last_lane, street.narrow)
        yield place(number, 1 - goes_first, origin, ends, 2.0), (back, ahead)[leg.is_forward]
    if connector and target:
        turn = leg.turn_to(target)
        rank = (0 if street.is_main else 2) + (turn > 0.5 and not street.is_one_way)
        zone = place(connector.id, rank, f"{street.name}{lane}", connector.line, street.stop)
        yield zone, _WIDE if turn < -0.5 and not street.is_one_way else 0.0


def _with_zones(path: Path, zones: list[tuple[Zone, float]]) -> Path:
    """A path with zones in which vehicles swing out; narrow places are driven past with care."""
    arc = STEP * np.arange(len(path.points))
    aside, speed = np.zeros(len(arc)), path.speed
    for zone, swing in zones:
        outside = np.maximum(np.maximum(zone.entry - arc, arc - zone.exit), 0.0) / _NARROW_RAMP
        share = np.clip(1.0 - outside, 0.0, 1.0)
        aside += swing * share * share * (3.0 - 2.0 * share)
        if zone.id < 0:
            speed = np.where(share > 0.5, np.minimum(speed, _NARROW_SPEED), speed)
    path = shifted(replace(path, speed=brake_in_time(speed)), aside)
    return replace(path, zones=tuple(sorted((x for x, _ in zones), key=lambda zone: zone.entry)))


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
