"""Where pedestrians walk and cars park along the streets of generated towns."""

import numpy as np

from shiftsim.data.demo.network import BAY_ANGLE, Street, Town
from shiftsim.data.demo.paths import STEP, Walk, arc_at, resample
from shiftsim.kernels import FloatArray

_PARKING_STEP, _BAY_STEP = 6.6, 3.1  # m along the street between parked cars, diagonal ones
_UNMARKED = 4.0  # m from a place to cross without a crosswalk to the middle of a parked car
_DIAGONAL = 3.0  # m, wider strips are for diagonal parking
_ROUNDING = 0.6  # m


def add_walks(town: Town) -> None:
    """Add ways over every crossing, and along the sidewalks."""
    for street in town.streets.values():
        if street.sidewalk <= 0.0 or street.is_one_way:
            continue
        for number in range(len(street.crossings)):
            _add_crossing(town, street, number)
        road = town.network.roads[street.id]
        first = 0.5 * sum(street.crossings[0]) + 8.0 if street.crossings else 3.0
        s = np.arange(first, road.length - 3.0, STEP)
        for name, sign in (("left", 1.0), ("right", -1.0)):
            points = road.at(s, sign * (street.half + 2.5))[:, :2]
            points = points if sign > 0 else points[::-1]
            town.walks[f"{street.name}-along-{name}"] = Walk(resample(points, _ROUNDING))


def _add_crossing(town: Town, street: Street, number: int) -> None:
    """Four ways over a crossing: two to either side, which never meet."""
    road = town.network.roads[street.id]
    half, middle = street.half, 0.5 * sum(street.crossings[number])
    far = min(middle + 30.0, road.length - 3.0)
    label = f"{street.name}.{number}" if number else street.name
    for name, sign in (("right", 1.0), ("left", -1.0)):
        aside = half + 1.2 + 0.4 * sign
        for suffix, offset in (("", -0.9), ("-b", -0.2)) if sign > 0 else (("", 0.5), ("-b", 1.2)):
            at = middle + offset
            before = road.at(np.arange(far, at, -STEP), sign * aside)[:, :2]
            lateral = np.arange(aside, -aside, -STEP)
            over = road.at(np.full(len(lateral), at), sign * lateral)[:, :2]
            after = road.at(np.arange(at, far - 6.0, STEP), -sign * aside)[:, :2]
            points = resample(np.concatenate([before, over, after]), _ROUNDING)
            kerb = arc_at(points, over[0]) + (aside - half) - 0.6
            across = kerb + 2 * half + 1.4
            crossing = street.crossing_name(number)
            town.walks[f"{label}-cross-{name}{suffix}"] = Walk(points, crossing, kerb, across)


def add_bays(town: Town) -> None:
    """Add the parking spaces of every street."""
    for street in town.streets.values():
        if street.parking > 0.0:
            town.bays[street.name] = _bays(town, street)


def _bays(town: Town, street: Street) -> FloatArray:
    """(n, 3) poses of parking spaces, right ones first, away from crossings and junctions."""
    road = town.network.roads[street.id]
    step, clear = (_BAY_STEP, 4.0) if street.parking > _DIAGONAL else (_PARKING_STEP, 9.0)
    stalls = street.stalls or ((14.0, road.length - 8.0),)
    places = np.concatenate([np.arange(*ends, step) for ends in stalls])
    clear = clear if street.is_marked else min(clear, _UNMARKED)
    for first, last in street.crossings:
        places = places[(places < first - clear) | (places > last + clear)]
    aside = np.full(len(places), street.half - 0.5 * street.parking)
    right, left = road.at(places, -aside), road.at(places, aside)
    left[:, 2] += np.pi
    if street.parking > _DIAGONAL:
        right[:, 2] -= BAY_ANGLE
        left[:, 2] -= BAY_ANGLE
    return np.concatenate([right, left])
