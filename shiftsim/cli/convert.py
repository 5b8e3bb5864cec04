"""Commands that make scenario stores: convert nuplan, dsc3d, tracks, av2, py123d, commonroad."""

from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

import shiftsim
from shiftsim import cli
from shiftsim.cli import Json, Quiet, echo, new_app, print_json, print_result, progress_bar
from shiftsim.errors import ConfigError, ConversionError, MissingExtraError, plural
from shiftsim.files import read_toml, store_path

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from shiftsim.data.readers.convert import ConversionReport
    from shiftsim.data.readers.tracks.reader import TracksReader
    from shiftsim.data.readers.windows import ConversionConfig

app = new_app("Make a scenario store from recordings.", no_args_is_help=True)
MAX_NAMED = 20  # failures that are printed

Store = Annotated[str, Option("--store", "-s", help="Name or folder of the store.")]
Window = Annotated[float | None, Option(help="Length of a scenario with its history [s]. [18]")]
Overlap = Annotated[float | None, Option(help="Overlap of windows [s]. [6]")]
History = Annotated[float | None, Option(help="Part of a window before iteration 0 [s]. [3]")]
Source = Annotated[Path, Argument(metavar="FOLDER", help="Folder of the data set.")]
Egos = Annotated[
    str,
    Option(
        help="recorded: the recording car; vehicles: each vehicle that drives, always so of "
        "commonroad."
    ),
]
At = Annotated[
    Path | None,
    Option(
        help="Of py123d: only scenarios that begin where this CSV file says, by columns log_name "
        "and time_us."
    ),
]
_DATASETS = {
    "av2": """Convert scenes of Argoverse 2 motion forecasting, train or val.

    A broken scene is skipped and named, and the exit code is 3. A conversion that was stopped goes
    on when it is started again. That holds for py123d and commonroad as well.
    """,
    "py123d": """Convert logs that py123d wrote: Waymo, nuScenes, Argoverse 2 Sensor, nuPlan.

    FOLDER holds logs/ and, for data sets with one map per city, maps/.
    """,
    "commonroad": """Convert CommonRoad scenarios in XML: NGSIM, INTERACTION, inD, highD and others.

    The files have no recording car: each vehicle that drives is an ego.
    """,
}


