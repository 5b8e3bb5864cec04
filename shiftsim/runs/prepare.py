"""Everything that is checked before the first simulated step of a run.

What was checked is what is run: `prepare` makes the plan that `shiftsim.runs.execute` carries out.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shiftsim._version import __version__
from shiftsim.data import open_store
from shiftsim.errors import ConfigError, nearest, one_of
from shiftsim.files import expand
from shiftsim.metrics import METRIC_VERSION, load_metric, thresholds_of
from shiftsim.planners import registry
from shiftsim.planners.registry import PLANNERS, RunPlanner, planner_name, takes_argument
from shiftsim.runs.config import DRIFT, RunConfig, Value, default_workers, parse_shard, split_label
from shiftsim.runs.manifest import State, check_resumable, check_space, check_target, code_digest
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import Selection, select_scenarios
from shiftsim.runs.task import Batch, TaskRunner
from shiftsim.sim.perception import Drift, make_drifts
from shiftsim.sim.traffic import PLANNER, BatchTraffic, make_traffic, traffic_name

if TYPE_CHECKING:
    from shiftsim.planners.isolated import Isolated
    from shiftsim.runs.edited import EditSet

RUNS = Path("runs")
_MAX_NAME = 40  # characters of one part of a run's name
_MEMORY_OF_NETWORK = 1.5e9  # bytes per worker


@dataclass(frozen=True)
class RunPlan:
    """A run that has been checked and can start."""

    config: RunConfig  # the settings, names resolved
    store: str  # folder or URL of the scenario store
    provenance: Mapping[str, Any]  # what made synthetic scenarios; empty for recorded ones
    selection: Selection  # the scenarios
    # the planners by name, that of the traffic by the name of the traffic
    planners: Mapping[str, RunPlanner]
    noises: Mapping[str, Drift]  # noise and what else drifts, by name
    batches: tuple[Batch, ...]  # all tasks whose scenario exists, as they are handed out
    missing: tuple[Task, ...]  # tasks whose scenario the store does not hold
    fingerprint: dict[str, Any]  # everything that the scores depend on
    folder: Path  # where the run folder will be
    before: State  # what it holds now
    workers: int  # number of worker processes
    # planners, of the ego and of traffic, whose networks one process holds for all workers
    shared: tuple[str, ...] = ()

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks whose scenario exists."""
        return tuple(task for batch in self.batches for task in batch)

    def runner(self) -> "partial[TaskRunner]":
        """What makes the function that does batches, in this process or in another one."""
        given = (self.config, self.store, self.planners, self.noises, self.selection.edits)
        return partial(TaskRunner, *given)

    def close_planners(self) -> None:
        """Close the planners of this process."""
        for planner in self.planners.values():
            planner.close()


