"""Commands that work on a whole store: check, filter, stats, split, export nuplan."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import (
    Json,
    Quiet,
    new_app,
    plural,
    progress_bar,
    say,
    say_json,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from shiftsim.data.store.check import Problem, RecordingRow
    from shiftsim.data.store.reading import ScenarioStore
    from shiftsim.runs.filter import FilterResults

_DATA, _PARTIAL = 2, 3
_MAX_SHOWN = 20  # problems of one kind
export = new_app("Write scenarios in the formats of others.", no_args_is_help=True)

Store = Annotated[
    str,
    typer.Argument(metavar="STORE", help="Store, by name or folder."),
]


def check(
    store: Store,
    as_json: Json = False,
) -> None:
    """Validate a store: files, units, motion, maps and routes; lists every problem.

    At the end comes what was found in each recording.
    """
    from shiftsim.data.store.check import survey_store
    from shiftsim.files import store_path

    path = store_path(store)
    found = survey_store(path)
    num_errors = sum(problem.is_error for problem in found.problems)
    if as_json:
        from dataclasses import asdict

        say_json([asdict(problem) for problem in found.problems])
    else:
        _show_problems(found.problems)
        _show_recordings(found.recordings)
        unusual = len(found.problems) - num_errors
        say(f"{path}: {plural(num_errors, 'error')}, {unusual} unusual")
    if num_errors:
        raise typer.Exit(_DATA)


def _show_problems(problems: "Sequence[Problem]") -> None:
    """The first of every kind, errors before what is only unusual."""
    from collections import Counter

    shown: Counter[tuple[bool, str]] = Counter()
    for problem in sorted(problems, key=lambda problem: not problem.is_error):
        word, group = "error" if problem.is_error else "unusual", (problem.is_error, problem.kind)
        shown[group] += 1
        if shown[group] <= _MAX_SHOWN:
            remedy = f" ({problem.remedy})" if problem.remedy else ""
            say(f" {word}: {problem.where}: {problem.what}{remedy}")
    for (is_error, kind), count in shown.items():
        if count > _MAX_SHOWN:
            word = "errors" if is_error else "unusual"
            say(f" {word}: {count - _MAX_SHOWN} more of {kind or 'files'}: --json lists them")


def _show_recordings(rows: "Sequence[RecordingRow]") -> None:
    if not rows:
        return
    width = max(9, *(len(row.recording) for row in rows))
    say(f" {'recording':{width}}  length s  tracks  scenarios  errors  unusual  found")
    for row in rows:
        kinds = ", ".join(f"{kind} {count}" for kind, count in row.found.items()) or "nothing"
        counts = f"{row.tracks:6d}  {row.scenarios:9d}  {row.errors:6d}  {row.unusual:7d}"
        say(f" {row.recording:{width}}  {row.duration_s:8.1f}  {counts}  {kinds}")


@cli.with_settings("thresholds", "workers", thresholds="nuplan or deepplan. [deepplan]")
def filter_scenarios(
    store: Store,
    min_path: Annotated[float | None, typer.Option(help="Shortest path [m]. [5]")] = None,
    min_progress: Annotated[
        float | None, typer.Option(help="Least share of it along the route. [0.5]")
    ] = None,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Drive every scenario as recorded; drop those with a collision, off the road or standing.

    Dropped scenarios stay in the store and are listed; runs over the whole store leave them out.
    An interrupted filter goes on when it is started again.
    """
    from shiftsim.runs.filter import FilterConfig, filter_store
    from shiftsim.runs.scenarios import open_named_store

    given: dict[str, Any] = {
        "thresholds": settings.get("thresholds"),
        "min_path_m": min_path,
        "min_progress_share": min_progress,
    }
    config = FilterConfig(**{name: value for name, value in given.items() if value is not None})
    folder = open_named_store(store).path
    with progress_bar(quiet=quiet or as_json) as advance:
        found = filter_store(
            folder,
            config,
            workers=settings.get("workers", 0),
            on_progress=advance,
        )
    if as_json:
        say_json({"config": found.config, "counts": found.counts(), "verdicts": found.rows})
    else:
        _show_verdicts(found, thresholds=config.thresholds)
    if found.counts()["failed"]:
        raise typer.Exit(_PARTIAL)


def _show_verdicts(found: "FilterResults", *, thresholds: str) -> None:
    for row in found.rejected:
        details = [f"{row[n]:.1f} m {what}" for n, what in _DETAILS.items() if row[n] is not None]
        if row["partner_token"] is not None:
            details.insert(0, f"track {row['partner_token']} at {row['first_violation_s']:.1f} s")
        tail = f"  ({', '.join(details)})" if details else ""
        say(f" {row['verdict']}: {row['token']}  {row['reason']}{tail}")
    counts = found.counts()
    say(
        f" {counts['accepted']} of {plural(len(found.rows), 'scenario')} accepted, "
        f"{counts['dropped']} dropped, {counts['failed']} failed"
        f"   thresholds {thresholds} → {found.path}"
    )


_DETAILS = {"path_m": "path", "progress_m": "along the route", "max_outside_m": "off the road"}


