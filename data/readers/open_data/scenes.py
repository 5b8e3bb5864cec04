"""Scenes of open data sets to scenarios of a store: what all readers share.

A reader makes a `Scene` of each of its recordings: tracks, map, lights, and whose licence holds.
Scenes are converted one by one, in any order and in any process; the bytes are the same.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol

from shiftsim._version import __version__
from shiftsim.data.maps.build import PieceMap
from shiftsim.data.maps.lights import LightStates, light_rows
from shiftsim.data.readers.deepplan.convert import Progress, Spread, one_by_one
from shiftsim.data.readers.deepplan.parts import ConversionFailure, alone_in
from shiftsim.data.readers.deepplan.recording import Converted
from shiftsim.data.readers.deepplan.windows import ConversionConfig
from shiftsim.data.readers.tracks.samples import TrackSamples
from shiftsim.data.readers.tracks.scenarios import make_scenarios, write_converted
from shiftsim.data.store.schema import VERSION
from shiftsim.data.store.tables import digest
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConversionError, DataError
from shiftsim.world.map import VectorMap

_SAVE_EVERY = 1000  # scenes; what is saved is not converted again
# a recording car is an ego whatever it does, also standing
_RECORDED = ConversionConfig(min_peak_speed=0.0, max_overlap=1e6)


@dataclass(frozen=True)
class Scene:
    """One recording with its map, in the frame of the map."""

    samples: TrackSamples
    map: PieceMap
    egos: tuple[str, ...] | None = None  # ids of the recording cars; None where there is none
    lights: LightStates | None = None
    left_out_s: float = 0.0  # time at its end that no scenario reaches [s]
    metadata: Mapping[str, object] = field(default_factory=dict)  # source, licence and so on
    warnings: Mapping[str, int] = field(default_factory=dict)  # what the reader left out, by kind


class Reader(Protocol):
    """What a data set offers. It must pickle."""

    def find(self, folder: Path) -> list[Path]:
        """What names each scene of a folder, sorted.

        Raises:
            ConversionError: There is none.
        """

    def files(self, path: Path) -> list[Path]:
        """The files that a scene is read from."""

    def read(self, path: Path) -> Scene:
        """One scene.

        Raises:
            DataError: A file is missing or broken, or contradicts itself.
        """


class Made(NamedTuple):
    """One scene, ready for the store."""

    road: VectorMap
    converted: Converted
    warnings: Mapping[str, int]


@dataclass
class OpenReport:
    """What became of the scenes of a folder."""

    scenes: int = 0  # scenes that were converted
    scenarios: int = 0
    kept: int = 0  # scenes that the store had from an earlier call
    without: int = 0  # converted scenes without any scenario
    rejected: Counter[str] = field(default_factory=Counter)  # egos by the rule that they fail
    warnings: Counter[str] = field(default_factory=Counter)  # what was repaired, by kind
    failed: dict[str, str] = field(default_factory=dict)  # why, by scene


def convert_scenes(
    reader: Reader,
    folder: Path,
    store: Path,
    *,
    vehicles: bool = False,
    progress: Progress | None = None,
    spread: Spread = one_by_one,
) -> OpenReport:
    """Convert all scenes of a folder to scenarios in a store.

    A scene that is broken is skipped and named; what was converted before from the same files with
    the same options is kept, also from a conversion that was killed.

    Args:
        reader: The data set.
        folder: Where its files are.
        store: The store, made or extended.
        vehicles: Whether every vehicle that drives is an ego, not the recording car alone.
        progress: Called with scenes done, scenes in all and the name of the last one.
        spread: How scenes are spread over processes; one by one in this process by default.

    Raises:
        ConversionError: The folder has no scene, or none of them can be converted.
    """
    paths = reader.find(folder)
    show = progress or (lambda done, total, name: None)
    report, first = OpenReport(), ConversionFailure("")
    with alone_in(store):
        writer = StoreWriter(store)
        keys = {str(path): _key(reader, path, vehicles) for path in paths}
        have = {writer.window(token).metadata.get("source_key") for token in writer.tokens}
        todo = [name for name, key in keys.items() if key not in have]
        report.kept = len(paths) - len(todo)
        maps: set[str] = set()
        for done, outcome in enumerate(spread(partial(_Converter, reader, vehicles, keys), todo)):
            show(report.kept + done + 1, len(paths), Path(outcome.task).name)
            made = ConversionFailure(outcome.death) if outcome.death else outcome.result
            if isinstance(made, ConversionFailure):
                first = first if report.failed else made
                report.failed[outcome.task] = str(made)
                continue
            _count(report, made)
            if made.converted.windows:
                if made.road.name not in maps:
                    writer.add_map(made.road)
                    maps.add(made.road.name)
                write_converted(writer, made.converted)
            if report.scenes % _SAVE_EVERY == 0:
                writer.close()
        if len(report.failed) == len(paths):
            raise ConversionError(first.reason, first.hint)
        writer.close()
    report.failed = dict(sorted(report.failed.items()))
    return report


def convert_scene(scene: Scene, *, vehicles: bool = False) -> Made:
    """One scene to scenarios.

    Raises:
        DataError: Its ego is not among the tracks.
    """
    egos = None if vehicles else scene.egos
    converted = make_scenarios(
        scene.samples,
        scene.map.road,
        egos=egos,
        config=None if egos is None else _RECORDED,
        left_out_s=scene.left_out_s,
    )
    recording = converted.recording
    if scene.lights is not None:
        lights = light_rows(scene.lights, scene.map.lights, recording.time_us)
        recording = replace(recording, lights=lights)
    windows = tuple(
        replace(window, metadata={**window.metadata, **scene.metadata})
        for window in converted.windows
    )
    converted = replace(converted, recording=recording, windows=windows)
    warnings = Counter(scene.map.warnings)
    warnings.update(scene.warnings)
    warnings.update(converted.summary.warnings)
    return Made(scene.map.road, converted, +warnings)


class _Converter:
    """Converts scenes, whatever is wrong with them."""

    def __init__(self, reader: Reader, vehicles: bool, keys: Mapping[str, str]) -> None:
        self.reader, self.vehicles, self.keys = reader, vehicles, keys

    def __call__(self, name: str) -> Made | ConversionFailure:
        try:
            scene = self.reader.read(Path(name))
            scene = replace(scene, metadata={**scene.metadata, "source_key": self.keys[name]})
            return convert_scene(scene, vehicles=self.vehicles)
        except DataError as error:
            return ConversionFailure(error.message, error.hint)
        except MemoryError:
            return ConversionFailure(
                f"{name}: it does not fit into memory", "give the machine more of it"
            )


def _key(reader: Reader, path: Path, vehicles: bool) -> str:
    """Equal where the result is equal."""
    found = [__version__, VERSION, str(path.name), vehicles]
    with suppress(OSError, DataError):  # reading tells what is wrong
        found += [digest(file) for file in reader.files(path)]
    return hashlib.sha256(json.dumps(found).encode()).hexdigest()[:16]


def _count(report: OpenReport, made: Made) -> None:
    report.scenes += 1
    report.scenarios += len(made.converted.windows)
    report.without += not made.converted.windows
    report.rejected.update(made.converted.summary.rejected)
    report.warnings.update(made.warnings)
