"""Streets of random towns, each a kind of place: junctions, roundabouts, winding streets, car parks.

Streets are drawn without a place, fanned out around their junctions, and drawn again until no two
of them come too close.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.data.demo.lights import Lights
from shiftsim.data.demo.network import Street, Town, build_town
from shiftsim.data.demo.roads import Piece, arc, bend, connect, line
from shiftsim.data.demo.walks import add_bays, add_walks

_NAMES = ("alder", "birch", "cedar", "dogwood", "elm", "fir", "gorse", "hazel", "iris")
_AT_JUNCTION = ((3.0, 7.0),)  # m along a street, crosswalk at a junction
_STEP = 4.0  # m between the places of streets that are compared
_APART = 3.0  # m between streets
_LATERAL_ACCEL = 1.8  # m/s^2, of a driver in a curve
_WIDE = 0.3  # m, to the left of the lane in right turns
_TRIES = 300


@dataclass(frozen=True)
class Place:
    """A random town and its traffic lights."""

    kind: str  # one of `KINDS`
    town: Town
    lights: tuple[Lights, ...]


def random_place(kind: str, name: str, rng: np.random.Generator) -> Place:
    """A town of a kind."""
    for _ in range(_TRIES):
        streets = KINDS[kind](rng)
        if streets and _are_apart(streets):
            break
    else:
        raise AssertionError(f"no town of kind {kind!r} in {_TRIES} tries")
    town = build_town(name, streets)
    add_walks(town)
    add_bays(town)
    junctions = sorted({x for street in streets if street.has_lights for x in street.junctions})
    return Place(kind, town, tuple(_lights(town, x, rng) for x in junctions if x))


# ---- single streets


def _winding(
    rng: np.random.Generator, length: float, limit: float, half: float, calm: float
) -> tuple[Piece, ...]:
    """Lines and bends; the first `calm` metres are straight, and it never turns far from there."""
    comfortable = (limit / 3.6) ** 2 / _LATERAL_ACCEL  # m, radius
    pieces, turned = [line(calm)], 0.0
    straight = rng.random() < 0.25
    while (rest := length - sum(piece.length for piece in pieces)) > 8.0:
        radius = max(comfortable * float(rng.uniform(0.35, 2.5)), half + 9.0, 16.0)
        angle = float(rng.uniform(0.2, 0.9) * rng.choice((-1.0, 1.0)))
        easing = min(float(rng.uniform(6.0, 16.0)), 0.5 * abs(angle) * radius)
        if straight or abs(turned + angle) > 0.8 or abs(angle) * radius + easing > rest - 6.0:
            pieces.append(line(min(rest, float(rng.uniform(15.0, 40.0)))))
            straight = straight or rest < 40.0
            continue
        pieces += bend(angle, float(np.sign(angle)) / radius, easing)
        pieces.append(line(float(rng.uniform(6.0, 25.0))))
        turned += angle
    return tuple(pieces)


def _length(rng: np.random.Generator, limit: float) -> float:
    """Of a street that leads out of town, long enough for those who do not stop [m]."""
    return limit / 3.6 * float(rng.uniform(9.5, 15.0)) + 25.0


def _street(rng: np.random.Generator, number: int, **options: object) -> Street:
    """A street that is not in its place yet; options that are not given are drawn."""
    lanes = int(options.get("lanes", 1))  # type: ignore[call-overload]
    limits = ((20.0, 30.0, 30.0, 40.0, 50.0), (30.0, 40.0, 50.0, 50.0, 60.0), (50.0, 60.0, 70.0))
    limit = float(options.get("limit", rng.choice(limits[lanes - 1])))  # type: ignore[arg-type]
    width = round(float(rng.uniform(3.2, 3.75) if limit > 30.0 else rng.uniform(3.2, 3.5)), 2)
    has_cars = lanes == 1 and limit <= 40.0 and rng.random() < 0.4
    chosen = {
        "width": width,
        "lanes": lanes,
        "parking": round(float(rng.uniform(2.1, 2.4)), 2) if has_cars else 0.0,
        "wide": _WIDE,
        "sidewalk": round(float(rng.uniform(2.0, 3.5)), 2),
    } | {name: value for name, value in options.items() if name not in ("lanes", "limit", "length")}
    half = lanes * width + float(chosen["parking"])  # type: ignore[arg-type]
    length = float(options.get("length", _length(rng, limit)))  # type: ignore[arg-type]
    if "pieces" not in chosen:
        chosen["pieces"] = _winding(rng, length, limit, half, float(rng.uniform(20.0, 35.0)))
    made = Street(_NAMES[number - 1], number, (0.0, 0.0, 0.0), limit=limit, **chosen)  # type: ignore[arg-type]
    return replace(made, empty=_empty(rng)) if made.parking else made


def _empty(rng: np.random.Generator) -> tuple[int, ...]:
    """Parking spaces that are free."""
    share = rng.uniform(0.1, 0.7)
    return tuple(np.flatnonzero(rng.random(80) < share).tolist())


def _with_crossings(rng: np.random.Generator, street: Street, share: float) -> Street:
    """The same street with a crosswalk at its begin, another one further on, or none."""
    length = sum(piece.length for piece in street.pieces)
    places = _AT_JUNCTION if rng.random() < share else ()
    if rng.random() < 0.3 and length > 75.0:
        at = round(float(rng.uniform(32.0, length - 38.0)), 1)
        places = (*places, (at, at + 4.0))
    return replace(street, crossings=places, stop=9.0 if _AT_JUNCTION[0] in places else 2.0)


def _with_obstacles(rng: np.random.Generator, street: Street) -> Street:
    """The same street with cars half on the road, so that vehicles swing out or take turns."""
    length = sum(piece.length for piece in street.pieces)
    begin = float(rng.uniform(28.0, max(length - 60.0, 30.0)))
    count = int(rng.integers(1, 5))
    end = begin + 6.5 * count
    clear = all(last < begin - 12.0 or first > end + 12.0 for first, last in street.crossings)
    if street.lanes > 1 or not clear or end > length - 25.0:
        return street
    sign = rng.choice((-1.0, 1.0))  # -1 right of the direction along s
    edge = street.lanes * street.width
    into = float(rng.uniform(0.5, 1.1))  # m, how far they stand in the lane
    t = sign * (edge - into + 0.95)
    places = tuple((round(begin + 3.2 + 6.5 * k, 2), float(t)) for k in range(count))
    swing = min(into + 0.35, 0.5 * street.width - 0.1)
    swings = (swing, 0.0) if sign < 0 else (0.0, swing)
    return replace(
        street, narrow=(begin, end), swings=swings, obstacles=places, parking=0.0, empty=()
    )


# ---- places of streets


def _fan(
    streets: Sequence[Street],
    angles: Sequence[float],
    rounding: float,
    *,
    center: tuple[float, float] = (0.0, 0.0),
    junction: int = 101,
) -> list[Street]:
    """Streets put around a junction, each leading away from it at its angle [rad], ascending."""
    far = _reaches(streets, angles, rounding)
    out = []
    for street, angle, reach in zip(streets, angles, far, strict=True):
        x, y = center[0] + reach * np.cos(angle), center[1] + reach * np.sin(angle)
        start = (float(x), float(y), float(angle))
        out.append(replace(street, start=start, junctions=(junction, street.junctions[1])))
    return out


def _reaches(streets: Sequence[Street], angles: Sequence[float], rounding: float) -> list[float]:
    """How far from the middle of a junction with round kerbs its streets must begin [m]."""
    count = len(streets)
    out = [9.0] * count
    for one in range(count):
        other = (one + 1) % count
        gap = (angles[other] - angles[one]) % (2.0 * np.pi)
        if gap > np.pi - 0.25:
            continue
        a, b = streets[one].half, streets[other].half
        around = rounding / np.tan(0.5 * gap)
        out[one] = max(out[one], float((b + a * np.cos(gap)) / np.sin(gap) + around))
        out[other] = max(out[other], float((a + b * np.cos(gap)) / np.sin(gap) + around))
    return out


def _rounding(rng: np.random.Generator) -> float:
    """Radius of the kerbs of a junction [m]."""
    return float(rng.uniform(10.0, 15.0))


def _angles(rng: np.random.Generator, count: int) -> list[float]:
    """Directions of the arms of a junction, ascending, the first one near 0 [rad]."""
    if count == 3 and rng.random() < 0.6:
        gaps = np.array([0.5, 0.5, 1.0]) * np.pi  # a T
        gaps = np.roll(gaps, int(rng.integers(3)))
    else:
        gaps = np.full(count, 2.0 * np.pi / count)
    spread = {3: 0.25, 4: 0.25, 5: 0.06}[count]
    gaps = gaps + rng.uniform(-spread, spread, count)
    gaps *= 2.0 * np.pi / gaps.sum()
    return [0.0, *np.cumsum(gaps)[:-1].tolist()]


def _are_apart(streets: Sequence[Street]) -> bool:
    """Whether no two streets come too close away from the junctions that they share."""
    ways = {}
    for street in streets:
        road = street.road()
        ways[street.id] = road.at(np.append(np.arange(0.0, road.length, _STEP), road.length))[:, :2]
    for one in streets:
        for two in streets:
            if one.id >= two.id or one.is_one_way or two.is_one_way:
                continue
            a, b = (_away(ways[x.id], x, y) for x, y in ((one, two), (two, one)))
            if len(a) and len(b):
                gaps = np.hypot(*np.moveaxis(a[:, None] - b[None], -1, 0))
                wide = one.half + two.half + max(one.sidewalk, two.sidewalk) + _APART
                if gaps.min() < wide:
                    return False
    return True


def _away(points: FloatArray, street: Street, other: Street) -> FloatArray:
    """Points of a street that are not near a junction that it shares with another one."""
    first, last = (x in other.junctions and x > 0 for x in street.junctions)
    skip = 6  # 24 m
    return points[skip * first : len(points) - skip * last]


def _turned(streets: Sequence[Street], angle: float) -> list[Street]:
    """Streets turned around the origin [rad]."""
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    out = []
    for street in streets:
        x, y, heading = street.start
        start = (x * cos - y * sin, x * sin + y * cos, heading + angle)
        out.append(replace(street, start=start))
    return out


# ---- kinds of towns


def _mains(rng: np.random.Generator, angles: Sequence[float]) -> tuple[int, int]:
    """Two arms that lead on from one another: those whose angle is nearest to half a turn."""
    pairs = [(i, j) for i in range(len(angles)) for j in range(i + 1, len(angles))]
    return min(pairs, key=lambda x: abs(abs(angles[x[0]] - angles[x[1]]) - np.pi))


def _arms(
    rng: np.random.Generator,
    numbers: Sequence[int],
    angles: Sequence[float],
    options: dict[int, dict[str, object]],
    *,
    lit: bool,
    lanes: int,
    crossings: float,
) -> list[Street]:
    """Streets of one junction: a main road, with `lanes` per direction, and side roads."""
    mains = _mains(rng, angles)
    limit = float(
        rng.choice(((30.0, 40.0, 50.0), (40.0, 50.0, 60.0), (50.0, 60.0, 70.0))[lanes - 1])
    )
    all_main = lit or (lanes == 1 and rng.random() < 0.15)
    out = []
    for place, number in enumerate(numbers):
        is_main = place in mains
        own: dict[str, object] = {"is_main": is_main or all_main, "has_lights": lit}
        if is_main:
            own |= {"lanes": lanes, "limit": limit}
        else:
            own["lanes"] = 2 if lanes > 1 and lit and rng.random() < 0.4 else 1
            own["has_stop_sign"] = not all_main and rng.random() < 0.7
        street = _street(rng, number, **(own | options.get(place, {})))
        if place not in options:
            street = _with_crossings(rng, street, crossings)
            if street.lanes == 1 and rng.random() < 0.3:
                street = _with_obstacles(rng, street)
        out.append(street)
    return out


def _junction(rng: np.random.Generator, *, lit: bool) -> list[Street]:
    """One junction with three to five arms."""
    count = int(rng.choice((3, 4, 5), p=(0.35, 0.5, 0.15)))
    angles = _angles(rng, count)
    lanes = int(rng.choice((1, 2, 3), p=(0.25, 0.5, 0.25) if lit else (0.6, 0.4, 0.0)))
    lanes = min(lanes, 2) if count == 5 else lanes
    arms = _arms(
        rng, range(1, count + 1), angles, {}, lit=lit, lanes=lanes, crossings=float(rng.random())
    )
    return _turned(_fan(arms, angles, _rounding(rng)), float(rng.uniform(0.0, 2.0 * np.pi)))


def _pair(rng: np.random.Generator, *, lanes: int) -> list[Street]:
    """Two junctions and the street between them."""
    lit = [bool(rng.random() < 0.5) for _ in range(2)]
    limit = float(rng.choice(((30.0, 50.0), (40.0, 50.0, 60.0), (50.0, 60.0, 70.0))[lanes - 1]))
    mid = _street(
        rng, 1, lanes=lanes, limit=limit, junctions=(101, 102), stop=2.0, parking=0.0,
        length=float(rng.uniform(60.0, 120.0)), has_lights=all(lit),
    )  # fmt: skip
    lit = [all(lit)] * 2
    if rng.random() < 0.4 and not lit[0]:
        at = 0.5 * sum(piece.length for piece in mid.pieces)
        mid = replace(mid, crossings=((at - 2.0, at + 2.0),))
    options: dict[str, object] = {
        "lanes": lanes, "limit": limit, "parking": 0.0, "sidewalk": mid.sidewalk,
        "width": mid.width,
    }  # fmt: skip
    counts = [int(rng.choice((3, 4), p=(0.6, 0.4))) for _ in range(2)]
    out: list[Street] = []
    number = 2
    for place, count in enumerate(counts):
        angles = _angles(rng, count)
        straight = min(range(1, count), key=lambda k: abs(angles[k] - np.pi))
        numbers = [mid.id, *range(number, number + count - 1)]
        number += count - 1
        arms = _arms(
            rng, numbers, angles, {0: dict(options), straight: dict(options)},
            lit=lit[place], lanes=lanes, crossings=float(rng.random()),
        )  # fmt: skip
        arms = [
            replace(arm, is_main=lit[place] or k in (0, straight), has_stop_sign=False)
            if k in (0, straight)
            else replace(arm, is_main=lit[place])
            for k, arm in enumerate(arms)
        ]
        if place == 0:
            fan = _fan([mid, *arms[1:]], angles, _rounding(rng))
            mid = replace(fan[0], is_main=True, junctions=(101, 102))
            out = [mid, *fan[1:]]
        else:
            x, y, heading = mid.road().at(np.array([mid.road().length]))[0].tolist()
            turned = [angle + heading + np.pi for angle in angles]
            rounding = _rounding(rng)
            reach = _reaches(arms, angles, rounding)[0]
            center = (float(x + reach * np.cos(heading)), float(y + reach * np.sin(heading)))
            fan = _fan(arms, turned, rounding, center=center, junction=102)
            out += fan[1:]
    return _turned(out, float(rng.uniform(0.0, 2.0 * np.pi)))


def _roundabout(rng: np.random.Generator) -> list[Street]:
    """A roundabout with one lane and three or four arms."""
    count = int(rng.integers(3, 5))
    radius = float(rng.uniform(14.0, 24.0))  # of the inner kerb
    half = float(np.arctan(11.2 / radius))  # from an arm to its ring segments
    spread = 0.25 if count == 3 else 0.12
    gaps = np.full(count, 2.0 * np.pi / count) + rng.uniform(-spread, spread, count)
    gaps *= 2.0 * np.pi / gaps.sum()
    angles = [0.0, *np.cumsum(gaps)[:-1].tolist()]
    if gaps.min() < 2.0 * half + 0.15:
        return []
    start = float(radius / np.cos(half) + radius * np.tan(half))
    arms, rings = [], []
    limit = float(rng.choice((30.0, 40.0, 50.0)))
    crossings = rng.random()
    for place, angle in enumerate(angles):
        arm = _street(rng, place + 1, lanes=1, limit=limit, width=3.5, parking=0.0, is_main=False)
        crossed = rng.random() < crossings
        arm = replace(
            arm,
            start=(start * float(np.cos(angle)), start * float(np.sin(angle)), float(angle)),
            junctions=(101 + place, 0),
            stop=1.0,
            crossings=((9.0, 13.0),) if crossed else (),
        )
        arms.append(_with_obstacles(rng, arm) if rng.random() < 0.2 else arm)
        begin = angle + half
        length = float(radius * (gaps[place] - 2.0 * half))
        rings.append(
            Street(
                ("moss", "nettle", "oak", "pine")[place], count + place + 1,
                (radius * float(np.cos(begin)), radius * float(np.sin(begin)),
                 float(begin + np.pi / 2)),
                (arc(length, 1.0 / radius),), 4.5, 30.0, is_one_way=True, sidewalk=0.0, stop=1.0,
                junctions=(101 + place, 101 + (place + 1) % count),
            )
        )  # fmt: skip
    return _turned([*arms, *rings], float(rng.uniform(0.0, 2.0 * np.pi)))


def _narrow_street(rng: np.random.Generator) -> list[Street]:
    """A winding street with parked cars, narrow places and a side street or none of note."""
    limit = float(rng.choice((30.0, 30.0, 40.0, 50.0)))
    angles = [0.0, np.pi / 2 + float(rng.uniform(-0.3, 0.3)), np.pi + float(rng.uniform(-0.3, 0.3))]
    width = round(float(rng.uniform(3.15, 3.45)), 2)
    arms = []
    for place in range(3):
        is_side = place == 1
        parking = 0.0 if is_side else round(float(rng.uniform(2.1, 2.4)), 2)
        arm = _street(
            rng, place + 1, lanes=1, limit=20.0 if is_side else limit, width=width,
            parking=parking, is_main=not is_side, has_stop_sign=is_side,
            length=float(rng.uniform(50.0, 80.0) if is_side else rng.uniform(120.0, 160.0)),
        )  # fmt: skip
        arm = _with_crossings(rng, arm, 0.4)
        length = sum(piece.length for piece in arm.pieces)
        if not is_side and rng.random() < 0.5:
            arm = _with_obstacles(rng, arm)
        elif not is_side and rng.random() < 0.7:
            at = float(rng.uniform(24.0, length - 60.0))
            end = at + float(rng.uniform(15.0, 30.0))
            if all(last < at - 12.0 or first > end + 12.0 for first, last in arm.crossings):
                arm = replace(arm, narrow=(at, end))
        arms.append(arm)
    return _turned(_fan(arms, angles, _rounding(rng)), float(rng.uniform(0.0, 2.0 * np.pi)))


def _car_park(rng: np.random.Generator) -> list[Street]:
    """A car park with diagonal spaces along an aisle that leaves a street and returns to it."""
    apart, start = float(rng.uniform(24.0, 32.0)), float(rng.uniform(13.5, 16.0))
    aisle, top = float(rng.uniform(40.0, 70.0)), float(rng.uniform(14.0, 20.0))
    east, north, south = 0.0, np.pi / 2, -np.pi / 2
    x, y = -apart, start + aisle
    way = (
        line(aisle),
        *connect((x, y, north), (0.0, y + top, east), ease=True),
        *connect((0.0, y + top, east), (-x, y, south), ease=True),
        line(aisle),
    )
    length = sum(piece.length for piece in way)
    limit, width = float(rng.choice((30.0, 40.0, 50.0))), round(float(rng.uniform(3.25, 3.6)), 2)
    free = np.flatnonzero(rng.random(60) < rng.uniform(0.2, 0.6))
    lot = Street(
        "lot", 4, (x, start, north), way, 3.4, 20.0, wide=_WIDE, is_main=False, junctions=(101, 102),
        stop=2.0, sidewalk=1.8, parking=5.2,
        stalls=((18.0, aisle - 6.0), (length - aisle + 6.0, length - 18.0)),
        empty=tuple(free.tolist()), crossings=((0.5 * aisle, 0.5 * aisle + 3.0),), is_marked=False,
    )  # fmt: skip
    side = partial(_street, rng, lanes=1, limit=limit, width=width, parking=0.0)
    mid = replace(
        side(2, pieces=(line(2.0 * (apart - start)),)),
        start=(x + start, 0.0, 0.0), junctions=(101, 102), stop=1.0,
    )  # fmt: skip
    ends = []
    for number, sign in ((1, -1.0), (3, 1.0)):
        arm = _with_crossings(rng, side(number), 0.0)
        angle = 0.0 if sign > 0 else np.pi
        place = (sign * (apart + start), 0.0, angle)
        ends.append(replace(arm, start=place, junctions=(102 if sign > 0 else 101, 0)))
    return _turned([ends[0], mid, ends[1], lot], float(rng.uniform(0.0, 2.0 * np.pi)))


def _shared(rng: np.random.Generator) -> list[Street]:
    """A shared space: everybody is slow, and pedestrians cross where they like."""
    count = int(rng.integers(3, 5))
    angles = _angles(rng, count)
    arms = []
    for place in range(count):
        length = float(rng.uniform(70.0, 100.0))
        spots = np.cumsum(rng.uniform(10.0, 20.0, 5)) - 5.0
        arm = _street(
            rng, place + 1, lanes=1, limit=20.0, parking=0.0, sidewalk=4.0, length=length,
            stop=1.0, is_marked=False,
            crossings=tuple((round(x, 1), round(x + 3.0, 1)) for x in spots.tolist() if x < 52.0),
        )  # fmt: skip
        arms.append(arm)
    return _turned(_fan(arms, angles, _rounding(rng)), float(rng.uniform(0.0, 2.0 * np.pi)))


KINDS: dict[str, Callable[[np.random.Generator], list[Street]]] = {
    "junction": partial(_junction, lit=False),
    "lights": partial(_junction, lit=True),
    "roundabout": _roundabout,
    "avenue": lambda rng: _pair(rng, lanes=int(rng.integers(2, 4))),
    "street": _narrow_street,
    "block": lambda rng: _pair(rng, lanes=1),
    "parking": _car_park,
    "shared": _shared,
}


# ---- traffic lights


def _lights(town: Town, junction: int, rng: np.random.Generator) -> Lights:
    """Traffic lights of a junction: streets that face each other are green together."""
    roads: dict[str, set[int]] = {}
    for (at, street, _, _), (number, _) in town.connectors.items():
        if at == junction:
            roads.setdefault(street, set()).add(number)
    headings = {name: _inward(town.streets[name], junction) for name in roads}
    left, phases = list(roads), []
    while left:
        first = left.pop(0)
        turn = [abs(np.cos(headings[x] - headings[first]) + 1.0) for x in left]
        phase = [first]
        if turn and min(turn) < 0.2:
            phase.append(left.pop(int(np.argmin(turn))))
        phases.append(phase)
    crossings = {
        town.streets[name].crossing_name(number): place
        for place, phase in enumerate(phases)
        for name in phase
        for number, ends in enumerate(town.streets[name].crossings)
        if ends in _AT_JUNCTION and junction == town.streets[name].junctions[0]
    }
    green = tuple(round(float(rng.uniform(7.0, 13.0)), 1) for _ in phases)
    begun = round(float(rng.uniform(0.0, 30.0)), 1)
    numbers = tuple(frozenset(x for name in phase for x in roads[name]) for phase in phases)
    return Lights(numbers, green, begun, crossings)


def _inward(street: Street, junction: int) -> float:
    """Heading of a street where it enters a junction [rad]."""
    if street.junctions[0] == junction:
        return street.start[2] + float(np.pi)
    road = street.road()
    return float(road.at(np.array([road.length]))[0, 2])
