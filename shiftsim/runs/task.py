"""Tasks of a run: read the scenario, drive it, score it, and never raise.

This runs in a worker, on one unit of work after the other: one task, or several of a planner that
answers for all of them with one forward pass. It holds what is worth keeping between them: the open
store, one instance per planner, and the last scenario.
"""

import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, TypeAlias

import numpy as np

from shiftsim.errors import ShiftsimError
from shiftsim.metrics import METRIC_VERSION, SHORT_NAMES, MetricRow, compute_metrics
from shiftsim.planners.registry import RunPlanner, close_planner
from shiftsim.runs.results import FAILED, OK, TaskResult
from shiftsim.runs.rollouts import Task, encode_rollout
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.noise import NoiseModel
from shiftsim.sim.planner import BatchPlanner, Planner
from shiftsim.world.scenario import Scenario

Unit: TypeAlias = tuple[Task, ...]  # what a worker is handed at once


@dataclass
class TaskRunner:
    """Does units of tasks, one after the other.

    Attributes:
        store: Folder or URL of the scenario store.
        planners: The planners, by name.
        noises: The noise models, by name.
        traffic: Traffic mode.
        controller: How a plan moves the ego.
        thresholds: Threshold profile.
        metrics: Own metrics, by `module:attribute`.
        save_rollouts: Which results carry their rollout: `all`, `failed` (a score of 0) or `none`.
        strict: Whether a step with a makeshift plan fails its task.
    """

    store: str
    planners: Mapping[str, RunPlanner]
    noises: Mapping[str, NoiseModel]
    traffic: str
    controller: str
    thresholds: str
    metrics: tuple[str, ...]
    save_rollouts: str
    strict: bool = False
    _open: Any = field(default=None, init=False)
    _made: dict[str, Planner] = field(default_factory=dict, init=False)
    _last: Scenario | None = field(default=None, init=False)

    def __call__(self, unit: Unit) -> list[TaskResult]:
        """One result per task of a unit."""
        return self._together(unit) if len(unit) > 1 else [self._alone(unit[0])]

    def _alone(self, task: Task) -> TaskResult:
        result = attempt(task, partial(self._do, task))
        if result.status != OK:
            self._forget(task.planner)
        return result

    def _do(self, task: Task, seconds: dict[str, float], result: TaskResult) -> TaskResult:
        from shiftsim.sim.loop import simulate

        with _measured(seconds, "read_seconds"):
            scenario = self._read(task.token)
        with _measured(seconds, "simulate_seconds"):
            log = simulate(scenario, self._planner(task), **self._setting(task))
        return self._scored(scenario, log, result)

    def _together(self, unit: Unit) -> list[TaskResult]:
        """Several tasks in lock step; each of them fails for itself."""
        from shiftsim.sim.loop import Rollout, simulate_together

        rollouts: dict[Task, tuple[Scenario, Rollout]] = {}

        def begin(task: Task, seconds: dict[str, float], result: TaskResult) -> TaskResult:
            with _measured(seconds, "read_seconds"):
                scenario = self._read(task.token)
            rollout = Rollout(scenario, self._planner(task), **self._setting(task))
            rollouts[task] = (scenario, rollout)
            return result

        results = {task: attempt(task, partial(begin, task)) for task in unit}
        began = perf_counter()
        try:
            logs = simulate_together([rollout for _, rollout in rollouts.values()])
        except Exception:  # the shared pass itself failed: too little memory for all of them?
            self._forget(unit[0].planner)
            return [self._alone(task) for task in unit]
        share = (perf_counter() - began) / max(1, len(logs))
        for (task, (scenario, _)), log in zip(rollouts.items(), logs, strict=True):
            read = results[task].seconds
            results[task] = attempt(task, partial(self._finished, scenario, log))
            results[task].seconds.update(read, simulate_seconds=share)
        return list(results.values())

    def _finished(
        self,
        scenario: Scenario,
        log: SimulationLog | Exception,
        seconds: dict[str, float],
        result: TaskResult,
    ) -> TaskResult:
        if isinstance(log, Exception):
            raise log
        return self._scored(scenario, log, result)

    def _scored(self, scenario: Scenario, log: SimulationLog, result: TaskResult) -> TaskResult:
        result.seconds.update(planning_times(log))
        with _measured(result.seconds, "metrics_seconds"):
            scores, metrics = score_rollout(
                scenario,
                log,
                thresholds=self.thresholds,
                traffic=self.traffic,
                metrics=self.metrics,
            )
        reactive = self.traffic != "nonreactive"
        keep = self.save_rollouts == "all" or (
            self.save_rollouts == "failed" and scores["cls"] == 0.0
        )
        return replace(
            result,
            scenario_type=scenario.scenario_type,
            scores=scores,
            metrics=metrics,
            rollout=encode_rollout(log, with_tracks=reactive) if keep else b"",
        )

    def _setting(self, task: Task) -> dict[str, Any]:
        return {
            "noise": self.noises[task.noise],
            "seed": task.seed,
            "traffic": self.traffic,
            "controller": self.controller,
            "strict": self.strict,
        }

    def _read(self, token: str) -> Scenario:
        if self._open is None:
            from shiftsim.data.store.reading import open_store

            self._open = open_store(self.store)
        if self._last is None or self._last.token != token:
            self._last = self._open.read(token)
        return self._last

    def _planner(self, task: Task) -> Planner | None:
        """The planner of a task: made once, or a fork of it that has nothing of other tasks."""
        if self.controller == "log-playback":
            return None
        planner = self._made.get(task.planner)
        if planner is None:
            planner = self._made[task.planner] = self.planners[task.planner].make()
        return planner.fork() if isinstance(planner, BatchPlanner) else planner

    def _forget(self, name: str) -> None:
        """After a failure a planner may be in any state: the next task gets a new one."""
        if not isinstance(self._made.get(name), BatchPlanner):
            self._made.pop(name, None)

    def close(self) -> None:
        """Let the planners release what they hold."""
        for planner in self._made.values():
            close_planner(planner)
        self._made.clear()


