"""Many rollouts: scenarios x planners x noises x seeds, in worker processes, into one run folder.

Two steps: `prepare` checks everything that can be checked before the first simulated step, and
`execute` does the tasks.
"""

import logging
import os
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from operator import attrgetter
from threading import get_ident
from typing import TYPE_CHECKING, Any, NoReturn, TypeAlias

from shiftsim.errors import DataError
from shiftsim.planners.registry import RunPlanner, planner_name
from shiftsim.runs.config import make_config
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.manifest import make_manifest, now
from shiftsim.runs.prepare import Prepared, prepare
from shiftsim.runs.results import FAILED, OK, TIMEOUT, Run, TaskResult, open_run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import open_named_store, write_bundle
from shiftsim.runs.task import Batch, TaskRunner
from shiftsim.sim.noise import NOISE_NAMES, NoiseModel, parse_noise

if TYPE_CHECKING:
    from shiftsim.runs.workers import MakeFunction, Outcome

_LOG = logging.getLogger(__name__)


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

    def after(self, result: TaskResult) -> "Progress":
        """The progress after one more result."""
        return self + Progress(1, 0, int(result.status != OK), result.seconds)

    def __add__(self, other: "Progress") -> "Progress":
        names = {**self.seconds, **other.seconds}
        seconds = {n: self.seconds.get(n, 0.0) + other.seconds.get(n, 0.0) for n in names}
        return Progress(
            self.done + other.done,
            self.total + other.total,
            self.failed + other.failed,
            seconds,
            other.news,
        )


Watch: TypeAlias = Callable[[Progress], None]


def execute(
    prepared: Prepared, *, on_progress: Watch = lambda progress: None, argv: Sequence[str] = ()
) -> Run:
    """Do all tasks and write the run folder.

    Whatever happens, what is finished is on disk and can be resumed. An interrupt writes the tables
    with the other tasks `missing`, and `KeyboardInterrupt` is raised again; a complete run is never
    replaced by an incomplete one. `argv` is for the manifest.

    Raises:
        DataError: The folder cannot be written.
    """
    if prepared.config.resumes and prepared.before == "complete":
        return open_run(prepared.folder)
    manifest = make_manifest(
        prepared.folder,
        config=prepared.config,
        split=prepared.split,
        store=prepared.store,
        determining=prepared.determining,
        argv=argv,
    )
    manifest["workers"] = prepared.workers
    if prepared.edits is not None:
        manifest["edits"] = {**prepared.edits.to_dict(), "made": dict(prepared.made)}
    if prepared.config.shard:  # what the whole run would be, for `merge`
        manifest["tokens"] = sorted(prepared.tokens)
    try:
        return _execute(prepared, manifest, on_progress)
    except OSError as error:
        raise DataError(
            f"run {str(prepared.folder)!r} cannot be written: {error.strerror or error}",
            hint="check path and disk; what is finished is kept, and --resume goes on with it",
        ) from error


def _execute(prepared: Prepared, manifest: dict[str, Any], on_progress: Watch) -> Run:
    writer = RunWriter(prepared.folder, manifest, resume=prepared.config.resumes)
    try:
        interrupted = _do_batches(prepared, writer, on_progress)
        if interrupted and prepared.before == "complete":
            raise KeyboardInterrupt
        state = "interrupted" if interrupted else "finished"
        if prepared.config.bundle:
            store = open_named_store(prepared.store)
            tokens = {task.token for task in prepared.tasks}
            if prepared.edits is not None:
                edited = prepared.edits.over(store)
                tokens = {edited.base(token) for token in tokens}
            manifest["bundle"] = write_bundle(store, prepared.folder, tokens)
        missing = set(prepared.missing)
        run = writer.finish(
            {**manifest, "state": state, "ended": now()},
            (*prepared.tasks, *prepared.missing),
            lambda task: (
                "the store does not hold this scenario"
                if task in missing
                else "the run was interrupted"
            ),
        )
    finally:
        writer.close()
    if interrupted:
        raise KeyboardInterrupt
    return run


def _do_batches(prepared: Prepared, writer: RunWriter, on_progress: Watch) -> bool:
    """Do what is not finished; returns whether the user interrupted."""
    statuses = {task: ended.status for task, ended in writer.ended.items()}
    todo = remaining(prepared.batches, statuses, retry=prepared.config.retry_failed)
    total = len(prepared.tasks)
    progress = Progress(total - sum(len(batch.tasks) for batch in todo), total, 0)
    again = {task for batch in todo for task in batch.tasks}
    earlier = (result for result in writer.results() if result.task not in again)

    def tell(progress: Progress) -> None:
        on_progress(replace(progress, news=chain(earlier, progress.news)))

    try:
        with closing(_results(prepared, todo)) as results:
            record(results, writer.add, progress, tell)
    except KeyboardInterrupt:
        return True
    return False


def record(
    batches: Iterable[list[TaskResult]],
    add: Callable[[TaskResult], None],
    progress: Progress,
    on_progress: Watch,
) -> None:
    """Put results on disk as they come, batch by batch, and tell how far the run is."""
    doubted = set[str]()
    for results in batches:
        for result in results:
            add(result)
            progress = progress.after(result)
            if result.doubt and result.task.planner not in doubted:
                doubted.add(result.task.planner)
                _LOG.warning("planner %s: %s", result.task.planner, result.doubt)
        on_progress(replace(progress, news=results))


