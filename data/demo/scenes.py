"""What happens in the recordings of the demo: who starts where, when and how fast."""

from collections.abc import Callable
from dataclasses import dataclass

from shiftsim.data.demo.agents import Driver, Walker
from shiftsim.data.demo.network import Town
from shiftsim.data.demo.towns import (
    avenue_town,
    junction_town,
    parking_town,
    roundabout_town,
    shared_town,
    street_town,
)
from shiftsim.data.demo.traffic import Traffic


@dataclass(frozen=True)
class Scene:
    """One recording.

    Attributes:
        start: UTC time of the first frame.
        duration: [s].
        drivers: One line each: category, way, start arc length [m], speed [m/s], eagerness, start
            time [s].
        walkers: One line each: walk, start arc length [m], start time [s].
    """

    start: str
    duration: float
    drivers: str
    walkers: str

    @property
    def name(self) -> str:
        """Name of the recording, as DSC3D forms them."""
        return self.start.replace(":", "-")


@dataclass(frozen=True)
class DemoSite:
    """One generated town with its recordings."""

    name: str
    town: Callable[[], Town]
    zone: int
    offset: tuple[float, float, float]
    latitude: float
    longitude: float
    scenes: tuple[Scene, ...]


_JUNCTION = Scene(
    "2031-05-04T08:00:00",
    30.08,
    """
    car        east2-west           14  9.0  0.95  0
    van        east1-south          24  9.0  1     0
    car        west1-east           10 10.0  1     0
    car        west2-south          30  9.0  1     0
    car        north1-south         22  6.5  1     0
    pickup     south1-west          20  6.0  1     0
    bicycle    south1-east-bicycle  55  4.0  1     0
    car        east1-west            8 10.5  1.04  4
    truck      west2-east            8  9.0  0.8   5
    car        south1-north          8  6.5  1     7
    car        west1-north           8 10.0  1     9
    car        east2-north           8 10.0  1    11.5
    motorcycle east2-west            8 10.0  1    14
    bicycle    west2-east-bicycle    6  4.0  1    12
    bus        east1-west            9  8.0  0.75 18
    car        north1-west           8  6.0  1    17
    van        west2-east            8  9.5  0.95 20
    car        south1-east           8  6.5  1    21
    car        west1-east            8 10.0  1    22
    """,
    """
    east-cross-right    18  0
    north-cross-left    22  0
    west-cross-left     14 12
    south-cross-right-b 12  8
    east-cross-left     10 20
    west-cross-right    16 24
    north-cross-right-b 20 18
    east-along-left     10  0
    west-along-right    20  0
    south-along-left     5  3
    north-along-right    5  6
    """,
)

_STREET = Scene(
    "2031-06-15T17:45:00",
    30.08,
    """
    car        west1-east          52 7.0 1    0
    truck      west1-east          28 6.5 0.95 0
    car        west1-east           8 7.0 1    0
    car        east1-west          60 7.0 1    0
    pickup     east1-west          14 7.0 0.95 0
    bicycle    east1-west-bicycle 100 4.2 1    0
    van        side1-east           6 4.5 1    8
    car        west1-east           8 7.5 1.1  6
    bus        east1-west           8 6.5 0.9  5
    motorcycle west1-side           6 7.0 1   12
    car        east1-side           8 7.0 1   10.5
    car        west1-east           8 7.0 1   16
    car        east1-west           8 7.0 1   18
    van        west1-east           8 7.0 1   22
    """,
    """
    east-cross-right   19  0
    east-cross-left    10  4
    west-cross-right-b 14  9
    west-cross-left    10 18
    east-along-left    12  0
    west-along-right   30  0
    west-along-left    20  4
    """,
)

_ROUNDABOUT = Scene(
    "2031-07-02T12:10:00",
    30.08,
    """
    car        east1-ne-north          40 8.0 1    0
    van        west1-sw-se-east        30 8.0 1    0
    car        south1-se-ne-north      10 9.0 1    0
    car        north1-nw-sw-south      45 8.0 1    0
    pickup     north1-nw-sw-se-east    12 9.0 1    0
    car        east1-ne-nw-west        12 9.0 1    0
    bicycle    south1-se-ne-north-bicycle 60 4.0 1 0
    car        west1-sw-south           8 9.0 1    2
    bus        east1-ne-nw-west         9 8.0 0.85 6
    car        south1-se-ne-nw-west     8 9.0 1    5
    car        north1-nw-sw-south       8 9.0 1    8
    motorcycle west1-sw-se-ne-north     8 9.0 1    9
    car        west1-sw-se-east         8 9.0 1   12
    van        south1-se-ne-north       8 9.0 1   13
    car        east1-ne-nw-sw-south     8 9.0 1   15
    car        north1-nw-west           8 9.0 1   18
    truck      west1-sw-se-east         8 8.0 0.9 20
    car        south1-se-east           8 9.0 1   22
    """,
    """
    east-cross-right  18  0
    west-cross-left   16  4
    north-cross-left  20 10
    south-cross-right 22 16
    south-along-left  10  0
    north-along-right 12  2
    """,
)

