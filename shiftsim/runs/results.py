"""The run folder, read back: its manifest, tables and rollouts."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import pyarrow as pa
import pyarrow.compute as pc

from shiftsim.errors import ConfigError, DataError, listed, one_of
from shiftsim.files import write_text
from shiftsim.runs.rollouts import Task, damaged
from shiftsim.runs.rollouts.files import FOLDER, RolloutLocation, RolloutReader, complete_rollout
from shiftsim.runs.tables import LOCATION, OK, read_table, stored_location, task_of
from shiftsim.sim.log import SimulationLog
from shiftsim.world.scenario import Scenario

FORMAT_VERSION = 5
JOURNAL = "unfinished.sqlite"  # of a run under way
_MANIFEST = {  # what is read of it, and its type
    **dict.fromkeys(("state", "split", "store"), str),
    **dict.fromkeys(("config", "counts", "determining", "determining.planners"), dict),
    **dict.fromkeys(("determining.store", "determining.traffic", "determining.controller"), str),
    "determining.metric_version": str,
    **dict.fromkeys(("config.planners", "config.noise", "config.seeds"), list),
    "determining.thresholds.name": str,
}


@dataclass(frozen=True)
class Run:
    """A finished run on disk."""

    path: Path  # its folder
    manifest: dict[str, Any]  # everything the run depended on, and its counts
    # what planners are called, by their names on disk, where that is something else
    labels: Mapping[str, str] = field(default_factory=dict, repr=False)

    def labelled(self, labels: Mapping[str, str]) -> Self:
        """The same run with planners called otherwise, new names by own ones; or a ConfigError."""
        config, determining = self.manifest["config"], self.manifest["determining"]
        for name in labels:
            one_of(f"run {self.path.name!r}: planner", name, config["planners"])
        new = {name: labels.get(name, name) for name in config["planners"]}
        if len({*new.values()}) < len(new):
            what = f"run {self.path.name!r}: two planners would be called the same"
            raise ConfigError(what, hint=f"its planners: {', '.join(new)}")
        given = (text.partition("=") for text in config.get("checkpoints", ()))
        config = config | {
            "planners": [*new.values()],
            "planner_args": {new[n]: v for n, v in config.get("planner_args", {}).items()},
            "checkpoints": ["".join((new.get(name, name), *rest)) for name, *rest in given],
        }
        planners = {new.get(name, name): v for name, v in determining["planners"].items()}
        manifest = {"config": config, "determining": determining | {"planners": planners}}
        kept = {disk: new[name] for disk, name in self.labels.items()}
        return replace(self, manifest=self.manifest | manifest, labels=kept or new)

    def _table(self, name: str) -> pa.Table:
        """A table of the folder, with the planners as they are called here."""
        table = read_table(self.path / f"{name}.parquet")
        if not self.labels:
            return table
        column = table.column_names.index("planner")
        names = [self.labels.get(one, one) for one in table["planner"].to_pylist()]
        return table.set_column(column, table.field(column), pa.array(names, pa.string()))

    @cached_property
    def scores(self) -> pa.Table:
        """One row per finished task: closed-loop score and metric scores."""
        key = ["planner", "noise", "seed", "token"]
        scores, is_done = self._table("scores"), pc.equal(self.tasks["status"], OK)
        if not scores.select(key).equals(self.tasks.filter(is_done).select(key)):
            raise damaged(self.path / "scores.parquet", "its rows are not the finished tasks")
        return scores

    @cached_property
    def metrics(self) -> pa.Table:
        """One row per finished task and metric: value, threshold, first violation."""
        return self._table("metrics")

    @cached_property
    def tasks(self) -> pa.Table:
        """One row per task: status, error, durations."""
        return self._table("tasks")

    @cached_property
    def rollout_places(self) -> dict[Task, RolloutLocation | None]:
        """Where every rollout is stored; None where there is none."""
        rows = self.tasks.select([*Task._fields, *LOCATION]).to_pylist()
        places = (stored_location(self.path / FOLDER, *(row[n] for n in LOCATION)) for row in rows)
        return dict(zip(map(task_of, rows), places, strict=True))

    def rollout(self, task: Task, scenario: Scenario) -> SimulationLog:
        """One stored rollout; the scenario is that of the run's store, else it is a DataError."""
        rows, is_partial = self.rollout_rows(task), "elsewhere" in self.manifest
        return complete_rollout(rows, scenario, task, is_partial=is_partial)

    def rollout_rows(self, task: Task) -> pa.RecordBatch:
        """One stored rollout as it lies on disk, a row per sample; or a DataError."""
        location = self.rollout_places.get(task)
        if location is None:
            what = f"run {self.path.name!r} holds no rollout of {task.words} {task.token}"
            raise DataError(what, hint="run again with --save-rollouts all")
        return self._reader.read(location)

    @cached_property
    def _reader(self) -> RolloutReader:
        return RolloutReader()

    @property
    def remarks(self) -> list[str]:
        """What a reader must know of rollouts that were driven elsewhere, in one line."""
        told = self.manifest.get("elsewhere", {}).get("remarks", ())
        return [f"driven elsewhere: {'; '.join(told)}"] if told else []

    @property
    def is_complete(self) -> bool:
        """Whether every expected task finished."""
        return bool(self.manifest["counts"]["ok"] == self.manifest["counts"]["expected"])


