"""Writing a run folder: results go to a journal one by one, the tables are made at the end.

`finish` writes the rollouts of the journal into Parquet files, and reads its entries in the order
of the tables, both one by one, so that memory does not grow with the run.
"""

import json
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.errors import ConfigError, DataError
from shiftsim.files import below, draft, whole_file, write_text
from shiftsim.runs.journal import Journal
from shiftsim.runs.results import (
    JOURNAL,
    MISSING,
    OK,
    PLACE,
    STATUSES,
    TABLES,
    TEXTS,
    Run,
    TaskResult,
    open_run,
    stored_results,
)
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.columns import decode_rows
from shiftsim.runs.rollouts.files import (
    FOLDER,
    PartWriter,
    Place,
    RolloutReader,
    next_number,
    num_rows,
    part_file,
    part_name,
    without_key,
)

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


class TaskRecord(NamedTuple):
    """A task that has ended."""

    number: int  # its entry in the journal
    status: str  # what became of it
    place: Place | None  # where its rollout is, where a Parquet file has it already
    has_rollout: bool  # whether the journal has its rollout


class RunWriter:
    """The folder of a run under way.

    Attributes:
        path: The folder.
        rollouts: The folder of its rollouts.
        ended: What has ended so far, in an earlier attempt included.
    """

    def __init__(self, path: Path, manifest: dict[str, Any], *, resume: bool = False) -> None:
        """Begin a run, or `resume` one: keep what is finished.

        The manifest is written as `running`, unless a complete run is there, which stays as it is
        until this one has finished as well.

        Raises:
            ConfigError: Another process works on this folder.
        """
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        self.rollouts = below(path, FOLDER)
        self._journal = Journal(path / JOURNAL, keep=resume)
        self.ended = dict(self._entries())
        before = _finished(path)
        if before is not None and resume and not self.ended:
            self._journal.put_all(map(_entry, stored_results(path)))
            self.ended = dict(self._entries())
        if before is None or not before.is_complete:
            self._write_manifest(manifest | {"state": "running", "counts": {}})
        self.rollouts.mkdir(exist_ok=True)
        self._number = next_number(self.rollouts)  # of the next file that is linked to
        self._linked: dict[Path, Path] = {}

    def _entries(self) -> Iterator[tuple[Task, TaskRecord]]:
        for number, key, values, has_rollout in self._journal.items():
            place = values["place"] and Place(
                part_file(self.rollouts, values["place"][0]), *values["place"][1:]
            )
            yield Task(*json.loads(key)), TaskRecord(number, values["status"], place, has_rollout)

    def results(self) -> Iterator[TaskResult]:
        """What has ended so far, without the rollouts."""
        for task, ended in self.ended.items():
            values = self._journal.values(ended.number)
            known = {name: values[name] for name in (*TEXTS, "seconds", "scores", "metrics")}
            yield TaskResult(task, **known)

    def add(self, result: TaskResult, *, stored: Place | None = None) -> None:
        """Put one result on disk; its rollout may be `stored` by another run already.

        Raises:
            OSError: The disk is full; what is there already stays.
        """
        place = stored and stored._replace(file=self._link(stored.file))
        number = self._journal.put(*_entry((result, place)), result.rollout)
        self.ended[result.task] = TaskRecord(number, result.status, place, bool(result.rollout))

    def _link(self, file: Path) -> Path:
        """Have a file of another run in this one, too; returns where it is here."""
        if file not in self._linked:
            target = self.rollouts / part_name(self._number)
            _link(file, target)
            self._linked[file], self._number = target, self._number + 1
        return self._linked[file]

    def finish(
        self,
        manifest: dict[str, Any],
        expected: Iterable[Task],
        absent: Callable[[Task], str] = lambda task: "the run was interrupted",
    ) -> Run:
        """Write tables and manifest, whose `counts` are filled in.

        `expected` are all tasks of a complete run; `absent` says why one has no result.
        """
        counts = {"expected": 0, **dict.fromkeys(STATUSES, 0)}
        tables: list[_SortedTable] = []
        try:
            for name, schema in TABLES.items():
                tables.append(_SortedTable(self.path / f"{name}.parquet", schema))
            places = self._write_rollouts()
            tasks = iter(sorted(expected))
            while chunk := list(islice(tasks, _CHUNK)):
                rows = [self._values(task, places.get(task), absent) for task in chunk]
                for values in rows:
                    counts["expected"] += 1
                    counts[values["status"]] += 1
                for table, content in zip(tables, _contents(chunk, rows), strict=True):
                    table.add(content)
            for table in tables:
                table.close()
        finally:
            for table in tables:
                table.discard()
        self._write_manifest({**manifest, "counts": counts})
        self._journal.remove()  # what it points to is needed until then
        used = {place.file for place in places.values()}
        for path in self.rollouts.iterdir():
            if path not in used:
                path.unlink()
        return open_run(self.path)

    def close(self) -> None:
        """Let another process work on the folder."""
        self._journal.close()

    def _values(
        self, task: Task, place: Place | None, absent: Callable[[Task], str]
    ) -> dict[str, Any]:
        """What the tables say of a task beyond its key."""
        if task not in self.ended:
            texts = dict.fromkeys(TEXTS, "") | {"status": MISSING, "error": absent(task)}
            return {**texts, "seconds": {}, **dict.fromkeys(PLACE)}
        columns = (place.file.name, place.row, place.rows) if place else (None, None, None)
        return {
            **self._journal.values(self.ended[task].number),
            **dict(zip(PLACE, columns, strict=True)),
        }

    def _write_rollouts(self) -> dict[Task, Place]:
        """Put the rollouts of a run that ends into files, those of a scenario together.

        A file from an earlier attempt stays as it is, unless some of its rollouts have been made
        again: then the others move.

        Returns:
            Where they are.
        """
        kept: Counter[Path] = Counter()
        for ended in self.ended.values():
            if ended.place:
                kept[ended.place.file] += ended.place.rows
        whole = {file for file, rows in kept.items() if rows == num_rows(file)}
        places: dict[Task, Place] = {}
        writer, reader = PartWriter(self.rollouts), RolloutReader()
        try:
            for task in sorted(self.ended, key=lambda task: (task.token, task)):
                number, _, place, has_rollout = self.ended[task]
                if place and place.file in whole:
                    places[task] = place
                elif place:
                    places[task] = writer.add(task, without_key(reader.read(place)))
                elif has_rollout:
                    places[task] = writer.add(task, decode_rows(self._journal.data(number)))
            writer.close()
        finally:
            writer.discard()
        return places

    def _write_manifest(self, manifest: dict[str, Any]) -> None:
        text = json.dumps(manifest, indent=2, ensure_ascii=False)
        write_text(self.path / "manifest.json", f"{text}\n")


