"""Commands that make scenario stores: convert nuplan, dsc3d, av2, py123d, commonroad."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim import cli
from shiftsim.cli import Debug, Json, Quiet, new_app, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.data.deepplan.convert import ConversionReport
    from shiftsim.data.deepplan.windows import ConversionConfig
    from shiftsim.data.tracks.scenes import Reader

app = new_app("Make a scenario store from recordings.", no_args_is_help=True)
_PARTIAL, _INTERRUPTED = 3, 130


Store = Annotated[str, typer.Option("--store", "-s", help="Name or folder of the store.")]
_MAX_NAMED = 20


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
    debug: Debug = False,
) -> None:
    """Convert scenarios of nuPlan logs (.db) and maps (map.gpkg)."""
    from shiftsim.data.nuplan.convert import convert_nuplan
    from shiftsim.data.nuplan.mapping import parse_mapping
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
        from dataclasses import asdict

        say_json(asdict(report))
    else:
        for flaw, count in report.flaws.items():
            say(f" tolerated: {flaw} ({count})")
        for token, reason in list(report.failed.items())[:_MAX_NAMED]:
            say(f" failed: {token}: {reason}")
        say(
            f" {plural(len(report.converted), 'scenario')} converted, "
            f"{len(report.unchanged)} unchanged, {len(report.failed)} failed → {folder}"
        )
    if report.failed:
        raise typer.Exit(_PARTIAL)


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
    window_s: Annotated[
        float | None, typer.Option(help="Length of a scenario with its history [s]. [18]")
    ] = None,
    overlap_s: Annotated[float | None, typer.Option(help="Overlap of windows [s]. [6]")] = None,
    history_s: Annotated[
        float | None, typer.Option(help="Part of a window before iteration 0 [s]. [3]")
    ] = None,
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
    debug: Debug = False,
) -> None:
    """Convert recordings in the layout of DSC3D.

    A broken recording is skipped and named; the others are converted, and the exit code is 3. A
    conversion that was stopped goes on when it is started again.

    Planners need 2 s of history. A recording too short for that is converted with a made-up one,
    of constant velocity: --window-s 4.9 --overlap-s 0 --history-s 0 --padding-s 2.2
    """
    from functools import partial

    from shiftsim.data.deepplan.convert import convert_dsc3d
    from shiftsim.files import store_path
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.workers import map_unordered

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
    folder = store_path(store)
    count = settings.get("workers") or default_workers()
    with progress_bar(quiet=quiet or as_json) as advance:
        try:
            report = convert_dsc3d(
                source,
                folder,
                site=site,
                map_path=map_path,
                options=options,
                progress=advance,
                spread=partial(map_unordered, workers=count),
            )
        except KeyboardInterrupt:
            raise _interrupted() from None
    if as_json:
        from dataclasses import asdict

        say_json(asdict(report))
    else:
        _show_dsc3d(report)
        if options.is_short:
            say(" note: scenarios are shorter than the benchmark's; their scores do not compare")
        say(f" {plural(report.accepted, 'scenario')} → {folder}")
        say(f" next: shiftsim filter {store}, then shiftsim run --planner idm --store {store}")
    if report.skipped:
        raise typer.Exit(_PARTIAL)


def _interrupted() -> typer.Exit:
    again = shlex.join(["shiftsim", *sys.argv[1:]])
    typer.echo("error: interrupted", err=True)
    typer.echo(f"hint: what is converted is kept; start again with: {again}", err=True)
    return typer.Exit(_INTERRUPTED)


def _category_map(words: list[str]) -> dict[str, str] | None:
    from shiftsim.errors import ConfigError

    for word in words:
        name, equals, known = word.partition("=")
        if not (name and equals and known):
            raise ConfigError(f"category {word!r} is not NAME=KNOWN", "--category lorry=truck")
    return dict(word.split("=", 1) for word in words) or None


def _options(path: Path | None, flags: dict[str, Any]) -> "ConversionConfig":
    from shiftsim.data.deepplan.windows import make_config
    from shiftsim.errors import ConfigError
    from shiftsim.files import read_toml

    values = read_toml(path) if path else {}
    try:
        return make_config(values | flags)
    except ConfigError as error:
        raise ConfigError(f"{path or 'convert dsc3d'}: {error}", error.hint) from error


def _show_dsc3d(report: "ConversionReport") -> None:
    say(
        f"site {report.site}: {report.lanes} lanes and connectors, "
        f"{100.0 * report.drivable_share:.1f} % of moving vehicles on drivable area"
    )
    for name, count in report.map_warnings.items():
        say(f" map: {name} ({count})")
    for summary in report.recordings:
        say(
            f" {summary.name}: {summary.duration_s:.1f} s, {plural(summary.tracks, 'track')}, "
            f"{plural(summary.windows, 'window')}, {plural(summary.candidates, 'candidate')}, "
            f"{summary.accepted} accepted"
        )
        for rule, count in summary.rejected.items():
            say(f"   not accepted by rule {rule}: {count}")
        for name, count in summary.warnings.items():
            say(f"   repaired: {name} ({count})")
    for name, reason in report.skipped.items():
        say(f" skipped: {name}: {reason}")
    if report.kept:
        say(f" {plural(report.kept, 'recording')} kept from before")


Source = Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the data set.")]
Egos = Annotated[
    str, typer.Option(help="recorded: the recording car; vehicles: each vehicle that drives.")
]


@app.command()
@cli.with_settings("workers")
def av2(
    folder: Source,
    store: Store,
    egos: Egos = "recorded",
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Convert scenes of Argoverse 2 motion forecasting, train or val.

    A broken scene is skipped and named, and the exit code is 3. A conversion that was stopped goes
    on when it is started again. That holds for py123d and commonroad as well.
    """
    from shiftsim.data.tracks.av2 import Av2Reader

    _convert_scenes(Av2Reader(), folder, store, egos, settings, quiet=quiet, as_json=as_json)