@app.command()
def nuplan(
    *,
    logs: Path = Argument(metavar="LOGS", help="Folder of .db logs, or one log."),
    maps: Path = Argument(metavar="MAPS", help="Folder of the maps."),
    store: Store,
    tokens: str | None = Option(
        None, help="Only these scenarios: a,b,c, or a file with one per line."
    ),
    types: str | None = Option(None, help="Only these scenario types: a,b,c."),
    filter_file: Path | None = Option(None, "--filter", help="nuPlan's scenario filter (.yaml)."),
    mapping: str | None = Option(
        None, help="DURATION,OFFSET,RATIO of all, such as 15,0,0.5. [nuPlan's by type]"
    ),
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Convert scenarios of nuPlan logs (.db) and maps (map.gpkg)."""
    from shiftsim.data.nuplan.scenarios import parse_mapping

    folder = store_path(store)
    filters: dict[str, Any] = {
        "tokens": _token_list(tokens) if tokens is not None else None,
        "types": [word.strip() for word in types.split(",")] if types is not None else None,
        "mapping": parse_mapping(mapping) if mapping is not None else None,
        "filter_file": filter_file,
    }
    with progress_bar(quiet=quiet or as_json) as advance:
        report = shiftsim.convert_nuplan(logs, maps, folder, **filters, progress=advance)
    lines = [
        *(f" tolerated: {flaw} ({count})" for flaw, count in report.flaws.items()),
        *_failures(report.failed),
        *(f" left by {key}: {count}" for key, count in report.left.items()),
        *(f" there are {what}: {_counted(found)}" for what, found in report.offers.items()),
        f" {plural(len(report.converted), 'scenario')} converted, "
        f"{len(report.unchanged)} unchanged, {len(report.failed)} failed → {folder}",
    ]
    print_result(vars(report), lines, as_json=as_json)
    return cli.UNFINISHED if report.failed or report.left else 0


def _counted(counts: Counter[str]) -> str:
    named = [f"{name} ({count})" for name, count in counts.most_common(MAX_NAMED)]
    others = len(counts) - len(named)
    return ", ".join(named) + (f", and {others} others" if others else "")


def _token_list(text: str) -> list[str]:
    """Tokens from a file, or from the words themselves."""
    from shiftsim.runs.scenarios import read_split

    path = Path(text)
    listed = read_split(path).tokens if path.is_file() else text.split(",")
    return [token.strip() for token in listed]


@app.command()
@cli.with_settings("workers")
def dsc3d(
    *,
    source: Path = Argument(metavar="SRC", help="Folder with data_meta.json, annotations, map."),
    store: Store,
    site: str | None = Option(None, help="Name of the site. [name of SRC]"),
    map_path: Path | None = Option(None, "--map", help="OpenDRIVE file, if it is elsewhere."),
    category: list[str] | None = Option(
        None, metavar="NAME=KNOWN", help="Read a category as a known one; repeatable."
    ),
    country: str | None = Option(None, help="Whose speed limits hold where the map has none. [DE]"),
    window_s: Window = None,
    overlap_s: Overlap = None,
    history_s: History = None,
    padding_s: float | None = Option(None, help="History made up before the first frame [s]. [0]"),
    max_per_window: int | None = Option(None, help="Egos per window. [all]"),
    config: Path | None = Option(None, help="All thresholds in TOML; flags win over it."),
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> int:
    """Convert recordings in the layout of DSC3D.

    A broken recording is skipped and named; the others are converted, and the exit code is 3. A
    conversion that was stopped goes on when it is started again.

    Planners need 2 s of history. A recording too short for that is converted with a made-up one,
    of constant velocity: --window-s 4.9 --overlap-s 0 --history-s 0 --padding-s 2.2
    """
    for word in category or ():
        name, _, known = word.partition("=")
        if not (name and known):
            raise ConfigError(f"category {word!r} is not NAME=KNOWN", "--category lorry=truck")
    flags = {
        **cli.given(window_s=window_s, overlap_s=overlap_s, history_s=history_s),
        **cli.given(country=country, padding_s=padding_s, max_per_window=max_per_window),
        **cli.given(category_map=dict(word.split("=", 1) for word in category or ()) or None),
    }
    options = _options(config, flags)
    rest: dict[str, Any] = {"site": site, "map_path": map_path, **settings, **vars(options)}
    make = partial(shiftsim.convert_dsc3d, source, **rest)
    lines = partial(_site_lines, is_short=options.is_short)
    return _convert(make, store, "site", lines, quiet=quiet, as_json=as_json)


@app.command()
def tracks(
    *,
    source: list[Path] = Argument(
        metavar="TRACKS", help="CSV or Parquet, a row per object and time; several are joined."
    ),
    map_path: Path = Argument(metavar="MAP", help="OpenDRIVE file (.xodr)."),
    store: Store,
    hz: float | None = Option(None, help="Frames per second, where time is given in frames."),
    ego: list[str] | None = Option(
        None, metavar="ID|all", help="Objects that become the ego; repeatable. [all]"
    ),
    columns: Path | None = Option(None, help="Names, units and kinds of the columns in TOML."),
    city: str | None = Option(None, help="Name of the map. [name of MAP]"),
    replace: bool = Option(False, help="Replace what other tables of that name became."),
    window_s: Window = None,
    overlap_s: Overlap = None,
    history_s: History = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert tracks of any source: a table with one row per object and time, and its map.

    Columns are known by their usual names. Wrong units, axes and origins are recognised and named;
    the picture beside the report shows tracks and map. Recordings shorter than a window become one
    scenario each, with 2 s of history.
    """
    from shiftsim.data.readers.scenarios import EGO_CATEGORIES
    from shiftsim.data.readers.tracks.reader import TracksReader, convert_tracks
    from shiftsim.data.readers.windows import make_config
    from shiftsim.data.store.tables import picture_file

    flags = cli.given(window_s=window_s, overlap_s=overlap_s, history_s=history_s)
    config = make_config({"ego_categories": EGO_CATEGORIES, **flags})
    overrides = read_toml(columns) if columns else {}
    egos = None if ego is None or "all" in ego else ego
    folder = store_path(store)
    try:
        inspection = TracksReader(
            source, map_path, city=city, overrides=overrides, hz=hz, config=config
        )
    except ConfigError as error:
        raise ConfigError(f"{columns or source[0]}: {error.message}", error.hint) from error
    picture = picture_file(folder, inspection.road.name, inspection.table.name)
    errors = inspection.diagnostics.errors
    try:
        report = convert_tracks(inspection, folder, egos=egos, replace=replace)
    except ConversionError:
        for wrong in errors:
            echo(f" wrong: {source[0]}: {wrong.what}\n   remedy: {wrong.remedy}", err=True)
        _draw_tracks(picture, inspection, None)
        if not errors:
            raise
        echo(f"error: {source[0]}: {plural(len(errors), 'thing')} cannot be right", err=True)
        raise typer.Exit(cli.DATA) from None
    _draw_tracks(picture, inspection, folder)
    read = inspection.table.columns
    names = {role: column.words for role, column in read.found.items()}
    if as_json:
        content = _contents(report) | {"city": report.name, "summary": asdict(report.recordings[0])}
        content["unusual"] = [warning._asdict() for warning in inspection.diagnostics.warnings]
        print_json(content | {"figures": inspection.diagnostics.figures, "columns": names})
    else:
        echo(f"map {report.name}: {report.lanes} lanes and connectors")
        echo(f" columns: {', '.join(f'{ours} = {name}' for ours, name in names.items())}")
        for what, value in ("layout", read.layout), ("point given", read.reference):
            if value:
                echo(f" {what}: {value}")
        if any(read.shift):
            echo(f" shift: ({read.shift[0]:.1f}, {read.shift[1]:.1f}) m")
        echo("\n".join(_report_lines(report)))
        for warning in inspection.diagnostics.warnings:
            echo(f" unusual: {warning.what}\n   remedy: {warning.remedy}")
        echo(f" {plural(report.accepted, 'scenario')} → {folder}")
        echo(f" next: shiftsim check {store}, then shiftsim run --planner idm --store {store}")


def _draw_tracks(path: Path, inspection: "TracksReader", store: Path | None) -> None:
    """The picture of map, tracks and scenarios; without matplotlib a line how to get it."""
    from shiftsim.view.drawing import save_tracks_picture

    try:
        save_tracks_picture(path, inspection, store)
    except MissingExtraError as error:
        echo(f" no picture: {error.message} ({error.hint})", err=True)
    else:
        echo(f" picture: {path}", err=True)


def _add_dataset(kind: str, text: str) -> None:
    """The command that converts one of the data sets of `shiftsim.convert_dataset`."""

    @app.command(kind, help=text)
    @cli.with_settings("workers")
    def convert(
        settings: cli.Settings,
        folder: Source,
        store: Store,
        egos: Egos = "recorded",
        at: At = None,
        quiet: Quiet = False,
        as_json: Json = False,
    ) -> int:
        make = partial(shiftsim.convert_dataset, kind, folder, egos=egos, at=at, **settings)
        return _convert(make, store, "dataset", _scene_lines, quiet=quiet, as_json=as_json)


for _kind, _text in _DATASETS.items():
    _add_dataset(_kind, _text)


def _convert(
    make: "Callable[..., ConversionReport]",
    store: str,
    kind: str,
    lines: "Callable[[ConversionReport, Path], Iterator[str]]",
    *,
    quiet: bool,
    as_json: bool,
) -> int:
    """Convert a source over processes, print the report, and return the code for it."""
    from shiftsim.data.readers.scenarios import why_none

    folder = store_path(store)
    with progress_bar(quiet=quiet or as_json) as advance:
        report = make(store=folder, on_progress=advance)
    following = f" next: shiftsim filter {store}, then shiftsim run --planner idm --store {store}"
    # of a data set, the report says nothing of what was kept
    if is_empty := not report.accepted and (kind == "site" or not report.kept):
        reason, is_short = why_none(report.recordings)
        following = f" no scenario: {reason}"
        if kind == "dataset":
            following += "\n   remedy: --egos vehicles, or other recordings"
        elif is_short:
            following += "\n   remedy: shorter windows, such as --window-s 10 --overlap-s 5"
            following += " --history-s 2; shiftsim convert dsc3d --help shows the shortest"
    printed = [*lines(report, folder), following]
    print_result({kind: report.name, **_contents(report)}, printed, as_json=as_json)
    return cli.UNFINISHED if report.skipped or is_empty else 0


def _options(path: Path | None, flags: dict[str, Any]) -> "ConversionConfig":
    from shiftsim.data.readers.windows import make_config

    try:
        return make_config((read_toml(path) if path else {}) | flags)
    except ConfigError as error:
        raise ConfigError(f"{path or 'convert dsc3d'}: {error.message}", error.hint) from error


def _failures(failed: "Mapping[str, str]") -> "Iterator[str]":
    """What failed and why, and how many more."""
    for name, reason in list(failed.items())[:MAX_NAMED]:
        yield f" failed: {name}: {reason}"
    if len(failed) > MAX_NAMED:
        yield f" failed: {len(failed) - MAX_NAMED} more, which --json lists"


def _scene_lines(report: "ConversionReport", store: Path) -> "Iterator[str]":
    warnings = Counter(report.map_warnings) + report.count("warnings")
    for title, counts in ("not an ego by rule", report.count("rejected")), ("note", warnings):
        for name, number in sorted(counts.items()):
            yield f" {title}: {name} ({number})"
    yield from _failures(report.skipped)
    without = sum(not summary.accepted for summary in report.recordings)
    yield (
        f" {plural(report.converted, 'scene')} converted, {without} of them without a "
        f"scenario, {report.kept} kept from before, {len(report.skipped)} failed"
    )
    yield f" {plural(report.accepted, 'new scenario')} → {store}"


def _site_lines(report: "ConversionReport", store: Path, *, is_short: bool) -> "Iterator[str]":
    yield (
        f"site {report.name}: {report.lanes} lanes and connectors, "
        f"{100.0 * report.details['drivable_share']:.1f} % of moving vehicles on drivable area"
    )
    yield from _report_lines(report)
    for name, reason in report.skipped.items():
        yield f" skipped: {name}: {reason}"
    if report.kept:
        yield f" {plural(report.kept, 'recording')} kept from before"
    if is_short:
        yield " note: scenarios are shorter than the benchmark's; their scores do not compare"
    yield f" {plural(report.accepted, 'scenario')} → {store}"


def _report_lines(report: "ConversionReport") -> "Iterator[str]":
    for name, count in report.map_warnings.items():
        yield f" map: {name} ({count})"
    for summary in report.recordings:
        yield (
            f" {summary.name}: {summary.duration_s:.1f} s, {plural(summary.tracks, 'track')}, "
            f"{plural(summary.windows, 'window')}, {plural(summary.candidates, 'candidate')}, "
            f"{summary.accepted} accepted"
        )
        for rule, count in summary.rejected.items():
            yield f"   not accepted by rule {rule}: {count}"
        for name, count in summary.warnings.items():
            yield f"   repaired: {name} ({count})"
        if summary.name in report.replaced:
            yield f"   replaced: {plural(report.replaced[summary.name], 'scenario')} of before"


def _contents(report: "ConversionReport") -> dict[str, Any]:
    """The report as plain values, for JSON."""
    found = asdict(report)
    return {**found.pop("details"), **{k: v for k, v in found.items() if k != "name"}}
