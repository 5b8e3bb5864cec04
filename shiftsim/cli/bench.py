"""The command that runs a whole benchmark track and reports it."""

import shlex
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from shiftsim.cli.common import Debug, Json, Quiet, plural, progress_bar, say, say_json
from shiftsim.cli.reading import terminal_width
from shiftsim.cli.running import (
    BatchSize,
    Checkpoints,
    Controller,
    Device,
    DryRun,
    Executor,
    Limit,
    Out,
    Partial,
    PlannerArgs,
    Planners,
    SaveRollouts,
    Scheduler,
    Strict,
    Timeout,
    Workers,
    numbers,
    planner_arguments,
    progress_note,
    stopped_as_interrupt,
    worker_count,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shiftsim.benchmarks.bench import Plan
    from shiftsim.report.figures import Figure
    from shiftsim.report.groups import Group
    from shiftsim.runs.execute import Progress

_UNFINISHED, _INTERRUPTED = 3, 130
_MAIN_TABLE = {"semantic-shift": "semantic-shift", "state-drift": "noise-robustness"}


def register(app: typer.Typer) -> None:
    """Add the command of this module."""
    app.command()(bench)


def bench(
    track: Annotated[str, typer.Argument(help="semantic-shift or state-drift.")],
    planner: Planners = None,
    store: Annotated[
        str | None, typer.Option("--store", "-s", help="Own scenarios: name or folder (demo).")
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="Name or file (the whole store; demo-mini of the demo).")
    ] = None,
    val14: Annotated[
        str | None, typer.Option(help="Store, or STORE:SPLIT, with Val14 (left out).")
    ] = None,
    checkpoint: Checkpoints = None,
    planner_arg: PlannerArgs = None,
    seeds: Annotated[
        str | None, typer.Option(help="Only these, such as 0,1; the result is partial.")
    ] = None,
    noise: Annotated[
        list[str] | None, typer.Option("--noise", "-n", help="Only these; the result is partial.")
    ] = None,
    traffic: Annotated[
        str | None, typer.Option(help="Only this mode; the result is partial.")
    ] = None,
    controller: Controller = None,
    limit: Limit = None,
    device: Device = None,
    batch_size: BatchSize = None,
    strict: Strict = False,
    workers: Workers = None,
    timeout: Timeout = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    retry_failed: Annotated[
        bool, typer.Option("--retry-failed", help="Do again what failed before.")
    ] = False,
    out: Out = None,
    save_rollouts: SaveRollouts = None,
    published: Annotated[
        bool, typer.Option("--published", help="The paper's figures beside the own ones.")
    ] = False,
    allow_partial: Partial = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Run a benchmark track with all its traffic modes, noises and seeds, and report it.

    The same command again goes on where the first one ended.
    """
    from shiftsim.benchmarks import load_track
    from shiftsim.benchmarks.bench import plan_bench, run_bench

    chosen = load_track(track)
    settings = {
        "planners": planner or None,
        "planner_args": planner_arguments(planner_arg, {}, planner or ()) or None,
        "checkpoints": checkpoint or None,
        "store": store,
        "split": split,
        "seeds": None if seeds is None else numbers(seeds),
        "noise": noise or None,
        "traffic": traffic,
        "controller": controller,
        "limit": limit,
        "device": device,
        "batch_size": batch_size,
        "strict": strict or None,
        "timeout": timeout,
        "executor": executor,
        "scheduler": scheduler,
        "retry_failed": retry_failed or None,
        "workers": None if workers is None else worker_count(workers),
        "save_rollouts": save_rollouts,
        "allow_partial": allow_partial or None,
    }
    given = {name: value for name, value in settings.items() if value is not None}
    plan = plan_bench(chosen, given, reference=val14 or "", out=out or "")
    if not as_json:
        _announce(plan)
    if dry_run:
        say("dry run: everything checked, nothing simulated")
        return
    with progress_bar(quiet=quiet or as_json) as advance, stopped_as_interrupt():

        def show(progress: "Progress") -> None:
            advance(progress.done, progress.total, progress_note(progress))

        try:
            runs = run_bench(plan, on_progress=show, argv=sys.argv)
        except KeyboardInterrupt:
            typer.echo("error: interrupted", err=True)
            again = shlex.join(["shiftsim", *sys.argv[1:]])
            typer.echo(f"hint: kept: {plan.folder}; go on with: {again}", err=True)
            raise typer.Exit(_INTERRUPTED) from None
    _report(plan, published=published, allow_partial=allow_partial, as_json=as_json)
    if not all(run.is_complete for run in runs):
        raise typer.Exit(_UNFINISHED)


def _announce(plan: "Plan") -> None:
    """What will be run."""
    track, own = plan.track, plan.own
    first = next(iter(plan.runs.values()))
    config = first.config
    say(f"track       {track.name}   planners {' '.join(config.planners)}")
    for name, prepared in plan.runs.items():
        found = len({task.token for task in prepared.tasks})
        say(
            f"run         {name}: split {prepared.split}, {plural(found, 'scenario')}, "
            f"traffic {prepared.config.traffic}, thresholds {prepared.config.thresholds}"
        )
    say(f"noise       {' '.join(config.noise)}   seeds {' '.join(map(str, config.seeds))}")
    if config.limit:
        say(f"partial     the first {config.limit} of {own.count} scenarios")
    say(f"tasks       {plan.num_tasks}   workers {first.workers}   → {plan.folder}")
    say()


def _report(plan: "Plan", *, published: bool, allow_partial: bool, as_json: bool) -> None:
    """Print the main tables, and write everything below `report/`."""
    from shiftsim.benchmarks import known_sets
    from shiftsim.benchmarks import published as published_figures
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.build import TABLES, Options, make_tables, write_report
    from shiftsim.report.groups import read_groups
    from shiftsim.report.scores import summary
    from shiftsim.report.writers import FORMATS, render

    runs, own, extra = open_runs([plan.folder])
    groups = read_groups(runs, (*known_sets(), *own))
    options = Options(TABLES, None, published, allow_partial)
    tables = [*extra(groups), *make_tables(groups, published_figures(), options)]
    files = write_report(plan.folder / "report", tables, _pictures(groups, allow_partial), FORMATS)
    if as_json:
        say_json([summary(run) for run in runs])
        return
    shown = ("coverage", _MAIN_TABLE[plan.track.name], "planner-comparison")
    for table in tables:
        if table.name.partition("_")[0] in shown:
            say()
            say(render(table, "text", width=terminal_width()))
    say()
    say(f" report: {plan.folder / 'report'} ({plural(len(files), 'file')})")


def _pictures(groups: "Sequence[Group]", allow_partial: bool) -> "list[Figure]":
    """The pictures, or none where matplotlib is not installed."""
    from shiftsim.errors import MissingExtraError
    from shiftsim.report.figures import figures

    try:
        return figures(groups, allow_partial=allow_partial)
    except MissingExtraError as error:
        say(f" no pictures: {error}; {error.hint}")
        return []
