"""Commands that read runs: report, explain, diff."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shiftsim import cli
from shiftsim.cli import Json, Quiet, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.report.figures import Figure
    from shiftsim.report.tables import Table
    from shiftsim.runs.results import Run

_WORST = 10
RunFolder = Annotated[
    Path, typer.Argument(metavar="RUN", help="A run folder, or that of a benchmark.")
]
RunFolders = Annotated[list[Path], typer.Argument(metavar="RUN…", help="Run folders.")]


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
    worst: Annotated[int, typer.Option(help="Name the N worst scenarios.")] = 5,
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
) -> None:
    """Tables and pictures of one or several runs, or of a benchmark's folder."""
    from shiftsim.benchmarks import known_sets
    from shiftsim.benchmarks import published as published_figures
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.errors import one_of
    from shiftsim.files import safe_join
    from shiftsim.report.build import BRIEF, TABLES, Options, make_tables, write_report
    from shiftsim.report.groups import read_groups
    from shiftsim.report.scores import summary
    from shiftsim.report.tables import FORMATS, render

    opened, own_lists, extra = open_runs(runs)
    if as_json:
        say_json([summary(run) for run in opened])
        return
    for name in style or ():
        one_of("format", name, FORMATS)
    groups = read_groups(opened, (*known_sets(), *own_lists))
    if figures and out is None:
        out = safe_join(runs[0], "report")
    kind = (style or ["text"])[0]
    default = TABLES if out or site else ("scores",) if kind == "csv" else BRIEF
    options = Options(tuple(table or default), by, published, allow_partial)
    tables = make_tables(groups, published_figures(), options)
    title = f"Report on {', '.join(folder.resolve().name for folder in runs)}"
    if not table and options.tables != ("scores",):
        tables = [*extra(groups), *tables]
    drawn = []
    if figures or site is not None:
        from shiftsim.report.figures import figures as draw

        drawn = draw(groups, allow_partial=allow_partial)
    if out is not None:
        files = write_report(out, title, opened, tables, drawn, style or FORMATS)
        say(f"{plural(len(files), 'file')} in {out}: {', '.join(path.name for path in files)}")
    if site is not None:
        with progress_bar(quiet=quiet) as advance:
            _write_pages(site, title, opened, tables, drawn, advance)
        say(f"written: {site / 'index.html'}")
    if out is not None or site is not None:
        return
    say("\n\n".join(render(one, kind, width=cli.terminal_width()) for one in tables))
    if kind == "text" and not table:
        _say_worst(opened, worst)


def _write_pages(
    folder: Path,
    title: str,
    runs: "Sequence[Run]",
    tables: "Sequence[Table]",
    drawn: "Sequence[Figure]",
    on_progress: Callable[[int, int], None],
) -> None:
    """A folder of pages: tables and pictures, and every scenario with its replay."""
    from shiftsim.report.build import report_html
    from shiftsim.runs.scenarios import open_run_store
    from shiftsim.view.build import Choice, galleries, write_site

    folder.mkdir(parents=True, exist_ok=True)
    images = {figure.save(folder).name: figure.title for figure in drawn}
    stored = [run for run in runs if any(run.rollout_places.values())]
    write_site(
        folder,
        galleries(stored, [open_run_store(run) for run in stored], Choice()),
        title=title,
        limit=0,
        above=report_html(runs, tables, images),
        on_progress=on_progress,
    )


def _say_worst(runs: "Sequence[Run]", count: int) -> None:
    from shiftsim.report.scores import worst_rollouts
    from shiftsim.report.words import task_words

    for run in runs:
        rows = worst_rollouts(run, count)
        if rows:
            say(f"\n worst scenarios of {run.path.name}, each by its worst rollout")
        for row in rows:
            where = f"{row['token']}  {task_words(row)}"
            say(f"  {row['cls']:.4f}  {where}  {row['reason']}".rstrip())


def explain(
    source: RunFolder,
    token: Annotated[
        str | None,
        typer.Argument(metavar="[TOKEN]", help="Scenario, or its beginning. [the worst ten]"),
    ] = None,
    planner: Annotated[str | None, typer.Option(help="Only this planner.")] = None,
    noise: Annotated[str | None, typer.Option(help="Only this noise.")] = None,
    seed: Annotated[int | None, typer.Option(help="Only this seed.")] = None,
    as_json: Json = False,
) -> None:
    """Why a rollout has its score, or why a task failed."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.explain import explain_lines, explain_tasks
    from shiftsim.report.scores import worst_rollouts

    runs, *_ = open_runs([source])
    if token is None:
        if as_json:
            say_json({run.path.name: worst_rollouts(run, _WORST) for run in runs})
            return
        _say_worst(runs, _WORST)
        say(f"\nwhy: shiftsim explain {source} TOKEN")
        return
    chosen = explain_tasks(runs, token, planner=planner, noise=noise, seed=seed)
    if as_json:
        tasks = [task for found in chosen.values() for task in found]
        say_json(tasks)
        return
    for name, tasks in chosen.items():
        if len(runs) > 1:
            say(f"{name}\n")
        for task in tasks:
            for line in (*explain_lines(task), ""):
                say(line)
    if any(run.rollout_places.values() for run in runs):
        say(f"see it: shiftsim view {source} {token}")


def diff(
    first: Annotated[
        Path, typer.Argument(metavar="RUN_A", help="A run folder, or that of a benchmark.")
    ],
    second: Annotated[Path, typer.Argument(metavar="RUN_B", help="Another one.")],
    limit: Annotated[int, typer.Option(help="Look into the N largest changes.")] = 10,
    as_json: Json = False,
) -> None:
    """Scenarios whose score differs between two runs, and where the rollouts part."""
    from shiftsim.benchmarks.bench import paired_runs
    from shiftsim.report.words import LONG, legend
    from shiftsim.runs.diff import diff_lines, diff_runs

    pairs = paired_runs(first, second)
    found = [diff_runs(one, other, limit=limit) for one, other in pairs]
    if as_json:
        values = [pair.to_dict() for pair in found]
        say_json(values[0] if len(pairs) == 1 else values)
        return
    for (run, _), pair in zip(pairs, found, strict=True):
        if len(pairs) > 1:
            say(f"\n{run.path.name}")
        for line in diff_lines(pair):
            say(line)
    changed = {short for pair in found for change in pair.changes for short in change.metrics}
    if changed:
        say(f" metrics: {legend(short for short in LONG if short in changed)}")
