"""What happens in the recordings of the demo: who starts where, when and how fast."""

from collections.abc import Callable
from dataclasses import dataclass

from shiftsim.data.demo_towns import Town, junction_town, street_town
from shiftsim.data.demo_traffic import Driver, Traffic, Walker


@dataclass(frozen=True)
class Scene:
    """One recording.

    Attributes:
        name: Name of the recording, as DSC3D forms them.
        start: UTC time of the first frame.
        duration: [s].
        drivers: Category, path, start arc length [m], speed [m/s], eagerness, start time [s].
        walkers: Walk, start arc length [m], start time [s].
    """

    name: str
    start: str
    duration: float
    drivers: tuple[tuple[str, str, float, float, float, float], ...]
    walkers: tuple[tuple[str, float, float], ...]


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


_JUNCTION_BUSY = Scene(
    "2031-05-04T08-00-00",
    "2031-05-04T08:00:00",
    42.08,
    (
        ("car", "east2-west", 14.0, 9.0, 0.95, 0.0),
        ("van", "east1-south", 24.0, 9.0, 1.0, 0.0),
        ("car", "west1-east", 10.0, 10.0, 1.0, 0.0),
        ("car", "west2-south", 30.0, 9.0, 1.0, 0.0),
        ("car", "north1-south", 22.0, 6.5, 1.0, 0.0),
        ("pickup", "south1-west", 20.0, 6.0, 1.0, 0.0),
        ("bicycle", "south1-east-bicycle", 55.0, 4.0, 1.0, 0.0),
        ("car", "east1-west", 8.0, 10.5, 1.04, 4.0),
        ("truck", "west2-east", 8.0, 9.0, 0.8, 5.0),
        ("car", "south1-north", 8.0, 6.5, 1.0, 7.0),
        ("car", "west1-north", 8.0, 10.0, 1.0, 9.0),
        ("motorcycle", "east2-west", 8.0, 10.0, 1.0, 11.0),
        ("car", "north1-east", 8.0, 6.5, 1.0, 8.0),
        ("car", "east2-north", 8.0, 10.0, 1.0, 15.0),
        ("bus", "east1-west", 9.0, 8.0, 0.75, 20.0),
        ("car", "west1-east", 8.0, 10.5, 0.97, 21.0),
        ("car", "south1-east", 8.0, 6.5, 1.0, 22.0),
        ("bicycle", "west2-east-bicycle", 6.0, 4.0, 1.0, 12.0),
    ),
    (
        ("1-cross-right", 18.0, 0.0),
        ("2-cross-left", 22.0, 0.0),
        ("3-cross-left", 14.0, 12.0),
        ("4-cross-right-b", 12.0, 16.0),
        ("2-cross-right-b", 10.0, 24.0),
        ("1-along-left", 10.0, 0.0),
        ("3-along-right", 20.0, 0.0),
        ("4-along-left", 5.0, 3.0),
    ),
)

_JUNCTION_CALM = Scene(
    "2031-05-04T11-30-00",
    "2031-05-04T11:30:00",
    30.08,
    (
        ("car", "north1-west", 18.0, 6.5, 1.0, 0.0),
        ("car", "east1-west", 10.0, 10.5, 1.0, 0.0),
        ("van", "west2-east", 12.0, 10.0, 0.96, 0.0),
        ("car", "south1-north", 34.0, 6.0, 1.0, 0.0),
        ("car", "south1-east", 16.0, 6.0, 1.0, 0.0),
        ("bicycle", "north1-south-bicycle", 50.0, 4.0, 1.0, 0.0),
        ("car", "west1-north", 6.0, 11.0, 1.07, 6.0),
        ("car", "east2-north", 8.0, 10.0, 1.0, 8.0),
        ("pickup", "north1-south", 8.0, 6.5, 1.0, 9.0),
        ("bus", "west2-east", 8.0, 8.0, 0.8, 10.0),
    ),
    (
        ("4-cross-left", 16.0, 0.0),
        ("3-cross-right", 20.0, 3.0),
        ("1-cross-left-b", 15.0, 8.0),
        ("2-along-left", 10.0, 0.0),
    ),
)

_STREET = Scene(
    "2031-06-15T17-45-00",
    "2031-06-15T17:45:00",
    42.08,
    (
        ("car", "ahead", 84.0, 7.0, 1.0, 0.0),
        ("van", "ahead", 62.0, 7.0, 0.95, 0.0),
        ("car", "ahead", 30.0, 7.0, 1.0, 0.0),
        ("car", "back", 150.0, 7.0, 1.0, 0.0),
        ("pickup", "back", 100.0, 7.0, 0.9, 0.0),
        ("bicycle", "back-bicycle", 40.0, 4.2, 1.0, 0.0),
        ("car", "back", 12.0, 7.0, 1.0, 0.0),
        ("car", "ahead", 8.0, 7.5, 1.06, 7.0),
        ("truck", "back", 8.0, 6.0, 0.8, 8.0),
        ("motorcycle", "ahead", 6.0, 7.0, 1.0, 13.0),
        ("car", "ahead", 8.0, 7.5, 1.0, 18.0),
        ("car", "back", 8.0, 7.5, 1.0, 17.0),
    ),
    (
        ("1-cross-right", 19.0, 0.0),
        ("1-cross-left", 10.0, 6.0),
        ("1-cross-right-b", 14.0, 13.0),
        ("1-cross-left-b", 8.0, 22.0),
        ("1-along-left", 20.0, 0.0),
        ("1-along-right", 60.0, 0.0),
        ("1-along-right", 20.0, 4.0),
    ),
)

SITES = (
    DemoSite(
        "junction",
        junction_town,
        32,
        (690_000.0, 5_334_000.0, 0.0),
        48.13,
        11.56,
        (_JUNCTION_BUSY, _JUNCTION_CALM),
    ),
    DemoSite("street", street_town, 32, (513_000.0, 5_402_000.0, 0.0), 48.77, 9.18, (_STREET,)),
)


def traffic_of(scene: Scene, town: Town) -> Traffic:
    """Everybody of a scene in their town, ready to be simulated."""
    return Traffic(
        town,
        [
            Driver(category, town.paths[path], s, v, eager, start)
            for category, path, s, v, eager, start in scene.drivers
        ],
        [Walker(town.walks[walk], start, s) for walk, s, start in scene.walkers],
    )
