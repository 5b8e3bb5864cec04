"""Carry out a run: do its tasks, in worker processes or in this one, into one run folder."""

import logging
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, TypeAlias

from shiftsim.errors import DataError
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.manifest import make_manifest, now
from shiftsim.runs.prepare import RunPlan
from shiftsim.runs.results import Run, open_run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import BUNDLE, bundle_run
from shiftsim.runs.tables import FAILED, OK, TIMEOUT, TaskResult
from shiftsim.runs.task import Batch
from shiftsim.runs.workers import Outcome, map_on_cluster, map_unordered

_LOG = logging.getLogger(__name__)
ALONE = "run this scenario alone with --workers 1 to see why"  # hint where a worker has died


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is."""

    done: int  # tasks that have ended, failed ones and those of an earlier attempt included
    total: int  # tasks of the run
    failed: int  # tasks that failed, in this attempt
    # time spent so far by purpose, over all workers [s]
    seconds: dict[str, float] = field(default_factory=dict)
    # what has ended since the last call, those of an earlier attempt first; to be read once
    news: Iterable[TaskResult] = ()

    def __add__(self, other: "Progress") -> "Progress":
        names = {**self.seconds, **other.seconds}
        seconds = {n: self.seconds.get(n, 0.0) + other.seconds.get(n, 0.0) for n in names}
        counts = self.done + other.done, self.total + other.total, self.failed + other.failed
        return Progress(*counts, seconds, other.news)


OnProgress: TypeAlias = Callable[[Progress], None]


def execute(
    plan: RunPlan, *, on_progress: OnProgress = lambda progress: None, argv: Sequence[str] = ()
) -> Run:
    """Do all tasks and write the run folder; an interrupt leaves the others missing in it."""
    try:
        if plan.config.resumes and plan.before == "complete":
            return _bundled(open_run(plan.folder), plan)
        return _execute(plan, argv, on_progress)
    except OSError as error:
        raise DataError(
            f"run {str(plan.folder)!r} cannot be written: {error.strerror or error}",
            hint="check path and disk; what is finished is kept, and --resume goes on with it",
        ) from error
    finally:
        plan.close_planners()


def _execute(plan: RunPlan, argv: Sequence[str], on_progress: OnProgress) -> Run:
    config, selection = plan.config, plan.selection
    manifest = make_manifest(
        plan.folder, config, plan.fingerprint, split=selection.split, store=plan.store, argv=argv
    )
    manifest |= {"workers": plan.workers, "split_size": selection.size}
    if selection.edits is not None:
        manifest["edits"] = {**selection.edits.to_dict(), "made": dict(selection.edited)}
    if config.shard:  # what the whole run would be, for `merge`
        manifest["tokens"] = sorted(selection.tokens)
    reasons = dict.fromkeys(plan.missing, "the store does not hold this scenario")
    state = "finished"
    with closing(RunWriter(plan.folder, manifest, resume=config.resumes)) as writer:
        try:
            _do_tasks(plan, writer, on_progress)
        except KeyboardInterrupt:
            if plan.before == "complete":
                raise
            state = "interrupted"
        manifest |= {"state": state, "ended": now()}
        run = writer.finish(manifest, (*plan.tasks, *plan.missing), reasons)
        _bundled(run, plan)
    if state == "interrupted":
        raise KeyboardInterrupt
    return run


def _bundled(run: Run, plan: RunPlan) -> Run:
    """The run; with its scenarios where it shall have them, or had them before."""
    if plan.config.bundle or (plan.folder / BUNDLE).is_dir():
        bundle_run(run, plan.store)
    return run


def _do_tasks(plan: RunPlan, writer: RunWriter, on_progress: OnProgress) -> None:
    """Do what is not finished."""
    statuses = {task: record.status for task, record in writer.ended.items()}
    batches = remaining(plan.batches, statuses, retry=plan.config.retry_failed)
    todo = {task for batch in batches for task in batch}
    earlier, warned = (writer.result(task) for task in statuses if task not in todo), set[str]()
    progress = Progress(len(plan.tasks) - len(todo), len(plan.tasks), 0)
    with closing(_results(plan, batches)) as found:
        for results in found:
            for result in results:
                writer.add(result)
                progress += Progress(1, 0, int(result.status != OK), result.seconds)
                if result.warning and result.task.planner not in warned:
                    warned.add(result.task.planner)
                    _LOG.warning("planner %s: %s", result.task.planner, result.warning)
            on_progress(replace(progress, news=chain(earlier, results)))


def remaining(batches: Iterable[Batch], ended: Mapping[Task, str], *, retry: bool) -> list[Batch]:
    """Batches that are left, each as a whole: its results may depend on one another."""
    out: list[Batch] = []
    for batch in batches:
        failed = tuple(task for task in batch if ended.get(task) in (FAILED, TIMEOUT))
        if not all(task in ended for task in batch):
            out.append(batch)
        elif retry and failed:
            out.append(failed)
    return out


def _results(plan: RunPlan, batches: Sequence[Batch]) -> Generator[list[TaskResult], None, None]:
    """The results of each batch, in whatever order they end."""
    with _networks_in_background(plan) if plan.shared else nullcontext(plan) as plan:
        options: dict[str, Any] = {
            "alone": min(len(plan.config.planners), len(batches)),
            "limit": plan.config.timeout,
            "in_batches": True,
        }
        if plan.config.executor == "dask":
            scheduler = plan.config.scheduler
            outcomes = map_on_cluster(plan.runner(), batches, scheduler=scheduler, **options)
        else:
            options |= {"workers": plan.workers, "group": lambda batch: batch[0].token}
            outcomes = map_unordered(plan.runner(), batches, **options)
        with closing(outcomes):
            yield from map(results_of, outcomes)


@contextmanager
def _networks_in_background(plan: RunPlan) -> Iterator[RunPlan]:
    """The plan with planners that ask one process, which holds the networks they share."""
    from shiftsim.planners.learned.owner import InferenceClient, InferenceServer, new_address
    from shiftsim.processes import in_background

    address = new_address()
    makers = {name: plan.planners[name].make for name in plan.shared}
    asking = {
        name: replace(plan.planners[name], ask=InferenceClient(address, name))
        for name in plan.shared
    }
    with in_background(partial(InferenceServer, makers, address)):
        yield replace(plan, planners={**plan.planners, **asking})


def results_of(outcome: Outcome[Batch, list[TaskResult]]) -> list[TaskResult]:
    """The results of a batch, whose worker may have died."""
    if outcome.result is not None:
        return outcome.result
    status = TIMEOUT if outcome.is_late else FAILED
    return [TaskResult(task, status, error=outcome.death, hint=ALONE) for task in outcome.task]
