"""The converter: recordings of any source to scenarios of a store.

Every recording is read once and converted by itself into a folder below `.partial` that appears in
one step; all move into the store at the end. So recordings may be spread over processes, a
conversion that was killed goes on with those that are missing, and the bytes are the same each
time.
"""

import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from shiftsim._version import __version__
from shiftsim.data.readers.reader import Reader
from shiftsim.data.readers.scenarios import RecordingSummary, convert_recording, require_scenarios
from shiftsim.data.store import schema
from shiftsim.data.store.map import write_map
from shiftsim.data.store.reading import read_report
from shiftsim.data.store.recordings import write_ego, write_recording
from shiftsim.data.store.tables import MANIFEST, PARTIAL, digest, file_name, map_file
from shiftsim.data.store.writing import StoreWriter, window_row
from shiftsim.errors import ConversionError, DataError, ShiftsimError
from shiftsim.files import safe_join
from shiftsim.world.map import VectorMap

_PART, _FILES, _MAP = "part.json", "files", "map"

Progress = Callable[[int, int, str], None]
# What a process runs for each recording; made once per process.
Make = Callable[[], Callable[[str], Any]]
# Applies that to names in any order, as `shiftsim.runs.workers.map_unordered` does, and gives the
# `task`, the `result`, and the `death` of the process (empty where it lived) of each.
Executor = Callable[[Make, Sequence[str]], Iterable[Any]]


def serial_map(make: Make, tasks: Sequence[str]) -> Iterator[SimpleNamespace]:
    """What `Executor` means, in this process."""
    function = make()
    yield from (SimpleNamespace(task=task, result=function(task), death="") for task in tasks)


@dataclass
class ConversionReport:
    """What became of the recordings of a source."""

    name: str  # name of the site, which is the name of its map, or of the data set
    lanes: int = 0  # lanes and lane connectors of the map of a site
    recordings: list[RecordingSummary] = field(default_factory=list)  # of those converted
    skipped: dict[str, str] = field(default_factory=dict)  # why, by name, the others are not
    converted: int = 0  # how many recordings this call has converted
    kept: int = 0  # how many were converted before, by an interrupted or an earlier call
    replaced: dict[str, int] = field(default_factory=dict)  # scenarios that recordings had before
    # count by kind of what was repaired in the map
    map_warnings: dict[str, int] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)  # what the reader adds

    def __repr__(self) -> str:
        return (
            f"<ConversionReport {self.name}: {self.accepted} scenarios of {len(self.recordings)} "
            f"recordings, {len(self.skipped)} skipped>"
        )

    @property
    def accepted(self) -> int:
        """Number of scenarios of the recordings."""
        return sum(summary.accepted for summary in self.recordings)

    def count(self, what: str) -> Counter[str]:
        """Sum over the recordings of `rejected` or `warnings`, by kind."""
        total: Counter[str] = Counter()
        for summary in self.recordings:
            total.update(getattr(summary, what))
        return total


def convert(
    reader: Reader,
    store: Path,
    *,
    progress: Progress | None = None,  # gets recordings done, recordings in all, and a name
    executor: Executor = serial_map,  # how recordings are spread over processes
) -> ConversionReport:
    """Convert all recordings of a source to scenarios in a store.

    A recording that is broken is skipped and named; what was converted before from the same files
    with the same settings is kept, also from a conversion that was killed. It is a ConversionError
    if none of the recordings can be converted, or they contradict their map.
    """
    names = reader.recordings()
    show = progress or (lambda done, total, name: None)
    with _locked(store):
        writer = StoreWriter(store)
        work = safe_join(store, f"{PARTIAL}/{file_name(reader.name)}")
        work.mkdir(parents=True, exist_ok=True)
        try:
            report = _convert_into(reader, names, writer, work, show, executor)
        except ShiftsimError:  # nothing of it can be used
            _remove(work)
            raise
        _remove(work)
    return report


def _convert_into(
    reader: Reader,
    names: Sequence[str],
    writer: StoreWriter,
    work: Path,
    show: Progress,
    executor: Executor,
) -> ConversionReport:
    keys = {name: _key(reader, name) for name in names}
    make = partial(_Stage, reader, work, keys)
    stage, site = make(), reader.site
    before = read_report(writer.path, reader.name).get("recordings", {}) if site else {}
    if site is not None and before.keys() - set(names):
        refuse_other_map(writer.path, site.road, reader.source)
    entries = {n: before[n] for n in names if n in before and before[n].get("key") == keys[n]}
    if site is not None:
        known = {entry["key"] for entry in entries.values()}
    else:
        known = {writer.window(token).metadata.get("source_key") for token in writer.tokens}
    waiting = [name for name in names if keys[name] not in known]
    todo = [name for name in waiting if stage.part(name) is None]
    report = ConversionReport(reader.name, kept=len(names) - len(todo))
    show(report.kept, len(names), "")
    failures: dict[str, DataError] = {}
    for done, outcome in enumerate(executor(make, todo), 1):
        show(report.kept + done, len(names), Path(outcome.task).name)
        if outcome.death or outcome.result is not None:
            failures[outcome.task] = outcome.result or ConversionError(outcome.death)
    if len(failures) == len(names):
        first = failures[names[0]]
        others = f"{reader.source}: none of the {len(names)} recordings can be converted; the first"
        where = f"{others} is {names[0]}: " if len(names) > 1 else ""
        raise ConversionError(f"{where}{first.message}", first.hint)
    report.converted = len(todo) - len(failures)
    for name in filter(failures.__contains__, names):
        failure = failures[name]
        report.skipped[name] = failure.message + f" ({failure.hint})" * bool(failure.hint)
    parts = {name: stage.part(name) or {} for name in waiting if name not in failures}
    report.replaced = {n: before[n]["summary"]["accepted"] for n in parts if n in before}
    entries |= {name: part["entry"] for name, part in parts.items()}
    report.details = reader.summarise(list(entries.values()))
    map_warnings = Counter(site.warnings if site is not None else {})
    maps: set[str] = set()
    for name, part in parts.items():
        map_warnings.update(part["map_warnings"])
        if part["windows"]:
            folder, city = stage.folder(name), part["city"]
            writer.take_recording(folder / _FILES, part["log_name"], part["windows"])
            if site is None and city not in maps:
                writer.take_map(folder / _MAP, city)
            maps.add(city)
    report.map_warnings = dict(map_warnings)
    report.recordings = [
        RecordingSummary(**entries[name]["summary"]) for name in names if name in entries
    ]
    if site is not None:
        writer.add_map(site.road)
        report.lanes = len(site.road.edges)
        content = {
            "city": reader.name,
            "lanes": report.lanes,
            "map_warnings": report.map_warnings,
            "recordings": before | entries,
            "skipped": report.skipped,
        }
        writer.add_report(reader.name, content | report.details)
    writer.close()
    return report