def prepare(
    config: RunConfig,
    *,
    planners: Sequence[Any] = (),
    noises: Sequence[Drift] = (),
    edits: "EditSet | None" = None,
) -> RunPlan:
    """Resolve every name, but those of objects that are given, and check what a run needs."""
    models = list(noises) or make_drifts(*(getattr(config, name) for name in DRIFT))
    values: dict[str, Any] = {one.name: one.default for one in fields(config) if one.name in DRIFT}
    values["noise"] = tuple(model.name for model in models)  # of all that drifts
    config = replace(config, **values, traffic=traffic_name(config.traffic))
    traffic, traffic_fingerprint, is_batched = _traffic(config)
    thresholds = asdict(thresholds_of(config.thresholds))
    for metric in config.metrics:
        load_metric(metric)
    entries = _planners(config, planners or config.planners)
    config = _with_names(config, entries)
    store = open_store(config.store)
    selection = select_scenarios(config, store, edits)
    grouped = {
        entry.name: entry.batch_size or config.batch_size
        for entry in entries
        if entry.in_batches or is_batched
    }
    fingerprint = {
        **selection.fingerprint,
        **_fingerprint(config, entries, models, thresholds),
        **traffic_fingerprint,
        "batch_size": config.batch_size if grouped else 1,
    }
    run = run_name(config, selection.split, fingerprint)
    folder = Path(config.out) if config.out else RUNS / run
    before = check_target(folder, fingerprint, shard=config.shard)
    if config.resumes and before == "new" and not config.out:
        check_resumable(folder, fingerprint, shard=config.shard)
    elif before == "unfinished" and not config.resumes:
        what = f"{str(folder)!r} holds an unfinished run with these settings"
        raise ConfigError(what, hint="--resume finishes it; remove the folder to begin anew")
    unseen = [entry.name for entry in entries if entry.fingerprint.get("unseen")]
    if config.resumes and before != "new" and unseen:
        what = f"planner {unseen[0]!r} holds what cannot be pickled, so nobody can tell whether"
        hint = "begin anew in another --out; planners given as package.module:Class can resume"
        raise ConfigError(f"{what} it is the one of {str(folder)!r}", hint)
    runs = [
        (entry.name, model.name, seed)
        for entry in entries
        for model in models
        for seed in (config.seeds if model.is_random else (0,))
    ]
    # scenario by scenario, so that a worker can often reuse the one it has read
    tasks = [Task(*run, token) for token in selection.present for run in runs]
    missing: list[Batch] = [(Task(*run, token),) for token in selection.missing for run in runs]
    batches = _of_shard(config.shard, _batches(grouped, tasks))
    if before == "new":
        check_space(folder, sum(map(len, batches)), with_rollouts=config.save_rollouts == "all")
    # one batch per planner to the front: they compile all the kernels
    leading = {batch[0].planner: batch for batch in reversed(batches)}
    batches.sort(key=lambda batch: leading[batch[0].planner] is not batch)
    by_name = {entry.name: entry for entry in entries}
    by_name |= {config.traffic: traffic} if traffic else {}
    # of this machine; workers on others would not reach the process
    on_gpu = tuple(name for name, entry in by_name.items() if entry.on_gpu)
    shared = on_gpu if config.executor == "processes" else ()
    workers = _workers(config, entries, len(batches), shared)
    plan = RunPlan(
        config=config,
        store=store.source,
        provenance=store.generator,
        selection=selection,
        planners=by_name,
        noises={model.name: model for model in models},
        batches=tuple(batches),
        missing=tuple(task for task, *_ in _of_shard(config.shard, missing)),
        fingerprint=fingerprint,
        folder=folder,
        before=before,
        workers=workers,
        shared=shared if workers > 1 else (),
    )
    if config.executor != "processes" or workers > 1 or config.timeout:  # others do the tasks
        plan.close_planners()
    return plan


def _traffic(config: RunConfig) -> tuple[RunPlanner | None, dict[str, Any], bool]:
    """The planner that drives others, if any, what identifies traffic, and if a network does."""
    name = config.traffic.removeprefix(PLANNER)
    if name != config.traffic:
        arguments: dict[str, Value] = dict(config.planner_args.get(name, {}))
        if takes_argument(name, "device"):
            arguments.setdefault("device", config.device)
        planner = registry.run_planner(name, arguments)
        return planner, {"traffic_made_of": dict(planner.fingerprint)}, False
    try:
        model = make_traffic(config.traffic, config.device)
    except (ImportError, AttributeError, TypeError) as error:
        what = f"traffic {config.traffic!r} is not available: {error}"
        raise ConfigError(what, hint="use --traffic nonreactive") from error
    fingerprint = getattr(model, "fingerprint", None)
    in_batches = isinstance(model, BatchTraffic) and config.batch_size > 1
    return None, {"traffic_made_of": dict(fingerprint)} if fingerprint else {}, in_batches


