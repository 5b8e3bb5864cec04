"""The journal of a run under way: every result is on disk when it ends.

A result is one line of text; its rollout is appended to a second file before that line is written.
So a run can be killed at any moment: the lines, without a last one that was cut off, are what is
finished. Both files go when the tables are written.
"""

import errno
import json
import os
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import pyarrow as pa

from shiftsim.errors import ConfigError, DataError
from shiftsim.files import whole_file
from shiftsim.runs.results import PLACE, TEXTS, TaskResult, open_run, stored_results
from shiftsim.runs.rollouts import Task, decode_rollout

JOURNAL = "unfinished.jsonl"
ROLLOUTS = "unfinished.rollouts"  # encoded, one after the other
_FIELDS = (*TEXTS, "seconds", "scores", "metrics")


class Line(NamedTuple):
    """A line of the journal.

    Attributes:
        offset: Its first byte.
        length: Its bytes.
        status: What became of the task.
        rollout: Where its rollout is, empty where none is stored: `offset, length` in the second
            file; or file, row and number of rows where a Parquet file has it already.
    """

    offset: int
    length: int
    status: str
    rollout: tuple[Any, ...]

    @property
    def has_place(self) -> bool:
        """Whether a Parquet file has the rollout."""
        return len(self.rollout) == len(PLACE)


class Journal:
    """What is finished of a run.

    Attributes:
        lines: The last line of every task that has ended.
    """

    def __init__(self, folder: Path, *, resume: bool) -> None:
        """Begin a journal, or go on with one.

        Args:
            folder: The run folder.
            resume: Keep what is in it; the tables of a run that has ended become a journal again.

        Raises:
            ConfigError: Another process works on this folder.
        """
        self.folder = folder
        if resume:
            _restore(folder)
        self._text = _Appended(_locked(folder / JOURNAL))
        self._rollouts = _Appended((folder / ROLLOUTS).open("a+b", buffering=0))
        self.lines: dict[Task, Line] = {}
        if resume:
            self._scan()
        self._text.cut(max((sum(line[:2]) for line in self.lines.values()), default=0))
        spooled = (x.rollout for x in self.lines.values() if x.rollout and not x.has_place)
        self._rollouts.cut(max(map(sum, spooled), default=0))

    def _scan(self) -> None:
        """Read the lines up to one that was cut off, or whose rollout a power failure took."""
        end, stored = 0, os.fstat(self._rollouts.file.fileno()).st_size
        self._text.file.seek(0)
        with open(self._text.file.fileno(), "rb", closefd=False) as reader:
            for text in reader:
                try:
                    values = json.loads(text)
                    line = Line(end, len(text), values["status"], tuple(values["rollout"]))
                    task = Task(*values["task"])
                except (ValueError, KeyError, TypeError):
                    break
                lost = not line.has_place and sum(line.rollout) > stored
                if lost or not text.endswith(b"\n"):
                    break
                self.lines[task] = line
                end += len(text)

    def add(self, result: TaskResult, place: tuple[str, int, int] | tuple[()] = ()) -> None:
        """Put a result on disk.

        Args:
            result: The result.
            place: File, row and number of rows of its rollout, where a file has it already.

        Raises:
            OSError: The disk is full; what is there already stays.
        """
        rollout = self._rollouts.append(result.rollout) if result.rollout else place
        span = self._text.append(_text(result, rollout))
        self.lines[result.task] = Line(*span, result.status, rollout)

    def read(self, line: Line) -> dict[str, Any]:
        """A line: the fields of a result, but of the rollout only where it is."""
        values: dict[str, Any] = json.loads(self._text.read(line.offset, line.length))
        return values

    def rollout(self, line: Line) -> pa.RecordBatch:
        """The rollout of a line that has no place in a Parquet file yet, a row per sample."""
        offset, length = line.rollout
        return decode_rollout(self._rollouts.read(offset, length))

    def close(self) -> None:
        """Let another process work on the folder."""
        self._rollouts.file.close()
        self._text.file.close()

    def remove(self) -> None:
        """Close it, and remove it from disk; first the file without which the other is nothing."""
        (self.folder / JOURNAL).unlink()
        (self.folder / ROLLOUTS).unlink()
        self.close()


class _Appended:
    """A file that grows at its end, by a piece as a whole or not at all."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self._end = 0

    def append(self, data: bytes) -> tuple[int, int]:
        """Write a piece; returns its offset and length."""
        try:
            if self.file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:  # without half a piece, the next attempt can go on
            with suppress(OSError):
                self.file.truncate(self._end)
            raise
        self._end += len(data)
        return self._end - len(data), len(data)

    def read(self, offset: int, length: int) -> bytes:
        self.file.seek(offset)
        return self.file.read(length)

    def cut(self, end: int) -> None:
        """Drop what follows."""
        self.file.truncate(end)
        self._end = end


def _text(result: TaskResult, rollout: tuple[Any, ...]) -> bytes:
    values = {field: getattr(result, field) for field in _FIELDS}
    line = {"task": result.task, "rollout": rollout, **values}
    return (json.dumps(line, default=_plain) + "\n").encode()


def _plain(value: Any) -> Any:
    """NumPy scalars as Python's."""
    return value.item()


def _locked(path: Path) -> BinaryIO:
    file = path.open("a+b", buffering=0)
    if sys.platform == "win32":
        return file
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise ConfigError(
            f"another process is working on {str(path.parent)!r}",
            hint="wait for it, or choose another --out",
        ) from error
    except OSError:
        pass  # a file system without locks
    return file


def _restore(folder: Path) -> None:
    """Turn the tables of a finished or interrupted run into a journal again."""
    journal = folder / JOURNAL
    if journal.is_file() and journal.stat().st_size:
        return
    try:
        open_run(folder)
    except (ConfigError, DataError):
        return
    with whole_file(journal) as partial, partial.open("wb") as file:
        for result, place in stored_results(folder):
            file.write(_text(result, (place.file.name, place.row, place.rows) if place else ()))