def _entry(found: tuple[TaskResult, Place | None]) -> tuple[str, dict[str, Any]]:
    """A result as the journal has it, without its rollout."""
    result, place = found
    values = {name: getattr(result, name) for name in (*TEXTS, "seconds", "scores", "metrics")}
    values["place"] = place and (place.file.name, place.row, place.rows)
    return json.dumps(result.task), values


def _contents(tasks: list[Task], values: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], ...]:
    """Rows of the tables, in the order of `TABLES`."""
    names = (*TEXTS, *PLACE)
    keyed = [(task._asdict(), row) for task, row in zip(tasks, values, strict=True)]
    done = [(key, row) for key, row in keyed if row["status"] == OK]
    return (
        [{**key, **{name: row[name] for name in names}, **row["seconds"]} for key, row in keyed],
        [{**key, **row["scores"]} for key, row in done],
        [{**key, **metric} for key, row in done for metric in row["metrics"]],
    )


class _SortedTable:
    """A table that grows at its end; the file is there when it is closed, and not before.

    Row groups are cut at fixed places whatever the pieces were.
    """

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self.path, self.schema = path, schema
        self._partial = draft(path)
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
        with suppress(OSError):  # a draft is in nobody's way
            self._partial.unlink(missing_ok=True)


def _link(source: Path, target: Path) -> None:
    """The same file once more, without its bytes where the disk can do that."""
    if target.exists() and target.samefile(source):
        return
    target.unlink(missing_ok=True)
    try:
        os.link(source, target)
    except OSError:
        with whole_file(target) as partial:
            shutil.copyfile(source, partial)


def _finished(path: Path) -> Run | None:
    """The run in a folder, if there is one that has ended."""
    try:
        return open_run(path)
    except (ConfigError, DataError):
        return None
