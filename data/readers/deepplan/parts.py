"""Recordings of a site, each converted by itself into a folder that appears in one step.

The folders wait below `.partial` until the whole site is done. Nothing here depends on the order of
the recordings, or on which process converts them.
"""

import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shiftsim._version import __version__
from shiftsim.data.readers.deepplan.recording import convert_recording
from shiftsim.data.readers.deepplan.windows import ConversionConfig
from shiftsim.data.readers.dsc3d.recording import Annotations, Site, read_recording
from shiftsim.data.store import schema
from shiftsim.data.store.map import read_map_file
from shiftsim.data.store.tables import digest, file_name
from shiftsim.data.store.tracks import write_ego, write_recording
from shiftsim.data.store.writing import StoreWriter, window_row
from shiftsim.errors import DataError

MAP_FILE = "map.parquet"
_PART, _FILES = "part.json", "files"


@dataclass(frozen=True)
class ConversionFailure:
    """A recording that cannot be converted."""

    reason: str
    hint: str = ""

    def __str__(self) -> str:
        return f"{self.reason} ({self.hint})" if self.hint else self.reason


class LastRecording:
    """Keeps a recording from the first reading to the second, where one process does both."""

    def __init__(self) -> None:
        self.found: tuple[str, Annotations] | None = None

    def __reduce__(self) -> tuple[type["LastRecording"], tuple[()]]:
        """Recordings do not travel between processes."""
        return type(self), ()

    def take(self, name: str) -> Annotations | None:
        """The recording, if it is the one that was kept; nothing is kept any more."""
        found, self.found = self.found, None
        return found[1] if found is not None and found[0] == name else None


def try_read(source: Site, name: str, config: ConversionConfig) -> Annotations | ConversionFailure:
    """A recording, or why it cannot be read."""
    try:
        return read_recording(source, name, config.category_map)
    except DataError as error:
        return ConversionFailure(error.message.replace(f"{source.folder}{os.sep}", ""), error.hint)
    except MemoryError:
        return ConversionFailure("it does not fit into memory", "split the recording")


@dataclass(frozen=True)
class Job:
    """What the conversion of each recording of a site depends on, and where it is put."""

    source: Site
    work: Path
    config: ConversionConfig
    map_digest: str
    last: LastRecording

    def key(self, name: str) -> str:
        """Equal where the result is equal."""
        folder = self.source.folder / "annotations" / name
        depends = {
            "version": [__version__, schema.VERSION],
            "site": [self.work.name, *self.source.offset.tolist()],
            "rate": [self.source.frame_rate, self.source.frame_distance],
            "config": asdict(self.config),
            "map": self.map_digest,
            "files": [digest(folder / f"{part}.parquet") for part in ("annotations", "frames")],
        }
        return hashlib.sha256(json.dumps(depends, sort_keys=True).encode()).hexdigest()

    def folder(self, name: str) -> Path:
        """Where the result is until the end."""
        return self.work / file_name(name)

    def is_staged(self, name: str) -> bool:
        """Whether an interrupted conversion left the result."""
        try:
            part = json.loads((self.folder(name) / _PART).read_text("utf-8"))
            return bool(part["key"] == self.key(name)) and (self.folder(name) / _FILES).is_dir()
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def kept(self, report: dict[str, Any], names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """What the store holds already, by name."""
        before = report.get("recordings", {})
        return {n: before[n] for n in names if n in before and before[n]["key"] == self.key(n)}

    def merge(self, name: str, writer: StoreWriter) -> dict[str, Any]:
        """Move a result into the store."""
        part = json.loads((self.folder(name) / _PART).read_text("utf-8"))
        writer.take_recording(self.folder(name) / _FILES, part["log_name"], part["windows"])
        return {"key": part["key"], "summary": part["summary"]}


class Converter:
    """Converts recordings of one site, each into a folder of its own."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.road = read_map_file(job.work / MAP_FILE)

    def __call__(self, name: str) -> ConversionFailure | None:
        """Convert one recording; the folder appears when it is complete."""
        job = self.job
        recording = job.last.take(name) or try_read(job.source, name, job.config)
        if isinstance(recording, ConversionFailure):
            return recording
        result = convert_recording(recording, self.road, job.source.offset[:2], job.config)
        # A process that outlives a killed conversion writes beside its successor, never into it.
        draft = Path(tempfile.mkdtemp(prefix=".", dir=job.work))
        write_recording(draft / _FILES, result.recording)
        for ego in result.egos:
            write_ego(draft / _FILES, ego)
        content = {
            "key": job.key(name),
            "log_name": result.recording.log_name,
            "summary": asdict(result.summary),
            "windows": [window_row(window, self.road.name) for window in result.windows],
        }
        (draft / _PART).write_text(json.dumps(content), "utf-8")
        shutil.rmtree(job.folder(name), ignore_errors=True)
        os.replace(draft, job.folder(name))
        return None


@contextmanager
def alone_in(store: Path) -> Iterator[None]:
    """Keeps other conversions out of a store; the system ends that with this process."""
    store.mkdir(parents=True, exist_ok=True)
    if sys.platform == "win32":
        yield
        return
    import fcntl

    handle = os.open(store, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise DataError(
            f"{store}: another conversion writes to this store", "wait until it has finished"
        ) from error
    try:
        yield
    finally:
        os.close(handle)
