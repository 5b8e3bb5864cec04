"""The run folder: manifest, tables and rollouts on disk, and reading all of it back (ux.md §5).

`scores.parquet` and `metrics.parquet` hold nothing but results, sorted by task and written with
fixed settings, so that the same run gives the same bytes for any number of workers and any order.
Timings are in `tasks.parquet`. A folder appears under its name only when everything is written.
"""

import contextlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.errors import ConfigError, DataError
from shiftsim.log import SimulationLog
from shiftsim.rollouts import Task, complete_rollout, describe, rollout_table
from shiftsim.scenario import Scenario

FORMAT_VERSION = 2
ROLLOUTS_PER_PART = 256
WRITE_OPTIONS: dict[str, Any] = {
    "compression": "zstd",
    "compression_level": 3,
    "version": "2.6",
    "data_page_version": "1.0",
    "use_dictionary": True,
    "write_statistics": True,
}
ROW_GROUP = 1 << 16  # rows

_KEY = [
    ("planner", pa.string()),
    ("noise", pa.string()),
    ("seed", pa.int64()),
    ("token", pa.string()),
]
_PROFILE = [("thresholds", pa.string()), ("metric_version", pa.string())]
TASKS_SCHEMA = pa.schema(
    [
        *_KEY,
        ("scenario_type", pa.string()),
        ("status", pa.string()),
        ("error", pa.string()),
        ("hint", pa.string()),
        ("traceback", pa.string()),
        ("read_seconds", pa.float64()),
        ("simulate_seconds", pa.float64()),
        ("planner_seconds", pa.float64()),
        ("planning_ms_mean", pa.float64()),
        ("planning_ms_p95", pa.float64()),
        ("metrics_seconds", pa.float64()),
        ("rollout_part", pa.int64()),
        ("rollout_row_group", pa.int64()),
    ]
)
METRICS_SCHEMA = pa.schema(
    [
        *_KEY,
        ("metric", pa.string()),
        ("value", pa.float64()),
        ("unit", pa.string()),
        ("threshold", pa.float64()),
        ("score", pa.float64()),
        ("first_violation_iteration", pa.int64()),
        ("first_violation_time_us", pa.int64()),
        ("first_violation_s", pa.float64()),
        ("first_violation_value", pa.float64()),
        ("partner_token", pa.string()),
        *_PROFILE,
    ]
)


@dataclass(frozen=True, slots=True)
class TaskResult:
    """What became of one task.

    Attributes:
        task: The task.
        status: `ok`, `failed` or `missing`.
        scenario_type: Type of the scenario, where it could be read.
        error: What went wrong, empty for `ok`.
        hint: What to do about it.
        traceback: Where it went wrong.
        seconds: Durations by column name of `tasks.parquet` [s], or [ms] where the name says so.
        scores: The row of `scores.parquet` beyond the key; empty unless `ok`.
        metrics: The rows of `metrics.parquet` beyond the key.
        log: The rollout, when it is to be stored.
    """

    task: Task
    status: str
    scenario_type: str = ""
    error: str = ""
    hint: str = ""
    traceback: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    scores: dict[str, Any] = field(default_factory=dict)
    metrics: list[dict[str, Any]] = field(default_factory=list)
    log: SimulationLog | None = None


