"""Random towns, each of a kind: junctions, roundabouts, winding streets, car parks and others.

Streets are drawn without a place and fanned out around their junctions, all of it again until no
two of them come too close.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from shiftsim.data.synthetic.roads import Piece, connect
from shiftsim.data.synthetic.streets import (
    AT_JUNCTION,
    are_apart,
    directions,
    junction_arms,
    random_angles,
    random_gaps,
    random_street,
    reaches,
    with_crossings,
    with_obstacles,
)
from shiftsim.data.synthetic.town import Leg, Lights, Street, Town, build_town

_TRIES = 300
# km/h, of main roads by lanes per direction
_LIMITS = ((30.0, 40.0, 50.0), (40.0, 50.0, 60.0), (50.0, 60.0, 70.0))
_KERBS = (10.0, 15.0)  # m, radii at junctions
_RINGS = ("moss", "nettle", "oak", "pine")


def random_town(kind: str, name: str, rng: np.random.Generator) -> Town:
    """A town of one of `KINDS`, turned in any direction."""
    for _ in range(_TRIES):
        streets = KINDS[kind](rng)
        if streets and are_apart(streets := _turned(streets, float(rng.uniform(0.0, 2.0 * np.pi)))):
            break
    else:
        raise AssertionError(f"no town of kind {kind!r} in {_TRIES} tries")
    town = build_town(name, streets)
    lit = sorted({x for street in streets if street.has_lights for x in street.junctions} - {0})
    town.lights = tuple(_random_lights(town, junction, rng) for junction in lit)
    return town


def _turned(streets: Sequence[Street], angle: float) -> list[Street]:
    """Streets turned around the origin [rad]."""
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    old = (street.start for street in streets)
    starts = [(x * cos - y * sin, x * sin + y * cos, heading + angle) for x, y, heading in old]
    return [replace(street, start=start) for street, start in zip(streets, starts, strict=True)]


def _junction(rng: np.random.Generator, *, lit: bool) -> list[Street]:
    """One junction with three to five arms."""
    count = int(rng.choice((3, 4, 5), p=(0.35, 0.5, 0.15)))
    angles = random_angles(rng, count)
    lanes = int(rng.choice((1, 2, 3), p=(0.25, 0.5, 0.25) if lit else (0.6, 0.4, 0.0)))
    lanes = min(lanes, 2) if count == 5 else lanes
    share = float(rng.uniform(0.3, 1.0))
    arms = _arms(rng, range(1, count + 1), angles, lit=lit, lanes=lanes, crossings=share)
    return junction_arms(arms, angles, rng.uniform(*_KERBS))


def _pair(rng: np.random.Generator, *, lanes: int) -> list[Street]:
    """Two junctions and the main street through both."""
    lit = bool(np.all(rng.random(2) < 0.5))
    limits = ((30.0, 50.0), *_LIMITS[1:])[lanes - 1]
    limit, length = float(rng.choice(limits)), float(rng.uniform(60.0, 120.0))
    mid = random_street(rng, 1, lanes=lanes, limit=limit, length=length, parking=0.0)
    if rng.random() < 0.6 and not lit:
        at = 0.5 * mid.length
        mid = replace(mid, crossings=((at - 2.0, at + 2.0),))
    mid = replace(mid, has_lights=lit, stop=2.0)
    out: list[Street] = []
    number = 2
    for junction, count in enumerate(rng.choice((3, 4), 2, p=(0.6, 0.4)).tolist(), start=101):
        angles = random_angles(rng, count)
        onward = min(range(1, count), key=lambda k: abs(angles[k] - np.pi))
        numbers = [mid.id, *range(number, number + count - 1)]
        number += count - 1
        arms = _arms(
            rng, numbers, angles,
            lit=lit, lanes=lanes, crossings=float(rng.uniform(0.3, 1.0)),
            like=mid, alike=(0, onward),
        )  # fmt: skip
        rounding = rng.uniform(*_KERBS)
        if junction == 101:
            mid, *others = junction_arms([mid, *arms[1:]], angles, rounding)
            mid = replace(mid, junctions=(101, 102))
            out = [mid, *others]
        else:
            x, y, heading = mid.road.at(np.array([mid.length]))[0].tolist()
            reach = reaches(arms, angles, rounding)[0]
            center = (float(x + reach * np.cos(heading)), float(y + reach * np.sin(heading)))
            turned = [angle + heading + np.pi for angle in angles]
            out += junction_arms(arms, turned, rounding, center=center, junction=102)[1:]
    return out


def _arms(
    rng: np.random.Generator,
    numbers: Sequence[int],
    angles: Sequence[float],
    *,
    lit: bool,
    lanes: int,
    crossings: float,
    like: Street | None = None,
    alike: Collection[int] = (),
) -> list[Street]:
    """Streets of one junction: a main road, with `lanes` per direction, and side roads.

    Those whose place is in `alike` are the main road instead, as wide as `like`.
    """
    mains = _opposite(angles)
    limit = float(rng.choice(_LIMITS[lanes - 1]))
    all_main = lit or (lanes == 1 and rng.random() < 0.15)
    out = []
    for place, number in enumerate(numbers):
        is_main, num_lanes, has_sign = place in mains, lanes, False
        if not is_main:
            num_lanes = 2 if lanes > 1 and lit and rng.random() < 0.4 else 1
            has_sign = not all_main and rng.random() < 0.7
        if like is not None and place in alike:
            street = random_street(rng, number, lanes=lanes, limit=like.limit, parking=0.0)
            street = replace(street, width=like.width, sidewalk=like.sidewalk)
            is_main, has_sign = True, False
        else:
            street = random_street(rng, number, lanes=num_lanes, limit=limit if is_main else None)
            street = with_crossings(rng, street, crossings)
            if street.lanes == 1 and rng.random() < 0.4:
                street = with_obstacles(rng, street)
            is_main = lit or (all_main or is_main if like is None else False)
        is_marked = lit or street.is_marked
        street = replace(street, is_main=is_main, has_lights=lit, is_marked=is_marked)
        out.append(replace(street, has_stop_sign=has_sign))
    return out


def _opposite(angles: Sequence[float]) -> tuple[int, int]:
    """Two arms that lead on from one another: those whose angle is nearest to half a turn."""
    pairs = [(i, j) for i in range(len(angles)) for j in range(i + 1, len(angles))]
    return min(pairs, key=lambda x: abs(abs(angles[x[0]] - angles[x[1]]) - np.pi))


def _roundabout(rng: np.random.Generator) -> list[Street]:
    """A roundabout with one lane and three or four arms."""
    count = int(rng.integers(3, 5))
    radius = float(rng.uniform(14.0, 24.0))  # of the inner kerb
    half = float(np.arctan(11.2 / radius))  # from an arm to its ring segments
    gaps = random_gaps(rng, np.full(count, 2.0 * np.pi / count), 0.25 if count == 3 else 0.12)
    if gaps.min() < 2.0 * half + 0.15:
        return []
    start = float(radius / np.cos(half) + radius * np.tan(half))
    limit, share = float(rng.choice((30.0, 40.0, 50.0))), rng.uniform(0.3, 1.0)
    arms, rings = [], []
    for place, angle in enumerate(directions(gaps)):
        arm = random_street(rng, place + 1, limit=limit, parking=0.0)
        arm = replace(
            arm,
            start=(start * float(np.cos(angle)), start * float(np.sin(angle)), angle),
            width=3.5,
            is_main=False,
            junctions=(101 + place, 0),
            stop=1.0,
            crossings=((9.0, 13.0),) if rng.random() < share else (),
        )
        arms.append(with_obstacles(rng, arm) if rng.random() < 0.2 else arm)
        begin, length = angle + half, float(radius * (gaps[place] - 2.0 * half))
        x, y = radius * float(np.cos(begin)), radius * float(np.sin(begin))
        ring = Street(
            _RINGS[place], count + place + 1, (x, y, float(begin + np.pi / 2)),
            (Piece(length, 1.0 / radius, 1.0 / radius),), 4.5, 30.0,
            is_one_way=True, sidewalk=0.0, stop=1.0,
            junctions=(101 + place, 101 + (place + 1) % count),
        )  # fmt: skip
        rings.append(ring)
    return [*arms, *rings]


def _street(rng: np.random.Generator) -> list[Street]:
    """A winding street with parked cars and narrow places, and a side street."""
    limit = float(rng.choice((30.0, 30.0, 40.0, 50.0)))
    angles = [0.0, np.pi / 2 + float(rng.uniform(-0.3, 0.3)), np.pi + float(rng.uniform(-0.3, 0.3))]
    width = round(float(rng.uniform(3.15, 3.45)), 2)
    arms = []
    for place in range(3):
        is_side = place == 1
        parking = 0.0 if is_side else round(float(rng.uniform(2.1, 2.4)), 2)
        length = float(rng.uniform(50.0, 80.0) if is_side else rng.uniform(120.0, 160.0))
        kmh = 20.0 if is_side else limit
        arm = random_street(rng, place + 1, limit=kmh, length=length, parking=parking)
        arm = replace(arm, width=width, is_main=not is_side, has_stop_sign=is_side)
        arm = with_crossings(rng, arm, 0.6)
        if not is_side and rng.random() < 0.5:
            arm = with_obstacles(rng, arm)
        elif not is_side and rng.random() < 0.7:
            begin = float(rng.uniform(24.0, arm.length - 60.0))
            end = begin + float(rng.uniform(15.0, 30.0))
            if all(last < begin - 12.0 or first > end + 12.0 for first, last in arm.crossings):
                arm = replace(arm, narrow=(begin, end))
        arms.append(arm)
    return junction_arms(arms, angles, rng.uniform(*_KERBS))


def _car_park(rng: np.random.Generator) -> list[Street]:
    """A car park with diagonal spaces along an aisle that leaves a street and returns to it."""
    apart, start = float(rng.uniform(24.0, 32.0)), float(rng.uniform(13.5, 16.0))
    aisle, top = float(rng.uniform(40.0, 70.0)), float(rng.uniform(14.0, 20.0))
    east, north, west, south = 0.0, np.pi / 2, np.pi, -np.pi / 2
    x, y = -apart, start + aisle
    way = (
        Piece(aisle),
        *connect((x, y, north), (0.0, y + top, east), ease=True),
        *connect((0.0, y + top, east), (-x, y, south), ease=True),
        Piece(aisle),
    )
    length = sum(piece.length for piece in way)
    limit, width = float(rng.choice((30.0, 40.0, 50.0))), round(float(rng.uniform(3.25, 3.6)), 2)
    free = np.flatnonzero(rng.random(60) < rng.uniform(0.2, 0.6))
    lot = Street(
        "lot", 4, (x, start, north), way, 3.4, 20.0, is_main=False, junctions=(101, 102),
        stop=2.0, sidewalk=1.8, parking=5.2,
        stalls=((18.0, aisle - 6.0), (length - aisle + 6.0, length - 18.0)),
        empty=tuple(free.tolist()), crossings=((0.5 * aisle, 0.5 * aisle + 3.0),), is_marked=False,
    )  # fmt: skip
    through_road = partial(random_street, rng, limit=limit, parking=0.0)
    begins = ((x + start, 0.0, east), (x - start, 0.0, west), (start - x, 0.0, east))
    mid = replace(
        through_road(2, pieces=(Piece(2.0 * (apart - start)),)), junctions=(101, 102), stop=1.0
    )
    one = replace(with_crossings(rng, through_road(1), 0.0), junctions=(101, 0))
    two = replace(with_crossings(rng, through_road(3), 0.0), junctions=(102, 0))
    mid, one, two = (
        replace(street, start=begin, width=width)
        for street, begin in zip((mid, one, two), begins, strict=True)
    )
    return [one, mid, two, lot]


def _shared(rng: np.random.Generator) -> list[Street]:
    """A shared space: everybody is slow, and pedestrians cross where they like."""
    count = int(rng.integers(3, 5))
    angles = random_angles(rng, count)
    arms = []
    for number in range(1, count + 1):
        length = float(rng.uniform(70.0, 100.0))
        spots = np.cumsum(rng.uniform(10.0, 20.0, 5)) - 5.0
        places = tuple((round(x, 1), round(x + 3.0, 1)) for x in spots.tolist() if x < 52.0)
        arm = random_street(rng, number, limit=20.0, length=length, parking=0.0)
        arms.append(replace(arm, sidewalk=4.0, stop=1.0, is_marked=False, crossings=places))
    return junction_arms(arms, angles, rng.uniform(*_KERBS))


def _random_lights(town: Town, junction: int, rng: np.random.Generator) -> Lights:
    """Lights of a junction, at which streets that face each other are green together."""
    roads: dict[str, set[int]] = {}
    for turn, road in town.connectors.items():
        if turn.junction == junction:
            roads.setdefault(turn.street, set()).add(road.id)
    entering = [Leg(town.streets[x], town.streets[x].junctions[0] != junction) for x in roads]
    phases = _phases({x.street.name: float(x.pose(1, at_end=True)[2]) for x in entering})
    crossings = {
        town.streets[name].crossing_name(number): place
        for place, phase in enumerate(phases)
        for name in phase
        for number, ends in enumerate(town.streets[name].crossings)
        if ends in AT_JUNCTION and junction == town.streets[name].junctions[0]
    }
    green = tuple(round(float(rng.uniform(7.0, 13.0)), 1) for _ in phases)
    begun = round(float(rng.uniform(0.0, 30.0)), 1)
    numbers = tuple(frozenset(x for name in phase for x in roads[name]) for phase in phases)
    fastest = max(town.streets[name].limit for name in roads)
    yellow = float(np.clip(0.1 * fastest - 2.0, 3.0, 5.0))  # as in German towns
    return Lights(numbers, green, begun, crossings, yellow)


def _phases(headings: dict[str, float]) -> list[list[str]]:
    """Streets by the headings in which they enter a junction [rad], those that face in pairs."""
    left, phases = list(headings), []
    while left:
        first = left.pop(0)
        phase = [first]
        turn = [abs(np.cos(headings[x] - headings[first]) + 1.0) for x in left]
        if turn and min(turn) < 0.2:
            phase.append(left.pop(int(np.argmin(turn))))
        phases.append(phase)
    return phases


KINDS: dict[str, Callable[[np.random.Generator], list[Street]]] = {
    "junction": partial(_junction, lit=False),
    "lights": partial(_junction, lit=True),
    "roundabout": _roundabout,
    "avenue": lambda rng: _pair(rng, lanes=int(rng.integers(2, 4))),
    "street": _street,
    "block": partial(_pair, lanes=1),
    "parking": _car_park,
    "shared": _shared,
}
