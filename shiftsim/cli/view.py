"""Commands that show runs and scenarios: report, explain, diff, view, plot, inspect."""

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Exit, Option

from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, print_json, progress_bar, show_in_browser
from shiftsim.errors import ConfigError, plural
from shiftsim.files import safe_join

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shiftsim.runs.results import Run
    from shiftsim.view.build import Gallery

_WORST = 10
Others = Annotated[
    list[Path] | None,
    Option("--with", help="Another run on the same store, shown together; repeatable."),
]
Planners = Annotated[
    list[str] | None, Option("--planner", "-p", help="Only this planner; repeatable.")
]
Noises = Annotated[list[str] | None, Option("--noise", "-n", help="Only this noise; repeatable.")]
Seeds = Annotated[list[int] | None, Option("--seed", help="Only this seed; repeatable.")]
Store = Annotated[str | None, Option("--store", "-s", help="Name or folder. [the manifest's]")]
Browser = Annotated[bool, Option("--open/--no-open", help="Open the page in the browser.")]


def _list_tables(wanted: bool) -> None:
    """Name the tables of a report and leave."""
    if wanted:
        from shiftsim.report.build import TABLES

        echo("\n".join(f"{name:25} {words}" for name, words in TABLES.items()))
        raise Exit


Labels = Annotated[
    list[str] | None,
    Option("--label", help="NAME=LABEL, or RUN/NAME=LABEL: what a planner is called; repeatable."),
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
    counts = {run.path.name: run.manifest["counts"] for run in opened.runs if not run.is_complete}
    part = ", ".join(f"{one['ok']} of {one['expected']} in {run}" for run, one in counts.items())
    note = f"; planners that lack rollouts may be left out, {part} finished" if part else ""
    for name in table:
        if not any(one.name.split("_")[0] == name for one in tables):
            echo(f"no table {name}: these runs hold nothing of it{note}", err=True)
    if kind == "text" and not table:
        print_worst(opened.runs, worst)


def print_worst(runs: "Sequence[Run]", count: int) -> None:
    """Name the worst scenarios of each run, and of how many they are."""
    from shiftsim.report.scores import worst_rollouts
    from shiftsim.report.words import task_of

    for run in runs:
        rows = [row for row in worst_rollouts(run, count) if row["cls"] < 1.0]
        if rows:
            each = "one per recording and cause, each by its worst rollout"
            of = f"{len(rows)} of {len(set(run.scores['token'].to_pylist()))}"
            echo(f"\n worst scenarios of {run.path.name}, {of}, {each}")
        for row in rows:
            where = f"{row['token']}  {task_of(row).words}"
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
    from shiftsim.report.words import task_of

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
    stored = {key for run in runs for key, place in run.rollout_places.items() if place is not None}
    if any(task_of(task) in stored for tasks in chosen.values() for task in tasks):
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


def view(
    run: RunFolder,
    token: str | None = Argument(None, metavar="[TOKEN]", help="A scenario. [all of them]"),
    others: Others = None,
    planner: Planners = None,
    noise: Noises = None,
    seed: Seeds = None,
    store: Store = None,
    labels: Labels = None,
    limit: int = Option(200, help="Only the N with the lowest scores, 0 for all."),
    fork: bool = Option(
        False, "--fork", help="Also from where collisions could be avoided; needs TOKEN."
    ),
    out: Path | None = Option(None, help="Folder to write to. [RUN/view]"),
    browser: Browser = True,
    quiet: Quiet = False,
) -> None:
    """Replay rollouts in the browser: pages that need no server and no network."""
    from shiftsim.view.build import page_name, write_site

    if fork and token is None:
        raise ConfigError("--fork needs a scenario", hint="shiftsim view RUN TOKEN --fork")
    found = _galleries([run, *(others or ())], labels, store, planner, noise, seed)
    folder = out or safe_join(run, "view")
    if token is not None:
        gallery, token = _holding(found, token, others or ())
        folder.mkdir(parents=True, exist_ok=True)
        page = folder / page_name(token)
        for name, one in gallery.pages(token, fork=fork).items():
            one.save(folder / name)
        _say_shown(gallery, token, "the others are linked")
    else:
        with progress_bar(quiet=quiet) as advance:
            title = f"Replays of {run.name}"
            count = write_site(folder, found, title=title, limit=limit, on_progress=advance)
        left = sum(len(gallery.tokens) for gallery in found) - count
        echo(f"{plural(count, 'replay')}{f', {left} more with --limit 0' if left else ''}")
        page = folder / "index.html"
    echo(f"written: {page}")
    if browser:
        show_in_browser(page.resolve().as_uri())


def plot(
    run: RunFolder,
    token: str | None = Argument(None, metavar="[TOKEN]", help="A scenario."),
    at: str = Option("0", help="Time of a still from the start [s]; several, such as 0,5,10."),
    grid: bool = Option(False, "--grid", help="A row per rollout, a column per time."),
    width: Width = None,
    serif: Serif = False,
    plain: Plain = False,
    speed: float = Option(1.0, help="How much faster than time a film is."),
    open_against_closed: bool = Option(
        False,
        "--open-against-closed",
        help="In place of a scenario: open-loop against closed-loop scores of all of them.",
    ),
    out: Path = Option(
        Path("figure.pdf"), "--out", "-o", help="A .pdf, .png or .svg, or a film: .mp4 or .gif."
    ),
    others: Others = None,
    planner: Planners = None,
    noise: Noises = None,
    seed: Seeds = None,
    store: Store = None,
    labels: Labels = None,
    quiet: Quiet = False,
) -> None:
    """The driven paths of several rollouts over the map, as a still or a film."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.report.figures import open_against_closed as scatter
    from shiftsim.report.palette import FigureFormat, save_picture
    from shiftsim.view.still import FILMS, save_figure

    form = FigureFormat.of(width, serif=serif, plain=plain)
    if open_against_closed:
        opened = open_runs([run, *(others or ())], labels or ())
        save_picture(scatter(opened.groups(allow_partial=True), form=form).drawn, out)
        echo(f"written: {out}")
        return
    if token is None:
        raise ConfigError("no scenario", hint="shiftsim plot RUN TOKEN, or --open-against-closed")
    found = _galleries([run, *(others or ())], labels, store, planner, noise, seed)
    gallery, token = _holding(found, token, others or ())
    scenario = gallery.store.read(token)
    shown = gallery.shown(token, scenario)
    form = form._replace(note=gallery.shown_words(token))
    how: dict[str, Any] = {"at": _times(at), "in_grid": grid, "form": form}
    with progress_bar(quiet=quiet or out.suffix.lower() not in FILMS) as advance:
        save_figure(out, scenario, shown, **how, speed=speed, on_progress=advance)
    _say_shown(gallery, token, "--planner, --noise and --seed choose others")
    echo(f"written: {out}")


def _say_shown(gallery: "Gallery", token: str, others: str) -> None:
    """Say what is drawn of how much, where that is not all."""
    if words := gallery.shown_words(token):
        echo(f"{words}{f'; {others}' if len(gallery.parts(token)) > 1 else ''}")


def _times(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        what = f"times {text!r} are not numbers"
        raise ConfigError(what, hint="--at 5, or --at 0,5,10") from error


def inspect(
    store: str = Argument(metavar="STORE", help="Name or folder of a store."),
    reviewer: str = Option("", help="Who reviews. [the login name]"),
    port: int = Option(0, help="Port on this machine, 0 for a free one."),
    browser: Browser = True,
) -> None:
    """Review scenarios in the browser: accept, reject, comment, correct the route."""
    from shiftsim.data.store.tables import REVIEW
    from shiftsim.view.review import ReviewService, review_server

    if "://" in store:  # where the source's own review would take the place of what is decided
        raise ConfigError(f"store {store!r} is behind a URL", "review a copy of its folder")
    path = cli.open_store(store).path
    with review_server(ReviewService(path, reviewer), port) as server:
        echo(f"review     {server.address}")
        echo(f"kept in    {path / REVIEW}")
        echo("stop with Ctrl-C; what was decided is on disk")
        if browser:
            show_in_browser(server.address)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            echo()


def _galleries(
    folders: list[Path],
    labels: list[str] | None,
    store: str | None,
    *chosen: "Sequence[Any] | None",
) -> "list[Gallery]":
    """The rollouts of runs and benchmarks by planner, noise and seed, a gallery for each store."""
    from shiftsim.benchmarks.bench import open_runs
    from shiftsim.runs.scenarios import open_run_store
    from shiftsim.view.build import Choice, galleries

    runs = open_runs(folders, labels or ()).runs
    choice = Choice(*(tuple(values or ()) for values in chosen))
    return galleries(runs, [open_run_store(run, store) for run in runs], choice)


def _holding(found: "list[Gallery]", token: str, runs: "Sequence[Path]") -> "tuple[Gallery, str]":
    """The gallery that holds a scenario, and its whole token; each of `runs` must have it, too."""
    *others, gallery = found
    for other in reversed(others):
        with suppress(ConfigError):
            other.find(token)
            gallery = other
    token = gallery.find(token)
    held = [one.run.path.resolve() for key, one in gallery.rollouts.items() if key.token == token]
    for run in runs:
        if not any(path.is_relative_to(run.resolve()) for path in held):
            raise ConfigError(f"--with {run}: no rollout of scenario {token} of that store")
    return gallery, token
