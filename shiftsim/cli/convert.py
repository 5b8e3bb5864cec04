"""Commands that make scenario stores: convert nuplan, convert dsc3d."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from shiftsim.cli.common import Debug, Json, Quiet, plural, progress_bar, say, say_json

if TYPE_CHECKING:
    from shiftsim.data.deepplan import ConversionReport

_CONVERT = typer.Typer(help="Make a scenario store from recordings.")
_PARTIAL = 3


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    _CONVERT.command("nuplan")(nuplan)
    _CONVERT.command("dsc3d")(dsc3d)
    app.add_typer(_CONVERT, name="convert", no_args_is_help=True)


Store = Annotated[str, typer.Option("--store", "-s", help="Name or folder of the store.")]
_MAX_NAMED = 20


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
    from shiftsim.config import store_path
    from shiftsim.data.nuplan_convert import convert_nuplan
    from shiftsim.data.nuplan_mapping import parse_mapping

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
        from shiftsim.splits import read_split

        return list(read_split(path).tokens)
    return [word.strip() for word in text.split(",")]


def dsc3d(
    source: Annotated[
        Path, typer.Argument(metavar="SRC", help="Folder with data_meta.json, annotations, map.")
    ],
    store: Store,
    site: Annotated[str | None, typer.Option(help="Name of the site. [name of SRC]")] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help="OpenDRIVE file, if it is elsewhere.")
    ] = None,
    window: Annotated[float | None, typer.Option(help="Length of a scenario [s].")] = None,
    overlap: Annotated[float | None, typer.Option(help="Overlap of windows [s].")] = None,
    history: Annotated[float | None, typer.Option(help="Part before iteration 0 [s].")] = None,
    padding: Annotated[
        float | None, typer.Option(help="History made up before the first frame [s].")
    ] = None,
    max_per_window: Annotated[int | None, typer.Option(help="Egos per window.")] = None,
    config: Annotated[
        Path | None, typer.Option(help="All thresholds in TOML; flags win over it.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Convert recordings in the layout of DSC3D."""
    from shiftsim.config import read_toml, store_path
    from shiftsim.data.deepplan import convert_dsc3d

    flags = {
        "window_s": window,
        "overlap_s": overlap,
        "history_s": history,
        "padding_s": padding,
        "max_per_window": max_per_window,
    }
    values = read_toml(config) if config else {}
    values |= {name: value for name, value in flags.items() if value is not None}
    options = _options(values, str(config) if config else "convert dsc3d")
    folder = store_path(store)
    with progress_bar(quiet=quiet or as_json) as advance:
        report = convert_dsc3d(
            source, folder, site=site, map_path=map_path, options=options, progress=advance
        )
    if as_json:
        from dataclasses import asdict

        say_json(asdict(report))
        return
    _show_dsc3d(report)
    if options.is_short:
        say(" note: scenarios are shorter than the benchmark's; their scores do not compare")
    say(f" {plural(report.accepted, 'scenario')} → {folder}")
    say(f" next: shiftsim run --planner idm --store {store}")


def _options(values: dict[str, Any], where: str) -> Any:
    from dataclasses import fields

    from shiftsim.config import one_of
    from shiftsim.data.deepplan_windows import ConversionConfig
    from shiftsim.errors import ConfigError

    known = [field.name for field in fields(ConversionConfig)]
    for name in values:
        one_of(f"{where}: setting", name, known)
    if isinstance(values.get("ego_categories"), list):
        values["ego_categories"] = tuple(values["ego_categories"])
    try:
        return ConversionConfig(**values)
    except TypeError as error:
        raise ConfigError(f"{where}: a value has the wrong type ({error})") from error


def _show_dsc3d(report: "ConversionReport") -> None:
    say(
        f"site {report.site}: {report.lanes} lanes and connectors, ",
    )
    say(f" {100.0 * report.drivable_share:.1f} % of moving vehicles on drivable area")
    for name, count in report.map_warnings.items():
        say(f" map: {name} ({count})")
    for summary in report.recordings:
        say(
            f" {summary.name}: {summary.duration_s:.1f} s, {plural(summary.tracks, 'track')}, "
            f"{plural(summary.windows, 'window')}, {summary.candidates} candidates, "
            f"{summary.accepted} accepted"
        )
        for rule, count in summary.rejected.items():
            say(f"   not accepted by rule {rule}: {count}")
        for name, count in summary.warnings.items():
            say(f"   mended: {name} ({count})")
