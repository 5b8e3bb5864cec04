"""DSC3D downloads as a source of recordings: a site with its map, and annotated drone video.

A recording is a table with one row per object and frame. It is read without trust and kept flat,
sorted by track and frame (nothing here grows with tracks x frames), in the local frame of the site;
`local + offset` is UTM, the frame of the map. Position and heading are taken as truth, heading
through the rotation matrix.
"""

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj
from scipy.spatial.transform import Rotation

from shiftsim.data.maps.builder import BuiltMap
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.readers.build import Frames, dictionary_codes, find_pause, make_samples
from shiftsim.data.readers.codes import CATEGORIES, normalise_category
from shiftsim.data.readers.convert import ConversionReport, convert
from shiftsim.data.readers.files import SourceFile
from shiftsim.data.readers.motion import track_medians
from shiftsim.data.readers.placement import place_on_map
from shiftsim.data.readers.reader import Reader, SourceRecording, opendrive_site
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.data.readers.windows import ConversionConfig, window_spans
from shiftsim.data.store.tables import digest
from shiftsim.errors import ConversionError, DataError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.ranges import DSC3D, require
from shiftsim.world.state import AgentKind

POSITION = ("translation_x", "translation_y", "translation_z")
ROTATION = ("rotation_x", "rotation_y", "rotation_z")
DIMENSION = ("dimension_x", "dimension_y", "dimension_z")
VELOCITY = ("velocity_x", "velocity_y")  # may be missing
_NUMBERS = ("frame_id", "track_id", *POSITION, *ROTATION, *DIMENSION, *VELOCITY)
_BOXES = {
    **dict.fromkeys(_NUMBERS, pa.float64()),
    "category": pa.dictionary(pa.int32(), pa.string()),
}
_FRAMES = {"frame_id": pa.float64(), "time": pa.timestamp("us", "UTC")}
_MAX_VELOCITY_ERROR = 0.5  # m/s, median of a track; beyond it the stored velocity is not believed
_EPS = 1e-9  # s
# Far beyond any recording: what exceeds them is damaged or hostile.
_MAX_TRACKS = 100_000
_MAX_AT_ONCE = 5_000  # boxes in a frame
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


@dataclass(frozen=True)
class Site:
    """One DSC3D folder."""

    folder: Path  # where `data_meta.json` lies
    zone: int  # UTM zone
    is_north: bool  # whether the zone is a northern one
    offset: FloatArray  # (3,) UTM easting, northing and altitude of the local origin [m]
    frame_rate: float  # rate of the camera [Hz]
    frame_distance: int  # camera frames between two annotated ones
    recordings: tuple[str, ...]  # names of the recordings

    @property
    def epsg(self) -> int:
        """Code of the site's UTM coordinate system (WGS 84)."""
        return (32600 if self.is_north else 32700) + self.zone

    @property
    def period(self) -> float:
        """Time between annotated frames [s]."""
        return self.frame_distance / self.frame_rate


class Dsc3dFile(SourceFile):
    """A file of a DSC3D download."""

    remedy = "get the recording again from its source, or repair the file"
    casts = True

    def require(self, field: str, values: Any, place: str) -> None:
        """Numbers are in the range of their field."""
        require(DSC3D, field, values, f"{self.path}: {place}", error=ConversionError)

    def values(self, table: pa.Table, name: str) -> FloatArray:
        """(A,) a column of numbers, all in the range of its field."""
        values: FloatArray = table[name].to_numpy()
        self.require(name, values, "column")
        return values