_AVENUE = Scene(
    "2031-07-20T07:30:00",
    30.08,
    """
    car        west2-mid-east       20 12.0 1    0
    van        west3-mid-east       40 11.0 0.95 0
    car        west1-mid>2-east     60 12.0 1    0
    car        east2-mid-west       30 12.0 1    0
    bus        east3-mid-west       20 10.0 0.8  0
    pickup     east3>2-mid-west      8 11.0 1    0
    car        east1-south          45 10.0 1    0
    car        west1-north           8 11.0 1   12
    car        north1-west          20  6.0 1    0
    car        south1-mid-west      10  6.0 1    0
    car        west3-mid-south       8 11.0 1    1
    car        west1-mid-east        8 12.0 1.05 2
    bicycle    west3-mid-east-bicycle 70 4.4 1   0
    car        east2-mid>1-west      8 12.0 1.04 4
    truck      east3-mid-west        8 10.0 0.85 6
    car        west2-mid-east        8 12.0 1    7
    car        east1-mid-west        8 12.0 1    9
    motorcycle west1-mid-east        8 12.0 1   10
    car        south1-east           8  6.0 1   11
    car        east3-mid-west        8 11.0 1   14
    car        west2>3-mid-east      8 11.0 1   16
    van        west1-mid-east        8 12.0 1   18
    car        east2-mid-west        8 12.0 1   20
    car        north1-mid-east       8  6.0 1   15
    """,
    """
    west-cross-right   18  0
    north-cross-left   16  6
    south-cross-right  18 12
    west-along-left    20  0
    mid-along-right    30  0
    mid-along-left     10  5
    east-along-left    15  3
    """,
)

_PARKING = Scene(
    "2031-08-11T10:20:00",
    30.08,
    """
    car        west1-lot@4          40 7.0 1    0
    car        east1-mid-west       10 7.0 1    0
    van        west1-mid-east       10 7.0 1    0
    car        west1-lot-east       75 6.0 1    0
    bicycle    east1-mid-west-bicycle 40 4.0 1  0
    car        east1-mid-lot@16      8 7.0 1    4
    pickup     west1-lot-east        8 7.0 1    5
    car        west1-mid-east        8 7.0 1    9
    car        west1-lot@13          8 7.0 1   12
    car        east1-lot-west        8 7.0 1    9
    van        east1-mid-west        8 7.0 1   14
    car        west1-mid-east        8 7.0 1   17
    car        east1-mid-west        8 7.0 1   20
    """,
    """
    west-cross-right   14  0
    lot-cross-left      8  6
    lot-cross-right    10 16
    west-cross-left-b  16 18
    west-along-left    20  0
    east-along-right   10  0
    """,
)

_SHARED = Scene(
    "2031-09-05T16:00:00",
    30.08,
    """
    car        west1-east           12 4.5 1    0
    car        east1-west           10 4.5 1    0
    van        south1-east           8 4.5 1    0
    bicycle    east1-south-bicycle  30 4.0 1    0
    bicycle    west1-east-bicycle   30 4.0 1    0
    car        west1-south          24 4.5 1    0
    pickup     east1-south           8 4.5 1    6
    car        south1-west           8 4.5 1    2
    car        west1-east            8 4.5 1    9
    bicycle    south1-west-bicycle   6 4.0 1   11
    car        east1-west            8 4.5 1   14
    car        south1-east           8 4.5 1   16
    car        west1-south           8 4.5 1   20
    """,
    """
    west-cross-right     10  0
    west.1-cross-left    14  2
    west.2-cross-right-b 18  8
    east-cross-left      12  4
    east.2-cross-right   16  0
    east.3-cross-left    18 12
    south-cross-right    14  3
    south.1-cross-left   16 14
    south.2-cross-right  18 18
    west.3-cross-left    14 20
    east.1-cross-right   22 22
    west-along-left       5  0
    south-along-right     8  0
    east-along-right     10  5
    """,
)

SITES = (
    DemoSite("avenue", avenue_town, 33, (392_000.0, 5_820_000.0, 0.0), 52.52, 13.41, (_AVENUE,)),
    DemoSite(
        "junction", junction_town, 32, (690_000.0, 5_334_000.0, 0.0), 48.13, 11.56, (_JUNCTION,)
    ),
    DemoSite("parking", parking_town, 32, (498_000.0, 5_395_000.0, 0.0), 48.71, 9.0, (_PARKING,)),
    DemoSite(
        "roundabout",
        roundabout_town,
        32,
        (565_000.0, 5_934_000.0, 0.0),
        53.55,
        9.99,
        (_ROUNDABOUT,),
    ),
    DemoSite("shared", shared_town, 32, (356_000.0, 5_645_000.0, 0.0), 50.94, 6.96, (_SHARED,)),
    DemoSite("street", street_town, 32, (513_000.0, 5_402_000.0, 0.0), 48.77, 9.18, (_STREET,)),
)


def traffic_of(scene: Scene, town: Town) -> Traffic:
    """Everybody of a scene in their town, ready to be simulated."""
    drivers = []
    for line in _lines(scene.drivers):
        category, way, s, v, eager, start = line
        path = town.path(way)
        drivers.append(Driver(category, path, float(s), float(v), float(eager), float(start)))
    walkers = [
        Walker(town.walks[walk], float(start), float(s)) for walk, s, start in _lines(scene.walkers)
    ]
    return Traffic(town, drivers, walkers)


def _lines(table: str) -> list[list[str]]:
    return [line.split() for line in table.strip().splitlines()]
