"""Commands that simulate or score: run, demo, score."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim.cli.common import Debug, Json, Quiet, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.results import Run
    from shiftsim.runner import Prepared, Progress

_UNFINISHED, _INTERRUPTED = 3, 130
_DEMO_PLANNERS = ("log-future", "idm", "constant-velocity")
_DEMO_NOISE = ("none", "ou-high")
_MAX_NAMED_FAILURES = 5

Planners = Annotated[
    list[str] | None,
    typer.Option("--planner", "-p", help="Name or package.module:Class; repeatable."),
]
PlannerArgs = Annotated[
    list[str] | None,
    typer.Option("--planner-arg", help="key=value, or PLANNER.key=value; repeatable."),
]
Noises = Annotated[
    list[str] | None,
    typer.Option("--noise", "-n", help="none, awgn-low … ou-high, all; repeatable. [none]"),
]
Seeds = Annotated[str | None, typer.Option(help="Noise seeds, such as 0,1,2. [0]")]
Traffic = Annotated[str | None, typer.Option(help="nonreactive. [nonreactive]")]
Controller = Annotated[
    str | None, typer.Option(help="lqr, perfect or log-playback. [lqr]", show_default=False)
]
Thresholds = Annotated[str | None, typer.Option(help="nuplan or deepplan. [nuplan]")]
Store = Annotated[str | None, typer.Option("--store", "-s", help="Name or folder. [demo]")]
Split = Annotated[str | None, typer.Option(help="Name or file (.toml, .txt). [whole store]")]
Limit = Annotated[int | None, typer.Option(help="Only the first N scenarios.")]
AllScenarios = Annotated[
    bool, typer.Option("--all", help="Also the scenarios that the filter dropped.")
]
Workers = Annotated[str | None, typer.Option(help="Worker processes. [auto]")]
Out = Annotated[str | None, typer.Option(help="Run folder. [runs/<id>]")]
SaveRollouts = Annotated[str | None, typer.Option(help="all or none. [all]")]
Metrics = Annotated[
    list[str] | None,
    typer.Option("--metric", help="Own metric as package.module:function; repeatable."),
]
Config = Annotated[Path | None, typer.Option(help="Settings in TOML; flags win over it.")]
Partial = Annotated[
    bool, typer.Option("--allow-partial", help="Print a labelled mean over what finished.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Check everything, simulate nothing.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(demo)
    app.command()(run)
    app.command()(score)


def run(
    planner: Planners = None,
    noise: Noises = None,
    seeds: Seeds = None,
    store: Store = None,
    split: Split = None,
    limit: Limit = None,
    all_scenarios: AllScenarios = False,
    traffic: Traffic = None,
    controller: Controller = None,
    thresholds: Thresholds = None,
    planner_arg: PlannerArgs = None,
    metric: Metrics = None,
    config: Config = None,
    out: Out = None,
    workers: Workers = None,
    save_rollouts: SaveRollouts = None,
    allow_partial: Partial = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Simulate and score planners on scenarios."""
    from shiftsim.config import make_config, parse_argument, read_toml

    values = read_toml(config) if config else {}
    flags: dict[str, Any] = {
        "planners": planner or None,
        "noise": noise or None,
        "seeds": None if seeds is None else _numbers(seeds),
        "store": store,
        "split": split,
        "limit": limit,
        "all_scenarios": all_scenarios or None,
        "traffic": traffic,
        "controller": controller,
        "thresholds": thresholds,
        "metrics": metric or None,
        "out": out,
        "workers": None if workers is None else worker_count(workers),
        "save_rollouts": save_rollouts,
        "allow_partial": allow_partial or None,
    }
    values |= {name: value for name, value in flags.items() if value is not None}
    if planner_arg:
        named = tuple(values.get("planners", ()))
        arguments = {name: dict(table) for name, table in values.get("planner_args", {}).items()}
        for text in planner_arg:
            owner, name, value = parse_argument(text, named)
            arguments.setdefault(owner, {})[name] = value
        values["planner_args"] = arguments
    made = make_config(values, where=str(config) if config else "run")
    _run(made, dry_run=dry_run, quiet=quiet, as_json=as_json)


def _numbers(text: str) -> list[int]:
    from shiftsim.errors import ConfigError

    try:
        return [int(word) for word in text.split(",")]
    except ValueError as error:
        raise ConfigError(
            f"seeds {text!r} are not integers", hint="for example --seeds 0,1,2"
        ) from error


def worker_count(text: str | None) -> int:
    """Worker processes as given on the command line; 0 chooses from the cores."""
    from shiftsim.errors import ConfigError

    if text is None or text == "auto":
        return 0
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(
            f"workers {text!r} is neither auto nor a number from 1 on", hint="--workers auto"
        )
    return int(text)