def open_run(path: str | Path) -> Run:
    """A run folder; a ConfigError where there is none, a DataError if it cannot be read."""
    folder = Path(path)
    if not folder.is_dir():
        near = [*folder.parent.glob("*/manifest.json"), *folder.parent.glob("runs/*/manifest.json")]
        runs = sorted(str(file.parent) for file in near)
        hint = f"there are: {listed(runs)}" if runs else "make one with `shiftsim run`"
        raise ConfigError(f"no run folder {str(folder)!r}", hint)
    manifest = read_manifest(folder)
    if manifest["state"] == "running":
        what = f"run {str(folder)!r} is not finished, or still under way"
        raise DataError(what, hint="the command that started it, with --resume, finishes it")
    return Run(folder, manifest)


def label_runs(runs: Sequence[Run], labels: Iterable[str]) -> list[Run]:
    """Runs with planners called otherwise: `NAME=LABEL`, or `RUN/NAME=LABEL` in one of them."""
    wanted: list[dict[str, str]] = [{} for _ in runs]
    named = [
        (run.path.name, name, new)
        for run, new in zip(runs, wanted, strict=True)
        for name in run.manifest["config"]["planners"]
    ]
    for text in labels:
        name, _, label = text.partition("=")
        known = {full for where, one, _ in named for full in (one, f"{where}/{one}")}
        one_of(f"label {text!r}: planner", name, known)
        if not label.strip() or not label.isprintable():
            raise ConfigError(f"label {text!r} is empty", hint=f"for example {name}=ours")
        for where, one, new in named:
            if name in (one, f"{where}/{one}"):
                new[one] = label
    return [run.labelled(new) if new else run for run, new in zip(runs, wanted, strict=True)]


def write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Write the manifest of a run folder, in one step."""
    text = json.dumps(manifest, indent=2, ensure_ascii=False)
    write_text(folder / "manifest.json", f"{text}\n")


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a run folder, finished or not; a DataError if none is of this format."""
    path = folder / "manifest.json"
    try:
        manifest: dict[str, Any] = json.loads(path.read_text("utf-8"))
        version, _ = manifest["format"], manifest["state"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        what = f"{str(folder)!r} is not a run folder: manifest.json is missing or broken"
        raise DataError(what, hint="name a folder that `shiftsim run` wrote") from error
    if version != FORMAT_VERSION:
        what = f"{str(path)!r} has format {version!r}, this version reads {FORMAT_VERSION}"
        raise DataError(what, hint=f"python tools/upgrade.py {folder}, or make the run again")
    counts = {"counts.ok": int, "counts.expected": int} if manifest["state"] == "finished" else {}
    for key, kind in {**_MANIFEST, **counts}.items():
        value: Any = manifest
        for name in key.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        if not isinstance(value, kind):
            raise damaged(path, f"{key!r} is missing or no {kind.__name__}")
    named, found = manifest["config"]["planners"], manifest["determining"]["planners"]
    sound = [isinstance(about, (dict, str)) for about in found.values()]
    if not all(sound) or not all(isinstance(name, str) for name in named):
        raise damaged(path, "its planners are no names with what they are")
    return manifest
