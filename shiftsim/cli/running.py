"""Commands that simulate or score: run, demo, score."""

import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim.cli.common import Debug, Json, Quiet, plural, progress_bar, say, say_json
from shiftsim.cli.merging import merge

if TYPE_CHECKING:
    from shiftsim.runs.execute import Prepared, Progress
    from shiftsim.runs.results import Run

_UNFINISHED, _INTERRUPTED = 3, 130
_DEMO_PLANNERS = ("log-future", "idm", "constant-velocity")
_DEMO_NOISE = ("none", "ou-high")
_MAX_NAMED_FAILURES = 5
_BEFORE = {
    "new": "nothing there yet",
    "unfinished": "goes on with what is finished",
    "failed": "had ended with failed or missing tasks",
    "complete": "is complete already",
}

Planners = Annotated[
    list[str] | None,
    typer.Option("--planner", "-p", help="Name or [nuplan:]package.module:Class; repeatable."),
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
Traffic = Annotated[
    str | None,
    typer.Option(
        help="nonreactive (nr), reactive (r), constant-velocity, or package.module:Model. "
        "[nonreactive]"
    ),
]
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
SaveRollouts = Annotated[str | None, typer.Option(help="all, failed (score 0) or none. [all]")]
Checkpoints = Annotated[
    list[str] | None,
    typer.Option("--checkpoint", help="PATH, or PLANNER=PATH; repeatable."),
]
Device = Annotated[str | None, typer.Option(help="cpu, cuda or auto. [cpu]")]
BatchSize = Annotated[
    int | None, typer.Option(help="Scenarios per forward pass of a learned planner. [1]")
]
Strict = Annotated[bool, typer.Option("--strict", help="Fail where a planner falls back.")]
Timeout = Annotated[
    float | None, typer.Option(help="Seconds that one scenario may take; a hung one is killed.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Finish an interrupted or killed run.")]
RetryFailed = Annotated[
    bool, typer.Option("--retry-failed", help="Finish a run, and do again what failed.")
]
Shard = Annotated[str | None, typer.Option(help="Only the part i/n of the tasks; see merge.")]
Executor = Annotated[str | None, typer.Option(help="processes or dask. [processes]")]
Scheduler = Annotated[str | None, typer.Option(help="Address of the dask scheduler.")]
Bundle = Annotated[
    bool, typer.Option("--bundle", help="Copy the scenarios used into the run folder.")
]
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
    app.command()(merge)


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
    checkpoint: Checkpoints = None,
    device: Device = None,
    batch_size: BatchSize = None,
    strict: Strict = False,
    out: Out = None,
    workers: Workers = None,
    timeout: Timeout = None,
    resume: Resume = False,
    retry_failed: RetryFailed = False,
    shard: Shard = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    save_rollouts: SaveRollouts = None,
    bundle: Bundle = False,
    allow_partial: Partial = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Simulate and score planners on scenarios."""
    from shiftsim.files import read_toml
    from shiftsim.runs.config import make_config

    values = read_toml(config) if config else {}
    flags: dict[str, Any] = {
        "planners": planner or None,
        "noise": noise or None,
        "seeds": None if seeds is None else numbers(seeds),
        "store": store,
        "split": split,
        "limit": limit,
        "all_scenarios": all_scenarios or None,
        "traffic": traffic,
        "controller": controller,
        "thresholds": thresholds,
        "metrics": metric or None,
        "checkpoints": checkpoint or None,
        "device": device,
        "batch_size": batch_size,
        "strict": strict or None,
        "out": out,
        "workers": None if workers is None else worker_count(workers),
        "timeout": timeout,
        "resume": resume or None,
        "retry_failed": retry_failed or None,
        "shard": shard,
        "executor": executor,
        "scheduler": scheduler,
        "save_rollouts": save_rollouts,
        "bundle": bundle or None,
        "allow_partial": allow_partial or None,
    }
    values |= {name: value for name, value in flags.items() if value is not None}
    if planner_arg:
        before, names = values.get("planner_args", {}), values.get("planners", ())
        values["planner_args"] = planner_arguments(planner_arg, before, names)
    made = make_config(values, where=str(config) if config else "run")
    run_config(made, dry_run=dry_run, quiet=quiet, as_json=as_json)


def planner_arguments(
    texts: Sequence[str] | None, before: Mapping[str, Any], planners: Sequence[str]
) -> dict[str, dict[str, Any]]:
    """Arguments by planner, those of the command line put over what a file says."""
    from shiftsim.runs.config import parse_argument

    arguments = {name: dict(table) for name, table in before.items()}
    for text in texts or ():
        owner, name, value = parse_argument(text, tuple(planners))
        arguments.setdefault(owner, {})[name] = value
    return arguments


def numbers(text: str) -> list[int]:
    """Seeds as given on the command line."""
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


def run_config(config: Any, *, dry_run: bool, quiet: bool, as_json: bool) -> None:
    """Run what the settings say, print what it gave, and leave with the right code."""
    from shiftsim.runs.execute import execute, prepare

    prepared = prepare(config)
    if not as_json:
        _announce(prepared)
    if dry_run:
        say("dry run: everything checked, nothing simulated")
        return
    with progress_bar(quiet=quiet or as_json) as advance, stopped_as_interrupt():

        def show(progress: "Progress") -> None:
            advance(progress.done, progress.total, progress_note(progress))

        try:
            finished = execute(prepared, on_progress=show, argv=sys.argv)
        except KeyboardInterrupt:
            words = [word for word in sys.argv[1:] if word not in ("--resume", "--retry-failed")]
            again = shlex.join(["shiftsim", *words, "--resume"])
            typer.echo("error: interrupted", err=True)
            typer.echo(f"hint: kept: {prepared.folder}; go on with: {again}", err=True)
            raise typer.Exit(_INTERRUPTED) from None
    leave_with(finished, allow_partial=prepared.config.allow_partial, as_json=as_json)


@contextmanager
def stopped_as_interrupt() -> Iterator[None]:
    """A request to end, as a batch system sends it, keeps what is finished like an interrupt."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def progress_note(progress: "Progress") -> str:
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
        arguments = prepared.runner.planners[name].arguments
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
    if any(entry.in_batches for entry in prepared.runner.planners.values()):
        strict = "   strict" if config.strict else ""
        say(f"networks    batch size {config.batch_size}{strict}")
    where = f"workers {prepared.workers} x 1 thread"
    if config.executor == "dask":
        where = f"dask {config.scheduler}"
    limit = f"   timeout {config.timeout:g} s" if config.timeout else ""
    part = f" (shard {config.shard})" if config.shard else ""
    say(
        f"tasks       {len(prepared.tasks)}{part}   {where}{limit}"
        f"   rollouts {config.save_rollouts}   → {prepared.folder}"
    )
    if prepared.resumes:
        say(f"resume      {_BEFORE[prepared.before]}")
    say()


def leave_with(finished: "Run", *, allow_partial: bool, as_json: bool) -> None:
    """Print what a run gave, and leave with the code for it."""
    _show(finished, allow_partial=allow_partial, as_json=as_json)
    if not finished.is_complete:
        raise typer.Exit(_UNFINISHED)


def _show(finished: "Run", *, allow_partial: bool, as_json: bool) -> None:
    from shiftsim.report import failures, score_table, summary, worst_rollouts

    if as_json:
        say_json(summary(finished))
        return
    counts = finished.manifest["counts"]
    say()
    say(score_table([finished], allow_partial=allow_partial))
    bad = [row for row in worst_rollouts(finished, 3) if row["cls"] < 1.0]
    if bad:
        words = (f"{row['token']} {row['planner']} {row['cls']:.2f} {row['reason']}" for row in bad)
        say(f" worst: {' · '.join(words)}")
    lost = failures(finished)
    for row in lost[:_MAX_NAMED_FAILURES]:
        say(f" {row['status']}: {row['token']} {row['planner']} {row['noise']}: {row['error']}")
    if lost:
        say(
            f" {counts['failed']} failed, {counts['timeout']} timeout, {counts['missing']} missing"
            f" of {counts['expected']} tasks — shiftsim explain {finished.path} TOKEN"
        )
    say(f" results: {finished.path}")
    if finished.manifest["config"]["save_rollouts"] == "all":
        say(f" replay:  shiftsim view {finished.path}")


def demo(
    out: Annotated[Path | None, typer.Option(help="Folder of the demo store.")] = None,
    workers: Workers = None,
    limit: Limit = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Generate small recordings, convert them, run three planners clean and disturbed."""
    from shiftsim.data.demo.store import DEMO_SPLIT, demo_store
    from shiftsim.files import store_path
    from shiftsim.runs.config import DEFAULT_STORE, make_config
    from shiftsim.verify.warmup import warm_up

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
        run_config(make_config(values, where="demo"), dry_run=False, quiet=quiet, as_json=False)
    finally:
        named = f" --store {folder}" if out else ""
        say()
        say("next:")
        say(f"  shiftsim run --planner idm --noise awgn-mid --seeds 0,1,2{named}")
        say(f"  shiftsim run --planner my_package.my_module:MyPlanner{named}")
        say("  shiftsim report runs/<id>        shiftsim view runs/<id>")
        say("  shiftsim explain runs/<id> TOKEN")
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
    from shiftsim.runs.rescore import rescore
    from shiftsim.runs.results import open_run

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
    leave_with(finished, allow_partial=allow_partial, as_json=as_json)
