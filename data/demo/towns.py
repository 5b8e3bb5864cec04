"""The streets of the demo towns, each of another character."""

import numpy as np

from shiftsim.data.demo.network import Street, Town, build_town
from shiftsim.data.demo.roads import Piece, arc, bend, connect, line
from shiftsim.data.demo.walks import add_bays, add_walks

_EAST, _NORTH, _WEST, _SOUTH = 0.0, np.pi / 2, np.pi, -np.pi / 2
_SQUARE = ((3.0, 7.0),)  # m along a street, crosswalk at a junction


def _outward(x: float, y: float, angle: float, radius: float) -> tuple[float, float, float]:
    """Start of a street that leads away from a junction."""
    return x + radius * float(np.cos(angle)), y + radius * float(np.sin(angle)), float(angle)


def junction_town() -> Town:
    """A four-armed junction: a main road with two lanes per direction, two narrow side roads."""
    at = (101, 0)
    south: tuple[Piece, ...] = connect((0.0, 0.0, 0.0), (62.0, 9.0, 0.0), ease=True)
    return _finish(
        "junction",
        Street(
            "east", 1, _outward(0, 0, _EAST, 16.0), (line(108.0),), 3.3, 50.0, 2,
            junctions=at, crossings=_SQUARE,
        ),
        Street(
            "north", 2, _outward(0, 0, _NORTH, 16.0),
            (line(24.0), *bend(-0.5, -0.02, 14.0), line(45.0)), 3.5, 30.0,
            is_main=False, junctions=at, crossings=_SQUARE, has_stop_sign=True,
        ),
        Street(
            "west", 3, _outward(0, 0, _WEST, 16.0),
            (line(30.0), *bend(0.45, 0.012, 20.0), line(25.0)), 3.3, 50.0, 2,
            junctions=at, crossings=_SQUARE,
        ),
        Street(
            "south", 4, _outward(0, 0, _SOUTH, 16.0), (line(25.0), *south, line(15.0)), 3.5, 30.0,
            is_main=False, junctions=at, crossings=_SQUARE, has_stop_sign=True,
        ),
    )  # fmt: skip


def street_town() -> Town:
    """A winding street with cars parked on both sides, too narrow to meet at one place."""
    at = (101, 0)
    east = (line(22.0), *bend(1.1, 1 / 50, 18.0), line(38.0), *bend(-0.8, -1 / 55, 18.0))
    west = (line(18.0), *bend(-0.9, -1 / 52, 18.0), line(30.0), *bend(0.7, 1 / 60, 16.0))
    return _finish(
        "street",
        Street(
            "east", 1, _outward(0, 0, _EAST, 12.0), (*east, line(20.0)), 3.2, 30.0,
            junctions=at, crossings=((84.0, 88.0),), parking=2.3, narrow=(26.0, 50.0),
        ),
        Street(
            "side", 2, _outward(0, 0, _NORTH, 14.0), (line(45.0),), 3.2, 20.0,
            is_main=False, junctions=at, crossings=_SQUARE, has_stop_sign=True,
        ),
        Street(
            "west", 3, _outward(0, 0, _WEST, 12.0), (*west, line(25.0)), 3.2, 30.0,
            junctions=at, crossings=((9.0, 13.0),), stop=2.0, parking=2.3,
        ),
    )  # fmt: skip


def roundabout_town() -> Town:
    """A roundabout with one lane and four arms, crosswalks one car length before it."""
    radius, half = 18.0, 32.0 * np.pi / 180.0  # of the inner kerb; from an arm to its ring segments
    start = float(radius / np.cos(half) + radius * np.tan(half))
    ways = {
        "east": (_EAST, (line(60.0), *bend(0.35, 0.015, 12.0), line(25.0))),
        "north": (_NORTH, (line(85.0),)),
        "west": (_WEST, (line(40.0), *bend(-0.6, -0.02, 15.0), line(30.0))),
        "south": (_SOUTH, (line(95.0),)),
    }
    arms = [
        Street(
            name, number, _outward(0, 0, angle, start), pieces, 3.5, 40.0, is_main=False,
            junctions=(100 + number, 0), crossings=((9.0, 13.0),), stop=1.0,
        )
        for number, (name, (angle, pieces)) in enumerate(ways.items(), start=1)
    ]  # fmt: skip
    rings = []
    for number, name in enumerate(("ne", "nw", "sw", "se")):
        angle = number * np.pi / 2 + half
        x, y, _ = _outward(0, 0, angle, radius)
        length = float(radius * (np.pi / 2 - 2 * half))
        rings.append(
            Street(
                name, 5 + number, (x, y, float(angle + np.pi / 2)), (arc(length, 1 / radius),),
                4.5, 30.0, is_one_way=True, sidewalk=0.0, stop=1.0,
                junctions=(101 + number, 101 + (number + 1) % 4),
            )
        )  # fmt: skip
    return _finish("roundabout", *arms, *rings)


