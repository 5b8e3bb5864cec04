"""Commands that make runs: `run`, `demo`, and `score` and `merge`, which make them of others."""

import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

import shiftsim
from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, print_result, progress_bar, stdout_to_stderr
from shiftsim.cli.view import print_worst
from shiftsim.errors import ConfigError, plural
from shiftsim.files import DEFAULT_STORE, read_toml, store_path
from shiftsim.planners.table import PLANNERS
from shiftsim.runs.config import make_config

if TYPE_CHECKING:
    from shiftsim.runs.execute import OnProgress, Progress
    from shiftsim.runs.prepare import RunPlan
    from shiftsim.runs.results import Run
    from shiftsim.world.scenario import Scenario

_MAX_NAMED_FAILURES = 5
_WORST = 3
_KERNELS = 230  # at most, of a run that also makes its store; constant-velocity needs 70
_BEFORE = {
    "new": "nothing there yet",
    "unfinished": "goes on with what is finished",
    "failed": "had ended with failed or missing tasks",
    "complete": "is complete already",
}

Config = Annotated[Path | None, Option(help="Settings in TOML; flags win over it.")]
Live = Annotated[
    bool, Option("--live", help="Show the run while it lasts, on a page of this machine.")
]
DryRun = Annotated[bool, Option("--dry-run", help="Check everything, simulate nothing.")]


