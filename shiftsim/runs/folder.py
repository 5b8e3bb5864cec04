"""Writing a run folder: results go to a journal one by one, the tables are made at the end.

`finish` writes the rollouts of the journal into Parquet files, and reads its entries in the order
of the tables, both one by one, so that memory does not grow with the run.
"""

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.errors import ConfigError, DataError
from shiftsim.files import atomic_write, safe_join
from shiftsim.runs.journal import Journal
from shiftsim.runs.results import JOURNAL, Run, open_run, write_manifest
from shiftsim.runs.rollouts import Task, files
from shiftsim.runs.rollouts.files import RolloutLocation, decode_rows
from shiftsim.runs.tables import MISSING, STATUSES, TABLES, TaskResult, stored_results

_ROW_GROUP = 1024  # tasks


class TaskRecord(NamedTuple):
    """A task that has ended."""

    number: int  # its entry in the journal
    status: str  # what became of it
    location: RolloutLocation | None  # of its rollout, where a Parquet file has it already
    has_rollout: bool  # whether the journal has its rollout


class RunWriter:
    """The folder of a run under way; what has `ended` so far includes an earlier attempt."""

    def __init__(self, path: Path, manifest: dict[str, Any], *, resume: bool = False) -> None:
        """Begin a run, or `resume` one; a complete one stays until this one has finished."""
        self.path = path
        path.mkdir(parents=True, exist_ok=True)
        self.rollouts = safe_join(path, files.FOLDER)
        self._journal = Journal(path / JOURNAL, keep=resume)
        self.ended: dict[Task, TaskRecord] = {}
        self._outdated = set[Path]()
        self._read_journal()
        try:
            before = open_run(path)
        except (ConfigError, DataError):
            before = None
        if before is not None and resume and not self.ended:
            self._journal.put_all(map(_entry, stored_results(path)))
            self._read_journal()
        if before is None or not before.is_complete:
            write_manifest(path, manifest | {"state": "running", "counts": {}})
        self.rollouts.mkdir(exist_ok=True)
        self._linked: dict[Path, Path] = {}

    def _read_journal(self) -> None:
        for number, _, rows, has_rollout in self._journal.items():
            result = TaskResult.from_rows(rows, self.rollouts)
            self._note(result, number, has_rollout=has_rollout)

    def _note(self, result: TaskResult, number: int, *, has_rollout: bool) -> None:
        """What has ended; a file that holds an earlier rollout of the task is out of date."""
        before = self.ended.get(result.task)
        if before is not None and before.location is not None:
            self._outdated.add(before.location.file)
        self.ended[result.task] = TaskRecord(number, result.status, result.location, has_rollout)

    def result(self, task: Task) -> TaskResult:
        """What became of a task that has ended, without its rollout."""
        return TaskResult.from_rows(self._journal.values(self.ended[task].number), self.rollouts)

    def add(self, result: TaskResult) -> None:
        """Put a result on disk; a file of another run that holds its rollout is linked to."""
        if result.location is not None:
            file = self._link(result.location.file)
            result = replace(result, location=result.location._replace(file=file))
        number = self._journal.put(*_entry(result), result.rollout)
        self._note(result, number, has_rollout=bool(result.rollout))

    def _link(self, file: Path) -> Path:
        """Have a file of another run in this one too, without its bytes where the disk can."""
        if file not in self._linked:
            target = files.new_file(self.rollouts)
            try:
                os.link(file, target)
            except OSError:
                with atomic_write(target) as partial:
                    shutil.copyfile(file, partial)
            self._linked[file] = target
        return self._linked[file]

    def finish(
        self,
        manifest: dict[str, Any],
        expected: Iterable[Task],
        reasons: Mapping[Task, str] = MappingProxyType({}),
        default: str = "the run was interrupted",
    ) -> Run:
        """Write tables and manifest; `reasons`, or the `default`, say why a task has no result."""
        counts = {"expected": 0, **dict.fromkeys(STATUSES, 0)}
        locations = self._write_rollouts()
        tasks = iter(sorted(expected))
        with ExitStack() as stack:
            tables = {}
            for name, schema in TABLES.items():
                path = stack.enter_context(atomic_write(self.path / f"{name}.parquet"))
                table = pq.ParquetWriter(path, schema, compression="zstd", compression_level=3)
                tables[name] = stack.enter_context(table)
            while chunk := list(islice(tasks, _ROW_GROUP)):
                rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
                for task in chunk:
                    if task in self.ended:
                        result = replace(self.result(task), location=locations.get(task))
                    else:
                        result = TaskResult(task, MISSING, error=reasons.get(task, default))
                    counts["expected"] += 1
                    counts[result.status] += 1
                    for name, found in result.rows().items():
                        rows[name] += found
                for name, table in tables.items():
                    table.write_table(pa.Table.from_pylist(rows[name], TABLES[name]))
        write_manifest(self.path, {**manifest, "counts": counts})
        self._journal.remove()  # what it points to is needed until then
        used = {location.file for location in locations.values()}
        for path in self.rollouts.iterdir():
            if path not in used:
                path.unlink()
        return open_run(self.path)

    def close(self) -> None:
        """Let another process work on the folder."""
        self._journal.close()

    def _write_rollouts(self) -> dict[Task, RolloutLocation]:
        """Put rollouts into files by scenario; one that others have left is written anew."""
        order = sorted(self.ended, key=lambda task: (task.token, task))
        locations = {
            task: location
            for task in order
            if (location := self.ended[task].location) and location.file not in self._outdated
        }
        reader = files.RolloutReader()

        def moved() -> Iterator[tuple[Task, pa.RecordBatch]]:
            for task, record in ((task, self.ended[task]) for task in order):
                if task not in locations and record.location:
                    yield task, reader.read(record.location)
                elif task not in locations and record.has_rollout:
                    yield task, decode_rows(self._journal.data(record.number))

        return locations | files.write_rollouts(self.rollouts, moved())


def _entry(result: TaskResult) -> tuple[str, dict[str, Any]]:
    """A result as an entry of the journal, without its rollout."""
    return json.dumps(result.task), result.rows()
