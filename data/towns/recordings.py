"""A random town as a store of its own: recordings, their conversion, and the traffic lights.

DSC3D has no traffic lights, so they join the recordings after the conversion.
"""

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from hashlib import blake2b
from pathlib import Path

import numpy as np

from shiftsim.data.demo.files import write_site
from shiftsim.data.demo.lights import Lights
from shiftsim.data.demo.scenes import DemoSite, Scene
from shiftsim.data.readers.dsc3d import convert_dsc3d
from shiftsim.data.readers.samples import ROW_S
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.data.recording import Window
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.data.store.writing import StoreWriter
from shiftsim.data.towns.layouts import KINDS, Place, random_place
from shiftsim.data.towns.people import random_traffic
from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.state import TrafficLights

_DURATION = 42.08  # s, of a recording: five windows
_OVERLAP = 12.0  # s, of consecutive windows
_FIRST = datetime(2032, 1, 1, 8, 0, tzinfo=UTC)
_SPACING = 2000.0  # m between the origins of towns
_ENOUGH = 6  # scenarios that a town must have
_TRIES = 8
_SAME_PLACE = 0.5  # m, both ends together
_MIN_BLOCKS = 2  # of a route; who drives out of town from the first moment on has one


@dataclass(frozen=True)
class MakeTown:
    """Makes towns, each by itself."""

    folder: Path  # where the store of each town is put

    def __call__(self, name: str) -> None:
        """Make the store of one town, named `town-<seed>-<number>`."""
        for attempt in range(_TRIES):
            with tempfile.TemporaryDirectory(prefix="shiftsim-town-") as scratch:
                store = Path(scratch) / "store"
                try:
                    count = _make(name, _generator(name, attempt), Path(scratch) / name, store)
                except ConversionError:  # such as traffic that is not on the road
                    continue
                if count >= _ENOUGH:
                    shutil.move(store, self.folder / name)
                    return
        raise AssertionError(f"no town {name!r} with {_ENOUGH} scenarios in {_TRIES} tries")


def town_names(towns: int, seed: int) -> list[str]:
    """Names of the towns of a seed."""
    return [f"town-{seed}-{number:03d}" for number in range(1, towns + 1)]


def _generator(name: str, attempt: int) -> np.random.Generator:
    """Random numbers that depend on nothing but the town."""
    digest = blake2b(f"{name}\n{attempt}".encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


def _make(name: str, rng: np.random.Generator, source: Path, store: Path) -> int:
    """Generate and convert a town; the number of its scenarios."""
    number = int(name.rpartition("-")[2])
    kinds = list(KINDS)
    place = random_place(kinds[(number - 1) % len(kinds)], name, rng)
    start = (_FIRST + timedelta(hours=number)).strftime("%Y-%m-%dT%H:%M:%S")
    row, column = divmod(number, 100)
    offset = [400_000.0 + _SPACING * column, 5_400_000.0 + _SPACING * row, 0.0]
    scene = Scene(start, _DURATION, "", "")
    site = DemoSite(name, 32, offset, 48.7, 9.0, (scene,))
    write_site(source, site, place.town, [random_traffic(place, rng, _DURATION)])
    config = ConversionConfig(overlap_s=_OVERLAP)
    report = convert_dsc3d(source, store, site=name, options=config)
    if place.lights and report.accepted:
        _add_lights(store, f"{name}_{scene.name}", place, np.array(offset[:2]))
    return len(usable(ScenarioStore(store))) if report.accepted else 0


def usable(store: ScenarioStore) -> list[Window]:
    """Scenarios of a town whose route all planners can follow."""
    windows = map(store.window, store.tokens)
    return [window for window in windows if len(window.route) >= _MIN_BLOCKS]


def _add_lights(store: Path, recording: str, place: Place, offset: FloatArray) -> None:
    """Write what the traffic lights showed into a recording."""
    opened = ScenarioStore(store)
    road = opened.map(place.town.name)
    stored = opened.recording(recording)
    found = stored.read(0, stored.num_rows)
    seconds = (np.arange(stored.num_rows) * ROW_S).tolist()
    names, columns = [], []
    for edge, lights, phase in _lit_connectors(road, place, offset):
        names.append(road.edges.ids[edge])
        columns.append([int(lights.status(phase, time)) for time in seconds])
    status = np.array(columns, np.int8).T
    with StoreWriter(store) as writer:
        writer.add_recording(replace(found, lights=TrafficLights(tuple(names), status)))


def _lit_connectors(
    road: VectorMap, place: Place, offset: FloatArray
) -> Iterator[tuple[int, Lights, int]]:
    """Connectors of the map that have a light, whose lights, and their phase."""
    ends = {
        number: np.concatenate([line[0], line[-1]])
        for number, spec in place.town.network.roads.items()
        if spec.junction >= 0
        for line in [spec.center_of(-1, np.array([0.0, spec.length]))[:, :2] + offset]
    }
    numbers, places = list(ends), np.array(list(ends.values()))
    for edge in range(road.num_lanes, len(road.edges)):
        line = road.baselines.at(edge)
        gaps = np.hypot(*(places - np.concatenate([line[0], line[-1]])).reshape(-1, 2, 2).T).sum(0)
        number = numbers[int(gaps.argmin())]
        assert gaps.min() < _SAME_PLACE, f"{road.name}: connector {road.edges.ids[edge]}"
        for lights in place.lights:
            for phase, group in enumerate(lights.phases):
                if number in group:
                    yield edge, lights, phase
