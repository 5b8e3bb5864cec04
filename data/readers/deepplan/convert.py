"""A DSC3D download and its OpenDRIVE map to scenarios of a store.

Every recording is read twice: for the place of the map, which the whole site decides, and to be
converted. Each is converted by itself into a folder below `.partial` that appears in one step and
moves into the store at the end. So recordings may be spread over processes, a conversion that was
killed goes on with those that are missing, and the bytes are the same each time.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyproj

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.readers.deepplan.parts import (
    MAP_FILE,
    ConversionFailure,
    Converter,
    Job,
    LastRecording,
    alone_in,
    try_read,
)
from shiftsim.data.readers.deepplan.recording import RecordingSummary
from shiftsim.data.readers.deepplan.route import place_on_map
from shiftsim.data.readers.deepplan.windows import ConversionConfig
from shiftsim.data.readers.dsc3d.recording import Site, find_map, open_site
from shiftsim.data.store.map import write_map
from shiftsim.data.store.reading import read_report
from shiftsim.data.store.tables import PARTIAL, digest, file_name
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConversionError
from shiftsim.files import safe_join
from shiftsim.kernels import FloatArray
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind

_MAX_FRAME_SHIFT = 0.5  # m between the map's own georeference and that of the annotations
_MOVING = 1.0  # m/s
_MAX_POINTS = 20_000  # of a recording that tell where the map lies

Progress = Callable[[int, int, str], None]


# What a process runs for each recording; made once per process.
Make = Callable[[], Callable[[str], Any]]
# Applies that to names in any order, as `shiftsim.runs.workers.map_unordered` does, and gives the
# `task`, the `result`, and the `death` of the process (empty where it lived) of each.
Spread = Callable[[Make, Sequence[str]], Iterable[Any]]


class _Done(NamedTuple):
    task: str
    result: Any
    death: str = ""


def one_by_one(make: Make, tasks: Sequence[str]) -> Iterator[_Done]:
    """What `Spread` means, in this process."""
    function = make()
    yield from (_Done(task, function(task)) for task in tasks)


@dataclass(frozen=True)
class ConversionReport:
    """What became of one site."""

    site: str  # name of the site, which is the name of its map
    lanes: int  # lanes and lane connectors of the map
    drivable_share: float  # share of moving vehicles on drivable area
    recordings: tuple[RecordingSummary, ...]  # summary of every recording that was converted
    # why, by name of a recording that cannot be converted
    skipped: dict[str, str] = field(default_factory=dict)
    kept: int = 0  # how many recordings were converted before, by an interrupted or an earlier call
    # count by kind of what was repaired in the map
    map_warnings: dict[str, int] = field(default_factory=dict)

    @property
    def accepted(self) -> int:
        """Number of scenarios."""
        return sum(summary.accepted for summary in self.recordings)


def convert_dsc3d(
    src: Path,
    store: Path,
    *,
    site: str | None = None,
    map_path: Path | None = None,
    options: ConversionConfig | None = None,
    progress: Progress | None = None,
    spread: Spread = one_by_one,
) -> ConversionReport:
    """Convert a DSC3D download to scenarios in a store.

    A recording that is broken is skipped and named; what was converted before from the same files
    with the same options is kept.

    Args:
        src: Folder with `data_meta.json`, `annotations/` and `map/`.
        store: The store, made or extended.
        site: Name of the site in the store; the name of the folder by default.
        map_path: OpenDRIVE file, where it is not in the download.
        options: Thresholds.
        progress: Called with recordings done, recordings in all and the name of the last one.
        spread: How recordings are spread over processes; one by one in this process by default.

    Raises:
        ConversionError: Nothing of the download can be converted.
    """
    config = options or ConversionConfig()
    source = open_site(src)
    road, warnings = _build_map(source, site or src.resolve().name, map_path, config)
    names = source.recordings
    show = progress or (lambda done, total, name: None)
    show(0, len(names), "")
    last = LastRecording()
    look = partial(partial, _moving_vehicles, source, config, last)
    read = _collect(spread, look, names, lambda name: None)
    skipped = {
        name: str(found) for name, found in read.items() if isinstance(found, ConversionFailure)
    }
    if len(skipped) == len(names):
        _refuse_all(source, read)
    share = _check_placement(road, source, [read[n] for n in names if n not in skipped], config)
    with alone_in(store):
        writer = StoreWriter(store)
        work = safe_join(store, f"{PARTIAL}/{file_name(road.name)}")
        work.mkdir(parents=True, exist_ok=True)
        write_map(work / MAP_FILE, road)
        job = Job(source, work, config, digest(work / MAP_FILE), last)
        good = [name for name in names if name not in skipped]
        kept = job.kept(read_report(store, road.name), good)
        staged = [name for name in good if job.is_staged(name) and name not in kept]
        done = len(skipped) + len(kept) + len(staged)
        show(done, len(names), "")
        counted = iter(range(done + 1, len(names) + 1))
        made = _collect(
            spread,
            partial(Converter, job),
            [name for name in good if name not in kept and name not in staged],
            lambda name: show(next(counted), len(names), name),
        )
        skipped |= {name: str(end) for name, end in made.items() if end is not None}
        writer.add_map(road)
        for name in good:
            if name not in kept and name not in skipped:
                kept[name] = job.merge(name, writer)
        report = {
            "city": road.name,
            "config": asdict(config),
            "lanes": len(road.edges),
            "drivable_share": share,
            "map_warnings": warnings,
            "recordings": {name: kept[name] for name in names if name in kept},
            "skipped": skipped,
        }
        writer.add_report(road.name, report)
        writer.close()
        shutil.rmtree(work, ignore_errors=True)
        with suppress(OSError):  # another site was interrupted
            work.parent.rmdir()
    return ConversionReport(
        road.name,
        len(road.edges),
        share,
        tuple(RecordingSummary(**kept[name]["summary"]) for name in names if name in kept),
        skipped,
        len(good) - len(made),
        warnings,
    )


def _build_map(
    source: Site, city: str, map_path: Path | None, config: ConversionConfig
) -> tuple[VectorMap, dict[str, int]]:
    drive = read_opendrive(find_map(source, map_path))
    _check_georeference(drive, source)
    x, y, *_ = drive.offset or (0.0, 0.0)
    offset = float(source.offset[0]) - x, float(source.offset[1]) - y  # the header's is applied
    road, report = build_road_map(
        drive, name=city, offset=offset, epsg=source.epsg, country=config.country
    )
    if road.num_lanes == 0:
        raise ConversionError(f"{drive.source} has no drivable lane", "give a map with roads")
    return road, dict(report.warnings)


def _collect(
    spread: Spread, make: Make, names: Sequence[str], seen: Callable[[str], None]
) -> dict[str, Any]:
    """Result by name, in the order of the names, `ConversionFailure` where the process died."""
    found = {}
    for outcome in spread(make, names):
        found[outcome.task] = ConversionFailure(outcome.death) if outcome.death else outcome.result
        seen(outcome.task)
    return {name: found[name] for name in names}


def _refuse_all(source: Site, read: dict[str, ConversionFailure]) -> None:
    name, first = next(iter(read.items()))
    if len(read) == 1:
        raise ConversionError(first.reason, first.hint)
    raise ConversionError(
        f"{source.folder}: none of the {len(read)} recordings can be converted; the first is"
        f" {name}: {first.reason}",
        first.hint,
    )


def _moving_vehicles(
    source: Site, config: ConversionConfig, last: LastRecording, name: str
) -> FloatArray | ConversionFailure:
    """(n, 2) local places of moving vehicles, enough of them to tell where the map lies [m]."""
    last.found = None  # before the next one is read: two would not fit
    recording = try_read(source, name, config)
    if isinstance(recording, ConversionFailure):
        return recording
    last.found = name, recording
    is_vehicle = (recording.kinds == AgentKind.VEHICLE)[recording.track]
    moves = np.hypot(recording.velocities[:, 0], recording.velocities[:, 1]) > _MOVING
    points = recording.centers[is_vehicle & moves, :2]
    return points[:: max(1, len(points) // _MAX_POINTS)]


def _check_placement(
    road: VectorMap, site: Site, places: list[FloatArray], config: ConversionConfig
) -> float:
    """Share of moving vehicles on drivable area; an error where map and tracks do not fit."""
    points = np.concatenate(places) + site.offset[:2]
    found = place_on_map(road, points, config.min_drivable_share)
    if found.share < config.min_drivable_share:
        x, y = found.shift
        raise ConversionError(
            f"{site.folder}: only {found.share:.0%} of the moving vehicles are on drivable area of"
            f" the map, need {config.min_drivable_share:.0%}",
            f"the annotations fit best ({found.best_share:.0%}) when shifted by"
            f" ({x:+.1f}, {y:+.1f}) m: check that map and reference_utm.offset belong together",
        )
    return found.share


def _check_georeference(drive: OpenDrive, site: Site) -> None:
    """Refuse a map whose own georeference contradicts that of the annotations."""
    offset = drive.offset or (0.0, 0.0, 0.0, 0.0)
    if drive.geo_reference is None:
        own = offset[:2]
        if own == (0.0, 0.0):
            return
    else:
        try:
            crs = pyproj.CRS.from_user_input(drive.geo_reference)
            to_utm = pyproj.Transformer.from_crs(crs, site.epsg, always_xy=True)
            own = to_utm.transform(offset[0], offset[1])
        except pyproj.exceptions.ProjError:
            return  # not a projection: the map counts as local
    if not np.hypot(own[0] - site.offset[0], own[1] - site.offset[1]) <= _MAX_FRAME_SHIFT:
        raise ConversionError(
            f"{drive.source} places its origin at UTM ({own[0]:.2f}, {own[1]:.2f}),"
            f" reference_utm.offset at ({site.offset[0]:.2f}, {site.offset[1]:.2f})",
            "correct the one that is wrong; they must agree to 0.5 m",
        )
