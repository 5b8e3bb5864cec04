"""Commands that read runs: report, explain, diff."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Exit, Option

from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, plural, print_json, progress_bar
from shiftsim.files import safe_join

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shiftsim.runs.results import Run

_WORST = 10


def _list_tables(wanted: bool) -> None:
    """Name the tables of a report and leave."""
    if wanted:
        from shiftsim.report.build import TABLES

        echo("\n".join(f"{name:25} {words}" for name, words in TABLES.items()))
        raise Exit


Labels = Annotated[
    list[str] | None,
    Option(
        "--label",
        help="NAME=LABEL, or RUN/NAME=LABEL: what a planner is called; repeatable.",
    ),
]
Width = Annotated[
    str | None,
    Option("--width", help="Of figures: 3.5in, 7in (columns of a paper), 89mm … [as they need]"),
]
Serif = Annotated[bool, Option("--serif", help="Figures with letters as in the text of a paper.")]
Plain = Annotated[bool, Option("--plain", help="Figures without title and notes.")]
RunFolder = Annotated[Path, Argument(metavar="RUN", help="A run folder, or that of a benchmark.")]


def report(
    folders: list[Path] = Argument(metavar="RUN…", help="Run folders."),
    style: list[str] = Option(
        [], "--format", "-f", help="text, md, csv, latex or html; repeatable with --out."
    ),
    table: list[str] = Option(
        [], "--table", "-t", help="Only this table, as --list names them; repeatable."
    ),
    names: bool = Option(
        False, "--list", is_eager=True, callback=_list_tables, help="Name the tables, and leave."
    ),
    by: str | None = Option(None, help="Scores per scenario_type, city or seed as well."),
    published: bool = Option(False, "--published", help="The paper's figures beside the own ones."),
    figures: bool = Option(False, "--figures", help="Pictures as well, into --out (RUN/report)."),
    width: Width = None,
    serif: Serif = False,
    plain: Plain = False,
    worst: int = Option(5, help="Name the N worst scenarios."),
    labels: Labels = None,
    out: Path | None = Option(None, help="Write everything into this folder."),
    site: Path | None = Option(
        None, "--html", help="Pages into this folder: tables, pictures, scenarios with replays."
    ),
    allow_partial: bool = Option(
        False, "--allow-partial", help="Print a labelled mean over what finished."
    ),
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Tables and pictures of one or several runs, or of a benchmark's folder."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.build import BRIEF, TABLES, Options
    from shiftsim.report.palette import FigureFormat
    from shiftsim.report.scores import summary
    from shiftsim.report.tables import render

    form = FigureFormat.of(width, serif=serif, plain=plain)
    opened = open_runs(folders, labels or ())
    if as_json:
        print_json([summary(run) for run in opened.runs])
        return
    if figures and out is None:
        out = safe_join(folders[0], "report")
    title = f"Report on {', '.join(folder.resolve().name for folder in folders)}"
    options = Options(tuple(table or TABLES), by, published)
    shared: dict[str, Any] = {"allow_partial": allow_partial, "title": title, "form": form}
    if out is not None:
        files = opened.report(out, options, style, pictures=figures, **shared)
        echo(f"{plural(len(files), 'file')} in {out}: {', '.join(path.name for path in files)}")
    if site is not None:
        with progress_bar(quiet=quiet) as advance:
            (page,) = opened.report(site, options, pages=True, on_progress=advance, **shared)
        echo(f"written: {page}")
    if out is not None or site is not None:
        return
    kind = (style or ["text"])[0]
    default = ("scores",) if kind == "csv" else BRIEF
    options = Options(tuple(table or default), by, published)
    whole = not table and kind != "csv"
    tables = opened.tables(options, with_coverage=whole, allow_partial=allow_partial)
    look: dict[str, Any] = {"width": cli.terminal_width(), "mark": cli.paint}
    words = "\n\n".join(render(one, kind, **look) for one in tables)
    (echo if kind == "text" else typer.echo)(words)  # files are not broken into lines
    for name in table:
        if not any(one.name.split("_")[0] == name for one in tables):
            echo(f"no table {name}: these runs hold nothing of it", err=True)
    if kind == "text" and not table:
        print_worst(opened.runs, worst)


def print_worst(runs: "Sequence[Run]", count: int) -> None:
    """Name the worst scenarios of each run, and of how many they are."""
    from shiftsim.report.scores import worst_rollouts
    from shiftsim.report.words import task_words

    for run in runs:
        rows = [row for row in worst_rollouts(run, count) if row["cls"] < 1.0]
        if rows:
            each = "one per recording and cause, each by its worst rollout"
            of = f"{len(rows)} of {len(set(run.scores['token'].to_pylist()))}"
            echo(f"\n worst scenarios of {run.path.name}, {of}, {each}")
        for row in rows:
            where = f"{row['token']}  {task_words(row)}"
            others = f"  ({row['others']} more like it)" if row["others"] else ""
            score = f"{100.0 * row['cls']:6.2f}"
            score = score if row["cls"] else cli.paint(score, "red")
            echo(f"  {score}  {where}  {row['reason']}{others}".rstrip())


def explain(
    source: RunFolder,
    token: str | None = Argument(
        None, metavar="[TOKEN]", help="Scenario, or its beginning. [the worst ten]"
    ),
    planner: str | None = Option(None, help="Only this planner."),
    noise: str | None = Option(None, help="Only this noise."),
    seed: int | None = Option(None, help="Only this seed."),
    as_json: Json = False,
) -> None:
    """Why a rollout has its score, or why a task failed."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.explain import explain_lines, explain_tasks
    from shiftsim.report.scores import worst_rollouts

    runs = open_runs([source]).runs
    if token is None and as_json:
        print_json({run.path.name: worst_rollouts(run, _WORST) for run in runs})
    elif token is None:
        print_worst(runs, _WORST)
        echo(f"\nwhy: shiftsim explain {source} TOKEN")
    if token is None:
        return
    chosen = explain_tasks(runs, token, planner=planner, noise=noise, seed=seed)
    if as_json:
        print_json([task for tasks in chosen.values() for task in tasks])
        return
    for name, tasks in chosen.items():
        if len(runs) > 1:
            echo(f"{name}\n")
        for task in tasks:
            echo("\n".join([*explain_lines(task), ""]))
    if any(run.rollout_places.values() for run in runs):
        echo(f"see it: shiftsim view {source} {token}")


