"""Tracks of a recording at the rate of its source, and the sampler that reads them at any time.

Rows of a converted recording are 0.05 s apart, counted from the first frame; poses are linear
between frames, angles by the shorter way round. Nothing is stretched (nuPlan rule 454).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray

ROW_S, ROW_US = 0.05, 50_000  # s and us between rows of a converted recording
_EPS = 1e-9  # s


@dataclass(frozen=True)
class TrackSamples:
    """One recording. F frames, A rows (one per object and frame), N tracks.

    Rows are sorted by track, then frame; nothing here grows with tracks x frames.
    """

    name: str  # name of the recording
    start_us: int  # time stamp of the first frame [us]
    period: float  # nominal time between frames [s]
    clock: FloatArray  # (F,) time of the frames since the first one [s]
    frame: IntArray  # (A,) frame of the row
    track: IntArray  # (A,) track of the row
    centers: FloatArray  # (A, 3) centre of the box [m]
    raw_headings: FloatArray  # (A,) heading as recorded [rad]
    headings: FloatArray  # (A,) heading, held where it spins at standstill [rad]
    velocities: FloatArray  # (A, 2) in the frame of the centres [m/s]
    track_ids: NDArray[Any]  # (N,) ids, ascending
    categories: tuple[str, ...]  # N names of categories
    kinds: IntArray  # (N,) AgentKind codes
    sizes: FloatArray  # (N, 2 or 3) length, width and, if known, height [m]
    warnings: dict[str, int]  # count by kind of what was repaired

    @cached_property
    def time(self) -> FloatArray:
        """(A,) time of the rows since the first frame [s]."""
        return self.clock[self.frame]

    @cached_property
    def by_frame(self) -> IntArray:
        """(A,) rows sorted by frame, then track."""
        return np.argsort(self.frame, kind="stable")

    @cached_property
    def frame_ptr(self) -> IntArray:
        """(F + 1,) where the rows of each frame begin in `by_frame`, and the number of rows."""
        counts = np.bincount(self.frame, minlength=len(self.clock))
        return np.concatenate([[0], np.cumsum(counts)])

    @property
    def duration(self) -> float:
        """Time from the first to the last frame [s]."""
        return float(self.clock[-1])


@dataclass(frozen=True)
class Runs:
    """Stretches of rows in which a track is present without a hole that is too long. U runs."""

    first: IntArray  # (U,) first row
    last: IntArray  # (U,) last row
    track: IntArray  # (U,) track
    number: IntArray  # (U,) how many runs of the same track came before


class Boxes(NamedTuple):
    """Boxes of a track at given times. G boxes, in the frame of the recording."""

    poses: FloatArray  # (G, 3) box centre x [m], y [m], heading [rad]
    velocities: FloatArray  # (G, 2) [m/s]
    heights: FloatArray  # (G,) z of the box centre [m]


def find_runs(recording: TrackSamples, max_hole_s: float) -> Runs:
    """Split the tracks where they are absent for longer than `max_hole_s` (nuPlan rule 458)."""
    time = recording.time
    gap = np.r_[np.inf, np.diff(time)]
    new_track = np.r_[True, np.diff(recording.track) != 0]
    starts = new_track | (gap > max_hole_s + recording.period + 1e-6)
    first = np.flatnonzero(starts)
    last = np.r_[first[1:] - 1, len(time) - 1]
    track = recording.track[first]
    first_run = np.searchsorted(track, track)
    return Runs(first, last, track, np.arange(len(first)) - first_run)


def rows_of(seconds: float) -> int:
    """How many 20 Hz rows a time span has."""
    return round(seconds / ROW_S)


def rows_between(first_s: FloatArray, last_s: FloatArray) -> tuple[IntArray, IntArray]:
    """First and last 20 Hz row of time spans; first > last where one lies between two rows."""
    first = np.ceil(first_s / ROW_S - _EPS).astype(np.int64)
    return first, np.floor(last_s / ROW_S + _EPS).astype(np.int64)


def sample_run(recording: TrackSamples, runs: Runs, run: int, time: FloatArray) -> Boxes:
    """Boxes of a run at times (G,) since the first frame [s], linear between the frames.

    Beyond the ends of a run motion goes on: linearly for one frame, then with constant velocity and
    heading. Callers decide how far that is allowed.
    """
    first, last = int(runs.first[run]), int(runs.last[run])
    row_time, velocities = recording.time, recording.velocities
    row = first - 1 + np.searchsorted(row_time[first : last + 1], time + _EPS, side="right")
    row = np.clip(row, first, max(last - 1, first))
    following = np.minimum(row + 1, last)
    span = np.where(following > row, row_time[following] - row_time[row], recording.period)
    share = (time - row_time[row]) / span
    reach = recording.period / span
    linear = np.clip(share, -reach, 1.0 + reach)
    inside = np.clip(share, 0.0, 1.0)[:, None]
    beyond = (share - linear) * span  # s
    end = np.where(share < 0.0, row, following)
    way = recording.centers[following] - recording.centers[row]
    centers = recording.centers[row] + linear[:, None] * way
    places = centers[:, :2] + beyond[:, None] * velocities[end]
    turn = wrap_angles(recording.headings[following] - recording.headings[row])
    headings = wrap_angles(recording.headings[row] + linear * turn)
    change = velocities[following] - velocities[row]
    return Boxes(
        np.column_stack([places, headings]), velocities[row] + inside * change, centers[:, 2]
    )
