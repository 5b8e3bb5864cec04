"""A file of tracks and an OpenDRIVE map to scenarios of a store.

The reader looks for what cannot be right, so that even what is wrong can be drawn; then the
scenarios are made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.readers.build import make_samples
from shiftsim.data.readers.codes import KINDS
from shiftsim.data.readers.convert import ConversionReport, convert, refuse_other_map
from shiftsim.data.readers.placement import extent_of
from shiftsim.data.readers.reader import Reader, SourceRecording, opendrive_site
from shiftsim.data.readers.scenarios import EGO_CATEGORIES
from shiftsim.data.readers.tracks.axes import Diagnostics
from shiftsim.data.readers.tracks.diagnostics import diagnose
from shiftsim.data.readers.tracks.table import TrackTable, read_tracks
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.data.store.reading import read_report
from shiftsim.data.store.tables import digest
from shiftsim.errors import ConversionError, plural
from shiftsim.world.map import VectorMap


class TracksReader(Reader):
    """Tracks and map, read, and what cannot be right about them: a source of one recording.

    It is a ConversionError if a file cannot be read, a ConfigError if an override does not fit it.
    """

    egos: Sequence[str] | None = None  # ids of the egos; None for every vehicle that can be one

    def __init__(
        self,
        tracks: Path | Sequence[Path],  # CSV or Parquet, one row per object and time
        map_path: Path,  # OpenDRIVE file
        *,
        city: str | None = None,  # name of the map in the store; that of the file by default
        overrides: Mapping[str, Any] | None = None,  # names, units and kinds (`recognise`)
        hz: float | None = None,  # frames per second, for time given in frames
        config: ConversionConfig | None = None,
    ) -> None:
        self.config = config = config or ConversionConfig(ego_categories=EGO_CATEGORIES)
        self.paths = [tracks] if isinstance(tracks, Path) else tracks
        self.source, self.map_path = self.paths[0], map_path
        if self.source.suffix.lower() == ".xodr":
            what = f"{self.source} is an OpenDRIVE map, not a table of tracks"
            raise ConversionError(what, "give the tables first, then the map")
        table = read_tracks(self.paths, overrides=overrides, hz=hz)
        drive, self.name = read_opendrive(map_path), city or map_path.stem
        self.site: BuiltMap = opendrive_site(drive, name=self.name, country=config.country)
        if table.origin and "shift_m" not in (overrides or {}):
            table = _at_origin(table, self.road, table.origin)
        self.table, self.diagnostics = table, diagnose(table, self.road, config.min_drivable_share)
        _note_inputs(self.paths, table, self.diagnostics)
        if hz is not None and "frame" not in table.columns.found:
            remedy = "leave hz out, or name the column of frames: [columns] frame = 'NAME'"
            self.diagnostics.warn("hz is not used: the table has times", remedy)
        tables = [digest(path) for path in self.paths]  # which others of that name have not
        self.details = {"figures": self.diagnostics.figures, "tables": tables}
        columns = asdict(table.columns) | {"hz": table.hz}
        self.settings: dict[str, Any] = {"config": asdict(config), "columns": columns, "egos": None}

    @property
    def road(self) -> VectorMap:
        """The map."""
        return self.site.road

    def recordings(self) -> Sequence[str]:
        """The name of the table."""
        return [self.table.name]

    def files(self, recording: str) -> Sequence[Path]:
        """The table and the map."""
        return [*self.paths, self.map_path]

    def read(self, recording: str) -> SourceRecording:
        """The recording."""
        table = self.table
        samples = make_samples(
            table.name,
            time_us=table.time_us,
            ids=table.track_ids[table.track],
            category=table.category,
            categories=table.categories,
            xy=table.xy,
            headings=table.headings,
            velocities=table.velocities,
            sizes=table.sizes,
            kind_of=KINDS,
        )
        columns = {role: column.words for role, column in table.columns.found.items()}
        return SourceRecording(
            samples,
            self.site,
            config=self.config,
            egos=self.egos,
            needs_scenario=True,
            details=self.details | {"columns": columns},
        )


def _at_origin(table: TrackTable, road: VectorMap, origin: tuple[float, float]) -> TrackTable:
    """Tracks moved by the origin of their frame, where that brings them nearer to the map."""
    middles = np.median(table.xy, axis=0) + np.array([(0.0, 0.0), origin])
    gap, gap_then = np.hypot(*(middles - np.clip(middles, *extent_of(road))).T)
    if gap_then >= gap:
        return table
    return replace(table, xy=table.xy + origin, columns=replace(table.columns, shift=origin))


def _note_inputs(files: Sequence[Path], table: TrackTable, out: Diagnostics) -> None:
    """What the user should know of a shift of their own, and of tables that are not read."""
    shift, origin = table.columns.shift, table.origin
    if any(shift) and shift != origin:
        out.warn(
            f"positions are shifted by shift_m = [{shift[0]}, {shift[1]}]; one that was found"
            " by search is approximate: a lane beside looks the same",
            "give the difference between the origins of map and tracks"
            + (f"; recordingMeta says [{origin[0]}, {origin[1]}]" if origin else ""),
        )
    for path in files:
        for ours, theirs in (("vehicle", "pedestrian"), ("pedestrian", "vehicle")):
            other = path.with_name(path.name.replace(f"{ours}_tracks", f"{theirs}_tracks"))
            if other not in files and other.is_file():
                out.warn(f"{other.name} lies beside and is not read", "give both tables")


def convert_tracks(
    reader: TracksReader, store: Path, *, egos: Sequence[str] | None = None, replace: bool = False
) -> ConversionReport:
    """Add tracks to a store, made if needed; what it held of the same tables is replaced.

    `egos` are the ids of the egos; every vehicle that can be one by default. It is a DataError if
    something cannot be right, no scenario is left, or the store has another map of that name, or
    the recording of that name from other tables, unless these are to be replaced.
    """
    errors, road = reader.diagnostics.errors, reader.road
    if errors:
        what, remedy = map("; ".join, zip(*errors, strict=True))
        raise ConversionError(f"{reader.source}: {what}", remedy)
    refuse_other_map(store, road, reader.map_path)
    before, tables = read_report(store, road.name), reader.details["tables"]
    before = before.get("recordings", {}).get(reader.table.name, {})
    if not replace and before.get("tables", tables) != tables:
        count = plural(before["summary"]["accepted"], "scenario")
        what = f"{reader.source}: store {store} has that recording of another table, {count}"
        raise ConversionError(what, "rename the file to add both; --replace to lose that one")
    reader.egos = reader.settings["egos"] = egos
    return convert(reader, store)
