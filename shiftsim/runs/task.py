"""Tasks of a run: read the scenario, drive it, score it, and never raise.

This runs in a worker, on one batch of tasks after the other: a batch is one task, or several of a
planner that answers for all of them with one forward pass. It holds what is worth keeping between
them: the open store, what copies of each planner are made from, and the last scenario.
"""

import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
import pyarrow as pa

from shiftsim.data.store.reading import ScenarioStore, open_store
from shiftsim.errors import ConfigError, ShiftsimError, readable
from shiftsim.files import place_of
from shiftsim.metrics import METRIC_VERSION, SHORT_NAMES, MetricRow, compute_metrics, open_loop
from shiftsim.metrics.score import without
from shiftsim.planners.registry import RunPlanner
from shiftsim.runs.config import RunConfig
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import encode_rows, rollout_rows
from shiftsim.runs.tables import FAILED, OK, TABLES, TaskResult
from shiftsim.sim import loop
from shiftsim.sim.log import Setting, SimulationLog
from shiftsim.sim.loop import Rollout
from shiftsim.sim.noise import is_standard
from shiftsim.sim.perception import Drift
from shiftsim.sim.planner import Planner
from shiftsim.sim.traffic import BatchTraffic, Traffic, make_traffic
from shiftsim.world.scenario import Scenario

if TYPE_CHECKING:
    from shiftsim.runs.edited import EditSet

T = TypeVar("T")


# what a worker is handed at once: one task, or several of one planner that are driven in lock step
Batch: TypeAlias = tuple[Task, ...]


