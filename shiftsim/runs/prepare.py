"""Everything that is checked before the first simulated step of a run.

What was checked is what is run: `prepare` resolves the settings to batches of tasks, which
`shiftsim.runs.execute` then does.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from shiftsim._version import __version__
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.errors import ConfigError, DataError, one_of
from shiftsim.files import require_no_import
from shiftsim.metrics import METRIC_VERSION, load_metric, thresholds_of
from shiftsim.planners.registry import (
    PLANNERS,
    RunPlanner,
    planner_name,
    run_planner,
    takes_argument,
)
from shiftsim.runs.config import RunConfig, Value, default_workers, parse_shard
from shiftsim.runs.manifest import State, check_resumable, check_space, check_target, code_digest
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import find_split, open_edits, open_named_store, token_hash
from shiftsim.runs.task import Batch
from shiftsim.runs.verdicts import Verdicts, read_verdicts
from shiftsim.sim.noise import NOISE_NAMES, NoiseModel, parse_noise
from shiftsim.sim.traffic import PLANNER, BatchTraffic, make_traffic, traffic_name

if TYPE_CHECKING:
    from shiftsim.planners.isolated import Isolated
    from shiftsim.runs.edited import EditSet

RUNS = Path("runs")
_NOISE_FIELDS = ("kind", "sigma_accel", "sigma_rate", "theta")
_MAX_NAME = 40  # characters of one part of a run's name
_MEMORY_OF_NETWORK = 1.5e9  # bytes per worker


@dataclass(frozen=True)
class Prepared:
    """A run that has been checked and can start."""

    config: RunConfig  # the settings, names resolved
    store: str  # folder or URL of the scenario store
    planners: Mapping[str, RunPlanner]  # the planners, by name
    noises: Mapping[str, NoiseModel]  # the noise models, by name
    batches: tuple[Batch, ...]  # all tasks whose scenario exists, as they are handed out
    missing: tuple[Task, ...]  # tasks whose scenario the store does not hold
    split: str  # name of the split
    tokens: tuple[str, ...]  # all scenarios of the run, whatever the shard
    num_dropped: int  # scenarios left out because the filter dropped them
    determining: dict[str, Any]  # everything that the scores depend on
    folder: Path  # where the run folder will be
    before: State  # what it holds now
    workers: int  # number of worker processes
    generator: Mapping[str, Any]  # what made the scenarios up; empty where they were recorded
    traffic: RunPlanner | None = None  # who drives the other vehicles, where that is a planner
    edits: "EditSet | None" = None  # what makes the scenarios of recorded ones
    made: Mapping[str, Any] = field(default_factory=dict)  # which are made of which
    # planners, of the ego and of traffic, whose networks one process holds for all workers
    shared: tuple[str, ...] = ()

    @property
    def tasks(self) -> tuple[Task, ...]:
        """All tasks whose scenario exists."""
        return tuple(task for batch in self.batches for task in batch.tasks)


class Selection(NamedTuple):
    """The scenarios of a run."""

    split: str  # name of the split
    present: list[str]  # tokens that the store holds
    missing: list[str]  # tokens that it does not hold
    num_dropped: int  # scenarios left out because the filter dropped them
    determining: dict[str, Any]  # what identifies them
    edits: "EditSet | None"  # what makes them of recorded ones
    made: dict[str, Any]  # which are made of which, for the manifest


def prepare(
    config: RunConfig,
    *,
    planners: Sequence[Any] = (),
    noises: Sequence[NoiseModel] = (),
    edits: "EditSet | None" = None,
) -> Prepared:
    """Resolve every name and check everything that a run needs.

    Classes or instances of planners, noise models, and edits take the place of the names in the
    settings.

    Raises:
        ShiftsimError: Something is unknown, missing or contradictory.
    """
    require_no_import()
    # `all` stands for the seven of the benchmark
    names = [
        name for given in config.noise for name in (NOISE_NAMES if given == "all" else [given])
    ]
    models = list(noises) or [parse_noise(name) for name in dict.fromkeys(names)]
    config = replace(
        config, noise=tuple(model.name for model in models), traffic=traffic_name(config.traffic)
    )
    traffic, made_of, in_batches = _traffic(config)
    thresholds = asdict(thresholds_of(config.thresholds))
    for metric in config.metrics:
        load_metric(metric)
    entries = _entries(config, planners or config.planners)
    store = open_named_store(config.store)
    chosen = _scenarios(config, store, edits)
    together = in_batches or any(entry.in_batches for entry in entries)
    made_of["batch_size"] = config.batch_size if together else 1
    determining = chosen.determining | _determining(config, entries, models, thresholds) | made_of
    folder = Path(config.out) if config.out else RUNS / run_name(config, chosen.split, determining)
    before = _check_folder(config, folder, determining)
    tasks = list(_tasks(entries, models, config.seeds, chosen.present))
    missing = [Batch((task,)) for task in _tasks(entries, models, config.seeds, chosen.missing)]
    grouped = {entry.name for entry in entries if entry.in_batches or in_batches}
    batches = _of_shard(config.shard, _batches(grouped, tasks, config.batch_size))
    if before == "new":
        count = sum(len(batch.tasks) for batch in batches)
        check_space(folder, count, with_rollouts=config.save_rollouts == "all")
    shared = _on_gpu(config, entries, traffic)
    workers = _workers(config, entries, len(batches), shared)
    return Prepared(
        config=config,
        store=store.source,
        planners={entry.name: entry for entry in entries},
        noises={model.name: model for model in models},
        batches=tuple(_leading_first(batches)),
        missing=tuple(batch.tasks[0] for batch in _of_shard(config.shard, missing)),
        split=chosen.split,
        tokens=(*chosen.present, *chosen.missing),
        num_dropped=chosen.num_dropped,
        determining=determining,
        folder=folder,
        before=before,
        workers=workers,
        generator=store.generator,
        traffic=traffic,
        edits=chosen.edits,
        made=chosen.made,
        shared=shared if workers > 1 else (),
    )


def _traffic(config: RunConfig) -> tuple[RunPlanner | None, dict[str, Any], bool]:
    """The planner that drives other vehicles, if one does, and what identifies the traffic.

    Last, whether a network of it moves several rollouts at once.
    """
    name = config.traffic.removeprefix(PLANNER)
    if name != config.traffic:
        arguments: dict[str, Value] = dict(config.planner_args.get(name, {}))
        if takes_argument(name, "device"):
            arguments.setdefault("device", config.device)
        planner = run_planner(name, arguments)
        return planner, {"traffic_made_of": dict(planner.fingerprint)}, False
    try:
        model = make_traffic(config.traffic, config.device)
    except (ImportError, AttributeError, TypeError) as error:
        raise ConfigError(
            f"traffic {config.traffic!r} is not available: {error}",
            hint="use --traffic nonreactive",
        ) from error
    made_of = getattr(model, "fingerprint", None)
    in_batches = isinstance(model, BatchTraffic) and config.batch_size > 1
    return None, {"traffic_made_of": dict(made_of)} if made_of else {}, in_batches


def _entries(config: RunConfig, sources: Sequence[Any]) -> list[RunPlanner]:
    checkpoints = _checkpoints(config, sources)
    entries = []
    for name, source in zip(config.planners, sources, strict=True):
        arguments: dict[str, Value] = dict(config.planner_args.get(name, {}))
        if name in checkpoints:
            arguments["checkpoint"] = checkpoints[name]
        if _is_known(config, source) and takes_argument(source, "device"):
            arguments.setdefault("device", config.device)
        if config.isolate or config.planner_python:
            source = _isolated(config, source, arguments)
        entries.append(run_planner(source, arguments))
    return entries


def _is_known(config: RunConfig, source: Any) -> bool:
    """Whether the code of a planner may be looked at in this process."""
    return source in PLANNERS if config.isolate or config.planner_python else True


def _isolated(config: RunConfig, source: Any, arguments: dict[str, Value]) -> "Isolated":
    if not isinstance(source, str):
        raise ConfigError(
            f"planner {planner_name(source)!r} cannot be isolated: it is an object of this process",
            hint="put its class into a module, and give its name as package.module:Class",
        )
    from shiftsim.planners.isolated import Isolated  # few runs need it

    return Isolated(source, arguments, "" if source in PLANNERS else config.planner_python)


def _checkpoints(config: RunConfig, sources: Sequence[Any]) -> dict[str, str]:
    """Checkpoint by planner."""
    named = zip(config.planners, sources, strict=True)
    takers = [
        name
        for name, source in named
        if _is_known(config, source) and takes_argument(source, "checkpoint")
    ]
    out: dict[str, str] = {}
    for text in config.checkpoints:
        name, equals, path = text.partition("=")
        if not equals or name not in config.planners:
            name, path = (takers[0], text) if len(takers) == 1 else ("", text)
        if not name and not takers:
            raise ConfigError(
                f"checkpoint {text!r}: {', '.join(config.planners)} takes none",
                hint="leave --checkpoint out",
            )
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


def _scenarios(config: RunConfig, store: ScenarioStore, given: "EditSet | None") -> Selection:
    known = tuple(store.tokens)
    whole = config.split in ("", store.path.name)
    verdicts, usable = None, known
    if whole and not config.all_scenarios:
        verdicts = _verdicts(config, store)
        accepted = set(verdicts.accepted if verdicts else known)
        usable = tuple(token for token in known if token in accepted)
        if store.is_reviewed:
            usable = store.reviews.usable(known, usable)
    split = find_split(config.split, Path(store.path), usable)
    name, tokens, store_tokens = split.name, split.tokens, set(known)
    edits, made = given or _edits(config, store), {}
    if edits is not None:
        edits.require_traffic(config.traffic)
        made = edits.describe(store, tokens)
        name, tokens, store_tokens = f"{name}+{edits.name}", tuple(made), set(made)
    tokens = tokens[: config.limit] if config.limit else tokens
    missing = sorted(set(tokens) - store_tokens)
    if missing and not config.allow_partial:
        raise DataError(
            f"split {split.name!r} needs {len(tokens)} scenarios, store {config.store!r} "
            f"lacks {len(missing)} of them, such as {missing[0]!r}",
            hint="convert the missing scenarios, or --allow-partial",
        )
    if len(missing) == len(tokens):
        raise DataError(
            f"split {split.name!r}: store {config.store!r} holds none of its scenarios",
            hint="name the store that was converted for this split",
        )
    determining = {"store": store.hash, "tokens": token_hash(tokens)}
    if verdicts is not None:
        determining["filter"] = verdicts.hash
    if store.is_reviewed and store.reviews.hash:
        determining["review"] = store.reviews.hash
    if edits is not None:
        determining["edits"] = edits.digest
    present = [token for token in tokens if token in store_tokens]
    return Selection(name, present, missing, len(known) - len(usable), determining, edits, made)


def _edits(config: RunConfig, store: ScenarioStore) -> "EditSet | None":
    """The edits of a run."""
    return open_edits(config.edits, store) if config.edits else None


def _verdicts(config: RunConfig, store: ScenarioStore) -> Verdicts | None:
    """The verdicts that decide which scenarios of a whole store are run."""
    found = read_verdicts(store.path, store.hash)
    if found is not None and not found.accepted:
        raise DataError(
            f"store {config.store!r}: the filter dropped all {len(found.rows)} scenarios",
            hint="`shiftsim filter` says why; --all to use them nevertheless",
        )
    return found


def _check_folder(config: RunConfig, folder: Path, determining: dict[str, Any]) -> State:
    before = check_target(folder, determining, shard=config.shard)
    if config.resumes:
        if before == "new" and not config.out:
            check_resumable(folder, determining, shard=config.shard)
    elif before == "unfinished":
        raise ConfigError(
            f"{str(folder)!r} holds an unfinished run with these settings",
            hint="--resume finishes it; remove the folder to begin anew",
        )
    return before


def _on_gpu(
    config: RunConfig, entries: Sequence[RunPlanner], traffic: RunPlanner | None
) -> tuple[str, ...]:
    """Planners whose networks the workers of this machine can share."""
    if config.executor != "processes":
        return ()
    names = [entry.name for entry in entries if entry.on_gpu]
    return (*names, *([config.traffic] if traffic is not None and traffic.on_gpu else ()))


def _workers(
    config: RunConfig, entries: Sequence[RunPlanner], num_batches: int, shared: Sequence[str]
) -> int:
    """Number of worker processes; 1 for planners that cannot be sent to another process."""
    stuck = [entry.name for entry in entries if not entry.can_travel]
    if stuck and (config.timeout or config.executor != "processes"):
        raise ConfigError(
            f"planner {stuck[0]!r} cannot be sent to a worker process, as a timeout or a cluster "
            "needs it",
            hint="put its class into a module of its own, beside the main script",
        )
    large = (
        entry.in_batches or getattr(type(entry.source), "shares_nothing", False)
        for entry in entries
        if entry.name not in shared
    )
    memory = _MEMORY_OF_NETWORK if any(large) else 0.0
    workers = config.workers or (default_workers(memory) if memory else default_workers())
    return 1 if stuck else max(1, min(workers, num_batches))


def _tasks(
    entries: Iterable[RunPlanner],
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


def _batches(grouped: set[str], tasks: list[Task], size: int) -> list[Batch]:
    """The tasks, those of planners whose scenarios are driven in lock step grouped.

    The groups depend on the whole run only, not on workers, shards or what is finished already. The
    first is a single task: other workers wait until it has compiled the planner's kernels.
    """
    batches = [Batch((task,)) for task in tasks if task.planner not in grouped]
    for name in sorted(grouped):
        own = tuple(task for task in tasks if task.planner == name)
        batches += [Batch(own[:1])]
        batches += [Batch(own[i : i + size]) for i in range(1, len(own), size)]
    return batches


def _of_shard(shard: str, batches: list[Batch]) -> list[Batch]:
    """The batches of a shard: by a hash of the first task, so no shard needs to know another."""
    if not shard:
        return batches
    number, count = parse_shard(shard)

    def bucket(task: Task) -> int:
        digest = hashlib.blake2b(repr(tuple(task)).encode(), digest_size=8).digest()
        return int.from_bytes(digest, "little") % count

    return [batch for batch in batches if bucket(batch.tasks[0]) == number - 1]


def _leading_first(batches: list[Batch]) -> list[Batch]:
    """One batch per planner to the front: they compile all the kernels."""
    leading = {batch.planner: batch for batch in reversed(batches)}
    first = [batch for batch in batches if leading[batch.planner] is batch]
    return first + [batch for batch in batches if leading[batch.planner] is not batch]


def _determining(
    config: RunConfig,
    entries: Sequence[RunPlanner],
    models: Sequence[NoiseModel],
    thresholds: dict[str, Any],
) -> dict[str, Any]:
    """Everything else that the scores depend on, as JSON values."""
    noisy = any(model.kind != "none" for model in models)
    fields = {
        "shiftsim": __version__,
        "code": code_digest(),
        "metric_version": METRIC_VERSION,
        "planners": {entry.name: dict(entry.fingerprint) for entry in entries},
        "noise": {
            model.name: {
                **{name: getattr(model, name) for name in _NOISE_FIELDS},
                "function": model.name if model.function is not None else None,
            }
            for model in models
        },
        "seeds": sorted(config.seeds) if noisy else [0],
        "traffic": config.traffic,
        "controller": config.controller,
        "thresholds": thresholds,
        "metrics": sorted(config.metrics),
        "strict": config.strict,
    }
    plain: dict[str, Any] = json.loads(json.dumps(fields, sort_keys=True, default=str))
    return plain


def run_name(config: RunConfig, split: str, determining: dict[str, Any]) -> str:
    """Name of a run's folder: the same settings on the same data give the same name."""
    text = json.dumps(determining, sort_keys=True)
    digest = hashlib.blake2b(text.encode(), digest_size=2).hexdigest()
    planners = _joined(config.planners, "planners")
    name = f"{planners}_{_joined(config.noise, 'noises')}_{_joined((split,), 'split')}_{digest}"
    return f"{name}.{config.shard.replace('/', '-of-')}" if config.shard else name


def _joined(names: Sequence[str], what: str) -> str:
    # without a dot in front, which would hide the folder
    text = "+".join(re.sub(r"[^A-Za-z0-9.-]+", "-", name).lstrip(".-") for name in names)
    return text if len(text) <= _MAX_NAME else f"{len(names)}-{what}"
