"""Random streets, not in their place yet, and streets fanned out around a junction."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from shiftsim.data.synthetic.roads import Piece
from shiftsim.data.synthetic.town import Street
from shiftsim.kernels import FloatArray

AT_JUNCTION = ((3.0, 7.0),)  # m along a street, crosswalk at a junction
_NAMES = ("alder", "birch", "cedar", "dogwood", "elm", "fir", "gorse", "hazel", "iris")
# km/h, by lanes per direction
_LIMITS = ((20.0, 30.0, 30.0, 40.0, 50.0), (30.0, 40.0, 50.0, 50.0, 60.0), (50.0, 60.0, 70.0))
_LATERAL_ACCEL = 1.8  # m/s^2, of a driver in a curve
_NEAR = 9.0  # m, shortest way from the middle of a junction to its streets
_STEP = 4.0  # m between the places of streets that are compared
_SKIPPED = 6  # of these next to a junction that two streets share
_APART = 3.0  # m between streets
_SPACE, _HALF_CAR = 6.5, 0.95  # m along a street for a parked car, half its width


def random_street(
    rng: np.random.Generator,
    number: int,
    *,
    lanes: int = 1,
    limit: float | None = None,
    length: float | None = None,
    parking: float | None = None,
    pieces: tuple[Piece, ...] | None = None,
) -> Street:
    """A street with a number from 1 on, whose begin is not in its place yet.

    What is not given is drawn. Long streets lead out of town, so that fast vehicles stay in sight.
    """
    drawn = float(rng.choice(_LIMITS[lanes - 1]))
    limit = drawn if limit is None else limit
    width = round(float(rng.uniform(3.2, 3.75) if limit > 30.0 else rng.uniform(3.2, 3.5)), 2)
    has_cars = lanes == 1 and limit <= 40.0 and rng.random() < 0.4
    strip = round(float(rng.uniform(2.1, 2.4)), 2) if has_cars else 0.0
    strip = strip if parking is None else parking
    sidewalk = round(float(rng.uniform(2.0, 3.5)), 2)
    drawn = limit / 3.6 * float(rng.uniform(9.5, 15.0)) + 25.0
    length = drawn if length is None else length
    if pieces is None:
        straight = float(rng.uniform(20.0, 35.0))
        pieces = _winding(rng, length, limit, lanes * width + strip, straight)
    free: tuple[int, ...] = ()  # parking spaces
    if strip:
        share = rng.uniform(0.1, 0.7)
        free = tuple(np.flatnonzero(rng.random(80) < share).tolist())
    return Street(
        _NAMES[number - 1], number, (0.0, 0.0, 0.0), pieces, width, limit, lanes, parking=strip,
        sidewalk=sidewalk, empty=free,
    )  # fmt: skip


def _winding(
    rng: np.random.Generator, length: float, limit: float, half: float, straight: float
) -> tuple[Piece, ...]:
    """Lines and bends; the first metres are straight, and it never turns far from there."""
    comfortable = (limit / 3.6) ** 2 / _LATERAL_ACCEL  # m, radius
    pieces, turned = [Piece(straight)], 0.0
    goes_on = rng.random() < 0.25  # straight to the end
    while (rest := length - sum(piece.length for piece in pieces)) > 8.0:
        radius = max(comfortable * float(rng.uniform(0.35, 2.5)), half + 9.0, 16.0)
        angle = float(rng.uniform(0.2, 0.9) * rng.choice((-1.0, 1.0)))
        easing = min(float(rng.uniform(6.0, 16.0)), 0.5 * abs(angle) * radius)
        if goes_on or abs(turned + angle) > 0.8 or abs(angle) * radius + easing > rest - 6.0:
            pieces.append(Piece(min(rest, float(rng.uniform(15.0, 40.0)))))
            goes_on = goes_on or rest < 40.0
            continue
        curvature = float(np.sign(angle)) / radius
        pieces += [
            Piece(easing, 0.0, curvature),
            Piece(abs(angle / curvature) - easing, curvature, curvature),
            Piece(easing, curvature, 0.0),
            Piece(float(rng.uniform(6.0, 25.0))),
        ]
        turned += angle
    return tuple(pieces)


def with_crossings(rng: np.random.Generator, street: Street, share: float) -> Street:
    """The same street with crossings, one at its begin with a chance; some are not marked."""
    length = street.length
    places = AT_JUNCTION if rng.random() < share else ()
    if rng.random() < 0.6 and length > 75.0:
        at = round(float(rng.uniform(32.0, length - 38.0)), 1)
        places = (*places, (at, at + 4.0))
    stop = 9.0 if AT_JUNCTION[0] in places else 2.0
    return replace(street, crossings=places, stop=stop, is_marked=bool(rng.random() < 0.7))


def with_obstacles(rng: np.random.Generator, street: Street) -> Street:
    """The same street with cars half on the road, so that vehicles swing out or take turns."""
    length = street.length
    begin = float(rng.uniform(28.0, max(length - 60.0, 30.0)))
    count = int(rng.integers(1, 5))
    end = begin + _SPACE * count
    clear = all(last < begin - 12.0 or first > end + 12.0 for first, last in street.crossings)
    if street.lanes > 1 or not clear or end > length - 25.0:
        return street
    sign = float(rng.choice((-1.0, 1.0)))  # -1 right of the direction along s
    into = float(rng.uniform(0.5, 1.1))  # m, how far they stand in the lane
    t = sign * (street.width - into + _HALF_CAR)
    swing = min(into + 0.35, 0.5 * street.width - 0.1)
    return replace(
        street,
        narrow=(begin, end),
        swings=(swing, 0.0) if sign < 0 else (0.0, swing),
        obstacles=tuple((round(begin + 3.2 + _SPACE * k, 2), t) for k in range(count)),
        parking=0.0,
        empty=(),
    )


def random_angles(rng: np.random.Generator, count: int) -> list[float]:
    """Directions of the arms of a junction, ascending, the first one 0 [rad]."""
    if count == 3 and rng.random() < 0.6:
        gaps = np.array([0.5, 0.5, 1.0]) * np.pi  # a T
        gaps = np.roll(gaps, int(rng.integers(3)))
    else:
        gaps = np.full(count, 2.0 * np.pi / count)
    return directions(random_gaps(rng, gaps, 0.06 if count == 5 else 0.25))


def random_gaps(rng: np.random.Generator, gaps: FloatArray, spread: float) -> FloatArray:
    """(n,) angles between neighbouring arms, each changed by about `spread` at most [rad]."""
    gaps = gaps + rng.uniform(-spread, spread, len(gaps))
    gaps *= 2.0 * np.pi / gaps.sum()
    return gaps


def directions(gaps: FloatArray) -> list[float]:
    """Directions of arms with gaps (n,) between them, the first one 0 [rad]."""
    return [0.0, *np.cumsum(gaps)[:-1].tolist()]


def junction_arms(
    streets: Sequence[Street],
    angles: Sequence[float],
    rounding: float,
    *,
    center: tuple[float, float] = (0.0, 0.0),
    junction: int = 101,
) -> list[Street]:
    """Streets that lead away from a junction at ascending angles [rad]; kerbs `rounding` [m]."""
    out = []
    far = reaches(streets, angles, rounding)
    for street, angle, reach in zip(streets, angles, far, strict=True):
        x, y = center[0] + reach * np.cos(angle), center[1] + reach * np.sin(angle)
        start = (float(x), float(y), float(angle))
        out.append(replace(street, start=start, junctions=(junction, street.junctions[1])))
    return out


def reaches(streets: Sequence[Street], angles: Sequence[float], rounding: float) -> list[float]:
    """How far from the middle of a junction its streets must begin [m]; arguments as above."""
    out = [_NEAR] * len(streets)
    for one in range(len(streets)):
        other = (one + 1) % len(streets)
        gap = (angles[other] - angles[one]) % (2.0 * np.pi)
        if gap > np.pi - 0.25:
            continue  # they go on from one another
        a, b = streets[one].half, streets[other].half
        kerb = rounding / np.tan(0.5 * gap)
        out[one] = max(out[one], float((b + a * np.cos(gap)) / np.sin(gap) + kerb))
        out[other] = max(out[other], float((a + b * np.cos(gap)) / np.sin(gap) + kerb))
    return out


def are_apart(streets: Sequence[Street]) -> bool:
    """Whether no two streets come too close away from the junctions that they share."""
    lines = [(x, x.road.at(np.append(np.arange(0.0, x.length, _STEP), x.length))) for x in streets]
    for (one, a), (two, b) in combinations([x for x in lines if not x[0].is_one_way], 2):
        gaps = np.hypot(*np.moveaxis(_away(a, one, two)[:, None] - _away(b, two, one), -1, 0))
        wide = one.half + two.half + max(one.sidewalk, two.sidewalk) + _APART
        if gaps.min(initial=np.inf) < wide:
            return False
    return True


def _away(line: FloatArray, street: Street, other: Street) -> FloatArray:
    """Points of a street's line that are not near a junction that it shares with another one."""
    first, last = (x in other.junctions and x > 0 for x in street.junctions)
    return line[_SKIPPED * first : len(line) - _SKIPPED * last, :2]