def _planners(config: RunConfig, given: Sequence[Any]) -> list[RunPlanner]:
    """The planners in the order of the settings; those without a label have their own name."""
    isolates = bool(config.isolate or config.planner_python)

    def takes(source: Any, argument: str) -> bool:
        # the code of an isolated planner of users is not looked at in this process
        return (not isolates or source in PLANNERS) and takes_argument(source, argument)

    labels = [split_label(planner)[0] for planner in config.planners]
    sources = [split_label(one)[1] if isinstance(one, str) else one for one in given]
    named = dict(zip(labels, sources, strict=True))
    with_checkpoint = [name for name, source in named.items() if takes(source, "checkpoint")]
    checkpoints = _checkpoints(config, with_checkpoint)
    entries, names = [], []
    for name, source in named.items():
        arguments: dict[str, Value] = dict(config.planner_args.get(name, {}))
        if name in checkpoints:
            arguments["checkpoint"] = checkpoints[name]
        if takes(source, "device"):
            arguments.setdefault("device", config.device)
        size = 0 if isolates or takes_argument(source, "batch_size") else _batch_size(arguments)
        isolated = _isolated(config, source, arguments) if isolates else source
        entry = registry.run_planner(isolated, arguments, name)
        if size and not entry.in_batches:
            what = f"planner {name!r} takes no batch_size: it answers for one scenario at a time"
            raise ConfigError(what, hint="leave it out")
        if size:
            entry.batch_size, entry.fingerprint = size, {**entry.fingerprint, "batch_size": size}
        entries.append(entry)
        is_custom = isinstance(source, str) and source == name and source not in PLANNERS
        names.append(registry.own_name(entry) if is_custom else name)
    for entry, name in zip(entries, names, strict=True):
        entry.name = name if names.count(name) == 1 else entry.name
    return entries


def _batch_size(arguments: dict[str, Value]) -> int:
    """Scenarios per forward pass of one planner, taken out of its arguments; 0 for the run's."""
    size = arguments.pop("batch_size", 0)
    if not isinstance(size, int) or isinstance(size, bool) or size < 0:
        raise ConfigError(f"batch_size {size!r} is no number from 1 on")
    return size


def _with_names(config: RunConfig, entries: Sequence[RunPlanner]) -> RunConfig:
    """The settings with the planners' names in place of what was given."""
    labels = [split_label(planner)[0] for planner in config.planners]
    names = {label: entry.name for label, entry in zip(labels, entries, strict=True)}
    checkpoints = (text.partition("=") for text in config.checkpoints)
    return replace(
        config,
        planners=tuple(names.values()),
        planner_args={names[label]: values for label, values in config.planner_args.items()},
        checkpoints=tuple("".join((names.get(a, a), *rest)) for a, *rest in checkpoints),
    )


def _isolated(config: RunConfig, source: Any, arguments: dict[str, Value]) -> "Isolated":
    if not isinstance(source, str):
        raise ConfigError(
            f"planner {planner_name(source)!r} cannot be isolated: it is an object of this process",
            hint="put its class into a module, and give its name as package.module:Class",
        )
    from shiftsim.planners.isolated import Isolated  # few runs need it

    return Isolated(source, arguments, "" if source in PLANNERS else config.planner_python)


def _checkpoints(config: RunConfig, takers: Sequence[str]) -> dict[str, str]:
    """Checkpoint by planner; `takers` are those that take one."""
    out: dict[str, str] = {}
    labels = [split_label(planner)[0] for planner in config.planners]
    for text in config.checkpoints:
        name, equals, path = text.partition("=")
        if not equals or name not in labels:
            is_label = nearest(name, takers) or expand(path).is_file()
            if equals and takers and is_label and not expand(text).exists():
                one_of("planner with a checkpoint", name, takers)
            name, path = (takers[0], text) if len(takers) == 1 else ("", text)
        if not name and not takers:
            what = f"checkpoint {text!r}: {', '.join(labels)} takes none"
            raise ConfigError(what, hint="leave --checkpoint out")
        if not name:
            raise ConfigError(
                f"checkpoint {text!r} does not say which planner is meant",
                hint=f"write PLANNER={path}; planners with one: {', '.join(takers)}",
            )
        one_of("planner with a checkpoint", name, takers)
        if name in out:
            raise ConfigError(f"planner {name!r} has two checkpoints: {out[name]!r} and {path!r}")
        out[name] = path
    return out


