"""Tracks as a source has them: flat, at its own rate, one row per object and time."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import FloatArray, IntArray


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
