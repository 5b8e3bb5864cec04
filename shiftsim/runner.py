"""Many rollouts: scenarios x planners x noises x seeds, in worker processes, into one run folder.

Two steps: `prepare` checks everything that can be checked before the first simulated step, and
`execute` does the tasks. What was checked is what is run.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import shiftsim
from shiftsim.config import DEFAULT_STORE, RunConfig, default_workers, make_config, store_path
from shiftsim.errors import ConfigError, DataError
from shiftsim.executors import Outcome, map_unordered
from shiftsim.filtering import Verdicts, read_verdicts
from shiftsim.manifest import make_manifest, now
from shiftsim.metrics import METRIC_VERSION, load_metric, thresholds_of
from shiftsim.noise import NOISE_NAMES, NoiseModel, parse_noise
from shiftsim.results import Run, RunWriter, TaskResult, check_target, open_run
from shiftsim.rollouts import Task
from shiftsim.splits import find_split, token_hash
from shiftsim.tasks import PlannerEntry, TaskRunner, can_travel, planner_entry, planner_name
from shiftsim.traffic import make_traffic, traffic_name

RUNS = Path("runs")
_MAX_NAME = 40  # characters of one part of a run's name


@dataclass(frozen=True)
class Prepared:
    """A run that has been checked and can start.

    Attributes:
        config: The settings, names resolved.
        runner: Does one task.
        tasks: All tasks whose scenario exists, in the order they are handed out.
        missing: Tasks whose scenario the store does not hold.
        split: Name of the split.
        determining: Everything that the scores depend on.
        folder: Where the run folder will be.
        workers: Number of worker processes.
        num_dropped: Scenarios left out because the filter dropped them.
    """

    config: RunConfig
    runner: TaskRunner
    tasks: tuple[Task, ...]
    missing: tuple[Task, ...]
    split: str
    determining: dict[str, Any]
    folder: Path
    workers: int
    num_dropped: int = 0

    @property
    def num_expected(self) -> int:
        """Tasks that a complete run has."""
        return len(self.tasks) + len(self.missing)


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is.

    Attributes:
        done: Tasks that have ended, failed ones included.
        total: Tasks to do.
        failed: Tasks that failed.
        seconds: Time spent so far by purpose, over all workers [s].
    """

    done: int
    total: int
    failed: int
    seconds: dict[str, float] = field(default_factory=dict)


def open_named_store(name: str) -> Any:
    """A store by name or path; the demo store is made when it is not there yet."""
    from shiftsim.data.store import open_store

    path = store_path(name)
    if name == DEFAULT_STORE and not path.exists():
        from shiftsim.data.synthetic import demo_store

        path = demo_store(path)
    if not path.exists():
        known = sorted(found.name for found in path.parent.glob("*") if found.is_dir())
        raise DataError(
            f"no store {name!r} at {str(path)!r}",
            hint=f"there are: {', '.join(known)}" if known else "make one with `shiftsim convert`",
        )
    return open_store(path)


def prepare(
    config: RunConfig,
    *,
    planners: Sequence[Any] = (),
    noises: Sequence[NoiseModel] = (),
) -> Prepared:
    """Resolve every name and check everything that a run needs.

    Args:
        config: The settings; `planners` and `noise` name what the next two hold, if given.
        planners: Classes or instances that take the place of the names.
        noises: Noise models that take the place of the names.

    Raises:
        ShiftsimError: Something is unknown, missing or contradictory.
    """
    models = list(noises) or [parse_noise(name) for name in _expanded(config.noise)]
    config = replace(
        config,
        noise=tuple(model.name for model in models),
        traffic=traffic_name(config.traffic),
    )
    _check_traffic(config.traffic)
    thresholds = asdict(thresholds_of(config.thresholds))
    for metric in config.metrics:
        load_metric(metric)
    entries = [
        planner_entry(source, config.planner_args.get(name, {}))
        for name, source in zip(config.planners, planners or config.planners, strict=True)
    ]
    store = open_named_store(config.store)
    known = tuple(store.tokens)
    verdicts = _verdicts(config, store)
    usable = known if verdicts is None else verdicts.accepted
    split = find_split(config.split, Path(store.path), usable)
    chosen = split.tokens[: config.limit] if config.limit else split.tokens
    lacking = sorted(set(chosen) - set(known))
    if lacking and not config.allow_partial:
        raise DataError(
            f"split {split.name!r} needs {len(chosen)} scenarios, store {config.store!r} "
            f"lacks {len(lacking)} of them, such as {lacking[0]!r}",
            hint="convert the missing scenarios, or --allow-partial",
        )
    if len(lacking) == len(chosen):
        raise DataError(
            f"split {split.name!r}: store {config.store!r} holds none of its scenarios",
            hint="name the store that was converted for this split",
        )
    determining = _determining(config, entries, models, thresholds, store.hash, chosen)
    if verdicts is not None:
        determining["filter"] = verdicts.hash
    folder = Path(config.out) if config.out else RUNS / run_name(config, split.name, determining)
    check_target(folder, determining)
    present = [token for token in chosen if token not in set(lacking)]
    runner = TaskRunner(
        Path(store.path).resolve(),
        {entry.name: entry for entry in entries},
        {model.name: model for model in models},
        config.traffic,
        config.controller,
        config.thresholds,
        config.metrics,
        config.save_rollouts == "all",
    )
    tasks = _leading_first(list(_tasks(entries, models, config.seeds, present)))
    workers = config.workers or default_workers()
    if not all(map(can_travel, entries)):
        workers = 1
    return Prepared(
        config,
        runner,
        tuple(tasks),
        tuple(_tasks(entries, models, config.seeds, lacking)),
        split.name,
        determining,
        folder,
        max(1, min(workers, len(tasks))),
        len(known) - len(usable),
    )


