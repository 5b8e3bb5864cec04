"""Commands that make runs: `run`, `demo`, and `score` and `merge`, which make them of others."""

import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import Json, Quiet, plural, progress_bar, say, say_json, stdout_to_stderr
from shiftsim.errors import ConfigError

if TYPE_CHECKING:
    from shiftsim.runs.execute import OnProgress, Progress
    from shiftsim.runs.prepare import RunPlan
    from shiftsim.runs.results import Run
    from shiftsim.world.scenario import Scenario

_UNFINISHED = 3
_MAX_NAMED_FAILURES = 5
_KERNELS_OF_A_RUN = "70 to 160"  # constant-velocity in replayed, PDM-Closed in reactive traffic
_BEFORE = {
    "new": "nothing there yet",
    "unfinished": "goes on with what is finished",
    "failed": "had ended with failed or missing tasks",
    "complete": "is complete already",
}

Config = Annotated[Path | None, typer.Option(help="Settings in TOML; flags win over it.")]
Live = Annotated[
    bool, typer.Option("--live", help="Show the run while it lasts, on a page of this machine.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Check everything, simulate nothing.")]


@cli.with_settings(*cli.ALL)
def run(
    settings: cli.Settings,
    config: Config = None,
    dry_run: DryRun = False,
    live: Live = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Simulate and score planners on scenarios."""
    from shiftsim.files import read_toml

    values = read_toml(config) if config else {}
    texts = settings.pop("planner_args", ())
    of_file = values.get("planner_args", {})
    values |= settings
    if texts:
        planners = values.get("planners", ())
        values["planner_args"] = cli.planner_arguments(texts, of_file, planners)
    where = str(config) if config else "run"
    run_settings(values, where, dry_run=dry_run, live=live, quiet=quiet, as_json=as_json)


def run_settings(
    values: Mapping[str, Any],
    where: str,
    *,
    dry_run: bool = False,
    live: bool = False,
    quiet: bool,
    as_json: bool = False,
) -> None:
    """Run what the settings say, print what it gave, and leave with the right code."""
    from shiftsim.runs.config import make_config
    from shiftsim.runs.execute import execute
    from shiftsim.runs.prepare import prepare

    with stdout_to_stderr():
        plan = prepare(make_config(values, where=where))
    say_provenance([plan], as_json=as_json)
    if not as_json:
        _say_plan(plan)
    if dry_run:
        say_dry_run([plan], as_json=as_json)
        return
    words = [word for word in sys.argv[1:] if word not in ("--resume", "--retry-failed")]
    with progress_of([plan], plan.folder, [*words, "--resume"], live, quiet or as_json) as shown:
        finished = execute(plan, on_progress=shown, argv=sys.argv)
    leave_with(finished, allow_partial=plan.config.allow_partial, as_json=as_json)


@contextmanager
def progress_of(
    plans: "Sequence[RunPlan]", folder: Path, words: list[str], live: bool, quiet: bool
) -> "Iterator[OnProgress]":
    """Yields what shows progress; an interrupt, or a request to end, keeps what is finished.

    It then says in which folder that is kept, and the words of the command that goes on with it.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        with stdout_to_stderr(), progress_bar(quiet=quiet) as advance:

            def show(progress: "Progress") -> None:
                advance(progress.done, progress.total, _note(progress))

            with _compiling_shown(partial(advance, 0, 0)):
                if not live:
                    yield show
                    return
                with _live_page(plans, folder, show) as add:
                    yield add
    except KeyboardInterrupt:
        command = shlex.join(["shiftsim", *words])
        raise cli.Interrupted(f"kept: {folder}; go on with: {command}") from None
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _compiling_shown(show: Callable[[str], None]) -> Iterator[None]:
    """Say in one line that a first run compiles, how far it is, and that this happens once.

    Nothing is said where the kernels of a run are there already.
    """
    from shiftsim.kernels import CACHE_FOLDER, machine_code

    ended = threading.Event()

    def watch() -> None:
        known = len(machine_code())
        while not ended.wait(0.5):
            count = len(machine_code())
            if count > known:
                show(f"compiling kernels, once per version: {count} of {_KERNELS_OF_A_RUN}")
                known = count

    thread = threading.Thread(target=watch, daemon=True)
    if CACHE_FOLDER:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if CACHE_FOLDER:
            thread.join()


@contextmanager
def _live_page(
    plans: "Sequence[RunPlan]", folder: Path, show: "OnProgress"
) -> "Iterator[OnProgress]":
    """Yields what shows progress on a page as well, as long as this lasts."""
    from shiftsim.runs.scenarios import open_named_store
    from shiftsim.view.live import LiveRun, LiveServer

    def read(token: str) -> "Scenario":
        store = next(plan.store for plan in plans if token in plan.selection.tokens)
        return open_named_store(store).read(token)

    def add(progress: "Progress") -> None:
        page.add(progress)
        show(progress)

    planners = [name for plan in plans for name in plan.config.planners]
    page = LiveRun(str(folder), sum(len(plan.tasks) for plan in plans), planners, read)
    with LiveServer(page) as server:
        typer.echo(f"live        {server.address}", err=True)
        cli.show_in_browser(server.address)
        yield add


def _note(progress: "Progress") -> str:
    """Where the time goes."""
    parts = dict(progress.seconds)
    planner = parts.get("planner_seconds", 0.0)
    times = {
        "planner": planner,
        "sim": parts.get("simulate_seconds", 0.0) - planner,
        "score": parts.get("metrics_seconds", 0.0),
        "io": parts.get("read_seconds", 0.0),
    }
    total = sum(times.values()) or 1.0
    text = " · ".join(f"{name} {100.0 * value / total:.0f} %" for name, value in times.items())
    return f"{text} · {progress.failed} failed" if progress.failed else text


def say_provenance(plans: "Sequence[RunPlan]", *, as_json: bool) -> None:
    """Say before anything else that scenarios are synthetic, where they are."""
    for found in dict.fromkeys(tuple(p.provenance.items()) for p in plans if p.provenance):
        text = ", ".join(str(value) if k == "name" else f"{k} {value}" for k, value in found)
        typer.echo(f"data        generated, not recorded: {text}", err=as_json)


def say_dry_run(plans: "Sequence[RunPlan]", *, as_json: bool) -> None:
    """What a run would have been."""
    if as_json:
        say_json([{"run": str(plan.folder), "tasks": len(plan.tasks)} for plan in plans])
    else:
        say("dry run: everything checked, nothing simulated")


def _say_plan(plan: "RunPlan") -> None:
    """Every setting, defaults included."""
    config, scenarios = plan.config, plan.selection
    found = len({task.token for task in plan.tasks})
    missing = len({task.token for task in plan.missing})
    for name in config.planners:
        arguments = plan.planners[name].arguments
        given = "".join(f"  {key}={value}" for key, value in arguments.items())
        say(f"planner     {name}{given}")
        if weights := _weights(plan.planners[name].fingerprint):
            say(f"weights     {name}, {weights}")
    say(f"noise       {' '.join(config.noise)}   seeds {' '.join(map(str, config.seeds))}")
    say(
        f"split       {scenarios.split}  {found} of {plural(found + missing, 'scenario')} found"
        f"   store {plan.store}"
    )
    if scenarios.num_dropped:
        say(f"filter      {scenarios.num_dropped} dropped scenarios left out (--all keeps them)")
    say(
        f"settings    traffic {config.traffic}   controller {config.controller}"
        f"   thresholds {config.thresholds}"
    )
    if config.metrics:
        say(f"metrics     {' '.join(config.metrics)}")
    is_learned = any(plan.planners[name].in_batches for name in config.planners)
    if is_learned or plan.fingerprint["batch_size"] > 1:
        strict = "   strict" if config.strict else ""
        say(f"networks    batch size {config.batch_size}{strict}")
    where = f"workers {plan.workers} x 1 thread"
    if config.executor == "dask":
        where = f"dask {config.scheduler}"
    limit = f"   timeout {config.timeout:g} s" if config.timeout else ""
    part = f" (shard {config.shard})" if config.shard else ""
    say(
        f"tasks       {len(plan.tasks)}{part}   {where}{limit}"
        f"   rollouts {config.save_rollouts}   → {plan.folder}"
    )
    if config.resumes:
        say(f"resume      {_BEFORE[plan.before]}")
    say()


def _weights(fingerprint: Mapping[str, Any]) -> str:
    """Which weights a planner drives with; empty where it has none."""
    checkpoint = str(fingerprint.get("checkpoint", ""))
    if not checkpoint:
        return ""
    is_name = checkpoint.startswith("deterministic:")
    text = f"{checkpoint}: made up, the scores mean nothing" if is_name else ""
    parts = checkpoint.split(",")
    digest = "" if is_name else f"SHA-256 {' '.join(part[:12] for part in parts)}"
    return "; ".join(filter(None, (text, str(fingerprint.get("weights", "")), digest)))


def leave_with(finished: "Run", *, allow_partial: bool, as_json: bool) -> None:
    """Print what a run gave, and leave with the code for it."""
    if as_json:
        from shiftsim.report.scores import summary

        say_json(summary(finished))
    else:
        _say_results(finished, allow_partial=allow_partial)
    if not finished.is_complete:
        raise typer.Exit(_UNFINISHED)


def _say_results(finished: "Run", *, allow_partial: bool) -> None:
    from shiftsim.report.scores import failures, score_table, worst_rollouts
    from shiftsim.report.words import task_words

    counts = finished.manifest["counts"]
    say()
    say(score_table([finished], allow_partial=allow_partial))
    bad = [row for row in worst_rollouts(finished, 3) if row["cls"] < 1.0]
    if bad:
        words = (
            f"{row['token']} {task_words(row)} {row['cls']:.2f} {row['reason']}" for row in bad
        )
        say(f" worst: {' · '.join(words)}")
    lost = failures(finished)
    alike: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in lost:
        alike.setdefault((row["status"], row["error"], row["hint"]), []).append(row)
    for (status, error, hint), rows in list(alike.items())[:_MAX_NAMED_FAILURES]:
        more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        first = f"{rows[0]['token']} {rows[0]['planner']} {rows[0]['noise']}"
        say(f" {status}: {first}{more}: {error}")
        if hint:
            say(f"   hint: {hint}")
    if lost:
        say(
            f" {counts['failed']} failed, {counts['timeout']} timeout, {counts['missing']} missing"
            f" of {counts['expected']} tasks — shiftsim explain {finished.path} TOKEN"
        )
    say(f" results: {finished.path}")
    if counts["ok"] and finished.manifest["config"]["save_rollouts"] == "all":
        say(f" replay:  shiftsim view {finished.path}")


@cli.with_settings(
    "thresholds",
    "metrics",
    "store",
    "out",
    "workers",
    "allow_partial",
    store="Store. [the one of the run]",
)
def score(
    source: Annotated[Path, typer.Argument(metavar="RUN", help="A run with stored rollouts.")],
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Score stored rollouts again, under another threshold profile, without simulating."""
    from shiftsim.runs.derive import rescore
    from shiftsim.runs.results import open_run

    run = open_run(source)
    allow_partial = settings.pop("allow_partial", False)
    with stdout_to_stderr(), progress_bar(quiet=quiet or as_json) as advance:
        finished = rescore(
            run,
            **{"thresholds": run.manifest["config"]["thresholds"], **settings},
            on_progress=lambda progress: advance(progress.done, progress.total),
            argv=sys.argv,
        )
    leave_with(finished, allow_partial=allow_partial, as_json=as_json)


def merge(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN…", help="The shards of one run.")],
    out: Annotated[
        str | None, typer.Option(help="Run folder. [that of the shards without number]")
    ] = None,
    allow_partial: Annotated[
        bool, typer.Option("--allow-partial", help="Accept missing shards; labelled so.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Join runs made with --shard: the same tables as without."""
    from shiftsim.runs.derive import merge_runs
    from shiftsim.runs.results import open_run

    merged = merge_runs([open_run(path) for path in runs], out=out, allow_partial=allow_partial)
    leave_with(merged, allow_partial=allow_partial, as_json=as_json)


@cli.with_settings("workers", "limit")
def demo(
    out: Annotated[Path | None, typer.Option(help="Folder of the store.")] = None,
    towns: Annotated[
        int | None, typer.Option(min=1, help="Only make a store of N random towns to train in.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Of the random towns; same seed, same bytes. [0]")
    ] = None,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
) -> None:
    """Generate small recordings, convert them, run three planners clean and disturbed.

    With --towns, generate, convert and filter random towns to train in, and run nothing.
    """
    if towns is not None:
        _make_towns(out, towns, seed or 0, settings, quiet=quiet)
        return
    if seed is not None:
        raise ConfigError("--seed is of random towns only", hint="say how many with --towns")
    from shiftsim.data.synthetic.store import DEMO_SPLIT, demo_store
    from shiftsim.files import store_path
    from shiftsim.runs.config import DEFAULT_STORE

    folder = out or store_path(DEFAULT_STORE)
    if not folder.exists():
        say(f"generating and converting recordings, compiling kernels → {folder}")
        demo_store(folder)
    values = {
        "planners": ["log-future", "idm", "constant-velocity"],
        "noise": ["none", "ou-high"],
        "store": str(folder) if out else DEFAULT_STORE,
        "split": DEMO_SPLIT,
        **settings,
    }
    try:
        run_settings(values, "demo", quiet=quiet)
    finally:
        named = f" --store {folder}" if out else ""
        say()
        say("next:")
        say(f"  shiftsim run --planner idm --noise awgn-mid --seeds 0,1,2{named}")
        say(f"  shiftsim run --planner my_package.my_module:MyPlanner{named}")
        say("  shiftsim report runs/<id>        shiftsim view runs/<id>")
        say("  shiftsim explain runs/<id> TOKEN")
        say("  shiftsim planners list           shiftsim --help")


def _make_towns(
    out: Path | None, towns: int, seed: int, settings: cli.Settings, *, quiet: bool
) -> None:
    """Generate, convert and filter random towns."""
    if "limit" in settings:
        raise ConfigError("--limit is of runs, --towns runs nothing", hint="leave one of them out")
    from shiftsim.data.synthetic.store import write_towns
    from shiftsim.files import store_path
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.filter import filter_store
    from shiftsim.runs.workers import map_unordered

    folder = out or store_path(f"towns-{seed}")
    workers = settings.get("workers", 0) or default_workers()
    say(f"generating and converting {plural(towns, 'town')} of seed {seed} → {folder}")
    with progress_bar(quiet=quiet) as advance:
        spread = partial(map_unordered, workers=min(workers, towns), alone=1)
        write_towns(folder, towns=towns, seed=seed, spread=spread, progress=advance)
    say("driving every scenario as recorded, to leave out those that cannot be driven so")
    with progress_bar(quiet=quiet) as advance:
        found = filter_store(folder, workers=workers, on_progress=advance)
    counts = found.counts()
    say(f" {counts['accepted']} of {plural(len(found.rows), 'scenario')} accepted → {folder}")
    say(f" next: shiftsim run --planner log-future --store {folder} --limit 20")
