"""Writing a run folder: every result is on disk when it ends, the tables are made at the end.

A result is one line of a journal, written at once; its rollout is a file of its own, in place
before that line. So a run can be killed at any moment: the journal, without a last line that was
cut off, is what is finished. `finish` reads it task by task in the order of the tables, so that
memory does not grow with the run; then the journal is removed.
"""

import hashlib
import json
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.errors import ConfigError, DataError
from shiftsim.results import JOURNAL, MISSING, OK, STATUSES, TABLES, Run, TaskResult, open_run
from shiftsim.rollouts import Task

WRITE_OPTIONS: dict[str, Any] = {
    "compression": "zstd",
    "compression_level": 3,
    "version": "2.6",
    "data_page_version": "1.0",
    "use_dictionary": True,
    "write_statistics": True,
}
ROW_GROUP = 1 << 16  # rows
_CHUNK = 256  # results turned into tables at once
_MAX_TOKEN = 60  # characters of a token in a file name
_TEXTS = ("status", "scenario_type", "error", "hint", "traceback")
_FIELDS = (*_TEXTS, "seconds", "scores", "metrics")
_DURATIONS = [n for n in TABLES["tasks"].names if n.endswith("_seconds") or "_ms_" in n]


class _Place(NamedTuple):
    """Where the line of a task is in the journal."""

    offset: int
    length: int
    status: str


def rollout_name(task: Task) -> str:
    """File name of a rollout: the beginning of its token, and a digest of the task."""
    digest = hashlib.blake2b(repr(tuple(task)).encode(), digest_size=8).hexdigest()
    return f"{re.sub(r'[^A-Za-z0-9_-]', '-', task.token)[:_MAX_TOKEN]}-{digest}.parquet"


class RunWriter:
    """The folder of a run under way.

    Attributes:
        path: The folder.
        ended: Status of every task that has ended, those of an earlier attempt included.
    """

    def __init__(self, path: Path, manifest: dict[str, Any], *, resume: bool = False) -> None:
        """Begin a run, or go on with one.

        Args:
            path: Its folder.
            manifest: Says what the run is; written as `running`, unless a complete run is there,
                which stays as it is until this one has finished as well.
            resume: Keep what is finished.

        Raises:
            ConfigError: Another process works on this folder.
        """
        self.path = path
        self.rollouts = path / "rollouts"
        path.mkdir(parents=True, exist_ok=True)
        if resume:
            _restore_journal(path)
        self._file = _locked(path / JOURNAL)
        if not resume:
            self._file.truncate(0)
        places, self._end = _scan(self._file)
        self._file.truncate(self._end)
        self.ended = {task: place.status for task, place in places.items()}
        if not _is_complete(path):
            self._write_manifest(manifest | {"state": "running", "counts": {}})
        self.rollouts.mkdir(exist_ok=True)

    def add(self, result: TaskResult, *, rollout: Path | None = None) -> None:
        """Put one result on disk.

        Args:
            result: The result.
            rollout: File of its rollout, where it is stored already in another run.
        """
        name = rollout_name(result.task) if result.rollout or rollout else None
        if result.rollout and name:
            with _whole(self.rollouts / name) as partial:
                partial.write_bytes(result.rollout)
        elif rollout and name:
            _link(rollout, self.rollouts / name)
        data = _line(result, name).encode()
        try:
            self._file.write(data)
        except OSError:  # the disk is full: without half a line, the next attempt can go on
            with suppress(OSError):
                self._file.truncate(self._end)
            raise
        self._end += len(data)
        self.ended[result.task] = result.status

    def finish(
        self,
        manifest: dict[str, Any],
        expected: Iterable[Task],
        absent: Callable[[Task], str] = lambda task: "the run was interrupted",
    ) -> Run:
        """Write tables and manifest.

        Args:
            manifest: The manifest; its `counts` are filled in.
            expected: All tasks of a complete run.
            absent: Why a task has no result.
        """
        places, _ = _scan(self._file)
        counts = {"expected": 0, **dict.fromkeys(STATUSES, 0)}
        tables = [_SortedTable(self.path / f"{name}.parquet", TABLES[name]) for name in TABLES]
        kept: set[str] = set()
        try:
            lines = self._lines(sorted(expected), places, absent)
            while chunk := list(islice(lines, _CHUNK)):
                for line in chunk:
                    counts["expected"] += 1
                    counts[line["status"]] += 1
                    kept.add(line["rollout"])
                for table, rows in zip(tables, _rows(chunk), strict=True):
                    table.add(rows)
            for table in tables:
                table.close()
        finally:
            for table in tables:
                table.discard()
        self._write_manifest({**manifest, "counts": counts})
        for path in self.rollouts.iterdir():
            if path.name not in kept:
                path.unlink()
        (self.path / JOURNAL).unlink()
        self.close()
        return open_run(self.path)

    def close(self) -> None:
        """Let another process work on the folder."""
        self._file.close()

    def _lines(
        self, tasks: Iterable[Task], places: dict[Task, _Place], absent: Callable[[Task], str]
    ) -> Iterator[dict[str, Any]]:
        for task in tasks:
            place = places.get(task)
            if place is None:
                values = TaskResult(task, MISSING, error=absent(task))
                line = {field: getattr(values, field) for field in _FIELDS} | {"rollout": None}
            else:
                self._file.seek(place.offset)
                line = json.loads(self._file.read(place.length))
            yield {**line, "key": task._asdict()}

    def _write_manifest(self, manifest: dict[str, Any]) -> None:
        with _whole(self.path / "manifest.json") as partial:
            partial.write_text(json.dumps(manifest, indent=2, ensure_ascii=False) + "\n", "utf-8")