def refuse_other_map(store: Path, road: VectorMap, source: Path) -> None:
    """Raise a ConversionError if a store has another map of that name than a source."""
    path = map_file(store, road.name)
    if (store / MANIFEST).is_file() and path.is_file():
        with tempfile.TemporaryDirectory() as folder:  # equal maps have equal bytes
            write_map(written := Path(folder) / _MAP, road)
            if digest(written) != digest(path):
                what = f"{source}: store {store} has another map named {road.name!r}"
                hint = "name this one (--city or --site NAME), or give another --store"
                raise ConversionError(what, hint)


class _Stage:
    """Converts recordings of a source, each into a folder of its own, whatever is wrong."""

    def __init__(self, reader: Reader, work: Path, keys: Mapping[str, str]) -> None:
        self.reader, self.work, self.keys = reader, work, keys

    def folder(self, name: str) -> Path:
        """Where the result is until the end."""
        return self.work / hashlib.sha256(name.encode()).hexdigest()[:32]

    def part(self, name: str) -> dict[str, Any] | None:
        """What is known of the result, if it is there."""
        folder = self.folder(name)
        try:
            part: dict[str, Any] = json.loads((folder / _PART).read_text("utf-8"))
        except (OSError, ValueError):
            return None
        is_complete = not part["windows"] or (folder / _FILES).is_dir()
        return part if is_complete and part["entry"]["key"] == self.keys[name] else None

    def __call__(self, name: str) -> DataError | None:
        """Convert one recording; the folder appears when it is complete."""
        # A process that outlives a killed conversion writes beside its successor, never into it.
        temp_path = Path(tempfile.mkdtemp(prefix=".", dir=self.work))
        try:
            self._write(name, temp_path)
        except DataError as error:
            return error
        except MemoryError:
            what = f"{name}: it does not fit into memory"
            return ConversionError(what, "split the recording, or use less workers")
        finally:
            shutil.rmtree(temp_path, ignore_errors=True)
        return None

    def _write(self, name: str, temp_path: Path) -> None:
        reader, key = self.reader, self.keys[name]
        source = reader.read(name)
        if reader.site is None:  # there is no report that could hold the key
            source = replace(source, metadata={**source.metadata, "source_key": key})
        converted, city = convert_recording(source), source.map.road.name
        if source.needs_scenario:
            require_scenarios(converted.summary, reader.source)
        if converted.windows:
            write_recording(temp_path / _FILES, converted.recording)
            for ego in converted.egos:
                write_ego(temp_path / _FILES, ego)
            if reader.site is None:
                write_map(temp_path / _MAP, source.map.road)
        content = {
            "city": city,
            "log_name": converted.recording.log_name,
            "windows": [window_row(window, city) for window in converted.windows],
            "entry": {"key": key, "summary": asdict(converted.summary), **source.details},
            "map_warnings": {} if reader.site is not None else dict(source.map.warnings),
        }
        (temp_path / _PART).write_text(json.dumps(content), "utf-8")
        shutil.rmtree(self.folder(name), ignore_errors=True)
        os.replace(temp_path, self.folder(name))


def _key(reader: Reader, name: str) -> str:
    """Equal where the result of a recording is equal."""
    content = [__version__, schema.VERSION, Path(name).name, dict(reader.settings)]
    with suppress(OSError, DataError):  # reading reports what is wrong
        content += [digest(file) for file in reader.files(name)]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _remove(work: Path) -> None:
    """Remove the folder of a conversion, and those above it that are empty then."""
    shutil.rmtree(work, ignore_errors=True)
    with suppress(OSError):  # another source was interrupted, or the store holds something
        work.parent.rmdir()
        work.parent.parent.rmdir()


@contextmanager
def _locked(store: Path) -> Iterator[None]:
    """Keeps other conversions out of a store; the system ends that with this process."""
    store.mkdir(parents=True, exist_ok=True)
    if sys.platform == "win32":
        yield
        return
    import fcntl

    handle = os.open(store, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        what = f"{store}: another conversion writes to this store"
        raise DataError(what, "wait until it has finished") from error
    finally:
        os.close(handle)
