"""The tables of a run: the result of a task, the rows it becomes, and reading them back.

`scores.parquet` and `metrics.parquet` hold nothing but results, sorted by task and written with
fixed settings, so that the same run gives the same bytes for any number of workers and any order.
Timings are in `tasks.parquet`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.metrics import SHORT_NAMES
from shiftsim.runs.rollouts import Task, damaged
from shiftsim.runs.rollouts.files import FOLDER, KEY, RolloutLocation, part_file
from shiftsim.world.ranges import RUN, require

OK, FAILED, TIMEOUT, MISSING = STATUSES = ("ok", "failed", "timeout", "missing")

_TEXT, _NUMBER, _INTEGER = pa.string(), pa.float64(), pa.int64()
_PROFILE = {"thresholds": _TEXT, "metric_version": _TEXT}
_TEXTS = ("scenario_type", "status", "error", "hint", "traceback")
_DURATIONS = (
    "read_seconds",
    "simulate_seconds",
    "planner_seconds",
    "planning_ms_mean",
    "planning_ms_p95",
    "metrics_seconds",
)
# file below rollouts/, first row there, rows
LOCATION = {"rollout": _TEXT, "rollout_row": _INTEGER, "rollout_rows": _INTEGER}
TABLES = {
    "tasks": pa.schema(
        KEY | dict.fromkeys(_TEXTS, _TEXT) | dict.fromkeys(_DURATIONS, _NUMBER) | LOCATION
    ),
    "scores": pa.schema(
        {
            **KEY,
            **dict.fromkeys(("scenario_type", "city", "log_name", "traffic"), _TEXT),
            "duration_class": _TEXT,
            "cls": _NUMBER,
            **dict.fromkeys((name for name in SHORT_NAMES if name != "score"), _NUMBER),
            "degraded_steps": _INTEGER,
            **_PROFILE,
        }
    ),
    "metrics": pa.schema(
        {
            **KEY,
            "metric": _TEXT,
            "value": _NUMBER,
            "unit": _TEXT,
            "threshold": _NUMBER,
            "score": _NUMBER,
            "first_violation_iteration": _INTEGER,
            "first_violation_time_us": _INTEGER,
            "first_violation_s": _NUMBER,
            "first_violation_value": _NUMBER,
            "partner_token": _TEXT,
            **_PROFILE,
        }
    ),
}
_RANGES = {  # by column
    **dict.fromkeys(("cls", *SHORT_NAMES), "score"),
    **dict.fromkeys(_DURATIONS, "duration"),
    **{name: name for name in ("degraded_steps", "rollout_row", "rollout_rows")},
}


@dataclass(frozen=True, slots=True)
class TaskResult:
    """What became of one task, from the worker that did it to the tables."""

    task: Task  # the task
    status: str  # one of `STATUSES`
    scenario_type: str = ""  # type of the scenario, where it could be read
    error: str = ""  # what went wrong, empty for `ok`
    hint: str = ""  # what to do about it
    traceback: str = ""  # where it went wrong
    # durations by column name of `tasks.parquet` [s], or [ms] where the name says so
    seconds: dict[str, float] = field(default_factory=dict)
    # the row of `scores.parquet` beyond the key; empty unless `ok`
    scores: dict[str, Any] = field(default_factory=dict)
    # the rows of `metrics.parquet` beyond the key
    metrics: list[dict[str, Any]] = field(default_factory=list)
    rollout: bytes = b""  # the rollout, encoded; empty where it is not stored, or stored elsewhere
    location: RolloutLocation | None = None  # of the rollout, where it is in a file already
    warning: str = ""  # why the first plan is most likely not what was meant
    remarks: tuple[str, ...] = ()  # what a reader must know of a rollout that was driven elsewhere

    def rows(self) -> dict[str, list[dict[str, Any]]]:
        """Its rows by table."""
        key = self.task._asdict()
        at = self.location
        stored = (at.file.name, at.row, at.rows) if at else (None, None, None)
        row = key | {name: getattr(self, name) for name in _TEXTS} | self.seconds
        return {
            "tasks": [row | dict(zip(LOCATION, stored, strict=True))],
            "scores": [key | self.scores] if self.status == OK else [],
            "metrics": [key | metric for metric in self.metrics],
        }

    @staticmethod
    def from_rows(rows: dict[str, list[dict[str, Any]]], folder: Path) -> "TaskResult":
        """The result that became rows; `folder` is that of its rollout, which it is without."""
        (row,), scores = rows["tasks"], rows["scores"]
        return TaskResult(
            task_of(row),
            **{name: row[name] for name in _TEXTS},
            seconds={name: row[name] for name in _DURATIONS if row.get(name) is not None},
            scores=_beyond_key(scores[0]) if scores else {},
            metrics=list(map(_beyond_key, rows["metrics"])),
            location=stored_location(folder, *(row[name] for name in LOCATION)),
        )


def task_of(row: Mapping[str, Any]) -> Task:
    """The task of a row of any table."""
    return Task(*(row[name] for name in Task._fields))


def _beyond_key(row: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if name not in Task._fields}


def stored_location(
    folder: Path, rollout: str | None, row: Any, rows: Any
) -> RolloutLocation | None:
    """Where a rollout is below the folder of rollouts, by the columns of `tasks.parquet`."""
    return RolloutLocation(part_file(folder, rollout), row, rows) if rollout else None


def stored_results(run: Path) -> Iterator[TaskResult]:
    """The results that the tables of a run hold, in their order, without those that are missing."""
    found = {}
    for name in TABLES:
        rows_of = (row for batch in _batches(run / f"{name}.parquet") for row in batch.to_pylist())
        found[name] = ((task, list(group)) for task, group in groupby(rows_of, task_of))
    for task, tasks in found["tasks"]:
        status, rows = tasks[0]["status"], {"tasks": tasks}
        for name in ("scores", "metrics"):
            rows[name] = _next_rows(task, found[name], run / name) if status == OK else []
        if status != MISSING:
            yield TaskResult.from_rows(rows, run / FOLDER)


def _next_rows(task: Task, rows: Iterator[Any], table: Path) -> list[dict[str, Any]]:
    found, values = next(rows, (None, []))
    if found != task:
        what = f"the rows of {task.words} {task.token} are missing"
        raise damaged(table.with_suffix(".parquet"), what)
    return list(values)


def read_table(path: Path) -> pa.Table:
    """A table of a run, or a DataError."""
    schema = TABLES[path.stem]
    return pa.Table.from_batches((batch.select(schema.names) for batch in _batches(path)), schema)


def _batches(path: Path) -> Iterator[pa.RecordBatch]:
    """A table part by part, with columns of the right types and numbers within their ranges."""
    try:
        file = pq.ParquetFile(path)
        names = file.schema_arrow.names
        types = {column.name: column.type for column in file.schema_arrow}
        for column in TABLES[path.stem]:
            if types.get(column.name) != column.type or names.count(column.name) > 1:
                what = f"column {column.name!r} is missing, there twice or not {column.type}"
                raise damaged(path, what)
        for batch in file.iter_batches(batch_size=4096):
            batch.validate(full=True)  # that texts are UTF-8
            for name in set(_RANGES) & set(batch.schema.names):
                values = batch[name].drop_null().to_numpy()
                require(RUN, _RANGES[name], values, f"{path}: column {name!r} as")
            yield batch
    except (OSError, ValueError, pa.ArrowException) as error:
        raise damaged(path, str(error)) from error
