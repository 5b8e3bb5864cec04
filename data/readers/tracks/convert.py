"""A file of tracks and an OpenDRIVE map to scenarios of a store.

First everything is looked at (`look_at`), so that even what is wrong can be drawn; then the
scenarios are made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.readers.deepplan.parts import alone_in
from shiftsim.data.readers.deepplan.recording import Converted, RecordingSummary
from shiftsim.data.readers.deepplan.windows import (
    CATEGORY,
    GAP,
    LANE,
    OVERLAP,
    PRESENCE,
    ROUTE,
    SPEED,
    ConversionConfig,
)
from shiftsim.data.readers.tracks.build import make_samples
from shiftsim.data.readers.tracks.columns import KINDS
from shiftsim.data.readers.tracks.doubts import find_doubts
from shiftsim.data.readers.tracks.evidence import Diagnostics
from shiftsim.data.readers.tracks.reading import TrackTable, read_tracks
from shiftsim.data.readers.tracks.scenarios import EGO_CATEGORIES, make_scenarios, write_converted
from shiftsim.data.store.map import read_map_file
from shiftsim.data.store.reading import read_report
from shiftsim.data.store.tables import MANIFEST, map_file
from shiftsim.data.store.writing import StoreWriter
from shiftsim.errors import ConversionError
from shiftsim.world.map import VectorMap

# what helps against a rule that leaves no ego
_REMEDIES = {
    CATEGORY: "only cars, vans, pickups and vehicles become egos by themselves: name another with"
    " --ego ID",
    PRESENCE: "no vehicle is seen throughout a window: try shorter ones, --window-s 10"
    " --overlap-s 5 --history-s 2, or name an ego whose own time is taken, --ego ID",
    SPEED: "all vehicles stand",
    OVERLAP: "boxes lie on one another: check sizes and headings, and whether an object is in the"
    " file twice",
    LANE: "egos start beside the lanes or against them: look at the picture",
    ROUTE: "egos touch no road of the map: look at the picture",
    GAP: "egos change between roads that the map does not link: add the links to the map",
}


@dataclass(frozen=True)
class Inspection:
    """Tracks and map, and what cannot be right about them."""

    path: Path  # the file of tracks
    table: TrackTable
    road: VectorMap
    map_warnings: dict[str, int]  # count by kind of what was repaired in the map
    doubts: Diagnostics


@dataclass(frozen=True)
class TracksReport:
    """What became of one recording."""

    city: str  # name of the map
    lanes: int  # lanes and lane connectors of the map
    summary: RecordingSummary
    figures: dict[str, float]  # what was measured to tell whether units and axes are right
    columns: dict[str, str]  # column of the file by our name
    map_warnings: dict[str, int]  # count by kind of what was repaired in the map


def look_at(
    tracks: Path,
    map_path: Path,
    *,
    city: str | None = None,
    said: Mapping[str, Any] | None = None,
    hz: float | None = None,
    config: ConversionConfig | None = None,
) -> Inspection:
    """Read a file of tracks and its map, and ask whether they can be right.

    Args:
        tracks: CSV or Parquet file, one row per object and time.
        map_path: OpenDRIVE file.
        city: Name of the map in the store; that of the file by default.
        said: Names, units and kinds (`columns.recognise`).
        hz: Frames per second, for time given in frames.
        config: Thresholds.

    Raises:
        ConversionError: A file cannot be read.
        ConfigError: What was said does not fit the file.
    """
    config = config or tracks_config()
    table = read_tracks(tracks, said=said, hz=hz)
    pa.default_memory_pool().release_unused()
    drive = read_opendrive(map_path)
    road, report = build_road_map(drive, name=city or map_path.stem, country=config.country)
    if road.num_lanes == 0:
        raise ConversionError(f"{map_path} has no drivable lane", "give a map with roads")
    doubts = find_doubts(table, road, config.min_drivable_share)
    return Inspection(tracks, table, road, dict(report.warnings), doubts)


def convert_tracks(
    looked: Inspection,
    store: Path,
    *,
    egos: Sequence[str] | None = None,
    config: ConversionConfig | None = None,
) -> tuple[TracksReport, Converted]:
    """Add what was looked at to a store, made if needed; what it held of the recording is replaced.

    Args:
        looked: Tracks and map.
        store: Folder of the store.
        egos: Ids of the egos; every vehicle that can be one by default.
        config: Thresholds.

    Raises:
        ConversionError: Something cannot be right, or no scenario is left.
        DataError: The store has another map of that name.
    """
    table, road, doubts = looked.table, looked.road, looked.doubts
    if doubts.found:
        raise ConversionError(
            "; ".join(doubt.what for doubt in doubts.found),
            "; ".join(doubt.remedy for doubt in doubts.found),
        )
    _require_same_map(store, road)
    samples = make_samples(
        table.name,
        time_us=table.time_us,
        ids=pa.DictionaryArray.from_arrays(table.track, pa.array(table.track_ids)),
        category=table.category,
        categories=table.categories,
        xy=table.xy,
        headings=table.headings,
        velocities=table.velocities,
        sizes=table.sizes,
        derived=doubts.derived,
        kind_of=KINDS,
    )
    doubts.derived = None  # large, and not needed any more
    made = make_scenarios(samples, road, egos=egos, config=config or tracks_config())
    if not made.windows:
        raise ConversionError(*_why_none(looked.path, made.summary))
    found = {role: column.name for role, column in table.columns.found.items()}
    report = TracksReport(
        road.name, len(road.edges), made.summary, doubts.figures, found, looked.map_warnings
    )
    with alone_in(store), StoreWriter(store) as writer:
        writer.add_map(road)
        write_converted(writer, made)
        before = read_report(store, road.name).get("recordings", {})
        one = asdict(report)
        content = {name: one.pop(name) for name in ("city", "lanes", "map_warnings")}
        writer.add_report(road.name, content | {"recordings": before | {table.name: one}})
    return report, made


def tracks_config(**values: Any) -> ConversionConfig:
    """Thresholds of DeepPlan's conversion; egos may also be plain vehicles."""
    return ConversionConfig(**{"ego_categories": EGO_CATEGORIES, **values})


def _why_none(path: Path, summary: RecordingSummary) -> tuple[str, str]:
    if not summary.seen:
        return (
            f"{path}: the recording is {summary.duration_s:.1f} s long, too short for a"
            " scenario: need at least 2.3 s, 2 s of them history",
            "check the unit of time, or --hz",
        )
    counts = ", ".join(f"{rule} {count}" for rule, count in summary.rejected.items())
    others = {rule: n for rule, n in summary.rejected.items() if rule != CATEGORY}
    most = max(others, key=lambda rule: others[rule]) if others else CATEGORY
    return (
        f"{path}: no scenario is left of {summary.seen} pairs of window and object; dropped"
        f" by the rules {counts}",
        _REMEDIES[most],
    )


def _require_same_map(store: Path, road: VectorMap) -> None:
    path = map_file(store, road.name)
    if not (store / MANIFEST).is_file() or not path.is_file():
        return
    other = read_map_file(path)
    if other.edges.ids != road.edges.ids or not (
        other.edges.polygons.bounds.shape == road.edges.polygons.bounds.shape
        and (other.edges.polygons.bounds == road.edges.polygons.bounds).all()
    ):
        raise ConversionError(
            f"store {store} has another map named {road.name!r}", "name this one: --city NAME"
        )