def _rows(lines: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], ...]:
    """Rows of the tables, in the order of `TABLES`."""
    names = (*_TEXTS, "rollout")
    done = [line for line in lines if line["status"] == OK]
    return (
        [{**x["key"], **{name: x[name] for name in names}, **x["seconds"]} for x in lines],
        [{**x["key"], **x["scores"]} for x in done],
        [{**x["key"], **row} for x in done for row in x["metrics"]],
    )


class _SortedTable:
    """A table that grows at its end; the file is there when it is closed, and not before.

    Row groups are cut at fixed places whatever the pieces were.
    """

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self.path, self.schema = path, schema
        self._partial = path.with_name(f".{path.name}.tmp")
        self._writer = pq.ParquetWriter(self._partial, schema, **WRITE_OPTIONS)
        self._pending = schema.empty_table()

    def add(self, rows: list[dict[str, Any]]) -> None:
        self.add_table(pa.Table.from_pylist(rows, self.schema))

    def add_table(self, table: pa.Table) -> None:
        self._pending = pa.concat_tables([self._pending, table])
        while len(self._pending) >= ROW_GROUP:
            self._write(ROW_GROUP)

    def _write(self, count: int) -> None:
        group = self._pending.slice(0, count).combine_chunks()
        self._writer.write_table(group, row_group_size=ROW_GROUP)
        self._pending = self._pending.slice(count)

    def close(self) -> None:
        self._write(len(self._pending))
        self._writer.close()
        self._partial.replace(self.path)

    def discard(self) -> None:
        """Remove what is not finished."""
        with suppress(OSError):
            self._writer.close()
        self._partial.unlink(missing_ok=True)


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A file to be written, which then takes its place: whole or not at all."""
    partial = path.with_name(f".{path.name}.tmp")
    try:
        yield partial
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _link(source: Path, target: Path) -> None:
    """The same file once more, without its bytes where the disk can do that."""
    if target.exists() and target.samefile(source):
        return
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        with _whole(target) as partial:
            shutil.copyfile(source, partial)


def _line(result: TaskResult, rollout: str | None) -> str:
    """A line of the journal."""
    values = {field: getattr(result, field) for field in _FIELDS}
    line = {"task": result.task, "rollout": rollout, **values}
    return json.dumps(line, default=_plain) + "\n"


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


def _scan(file: BinaryIO) -> tuple[dict[Task, _Place], int]:
    """Where the last line of every task is, and where the last whole line ends."""
    places: dict[Task, _Place] = {}
    end = 0
    file.seek(0)
    with open(file.fileno(), "rb", closefd=False) as reader:
        for line in reader:
            try:
                values = json.loads(line)
                task, status = Task(*values["task"]), values["status"]
            except (ValueError, KeyError, TypeError):
                break
            if not line.endswith(b"\n"):
                break
            places[task] = _Place(end, len(line), status)
            end += len(line)
    return places, end


def _is_complete(path: Path) -> bool:
    try:
        return open_run(path).is_complete
    except (ConfigError, DataError):
        return False


def _restore_journal(path: Path) -> None:
    """Turn the tables of a finished or interrupted run into a journal again."""
    journal = path / JOURNAL
    if journal.is_file() and journal.stat().st_size:
        return
    try:
        open_run(path)
    except (ConfigError, DataError):
        return
    with _whole(journal) as partial, partial.open("w", encoding="utf-8") as file:
        for result, rollout in stored_results(path):
            file.write(_line(result, rollout.name if rollout else None))


def stored_results(path: Path) -> Iterator[tuple[TaskResult, Path | None]]:
    """What made the tables of a run, task by task, and the file of the rollout.

    A task without a result has none.
    """
    scores, metrics = (_by_task(path / f"{name}.parquet") for name in ("scores", "metrics"))
    for key, (row,) in _by_task(path / "tasks.parquet"):
        if row["status"] == MISSING:
            continue
        done = row["status"] == OK
        result = TaskResult(
            Task(*key),
            **{name: row[name] for name in _TEXTS},
            seconds={name: row[name] for name in _DURATIONS if row[name] is not None},
            scores=next(scores)[1][0] if done else {},
            metrics=next(metrics)[1] if done else [],
        )
        yield result, path / "rollouts" / row["rollout"] if row["rollout"] else None


def _by_task(path: Path) -> Iterator[tuple[tuple[Any, ...], list[dict[str, Any]]]]:
    key = itemgetter(*Task._fields)
    batches = pq.ParquetFile(path).iter_batches(batch_size=4096)
    rows = (row for batch in batches for row in batch.to_pylist())
    for found, group in groupby(rows, key):
        yield found, [{n: v for n, v in row.items() if n not in Task._fields} for row in group]