class ScenarioReader:
    """A store that is opened when it is needed, and the scenario that was read last."""

    def __init__(self, store: str, edits: "EditSet | None" = None) -> None:
        self.store, self.edits = store, edits
        self._open: ScenarioStore | None = None
        self._last: Scenario | None = None

    def read(self, token: str) -> Scenario:
        """A scenario; several tasks on one follow each other."""
        if self._open is None:
            self._open = open_store(self.store)
            if self.edits is not None:
                from shiftsim.runs.edited import EditedStore

                self._open = EditedStore(self._open, self.edits)
        if self._last is None or self._last.token != token:
            self._last = self._open.read(token)
        return self._last


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Measure what is done within, whether it succeeds or not."""
    began = perf_counter()
    try:
        yield
    finally:
        seconds[name] = perf_counter() - began


class TaskRunner:
    """Does batches of tasks, one after the other."""

    def __init__(
        self,
        config: RunConfig,
        store: str,
        planners: Mapping[str, RunPlanner],
        noises: Mapping[str, Drift],
        edits: "EditSet | None" = None,
    ) -> None:
        """Planners and drifts are by name; one of the traffic is a planner, too."""
        self.config, self.planners, self.noises = config, planners, noises
        self.edits = edits
        self._scenarios = ScenarioReader(store, edits)
        self._network: BatchTraffic | None = None

    def __call__(self, batch: Batch) -> list[TaskResult]:
        """One result per task; several are driven in lock step, and each fails for itself."""
        seconds = {task: dict[str, float]() for task in batch}
        found = {task: attempt(task, partial(self._begin, task, seconds[task])) for task in batch}
        rollouts = {task: one for task, one in found.items() if isinstance(one, Rollout)}
        began = perf_counter()
        logs: Sequence[SimulationLog | BaseException]
        try:
            if len(batch) > 1:
                logs = loop.simulate_together(list(rollouts.values()))
            else:
                logs = [loop.drive(rollout) for rollout in rollouts.values()]
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            if len(batch) > 1:  # the shared pass itself failed: too little memory for all of them?
                return [result for task in batch for result in self((task,))]
            logs = [error]
        finally:
            for task, rollout in rollouts.items():
                self._release(task, rollout.planner)
        share = (perf_counter() - began) / max(1, len(rollouts))
        for (task, rollout), log in zip(rollouts.items(), logs, strict=True):
            seconds[task]["simulate_seconds"] += share
            result = attempt(task, partial(self._score, task, rollout, log, seconds[task]))
            if isinstance(log, BaseException) and not isinstance(log, ShiftsimError):
                result = replace(result, error=f"{result.error} (at iteration {rollout.iteration})")
            found[task] = result
        return [
            replace(result, seconds=seconds[task])
            for task, result in found.items()
            if isinstance(result, TaskResult)
        ]

    def _begin(self, task: Task, seconds: dict[str, float]) -> Rollout:
        with _timed(seconds, "read_seconds"):
            scenario = self._scenarios.read(task.token)
        with _timed(seconds, "simulate_seconds"):
            planner = self._planner(task)
            try:
                setting = Setting(
                    noise=self.noises[task.noise],
                    seed=task.seed,
                    traffic=self._make_traffic(),
                    controller=self.config.controller,
                    strict=self.config.strict,
                )
                return Rollout(scenario, planner, setting)
            except BaseException:
                self._release(task, planner)
                raise

    def _score(
        self,
        task: Task,
        rollout: Rollout,
        log: SimulationLog | BaseException,
        seconds: dict[str, float],
    ) -> TaskResult:
        if isinstance(log, BaseException):
            raise log
        scenario, warning = rollout.scenario, rollout.warning
        seconds.update(planner_times(log))
        with _timed(seconds, "metrics_seconds"):
            scores, metrics = score_rollout(scenario, log, self.config)
        if self.config.open_loop and rollout.planner is not None:
            profile = {name: scores[name] for name in ("thresholds", "metric_version")}
            try:
                rows = self._open_loop(task, scenario)
                metrics += [_metric_row(row, int(log.time_us[0]), profile) for row in rows]
            except ShiftsimError as error:  # closed loop has its score
                warning = f"no open-loop score: {error.message}; {error.hint}"
        keep, encoded = self.config.save_rollouts, b""
        if keep == "all" or (keep == "failed" and scores["cls"] == 0.0):
            # pedestrians of an edit wait for the ego
            own_tracks = self.config.traffic != "nonreactive" or self.edits is not None
            own_noise = not is_standard(self.noises[task.noise].noise)
            with_seen = any(drift.senses for drift in self.noises.values())  # as other rollouts
            rows = rollout_rows(
                log, with_tracks=own_tracks, with_noise=own_noise, with_seen=with_seen
            )
            encoded = encode_rows(rows)
        return TaskResult(
            task,
            OK,
            scenario.scenario_type,
            scores=scores,
            metrics=metrics,
            rollout=encoded,
            warning=warning,
        )

    def _open_loop(self, task: Task, scenario: Scenario) -> list[MetricRow]:
        """Scores of the plans that a fresh planner makes along the recording."""
        planner = self._planner(task)
        assert planner is not None
        try:
            plans = loop.plans_on_recording(scenario, planner, open_loop.EVERY, seed=task.seed)
        finally:
            self._release(task, planner)
        poses = [open_loop.Poses(plan.time_us, plan.states[:, :3]) for plan in plans]
        return open_loop.metric_rows(poses, scenario)

    def _planner(self, task: Task) -> Planner | None:
        """The planner of a task, which has nothing of other tasks."""
        if self.config.controller == "log-playback":
            return None
        return self.planners[task.planner].prototype.copy()

    def _release(self, task: Task, planner: Planner | None) -> None:
        if planner is not None:
            self.planners[task.planner].prototype.release(planner)

    def _make_traffic(self) -> Traffic:
        """The traffic of one rollout; a network is loaded once."""
        if (planner := self.planners.get(self.config.traffic)) is not None:
            from shiftsim.sim.traffic.planned import PlannedTraffic

            return PlannedTraffic(planner.prototype.copy)
        if self._network is None:
            model = make_traffic(self.config.traffic, self.config.device)
            if not isinstance(model, BatchTraffic):
                return model
            self._network = model
        return self._network.fork()

    def close(self) -> None:
        """Let the planners release what they hold."""
        for planner in self.planners.values():
            planner.close()


def attempt(task: Task, work: Callable[[], T]) -> T | TaskResult:
    """What a piece of work returns or, whatever goes wrong, the failed result of its task."""
    try:
        return work()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit as well
        # the one place: a task that fails is a row, not the end of a run
        is_ours = isinstance(error, ShiftsimError)
        kind = "" if is_ours else f"{type(error).__name__}: "
        where = "" if is_ours else place_of(error)
        hint = f"repair {where}, which is no part of shiftsim" if where else ""
        return TaskResult(
            task,
            FAILED,
            error=kind + readable(getattr(error, "message", error) if is_ours else error),
            hint=readable(getattr(error, "hint", "") if is_ours else hint),
            traceback=readable(traceback.format_exc()),
        )


def planner_times(log: SimulationLog) -> dict[str, float]:
    """What the planner of a rollout took, by column of `tasks.parquet`."""
    per_step = log.planning_seconds * 1e3
    return {
        "planner_seconds": float(log.planning_seconds.sum()),
        "planning_ms_mean": float(per_step.mean()),
        "planning_ms_p95": float(np.percentile(per_step, 95)),
    }


def score_rollout(
    scenario: Scenario, log: SimulationLog, config: RunConfig, undefined: Collection[str] = ()
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """A row of `scores.parquet` and rows of `metrics.parquet`, without what is `undefined`."""
    result = compute_metrics(log, scenario, thresholds=config.thresholds, own=config.metrics)
    if scenario.script is not None and scenario.script.profile == "interplan":
        from shiftsim.metrics.interplan import add_interplan

        result = add_interplan(result, log, scenario.map, scenario.script)
    if undefined:
        result = without(result, undefined)
    profile = {"thresholds": config.thresholds, "metric_version": METRIC_VERSION}
    scores = {
        "scenario_type": scenario.scenario_type,
        "city": scenario.city,
        "duration_class": scenario.duration_class,
        "log_name": scenario.log_name,
        "traffic": config.traffic,
        "cls": None if undefined else result.score,
        **{name: result.scores[name] for name in SHORT_NAMES if name != "score"},
        "degraded_steps": int(log.degraded.sum()),
        **profile,
    }
    start_us = int(log.time_us[0])
    order = {name: place for place, name in enumerate(SHORT_NAMES)}
    ordered = sorted(result.rows, key=lambda row: order.get(row.metric, len(order)))
    custom = [_metric_row(row, start_us, profile) for row in result.extra]
    try:  # what metrics of users return is read back as the table will hold it
        custom = list(pa.Table.from_pylist(custom, _METRIC_COLUMNS).to_pylist())
    except (pa.ArrowException, UnicodeError, TypeError, ValueError) as error:
        raise ConfigError(
            f"a custom metric returned what metrics.parquet cannot hold: {error}",
            hint="return a number, or a MetricRow of texts and numbers",
        ) from error
    for row in custom:
        score, at = row["score"], row["first_violation_iteration"]
        if score is not None and not 0.0 <= score <= 1.0:
            what = f"metric {row['metric']!r} has score {score:g}"
            raise ConfigError(what, "a score is from 0 to 1, or None; other numbers are a value")
        times = log.time_us[at : at + 1] if at is not None and at >= 0 else ()
        if at is not None and row["first_violation_time_us"] not in times:
            what = f"metric {row['metric']!r} has a violation at iteration {at}"
            raise ConfigError(what, f"from 0 to {len(log.time_us) - 1}, with its log.time_us")
    return scores, [*(_metric_row(row, start_us, profile) for row in ordered), *custom]


_METRIC_COLUMNS = pa.schema(
    [column for column in TABLES["metrics"] if column.name not in Task._fields]
)


def _metric_row(row: MetricRow, start_us: int, profile: Mapping[str, str]) -> dict[str, Any]:
    plain = ("metric", "value", "unit", "threshold", "score")
    values = dict.fromkeys(_METRIC_COLUMNS.names) | {name: getattr(row, name) for name in plain}
    if (first := row.violation) is not None:
        values |= {
            "first_violation_iteration": first.iteration,
            "first_violation_time_us": first.time_us,
            "first_violation_s": (first.time_us - start_us) * 1e-6,
            "first_violation_value": first.value,
            "partner_token": first.partner,
        }
    return {**values, **profile}
