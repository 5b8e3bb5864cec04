"""DSC3D downloads as a source of recordings: a site with its map, and annotated drone video.

`local + offset` is UTM, the frame of the map.
"""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.readers.annotations import Dsc3dFile, Site, read_recording
from shiftsim.data.readers.convert import ConversionReport, convert
from shiftsim.data.readers.placement import place_on_map
from shiftsim.data.readers.reader import Reader, SourceRecording, opendrive_site
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.data.readers.windows import ConversionConfig, window_spans
from shiftsim.data.store.tables import digest
from shiftsim.errors import ConversionError, DataError
from shiftsim.world.state import AgentKind

_MAX_META = 10_000_000  # bytes of data_meta.json
_MAX_FRAME_SHIFT = 0.5  # m between the map's own georeference and that of the annotations
_MOVING = 1.0  # m/s
_MAX_POINTS = 20_000  # of a recording that tell where the map lies
_META = {
    "reference_utm": {"zone": list, "offset": [float]},
    "frame_rate": float,
    "frame_distance": float,
    "locations": [{"recordings": [str]}],
}


class Dsc3dReader(Reader):
    """A DSC3D download with its map; its recordings are named by their folders.

    Raises ConversionError: the folder or its map cannot be read, or contradict each other.
    """

    def __init__(
        self,
        src: Path,  # folder with `data_meta.json`, `annotations/` and `map/`
        *,
        site: str | None = None,  # name in the store; that of the folder by default
        map_path: Path | None = None,  # OpenDRIVE file, where it is not in the download
        config: ConversionConfig | None = None,
    ) -> None:
        self.config = config or ConversionConfig()
        self.download = open_site(src)
        self.name = site or src.resolve().name
        self.source = self.download.folder
        path = find_map(self.download, map_path)
        drive = read_opendrive(path)
        _check_georeference(drive, self.download)
        x, y, *_ = drive.offset or (0.0, 0.0)
        place = self.download.offset
        self.site: BuiltMap = opendrive_site(
            drive,
            name=self.name,
            offset=(float(place[0]) - x, float(place[1]) - y),  # the header's is applied
            epsg=self.download.epsg,
            country=self.config.country,
        )
        self.settings = {
            "site": [self.name, *self.download.offset.tolist()],
            "rate": [self.download.frame_rate, self.download.frame_distance],
            "config": asdict(self.config),
            "map": digest(path),
        }

    def recordings(self) -> Sequence[str]:
        """Names as listed in `data_meta.json`."""
        return self.download.recordings

    def files(self, recording: str) -> Sequence[Path]:
        """Annotations and frames."""
        folder = self.source / "annotations" / recording
        return [folder / f"{part}.parquet" for part in ("annotations", "frames")]

    def read(self, recording: str) -> SourceRecording:
        """One recording, and how its moving vehicles lie on the map."""
        try:
            samples = read_recording(self.download, recording, self.config.category_map)
        except DataError as error:
            message = error.message.replace(f"{self.source}{os.sep}", "")
            raise ConversionError(message, error.hint) from error
        return SourceRecording(
            replace(samples, offset=self.download.offset[:2]),
            self.site,
            config=self.config,
            spans=window_spans(samples.duration, self.config),
            details={"placement": self._placement(samples)},
        )

    def _placement(self, samples: TrackSamples) -> dict[str, Any]:
        """How many moving vehicles are looked at, how many of them are on drivable area."""
        is_vehicle = (samples.kinds == AgentKind.VEHICLE)[samples.track]
        moves = np.hypot(samples.velocities[:, 0], samples.velocities[:, 1]) > _MOVING
        points = samples.xy[is_vehicle & moves]
        points = points[:: max(1, len(points) // _MAX_POINTS)] + self.download.offset[:2]
        found = place_on_map(self.site.road, points, self.config.min_drivable_share)
        return found._asdict() | {"shift": found.shift.tolist()}

    def summarise(self, entries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Share of moving vehicles on drivable area; an error where map and tracks do not fit."""
        places = [entry["placement"] for entry in entries]
        looked_at = sum(place["num_points"] for place in places)
        share = sum(place["num_drivable"] for place in places) / looked_at if looked_at else 1.0
        least = self.config.min_drivable_share
        if share < least:
            worst = max(places, key=lambda place: place["num_points"] - place["num_drivable"])
            x, y = worst["shift"]
            raise ConversionError(
                f"{self.source}: only {share:.0%} of the moving vehicles are on drivable area of"
                f" the map, need {least:.0%}",
                f"the annotations fit best ({worst['best_share']:.0%}) when shifted by"
                f" ({x:+.1f}, {y:+.1f}) m: check that map and reference_utm.offset belong together",
            )
        return {"drivable_share": share, "config": asdict(self.config)}


def convert_dsc3d(
    src: Path, store: Path, *, site: str | None = None, options: ConversionConfig | None = None
) -> ConversionReport:
    """Convert a DSC3D download to scenarios in a store: `convert` of a `Dsc3dReader`."""
    return convert(Dsc3dReader(src, site=site, config=options), store)


def open_site(src: Path) -> Site:
    """The site of a DSC3D download, from its `data_meta.json`; else a ConversionError.

    `src` is the folder that holds it, or one above a `data` or `release/data` folder.
    """
    folders = (src, src / "data", src / "release/data")
    found = [folder for folder in folders if (folder / "data_meta.json").exists()]
    if not found:
        raise ConversionError(
            f"{src} is no DSC3D folder: it has no data_meta.json",
            "give the folder that holds data_meta.json, annotations/ and map/",
        )
    file = Dsc3dFile(found[0] / "data_meta.json")
    meta = file.unpack(file.content(_MAX_META), json.loads, _META, "the JSON")
    version = str(meta.get("interface_version"))
    file.require_that(
        version.split(".")[0] == "1",
        f"interface_version {version!r} is not supported, only 1.x",
        "convert with a version of shiftsim that knows this format",
    )
    utm, names = meta["reference_utm"], [n for at in meta["locations"] for n in at["recordings"]]
    file.require_that(len(utm["zone"]) == 2, f"zone {utm['zone']!r} is not [number, 'N' or 'S']")
    file.require_that(len(utm["offset"]) == 3, "reference_utm.offset has not 3 numbers")
    zone = file.known(utm["zone"][0], range(1, 61), "reference_utm.zone")
    for key in ("frame_rate", "frame_distance"):
        file.require(key, meta[key], "key")
    offset = [file.number(value, "reference_utm.offset", "key") for value in utm["offset"]]
    file.require_that(names, "no recordings are listed under locations")
    for name in names:
        is_plain = Path(name).name == name and name not in ("", ".", "..")
        file.require_that(is_plain, f"recording name {name!r} is not a plain folder name")
    return Site(
        folder=found[0],
        zone=int(zone),
        is_north=str(utm["zone"][1]).upper() == "N",
        offset=np.array(offset),
        frame_rate=float(meta["frame_rate"]),
        frame_distance=int(meta["frame_distance"]),
        recordings=tuple(names),
    )


def find_map(site: Site, given: Path | None = None) -> Path:
    """The map of a site, or a ConversionError: `map/map.xodr`, any in `map/`, or `map.xodr`."""
    if given is not None:
        if not given.is_file():
            raise ConversionError(f"map {given} does not exist", "check the path")
        return given
    others = sorted((site.folder / "map").glob("*.xodr"))
    for path in (site.folder / "map/map.xodr", *others, site.folder / "map.xodr"):
        if path.is_file():
            return path
    what = f"{site.folder}: this download has no OpenDRIVE map (map/map.xodr)"
    raise ConversionError(what, "ask DeepScenario support for the map, or give one with --map")


def _check_georeference(drive: OpenDrive, site: Site) -> None:
    """Refuse a map whose own georeference contradicts that of the annotations."""
    own = (drive.offset or (0.0, 0.0))[:2]
    if drive.geo_reference is None and own == (0.0, 0.0):
        return
    if drive.geo_reference is not None:
        try:
            crs = pyproj.CRS.from_user_input(drive.geo_reference)
            to_utm = pyproj.Transformer.from_crs(crs, site.epsg, always_xy=True)
            own = to_utm.transform(*own)
        except pyproj.exceptions.ProjError:
            return  # not a projection: the map counts as local
    if not np.hypot(own[0] - site.offset[0], own[1] - site.offset[1]) <= _MAX_FRAME_SHIFT:
        raise ConversionError(
            f"{drive.source} places its origin at UTM ({own[0]:.2f}, {own[1]:.2f}),"
            f" reference_utm.offset at ({site.offset[0]:.2f}, {site.offset[1]:.2f})",
            "correct the one that is wrong; they must agree to 0.5 m",
        )
