"""Annotated boxes of a DSC3D recording: read without trust, as flat arrays.

A recording is a table with one row per object and frame. It is kept flat, sorted by track and frame
(nothing here grows with tracks x frames), in the local frame of the site. Position and heading are
taken as truth, heading through the rotation matrix.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.data.readers.build import (
    dictionary_codes,
    find_pause,
    find_twice,
    track_categories,
)
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
VELOCITY = ("velocity_x", "velocity_y")  # may be missing
_NUMBERS = ("frame_id", "track_id", *POSITION, *ROTATION, *DIMENSION, *VELOCITY)
_BOXES = {
    **dict.fromkeys(_NUMBERS, pa.float64()),
    "category": pa.dictionary(pa.int32(), pa.string()),
}
_FRAMES = {"frame_id": pa.float64(), "time": pa.timestamp("us", "UTC")}
_MAX_VELOCITY_ERROR = 0.5  # m/s, median of a track; beyond it the stored velocity is not believed
_MAX_SPEED = 200.0  # m/s along an axis
_EPS = 1e-9  # s
# Far beyond any recording: what exceeds them is damaged or hostile.
_MAX_TRACKS = 100_000
_MAX_AT_ONCE = 5_000  # boxes in a frame


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

    Raises:
        ConversionError: A file is missing or broken, or its content contradicts itself.
    """
    folder = site.folder / "annotations" / name
    warnings: Counter[str] = Counter()
    frames, stamps = _read_frames(Dsc3dFile(folder / "frames.parquet"), site.frame_distance)
    clock = (frames - frames[0]) / site.frame_rate
    file = Dsc3dFile(folder / "annotations.parquet")
    if fault := find_pause(clock * 1e6):
        raise ConversionError(
            f"{folder}: {fault[0]}", "check frame_id, and frame_rate in data_meta.json"
        )
    wrong = np.abs((stamps - stamps[0]) * 1e-6 - clock) > 0.5 * site.period
    warnings["frames whose time disagrees with their id"] += int(wrong.sum())
    warnings["frames missing"] += int((np.diff(frames) // site.frame_distance - 1).sum())
    table = file.columns(_BOXES, optional=VELOCITY)

    def matrix(*names: str) -> FloatArray:
        """(A, number of names) columns of numbers in their range."""
        return np.column_stack([file.values(table, name) for name in names])

    row_frames, ids = matrix("frame_id", "track_id").astype(np.int64).T
    order = np.lexsort((row_frames, ids))
    track_ids, track = np.unique(ids[order], return_inverse=True)
    row_frames = row_frames[order]
    frame = np.searchsorted(frames, row_frames)
    missing = row_frames[frames[np.minimum(frame, len(frames) - 1)] != row_frames]
    if len(missing):
        what = f"frame_id {missing[0]} is not listed in frames.parquet"
        raise file.fault(f"{what} ({len(missing)} such rows)")
    num_tracks, most = len(track_ids), int(np.bincount(frame).max())
    file.require_that(num_tracks <= _MAX_TRACKS, f"{num_tracks} tracks, more than {_MAX_TRACKS}")
    file.require_that(most <= _MAX_AT_ONCE, f"{most} boxes in one frame, more than {_MAX_AT_ONCE}")
    time = clock[frame]
    if fault := find_twice(track_ids, track, time * 1e6):
        raise file.fault(*fault)
    dimensions = matrix(*DIMENSION)[order]
    bad = dimensions[~(dimensions > 0).all(axis=1)]
    file.require_that(
        not len(bad), f"a box has the dimensions {bad[:1].tolist()}; all must be positive"
    )
    sizes = track_medians(dimensions, track)
    varying = np.unique(track[(np.abs(dimensions - sizes[track]) > 1e-3).any(axis=1)])
    warnings["tracks of varying size (median taken)"] += len(varying)
    found, codes = dictionary_codes(table["category"])
    given = {normalise_category(k): normalise_category(v) for k, v in (category_map or {}).items()}
    categories = [normalise_category(str(category)) for category in found.to_pylist()]
    names = track_categories(
        str(file.path),
        codes[order],
        [given.get(category, category) for category in categories],
        track,
        CATEGORIES,
        warnings,
        remedy="map it: --category NAME=… with one of",
    )
    angles, up = rotation_angles(matrix(*ROTATION)[order])
    yaw = np.ascontiguousarray(angles[:, 0])
    xy = matrix(*POSITION[:2])[order] + 0.5 * sizes[track, 2:] * up[:, :2]  # nuPlan rule 461
    stored = matrix(*VELOCITY)[order] if set(VELOCITY) <= set(table.column_names) else None
    derived = _central_differences(xy, time, track)
    contradicts = None if stored is None else _contradicts(stored, derived, track)
    velocities = believed_velocities(stored, derived, contradicts, track, warnings)
    return TrackSamples(
        name=name,
        start_us=int(stamps[0]),
        period=site.period,
        clock=clock,
        frame=frame,
        track=track,
        xy=xy,
        raw_headings=yaw,
        headings=held_headings(yaw, velocities, time, track, warnings),
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
