"""Annotated boxes of a DSC3D recording: read without trust, as flat arrays.

A recording is a table with one row per object and frame. It is kept flat, sorted by track and frame
(nothing here grows with tracks x frames), in the local frame of the site. Position and heading are
taken as truth, heading through the rotation matrix.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.readers.build import dictionary_codes, most_frequent
from shiftsim.data.readers.codes import CATEGORIES, normalise_category
from shiftsim.data.readers.files import SourceFile
from shiftsim.data.readers.motion import (
    believed_velocities,
    held_headings,
    track_ends,
    track_medians,
)
from shiftsim.data.readers.samples import TrackSamples
from shiftsim.errors import ConversionError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.ranges import DSC3D, require

POSITION = ("translation_x", "translation_y", "translation_z")
ROTATION = ("rotation_x", "rotation_y", "rotation_z")
DIMENSION = ("dimension_x", "dimension_y", "dimension_z")
VELOCITY = ("velocity_x", "velocity_y")
_WANTED = ("frame_id", "track_id", "category", *POSITION, *ROTATION, *DIMENSION, *VELOCITY)
_MAX_VELOCITY_ERROR = 0.5  # m/s, median of a track; beyond it the stored velocity is not believed
_MAX_SPEED = 200.0  # m/s along an axis
_EPS = 1e-9  # s
# Far beyond any recording, and still within 2 GB: what exceeds them is damaged or hostile.
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


class Dsc3dFile(SourceFile):
    """A file of a DSC3D download."""

    remedy = "get the recording again from its source, or repair the file"

    def require(self, field: str, values: Any, place: str) -> None:
        """Numbers are in the range of their field."""
        require(DSC3D, field, values, f"{self.path}: {place}", error=ConversionError)

    def require_that(self, is_good: object, what: str, remedy: str = "") -> None:
        """Raise an error that says what is wrong, unless all is good."""
        if not is_good:
            raise self.fault(what, remedy)

    def table(self, wanted: tuple[str, ...], max_rows: int) -> pa.Table:
        """The columns wanted, as far as the file has them."""
        self.require_size()
        try:
            file = pq.ParquetFile(self.path)
            rows, present = file.metadata.num_rows, file.schema_arrow.names
            self.require_that(
                rows <= max_rows, f"{rows} rows, at most {max_rows} can be read", "split it"
            )
            names = [name for name in wanted if name in present]
            twice = [name for name in names if present.count(name) > 1]
            self.require_that(not twice, f"columns {twice} are there twice", "remove one of each")
            long = [name for name in names if name == "category"]  # its texts are not repeated
            file = pq.ParquetFile(self.path, read_dictionary=long)
            return file.read(names, use_threads=False)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise self.fault(f"not a readable Parquet file ({error})") from error

    def column(self, table: pa.Table, name: str, kind: pa.DataType) -> pa.ChunkedArray:
        """A column without nulls, as a type."""
        self.require_that(name in table.column_names, f"column {name!r} is missing")
        column = table[name]
        nulls = column.null_count
        self.require_that(not nulls, f"column {name!r} holds {nulls} nulls")
        try:
            return column.cast(kind)
        except (pa.ArrowException, ValueError) as error:
            raise self.fault(f"column {name!r} is {column.type}, need {kind}") from error

    def values(self, table: pa.Table, name: str) -> FloatArray:
        """One numeric column as float64, finite and within its range."""
        values: FloatArray = self.column(table, name, pa.float64()).to_numpy()
        self.require(name, values, "column")
        return values


def read_recording(
    site: Site, name: str, category_map: dict[str, str] | None = None
) -> Annotations:
    """One recording, checked; `category_map` gives the known category for names of the data set.

    Raises:
        ConversionError: A file is missing or broken, or its content contradicts itself.
    """
    folder = site.folder / "annotations" / name
    warnings: Counter[str] = Counter()
    frames, stamps = _read_frames(Dsc3dFile(folder / "frames.parquet"), site.frame_distance)
    clock = (frames - frames[0]) / site.frame_rate
    file = Dsc3dFile(folder / "annotations.parquet")
    if clock[-1] > _MAX_DURATION:
        raise ConversionError(
            f"{folder}: the frames span {clock[-1]:.0f} s, at most {_MAX_DURATION:.0f} s are read",
            "check frame_id, and frame_rate in data_meta.json; or split the recording",
        )
    wrong = np.abs((stamps - stamps[0]) * 1e-6 - clock) > 0.5 * site.period
    warnings["frames whose time disagrees with their id"] += int(wrong.sum())
    warnings["frames missing"] += int((np.diff(frames) // site.frame_distance - 1).sum())
    table = file.table(_WANTED, _MAX_ROWS)
    ids = file.values(table, "track_id").astype(np.int64)
    row_frames = file.values(table, "frame_id").astype(np.int64)
    file.require_that(len(ids), "the recording has no objects")
    order = np.lexsort((row_frames, ids))
    track_ids, track = np.unique(ids[order], return_inverse=True)
    row_frames = row_frames[order]
    frame = np.searchsorted(frames, row_frames)
    _check_rows(file, frames, frame, row_frames, track_ids, track)

    def matrix(names: tuple[str, ...]) -> FloatArray:
        return np.stack([file.values(table, name)[order] for name in names], axis=1)

    sizes = _track_sizes(file, matrix(DIMENSION), track, warnings)
    names = _track_categories(file, table, order, track, category_map or {}, warnings)
    bottom = matrix(POSITION)
    angles, up = rotation_angles(matrix(ROTATION))
    centers = bottom + 0.5 * sizes[track, 2:3] * up  # nuPlan rule 461
    time = clock[frame]
    stored = matrix(VELOCITY) if set(VELOCITY) <= set(table.column_names) else None
    derived = _central_differences(centers[:, :2], time, track)
    contradicts = None if stored is None else _contradicts(stored, derived, track)
    velocities = believed_velocities(stored, derived, contradicts, track, warnings)
    return Annotations(
        name=name,
        start_us=int(stamps[0]),
        period=site.period,
        clock=clock,
        frame=frame,
        track=track,
        bottom=bottom,
        angles=angles,
        centers=centers,
        raw_headings=angles[:, 0],
        headings=held_headings(angles[:, 0], velocities, time, track, warnings),
        velocities=velocities,
        track_ids=track_ids,
        categories=names,
        kinds=np.array([CATEGORIES[name] for name in names], np.int64),
        sizes=sizes,
        warnings=dict(+warnings),
    )


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


def _read_frames(file: Dsc3dFile, apart: int) -> tuple[IntArray, IntArray]:
    """(F,) ids and (F,) time stamps [us] of the annotated frames."""
    table = file.table(("frame_id", "time"), _MAX_FRAMES)
    ids = file.values(table, "frame_id").astype(np.int64)
    file.require_that(len(ids) > 1, f"{len(ids)} frames, need at least 2")
    file.require_that((np.diff(ids) > 0).all(), "frame_id must increase strictly")
    file.require_that(
        not ((ids - ids[0]) % apart).any(), f"frame ids are not {apart} (frame_distance) apart"
    )
    time = file.column(table, "time", pa.timestamp("us", "UTC"))
    stamps = time.cast(pa.int64()).to_numpy()
    file.require("time", stamps, "column")
    return ids, stamps


def _check_rows(
    file: Dsc3dFile,
    frames: IntArray,
    frame: IntArray,
    row_frames: IntArray,
    track_ids: IntArray,
    track: IntArray,
) -> None:
    """Every box is in a frame that is listed, once per track, and there are not too many."""
    num_tracks = len(track_ids)
    file.require_that(num_tracks <= _MAX_TRACKS, f"{num_tracks} tracks, more than {_MAX_TRACKS}")
    missing = row_frames[frames[np.minimum(frame, len(frames) - 1)] != row_frames]
    if len(missing):
        what = f"frame_id {missing[0]} is not listed in frames.parquet"
        raise file.fault(f"{what} ({len(missing)} such rows)")
    most = int(np.bincount(frame).max())
    file.require_that(most <= _MAX_AT_ONCE, f"{most} boxes in one frame, more than {_MAX_AT_ONCE}")
    twice = np.flatnonzero((np.diff(track) == 0) & (np.diff(frame) == 0))
    if len(twice):
        what = f"track_id {track_ids[track[twice[0]]]} occurs twice"
        where = f"at frame_id {row_frames[twice[0]]} ({len(twice)} such rows)"
        raise file.fault(
            f"{what} {where}", "one of the boxes belongs to another track; renumber it"
        )


def _track_sizes(
    file: Dsc3dFile, sizes: FloatArray, track: IntArray, warnings: Counter[str]
) -> FloatArray:
    """(N, 3) first size of every track, the median where it changes."""
    bad = sizes[~(sizes > 0).all(axis=1)]
    if len(bad):
        raise file.fault(f"a box has the dimensions {bad[0].tolist()}; all must be positive")
    out = sizes[track_ends(track)[:-1]]
    changed = np.unique(track[(np.abs(sizes - out[track]) > 1e-3).any(axis=1)])
    if len(changed):
        for axis in range(3):
            out[changed, axis] = track_medians(sizes[:, axis], track)[changed]
    warnings["tracks of varying size (median taken)"] += len(changed)
    return out


def _track_categories(
    file: Dsc3dFile,
    table: pa.Table,
    order: IntArray,
    track: IntArray,
    category_map: dict[str, str],
    warnings: Counter[str],
) -> tuple[str, ...]:
    """Known category of every track."""
    kind = pa.dictionary(pa.int32(), pa.string())
    found, codes = dictionary_codes(file.column(table, "category", kind))
    file.require_that(len(found) <= _MAX_NAMES, f"more than {_MAX_NAMES} categories")
    given = {normalise_category(k): normalise_category(v) for k, v in category_map.items()}
    names = [normalise_category(str(name)) for name in found.to_pylist()]
    most = most_frequent(codes[order], len(names), track, warnings)
    known = tuple(given.get(names[code], names[code]) for code in most)
    for name in known:
        hint = f"map it: --category {name}=… with one of {', '.join(sorted(CATEGORIES))}"
        file.require_that(name in CATEGORIES, f"category {name!r} is unknown", hint)
    return known


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
