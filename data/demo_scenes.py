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


_JUNCTION = Scene(
    "2031-05-04T08-00-00",
    "2031-05-04T08:00:00",
    30.08,
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
        ("car", "east2-north", 8.0, 10.0, 1.0, 11.5),
        ("motorcycle", "east2-west", 8.0, 10.0, 1.0, 14.0),
        ("bicycle", "west2-east-bicycle", 6.0, 4.0, 1.0, 12.0),
        ("bus", "east1-west", 9.0, 8.0, 0.75, 18.0),
    ),
    (
        ("1-cross-right", 18.0, 0.0),
        ("2-cross-left", 22.0, 0.0),
        ("3-cross-left", 14.0, 12.0),
        ("4-cross-right-b", 12.0, 8.0),
        ("1-along-left", 10.0, 0.0),
        ("3-along-right", 20.0, 0.0),
        ("4-along-left", 5.0, 3.0),
    ),
)

_STREET = Scene(
    "2031-06-15T17-45-00",
    "2031-06-15T17:45:00",
    30.08,
    (
        ("car", "west1-east", 52.0, 7.0, 1.0, 0.0),
        ("truck", "west1-east", 28.0, 6.5, 0.95, 0.0),
        ("car", "west1-east", 8.0, 7.0, 1.0, 0.0),
        ("car", "east1-west", 60.0, 7.0, 1.0, 0.0),
        ("pickup", "east1-west", 14.0, 7.0, 0.95, 0.0),
        ("bicycle", "east1-west-bicycle", 100.0, 4.2, 1.0, 0.0),
        ("van", "side1-east", 6.0, 4.5, 1.0, 8.0),
        ("car", "west1-east", 8.0, 7.5, 1.1, 6.0),
        ("bus", "east1-west", 8.0, 6.5, 0.9, 5.0),
        ("motorcycle", "west1-side", 6.0, 7.0, 1.0, 12.0),
        ("car", "east1-side", 8.0, 7.0, 1.0, 10.5),
    ),
    (
        ("1-cross-right", 19.0, 0.0),
        ("1-cross-left", 10.0, 4.0),
        ("3-cross-right-b", 14.0, 9.0),
        ("1-along-left", 12.0, 0.0),
        ("3-along-right", 30.0, 0.0),
        ("3-along-left", 20.0, 4.0),
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
        (_JUNCTION,),
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
