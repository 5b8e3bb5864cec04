"""Commands about benchmark tracks: `bench` runs and reports one, `data` says what is missing."""

import sys
from typing import TYPE_CHECKING, Any

from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, print_json, print_result, stdout_to_stderr
from shiftsim.cli.run import DryRun, Live, announce, progress_of
from shiftsim.errors import MissingExtraError, plural
from shiftsim.runs.config import split_label

if TYPE_CHECKING:
    from collections.abc import Iterator

    from shiftsim.benchmarks.bench import Plan

_MAIN_TABLE = {
    "semantic-shift": "semantic-shift",
    "state-drift": "noise-robustness",
    "sensor-drift": "drift",
    "edits": "edits",
    "finding": "noise-robustness",
}
_SETTINGS = """planners store split edits checkpoints planner_args seeds noise perception
localization latency controller
limit device batch_size strict workers timeout executor scheduler resume retry_failed out
save_rollouts allow_partial""".split()


@cli.with_settings(
    *_SETTINGS,
    store="Own scenarios: name or folder (demo).",
    seeds="Only these, such as 0,1; the result is partial.",
    noise="Only these, such as perception-low or latency-200; the result is partial.",
    edits="For the track edits: a .toml file of edits, in place of those that it draws.",
    resume="Only go on with what is there, as the same command does anyway.",
    retry_failed="Do again what failed before.",
)
def bench(
    settings: cli.Settings,
    track: str = Argument(
        metavar="TRACK", help="semantic-shift, state-drift, sensor-drift, edits or finding."
    ),
    traffic: list[str] | None = Option(
        None, help="Only these modes; repeatable, also package.module:Model."
    ),
    val14: str = Option("", help="Store, or STORE:SPLIT, with Val14 (left out)."),
    published: bool = Option(False, "--published", help="The paper's figures beside the own ones."),
    estimate: bool = Option(
        False, "--estimate", help="Only say what it will cost, after a few tasks."
    ),
    shards: int = Option(1, min=1, help="Machines that share the tasks, for --estimate."),
    dry_run: DryRun = False,
    live: Live = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Run a benchmark track with all its traffic modes, noises and seeds, and report it.

    The same command again goes on where the first one ended.
    """
    from shiftsim.benchmarks import estimate as costs_of
    from shiftsim.benchmarks import load_track
    from shiftsim.benchmarks.bench import plan_bench, run_bench

    chosen = load_track(track)
    settings |= {"traffic": traffic} if traffic else {}
    out = settings.pop("out", "")
    if texts := settings.pop("planner_args", None):
        planners = settings.get("planners", ())
        settings["planner_args"] = cli.planner_arguments(texts, {}, planners)
    if published:  # beside the paper's figures nothing stands in for the paper's planners
        settings["checkpoints"] = (*settings.get("checkpoints", ()), *_official(settings))
    with stdout_to_stderr():
        plan = plan_bench(chosen, settings, reference=val14, out=out)
        costs = costs_of.estimate(plan, shards=shards) if estimate else None
    if costs is not None:
        lines = costs_of.lines(plan, costs, shards=shards)
        print_result(costs_of.as_json(plan, costs, shards=shards), lines, as_json=as_json)
        return 0
    plans = list(plan.runs.values())
    words = () if quiet and not dry_run else _plan_lines(plan)
    announce(plans, words, dry_run=dry_run, as_json=as_json)
    if dry_run:
        return 0
    with progress_of(plans, plan.folder, sys.argv[1:], live, quiet or as_json) as on_progress:
        runs = run_bench(plan, on_progress=on_progress, argv=sys.argv)
    allow_partial = settings.get("allow_partial", False)
    _report(plan, published=published, allow_partial=allow_partial, as_json=as_json)
    return 0 if all(run.is_complete for run in runs) else cli.UNFINISHED


def _official(settings: cli.Settings) -> list[str]:
    """The official checkpoint, for planners that would take weights of our own unasked."""
    from shiftsim.planners.table import OFFICIAL, shipped_file

    given = settings.get("checkpoints", ())
    if any("=" not in text for text in given):  # of the only planner with one
        return []
    named = {text.partition("=")[0] for text in given}
    arguments = settings.get("planner_args", {})
    named |= {name for name, values in arguments.items() if "checkpoint" in values}
    labels = map(split_label, settings.get("planners", ()))
    names = [label for label, source in labels if shipped_file(source) is not None]
    return [f"{name}={OFFICIAL}" for name in names if name not in named]


def _plan_lines(plan: "Plan") -> "Iterator[str]":
    first = next(iter(plan.runs.values()))
    config = first.config
    yield f"track       {plan.track.name}   planners {' '.join(config.planners)}"
    for name, run in plan.runs.items():
        found = len({task.token for task in run.tasks})
        yield (
            f"run         {name}: split {run.selection.split}, {plural(found, 'scenario')}, "
            f"traffic {run.config.traffic}, thresholds {run.config.thresholds}"
        )
        yield from (f"left out    {name}: {words}" for words in run.selection.left_out)
    yield f"noise       {' '.join(config.noise)}   seeds {' '.join(map(str, config.seeds))}"
    if config.limit:
        lists = ", ".join(f"{listed.count} of {listed.name}" for listed in plan.own)
        yield f"partial     the first {config.limit} scenarios of {lists}"
    yield f"tasks       {plan.num_tasks}   workers {first.workers}   → {plan.folder}"


def _report(plan: "Plan", *, published: bool, allow_partial: bool, as_json: bool) -> None:
    """Print the main tables, and write everything below `report/`."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.build import Options, write_report
    from shiftsim.report.figures import figures
    from shiftsim.report.scores import summary
    from shiftsim.report.tables import FORMATS, render

    opened = open_runs([plan.folder])
    options = Options(with_published=published)
    tables = opened.tables(options, with_coverage=True, allow_partial=allow_partial)
    try:
        drawn = figures(opened.groups(allow_partial=allow_partial))
    except MissingExtraError as error:
        echo(f" no pictures: {error.message}; {error.hint}", err=True)
        drawn = []
    title = f"Report on {plan.folder.resolve().name}"
    files = write_report(plan.folder / "report", title, opened.runs, tables, drawn, FORMATS)
    if as_json:
        print_json([summary(run) for run in opened.runs])
        return
    shown = ("coverage", _MAIN_TABLE[plan.track.name], "planner-comparison")
    for table in tables:
        if table.name.partition("_")[0] in shown:
            look: dict[str, Any] = {"width": cli.terminal_width(), "mark": cli.paint}
            echo("\n" + render(table, "text", **look))
    echo(f"\n report: {plan.folder / 'report'} ({plural(len(files), 'file')})")


def data(as_json: Json = False) -> None:
    """Stores, maps, splits and checkpoints that are there, and what each benchmark row lacks."""
    from shiftsim.benchmarks.inventory import list_available_data

    found = list_available_data()
    print_result(found, _inventory_lines(found), as_json=as_json)


def _inventory_lines(found: dict[str, Any]) -> "Iterator[str]":
    yield f"stores in {found['store_folder']} (SHIFTSIM_DATA)"
    for store in found["stores"]:
        if store["problem"]:
            yield f" {store['name']:18} {store['problem']}"
        for one in store["sets"]:
            label = f"   is {one['known']}" if one["known"] else ""
            yield f" {one['name']:18} {plural(one['scenarios'], 'scenario')}{label}"
        if store["maps"]:
            yield f" {'':18} maps: {', '.join(store['maps'])}"
    if not found["stores"]:
        yield " none; shiftsim demo makes one"
    yield f"checkpoints in {found['checkpoint_folder']} (SHIFTSIM_CHECKPOINTS)"
    for planner, lack in found["checkpoints"].items():
        yield f" {planner:18} {'missing' if lack else 'ready'}"
    missing: dict[str, dict[str, str]] = {}
    yield "benchmark"
    yield f" {'track':15} {'planner':18} {'Val14':16} {'own scenarios':16} planner"
    for row in found["rows"]:
        lacks = [lack["what"] for lack in row["missing"]]
        missing |= {lack["what"]: lack for lack in row["missing"]}
        ready = "missing" if f"planner {row['planner']}" in lacks else "ready"
        own = ", ".join(row["own"]) or "missing"
        reference = row["reference"] or "missing"
        yield f" {row['track']:15} {row['planner']:18} {reference:16} {own:16} {ready}"
    yield "missing" if missing else "nothing is missing"
    for what, gap in missing.items():
        yield f" {what}: {gap['get']} ({gap['page']})"