def read_recording(
    site: Site, name: str, category_map: Mapping[str, str] | None = None
) -> TrackSamples:
    """One recording, checked; `category_map` gives the known category for names of the data set.

    Raises ConversionError: a file is missing or broken, or its content contradicts itself.
    """
    folder = site.folder / "annotations" / name
    warnings: Counter[str] = Counter()
    frames, stamps = _read_frames(Dsc3dFile(folder / "frames.parquet"), site.frame_distance)
    clock = (frames - frames[0]) / site.frame_rate
    file = Dsc3dFile(folder / "annotations.parquet")
    if fault := find_pause(clock * 1e6):
        words = f"{folder}: {fault[0]}"
        raise ConversionError(words, "check frame_id, and frame_rate in data_meta.json")
    wrong = np.abs((stamps - stamps[0]) * 1e-6 - clock) > 0.5 * site.period
    warnings["frames whose time disagrees with their id"] += int(wrong.sum())
    warnings["frames missing"] += int((np.diff(frames) // site.frame_distance - 1).sum())
    table = file.columns(_BOXES, optional=VELOCITY)

    def matrix(*names: str) -> FloatArray:
        """(A, number of names) columns of numbers in their range."""
        return np.column_stack([file.values(table, name) for name in names])

    row_frames, ids = matrix("frame_id", "track_id").astype(np.int64).T
    frame = np.searchsorted(frames, row_frames)
    missing = row_frames[frames[np.minimum(frame, len(frames) - 1)] != row_frames]
    if len(missing):
        what = f"frame_id {np.sort(missing)[0]} is not listed in frames.parquet"
        raise file.fault(f"{what} ({len(missing)} such rows)")
    track_ids, track = np.unique(ids, return_inverse=True)
    num_tracks, most = len(track_ids), int(np.bincount(frame).max())
    file.require_that(num_tracks <= _MAX_TRACKS, f"{num_tracks} tracks, more than {_MAX_TRACKS}")
    file.require_that(most <= _MAX_AT_ONCE, f"{most} boxes in one frame, more than {_MAX_AT_ONCE}")
    dimensions = matrix(*DIMENSION)
    bad = dimensions[~(dimensions > 0).all(axis=1)]
    file.require_that(
        not len(bad), f"a box has the dimensions {bad[:1].tolist()}; all must be positive"
    )
    sizes = track_medians(dimensions, track)[track]
    varying = np.unique(track[(np.abs(dimensions - sizes) > 1e-3).any(axis=1)])
    warnings["tracks of varying size (median taken)"] += len(varying)
    found, codes = dictionary_codes(table["category"])
    given = {normalise_category(k): normalise_category(v) for k, v in (category_map or {}).items()}
    categories = [normalise_category(str(category)) for category in found.to_pylist()]
    angles, up = rotation_angles(matrix(*ROTATION))
    time_us = stamps[0] + np.rint(clock * 1e6).astype(np.int64)
    samples = make_samples(
        name,
        time_us=time_us[frame],
        ids=ids,
        category=codes,
        categories=[given.get(category, category) for category in categories],
        xy=matrix(*POSITION[:2]) + 0.5 * sizes[:, 2:] * up[:, :2],  # nuPlan rule 461
        headings=np.ascontiguousarray(angles[:, 0]),
        velocities=matrix(*VELOCITY) if set(VELOCITY) <= set(table.column_names) else None,
        sizes=sizes,
        kind_of=CATEGORIES,
        frames=Frames(time_us, clock, site.period),
        velocity_rule=_by_error,
        where=str(file.path),
        remedy="map it: --category NAME=… with one of",
    )
    return replace(samples, warnings=dict(+(warnings + Counter(samples.warnings))))


def rotation_angles(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(A, 3) yaw, pitch, roll [rad] and (A, 3) unit vectors along the height of objects.

    `rotation` is (A, 3) axis times angle, object to local frame [rad].
    """
    matrix = Rotation.from_rotvec(rotation).as_matrix()
    yaw = np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])
    pitch = -np.arcsin(np.clip(matrix[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(matrix[:, 2, 1], matrix[:, 2, 2])
    return np.stack([yaw, pitch, roll], axis=1), matrix[:, :, 2]


def _read_frames(file: Dsc3dFile, apart: int) -> tuple[IntArray, IntArray]:
    """(F,) ids and (F,) time stamps [us] of the annotated frames."""
    table = file.columns(_FRAMES)
    ids = file.values(table, "frame_id").astype(np.int64)
    file.require_that(len(ids) > 1, f"{len(ids)} frames, need at least 2")
    file.require_that((np.diff(ids) > 0).all(), "frame_id must increase strictly")
    file.require_that(
        not ((ids - ids[0]) % apart).any(), f"frame ids are not {apart} (frame_distance) apart"
    )
    stamps = table["time"].cast(pa.int64()).to_numpy()
    file.require("time", stamps, "column")
    return ids, stamps


def _by_error(
    stored: FloatArray, xy: FloatArray, time: FloatArray, track: IntArray, _period: float
) -> tuple[FloatArray, BoolArray]:
    """Differences of the neighbouring rows, one-sided at the ends of a track; nuPlan rule 459."""
    index, same = np.arange(len(track)), track[1:] == track[:-1]
    before, after = index - np.r_[False, same], index + np.r_[same, False]
    span = np.maximum(time[after] - time[before], _EPS)
    derived = (xy[after] - xy[before]) / span[:, None]
    wrong = track_medians(np.hypot(*(derived - stored).T), track) >= _MAX_VELOCITY_ERROR
    wrong &= np.bincount(track) > 1  # a single row has nothing to compare with
    return derived, wrong


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
