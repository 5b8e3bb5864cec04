"""A file of tracks and an OpenDRIVE map to scenarios of a store.

First both are inspected (`inspect_tracks`), so that even what is wrong can be drawn; then the
scenarios are made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from shiftsim.data.maps.opendrive.map import build_road_map, require_lanes
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.codes import KINDS
from shiftsim.data.readers.convert import ConversionReport, convert
from shiftsim.data.readers.reader import SourceRecording, site_map
from shiftsim.data.readers.scenarios import EGO_CATEGORIES
from shiftsim.data.readers.tracks.diagnostics import diagnose
from shiftsim.data.readers.tracks.statistics import Diagnostics
from shiftsim.data.readers.tracks.table import TrackTable, read_tracks
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.data.store.map import read_map_file
from shiftsim.data.store.tables import MANIFEST, map_file
from shiftsim.errors import ConversionError
from shiftsim.world.map import VectorMap


@dataclass(frozen=True)
class Inspection:
    """Tracks and map, and what cannot be right about them."""

    path: Path  # the file of tracks
    map_path: Path
    table: TrackTable
    road: VectorMap
    map_warnings: dict[str, int]  # count by kind of what was repaired in the map
    diagnostics: Diagnostics


def tracks_config(**values: Any) -> ConversionConfig:
    """Thresholds of DeepPlan's conversion; egos may also be plain vehicles."""
    return ConversionConfig(**{"ego_categories": EGO_CATEGORIES, **values})


def inspect_tracks(
    tracks: Path,
    map_path: Path,
    *,
    city: str | None = None,
    overrides: Mapping[str, Any] | None = None,
    hz: float | None = None,
    config: ConversionConfig | None = None,
) -> Inspection:
    """Read a file of tracks and its map, and find out whether they can be right.

    Args:
        tracks: CSV or Parquet file, one row per object and time.
        map_path: OpenDRIVE file.
        city: Name of the map in the store; that of the file by default.
        overrides: Names, units and kinds (`columns.recognise`).
        hz: Frames per second, for time given in frames.
        config: Thresholds.

    Raises:
        ConversionError: A file cannot be read.
        ConfigError: An override does not fit the file.
    """
    config = config or tracks_config()
    table = read_tracks(tracks, overrides=overrides, hz=hz)
    pa.default_memory_pool().release_unused()
    drive = read_opendrive(map_path)
    road, report = build_road_map(drive, name=city or map_path.stem, country=config.country)
    require_lanes(drive, report)
    diagnostics = diagnose(table, road, config.min_drivable_share)
    return Inspection(tracks, map_path, table, road, dict(report.warnings), diagnostics)


def convert_tracks(
    inspection: Inspection,
    store: Path,
    *,
    egos: Sequence[str] | None = None,
    config: ConversionConfig | None = None,
) -> ConversionReport:
    """Add inspected tracks to a store, made if needed; what it held of the recording is replaced.

    Args:
        inspection: Tracks and map.
        store: Folder of the store.
        egos: Ids of the egos; every vehicle that can be one by default.
        config: Thresholds.

    Raises:
        ConversionError: Something cannot be right, or no scenario is left.
        DataError: The store has another map of that name.
    """
    errors, road = inspection.diagnostics.errors, inspection.road
    if errors:
        raise ConversionError(
            "; ".join(error.what for error in errors), "; ".join(error.remedy for error in errors)
        )
    path = map_file(store, road.name)
    if (store / MANIFEST).is_file() and path.is_file():
        other = read_map_file(path).edges
        bounds = other.polygons.bounds, road.edges.polygons.bounds
        if other.ids != road.edges.ids or not (
            bounds[0].shape == bounds[1].shape and (bounds[0] == bounds[1]).all()
        ):
            raise ConversionError(
                f"store {store} has another map named {road.name!r}", "name this one: --city NAME"
            )
    return convert(TracksReader(inspection, egos, config or tracks_config()), store)


class TracksReader:
    """Inspected tracks as a source of one recording."""

    def __init__(
        self, inspection: Inspection, egos: Sequence[str] | None, config: ConversionConfig
    ) -> None:
        self.inspection, self.egos, self.config = inspection, egos, config
        self.name, self.source = inspection.road.name, inspection.path
        self.site = site_map(inspection.road, inspection.map_warnings)
        columns = asdict(inspection.table.columns) | {"hz": inspection.table.hz}
        self.settings: Mapping[str, Any] = {
            "egos": egos,
            "config": asdict(config),
            "columns": columns,
        }

    def recordings(self) -> Sequence[str]:
        """The name of the table."""
        return [self.inspection.table.name]

    def files(self, recording: str) -> Sequence[Path]:
        """The table and the map."""
        return [self.inspection.path, self.inspection.map_path]

    def read(self, recording: str) -> SourceRecording:
        """The recording."""
        table, diagnostics = self.inspection.table, self.inspection.diagnostics
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
            derived=diagnostics.derived,
            kind_of=KINDS,
        )
        diagnostics.derived = None  # large, and not needed any more
        columns = {role: column.name for role, column in table.columns.found.items()}
        return SourceRecording(
            samples,
            self.site,
            config=self.config,
            egos=self.egos,
            needs_scenario=True,
            details={"figures": diagnostics.figures, "columns": columns},
        )

    def summarise(self, entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Nothing: there is one recording."""
        return {}
