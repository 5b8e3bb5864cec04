"""The run folder: tables and rollouts on disk, and reading all of it back.

`scores.parquet` and `metrics.parquet` hold nothing but results, sorted by task and written with
fixed settings, so that the same run gives the same bytes for any number of workers and any order.
Timings are in `tasks.parquet`.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from shiftsim.errors import ConfigError, DataError
from shiftsim.metrics import SHORT_NAMES
from shiftsim.runs.rollouts import Task, complete_rollout, describe
from shiftsim.runs.rollouts.files import FOLDER, Place, RolloutReader, part_file
from shiftsim.sim.log import SimulationLog
from shiftsim.world.ranges import RUN, require
from shiftsim.world.scenario import Scenario

FORMAT_VERSION = 5
JOURNAL = "unfinished.sqlite"  # of a run under way
OK, FAILED, TIMEOUT, MISSING = STATUSES = ("ok", "failed", "timeout", "missing")

_TEXT, _NUMBER, _WHOLE = pa.string(), pa.float64(), pa.int64()
_KEY = {"planner": _TEXT, "noise": _TEXT, "seed": _WHOLE, "token": _TEXT}
_PROFILE = {"thresholds": _TEXT, "metric_version": _TEXT}
_DURATIONS = (
    "read_seconds",
    "simulate_seconds",
    "planner_seconds",
    "planning_ms_mean",
    "planning_ms_p95",
    "metrics_seconds",
)
TEXTS = ("scenario_type", "status", "error", "hint", "traceback")
PLACE = ("rollout", "rollout_row", "rollout_rows")  # file below rollouts/, first row there, rows
TABLES = {
    "tasks": pa.schema(
        {
            **_KEY,
            **dict.fromkeys(TEXTS, _TEXT),
            **dict.fromkeys(_DURATIONS, _NUMBER),
            **dict(zip(PLACE, (_TEXT, _WHOLE, _WHOLE), strict=True)),
        }
    ),
    "scores": pa.schema(
        {
            **_KEY,
            **dict.fromkeys(("scenario_type", "city", "log_name", "traffic"), _TEXT),
            "duration_class": _TEXT,
            "cls": _NUMBER,
            **dict.fromkeys((name for name in SHORT_NAMES if name != "score"), _NUMBER),
            "degraded_steps": _WHOLE,
            **_PROFILE,
        }
    ),
    "metrics": pa.schema(
        {
            **_KEY,
            "metric": _TEXT,
            "value": _NUMBER,
            "unit": _TEXT,
            "threshold": _NUMBER,
            "score": _NUMBER,
            "first_violation_iteration": _WHOLE,
            "first_violation_time_us": _WHOLE,
            "first_violation_s": _NUMBER,
            "first_violation_value": _NUMBER,
            "partner_token": _TEXT,
            **_PROFILE,
        }
    ),
}
ADDED = {"duration_class"}  # columns that older runs lack

_RANGES = {  # by column
    **dict.fromkeys(("cls", *SHORT_NAMES), "score"),
    **dict.fromkeys(_DURATIONS, "duration"),
    **{name: name for name in ("degraded_steps", *PLACE[1:])},
}
_MANIFEST = {  # what is read of it, and its type
    **dict.fromkeys(("state", "split", "store"), str),
    **dict.fromkeys(("config", "counts", "determining", "determining.planners"), dict),
    **dict.fromkeys(("determining.store", "determining.traffic", "determining.controller"), str),
    "determining.metric_version": str,
    "config.planners": list,
    "determining.thresholds.name": str,
}


@dataclass(frozen=True, slots=True)
class TaskResult:
    """What became of one task."""

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
    rollout: bytes = b""  # the rollout, encoded; empty when it is not to be stored
    doubt: str = ""  # why the first plan is most likely not what was meant


@dataclass(frozen=True)
class Run:
    """A finished run on disk.

    Attributes:
        path: Its folder.
        manifest: Everything the run depended on, and its counts.
    """

    path: Path
    manifest: dict[str, Any]

    @cached_property
    def scores(self) -> pa.Table:
        """One row per finished task: closed-loop score and metric scores."""
        found, done = _read(self.path / "scores.parquet"), pc.equal(self.tasks["status"], OK)
        if not found.select(Task._fields).equals(self.tasks.filter(done).select(Task._fields)):
            raise _damaged(self.path / "scores.parquet", "its rows are not the finished tasks")
        return found

    @cached_property
    def metrics(self) -> pa.Table:
        """One row per finished task and metric: value, threshold, first violation."""
        return _read(self.path / "metrics.parquet")

    @cached_property
    def tasks(self) -> pa.Table:
        """One row per task: status, error, durations."""
        return _read(self.path / "tasks.parquet")

    @cached_property
    def rollout_places(self) -> dict[Task, Place | None]:
        """Where every rollout is stored; None where there is none."""
        keys, places = (
            zip(*(self.tasks[name].to_pylist() for name in names), strict=True)
            for names in (Task._fields, PLACE)
        )
        return {
            Task(*key): stored_place(self.path, *place)
            for key, place in zip(keys, places, strict=True)
        }

    def rollout(self, task: Task, scenario: Scenario) -> SimulationLog:
        """One stored rollout; its scenario is that of the store the run was made with.

        Raises:
            DataError: It was not stored, cannot be read, or the scenario is another one.
        """
        return complete_rollout(self.rollout_rows(task), scenario, task)

    def rollout_rows(self, task: Task) -> pa.RecordBatch:
        """One stored rollout as it lies on disk, a row per sample.

        Raises:
            DataError: It was not stored, or cannot be read.
        """
        place = self.rollout_places.get(task)
        if place is None:
            raise DataError(
                f"run {self.path.name!r} holds no rollout of {describe(task)}",
                hint="run again with --save-rollouts all",
            )
        return self._reader.read(place)

    @cached_property
    def _reader(self) -> RolloutReader:
        return RolloutReader()

    @property
    def is_complete(self) -> bool:
        """Whether every expected task finished."""
        return bool(self.manifest["counts"]["ok"] == self.manifest["counts"]["expected"])


def stored_place(
    run: Path, rollout: str | None, rollout_row: int | None, rollout_rows: int | None
) -> Place | None:
    """Where a rollout is, by the columns of `tasks.parquet`."""
    if not rollout:
        return None
    if rollout_row is None or rollout_rows is None:
        what = f"'rollout_row' or 'rollout_rows' is empty where 'rollout' is {rollout!r}"
        raise _damaged(run / "tasks.parquet", what)
    return Place(part_file(run / FOLDER, rollout), rollout_row, rollout_rows)


def stored_results(path: Path) -> Iterator[tuple[TaskResult, Place | None]]:
    """What made the tables of a run, task by task, and where the rollout is.

    A task without a result has none.
    """
    files = [path / f"{name}.parquet" for name in ("scores", "metrics")]
    scores, metrics = map(_by_task, files)
    for key, (row,) in _by_task(path / "tasks.parquet"):
        if row["status"] == MISSING:
            continue
        done = row["status"] == OK
        result = TaskResult(
            Task(*key),
            **{name: row[name] for name in TEXTS},
            seconds={name: row[name] for name in _DURATIONS if row[name] is not None},
            scores=_next_of(key, scores, files[0])[0] if done else {},
            metrics=_next_of(key, metrics, files[1]) if done else [],
        )
        yield result, stored_place(path, *(row[name] for name in PLACE))


def _by_task(path: Path) -> Iterator[tuple[tuple[Any, ...], list[dict[str, Any]]]]:
    key = itemgetter(*Task._fields)
    rows = (row for batch in _batches(path) for row in batch.to_pylist())
    for found, group in groupby(rows, key):
        yield found, [{n: v for n, v in row.items() if n not in Task._fields} for row in group]


def _next_of(key: tuple[Any, ...], rows: Iterator[Any], path: Path) -> list[dict[str, Any]]:
    found, values = next(rows, (None, []))
    if found != key:
        raise _damaged(path, f"the rows of {describe(Task(*key))} are missing")
    return list(values)


def _batches(path: Path) -> Iterator[pa.RecordBatch]:
    """A table of a run, part by part, with columns of the right types and plausible numbers."""
    try:
        file = pq.ParquetFile(path)
        found = {column.name: column.type for column in file.schema_arrow}
        lacking = [column for column in ADDED & set(TABLES[path.stem].names) if column not in found]
        for column in TABLES[path.stem]:
            if column.name in lacking:
                continue
            if found.get(column.name) != column.type:
                raise _damaged(path, f"column {column.name!r} is missing or not {column.type}")
        for batch in file.iter_batches(batch_size=4096):
            batch.validate(full=True)  # that texts are UTF-8
            for name in lacking:
                batch = batch.append_column(name, pa.nulls(len(batch), _TEXT))
            for name in set(_RANGES) & set(batch.schema.names):
                values = batch[name].drop_null().to_numpy()
                require(RUN, _RANGES[name], values, f"{path}: column {name!r} as")
            yield batch
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _damaged(path, str(error)) from error


def _damaged(path: Path, what: str) -> DataError:
    return DataError(f"{str(path)!r} cannot be read: {what}", hint="make the run again")


def _read(path: Path) -> pa.Table:
    schema = TABLES[path.stem]
    batches = (batch.select(schema.names) for batch in _batches(path))
    return pa.Table.from_batches(batches, schema)


def open_run(path: str | Path) -> Run:
    """A run folder.

    Raises:
        ConfigError: There is no such folder.
        DataError: It is not a run folder, one of another format, or the run is not finished.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise ConfigError(f"no run folder {str(folder)!r}", hint=_known_runs(folder.parent))
    manifest = read_manifest(folder)
    if manifest["state"] == "running":
        raise DataError(
            f"run {str(folder)!r} is not finished, or still under way",
            hint="the command that started it, with --resume, finishes it",
        )
    return Run(folder, manifest)


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a run folder, finished or not.

    Raises:
        DataError: It is not a run folder, or one of another format.
    """
    path = folder / "manifest.json"
    try:
        manifest: dict[str, Any] = json.loads(path.read_text("utf-8"))
        version, _ = manifest["format"], manifest["state"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            f"{str(folder)!r} is not a run folder: manifest.json is missing or broken",
            hint="name a folder that `shiftsim run` wrote",
        ) from error
    if version != FORMAT_VERSION:
        raise DataError(
            f"{str(path)!r} has format {version!r}, this version reads {FORMAT_VERSION}",
            hint=f"python tools/upgrade.py {folder}, or make the run again",
        )
    finished = {"counts.ok": int, "counts.expected": int} if manifest["state"] == "finished" else {}
    for key, kind in {**_MANIFEST, **finished}.items():
        value: Any = manifest
        for name in key.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        if not isinstance(value, kind):
            raise _damaged(path, f"{key!r} is missing or no {kind.__name__}")
    return manifest


def _known_runs(parent: Path) -> str:
    below = (path for where in ("*", "runs/*") for path in parent.glob(f"{where}/manifest.json"))
    runs = sorted(str(path.parent) for path in below)
    return f"there are: {', '.join(runs[:8])}" if runs else "make one with `shiftsim run`"
