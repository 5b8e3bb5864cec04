"""Commands that work on a whole store: check, filter, stats, split, export."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, new_app, print_json, print_result, progress_bar
from shiftsim.cli.view import Plain, Serif, Width
from shiftsim.errors import one_of, plural
from shiftsim.files import store_path

if TYPE_CHECKING:
    from collections.abc import Iterator

    from shiftsim.api.finished import Run
    from shiftsim.compat.nuplan.results import ResultsExport
    from shiftsim.data.nuplan.export import ExportReport
    from shiftsim.data.store.check import CheckReport
    from shiftsim.runs.filter import FilterResults

_MAX_SHOWN = 20  # problems of one kind
export = new_app("Write scenarios in the formats of others.", no_args_is_help=True)

Store = Annotated[str, Argument(metavar="STORE", help="Store, by name or folder.")]


def check(store: Store, as_json: Json = False) -> int:
    """Validate a store: files, units, motion, maps and routes; lists every problem.

    At the end comes what was found in each recording.
    """
    from shiftsim.data.store.check import survey_store

    path = store_path(store)
    found = survey_store(path)
    problems = [asdict(problem) for problem in found.problems]
    print_result(problems, _survey_lines(path, found), as_json=as_json)
    return cli.DATA if any(problem.is_error for problem in found.problems) else 0


def _survey_lines(path: Path, found: "CheckReport") -> "Iterator[str]":
    """The first problems of every kind, errors before what is only unusual, and recordings."""
    shown: Counter[tuple[str, str]] = Counter()
    for problem in sorted(found.problems, key=lambda problem: not problem.is_error):
        word = "error" if problem.is_error else "unusual"
        shown[word, problem.kind] += 1
        if shown[word, problem.kind] <= _MAX_SHOWN:
            remedy = f" ({problem.remedy})" if problem.remedy else ""
            yield f" {word}: {problem.where}: {problem.what}{remedy}"
    for (word, kind), count in shown.items():
        if count > _MAX_SHOWN:
            words = "errors" if word == "error" else word
            yield f" {words}: {count - _MAX_SHOWN} more of {kind or 'files'}: --json lists them"
    if found.recordings:
        width = max(9, *(len(row.recording) for row in found.recordings))
        yield f" {'recording':{width}}  length s  tracks  scenarios  errors  unusual  found"
    for row in found.recordings:
        kinds = ", ".join(f"{kind} {count}" for kind, count in row.found.items()) or "nothing"
        counts = f"{row.tracks:6d}  {row.scenarios:9d}  {row.errors:6d}  {row.unusual:7d}"
        yield f" {row.recording:{width}}  {row.duration_s:8.1f}  {counts}  {kinds}"
    errors = sum(problem.is_error for problem in found.problems)
    yield f"{path}: {plural(errors, 'error')}, {len(found.problems) - errors} unusual"


@cli.with_settings("thresholds", "workers", thresholds="nuplan or deepplan. [deepplan]")
def filter_scenarios(
    settings: cli.Settings,
    store: Store,
    min_path: float | None = Option(None, help="Shortest path [m]. [5]"),
    min_progress: float | None = Option(None, help="Least share of it along the route. [0.5]"),
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Drive every scenario as recorded; drop those with a collision, off the road or standing.

    Dropped scenarios stay in the store and are listed; runs over the whole store leave them out.
    An interrupted filter goes on when it is started again.
    """
    workers = settings.pop("workers", 0)
    limits = cli.given(min_path_m=min_path, min_progress_share=min_progress)
    opened = cli.open_store(store)
    with progress_bar(quiet=quiet or as_json) as advance:
        found = opened.filter(workers=workers, on_progress=advance, **settings, **limits)
    values = {"config": found.config, "counts": found.counts(), "verdicts": found.rows}
    print_result(values, _verdict_lines(found, found.config["thresholds"]), as_json=as_json)
    return cli.UNFINISHED if found.counts()["failed"] else 0


