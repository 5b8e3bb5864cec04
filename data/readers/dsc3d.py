"""Reader of DSC3D recordings: a folder of annotated drone video, as flat arrays of boxes.

A recording is a table with one row per object and frame. It is kept flat, sorted by track and frame
(nothing here grows with tracks x frames), in the local frame of the site; `local + offset` is UTM.
Position and heading are taken as truth, heading through the rotation matrix.
"""

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj

from shiftsim.data.maps.build import PieceMap
from shiftsim.data.maps.opendrive.map import build_road_map
from shiftsim.data.maps.opendrive.reading import read_opendrive
from shiftsim.data.maps.opendrive.records import OpenDrive
from shiftsim.data.readers.build import dictionary_codes, most_frequent
from shiftsim.data.readers.codes import CATEGORIES, normalise_category
from shiftsim.data.readers.convert import (
    ConversionReport,
    Executor,
    Progress,
    convert,
    serial_map,
)
from shiftsim.data.readers.motion import (
    believed_velocities,
    held_headings,
    track_ends,
    track_medians,
)
from shiftsim.data.readers.placement import place_on_map
from shiftsim.data.readers.reader import SourceRecording, site_map
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
VELOCITY = ("velocity_x", "velocity_y")
REPAIR = "get the recording again from its source, or repair the file"
SCENARIO_TYPE = "deepplan"
_MAX_VELOCITY_ERROR = 0.5  # m/s, median of a track; beyond it the stored velocity is not believed
_MAX_SPEED = 200.0  # m/s along an axis
_EPS = 1e-9  # s
_MAX_FRAME_SHIFT = 0.5  # m between the map's own georeference and that of the annotations
_MOVING = 1.0  # m/s
_MAX_POINTS = 20_000  # of a recording that tell where the map lies

_NEEDED = ("frame_id", "track_id", "category", *POSITION, *ROTATION, *DIMENSION, *VELOCITY)

# Far beyond any recording, and still within 2 GB: what exceeds them is damaged or hostile.
_MAX_META = 10_000_000  # bytes of data_meta.json
_MAX_ROWS = 8_000_000  # boxes of a recording: 100 minutes of 100 tracks
_MAX_FRAMES = 1_000_000
_MAX_DURATION = 12 * 3600.0  # s
_MAX_TRACKS = 100_000
_MAX_AT_ONCE = 5_000  # boxes in a frame
_MAX_NAMES = 1_000  # distinct categories


@dataclass(frozen=True)
class Site:
    """One DSC3D folder."""

    folder: Path  # where `data_meta.json` lies
    name: str  # free text of the data set
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


@dataclass(frozen=True)
class Annotations(TrackSamples):
    """One recording, in the local frame."""

    bottom: FloatArray  # (A, 3) centre of the bottom face [m]
    angles: FloatArray  # (A, 3) yaw, pitch, roll [rad]


