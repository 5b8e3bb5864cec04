"""Commands that make scenario stores of open data sets: convert av2, py123d, commonroad."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from shiftsim import cli
from shiftsim.cli import Debug, Json, Quiet, plural, say, say_json
from shiftsim.cli.convert import MAX_NAMED, PARTIAL, Store, app, in_parts

if TYPE_CHECKING:
    from shiftsim.data.readers.open_data.scenes import Reader

__all__ = ["app"]  # the commands of `convert`, these among them
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
    from shiftsim.data.readers.open_data.av2 import Av2Reader

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
    from shiftsim.data.readers.open_data.py123d import Py123dReader

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
    from shiftsim.data.readers.open_data.commonroad import CommonRoadReader

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
    from shiftsim.data.readers.open_data.scenes import convert_scenes
    from shiftsim.errors import one_of
    from shiftsim.files import store_path

    vehicles = one_of("egos", egos, ("recorded", "vehicles")) == "vehicles"
    folder = store_path(store)
    with in_parts(settings, quiet=quiet or as_json) as (advance, spread):
        report = convert_scenes(
            reader, source, folder, vehicles=vehicles, progress=advance, spread=spread
        )
    if as_json:
        from dataclasses import asdict

        say_json(asdict(report))
    else:
        for title, counts in (("not an ego by rule", report.rejected), ("note", report.warnings)):
            for name, number in sorted(counts.items()):
                say(f" {title}: {name} ({number})")
        for name, reason in list(report.failed.items())[:MAX_NAMED]:
            say(f" failed: {name}: {reason}")
        say(
            f" {plural(report.scenes, 'scene')} converted, {report.without} of them without a "
            f"scenario, {report.kept} kept from before, {len(report.failed)} failed"
        )
        say(f" {plural(report.scenarios, 'new scenario')} → {folder}")
        say(f" next: shiftsim filter {store}, then shiftsim run --planner idm --store {store}")
    if report.failed:
        raise typer.Exit(PARTIAL)