def _verdict_lines(found: "FilterResults", thresholds: str) -> "Iterator[str]":
    for row in found.rejected:
        details = [f"{row[n]:.1f} m {what}" for n, what in _DETAILS.items() if row[n] is not None]
        if row["partner_token"] is not None:
            details.insert(0, f"track {row['partner_token']} at {row['first_violation_s']:.1f} s")
        tail = f"  ({', '.join(details)})" if details else ""
        yield f" {row['verdict']}: {row['token']}  {row['reason']}{tail}"
    counts = found.counts()
    yield (
        f" {counts['accepted']} of {plural(len(found.rows), 'scenario')} accepted, "
        f"{counts['dropped']} dropped, {counts['failed']} failed"
        f"   thresholds {thresholds} → {found.path}"
    )


_DETAILS = {"path_m": "path", "progress_m": "along the route", "max_outside_m": "off the road"}


@cli.with_settings("split", "all_scenarios")
def make_split(
    settings: cli.Settings,
    store: Store,
    out: Path = Option(
        ..., "--out", "-o", help="File to write: .toml (count and hash too) or .txt."
    ),
    types: list[str] | None = Option(None, "--type", help="Scenario type; repeatable. [all]"),
    cities: list[str] | None = Option(None, "--city", help="Repeatable. [all]"),
    per_type: int | None = Option(None, min=1, help="At most N of every type."),
    limit: int | None = Option(None, min=1, help="At most N in all."),
    as_json: Json = False,
) -> None:
    """Write a list of scenarios that --split takes, the same however often it is written.

    Scenarios are taken in the order of their tokens, which says nothing about their content.
    """
    from shiftsim.runs.scenarios import choose_scenarios, usable_tokens, write_split

    opened = cli.open_store(store)
    found = choose_scenarios(
        opened.summary().select(["token", "type", "city"]).to_pylist(),
        set(usable_tokens(opened, **settings)),
        wanted={"type": types or [], "city": cities or []},
        per_type=per_type,
        limit=limit,
    )
    written = write_split(out, found)
    line = f" {plural(len(found), 'scenario')} of {len(opened)}, hash {written.hash} → {out}"
    values = {"path": str(out), "count": len(found), "hash": written.hash}
    print_result(values, [line], as_json=as_json)