def _run(config: Any, *, dry_run: bool, quiet: bool, as_json: bool) -> None:
    from shiftsim.runner import execute, prepare

    prepared = prepare(config)
    if not as_json:
        _announce(prepared)
    if dry_run:
        say("dry run: everything checked, nothing simulated")
        return
    with progress_bar(quiet=quiet or as_json) as advance:

        def show(progress: "Progress") -> None:
            advance(progress.done, progress.total, _shares(progress))

        try:
            finished = execute(prepared, on_progress=show, argv=sys.argv)
        except KeyboardInterrupt:
            kept = prepared.folder if prepared.folder.exists() else "nothing"
            again = shlex.join(["shiftsim", *sys.argv[1:]])
            typer.echo("error: interrupted", err=True)
            typer.echo(f"hint: kept: {kept}; start again with: {again}", err=True)
            raise typer.Exit(_INTERRUPTED) from None
    _show(finished, allow_partial=prepared.config.allow_partial, as_json=as_json)
    if not finished.is_complete:
        raise typer.Exit(_UNFINISHED)


def _shares(progress: "Progress") -> str:
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


def _announce(prepared: "Prepared") -> None:
    """Every setting, defaults included."""
    config = prepared.config
    found = len({task.token for task in prepared.tasks})
    lacking = len({task.token for task in prepared.missing})
    for name in config.planners:
        arguments = config.planner_args.get(name, {})
        given = "".join(f"  {key}={value}" for key, value in arguments.items())
        say(f"planner     {name}{given}")
    say(f"noise       {' '.join(config.noise)}   seeds {' '.join(map(str, config.seeds))}")
    say(
        f"split       {prepared.split}  {found} of {plural(found + lacking, 'scenario')} found"
        f"   store {prepared.runner.store}"
    )
    if prepared.num_dropped:
        say(f"filter      {prepared.num_dropped} dropped scenarios left out (--all keeps them)")
    say(
        f"settings    traffic {config.traffic}   controller {config.controller}"
        f"   thresholds {config.thresholds}"
    )
    if config.metrics:
        say(f"metrics     {' '.join(config.metrics)}")
    say(
        f"tasks       {len(prepared.tasks)}   workers {prepared.workers}"
        f"   rollouts {config.save_rollouts}   → {prepared.folder}"
    )
    say()


def _show(finished: "Run", *, allow_partial: bool, as_json: bool) -> None:
    from shiftsim.report import failures, summary, worst_rollouts

    if as_json:
        say_json(summary(finished))
        return
    counts = finished.manifest["counts"]
    say()
    say(finished.table(allow_partial=allow_partial))
    bad = [row for row in worst_rollouts(finished, 3) if row["cls"] < 1.0]
    if bad:
        words = (f"{row['token']} {row['planner']} {row['cls']:.2f} {row['reason']}" for row in bad)
        say(f" worst: {' · '.join(words)}")
    lost = failures(finished)
    for row in lost[:_MAX_NAMED_FAILURES]:
        say(f" {row['status']}: {row['token']} {row['planner']} {row['noise']}: {row['error']}")
    if lost:
        say(
            f" {counts['failed']} failed, {counts['missing']} missing of {counts['expected']} tasks"
            f" — shiftsim explain {finished.path} TOKEN"
        )
    say(f" results: {finished.path}")


def demo(
    out: Annotated[Path | None, typer.Option(help="Folder of the demo store.")] = None,
    workers: Workers = None,
    limit: Limit = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Generate small recordings, convert them, run three planners clean and disturbed."""
    from shiftsim.config import DEFAULT_STORE, make_config, store_path
    from shiftsim.data.synthetic import DEMO_SPLIT, demo_store
    from shiftsim.warmup import warm_up

    folder = out or store_path(DEFAULT_STORE)
    if not folder.exists():
        say(f"generating and converting recordings, compiling kernels → {folder}")
        with warm_up():
            demo_store(folder)
    values: dict[str, Any] = {
        "planners": list(_DEMO_PLANNERS),
        "noise": list(_DEMO_NOISE),
        "store": str(folder) if out else DEFAULT_STORE,
        "split": DEMO_SPLIT,
        "limit": limit or 0,
        "workers": worker_count(workers),
    }
    try:
        _run(make_config(values, where="demo"), dry_run=False, quiet=quiet, as_json=False)
    finally:
        named = f" --store {folder}" if out else ""
        say()
        say("next:")
        say(f"  shiftsim run --planner idm --noise awgn-mid --seeds 0,1,2{named}")
        say(f"  shiftsim run --planner my_package.my_module:MyPlanner{named}")
        say("  shiftsim report runs/<id>        shiftsim explain runs/<id> TOKEN")
        say("  shiftsim planners list           shiftsim --help")


def score(
    source: Annotated[Path, typer.Argument(metavar="RUN", help="A run with stored rollouts.")],
    thresholds: Thresholds = None,
    metric: Metrics = None,
    store: Annotated[str | None, typer.Option(help="Store. [the one of the run]")] = None,
    out: Out = None,
    workers: Workers = None,
    allow_partial: Partial = False,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Score stored rollouts again, under another threshold profile, without simulating."""
    from shiftsim.rescore import rescore
    from shiftsim.results import open_run

    run = open_run(source)
    with progress_bar(quiet=quiet or as_json) as advance:
        finished = rescore(
            run,
            thresholds=thresholds or run.manifest["config"]["thresholds"],
            metrics=tuple(metric or ()),
            store=store,
            out=out,
            workers=worker_count(workers),
            on_progress=lambda progress: advance(progress.done, progress.total, ""),
            argv=sys.argv,
        )
    _show(finished, allow_partial=allow_partial, as_json=as_json)
    if not finished.is_complete:
        raise typer.Exit(_UNFINISHED)
