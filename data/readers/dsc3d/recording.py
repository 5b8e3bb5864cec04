"""Reader of DSC3D recordings: a folder of annotated drone video, as flat arrays of boxes.

A recording is a table with one row per object and frame. It is kept flat, sorted by track and frame
(nothing here grows with tracks x frames), in the local frame of the site; `local + offset` is UTM.
Position and heading are taken as truth, heading through the rotation matrix.
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.readers.dsc3d.files import (
    DIMENSION,
    POSITION,
    REPAIR,
    ROTATION,
    VELOCITY,
    numbers,
    read_table,
)
from shiftsim.data.readers.dsc3d.motion import (
    believed_velocities,
    held_headings,
    rotation_angles,
    track_medians,
)
from shiftsim.data.readers.tracks.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world.ranges import DSC3D, require
from shiftsim.world.state import AgentKind

_CATEGORIES = {
    AgentKind.VEHICLE: "car vehicle van pickup truck bus trailer tram train construction_vehicle"
    " agricultural_vehicle emergency_vehicle",
    AgentKind.BICYCLE: "motorcycle bicycle cyclist scooter e_scooter escooter moped",
    AgentKind.PEDESTRIAN: "pedestrian person stroller wheelchair",
    AgentKind.GENERIC_OBJECT: "animal bicycle_rack movable_object static_object generic_object",
}  # nuPlan rule 462: it has no class for motorcycles
CATEGORIES = {name: kind for kind, names in _CATEGORIES.items() for name in names.split()}

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
    table = read_table(path, _NEEDED, _MAX_ROWS)
    columns = {key: numbers(table, key, path) for key in (*POSITION, *ROTATION, *DIMENSION)}
    ids = numbers(table, "track_id", path).astype(np.int64)
    row_frames = numbers(table, "frame_id", path).astype(np.int64)
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
        stored = np.stack([numbers(table, key, path)[order] for key in VELOCITY], axis=1)
    velocities = believed_velocities(stored, centers[:, :2], time, track, warnings)
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


def normalise_category(name: str) -> str:
    """A category in lower case with underscores."""
    return name.strip().lower().replace(" ", "_").replace("-", "_")


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
    table = read_table(path, ("frame_id", "time"), _MAX_FRAMES)
    ids = numbers(table, "frame_id", path).astype(np.int64)
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
    try:
        encoded = table["category"].unify_dictionaries().combine_chunks()
        if not pa.types.is_dictionary(encoded.type):
            encoded = encoded.cast(pa.string()).dictionary_encode()
        encoded = encoded.cast(pa.dictionary(pa.int32(), pa.string()))
    except (pa.ArrowException, ValueError) as error:
        raise ConversionError(f"{path}: column 'category' does not hold names", REPAIR) from error
    if encoded.null_count:
        raise ConversionError(f"{path}: column 'category' holds {encoded.null_count} nulls", REPAIR)
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    if len(encoded.dictionary) > _MAX_NAMES:
        raise ConversionError(f"{path}: more than {_MAX_NAMES} categories", REPAIR)
    names = [normalise_category(str(name)) for name in encoded.dictionary.to_pylist()]
    codes = encoded.indices.to_numpy()[order].astype(np.int64)
    votes = np.zeros((int(track[-1]) + 1, len(names)), np.int64)
    np.add.at(votes, (track, codes), 1)
    changing = int(((votes > 0).sum(axis=1) > 1).sum())
    warnings["tracks of changing category (most frequent taken)"] += changing
    return tuple(names[code] for code in votes.argmax(axis=1).tolist())


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