def _workers(
    config: RunConfig, entries: Sequence[RunPlanner], num_batches: int, shared: Sequence[str]
) -> int:
    """Number of worker processes; 1 for planners that cannot be sent to another process."""
    stuck = [entry.name for entry in entries if not entry.can_travel]
    if stuck and (config.timeout or config.executor != "processes"):
        raise ConfigError(
            f"planner {stuck[0]!r} cannot be sent to a worker process, as a timeout or a cluster "
            "needs it",
            hint="put its class or function into a module of its own, beside the main script",
        )
    large = (
        entry.in_batches or getattr(type(entry.source), "shares_nothing", False)
        for entry in entries
        if entry.name not in shared
    )
    workers = config.workers
    if not workers:
        workers = default_workers(_MEMORY_OF_NETWORK) if any(large) else default_workers()
    return 1 if stuck else max(1, min(workers, num_batches))


def _batches(grouped: Mapping[str, int], tasks: list[Task]) -> list[Batch]:
    """The tasks in batches, which depend on the whole run only; a planner's first is one task."""
    batches: list[Batch] = [(task,) for task in tasks if task.planner not in grouped]
    for name, size in sorted(grouped.items()):
        of_planner = tuple(task for task in tasks if task.planner == name)
        batches += [of_planner[:1]]
        batches += [of_planner[i : i + size] for i in range(1, len(of_planner), size)]
    return batches


def _of_shard(shard: str, batches: list[Batch]) -> list[Batch]:
    """The batches of a shard: by a hash of the first task, so no shard needs to know another."""
    if not shard:
        return batches
    number, count = parse_shard(shard)

    def bucket(task: Task) -> int:
        digest = hashlib.blake2b(repr(tuple(task)).encode(), digest_size=8).digest()
        return int.from_bytes(digest, "little") % count

    return [batch for batch in batches if bucket(batch[0]) == number - 1]


def _fingerprint(
    config: RunConfig,
    entries: Iterable[RunPlanner],
    models: Sequence[Drift],
    thresholds: dict[str, Any],
) -> dict[str, Any]:
    """Everything else that the scores depend on, as JSON values."""
    noisy = any(model.is_random for model in models)
    values = {
        "shiftsim": __version__,
        "code": code_digest(),
        "metric_version": METRIC_VERSION,
        "planners": {entry.name: dict(entry.fingerprint) for entry in entries},
        "noise": {model.name: model.fingerprint() for model in models},
        "seeds": sorted(config.seeds) if noisy else [0],
        "traffic": config.traffic,
        "controller": config.controller,
        "thresholds": thresholds,
        "metrics": config.added_metrics,
        "strict": config.strict,
    }
    return json.loads(json.dumps(values, sort_keys=True, default=str))


def run_name(config: RunConfig, split: str, fingerprint: dict[str, Any]) -> str:
    """Name of a run's folder: the same settings on the same data give the same name."""
    text = json.dumps(fingerprint, sort_keys=True)
    digest = hashlib.blake2b(text.encode(), digest_size=2).hexdigest()
    planners = _joined(config.planners, "planners")
    name = f"{planners}_{_joined(config.noise, 'noises')}_{_joined((split,), 'split')}_{digest}"
    return f"{name}.{config.shard.replace('/', '-of-')}" if config.shard else name


def _joined(names: Sequence[str], what: str) -> str:
    # without a dot in front, which would hide the folder
    text = "+".join(re.sub(r"[^A-Za-z0-9.-]+", "-", name).lstrip(".-") for name in names)
    return text if len(text) <= _MAX_NAME else f"{len(names)}-{what}"
