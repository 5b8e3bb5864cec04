"""Commands that look at things: report, explain, diff, check, planners, verify, doctor."""

import shutil
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shiftsim.cli.common import Debug, Json, Quiet, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.runs.results import Run

_USAGE, _DATA = 1, 2

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.")]
RunFolders = Annotated[list[Path], typer.Argument(metavar="RUN…", help="Run folders.")]
_PLANNERS = typer.Typer(help="Planners: what there is, and does mine obey the contract.")


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command()(report)
    app.command()(explain)
    app.command()(diff)
    app.command()(check)
    app.command()(verify)
    app.command()(doctor)
    _PLANNERS.command("list")(list_planners)
    _PLANNERS.command("check")(check_one_planner)
    _PLANNERS.callback(invoke_without_command=True)(planners)
    app.add_typer(_PLANNERS, name="planners")


def report(
    runs: RunFolders,
    style: Annotated[
        list[str] | None,
        typer.Option("--format", "-f", help="text, md, csv, latex or html; repeatable with --out."),
    ] = None,
    table: Annotated[
        list[str] | None,
        typer.Option(
            "--table", "-t", help="Only this table; repeatable. A wrong name shows the names."
        ),
    ] = None,
    by: Annotated[
        str | None, typer.Option(help="Scores per scenario_type, city or seed as well.")
    ] = None,
    published: Annotated[
        bool, typer.Option("--published", help="The paper's figures beside the own ones.")
    ] = False,
    figures: Annotated[
        bool, typer.Option("--figures", help="Pictures as well, into --out (RUN/report).")
    ] = False,
    worst: Annotated[int, typer.Option(help="Name the N worst rollouts.")] = 5,
    out: Annotated[Path | None, typer.Option(help="Write everything into this folder.")] = None,
    site: Annotated[
        Path | None,
        typer.Option(
            "--html", help="Pages into this folder: tables, pictures, scenarios with replays."
        ),
    ] = None,
    allow_partial: Annotated[
        bool, typer.Option("--allow-partial", help="Print a labelled mean over what finished.")
    ] = False,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Tables and pictures of one or several runs, or of a benchmark's folder."""
    from shiftsim.benchmarks import known_sets
    from shiftsim.benchmarks import published as published_figures
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.errors import one_of
    from shiftsim.report.build import BRIEF, TABLES, Options, make_tables, write_report
    from shiftsim.report.groups import read_groups
    from shiftsim.report.scores import summary
    from shiftsim.report.writers import FORMATS, render

    opened, own_lists, extra = open_runs(runs)
    if as_json:
        say_json([summary(run) for run in opened])
        return
    for name in style or ():
        one_of("format", name, FORMATS)
    groups = read_groups(opened, (*known_sets(), *own_lists))
    if figures and out is None:
        out = runs[0] / "report"
    kind = (style or ["text"])[0]
    default = TABLES if out or site else ("scores",) if kind == "csv" else BRIEF
    options = Options(tuple(table or default), by, published, allow_partial)
    tables = make_tables(groups, published_figures(), options)
    if not table and options.tables != ("scores",):
        tables = [*extra(groups), *tables]
    drawn = []
    if figures or site is not None:
        from shiftsim.report.figures import figures as draw

        drawn = draw(groups, allow_partial=allow_partial)
    if out is not None:
        files = write_report(out, tables, drawn, style or FORMATS)
        say(f"{plural(len(files), 'file')} in {out}: {', '.join(path.name for path in files)}")
    if site is not None:
        from shiftsim.cli.site import write_report_site

        with progress_bar(quiet=quiet) as advance:
            page = write_report_site(
                site,
                opened,
                tables,
                drawn,
                on_progress=lambda done, total: advance(done, total, ""),
            )
        say(f"written: {page}")
    if out is not None or site is not None:
        return
    say("\n\n".join(render(one, kind, width=terminal_width()) for one in tables))
    if kind == "text" and not table:
        _say_worst(opened, worst)


def terminal_width() -> int:
    """Columns of the terminal; 0 where the output goes elsewhere."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else 0


def _say_worst(runs: "Sequence[Run]", count: int) -> None:
    from shiftsim.report.scores import worst_rollouts

    for run in runs:
        rows = worst_rollouts(run, count)
        if rows:
            say(f"\n worst of {run.path.name}")
        for row in rows:
            seed = "" if row["noise"] == "none" else f" seed {row['seed']}"
            where = f"{row['token']}  {row['planner']} {row['noise']}{seed}"
            say(f"  {row['cls']:.4f}  {where}  {row['reason']}".rstrip())


def explain(
    source: RunFolder,
    token: Annotated[str, typer.Argument(help="Scenario token, or its beginning.")],
    planner: Annotated[str | None, typer.Option(help="Only this planner.")] = None,
    noise: Annotated[str | None, typer.Option(help="Only this noise.")] = None,
    seed: Annotated[int | None, typer.Option(help="Only this seed.")] = None,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Why a rollout has its score, or why a task failed."""
    from shiftsim.report.explain import explain_lines, select_tasks
    from shiftsim.runs.results import open_run

    run = open_run(source)
    chosen = select_tasks(run, token, planner=planner, noise=noise, seed=seed)
    if as_json:
        say_json(chosen)
        return
    for number, task in enumerate(chosen):
        if number:
            say()
        for line in explain_lines(task):
            say(line)


def diff(
    first: Annotated[Path, typer.Argument(metavar="RUN_A", help="A run folder.")],
    second: Annotated[Path, typer.Argument(metavar="RUN_B", help="Another one.")],
    limit: Annotated[int, typer.Option(help="Look into the N largest changes.")] = 10,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Scenarios whose score differs between two runs, and where the rollouts part."""
    from shiftsim.runs.diff import diff_lines, diff_runs
    from shiftsim.runs.results import open_run

    found = diff_runs(open_run(first), open_run(second), limit=limit)
    if as_json:
        say_json(found.to_dict())
        return
    for line in diff_lines(found):
        say(line)


def check(
    store: Annotated[str, typer.Argument(help="Store, by name or folder.")],
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Validate a store: schemas, hashes, units, links to the map; lists every problem."""
    from shiftsim.data.store.check import check_store
    from shiftsim.files import store_path

    path = store_path(store)
    problems = check_store(path)
    num_errors = sum(problem.is_error for problem in problems)
    if as_json:
        from dataclasses import asdict

        say_json([asdict(problem) for problem in problems])
    else:
        for problem in problems:
            kind = "error" if problem.is_error else "unusual"
            say(f" {kind}: {problem.where}: {problem.what}")
        unusual = len(problems) - num_errors
        say(f"{path}: {plural(num_errors, 'error')}, {unusual} unusual")
    if num_errors:
        raise typer.Exit(_DATA)


def planners(context: typer.Context, as_json: Json = False, debug: Debug = False) -> None:
    """The planners that come with shiftsim, and whether they are ready to run."""
    if context.invoked_subcommand is None:
        list_planners(as_json)


def list_planners(as_json: Json = False, debug: Debug = False) -> None:
    """The planners that come with shiftsim, and whether they are ready to run."""
    from dataclasses import asdict

    from shiftsim.planners.registry import PLANNERS, readiness

    missing = {name: readiness(entry) for name, entry in PLANNERS.items()}
    if as_json:
        say_json(
            [
                {**asdict(entry), "ready": not missing[name], "missing": missing[name]}
                for name, entry in PLANNERS.items()
            ]
        )
        return
    for name, entry in PLANNERS.items():
        say(f" {name:18} {entry.kind:11} {entry.description}")
        if entry.checkpoint is not None:
            published = f"{entry.checkpoint.file}, of the project {entry.checkpoint.project}"
            say(f" {'':18} checkpoint  {published}")
        if entry.arguments:
            say(f" {'':18} arguments   --planner-arg {', '.join(entry.arguments)}")
        if missing[name]:
            say(f" {'':18} not ready   {missing[name]}")
    ready = sum(not text for text in missing.values())
    say(f" {ready} of {len(missing)} are ready to run")


def check_one_planner(
    planner: Annotated[str, typer.Argument(help="Name or package.module:Class.")],
    planner_arg: Annotated[
        list[str] | None, typer.Option("--planner-arg", help="key=value; repeatable.")
    ] = None,
    store: Annotated[str, typer.Option(help="Store with scenarios to try it on.")] = "demo",
    token: Annotated[str | None, typer.Option(help="Scenario. [the first]")] = None,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Does a planner obey the contract? Says what is wrong, and what to do."""
    from shiftsim.planners.contract import check_planner
    from shiftsim.planners.registry import load_planner
    from shiftsim.runs.config import parse_argument
    from shiftsim.runs.execute import open_named_store

    arguments = {}
    for text in planner_arg or ():
        _, name, value = parse_argument(text, (planner,))
        arguments[name] = value
    load_planner(planner, arguments)
    scenes = open_named_store(store)
    scenario = scenes.read(token or scenes.tokens[0])
    findings = check_planner(partial(load_planner, planner, arguments), scenario)
    errors = [finding for finding in findings if finding.severity == "error"]
    if as_json:
        from dataclasses import asdict

        say_json([asdict(finding) for finding in findings])
    else:
        for finding in findings:
            say(f" {finding.severity}: {finding.check}: {finding.message}")
            if finding.hint:
                say(f"   hint: {finding.hint}")
        verdict = plural(len(errors), "error") if errors else "obeys the contract"
        say(f"{planner} on scenario {scenario.token}: {verdict}")
    if errors:
        raise typer.Exit(_USAGE)


def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of reference outputs.")],
    mode: Annotated[str | None, typer.Option(help="Only runs of this mode: NR, R or PT.")] = None,
    scenes: Annotated[Path | None, typer.Option(help="Folder with logs and maps.")] = None,
    maps: Annotated[Path | None, typer.Option(help="Folder with OpenDRIVE maps.")] = None,
    require_all: Annotated[
        bool, typer.Option("--require-all", help="Exit with 3 if anything is not covered.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Compare with reference outputs of nuPlan's own code.

    Exit codes: 0 all covered cases equal, 1 a mismatch, 2 nothing covered or not recognised,
    3 not all covered (with --require-all).
    """
    from shiftsim.errors import one_of
    from shiftsim.verify import MODES
    from shiftsim.verify import verify as compare

    if mode is not None:
        one_of("mode", mode, MODES)
    result = compare(folder, mode=mode, scenes=scenes, maps=maps)
    for line in result.lines():
        say(line)
    raise typer.Exit(result.exit_code(require_all=require_all))


def doctor(quiet: Quiet = False, as_json: Json = False, debug: Debug = False) -> None:
    """Versions, cores and memory, and whether the kernels compute what they should."""
    from shiftsim.cli.diagnosis import examine

    with progress_bar(quiet=quiet or as_json) as advance:
        found = examine(advance)
    if as_json:
        say_json(found.to_dict())
    else:
        for line in found.lines():
            say(line)
    if not found.is_well:
        raise typer.Exit(_DATA)