def remaining(batches: Iterable[Batch], ended: Mapping[Task, str], *, retry: bool) -> list[Batch]:
    """What is left to do of a run, by the status of the tasks that have ended.

    A batch that is not finished is done as a whole again: its results may depend on one another in
    the last digits. `retry` does those that failed again, too.
    """
    out: list[Batch] = []
    for batch in batches:
        failed = tuple(task for task in batch.tasks if ended.get(task) in (FAILED, TIMEOUT))
        if not all(task in ended for task in batch.tasks):
            out.append(batch)
        elif retry and failed:
            out.append(Batch(failed))
    return out


def _results(
    prepared: Prepared, batches: Sequence[Batch]
) -> Generator[list[TaskResult], None, None]:
    """The results of each batch, in whatever order they end."""
    config = prepared.config
    with _networks_beside(prepared) as (planners, traffic):
        given = config, prepared.store, planners, prepared.noises
        make = partial(TaskRunner, *given, traffic, prepared.edits)
        if config.executor != "dask" and prepared.workers <= 1 and not config.timeout:
            with closing(make()) as run_batch, _no_exit():
                for batch in batches:
                    yield run_batch(batch)
            return
        with closing(_outcomes(prepared, make, batches)) as outcomes:
            yield from map(ended, outcomes)


@contextmanager
def _networks_beside(
    prepared: Prepared,
) -> Iterator[tuple[Mapping[str, RunPlanner], RunPlanner | None]]:
    """The planners, and the one of traffic; those that share a device ask its owner."""
    planners, traffic, name = dict(prepared.planners), prepared.traffic, prepared.config.traffic
    if not prepared.shared:
        yield planners, traffic
        return
    from shiftsim.planners.learned.owner import InferenceClient, InferenceServer, new_address
    from shiftsim.processes import in_background

    known = planners | ({name: traffic} if traffic else {})
    address = new_address()
    asking = {
        who: replace(known[who], ask=InferenceClient(address, who)) for who in prepared.shared
    }
    with in_background(
        partial(InferenceServer, {who: known[who].make for who in prepared.shared}, address)
    ):
        yield {who: asking.get(who, planners[who]) for who in planners}, asking.get(name, traffic)


@contextmanager
def _no_exit() -> Iterator[None]:
    """Have a planner that calls `os._exit` fail its task, as it does where a worker dies of it.

    Else the command would end without a word or a table, and with the code that the planner chose.
    Other threads, and processes that a planner forks, leave as they like.
    """
    leave, here = os._exit, (os.getpid(), get_ident())

    def refuse(status: int) -> NoReturn:
        if (os.getpid(), get_ident()) != here:
            leave(status)
        raise SystemExit(f"os._exit({status})")

    os._exit = refuse
    try:
        yield
    finally:
        os._exit = leave


def _outcomes(
    prepared: Prepared, make: "MakeFunction[Batch, list[TaskResult]]", batches: Sequence[Batch]
) -> "Generator[Outcome[Batch, list[TaskResult]], None, None]":
    """What becomes of each batch in worker processes."""
    config = prepared.config
    leading = min(len(prepared.planners), len(batches))
    if config.executor == "dask":
        from shiftsim.runs.cluster import map_on_cluster

        return map_on_cluster(
            make,
            batches,
            scheduler=config.scheduler,
            alone=leading,
            limit=config.timeout,
            pieces=Batch.split,
        )
    from shiftsim.runs.workers import map_unordered

    return map_unordered(
        make,
        batches,
        workers=prepared.workers,
        alone=leading,
        limit=config.timeout,
        pieces=Batch.split,
        group=attrgetter("token"),
    )


def ended(outcome: "Outcome[Batch, list[TaskResult]]") -> list[TaskResult]:
    """The results of a batch, whose worker may have died."""
    if outcome.result is not None:
        return outcome.result
    status = TIMEOUT if outcome.is_late else FAILED
    hint = "run this scenario alone with --workers 1 to see why"
    return [TaskResult(task, status, error=outcome.death, hint=hint) for task in outcome.task.tasks]


def run(
    planner: Any,
    *,
    noise: str | NoiseModel | Sequence[str | NoiseModel] = "none",
    seeds: int | Iterable[int] = 0,
    on_progress: Watch = lambda progress: None,
    **settings: Any,
) -> Run:
    """Simulate and score planners on scenarios, as `shiftsim run` does.

    Args:
        planner: A name, `package.module:Class`, a class or an instance, or a list of those.
            Classes and instances of the main script run in this process.
        noise: Name or model, or a list of them.
        seeds: Seeds of the noise.
        on_progress: Called after every task.
        settings: The other settings of `RunConfig`: `store`, `split`, `limit`, `traffic`,
            `thresholds`, `workers`, `out`, …

    Returns:
        The finished run; print `.table()`.

    Raises:
        ShiftsimError: A setting is wrong, or something it names is missing.
    """
    sources = list(planner) if isinstance(planner, (list, tuple)) else [planner]
    models = [noise] if isinstance(noise, (str, NoiseModel)) else list(noise)
    made = [m if isinstance(m, NoiseModel) else parse_noise(m) for m in models if m != "all"]
    if "all" in [model for model in models if isinstance(model, str)]:
        made += [parse_noise(name) for name in NOISE_NAMES]
    values = {
        "planners": [planner_name(source) for source in sources],
        "noise": [model.name for model in made],
        "seeds": [seeds] if isinstance(seeds, int) else list(seeds),
        **settings,
    }
    prepared = prepare(make_config(values), planners=sources, noises=made)
    return execute(prepared, on_progress=on_progress)
