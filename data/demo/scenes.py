"""What happens in the recordings of the demo: `scenes.toml`, as traffic in generated towns."""

from dataclasses import dataclass
from pathlib import Path

from shiftsim.data.demo.agents import Driver, Walker
from shiftsim.data.demo.network import Town
from shiftsim.data.demo.towns import TOWNS
from shiftsim.data.demo.traffic import Traffic
from shiftsim.files import read_toml


@dataclass(frozen=True)
class Scene:
    """One recording."""

    start: str  # UTC time of the first frame
    duration: float  # [s]
    drivers: str  # one line each, as `scenes.toml` says
    walkers: str  # likewise

    @property
    def name(self) -> str:
        """Name of the recording, as DSC3D forms them."""
        return self.start.replace(":", "-")


@dataclass(frozen=True)
class DemoSite:
    """One generated town with its recordings; `offset` is the UTM position of its origin [m]."""

    name: str
    zone: int
    offset: list[float]
    latitude: float
    longitude: float
    scenes: tuple[Scene, ...]

    def town(self) -> Town:
        """The town, made anew."""
        return TOWNS[self.name]()


def demo_sites() -> tuple[DemoSite, ...]:
    """All towns of the demo."""
    sites = read_toml(Path(__file__).with_suffix(".toml"))["site"]
    return tuple(
        DemoSite(**{**site, "scenes": tuple(Scene(**scene) for scene in site["scenes"])})
        for site in sites
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
