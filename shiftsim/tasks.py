"""One task of a run: read the scenario, drive it, score it, and never raise.

This runs in a worker. It holds what is worth keeping between tasks: the open store, one instance
per planner, and the last scenario.
"""

import copy
import hashlib
import inspect
import pickle
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import numpy as np

from shiftsim.config import Value
from shiftsim.errors import ConfigError, ShiftsimError
from shiftsim.log import SimulationLog
from shiftsim.metrics import METRIC_VERSION, SHORT_NAMES, MetricRow, compute_metrics
from shiftsim.noise import NoiseModel
from shiftsim.planner import Planner
from shiftsim.results import TaskResult
from shiftsim.rollouts import Task
from shiftsim.scenario import Scenario

# what constructors of users' planners are likely to raise
_CANNOT_MAKE = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    RuntimeError,
    OSError,
    ImportError,
)
_NO_PICKLE = (pickle.PicklingError, TypeError, AttributeError, NotImplementedError, RuntimeError)


@dataclass(frozen=True, slots=True)
class PlannerEntry:
    """A planner of a run: how to make it, and what identifies it.

    Attributes:
        name: As in tables.
        source: A name, `package.module:Class`, a class, or an instance.
        arguments: Passed to the constructor of a name or class.
        fingerprint: All that tells it from another planner, as JSON values.
    """

    name: str
    source: Any
    arguments: Mapping[str, Value]
    fingerprint: Mapping[str, Any]

    def make(self) -> Planner:
        """An instance of its own for one worker."""
        if isinstance(self.source, str):
            from shiftsim.planners import load_planner

            loaded: Planner = load_planner(self.source, dict(self.arguments))
            return loaded
        if inspect.isclass(self.source):
            made: Planner = cast(Any, self.source)(**self.arguments)
            return made
        own: Planner = copy.deepcopy(self.source)
        return own


def planner_name(source: Any) -> str:
    """How a planner given by name, class or instance is called in tables."""
    if isinstance(source, str):
        return source
    kind = source if inspect.isclass(source) else type(source)
    return str(getattr(source, "name", "") or kind.__name__)


def planner_entry(source: Any, arguments: Mapping[str, Value]) -> PlannerEntry:
    """Describe a planner given by name, class or instance; it is made once to see that it works.

    Raises:
        ShiftsimError: It does not exist, or cannot be made.
    """
    if isinstance(source, str):
        from shiftsim.planners import planner_fingerprint

        entry = PlannerEntry(
            source, source, arguments, planner_fingerprint(source, dict(arguments))
        )
    else:
        kind = source if inspect.isclass(source) else type(source)
        fingerprint = _object_fingerprint(kind, source, arguments)
        entry = PlannerEntry(planner_name(source), source, arguments, fingerprint)
    try:
        planner = entry.make()
    except ShiftsimError:
        raise
    except _CANNOT_MAKE as error:
        raise ConfigError(
            f"planner {entry.name!r} cannot be made: {type(error).__name__}: {error}",
            hint="check its arguments with --planner-arg key=value",
        ) from error
    for method in ("reset", "plan"):
        if not callable(getattr(planner, method, None)):
            raise ConfigError(
                f"planner {entry.name!r} has no method {method}()",
                hint="a planner has reset(scene) and plan(observation)",
            )
    _close(planner)
    return entry


def _object_fingerprint(
    kind: type, source: object, arguments: Mapping[str, Value]
) -> dict[str, Any]:
    """A class's code and an instance's state, as far as they can be seen."""
    digest = hashlib.sha256()
    try:
        digest.update(inspect.getsource(kind).encode())
    except (OSError, TypeError):
        digest.update(repr(sorted(vars(kind))).encode())
    if source is not kind:
        try:
            digest.update(pickle.dumps(getattr(source, "__dict__", None)))
        except _NO_PICKLE as error:  # then its state merely has no digest
            digest.update(type(error).__name__.encode())
    return {
        "planner": f"{kind.__module__}:{kind.__qualname__}",
        "arguments": dict(sorted(arguments.items())),
        "source": digest.hexdigest(),
    }