def diff(
    first: Path = Argument(metavar="RUN_A", help="A run folder, or that of a benchmark."),
    second: Path = Argument(metavar="RUN_B", help="Another one."),
    limit: int = Option(10, help="Look into the N largest changes."),
    tolerance: float = Option(
        1e-6, min=0.0, help="Rollouts part where they differ by more [m, rad, m/s …]."
    ),
    labels: Labels = None,
    as_json: Json = False,
) -> None:
    """Scenarios whose score differs between two runs, and where the rollouts part."""
    from shiftsim.benchmarks.bench import paired_runs
    from shiftsim.report.words import LONG, legend
    from shiftsim.runs.diff import diff_lines, diff_runs

    pairs = paired_runs(first, second, labels or ())
    found = [diff_runs(one, other, limit=limit, tolerance=tolerance) for one, other in pairs]
    if as_json:
        values = [pair.to_dict() for pair in found]
        print_json(values[0] if len(pairs) == 1 else values)
        return
    for (run, _), pair in zip(pairs, found, strict=True):
        if len(pairs) > 1:
            echo(f"\n{run.path.name}")
        echo("\n".join(diff_lines(pair)))
    changed = {short for pair in found for change in pair.changes for short in change.metrics}
    if changed:
        echo(f" metrics: {legend(short for short in LONG if short in changed)}")