class RunWriter:
    """Collects results and writes a run folder beside its final place."""

    def __init__(self, path: Path, *, with_tracks: bool = False) -> None:
        """Prepare an empty folder next to `path`; tracks are stored only when asked for."""
        self.path = path
        self.work = path.parent / f".{path.name}.partial-{os.getpid()}"
        shutil.rmtree(self.work, ignore_errors=True)
        (self.work / "rollouts").mkdir(parents=True)
        self._results: dict[Task, TaskResult] = {}
        self._places: dict[Task, tuple[int, int]] = {}
        self._with_tracks = with_tracks
        self._part: pq.ParquetWriter | None = None

    def add(self, result: TaskResult) -> None:
        """Take one result; its rollout goes to disk at once."""
        if result.log is not None:
            self._write_rollout(result.task, result.log)
        self._results[result.task] = TaskResult(
            **{name: getattr(result, name) for name in TaskResult.__slots__ if name != "log"}
        )

    def counts(self, expected: int) -> dict[str, int]:
        """How many tasks were expected, and how many ended in each way."""
        states = [result.status for result in self._results.values()]
        return {"expected": expected} | {
            status: states.count(status) for status in ("ok", "failed", "missing")
        }

    def _write_rollout(self, task: Task, log: SimulationLog) -> None:
        table = rollout_table(task, log, with_tracks=self._with_tracks)
        part, group = divmod(len(self._places), ROLLOUTS_PER_PART)
        if group == 0:
            self._close_part()
            path = self.work / "rollouts" / f"part-{part:05d}.parquet"
            self._part = pq.ParquetWriter(path, table.schema, **WRITE_OPTIONS)
        assert self._part is not None
        self._part.write_table(table, row_group_size=max(1, len(table)))
        self._places[task] = (part, group)

    def _close_part(self) -> None:
        if self._part is not None:
            self._part.close()
            self._part = None

    def link_rollouts(self, source: "Run") -> None:
        """Take over the stored rollouts of another run; its results must be added as well."""
        for part in sorted((source.path / "rollouts").glob("*.parquet")):
            target = self.work / "rollouts" / part.name
            try:
                os.link(part, target)
            except OSError:
                shutil.copy2(part, target)
        self._places = {task: place for task, place in source.places.items() if place}

    def finish(self, manifest: dict[str, Any]) -> "Run":
        """Write tables and manifest, and put the folder in its place."""
        self._close_part()
        results = [self._results[task] for task in sorted(self._results)]
        write_table(self.work / "tasks.parquet", self._tasks_table(results))
        write_table(self.work / "scores.parquet", _scores_table(results))
        write_table(self.work / "metrics.parquet", _metrics_table(results))
        text = json.dumps(manifest, indent=2, ensure_ascii=False) + "\n"
        (self.work / "manifest.json").write_text(text)
        _replace_folder(self.work, self.path)
        return open_run(self.path)

    def discard(self) -> None:
        """Remove everything written so far, unless the folder is in its place already."""
        with contextlib.suppress(OSError):
            self._close_part()
        shutil.rmtree(self.work, ignore_errors=True)

    def _tasks_table(self, results: Sequence[TaskResult]) -> pa.Table:
        rows = []
        for result in results:
            part, group = self._places.get(result.task, (None, None))
            rows.append(
                {
                    **result.task._asdict(),
                    "scenario_type": result.scenario_type,
                    "status": result.status,
                    "error": result.error,
                    "hint": result.hint,
                    "traceback": result.traceback,
                    **result.seconds,
                    "rollout_part": part,
                    "rollout_row_group": group,
                }
            )
        return pa.Table.from_pylist(rows, TASKS_SCHEMA)


def _scores_table(results: Sequence[TaskResult]) -> pa.Table:
    """Columns: key, labels, `cls`, one per metric, profile and version."""
    rows = [{**r.task._asdict(), **r.scores} for r in results if r.status == "ok"]
    labels = ("scenario_type", "city", "log_name", "traffic")
    profile = dict(_PROFILE)
    named = {"cls": None} | {name: None for row in rows for name in row}
    known = {*dict(_KEY), *labels, "degraded_steps", *profile}
    numbers = [name for name in named if name not in known]
    schema = pa.schema(
        [
            *_KEY,
            *((name, pa.string()) for name in labels),
            *((name, pa.float64()) for name in numbers),
            ("degraded_steps", pa.int64()),
            *_PROFILE,
        ]
    )
    return pa.Table.from_pylist(rows, schema)


def _metrics_table(results: Sequence[TaskResult]) -> pa.Table:
    rows = [{**r.task._asdict(), **row} for r in results if r.status == "ok" for row in r.metrics]
    return pa.Table.from_pylist(rows, METRICS_SCHEMA)


def write_table(path: Path, table: pa.Table) -> None:
    """Write one table with the project's fixed settings, whole or not at all."""
    partial = path.with_name(f".{path.name}.partial")
    pq.write_table(table, partial, row_group_size=ROW_GROUP, **WRITE_OPTIONS)
    partial.replace(path)