def attempt(task: Task, work: Callable[[dict[str, float], TaskResult], TaskResult]) -> TaskResult:
    """The result of a piece of work; whatever goes wrong becomes its error text.

    Args:
        task: The task.
        work: Fills the durations it is given, and completes the result it is given.
    """
    result = TaskResult(task, OK)
    try:
        return work(result.seconds, result)
    except Exception as error:  # the one place: a task that fails is a row, not the end of a run
        return replace(
            result,
            status=FAILED,
            error=f"{_kind(error)}{error}",
            hint=getattr(error, "hint", ""),
            traceback=traceback.format_exc(),
        )


def planning_times(log: SimulationLog) -> dict[str, float]:
    """What `tasks.parquet` says of the planner's speed: its total [s], mean and p95 [ms]."""
    per_step = log.planning_seconds * 1e3
    return {
        "planner_seconds": float(log.planning_seconds.sum()),
        "planning_ms_mean": float(per_step.mean()),
        "planning_ms_p95": float(np.percentile(per_step, 95)),
    }


def score_rollout(
    scenario: Scenario,
    log: SimulationLog,
    *,
    thresholds: str,
    traffic: str,
    metrics: Sequence[str] = (),
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The row of `scores.parquet` and the rows of `metrics.parquet`, beyond the key."""
    result = compute_metrics(log, scenario.map, thresholds=thresholds, own=metrics)
    profile = {"thresholds": thresholds, "metric_version": METRIC_VERSION}
    scores = {
        "scenario_type": scenario.scenario_type,
        "city": scenario.city,
        "log_name": scenario.log_name,
        "traffic": traffic,
        "cls": result.score,
        **{name: result.scores[name] for name in SHORT_NAMES if name != "score"},
        "degraded_steps": int(log.degraded.sum()),
        **profile,
    }
    start_us = int(log.time_us[0])
    rows = [_metric_row(row, start_us) for row in (*result.rows, *result.extra)]
    return scores, [{**row, **profile} for row in rows]


def _metric_row(row: MetricRow, start_us: int) -> dict[str, Any]:
    first = row.violation
    return {
        "metric": row.metric,
        "value": row.value,
        "unit": row.unit,
        "threshold": row.threshold,
        "score": row.score,
        "first_violation_iteration": None if first is None else first.iteration,
        "first_violation_time_us": None if first is None else first.time_us,
        "first_violation_s": None if first is None else (first.time_us - start_us) * 1e-6,
        "first_violation_value": None if first is None else first.value,
        "partner_token": None if first is None else first.partner,
    }


def _kind(error: Exception) -> str:
    """Errors of our own explain themselves; others are named."""
    return "" if isinstance(error, ShiftsimError) else f"{type(error).__name__}: "


@contextmanager
def _measured(seconds: dict[str, float], name: str) -> Iterator[None]:
    began = perf_counter()
    try:
        yield
    finally:
        seconds[name] = perf_counter() - began