def _verdicts(config: RunConfig, store: Any) -> Verdicts | None:
    """The verdicts that decide which scenarios of a whole store are run.

    A split names its scenarios itself.
    """
    if config.all_scenarios or config.split not in ("", store.path.name):
        return None
    found = read_verdicts(store.path, store.hash)
    if found is not None and not found.accepted:
        raise DataError(
            f"store {config.store!r}: the filter dropped all {len(found.rows)} scenarios",
            hint="`shiftsim filter` says why; --all to use them nevertheless",
        )
    return found


def _expanded(names: Iterable[str]) -> list[str]:
    """`all` stands for the seven of the benchmark."""
    out = [name for given in names for name in (NOISE_NAMES if given == "all" else (given,))]
    return list(dict.fromkeys(out))


def _check_traffic(name: str) -> None:
    try:
        make_traffic(name)
    except (ImportError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"traffic {name!r} is not available: {error}", hint="use --traffic nonreactive"
        ) from error


def _tasks(
    entries: Iterable[PlannerEntry],
    models: Iterable[NoiseModel],
    seeds: Iterable[int],
    tokens: Iterable[str],
) -> Iterator[Task]:
    """All tasks, scenario by scenario, so that a worker can often reuse the one it has read."""
    runs = [
        (entry.name, model.name, seed)
        for entry in entries
        for model in models
        for seed in ((0,) if model.kind == "none" else seeds)
    ]
    return (Task(*run, token) for token in tokens for run in runs)


def _leading_first(tasks: list[Task]) -> list[Task]:
    """One task per planner and kind of noise to the front: they compile all the kernels."""
    leading: dict[tuple[str, str], Task] = {}
    for task in tasks:
        leading.setdefault((task.planner, task.noise), task)
    first = list(leading.values())
    return first + [task for task in tasks if task not in set(first)]


def _determining(
    config: RunConfig,
    entries: Sequence[PlannerEntry],
    models: Sequence[NoiseModel],
    thresholds: dict[str, Any],
    store_hash: str,
    tokens: Iterable[str],
) -> dict[str, Any]:
    """Everything that the scores depend on, as JSON values."""
    noisy = any(model.kind != "none" for model in models)
    fields = {
        "shiftsim": shiftsim.__version__,
        "metric_version": METRIC_VERSION,
        "store": store_hash,
        "tokens": token_hash(tokens),
        "planners": {entry.name: dict(entry.fingerprint) for entry in entries},
        "noise": {model.name: _noise_fields(model) for model in models},
        "seeds": sorted(config.seeds) if noisy else [0],
        "traffic": config.traffic,
        "controller": config.controller,
        "thresholds": thresholds,
        "metrics": sorted(config.metrics),
    }
    plain: dict[str, Any] = json.loads(json.dumps(fields, sort_keys=True, default=str))
    return plain


def _noise_fields(model: NoiseModel) -> dict[str, Any]:
    out = {name: getattr(model, name) for name in ("kind", "sigma_accel", "sigma_rate", "theta")}
    return out | {"function": model.name if model.function is not None else None}


