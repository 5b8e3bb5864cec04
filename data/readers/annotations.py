"""Annotated boxes of a DSC3D recording: read without trust, as flat arrays.

A recording is a table with one row per object and frame. It is kept flat, sorted by track and frame
(nothing here grows with tracks x frames), in the local frame of the site. Position and heading are
taken as truth, heading through the rotation matrix.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from shiftsim.data.readers.build import Frames, dictionary_codes, find_pause, make_samples
from shiftsim.data.readers.codes import CATEGORIES, normalise_category
from shiftsim.data.readers.files import SourceFile
from shiftsim.data.readers.motion import track_medians
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

    Raises ConversionError: a file is missing or broken, or its content contradicts itself.
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
