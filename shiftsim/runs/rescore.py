"""Score stored rollouts again: another threshold profile or own metrics, no simulation."""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from shiftsim.errors import DataError
from shiftsim.metrics import METRIC_VERSION, load_metric, thresholds_of
from shiftsim.runs.bundle import open_run_store
from shiftsim.runs.config import default_workers, make_config
from shiftsim.runs.execute import RUNS, Progress, advanced, ended, run_name
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.manifest import code_digest, make_manifest, now
from shiftsim.runs.results import MISSING, OK, Run, TaskResult, open_run
from shiftsim.runs.resume import check_target
from shiftsim.runs.rollouts import Task
from shiftsim.runs.task import attempt, score_rollout
from shiftsim.runs.workers import Outcome, map_unordered
from shiftsim.world.scenario import Scenario


@dataclass
class Rescorer:
    """Scores one stored rollout after the other.

    Attributes:
        run: Folder of the run that holds them.
        store: Folder of the store it was made with.
        thresholds: Threshold profile.
        metrics: Own metrics, by `module:attribute`.
        traffic: Traffic mode of the run.
    """

    run: Path
    store: str
    thresholds: str
    metrics: tuple[str, ...]
    traffic: str
    _open: Any = field(default=None, init=False)
    _last: Scenario | None = field(default=None, init=False)

    def __call__(self, task: Task) -> TaskResult:
        """The result of one task."""
        return attempt(task, partial(self._score, task))

    def _score(self, task: Task, seconds: dict[str, float], result: TaskResult) -> TaskResult:
        if self._open is None:
            from shiftsim.data.store.reading import open_store

            self._open = open_run(self.run), open_store(self.store)
        run, store = self._open
        if self._last is None or self._last.token != task.token:
            self._last = store.read(task.token)
        scenario = self._last
        log = run.rollout(task, scenario)
        scores, metrics = score_rollout(
            scenario,
            log,
            thresholds=self.thresholds,
            traffic=self.traffic,
            metrics=self.metrics,
        )
        kind = scenario.scenario_type
        return replace(result, scenario_type=kind, scores=scores, metrics=metrics)


def rescore(
    run: Run,
    *,
    thresholds: str,
    metrics: tuple[str, ...] = (),
    store: str | None = None,
    out: str | None = None,
    workers: int = 0,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    argv: Sequence[str] = (),
) -> Run:
    """Write a run folder as if the run had been made with other thresholds.

    Args:
        run: A run with stored rollouts.
        thresholds: Threshold profile.
        metrics: Own metrics, by `module:attribute`.
        store: The store, where it has moved.
        out: The new folder; by default `runs/<id>`.
        workers: Worker processes; 0 chooses from the cores.
        on_progress: Called after every rollout.
        argv: The command line, for the manifest.

    Raises:
        DataError: Rollouts are missing, or the store is another one.
    """
    for metric in metrics:
        load_metric(metric)
    found = open_run_store(run, store)
    determining = run.manifest["determining"] | {
        "thresholds": asdict(thresholds_of(thresholds)),
        "metrics": sorted(metrics),
        "metric_version": METRIC_VERSION,
        "code": _code(run.manifest["determining"].get("code", "")),
    }
    values = run.manifest["config"] | {"thresholds": thresholds, "metrics": list(metrics)}
    config = make_config(values, where=str(run.path / "manifest.json"))
    target = Path(out) if out else RUNS / run_name(config, run.manifest["split"], determining)
    check_target(target, determining)
    tasks = [Task(*(row[n] for n in Task._fields)) for row in _finished(run)]
    tasks.sort(key=lambda task: task.token)  # as rollouts lie in their files
    lacking = [task for task in tasks if run.rollout_places[task] is None]
    if lacking:
        raise DataError(
            f"run {run.path.name!r} holds no rollouts for {len(lacking)} of {len(tasks)} tasks",
            hint="run again with --save-rollouts all",
        )
    rescorer = Rescorer(
        run.path.resolve(), found.source, thresholds, metrics, determining["traffic"]
    )
    manifest = make_manifest(
        target,
        config=config,
        split=run.manifest["split"],
        store=run.manifest["store"] if store is None else found.source,
        determining=determining,
        argv=argv,
    )
    writer = RunWriter(target, manifest)
    try:
        _keep_unfinished(run, writer)
        progress = Progress(0, len(tasks), 0)
        count = min(workers or default_workers(), len(tasks))
        outcomes = map_unordered(
            partial(_same, rescorer), tasks, workers=count, alone=1, group=_token
        )
        with closing(outcomes):
            for outcome in outcomes:
                result = outcome.result or _lost(outcome)
                writer.add(result, stored=run.rollout_places[result.task])
                progress = advanced(progress, result)
                on_progress(progress)
        manifest |= {"state": "finished", "ended": now(), "rescored_from": run.path.name}
        errors = dict(zip(run.rollout_places, run.tasks["error"].to_pylist(), strict=True))
        return writer.finish(manifest, run.rollout_places, errors.__getitem__)
    finally:
        writer.close()


def _code(simulated: str) -> str:
    """Digest of the code that simulated, and of the code that scores where it is another."""
    here = code_digest()
    return here if here == simulated else f"{simulated}, scored by {here}"


def _same(rescorer: Rescorer) -> Rescorer:
    return rescorer


def _token(task: Task) -> str:
    return task.token


def _lost(outcome: Outcome[Task, TaskResult]) -> TaskResult:
    (result,) = ended(Outcome((outcome.task,), None, outcome.death))
    return result


def _finished(run: Run) -> list[dict[str, Any]]:
    return [row for row in run.tasks.to_pylist() if row["status"] == OK]


def _keep_unfinished(run: Run, writer: RunWriter) -> None:
    """Tasks that failed or are missing stay so."""
    names = ("status", "scenario_type", "error", "hint", "traceback")
    for row in run.tasks.to_pylist():
        if row["status"] not in (OK, MISSING):
            task = Task(*(row[n] for n in Task._fields))
            writer.add(TaskResult(task, *(row[name] for name in names)))