def run_name(config: RunConfig, split: str, determining: dict[str, Any]) -> str:
    """Name of a run's folder: the same settings on the same data give the same name."""
    text = json.dumps(determining, sort_keys=True)
    digest = hashlib.blake2b(text.encode(), digest_size=2).hexdigest()
    planners = _joined(config.planners, "planners")
    return f"{planners}_{_joined(config.noise, 'noises')}_{_joined((split,), 'split')}_{digest}"


def _joined(names: Sequence[str], what: str) -> str:
    text = "+".join(re.sub(r"[^A-Za-z0-9.-]+", "-", name) for name in names)
    return text if len(text) <= _MAX_NAME else f"{len(names)}-{what}"


def execute(
    prepared: Prepared,
    *,
    on_progress: Callable[[Progress], None] = lambda progress: None,
    argv: Sequence[str] = (),
) -> Run:
    """Do all tasks and write the run folder.

    An interrupt keeps what is finished: the folder is written with the other tasks `missing`, and
    `KeyboardInterrupt` is raised again. A complete run is never replaced by an incomplete one.

    Args:
        prepared: The run.
        on_progress: Called after every task.
        argv: The command line, for the manifest.
    """
    config = prepared.config
    started = now()
    reactive = config.traffic != "nonreactive"
    writer = RunWriter(prepared.folder, with_tracks=reactive)
    try:
        for task in prepared.missing:
            writer.add(TaskResult(task, "missing", error="the store does not hold this scenario"))
        interrupted = _do_tasks(prepared, writer, on_progress)
        counts = writer.counts(prepared.num_expected)
        if interrupted and _is_complete(prepared.folder):
            raise KeyboardInterrupt
        manifest = make_manifest(
            prepared.folder,
            config=config,
            split=prepared.split,
            store=prepared.runner.store,
            determining=prepared.determining,
            counts=counts,
            argv=argv,
        )
        manifest |= {"started": started, "workers": prepared.workers}
        if interrupted:
            manifest["state"] = "interrupted"
        run = writer.finish(manifest)
    finally:
        writer.discard()
    if interrupted:
        raise KeyboardInterrupt
    return run


def _do_tasks(
    prepared: Prepared, writer: RunWriter, on_progress: Callable[[Progress], None]
) -> bool:
    """Do the tasks; returns whether the user interrupted."""
    progress = Progress(0, len(prepared.tasks), 0)
    pending = dict.fromkeys(prepared.tasks)
    leading = len(prepared.runner.planners) * len(prepared.runner.noises)
    outcomes = map_unordered(
        partial(_runner, prepared.runner), prepared.tasks, workers=prepared.workers, alone=leading
    )
    try:
        with closing(outcomes):
            for outcome in outcomes:
                result = ended(outcome)
                writer.add(result)
                pending.pop(outcome.task)
                progress = advanced(progress, result)
                on_progress(progress)
    except KeyboardInterrupt:
        for task in pending:
            writer.add(TaskResult(task, "missing", error="the run was interrupted"))
        return True
    return False


def _runner(runner: TaskRunner) -> TaskRunner:
    return runner


def ended(outcome: Outcome[Task, TaskResult]) -> TaskResult:
    """The result of a task, whose worker may have died."""
    if outcome.result is not None:
        return outcome.result
    return TaskResult(
        outcome.task,
        "failed",
        error=outcome.death,
        hint="run this scenario alone with --workers 1 to see why",
    )


def advanced(progress: Progress, result: TaskResult) -> Progress:
    """The progress after one more result."""
    seconds = dict(progress.seconds)
    for name, value in result.seconds.items():
        seconds[name] = seconds.get(name, 0.0) + value
    failed = progress.failed + (result.status != "ok")
    return Progress(progress.done + 1, progress.total, failed, seconds)


def _is_complete(folder: Path) -> bool:
    return folder.exists() and open_run(folder).is_complete


def run(
    planner: Any,
    *,
    noise: str | NoiseModel | Sequence[str | NoiseModel] = "none",
    seeds: int | Iterable[int] = 0,
    on_progress: Callable[[Progress], None] = lambda progress: None,
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
    names = [model for model in models if isinstance(model, str)]
    made = [m if isinstance(m, NoiseModel) else parse_noise(m) for m in models if m != "all"]
    if "all" in names:
        made += [parse_noise(name) for name in NOISE_NAMES]
    values = {
        "planners": [planner_name(source) for source in sources],
        "noise": [model.name for model in made],
        "seeds": [seeds] if isinstance(seeds, int) else list(seeds),
        **settings,
    }
    prepared = prepare(make_config(values), planners=sources, noises=made)
    return execute(prepared, on_progress=on_progress)