class Dsc3dReader:
    """A DSC3D download with its map; its recordings are named by their folders.

    Args:
        src: Folder with `data_meta.json`, `annotations/` and `map/`.
        site: Name of the site in the store; the name of the folder by default.
        map_path: OpenDRIVE file, where it is not in the download.
        config: Thresholds.

    Raises:
        ConversionError: The folder or its map cannot be read, or contradict each other.
    """

    def __init__(
        self,
        src: Path,
        *,
        site: str | None = None,
        map_path: Path | None = None,
        config: ConversionConfig | None = None,
    ) -> None:
        self.config = config or ConversionConfig()
        self.download = open_site(src)
        self.name = site or src.resolve().name
        self.source = self.download.folder
        path = find_map(self.download, map_path)
        self.site = self._map(path)
        self.settings: Mapping[str, Any] = {
            "site": [self.name, *self.download.offset.tolist()],
            "rate": [self.download.frame_rate, self.download.frame_distance],
            "config": asdict(self.config),
            "map": digest(path),
        }

    def _map(self, path: Path) -> PieceMap:
        drive = read_opendrive(path)
        _check_georeference(drive, self.download)
        x, y, *_ = drive.offset or (0.0, 0.0)
        place = self.download.offset
        offset = float(place[0]) - x, float(place[1]) - y  # the header's is applied
        road, report = build_road_map(
            drive,
            name=self.name,
            offset=offset,
            epsg=self.download.epsg,
            country=self.config.country,
        )
        if road.num_lanes == 0:
            raise ConversionError(f"{drive.source} has no drivable lane", "give a map with roads")
        return site_map(road, report.warnings)

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
            samples,
            self.site,
            config=self.config,
            scenario_type=SCENARIO_TYPE,
            spans=window_spans(samples.duration, self.config),
            offset=self.download.offset[:2],
            details={"placement": self._placement(samples)},
        )

    def _placement(self, samples: TrackSamples) -> dict[str, Any]:
        """How many moving vehicles are looked at, how many of them are on drivable area."""
        is_vehicle = (samples.kinds == AgentKind.VEHICLE)[samples.track]
        moves = np.hypot(samples.velocities[:, 0], samples.velocities[:, 1]) > _MOVING
        points = samples.centers[is_vehicle & moves, :2]
        points = points[:: max(1, len(points) // _MAX_POINTS)] + self.download.offset[:2]
        found = place_on_map(self.site.road, points, self.config.min_drivable_share)
        return asdict(found) | {"shift": found.shift.tolist()}

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
    src: Path,
    store: Path,
    *,
    site: str | None = None,
    map_path: Path | None = None,
    options: ConversionConfig | None = None,
    progress: Progress | None = None,
    executor: Executor = serial_map,
) -> ConversionReport:
    """Convert a DSC3D download to scenarios in a store: `convert` of a `Dsc3dReader`."""
    reader = Dsc3dReader(src, site=site, map_path=map_path, config=options)
    return convert(reader, store, progress=progress, executor=executor)


def open_site(src: Path) -> Site:
    """The site of a DSC3D download, from its `data_meta.json`.

    Args:
        src: The folder that holds `data_meta.json`, or one above a `data` or `release/data` folder.

    Raises:
        ConversionError: The file is missing, not JSON, without a key or of another major version.
    """
    folders = (src, src / "data", src / "release/data")
    found = [folder for folder in folders if (folder / "data_meta.json").exists()]
    if not found:
        raise ConversionError(
            f"{src} is no DSC3D folder: it has no data_meta.json",
            "give the folder that holds data_meta.json, annotations/ and map/",
        )
    path = found[0] / "data_meta.json"
    try:
        if path.stat().st_size > _MAX_META:
            raise ConversionError(f"{path} is larger than {_MAX_META} bytes", REPAIR)
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise ConversionError(f"{path}: not readable as JSON ({error})", REPAIR) from error
    version = str(_key(meta, "interface_version", path))
    if version.split(".")[0] != "1":
        raise ConversionError(
            f"{path}: interface_version {version!r} is not supported, only 1.x",
            "convert with a version of shiftsim that knows this format",
        )
    try:
        zone, hemisphere = _key(meta, "reference_utm.zone", path)
        site = Site(
            folder=found[0],
            name=str(meta.get("dataset_name", "")),
            zone=int(zone),
            is_north=str(hemisphere).upper() == "N",
            offset=np.array(_key(meta, "reference_utm.offset", path), np.float64).reshape(3),
            frame_rate=float(_key(meta, "frame_rate", path)),
            frame_distance=int(_key(meta, "frame_distance", path)),
            recordings=tuple(
                str(name)
                for location in _key(meta, "locations", path)
                for name in _key(location, "recordings", path)
            ),
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise ConversionError(f"{path}: a value has the wrong type ({error})", REPAIR) from error
    _check_site(site, path)
    return site


def find_map(site: Site, given: Path | None = None) -> Path:
    """The OpenDRIVE file of a site: `map/map.xodr`, any file in `map/`, or `map.xodr` at the top.

    Raises:
        ConversionError: There is none.
    """
    if given is not None:
        if not given.is_file():
            raise ConversionError(f"map {given} does not exist", REPAIR)
        return given
    others = sorted((site.folder / "map").glob("*.xodr"))
    for path in (site.folder / "map/map.xodr", *others, site.folder / "map.xodr"):
        if path.is_file():
            return path
    raise ConversionError(
        f"{site.folder}: this download has no OpenDRIVE map (map/map.xodr)",
        "ask DeepScenario support for the map, or give one with --map",
    )


def read_recording(
    site: Site, name: str, category_map: dict[str, str] | None = None
) -> Annotations:
    """One recording, checked; `category_map` gives the known category for names of the data set.

    Raises:
        ConversionError: A file is missing or broken, or its content contradicts itself.
    """
    folder = site.folder / "annotations" / name
    warnings: Counter[str] = Counter()
    frame_ids, start_us = _read_frames(folder / "frames.parquet", site, warnings)
    path = folder / "annotations.parquet"
    table = _read_table(path, _NEEDED, _MAX_ROWS)
    columns = {key: _numbers(table, key, path) for key in (*POSITION, *ROTATION, *DIMENSION)}
    ids = _numbers(table, "track_id", path).astype(np.int64)
    row_frames = _numbers(table, "frame_id", path).astype(np.int64)
    order = np.lexsort((row_frames, ids))
    track_ids, track = np.unique(ids[order], return_inverse=True)
    if len(track_ids) > _MAX_TRACKS:
        raise ConversionError(f"{path}: {len(track_ids)} tracks, more than {_MAX_TRACKS}", REPAIR)
    frame = _frame_index(frame_ids, row_frames[order], path)
    most = int(np.bincount(frame).max())
    if most > _MAX_AT_ONCE:
        raise ConversionError(
            f"{path}: {most} boxes in one frame, more than {_MAX_AT_ONCE}", REPAIR
        )
    twice = np.flatnonzero((np.diff(track) == 0) & (np.diff(frame) == 0))
    if len(twice):
        one = f"track_id {track_ids[track[twice[0]]]} occurs twice"
        where = f"at frame_id {frame_ids[frame[twice[0]]]} ({len(twice)} such rows)"
        hint = "one of the boxes belongs to another track; renumber it"
        raise ConversionError(f"{path}: {one} {where}", hint)

    def matrix(keys: tuple[str, ...]) -> FloatArray:
        return np.stack([columns[key][order] for key in keys], axis=1)

    sizes = _track_sizes(matrix(DIMENSION), track, len(track_ids), path, warnings)
    names = _track_categories(table, order, track, path, warnings)
    names, kinds = _agent_kinds(names, category_map or {}, path)
    bottom, rotation = matrix(POSITION), matrix(ROTATION)
    angles, up = rotation_angles(rotation)
    centers = bottom + 0.5 * sizes[track, 2:3] * up  # nuPlan rule 461
    clock = (frame_ids - frame_ids[0]) / site.frame_rate
    time = clock[frame]
    stored = None
    if set(VELOCITY) <= set(table.column_names):
        stored = np.stack([_numbers(table, key, path)[order] for key in VELOCITY], axis=1)
    derived = _central_differences(centers[:, :2], time, track)
    contradicts = None if stored is None else _contradicts(stored, derived, track)
    velocities = believed_velocities(stored, derived, contradicts, track, warnings)
    return Annotations(
        name=name,
        start_us=start_us,
        period=site.period,
        clock=clock,
        frame=frame,
        track=track.astype(np.int64),
        bottom=bottom,
        angles=angles,
        centers=centers,
        raw_headings=angles[:, 0],
        headings=held_headings(angles[:, 0], velocities, time, track, warnings),
        velocities=velocities,
        track_ids=track_ids,
        categories=names,
        kinds=kinds,
        sizes=sizes,
        warnings=dict(+warnings),
    )


def _key(data: Any, dotted: str, path: Path) -> Any:
    for key in dotted.split("."):
        if not isinstance(data, dict) or key not in data:
            raise ConversionError(f"{path}: key {dotted!r} is missing", REPAIR)
        data = data[key]
    return data


def _check_site(site: Site, path: Path) -> None:
    is_place = DSC3D["reference_utm.offset"].holds(site.offset).all()
    is_positive = 0 < site.frame_rate < np.inf and site.frame_distance > 0
    for is_good, what in (
        (1 <= site.zone <= 60, f"reference_utm.zone {site.zone!r} is not a UTM zone (1-60)"),
        (np.isfinite(site.offset).all(), "reference_utm.offset is not finite"),
        (is_place, f"reference_utm.offset {site.offset.tolist()} is not a place in UTM"),
        (is_positive, "frame_rate and frame_distance must be positive"),
        (site.recordings, "no recordings are listed under locations"),
    ):
        if not is_good:
            raise ConversionError(f"{path}: {what}", REPAIR)
    for key, value in (("frame_rate", site.frame_rate), ("frame_distance", site.frame_distance)):
        require(DSC3D, key, value, f"{path}: key", error=ConversionError)
    for name in site.recordings:
        if Path(name).name != name or name in ("", ".", ".."):
            raise ConversionError(
                f"{path}: recording name {name!r} is not a plain folder name", REPAIR
            )


def _read_frames(path: Path, site: Site, warnings: Counter[str]) -> tuple[IntArray, int]:
    table = _read_table(path, ("frame_id", "time"), _MAX_FRAMES)
    ids = _numbers(table, "frame_id", path).astype(np.int64)
    if len(ids) < 2:
        raise ConversionError(f"{path}: {len(ids)} frames, need at least 2", REPAIR)
    if (np.diff(ids) <= 0).any():
        raise ConversionError(f"{path}: frame_id must increase strictly", REPAIR)
    apart = site.frame_distance
    if ((ids - ids[0]) % apart).any():
        raise ConversionError(f"{path}: frame ids are not {apart} (frame_distance) apart", REPAIR)
    if "time" not in table.column_names or not pa.types.is_timestamp(table["time"].type):
        raise ConversionError(f"{path}: column 'time' with time stamps is missing", REPAIR)
    if table["time"].null_count:
        raise ConversionError(f"{path}: column 'time' holds nulls", REPAIR)
    stamps = table["time"].cast(pa.timestamp("us", "UTC")).cast(pa.int64()).to_numpy()
    require(DSC3D, "time", stamps, f"{path}: column", error=ConversionError)
    clock = (ids - ids[0]) / site.frame_rate
    if clock[-1] > _MAX_DURATION:
        raise ConversionError(
            f"{path}: the frames span {clock[-1]:.0f} s, at most {_MAX_DURATION:.0f} s are read",
            "check frame_id, and frame_rate in data_meta.json; or split the recording",
        )
    wrong = np.abs((stamps - stamps[0]) * 1e-6 - clock) > 0.5 * site.period
    warnings["frames whose time disagrees with their id"] += int(wrong.sum())
    warnings["frames missing"] += int((np.diff(ids) // apart - 1).sum())
    return ids, int(stamps[0])


def _frame_index(frame_ids: IntArray, wanted: IntArray, path: Path) -> IntArray:
    if not len(wanted):
        raise ConversionError(f"{path}: the recording has no objects", REPAIR)
    index = np.searchsorted(frame_ids, wanted)
    found = frame_ids[np.minimum(index, len(frame_ids) - 1)] == wanted
    if not found.all():
        what = f"frame_id {int(wanted[~found][0])} is not listed in frames.parquet"
        raise ConversionError(f"{path}: {what} ({int((~found).sum())} such rows)", REPAIR)
    return index.astype(np.int64)


def _track_sizes(
    sizes: FloatArray, track: IntArray, num_tracks: int, path: Path, warnings: Counter[str]
) -> FloatArray:
    if not (sizes > 0).all():
        box = sizes[~(sizes > 0).all(axis=1)][0].tolist()
        raise ConversionError(
            f"{path}: a box has the dimensions {box}; all must be positive", REPAIR
        )
    first = np.searchsorted(track, np.arange(num_tracks))
    varying = (np.abs(sizes - sizes[first][track]) > 1e-3).any(axis=1)
    out = sizes[first].copy()
    changed = np.unique(track[varying])
    for axis in range(sizes.shape[1] if len(changed) else 0):
        out[changed, axis] = track_medians(sizes[:, axis], track)[changed]
    warnings["tracks of varying size (median taken)"] += len(changed)
    return out


def _track_categories(
    table: pa.Table, order: IntArray, track: IntArray, path: Path, warnings: Counter[str]
) -> tuple[str, ...]:
    if "category" not in table.column_names:
        raise ConversionError(f"{path}: column 'category' is missing", REPAIR)
    column = table["category"]
    if column.null_count:
        raise ConversionError(f"{path}: column 'category' holds {column.null_count} nulls", REPAIR)
    try:
        if not pa.types.is_dictionary(column.type):
            column = column.cast(pa.string()).dictionary_encode()
        found, codes = dictionary_codes(column.cast(pa.dictionary(pa.int32(), pa.string())))
    except (pa.ArrowException, ValueError) as error:
        raise ConversionError(f"{path}: column 'category' does not hold names", REPAIR) from error
    if len(found) > _MAX_NAMES:
        raise ConversionError(f"{path}: more than {_MAX_NAMES} categories", REPAIR)
    names = [normalise_category(str(name)) for name in found.to_pylist()]
    most = most_frequent(codes[order], len(names), track, warnings)
    return tuple(names[code] for code in most)


def _agent_kinds(
    names: tuple[str, ...], category_map: dict[str, str], path: Path
) -> tuple[tuple[str, ...], IntArray]:
    given = {normalise_category(k): normalise_category(v) for k, v in category_map.items()}
    mapped = tuple(given.get(name, name) for name in names)
    for name in mapped:
        if name not in CATEGORIES:
            raise ConversionError(
                f"{path}: category {name!r} is unknown",
                f"map it: --category {name}=… with one of {', '.join(sorted(CATEGORIES))}",
            )
    return mapped, np.array([CATEGORIES[name] for name in mapped], np.int64)


def rotation_angles(rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(A, 3) yaw, pitch, roll [rad] and (A, 3) unit vectors along the height of objects.

    `rotation` is (A, 3) axis times angle, object to local frame [rad].
    """
    angle = np.linalg.norm(rotation, axis=1)
    x, y, z = rotation.T
    sine = np.sinc(angle / np.pi)  # sin(a) / a
    rest = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2  # (1 - cos(a)) / a^2
    cos = np.cos(angle)
    yaw = np.arctan2(z * sine + x * y * rest, cos + x * x * rest)
    pitch = -np.arcsin(np.clip(x * z * rest - y * sine, -1.0, 1.0))
    up = np.stack([y * sine + x * z * rest, y * z * rest - x * sine, cos + z * z * rest], axis=1)
    roll = np.arctan2(x * sine + y * z * rest, up[:, 2])
    return np.stack([yaw, pitch, roll], axis=1), up


def _central_differences(xy: FloatArray, time: FloatArray, track: IntArray) -> FloatArray:
    """(A, 2) difference of the neighbouring rows of the same track, one-sided at its ends."""
    index = np.arange(len(track))
    before = np.where(np.r_[False, track[1:] == track[:-1]], index - 1, index)
    after = np.where(np.r_[track[1:] == track[:-1], False], index + 1, index)
    span = np.maximum(time[after] - time[before], _EPS)
    return (xy[after] - xy[before]) / span[:, None]


def _contradicts(stored: FloatArray, derived: FloatArray, track: IntArray) -> BoolArray:
    """(N,) whether the stored velocities of a track contradict its positions (nuPlan rule 459)."""
    error = np.hypot(*(derived - stored).T)
    wrong = track_medians(error, track) >= _MAX_VELOCITY_ERROR
    wrong &= np.diff(track_ends(track)) > 1  # a single row has nothing to compare with
    wrong[track[np.abs(stored).max(axis=1) > _MAX_SPEED]] = True
    return wrong


def _read_table(path: Path, wanted: tuple[str, ...], max_rows: int) -> pa.Table:
    """The columns wanted, as far as the file has them.

    Raises:
        ConversionError: The file is missing, not Parquet, or has more rows than `max_rows`.
    """
    if not os.path.isfile(path):  # a name may be too long to ask for
        raise ConversionError(f"{path} is missing", "copy the whole recording folder")
    try:
        file = pq.ParquetFile(path)
        if file.metadata.num_rows > max_rows:
            raise ConversionError(
                f"{path}: {file.metadata.num_rows} rows, at most {max_rows} can be read",
                "split the recording",
            )
        names = [name for name in wanted if name in file.schema_arrow.names]
        names_only = [name for name in ("category",) if name in names]
        file = pq.ParquetFile(path, read_dictionary=names_only)  # long names are not repeated
        return file.read(names, use_threads=False)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise ConversionError(f"{path}: not a readable Parquet file ({error})", REPAIR) from error


def _numbers(table: pa.Table, key: str, path: Path) -> FloatArray:
    """One numeric column as float64, finite and without nulls.

    Raises:
        ConversionError: It is missing, or a value cannot be.
    """
    if key not in table.column_names:
        raise ConversionError(f"{path}: column {key!r} is missing", REPAIR)
    column = table[key]
    if column.null_count:
        raise ConversionError(f"{path}: column {key!r} holds {column.null_count} nulls", REPAIR)
    try:
        values = column.cast(pa.float64()).to_numpy().astype(np.float64, copy=False)
    except (pa.ArrowException, ValueError, TypeError) as error:
        what = f"{path}: column {key!r} is {column.type}, need numbers"
        raise ConversionError(what, REPAIR) from error
    require(DSC3D, key, values, f"{path}: column", error=ConversionError)
    return values


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