def _replace_folder(new: Path, path: Path) -> None:
    old = path.parent / f".{path.name}.old-{os.getpid()}"
    if path.exists():
        path.rename(old)
    new.rename(path)
    shutil.rmtree(old, ignore_errors=True)


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
        return _read(self.path / "scores.parquet")

    @cached_property
    def metrics(self) -> pa.Table:
        """One row per finished task and metric: value, threshold, first violation."""
        return _read(self.path / "metrics.parquet")

    @cached_property
    def tasks(self) -> pa.Table:
        """One row per task: status, error, durations."""
        return _read(self.path / "tasks.parquet")

    @cached_property
    def places(self) -> dict[Task, tuple[int, int] | None]:
        """Part file and row group of every stored rollout; None where there is none."""
        names = [*Task._fields, "rollout_part", "rollout_row_group"]
        rows = zip(*(self.tasks[name].to_pylist() for name in names), strict=True)
        return {Task(*row[:4]): None if row[4] is None else (row[4], row[5]) for row in rows}

    def rollout(self, task: Task, scenario: Scenario) -> SimulationLog:
        """One stored rollout.

        Args:
            task: Which one.
            scenario: Its scenario, from the store the run was made with.

        Raises:
            DataError: It was not stored, cannot be read, or the scenario is another one.
        """
        place = self.places.get(task)
        if place is None:
            raise DataError(
                f"run {self.path.name!r} holds no rollout of {describe(task)}",
                hint="run again with --save-rollouts all",
            )
        path = self.path / "rollouts" / f"part-{place[0]:05d}.parquet"
        try:
            table = pq.ParquetFile(path).read_row_group(place[1])
        except (OSError, pa.ArrowException) as error:
            raise DataError(
                f"{str(path)!r} cannot be read: {error}", hint="make the run again"
            ) from error
        return complete_rollout(table, scenario)

    @property
    def is_complete(self) -> bool:
        """Whether every expected task finished."""
        return bool(self.manifest["counts"]["ok"] == self.manifest["counts"]["expected"])

    def table(self, *, allow_partial: bool = False) -> str:
        """The score table as text."""
        from shiftsim.report import score_table

        return score_table([self], allow_partial=allow_partial)

    def worst(self, count: int = 10) -> list[dict[str, Any]]:
        """The rollouts with the lowest scores: key, `cls` and `reason`."""
        from shiftsim.report import worst_rollouts

        return worst_rollouts(self, count)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})\n{self.table()}"

    def _repr_html_(self) -> str:
        import html

        return f"<pre>{html.escape(self.table())}</pre>"


def _read(path: Path) -> pa.Table:
    try:
        return pq.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise DataError(
            f"{str(path)!r} cannot be read: {error}", hint="make the run again"
        ) from error


def open_run(path: str | Path) -> Run:
    """A run folder.

    Raises:
        ConfigError: There is no such folder.
        DataError: It is not a run folder, or one of another format.
    """
    folder = Path(path)
    manifest_path = folder / "manifest.json"
    if not folder.is_dir():
        raise ConfigError(f"no run folder {str(folder)!r}", hint=_known_runs(folder.parent))
    try:
        manifest = json.loads(manifest_path.read_text())
        version = manifest["format"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{str(folder)!r} is not a run folder: manifest.json is missing or broken",
            hint="name a folder that `shiftsim run` wrote",
        ) from error
    if version != FORMAT_VERSION:
        raise DataError(
            f"{str(manifest_path)!r} has format {version!r}, this version reads {FORMAT_VERSION}",
            hint="make the run again with this version of shiftsim",
        )
    return Run(folder, manifest)


def _known_runs(parent: Path) -> str:
    runs = sorted(str(path.parent) for path in parent.glob("*/manifest.json"))
    return f"there are: {', '.join(runs[:8])}" if runs else "make one with `shiftsim run`"


def check_target(path: Path, determining: dict[str, Any]) -> None:
    """Whether a run may be written to a folder: a new one, or a repetition of the same run.

    Raises:
        ConfigError: The folder holds something else; the message says what differs.
    """
    if not path.exists():
        return
    if path.is_dir() and not any(path.iterdir()):
        return
    try:
        before = open_run(path).manifest["determining"]
    except (DataError, ConfigError, KeyError) as error:
        raise ConfigError(
            f"{str(path)!r} exists and is not a run folder", hint="choose another --out"
        ) from error
    names = sorted({*before, *determining})
    differing = [name for name in names if before.get(name) != determining.get(name)]
    if differing:
        name = differing[0]
        raise ConfigError(
            f"{str(path)!r} holds another run: {', '.join(differing)} differ "
            f"({name}: {before.get(name)!r}, not {determining.get(name)!r})"[:600],
            hint="choose another --out, or remove that folder",
        )