@app.command()
@cli.with_settings("workers")
def py123d(
    folder: Source,
    store: Store,
    egos: Egos = "recorded",
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Convert logs that py123d wrote: Waymo, nuScenes, Argoverse 2 Sensor, nuPlan.

    FOLDER holds logs/ and, for data sets with one map per city, maps/.
    """
    from shiftsim.data.tracks.py123d import Py123dReader

    _convert_scenes(Py123dReader(), folder, store, egos, settings, quiet=quiet, as_json=as_json)


@app.command()
@cli.with_settings("workers")
def commonroad(
    folder: Source,
    store: Store,
    *,
    settings: cli.Settings,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Convert CommonRoad scenarios in XML: NGSIM, INTERACTION, inD, highD and others.

    The files have no recording car: each vehicle that drives is an ego.
    """
    from shiftsim.data.tracks.commonroad import CommonRoadReader

    reader = CommonRoadReader()
    _convert_scenes(reader, folder, store, "vehicles", settings, quiet=quiet, as_json=as_json)


def _convert_scenes(
    reader: "Reader",
    source: Path,
    store: str,
    egos: str,
    settings: cli.Settings,
    *,
    quiet: bool,
    as_json: bool,
) -> None:
    from functools import partial

    from shiftsim.data.tracks.scenes import convert_scenes
    from shiftsim.errors import one_of
    from shiftsim.files import store_path
    from shiftsim.runs.config import default_workers
    from shiftsim.runs.workers import map_unordered

    vehicles = one_of("egos", egos, ("recorded", "vehicles")) == "vehicles"
    folder = store_path(store)
    count = settings.get("workers") or default_workers()
    with progress_bar(quiet=quiet or as_json) as advance:
        try:
            report = convert_scenes(
                reader,
                source,
                folder,
                vehicles=vehicles,
                progress=advance,
                spread=partial(map_unordered, workers=count),
            )
        except KeyboardInterrupt:
            raise _interrupted() from None
    if as_json:
        from dataclasses import asdict

        say_json(asdict(report))
    else:
        for title, counts in (("not an ego by rule", report.rejected), ("note", report.warnings)):
            for name, number in sorted(counts.items()):
                say(f" {title}: {name} ({number})")
        for name, reason in list(report.failed.items())[:_MAX_NAMED]:
            say(f" failed: {name}: {reason}")
        say(
            f" {plural(report.scenes, 'scene')} converted, {report.without} of them without a "
            f"scenario, {report.kept} kept from before, {len(report.failed)} failed"
        )
        say(f" {plural(report.scenarios, 'new scenario')} → {folder}")
        say(f" next: shiftsim filter {store}, then shiftsim run --planner idm --store {store}")
    if report.failed:
        raise typer.Exit(_PARTIAL)