def _chosen(store: "ScenarioStore", settings: cli.Settings) -> tuple[str, ...]:
    """The scenarios of a split, or all that review and filter accepted."""
    from shiftsim.errors import DataError
    from shiftsim.runs.filter import read_filter_results
    from shiftsim.runs.scenarios import find_split

    if split := settings.get("split"):
        tokens = find_split(split, store.path, store.tokens).tokens
        missing = sorted(set(tokens) - set(store.tokens))
        if missing:
            raise DataError(
                f"split {split!r} needs {len(tokens)} scenarios, the store lacks {len(missing)} of"
                f" them, such as {missing[0]!r}",
                hint="name the store that was converted for this split",
            )
        return tokens
    if settings.get("all_scenarios"):
        return store.tokens
    verdicts = read_filter_results(store.path, store.hash)
    usable = store.tokens if verdicts is None else verdicts.accepted
    return store.reviews.usable(store.tokens, usable)


@cli.with_settings("split", "all_scenarios")
def make_split(
    store: Store,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="File to write: .toml (count and hash too) or .txt.")
    ],
    types: Annotated[
        list[str] | None, typer.Option("--type", help="Scenario type; repeatable. [all]")
    ] = None,
    cities: Annotated[list[str] | None, typer.Option("--city", help="Repeatable. [all]")] = None,
    per_type: Annotated[int | None, typer.Option(min=1, help="At most N of every type.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="At most N in all.")] = None,
    *,
    settings: cli.Settings,
    as_json: Json = False,
) -> None:
    """Write a list of scenarios that --split takes, the same however often it is written.

    Scenarios are taken in the order of their tokens, which says nothing about their content.
    """
    from shiftsim.runs.scenarios import choose_scenarios, open_named_store, write_split

    opened = open_named_store(store)
    found = choose_scenarios(
        opened.summary().select(["token", "type", "city"]).to_pylist(),
        set(_chosen(opened, settings)),
        wanted={"type": types or [], "city": cities or []},
        per_type=per_type,
        limit=limit,
    )
    written = write_split(out, found)
    if as_json:
        say_json({"path": str(out), "count": len(found), "hash": written.hash})
    else:
        say(f" {plural(len(found), 'scenario')} of {len(opened)}, hash {written.hash} → {out}")


@export.command("nuplan")
@cli.with_settings("split", "all_scenarios")
def export_to_nuplan(
    store: Store,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")],
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write scenarios as nuPlan logs (.db) and maps (map.gpkg), one log per scenario.

    nuPlan's own code opens its four city maps whatever map is asked for: put them into the folder
    of the maps too, and merge the two index files.
    """
    from shiftsim.data.nuplan.export import export_nuplan
    from shiftsim.runs.scenarios import open_named_store

    opened = open_named_store(store)
    tokens = _chosen(opened, settings)
    with progress_bar(quiet=quiet or as_json) as advance:
        report = export_nuplan(opened, out, tokens=tokens, progress=advance)
    mappings: list[dict[str, Any]] = [
        {"type": kind, "mapping": list(mapping), "scenarios": count}
        for (kind, mapping), count in sorted(report.mappings.items())
    ]
    if as_json:
        names = ("logs", "maps", "token_file", "tokens", "cities")
        shown = {name: getattr(report, name) for name in names}
        rest = {"cut_off": report.cut_off, "missing_maps": report.missing_maps}
        say_json(shown | {"mappings": mappings} | rest)
        return
    say(f" {plural(len(report.tokens), 'log')} → {report.logs}")
    say(f" {plural(len(report.cities), 'map')} → {report.maps}")
    for row in mappings:
        say(f" scenario mapping to use: {row['type']}: {row['mapping']}")
    if report.renamed:
        say(f" {len(report.renamed)} tokens had another form and were replaced: --json lists them")
    if report.cut_off:
        ended = plural(report.cut_off, "recording")
        say(f" {ended} ended within 0.5 s of the last plan: nuPlan's LogFuturePlanner fails there")
    if report.missing_maps:
        say(f" nuPlan's own code also opens the maps {', '.join(report.missing_maps)}: add them")
    words = {",".join(f"{value:.12g}" for value in row["mapping"]) for row in mappings}
    mapping = f" --mapping {words.pop()}" if len(words) == 1 else ""
    say(
        f" read back: shiftsim convert nuplan {report.logs} {report.maps}"
        f" --tokens {report.token_file}{mapping} --store NAME"
    )


@cli.with_settings("split", "all_scenarios")
def show_stats(
    store: Store,
    by: Annotated[str, typer.Option(help="city or type.")] = "city",
    style: Annotated[
        str, typer.Option("--format", "-f", help="text, or csv with a row per scenario.")
    ] = "text",
    out: Annotated[Path | None, typer.Option(help="Write the table to this file.")] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw bars into this file (.png, .svg, .pdf).")
    ] = None,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Scenarios, agents, speeds, lengths and interactions, per city and in all."""
    from shiftsim.data.store.statistics import store_stats
    from shiftsim.errors import one_of
    from shiftsim.report.dataset import draw_stats, stats_dict, stats_table
    from shiftsim.runs.scenarios import open_named_store

    one_of("column", by, ("city", "type"))
    opened = open_named_store(store)
    tokens = _chosen(opened, settings)
    with progress_bar(quiet=quiet or as_json) as advance:
        found = store_stats(
            opened, tokens, progress=lambda done, total, token: advance(done, total)
        )
    text = stats_table(found, by=by, style=style)
    if figure is not None:
        name = opened.path.resolve().name
        draw_stats(found, figure, title=f"{name}: {plural(len(tokens), 'scenario')}")
    if as_json:
        say_json(stats_dict(found))
    elif out is not None:
        out.write_text(text + "\n", "utf-8")
        say(f"written: {out}")
    else:
        say(text)
        left_out = len(opened) - len(tokens)
        if left_out:
            say(f" {plural(left_out, 'scenario')} of the store left out")
    if figure is not None and not as_json:
        say(f"written: {figure}")