@export.command("nuplan")
@cli.with_settings("split", "all_scenarios")
def export_to_nuplan(
    settings: cli.Settings,
    store: Store,
    out: Path = Option(..., "--out", "-o", help="Folder to write to."),
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write scenarios as nuPlan logs (.db) and maps (map.gpkg), one log per scenario.

    nuPlan's own code opens its four city maps whatever map is asked for: put them into the folder
    of the maps too, and merge the two index files.
    """
    from shiftsim.runs.scenarios import usable_tokens

    opened = cli.open_store(store)
    tokens = usable_tokens(opened, **settings)
    with progress_bar(quiet=quiet or as_json) as advance:
        report = opened.export_nuplan(out, tokens=tokens, progress=advance)
    mappings: list[dict[str, Any]] = [
        {"type": kind, "mapping": list(mapping), "scenarios": count}
        for (kind, mapping), count in sorted(report.mappings.items())
    ]
    names = "logs maps token_file tokens cities mappings cut_off longer missing_maps".split()
    values = {name: getattr(report, name) for name in names} | {"mappings": mappings}
    print_result(values, _export_lines(report, mappings), as_json=as_json)


def _export_lines(report: "ExportReport", mappings: list[dict[str, Any]]) -> "Iterator[str]":
    yield f" {plural(len(report.tokens), 'log')} → {report.logs}"
    yield f" {plural(len(report.cities), 'map')} → {report.maps}"
    for row in mappings:
        yield f" scenario mapping to use: {row['type']}: {row['mapping']}"
    if report.renamed:
        yield f" {len(report.renamed)} tokens had another form and were replaced: --json lists them"
    if report.cut_off:
        ended = plural(report.cut_off, "recording")
        yield f" {ended} ended within 0.5 s of the last plan: nuPlan's LogFuturePlanner fails there"
    if report.longer:
        logs = plural(report.longer, "log")
        yield f" {logs} with rows behind the window: log-future sees them in nuPlan only"
    if report.missing_maps:
        yield f" nuPlan's own code also opens the maps {', '.join(report.missing_maps)}: add them"
    words = {",".join(f"{value:.12g}" for value in row["mapping"]) for row in mappings}
    mapping = f" --mapping {words.pop()}" if len(words) == 1 else ""
    yield (
        f" read back: shiftsim convert nuplan {report.logs} {report.maps}"
        f" --tokens {report.token_file}{mapping} --store NAME"
    )


@export.command("results")
@cli.with_settings("store", "workers", store="Store. [the one of the run]")
def export_results(
    settings: cli.Settings,
    source: Path = Argument(metavar="RUN", help="A run with stored rollouts."),
    out: Path = Option(..., "--out", "-o", help="Folder to write to."),
    logs: Path | None = Option(
        None, envvar="NUPLAN_DATA_ROOT", help="Folder of the .db logs, which nuBoard opens."
    ),
    maps: Path | None = Option(
        None, envvar="NUPLAN_MAPS_ROOT", help="Folder of the maps, which nuBoard opens."
    ),
    tables_only: bool = Option(False, "--tables-only", help="Write no simulation logs."),
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write a run as nuPlan's own result folders, which nuBoard and other scripts read.

    nuPlan knows neither noise nor seeds: each of them has a folder of its own.
    """
    import shiftsim

    run, places = shiftsim.open_run(source), cli.given(logs=logs, maps=maps)
    with progress_bar(quiet=quiet or as_json) as advance:
        values = {"simulation_logs": not tables_only, "progress": advance, **settings, **places}
        report = run.export_results(out, **values)
    for name, folder in places.items():
        if not folder.is_dir() and not tables_only:
            echo(f"--{name}: there is no folder {folder} here, where nuBoard will look", err=True)
    place = settings.get("store") or run.manifest["config"]["store"]
    print_result(asdict(report), _result_lines(report, run, place), as_json=as_json)


def _result_lines(report: "ResultsExport", run: "Run", store: str) -> "Iterator[str]":
    failed = f", {plural(report.failed, 'task')} without" if report.failed else ""
    yield f" {plural(report.rollouts, 'scored rollout')}{failed}"
    yield from (f" experiment: {folder}" for folder in report.folders)
    facts = run.manifest["determining"]
    if facts["thresholds"]["name"] != "nuplan":
        yield f" thresholds {facts['thresholds']['name']}: nuPlan's own code gives other scores"
    for what, known in ("traffic", "nonreactive reactive"), ("controller", "lqr"):
        if facts[what] not in known.split():
            yield f" {what} {facts[what]}, which nuPlan does not have"
    out = report.folders[0].parent.parent
    yield f" read back: shiftsim verify --experiment {out} --store {store}"


@cli.with_settings("split", "all_scenarios")
def show_stats(
    settings: cli.Settings,
    store: Store,
    by: str = Option("city", help="city or type."),
    style: str = Option("text", "--format", "-f", help="text, or csv with a row per scenario."),
    out: Path | None = Option(None, help="Write the table to this file."),
    figure: Path | None = Option(None, help="Draw bars into this file (.png, .svg, .pdf)."),
    width: Width = None,
    serif: Serif = False,
    plain: Plain = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Scenarios, agents, speeds, lengths and interactions, per city and in all."""
    from shiftsim.benchmarks import published
    from shiftsim.data.store.statistics import store_stats
    from shiftsim.report.dataset import stats_dict, stats_figure, stats_table
    from shiftsim.report.palette import FigureFormat, save_picture
    from shiftsim.runs.scenarios import usable_tokens

    one_of("column", by, ("city", "type"))
    opened = cli.open_store(store)
    tokens = usable_tokens(opened, **settings)
    with progress_bar(quiet=quiet or as_json) as advance:
        found = store_stats(
            opened, tokens, progress=lambda done, total, token: advance(done, total)
        )
    columns = cli.terminal_width() if out is None else 0
    text = stats_table(found, by=by, style=style, width=columns)
    if figure is not None:
        name = opened.path.resolve().name
        title = f"{name}: {plural(len(tokens), 'scenario')}"
        form = FigureFormat.of(width, serif=serif, plain=plain)
        save_picture(stats_figure(found, published(), title=title, form=form), figure)
    if as_json:
        print_json(stats_dict(found, published()))
        return
    if out is not None:
        out.write_text(text + "\n", "utf-8")
        echo(f"written: {out}")
    else:
        (echo if style == "text" else typer.echo)(text)
        if left_out := len(opened) - len(tokens):
            echo(f" {plural(left_out, 'scenario')} of the store left out")
    if figure is not None:
        echo(f"written: {figure}")
