"""`shiftsim run`, and what commands that make a run share."""

import shlex
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import Debug, Json, Quiet, output_kept, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.runs.execute import OnProgress, Progress
    from shiftsim.runs.prepare import RunPlan
    from shiftsim.runs.results import Run
    from shiftsim.world.scenario import Scenario

_UNFINISHED = 3
_MAX_NAMED_FAILURES = 5
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
    debug: Debug = False,
) -> None:
    """Simulate and score planners on scenarios."""
    from shiftsim.files import read_toml
    from shiftsim.runs.config import make_config

    values = read_toml(config) if config else {}
    texts = settings.pop("planner_args", ())
    before = values.get("planner_args", {})
    values |= settings
    if texts:
        values["planner_args"] = cli.planner_arguments(texts, before, values.get("planners", ()))
    made = make_config(values, where=str(config) if config else "run")
    run_config(made, dry_run=dry_run, live=live, quiet=quiet, as_json=as_json)


def run_config(
    config: Any, *, dry_run: bool = False, live: bool = False, quiet: bool, as_json: bool = False
) -> None:
    """Run what the settings say, print what it gave, and leave with the right code."""
    from shiftsim.runs.execute import execute
    from shiftsim.runs.prepare import prepare

    with output_kept():
        prepared = prepare(config)
    announce_data([prepared], as_json=as_json)
    if not as_json:
        _announce(prepared)
    if dry_run:
        say_dry_run([prepared], as_json=as_json)
        return
    words = [word for word in sys.argv[1:] if word not in ("--resume", "--retry-failed")]
    again = [*words, "--resume"]
    kept = interruptible(prepared.folder, again, quiet=quiet or as_json)
    with ExitStack() as around:
        around.enter_context(output_kept())
        show = around.enter_context(kept)
        tell = around.enter_context(watched([prepared], prepared.folder, live, show))
        finished = execute(prepared, on_progress=tell, argv=sys.argv)
    leave_with(finished, allow_partial=prepared.config.allow_partial, as_json=as_json)


@contextmanager
def interruptible(folder: Path, again: list[str], *, quiet: bool) -> "Iterator[OnProgress]":
    """Yields what shows progress; an interrupt, or a request to end, keeps what is finished.

    It then says in which folder that is kept, and the words of the command that goes on with it.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        from shiftsim.cli.compiling import compiling_shown

        with progress_bar(quiet=quiet) as advance, compiling_shown(partial(advance, 0, 0)):
            yield lambda progress: advance(progress.done, progress.total, progress_note(progress))
    except KeyboardInterrupt:
        command = shlex.join(["shiftsim", *again])
        raise cli.Interrupted(f"kept: {folder}; go on with: {command}") from None
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def watched(
    runs: "Sequence[RunPlan]", folder: Path, live: bool, show: "OnProgress"
) -> "Iterator[OnProgress]":
    """Yields what shows progress, on a page as well where that is wanted, as long as this lasts."""
    if not live:
        yield show
        return
    from shiftsim.runs.scenarios import open_named_store
    from shiftsim.view.live import LiveRun, LiveServer

    def read(token: str) -> "Scenario":
        stores = [open_named_store(run.store) for run in runs if token in run.selection.tokens]
        return stores[0].read(token)

    def tell(progress: "Progress") -> None:
        page.add(progress)
        show(progress)

    planners = [name for run in runs for name in run.config.planners]
    page = LiveRun(str(folder), sum(len(run.tasks) for run in runs), planners, read)
    with LiveServer(page) as server:
        typer.echo(f"live        {server.address}", err=True)
        cli.show_in_browser(server.address)
        yield tell


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


def announce_data(runs: "Sequence[RunPlan]", *, as_json: bool) -> None:
    """Say before anything else that scenarios were made up, where they were."""
    for made in dict.fromkeys(tuple(run.provenance.items()) for run in runs if run.provenance):
        told = ", ".join(str(value) if k == "name" else f"{k} {value}" for k, value in made)
        typer.echo(f"data        generated, not recorded: {told}", err=as_json)


def say_dry_run(runs: "Sequence[RunPlan]", *, as_json: bool) -> None:
    """What a run would have been."""
    if as_json:
        say_json([{"run": str(run.folder), "tasks": len(run.tasks)} for run in runs])
    else:
        say("dry run: everything checked, nothing simulated")


def _announce(prepared: "RunPlan") -> None:
    """Every setting, defaults included."""
    config, scenarios = prepared.config, prepared.selection
    found = len({task.token for task in prepared.tasks})
    missing = len({task.token for task in prepared.missing})
    for name in config.planners:
        arguments = prepared.planners[name].arguments
        given = "".join(f"  {key}={value}" for key, value in arguments.items())
        say(f"planner     {name}{given}")
        if weights := _weights(prepared.planners[name].fingerprint):
            say(f"weights     {name}, {weights}")
    say(f"noise       {' '.join(config.noise)}   seeds {' '.join(map(str, config.seeds))}")
    say(
        f"split       {scenarios.split}  {found} of {plural(found + missing, 'scenario')} found"
        f"   store {prepared.store}"
    )
    if scenarios.num_dropped:
        say(f"filter      {scenarios.num_dropped} dropped scenarios left out (--all keeps them)")
    say(
        f"settings    traffic {config.traffic}   controller {config.controller}"
        f"   thresholds {config.thresholds}"
    )
    if config.metrics:
        say(f"metrics     {' '.join(config.metrics)}")
    is_learned = any(entry.in_batches for entry in prepared.planners.values())
    if is_learned or prepared.fingerprint["batch_size"] > 1:
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
    if config.resumes:
        say(f"resume      {_BEFORE[prepared.before]}")
    say()


def _weights(fingerprint: Mapping[str, Any]) -> str:
    """Which weights a planner drives with; empty where it has none."""
    checkpoint = str(fingerprint.get("checkpoint", ""))
    if not checkpoint:
        return ""
    is_name = checkpoint.startswith("deterministic:")
    said = f"{checkpoint}: made up, the scores mean nothing" if is_name else ""
    parts = checkpoint.split(",")
    digest = "" if is_name else f"SHA-256 {' '.join(part[:12] for part in parts)}"
    return "; ".join(filter(None, (said, str(fingerprint.get("weights", "")), digest)))


def leave_with(finished: "Run", *, allow_partial: bool, as_json: bool) -> None:
    """Print what a run gave, and leave with the code for it."""
    if as_json:
        from shiftsim.report.scores import summary

        say_json(summary(finished))
    else:
        _show(finished, allow_partial=allow_partial)
    if not finished.is_complete:
        raise typer.Exit(_UNFINISHED)


def _show(finished: "Run", *, allow_partial: bool) -> None:
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