def avenue_town() -> Town:
    """An avenue with three lanes per direction and two side streets."""
    return _finish(
        "avenue",
        Street(
            "west", 1, _outward(-70, 0, _WEST, 20.0), (line(95.0), *bend(-0.2, -0.008, 10.0)),
            3.25, 50.0, 3, junctions=(101, 0), crossings=_SQUARE,
        ),
        Street("mid", 2, (-50.0, 0.0, 0.0), (line(100.0),), 3.25, 50.0, 3, junctions=(101, 102)),
        Street(
            "east", 3, _outward(70, 0, _EAST, 20.0), (line(60.0), *bend(0.3, 0.008, 15.0)),
            3.25, 50.0, 3, junctions=(102, 0),
        ),
        Street(
            "north", 4, _outward(-70, 0, _NORTH, 20.0), (line(70.0),), 4.0, 30.0,
            is_main=False, junctions=(101, 0), crossings=_SQUARE, has_stop_sign=True,
        ),
        Street(
            "south", 5, _outward(70, 0, _SOUTH, 20.0), (line(70.0),), 4.0, 30.0,
            is_main=False, junctions=(102, 0), crossings=_SQUARE, has_stop_sign=True,
        ),
    )  # fmt: skip


def parking_town() -> Town:
    """A car park with diagonal spaces along an aisle that leaves a street and returns to it."""
    apart, start, aisle, top = 24.0, 12.0, 58.0, 16.0
    x, y = -apart, start + aisle
    lot = (
        line(aisle),
        *connect((x, y, _NORTH), (0.0, y + top, 0.0), ease=True),
        *connect((0.0, y + top, 0.0), (-x, y, _SOUTH), ease=True),
        line(aisle),
    )
    length = sum(piece.length for piece in lot)
    return _finish(
        "parking",
        Street(
            "west", 1, _outward(x, 0, _WEST, start), (line(95.0),), 3.25, 30.0,
            junctions=(101, 0), stop=2.0, crossings=((40.0, 44.0),),
        ),
        Street(
            "mid", 2, (x + start, 0.0, 0.0), (line(2 * (apart - start)),), 3.25, 30.0,
            junctions=(101, 102), stop=1.0,
        ),
        Street(
            "east", 3, _outward(-x, 0, _EAST, start), (line(80.0),), 3.25, 30.0,
            junctions=(102, 0), stop=2.0,
        ),
        Street(
            "lot", 4, _outward(x, 0, _NORTH, start), lot, 3.0, 20.0,
            is_main=False, junctions=(101, 102), stop=2.0, sidewalk=1.8, parking=5.2,
            stalls=((8.0, 52.0), (length - 52.0, length - 8.0)),
            empty=(3, 4, 5, 12, 13, 16, 17, 30, 39),
            crossings=((28.0, 31.0),), is_marked=False,
        ),
    )  # fmt: skip


def shared_town() -> Town:
    """A shared space: everybody is slow, and pedestrians cross where they like."""
    places = tuple((x, x + 3.0) for x in (5.0, 19.0, 33.0, 47.0))
    ways = {
        "west": (_WEST, (line(30.0), *bend(0.3, 0.012, 10.0), line(30.0))),
        "east": (_EAST, (line(35.0), *bend(0.4, 0.015, 10.0), line(25.0))),
        "south": (_SOUTH, (line(70.0),)),
    }
    streets = [
        Street(
            name, number, _outward(0, 0, angle, 11.0), pieces, 3.2, 20.0,
            junctions=(101, 0), stop=1.0, crossings=places, is_marked=False, sidewalk=4.0,
        )
        for number, (name, (angle, pieces)) in enumerate(ways.items(), start=1)
    ]  # fmt: skip
    return _finish("shared", *streets)


TOWNS = {
    "avenue": avenue_town,
    "junction": junction_town,
    "parking": parking_town,
    "roundabout": roundabout_town,
    "shared": shared_town,
    "street": street_town,
}


def _finish(name: str, *streets: Street) -> Town:
    town = build_town(name, streets)
    add_walks(town)
    add_bays(town)
    return town
