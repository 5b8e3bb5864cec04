"""Commands that make scenario stores: convert nuplan, dsc3d, tracks, av2, py123d, commonroad."""

from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import Json, Quiet, new_app, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.data.readers.convert import ConversionReport
    from shiftsim.data.readers.reader import Reader
    from shiftsim.data.readers.scenarios import RecordingSummary
    from shiftsim.data.readers.tracks.inspection import Inspection
    from shiftsim.data.readers.windows import ConversionConfig

app = new_app("Make a scenario store from recordings.", no_args_is_help=True)
_DATA, PARTIAL = 2, 3


Store = Annotated[
    str,
    typer.Option("--store", "-s", help="Name or folder of the store."),
]
_Window = Annotated[
    float | None, typer.Option(help="Length of a scenario with its history [s]. [18]")
]
_Overlap = Annotated[float | None, typer.Option(help="Overlap of windows [s]. [6]")]
_History = Annotated[
    float | None, typer.Option(help="Part of a window before iteration 0 [s]. [3]")
]
MAX_NAMED = 20


@app.command()
def nuplan(
    logs: Annotated[Path, typer.Argument(metavar="LOGS", help="Folder of .db logs, or one log.")],
    maps: Annotated[Path, typer.Argument(metavar="MAPS", help="Folder of the maps.")],
    store: Store,
    tokens: Annotated[
        str | None, typer.Option(help="Only these scenarios: a,b,c, or a file with one per line.")
    ] = None,
    types: Annotated[str | None, typer.Option(help="Only these scenario types: a,b,c.")] = None,
    filter_file: Annotated[
        Path | None, typer.Option("--filter", help="nuPlan's scenario filter (.yaml).")
    ] = None,
    mapping: Annotated[
        str | None,
        typer.Option(help="DURATION,OFFSET,RATIO of all, such as 15,0,0.5. [nuPlan's by type]"),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert scenarios of nuPlan logs (.db) and maps (map.gpkg)."""
    from shiftsim.data.nuplan.convert import convert_nuplan
    from shiftsim.data.nuplan.scenarios import parse_mapping
    from shiftsim.files import store_path

    folder = store_path(store)
    with progress_bar(quiet=quiet or as_json) as advance:
        report = convert_nuplan(
            logs,
            maps,
            folder,
            tokens=None if tokens is None else _token_list(tokens),
            types=None if types is None else [word.strip() for word in types.split(",")],
            filter_file=filter_file,
            mapping=None if mapping is None else parse_mapping(mapping),
            progress=advance,
        )
    if as_json:
        say_json(asdict(report))
    else:
        for flaw, count in report.flaws.items():
            say(f" tolerated: {flaw} ({count})")
        for token, reason in list(report.failed.items())[:MAX_NAMED]:
            say(f" failed: {token}: {reason}")
        say(
            f" {plural(len(report.converted), 'scenario')} converted, "
            f"{len(report.unchanged)} unchanged, {len(report.failed)} failed → {folder}"
        )
    if report.failed:
        raise typer.Exit(PARTIAL)


def _token_list(text: str) -> list[str]:
    """Tokens from a file, or from the words themselves."""
    path = Path(text)
    if path.is_file():
        from shiftsim.runs.scenarios import read_split

        return list(read_split(path).tokens)
    return [word.strip() for word in text.split(",")]


@app.command()
@cli.with_settings("workers")
def dsc3d(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="Folder with data_meta.json, annotations, map.")
    ],
    store: Store,
    site: Annotated[str | None, typer.Option(help="Name of the site. [name of SRC]")] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help="OpenDRIVE file, if it is elsewhere.")
    ] = None,
    category: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=KNOWN", help="Read a category as a known one; repeatable."),
    ] = None,
    country: Annotated[
        str | None, typer.Option(help="Whose speed limits hold where the map has none. [DE]")
    ] = None,
    window_s: _Window = None,
    overlap_s: _Overlap = None,
    history_s: _History = None,
    padding_s: Annotated[
        float | None, typer.Option(help="History made up before the first frame [s]. [0]")
    ] = None,
    max_per_window: Annotated[int | None, typer.Option(help="Egos per window. [all]")] = None,
    config: Annotated[
        Path | None, typer.Option(help="All thresholds in TOML; flags win over it.")
    ] = None,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert recordings in the layout of DSC3D.

    A broken recording is skipped and named; the others are converted, and the exit code is 3. A
    conversion that was stopped goes on when it is started again.

    Planners need 2 s of history. A recording too short for that is converted with a made-up one,
    of constant velocity: --window-s 4.9 --overlap-s 0 --history-s 0 --padding-s 2.2
    """
    from shiftsim.data.readers.dsc3d import Dsc3dReader

    flags = {
        "country": country,
        "window_s": window_s,
        "overlap_s": overlap_s,
        "history_s": history_s,
        "padding_s": padding_s,
        "max_per_window": max_per_window,
        "category_map": _category_map(category or []),
    }
    options = _options(config, {name: value for name, value in flags.items() if value is not None})
    reader = Dsc3dReader(source, site=site, map_path=map_path, config=options)
    report, folder = _convert(reader, store, settings, quiet=quiet or as_json)
    if as_json:
        say_json({"site": report.name, **_contents(report)})
    else:
        _show_site(report)
        if options.is_short:
            say(" note: scenarios are shorter than the benchmark's; their scores do not compare")
        say(f" {plural(report.accepted, 'scenario')} → {folder}")
        say(f" next: shiftsim filter {store}, then shiftsim run --planner idm --store {store}")
    if report.skipped:
        raise typer.Exit(PARTIAL)


@app.command()
def tracks(
    source: Annotated[
        Path, typer.Argument(metavar="TRACKS", help="CSV or Parquet, a row per object and time.")
    ],
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="OpenDRIVE file (.xodr).")],
    store: Store,
    hz: Annotated[
        float | None, typer.Option(help="Frames per second, where time is given in frames.")
    ] = None,
    ego: Annotated[
        list[str] | None,
        typer.Option(metavar="ID|all", help="Objects that become the ego; repeatable. [all]"),
    ] = None,
    columns: Annotated[
        Path | None, typer.Option(help="Names, units and kinds of the columns in TOML.")
    ] = None,
    city: Annotated[str | None, typer.Option(help="Name of the map. [name of MAP]")] = None,
    window_s: _Window = None,
    overlap_s: _Overlap = None,
    history_s: _History = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert tracks of any source: a table with one row per object and time, and its map.

    Columns are known by their usual names. Wrong units, axes and origins are recognised and named;
    the picture beside the report shows tracks and map. Recordings shorter than a window become one
    scenario each, with 2 s of history.
    """
    from shiftsim.data.readers.scenarios import EGO_CATEGORIES
    from shiftsim.data.readers.tracks.inspection import convert_tracks, inspect_tracks
    from shiftsim.data.readers.windows import make_config
    from shiftsim.data.store.tables import picture_file
    from shiftsim.errors import ConfigError, ConversionError
    from shiftsim.files import read_toml, store_path

    flags = {"window_s": window_s, "overlap_s": overlap_s, "history_s": history_s}
    given = {name: value for name, value in flags.items() if value is not None}
    config = make_config({"ego_categories": EGO_CATEGORIES, **given})
    overrides = read_toml(columns) if columns else {}
    egos = None if ego is None or "all" in ego else ego
    folder = store_path(store)
    try:
        inspection = inspect_tracks(
            source, map_path, city=city, overrides=overrides, hz=hz, config=config
        )
    except ConfigError as error:
        raise ConfigError(f"{columns or source}: {error.message}", error.hint) from error
    picture = picture_file(folder, inspection.road.name, inspection.table.name)
    errors = inspection.diagnostics.errors
    try:
        report = convert_tracks(inspection, folder, egos=egos)
    except ConversionError:
        for wrong in errors:
            say(f" wrong: {wrong.what}")
            say(f"   remedy: {wrong.remedy}")
        _draw_tracks(picture, inspection, None)
        if not errors:
            raise
        typer.echo(f"error: {source}: {plural(len(errors), 'thing')} cannot be right", err=True)
        raise typer.Exit(_DATA) from None
    names = {role: column.name for role, column in inspection.table.columns.found.items()}
    if as_json:
        content = _contents(report) | {"city": report.name, "summary": asdict(report.recordings[0])}
        say_json(content | {"figures": inspection.diagnostics.figures, "columns": names})
    else:
        say(f"map {report.name}: {report.lanes} lanes and connectors")
        for name, count in report.map_warnings.items():
            say(f" map: {name} ({count})")
        say(f" columns: {', '.join(f'{ours} = {name}' for ours, name in names.items())}")
        _show_recording(report.recordings[0])
        for warning in inspection.diagnostics.warnings:
            say(f" unusual: {warning.what}")
            say(f"   remedy: {warning.remedy}")
    _draw_tracks(picture, inspection, folder)
    if not as_json:
        say(f" {plural(report.accepted, 'scenario')} → {folder}")
        say(f" next: shiftsim check {store}, then shiftsim run --planner idm --store {store}")


def _draw_tracks(path: Path, inspection: "Inspection", store: Path | None) -> None:
    """The picture of map, tracks and scenarios; without matplotlib a line how to get it."""
    from shiftsim.errors import MissingExtraError
    from shiftsim.view.tracks import save_tracks_picture

    try:
        save_tracks_picture(path, inspection, store)
    except MissingExtraError as error:
        typer.echo(f" no picture: {error.message} ({error.hint})", err=True)
    else:
        typer.echo(f" picture: {path}", err=True)


_Source = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the data set.")]
_Egos = Annotated[
    str, typer.Option(help="recorded: the recording car; vehicles: each vehicle that drives.")
]


@app.command()
@cli.with_settings("workers")
def av2(
    folder: _Source,
    store: Store,
    egos: _Egos = "recorded",
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert scenes of Argoverse 2 motion forecasting, train or val.

    A broken scene is skipped and named, and the exit code is 3. A conversion that was stopped goes
    on when it is started again. That holds for py123d and commonroad as well.
    """
    from shiftsim.data.readers.av2 import Av2Reader

    reader = Av2Reader(folder, vehicles=_are_vehicles(egos))
    _convert_scenes(reader, store, settings, quiet=quiet, as_json=as_json)


@app.command()
@cli.with_settings("workers")
def py123d(
    folder: _Source,
    store: Store,
    egos: _Egos = "recorded",
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert logs that py123d wrote: Waymo, nuScenes, Argoverse 2 Sensor, nuPlan.

    FOLDER holds logs/ and, for data sets with one map per city, maps/.
    """
    from shiftsim.data.readers.py123d import Py123dReader

    reader = Py123dReader(folder, vehicles=_are_vehicles(egos))
    _convert_scenes(reader, store, settings, quiet=quiet, as_json=as_json)


@app.command()
@cli.with_settings("workers")
def commonroad(
    folder: _Source,
    store: Store,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Convert CommonRoad scenarios in XML: NGSIM, INTERACTION, inD, highD and others.

    The files have no recording car: each vehicle that drives is an ego.
    """
    from shiftsim.data.readers.commonroad import CommonRoadReader

    _convert_scenes(CommonRoadReader(folder), store, settings, quiet=quiet, as_json=as_json)


def _are_vehicles(egos: str) -> bool:
    from shiftsim.errors import one_of

    return one_of("egos", egos, ("recorded", "vehicles")) == "vehicles"


def _convert_scenes(
    reader: "Reader", store: str, settings: cli.Settings, *, quiet: bool, as_json: bool
) -> None:
    report, folder = _convert(reader, store, settings, quiet=quiet or as_json)
    if as_json:
        say_json({"dataset": report.name, **_contents(report)})
    else:
        warnings = Counter(report.map_warnings) + report.count("warnings")
        for title, counts in ("not an ego by rule", report.count("rejected")), ("note", warnings):
            for name, number in sorted(counts.items()):
                say(f" {title}: {name} ({number})")
        for name, reason in list(report.skipped.items())[:MAX_NAMED]:
            say(f" failed: {name}: {reason}")
        without = sum(not summary.accepted for summary in report.recordings)
        say(
            f" {plural(report.converted, 'scene')} converted, {without} of them without a "
            f"scenario, {report.kept} kept from before, {len(report.skipped)} failed"
        )
        say(f" {plural(report.accepted, 'new scenario')} → {folder}")
        say(f" next: shiftsim filter {store}, then shiftsim run --planner idm --store {store}")
    if report.skipped:
        raise typer.Exit(PARTIAL)


def _convert(
    reader: "Reader", store: str, settings: cli.Settings, *, quiet: bool
) -> tuple["ConversionReport", Path]:
    """Convert a source over processes, with a progress bar; the report, and the store's folder."""
    from functools import partial

    from shiftsim.data.readers.convert import convert
    from shiftsim.files import store_path
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.workers import map_unordered

    folder = store_path(store)
    executor = partial(map_unordered, workers=settings.get("workers") or default_workers())
    with progress_bar(quiet=quiet) as advance:
        return convert(reader, folder, progress=advance, executor=executor), folder


def _contents(report: "ConversionReport") -> dict[str, Any]:
    """The report as plain values, for JSON."""
    found = asdict(report)
    return {**found.pop("details"), **{k: v for k, v in found.items() if k != "name"}}


def _category_map(words: list[str]) -> dict[str, str] | None:
    from shiftsim.errors import ConfigError

    for word in words:
        name, equals, known = word.partition("=")
        if not (name and equals and known):
            raise ConfigError(f"category {word!r} is not NAME=KNOWN", "--category lorry=truck")
    return dict(word.split("=", 1) for word in words) or None


def _options(path: Path | None, flags: dict[str, Any]) -> "ConversionConfig":
    from shiftsim.data.readers.windows import make_config
    from shiftsim.errors import ConfigError
    from shiftsim.files import read_toml

    values = read_toml(path) if path else {}
    try:
        return make_config(values | flags)
    except ConfigError as error:
        raise ConfigError(f"{path or 'convert dsc3d'}: {error.message}", error.hint) from error


def _show_site(report: "ConversionReport") -> None:
    say(
        f"site {report.name}: {report.lanes} lanes and connectors, "
        f"{100.0 * report.details['drivable_share']:.1f} % of moving vehicles on drivable area"
    )
    for name, count in report.map_warnings.items():
        say(f" map: {name} ({count})")
    for summary in report.recordings:
        _show_recording(summary)
    for name, reason in report.skipped.items():
        say(f" skipped: {name}: {reason}")
    if report.kept:
        say(f" {plural(report.kept, 'recording')} kept from before")


def _show_recording(summary: "RecordingSummary") -> None:
    say(
        f" {summary.name}: {summary.duration_s:.1f} s, {plural(summary.tracks, 'track')}, "
        f"{plural(summary.windows, 'window')}, {plural(summary.candidates, 'candidate')}, "
        f"{summary.accepted} accepted"
    )
    for rule, count in summary.rejected.items():
        say(f"   not accepted by rule {rule}: {count}")
    for name, count in summary.warnings.items():
        say(f"   repaired: {name} ({count})")