@cli.with_settings()
def run(
    settings: cli.Settings,
    config: Config = None,
    dry_run: DryRun = False,
    live: Live = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Simulate and score planners on scenarios."""
    values = read_toml(config) if config else {}
    if texts := settings.pop("planner_args", ()):
        planners = settings.get("planners", values.get("planners", ()))
        of_file = values.get("planner_args", {})
        settings["planner_args"] = cli.planner_arguments(texts, of_file, planners)
    where = str(config) if config else "run"
    how = {"dry_run": dry_run, "live": live, "quiet": quiet, "as_json": as_json}
    return run_settings(values | settings, where, **how)


def run_settings(
    values: Mapping[str, Any],
    where: str,
    *,
    dry_run: bool = False,
    live: bool = False,
    quiet: bool,
    as_json: bool = False,
) -> int:
    """Run what the settings say, print what it gave, and return the right code."""
    learned = (name for name, entry in PLANNERS.items() if entry.kind == "learned")
    named = str(values.get("planners"))  # whatever a file holds there
    what = "torch" if any(name in named for name in learned) else "NumPy and numba"
    with stdout_to_stderr(), cli.waiting(f"loading {what}", quiet=quiet or as_json) as note:
        from shiftsim.runs.execute import execute
        from shiftsim.runs.prepare import prepare

        with _compiling_shown(note):
            plan = prepare(make_config(values, where=where))
    lines = () if quiet and not dry_run else _plan_lines(plan)
    announce([plan], lines, dry_run=dry_run, as_json=as_json)
    if dry_run:
        return 0
    words = [word for word in sys.argv[1:] if word not in ("--resume", "--retry-failed")]
    words.append("--resume")
    with progress_of([plan], plan.folder, words, live, quiet or as_json) as on_progress:
        finished = execute(plan, on_progress=on_progress, argv=sys.argv)
    return code_of(finished, allow_partial=plan.config.allow_partial, as_json=as_json)


@contextmanager
def progress_of(
    plans: "Sequence[RunPlan]", folder: Path, words: list[str], live: bool, quiet: bool
) -> "Iterator[OnProgress]":
    """Yields what shows progress; an interrupt, or a request to end, says how to go on."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with stdout_to_stderr(), progress_bar(quiet=quiet) as advance:
            done, total = 0, sum(len(plan.tasks) for plan in plans)

            def note(text: str) -> None:
                advance(done, total, text)

            def show(progress: "Progress") -> None:
                nonlocal done
                done = progress.done
                advance(done, progress.total, _time_shares(progress))

            note("")
            page = _live_page(plans, folder, show) if live else nullcontext(show)
            with _compiling_shown(note), page as on_progress:
                yield on_progress
    except KeyboardInterrupt:
        command = shlex.join(["shiftsim", *words])
        raise cli.Interrupted(f"kept: {folder}; go on with: {command}") from None
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _compiling_shown(show: Callable[[str], None]) -> Iterator[None]:
    """Say in one line that kernels are compiled, once per version, and how far it is."""
    from shiftsim.kernels import machine_code

    ended = threading.Event()

    def watch() -> None:
        known = len(machine_code())
        while not ended.wait(0.5):
            count = len(machine_code())
            if count > known:
                show(f"compiling kernels, once per version: {count} of up to {_KERNELS}")
                known = count

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@contextmanager
def _live_page(
    plans: "Sequence[RunPlan]", folder: Path, show: "OnProgress"
) -> "Iterator[OnProgress]":
    """Yields what shows progress on a page as well, as long as this lasts."""
    from shiftsim.view.live import LiveRun, LiveServer

    def read(token: str) -> "Scenario":
        store = next(plan.store for plan in plans if token in plan.selection.tokens)
        return shiftsim.open_store(store).read(token)

    def add(progress: "Progress") -> None:
        page.add(progress)
        show(progress)

    planners = [name for plan in plans for name in plan.config.planners]
    page = LiveRun(str(folder), sum(len(plan.tasks) for plan in plans), planners, read)
    with LiveServer(page) as server:
        typer.echo(f"live, as long as the run lasts:\n{server.address}", err=True)
        cli.show_in_browser(server.address)
        yield add


def _time_shares(progress: "Progress") -> str:
    """Which shares of the time planning, simulation, scoring and reading take."""
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


def announce(
    plans: "Sequence[RunPlan]", lines: Iterable[str], *, dry_run: bool, as_json: bool
) -> None:
    """Print what will be run; before anything else that scenarios are synthetic, where they are."""
    for found in dict.fromkeys(tuple(p.provenance.items()) for p in plans if p.provenance):
        text = ", ".join(str(value) if k == "name" else f"{k} {value}" for k, value in found)
        echo(f"data        generated, not recorded: {text}", err=as_json)
    if not as_json and (words := [*lines]):
        echo("\n".join([*words, ""]))
    for store in dict.fromkeys(plan.store for plan in plans):
        cli.open_store(store)
    if dry_run:
        values = [{"run": str(plan.folder), "tasks": len(plan.tasks)} for plan in plans]
        lines = ["dry run: everything checked, nothing simulated"]
        print_result(values, lines, as_json=as_json)


def _plan_lines(plan: "RunPlan") -> Iterator[str]:
    """Every setting, defaults included."""
    from shiftsim.planners.registry import planner_name

    config, scenarios = plan.config, plan.selection
    found = len({task.token for task in plan.tasks})
    missing = len({task.token for task in plan.missing})
    for name in config.planners:
        planner = plan.planners[name]
        size = {"batch_size": planner.batch_size} if planner.batch_size else {}
        given = "".join(f"  {k}={value}" for k, value in {**planner.arguments, **size}.items())
        source = planner_name(planner.source)
        yield f"planner     {name}{f' = {source}' if source != name else ''}{given}"
        if weights := _weights(planner.fingerprint):
            yield f"weights     {name}, {weights}"
    yield f"noise       {' '.join(config.noise)}   seeds {' '.join(map(str, config.seeds))}"
    if len(config.seeds) == 1 and (n := config.seeds[0]) > 1:
        yield f"            {n} is the number of a single seed; for {n} seeds: --seeds 0-{n - 1}"
    first = ""
    if config.limit and config.limit < scenarios.size:
        first = f", the first of {scenarios.size}"
    yield (
        f"split       {scenarios.split}  {found} of {plural(found + missing, 'scenario')} found"
        f"{first}   store {plan.store}"
    )
    for words in scenarios.left_out:
        yield f"left out    {words}"
    yield (
        f"settings    traffic {config.traffic}   controller {config.controller}"
        f"   thresholds {config.thresholds}"
    )
    if config.metrics:
        yield f"metrics     {' '.join(config.metrics)}"
    is_learned = any(plan.planners[name].in_batches for name in config.planners)
    if is_learned or plan.fingerprint["batch_size"] > 1:
        strict = "   strict" if config.strict else ""
        yield f"networks    batch size {config.batch_size}{strict}"
    where = f"workers {plan.workers} x 1 thread"
    if config.executor == "dask":
        where = f"dask {config.scheduler}"
    limit = f"   timeout {config.timeout:g} s" if config.timeout else ""
    part = f" (shard {config.shard})" if config.shard else ""
    yield (
        f"tasks       {len(plan.tasks)}{part}   {where}{limit}"
        f"   rollouts {config.save_rollouts}   → {plan.folder}"
    )
    if config.resumes:
        yield f"resume      {_BEFORE[plan.before]}"
    elif plan.before != "new":
        yield f"again       what {plan.folder} holds will be replaced; --resume keeps it"


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


def code_of(finished: "Run", *, allow_partial: bool, as_json: bool) -> int:
    """Print what a run gave, and return the code for it."""
    if as_json:
        from shiftsim.report.scores import summary

        cli.print_json(summary(finished))
    else:
        _print_results(finished, allow_partial=allow_partial)
    return 0 if finished.is_complete else cli.UNFINISHED


def _print_results(finished: "Run", *, allow_partial: bool) -> None:
    from shiftsim.report.scores import failures, score_table

    counts = finished.manifest["counts"]
    echo()
    if not counts["expected"]:
        echo(f"no task falls into shard {finished.manifest['shard']}; merge takes it all the same")
        return
    look = {"width": cli.terminal_width(), "mark": cli.paint}
    echo(score_table([finished], allow_partial=allow_partial, **look))
    print_worst([finished], _WORST)
    lost = failures(finished)
    alike: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in lost:
        alike.setdefault((row["status"], row["error"], row["hint"]), []).append(row)
    for (status, error, hint), rows in list(alike.items())[:_MAX_NAMED_FAILURES]:
        more = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        first = f"{rows[0]['token']} {rows[0]['planner']} {rows[0]['noise']}"
        echo(f" {cli.paint(status, 'red')}: {first}{more}: {error}")
        if hint:
            echo(f"   hint: {hint}")
    if len(alike) > _MAX_NAMED_FAILURES:
        count = f"{_MAX_NAMED_FAILURES} of {len(alike)} different errors"
        echo(f" these are {count}, all of which tasks.parquet of the run holds")
    if lost:
        echo(
            f" {counts['failed']} failed, {counts['timeout']} timeout, {counts['missing']} missing"
            f" of {counts['expected']} tasks — shiftsim explain {finished.path} TOKEN"
        )
    echo(f" results: {finished.path}")
    if counts["ok"] and finished.manifest["config"]["save_rollouts"] == "all":
        echo(f" replay:  shiftsim view {finished.path}")


@cli.with_settings(
    *"thresholds metrics store out workers allow_partial traffic controller".split(),
    store="Store. [that of the run; of files demo]",
    traffic="What moved the others there, of files: a label. [elsewhere]",
    controller="What moved the ego there, of files: a label. [elsewhere]",
)
def score(
    settings: cli.Settings,
    source: Path = Argument(metavar="RUN|FILE", help="A run; poses; nuPlan's simulation logs."),
    tracks: str = Option("", help="The others: a table of boxes, or recorded. Of files."),
    point: str = Option("", help="rear_axle or center, whose poses files hold. [rear_axle]"),
    partial: bool = Option(False, "--partial", help="Also rollouts that end early; labelled so."),
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Score stored rollouts again, under other thresholds, or what was driven elsewhere.

    Tables of poses and nuPlan's simulation logs become a run folder: docs/score_elsewhere.md.
    """
    from shiftsim.api import score_files
    from shiftsim.runs.derive import rescore

    allow_partial = settings.pop("allow_partial", False)
    given: cli.Settings = {"tracks": tracks, "point": point, "partial": partial}
    is_run = (source / "manifest.json").is_file() or not (source.exists() or source.suffix)
    run = shiftsim.open_run(source) if is_run else None
    if is_run and (any(given.values()) or {"traffic", "controller"} & {*settings}):
        hint = "leave out --tracks, --point, --partial, --traffic and --controller"
        raise ConfigError(f"{str(source)!r} is a run, and not driven elsewhere", hint)
    with stdout_to_stderr(), progress_bar(quiet=quiet or as_json) as advance:
        settings |= {"on_progress": lambda now: advance(now.done, now.total), "argv": sys.argv}
        if run is None:
            finished: Run = score_files(source, **given, **settings)
        else:
            settings = {"thresholds": run.manifest["config"]["thresholds"], **settings}
            finished = rescore(run, **settings)
    return code_of(finished, allow_partial=allow_partial, as_json=as_json)


def merge(
    runs: list[Path] = Argument(metavar="RUN…", help="The shards of one run."),
    out: str | None = Option(None, help="Run folder. [that of the shards without number]"),
    allow_partial: bool = Option(
        False, "--allow-partial", help="Accept missing shards; labelled so."
    ),
    as_json: Json = False,
) -> int:
    """Join runs made with --shard: the same tables as without."""
    merged = shiftsim.merge(runs, out=out, allow_partial=allow_partial)
    return code_of(merged, allow_partial=allow_partial, as_json=as_json)


def bundle(
    source: Path = Argument(metavar="RUN", help="A run folder, or that of a benchmark."),
    store: str | None = Option(None, "--store", "-s", help="Name or folder. [the one of the run]"),
    as_json: Json = False,
) -> None:
    """Copy the scenarios and maps of a finished run into its folder: it needs no store then."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.runs.scenarios import bundle_run

    found = [(run.path, bundle_run(run, store)) for run in open_runs([source]).runs]
    values = [
        {"run": str(path), "scenarios": len(one.tokens), "maps": len(one.cities)}
        for path, one in found
    ]
    lines = [
        f" {plural(len(one.tokens), 'scenario')} in {plural(len(one.cities), 'map')} → {one.path}"
        for _, one in found
    ]
    print_result(values, lines, as_json=as_json)


@cli.with_settings("workers", "limit")
def demo(
    settings: cli.Settings,
    out: Path | None = Option(None, help="Folder of the store."),
    towns: int | None = Option(None, min=1, help="Only make N random towns to train in."),
    seed: int | None = Option(None, min=0, help="Of the random towns; same seed, same bytes. [0]"),
    domain: str | None = Option(None, help="Of the random towns: home or foreign. [all]"),
    quiet: Quiet = False,
) -> int:
    """Generate small recordings, convert them, run three planners with and without noise.

    With --towns, generate, convert and filter random towns to train in, and run nothing.
    """
    if towns is not None:
        _make_towns(out, towns, seed or 0, domain or "all", settings, quiet=quiet)
        return 0
    for name, value in (("--seed", seed), ("--domain", domain)):
        if value is not None:
            raise ConfigError(f"{name} is of random towns only", hint="say how many with --towns")
    folder = out.absolute() if out else store_path(DEFAULT_STORE)
    if not (folder.exists() or quiet):
        echo(f"generating and converting recordings → {folder}")
    with cli.waiting("loading NumPy and numba", quiet=quiet) as note:
        from shiftsim.api import DEMO

        if not folder.exists():
            with _compiling_shown(note):
                shiftsim.demo_store(folder)
    values = {**DEMO, "store": str(folder) if out else DEFAULT_STORE, **settings}
    try:
        return run_settings(values, "demo", quiet=quiet)
    finally:
        named = f" --store {out}" if out else ""
        lines = (
            "\nnext:",
            f"  shiftsim run --planner idm --noise awgn-mid --seeds 0,1,2{named}",
            f"  shiftsim run --planner my_package.my_module:MyPlanner{named}",
            "  shiftsim report runs/<id>        shiftsim view runs/<id>",
            "  shiftsim explain runs/<id> TOKEN",
            "  shiftsim planners list           shiftsim --help",
        )
        print_result(None, () if quiet else lines, as_json=False)


def _make_towns(
    out: Path | None, towns: int, seed: int, domain: str, settings: cli.Settings, *, quiet: bool
) -> None:
    """Generate, convert and filter random towns."""
    if "limit" in settings:
        raise ConfigError("--limit is of runs, --towns runs nothing", hint="leave one of them out")
    folder = out.absolute() if out else store_path(f"towns-{domain}-{seed}".replace("all-", ""))
    shown, workers = out or folder, settings.get("workers", 0)
    echo(f"generating and converting {plural(towns, 'town')} of seed {seed} → {shown}")
    with progress_bar(quiet=quiet) as advance:
        store = shiftsim.make_towns(
            folder, towns, seed=seed, domain=domain, workers=workers, on_progress=advance
        )
    echo("driving every scenario as recorded, to leave out those that cannot be driven so")
    with progress_bar(quiet=quiet) as advance:
        found = store.filter(workers=workers, on_progress=advance)
    counts = found.counts()
    echo(f" {counts['accepted']} of {plural(len(found.rows), 'scenario')} accepted → {shown}")
    echo(f" next: shiftsim run --planner log-future --store {shown} --limit 20")