def can_travel(entry: PlannerEntry) -> bool:
    """Whether a planner can be sent to a worker process.

    A class defined in the main script cannot: workers do not import that script.
    """
    if isinstance(entry.source, str):
        return True
    kind = entry.source if inspect.isclass(entry.source) else type(entry.source)
    if kind.__module__ == "__main__":
        return False
    try:
        pickle.dumps(entry.source)
    except _NO_PICKLE:
        return False
    return True


@dataclass
class TaskRunner:
    """Does tasks, one after the other.

    Attributes:
        store: Folder of the scenario store.
        planners: The planners, by name.
        noises: The noise models, by name.
        traffic: Traffic mode.
        controller: How a plan moves the ego.
        thresholds: Threshold profile.
        metrics: Own metrics, by `module:attribute`.
        keep_rollouts: Whether results carry their rollout.
    """

    store: Path
    planners: Mapping[str, PlannerEntry]
    noises: Mapping[str, NoiseModel]
    traffic: str
    controller: str
    thresholds: str
    metrics: tuple[str, ...]
    keep_rollouts: bool
    _open: Any = field(default=None, init=False)
    _made: dict[str, Planner] = field(default_factory=dict, init=False)
    _last: Scenario | None = field(default=None, init=False)

    def __call__(self, task: Task) -> TaskResult:
        """The result of one task."""
        result = attempt(task, partial(self._do, task))
        if result.status != "ok":
            # a planner that failed may be in any state: the next task gets a new one
            self._made.pop(task.planner, None)
        return result

    def _do(self, task: Task, seconds: dict[str, float], result: TaskResult) -> TaskResult:
        with _measured(seconds, "read_seconds"):
            scenario = self._read(task.token)
        with _measured(seconds, "simulate_seconds"):
            log = self._simulate(scenario, task)
        seconds |= planning_times(log)
        with _measured(seconds, "metrics_seconds"):
            scores, metrics = score_rollout(
                scenario,
                log,
                thresholds=self.thresholds,
                traffic=self.traffic,
                metrics=self.metrics,
            )
        return replace(
            result,
            scenario_type=scenario.scenario_type,
            scores=scores,
            metrics=metrics,
            log=log if self.keep_rollouts else None,
        )

    def _read(self, token: str) -> Scenario:
        if self._open is None:
            from shiftsim.data.store import open_store

            self._open = open_store(self.store)
        if self._last is None or self._last.token != token:
            self._last = self._open.read(token)
        return self._last

    def _simulate(self, scenario: Scenario, task: Task) -> SimulationLog:
        from shiftsim.simulation import simulate

        planner = self._made.get(task.planner)
        if planner is None and self.controller != "log-playback":
            planner = self._made[task.planner] = self.planners[task.planner].make()
        return simulate(
            scenario,
            planner,
            noise=self.noises[task.noise],
            seed=task.seed,
            traffic=self.traffic,
            controller=self.controller,
        )

    def close(self) -> None:
        """Let the planners release what they hold."""
        for planner in self._made.values():
            _close(planner)
        self._made.clear()


def attempt(task: Task, work: Callable[[dict[str, float], TaskResult], TaskResult]) -> TaskResult:
    """The result of a piece of work; whatever goes wrong becomes its error text.

    Args:
        task: The task.
        work: Fills the durations it is given, and completes the result it is given.
    """
    result = TaskResult(task, "ok")
    try:
        return work(result.seconds, result)
    except Exception as error:  # the one place: a task that fails is a row, not the end of a run
        return replace(
            result,
            status="failed",
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


def _close(planner: object) -> None:
    close = getattr(planner, "close", None)
    if callable(close):
        close()


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
