"""Runs made without simulating: of shards, and of rollouts that are stored or driven elsewhere."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from shiftsim._version import __version__
from shiftsim.data import open_store
from shiftsim.data.store.tables import digest
from shiftsim.errors import ConfigError, DataError, one_of
from shiftsim.metrics import METRIC_VERSION, load_metric, thresholds_of
from shiftsim.metrics.open_loop import NAMES as OPEN_LOOP
from shiftsim.runs.config import RunConfig, make_config, parse_shard
from shiftsim.runs.edited import make_edits
from shiftsim.runs.execute import ALONE, OnProgress, Progress
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.manifest import check_target, code_digest, difference, make_manifest, now
from shiftsim.runs.prepare import RUNS, run_name
from shiftsim.runs.results import Run, open_run
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.elsewhere import Entry, Source
from shiftsim.runs.rollouts.files import encode_rows, rollout_rows
from shiftsim.runs.rollouts.poses import NEED_BOXES, POINTS, REAR_AXLE, rollout_of
from shiftsim.runs.scenarios import open_run_store, split_name, token_hash
from shiftsim.runs.tables import FAILED, MISSING, OK, TaskResult, stored_results
from shiftsim.runs.task import ScenarioReader, attempt, planner_times, score_rollout
from shiftsim.runs.workers import map_unordered

Score: TypeAlias = Callable[[Entry], TaskResult]
ELSEWHERE = "elsewhere"  # what moved ego and others, where nobody says more


def merge_runs(runs: Sequence[Run], *, out: str | None = None, allow_partial: bool = False) -> Run:
    """Write the run folder that shards `1/n` to `n/n` are parts of: the same bytes as without."""
    first = runs[0].manifest
    shards = _check_shards(runs, allow_partial=allow_partial)
    name = first["run"].removesuffix(f".{first['shard'].replace('/', '-of-')}")
    target = Path(out) if out else runs[0].path.parent / name
    check_target(target, first["determining"])
    manifest = {key: value for key, value in first.items() if key not in ("tokens", "bundle")} | {
        "run": target.name,
        "shard": "",
        "config": first["config"] | {"shard": ""},
        "started": min(run.manifest["started"] for run in runs),
        "ended": max(run.manifest["ended"] for run in runs),
        "merged": now(),
        "merged_from": [run.path.name for run in runs],
    }
    with closing(RunWriter(target, manifest)) as writer:
        for run in runs:
            for result in stored_results(run.path):
                writer.add(result)
        return writer.finish(
            manifest | {"state": "finished"},
            _expected(first),
            {task: error for run in runs for task, error in _without_result(run)},
            f"shard missing; there are {', '.join(shards)}",
        )


def _check_shards(runs: Sequence[Run], *, allow_partial: bool) -> list[str]:
    first, shards = runs[0], [run.manifest["shard"] for run in runs]
    for run, shard in zip(runs, shards, strict=True):
        if not shard:
            what = f"{str(run.path)!r} is not a shard"
            raise ConfigError(what, hint="merge joins runs made with --shard i/n")
        differing = difference(run.manifest, first.manifest["determining"], shard)
        if differing or parse_shard(shard)[1] != parse_shard(shards[0])[1]:
            raise ConfigError(
                f"{str(run.path)!r} and {str(first.path)!r} are not of the same run: "
                f"{differing or f'their shards are {shard} and {shards[0]}'}",
                hint="name the shards of one run",
            )
        if shards.count(shard) > 1:
            raise ConfigError(f"shard {shard} is there twice", hint="name every shard once")
    _, count = parse_shard(shards[0])
    missing = {f"{number}/{count}" for number in range(1, count + 1)}.difference(shards)
    if missing and not allow_partial:
        raise ConfigError(
            f"shards are missing: {', '.join(sorted(missing))}",
            hint="name all of them, or --allow-partial for a result that is labelled so",
        )
    return shards


def _expected(manifest: dict[str, Any]) -> list[Task]:
    """All tasks of the whole run."""
    fingerprint = manifest["determining"]
    return [
        Task(planner, noise, seed, token)
        for planner in fingerprint["planners"]
        for noise, fields in fingerprint["noise"].items()
        for seed in ([0] if fields["kind"] == "none" else fingerprint["seeds"])
        for token in manifest["tokens"]
    ]


def _without_result(run: Run) -> Iterator[tuple[Task, str]]:
    """The missing tasks of a run, and why they have no result."""
    columns = (run.tasks[name].to_pylist() for name in (*Task._fields, "status", "error"))
    for *key, status, error in zip(*columns, strict=True):
        if status == MISSING:
            yield Task(*key), error


def _rescorer(path: Path, store: str, config: RunConfig) -> Score:
    """What scores one stored rollout of a run after the other."""
    run = open_run(path)
    about = run.manifest
    edits = make_edits(about["edits"], path.name) if about.get("edits") else None
    scenarios, open_loop = ScenarioReader(store, edits), dict[Task, list[dict[str, Any]]]()
    for row in run.metrics.to_pylist() if config.open_loop else ():
        if row["metric"] in OPEN_LOOP:  # no threshold changes it
            task = Task(*(row.pop(name) for name in Task._fields))
            open_loop.setdefault(task, []).append(row | {"thresholds": config.thresholds})

    def score(entry: Entry) -> TaskResult:
        scenario = scenarios.read(entry.task.token)
        log = run.rollout(entry.task, scenario)
        undefined = about.get("elsewhere", {}).get("undefined", ())
        scores, metrics = score_rollout(scenario, log, config, undefined)
        metrics += open_loop.get(entry.task, [])
        return TaskResult(entry.task, OK, scenario.scenario_type, scores=scores, metrics=metrics)

    return score


def tasks_with_rollouts(run: Run) -> list[Task]:
    """The tasks of a run that have a score; a DataError unless all of their rollouts are stored."""
    statuses = zip(run.rollout_places.items(), run.tasks["status"].to_pylist(), strict=True)
    done = {task: place for (task, place), status in statuses if status == OK}
    if without := sum(place is None for place in done.values()):
        what = f"run {run.path.name!r} holds no rollouts for {without} of {len(done)} tasks"
        raise DataError(what, hint="run again with --save-rollouts all")
    return sorted(done, key=lambda task: task.token)


def rescore(
    run: Run,
    *,
    thresholds: str,
    metrics: tuple[str, ...] = (),
    store: str | None = None,
    out: str | None = None,
    workers: int = 0,
    on_progress: OnProgress = lambda progress: None,
    argv: Sequence[str] = (),
) -> Run:
    """Write a run folder as if the run had been made with other thresholds or `metrics`."""
    run = open_run(run.path)  # with its own names
    for metric in metrics:
        load_metric(metric)
    found = open_run_store(run, store)
    here, simulated = code_digest(), run.manifest["determining"].get("code", "")
    values = run.manifest["config"] | {"thresholds": thresholds, "metrics": list(metrics)}
    config = make_config(values, where=str(run.path / "manifest.json"))
    fingerprint = run.manifest["determining"] | {
        "thresholds": asdict(thresholds_of(thresholds)),
        "metrics": config.added_metrics,
        "metric_version": METRIC_VERSION,
        "code": here if here == simulated else f"{simulated}, scored by {here}",
    }
    target = Path(out) if out else RUNS / run_name(config, run.manifest["split"], fingerprint)
    if target.resolve() == run.path.resolve():
        what = f"{str(target)!r} is the run that is scored: its times would be lost"
        raise ConfigError(what, hint="give other thresholds, a metric, or another folder as out")
    check_target(target, fingerprint)
    done = tasks_with_rollouts(run)
    place = run.manifest["store"] if store is None else found.source
    manifest = make_manifest(
        target, config, fingerprint, split=run.manifest["split"], store=place, argv=argv
    )
    kept = ("edits", "split_size", "elsewhere")
    manifest |= {key: run.manifest[key] for key in kept if key in run.manifest}
    with closing(RunWriter(target, manifest)) as writer:
        for result in stored_results(run.path):
            if result.status != OK:  # it stays so
                writer.add(replace(result, seconds={}))
        make = partial(_rescorer, run.path.resolve(), found.source, config)
        for result in _scored(make, [Entry(task) for task in done], workers, on_progress):
            writer.add(replace(result, location=run.rollout_places[result.task]))
        manifest |= {"state": "finished", "ended": now(), "rescored_from": run.path.name}
        return writer.finish(manifest, run.rollout_places, dict(_without_result(run)))


def _attempting(make: Callable[[], Score]) -> Score:
    score = make()
    return lambda entry: attempt(entry.task, partial(score, entry))


def _scored(
    make: Callable[[], Score], entries: Sequence[Entry], workers: int, on_progress: OnProgress
) -> Iterator[TaskResult]:
    """The results of rollouts, which so many processes share, to be put on disk as they come."""
    progress = Progress(0, len(entries), 0)
    outcomes = map_unordered(
        partial(_attempting, make),
        entries,
        workers=workers,
        alone=1,
        group=lambda entry: entry.task.token,
    )
    with closing(outcomes):
        for outcome in outcomes:
            lost = TaskResult(outcome.task.task, FAILED, error=outcome.death, hint=ALONE)
            yield (result := outcome.result or lost)
            progress += Progress(1, 0, int(result.status != OK), result.seconds)
            on_progress(replace(progress, news=[result]))


def _elsewhere_scorer(
    store: str, config: RunConfig, undefined: Sequence[str], given: dict[str, Any]
) -> Score:
    """What scores rollouts that were driven elsewhere; arguments of `rollout_of` are given."""
    scenarios = ScenarioReader(store)

    def score(entry: Entry) -> TaskResult:
        scenario, driven = scenarios.read(entry.task.token), entry.read()
        log, remarks = rollout_of(driven, scenario, **given)
        scores, metrics = score_rollout(scenario, log, config, undefined)
        has_others = driven.boxes is not None or bool(undefined)
        return TaskResult(
            entry.task,
            OK,
            scenario.scenario_type,
            seconds=planner_times(log) if "planning_seconds" in driven.fields else {},
            scores=scores,
            metrics=metrics,
            rollout=encode_rows(rollout_rows(log, with_tracks=has_others, with_kinds=has_others)),
            remarks=remarks,
        )

    return score


def score_elsewhere(
    source: Source,
    *,
    store: str,
    recorded: bool = False,
    partial_rollouts: bool = False,
    point: str = "",
    thresholds: str = "nuplan",
    metrics: tuple[str, ...] = (),
    traffic: str = "",
    controller: str = ELSEWHERE,
    out: str | None = None,
    workers: int = 0,
    on_progress: OnProgress = lambda progress: None,
    argv: Sequence[str] = (),
) -> Run:
    """Write a run folder with the scores of rollouts; arguments are labels, or of `rollout_of`."""
    if point and one_of("point", point, POINTS) != (source.point or point):
        words = f"--point {point}, but {source.name} says {source.point}"
        raise ConfigError(words, hint="leave --point out")
    found = open_store(store)
    source = source.in_store(found)
    for metric in metrics:
        load_metric(metric)
    tasks = [entry.task for entry in source.entries]
    config = RunConfig(
        planners=tuple(dict.fromkeys(task.planner for task in tasks)),
        noise=tuple(dict.fromkeys(task.noise for task in tasks)),
        seeds=tuple(sorted({task.seed for task in tasks})),
        store=store,
        traffic=traffic or ("nonreactive" if recorded else ELSEWHERE),
        thresholds=thresholds,
        metrics=metrics,
    )
    given = {"point": point or source.point or REAR_AXLE, "recorded": recorded}
    given["partial"] = partial_rollouts
    fingerprint = _fingerprint(source, found.hash, config) | {"controller": controller, **given}
    split = split_name(found, source.tokens, Path(source.name).stem)
    target = Path(out) if out else RUNS / run_name(config, split, fingerprint)
    is_new = check_target(target, fingerprint) == "new"
    manifest = make_manifest(
        target, config, fingerprint, split=split, store=found.source, argv=argv
    )
    undefined = () if recorded or source.has_boxes else NEED_BOXES
    remarks, failed = Counter[str](), list[TaskResult]()
    with closing(RunWriter(target, manifest)) as writer:
        make = partial(_elsewhere_scorer, found.source, config, undefined, given)
        for result in _scored(make, source.entries, workers, on_progress):
            writer.add(result)
            remarks.update(result.remarks)
            failed += [result] if result.status == FAILED else []
        if len(failed) == len(tasks):
            if is_new:
                shutil.rmtree(target)
            first = min(failed, key=lambda result: result.task)
            more = f"; {len(tasks) - 1} other rollouts fail as well" if len(tasks) > 1 else ""
            raise DataError(f"{first.error}{more}", first.hint)
        known = sorted(remarks.items())
        total = len(tasks) - len(failed)
        counted = (f"{one} ({n} of {total} rollouts)" if n < total else one for one, n in known)
        about = {"undefined": undefined, "remarks": [source.name, *source.remarks, *counted]}
        manifest |= {"state": "finished", "ended": now(), "elsewhere": about}
        expected = {task._replace(token=token) for task in tasks for token in source.tokens}
        return writer.finish(manifest, expected, default=f"not in {source.name}")


def _fingerprint(source: Source, store: str, config: RunConfig) -> dict[str, Any]:
    """What scores of rollouts that were driven elsewhere depend on, as JSON values."""
    files = {path.name: digest(path) for path in source.files}
    return {
        "shiftsim": __version__,
        "code": code_digest(),
        "store": store,
        "tokens": token_hash(source.tokens),
        "planners": {name: {"driven": files} for name in config.planners},
        "noise": {n: {"kind": "none" if n == "none" else ELSEWHERE} for n in config.noise},
        "seeds": list(config.seeds),
        "traffic": config.traffic,
        "thresholds": asdict(thresholds_of(config.thresholds)),
        "metrics": config.added_metrics,
        "metric_version": METRIC_VERSION,
    }
