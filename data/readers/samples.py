"""The sampler: tracks of a recording at the rate of its source, at 20 Hz, and states of egos.

Rows of a converted recording are 0.05 s apart, counted from the first frame; poses are linear
between frames, angles by the shorter way round. Nothing is stretched (nuPlan rule 454).
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.geometry.fits import fit_weights
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.world import state
from shiftsim.world.state import LAST_AGENT_KIND, PACIFICA, Tracks, TrafficLights

ROW_S, ROW_US = 0.05, 50_000  # s and us between rows of a converted recording
_EPS = 1e-9  # s
_HALF_WINDOW = 5  # rows on each side of a derivative: 0.55 s in all, second order


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
    xy: FloatArray  # (A, 2) centre of the box [m]
    raw_headings: FloatArray  # (A,) heading as recorded [rad]
    headings: FloatArray  # (A,) heading, held where it spins at standstill [rad]
    velocities: FloatArray  # (A, 2) in the frame of the centres [m/s]
    track_ids: NDArray[Any]  # (N,) ids, ascending
    categories: tuple[str, ...]  # N names of categories
    kinds: IntArray  # (N,) AgentKind codes
    sizes: FloatArray  # (N, 2 or 3) length, width and, if known, height [m]
    warnings: dict[str, int]  # count by kind of what was repaired
    # (2,) what brings places into the frame of the map [m]
    offset: FloatArray = field(default_factory=lambda: np.zeros(2))
    max_hole_s: float = 0.5  # longest time without a row that does not split a track [s]

    @cached_property
    def runs(self) -> "Runs":
        """Stretches of the tracks without a longer hole (nuPlan rule 458)."""
        gap = np.r_[np.inf, np.diff(self.time)]
        new_track = np.r_[True, np.diff(self.track) != 0]
        starts = new_track | (gap > self.max_hole_s + self.period + 1e-6)
        first = np.flatnonzero(starts)
        last = np.r_[first[1:] - 1, len(self.time) - 1]
        track = self.track[first]
        number = np.arange(len(first)) - np.searchsorted(track, track)
        tokens = [
            f"{name}_{before + 1}" if before else str(name)
            for name, before in zip(self.track_ids[track].tolist(), number.tolist(), strict=True)
        ]
        return Runs(first, last, track, tokens)

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


class Runs(NamedTuple):
    """Stretches of rows in which a track is present without a hole that is too long. U runs."""

    first: IntArray  # (U,) first row
    last: IntArray  # (U,) last row
    track: IntArray  # (U,) track
    tokens: list[str]  # U ids; a presence after a long hole is a track of its own


def rows_of(seconds: float) -> int:
    """How many 20 Hz rows a time span has."""
    return round(seconds / ROW_S)


def rows_between(first_s: FloatArray, last_s: FloatArray) -> tuple[IntArray, IntArray]:
    """First and last 20 Hz row of time spans; first > last where one lies between two rows."""
    first = np.ceil(first_s / ROW_S - _EPS).astype(np.int64)
    return first, np.floor(last_s / ROW_S + _EPS).astype(np.int64)


def sample_run(
    recording: TrackSamples, run: int, time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(G, 3) poses of box centres and (G, 2) velocities of a run at times (G,).

    Times are those since the first frame [s]; values are linear between the frames.
    Beyond the ends of a run motion goes on: linearly for one frame, then with constant velocity and
    heading. Callers decide how far that is allowed.
    """
    first, last = int(recording.runs.first[run]), int(recording.runs.last[run])
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
    way = recording.xy[following] - recording.xy[row]
    xy = recording.xy[row] + linear[:, None] * way + beyond[:, None] * velocities[end]
    turn = wrap_angles(recording.headings[following] - recording.headings[row])
    headings = wrap_angles(recording.headings[row] + linear * turn)
    change = velocities[following] - velocities[row]
    return np.column_stack([xy, headings]), velocities[row] + inside * change


def resample(recording: TrackSamples, log_name: str, city: str, padding: int = 0) -> Recording:
    """A recording at 20 Hz in the frame of the map, and `padding` rows at constant velocity."""
    runs = recording.runs
    num_rows = int(np.floor(recording.duration / ROW_S + _EPS)) + 1 + padding
    first, last = rows_between(recording.time[runs.first], recording.time[runs.last])
    first = np.where(recording.frame[runs.first] == 0, -padding, first)
    present = np.flatnonzero(last >= first)
    present = present[np.lexsort((present, first[present]))]  # tracks in the order of appearance
    kinds = recording.kinds[runs.track[present]]
    shape = num_rows, len(present)
    valid = np.zeros(shape, np.bool_)
    poses, velocities, sizes = (np.full((*shape, parts), np.nan) for parts in (3, 2, 2))
    for column, run in enumerate(present.tolist()):
        row = np.arange(first[run], last[run] + 1)
        sampled, moving = sample_run(recording, run, row * ROW_S)
        row += padding
        valid[row, column], poses[row, column] = True, sampled
        sizes[row, column] = recording.sizes[runs.track[run], :2]
        if kinds[column] <= LAST_AGENT_KIND:
            velocities[row, column] = moving
    poses[..., :2] += recording.offset
    tokens = tuple(runs.tokens[run] for run in present.tolist())
    tracks = Tracks(valid, poses, velocities, sizes, kinds, tokens)
    times = recording.start_us + (np.arange(num_rows) - padding) * ROW_US
    return Recording(log_name, city, times, tracks, TrafficLights.empty(num_rows))


def ego_trace(
    recording: TrackSamples,
    run: int,
    log_name: str,
    *,
    first_row: int,
    last_row: int,
    padding: int = 0,
) -> EgoTrace:
    """States of a run as the ego: the Pacifica's box centre on the recorded one.

    The rows first_row … last_row - 1 are wanted; they count from the first of the `padding` rows
    before the first frame.
    """
    runs = recording.runs
    ends = recording.time[[runs.first[run], runs.last[run]]]
    begin, end = rows_between(ends[:1], ends[1:])
    low = min(int(begin[0]) + padding, first_row)
    high = max(int(end[0]) + 1 + padding, last_row)
    times = np.arange(low - padding, high - padding).astype(np.float64) * ROW_S
    states = ego_states(*sample_run(recording, run, times))
    states[:, :2] += recording.offset
    wanted = np.ascontiguousarray(states[first_row - low : last_row - low])
    return EgoTrace(log_name, runs.tokens[run], first_row, wanted)


def ego_states(centers: FloatArray, velocities: FloatArray) -> FloatArray:
    """Ego states (R, 11) from box centres at 20 Hz.

    `centers` (R, 3) are x [m], y [m], heading [rad]; `velocities` (R, 2) are in the map frame
    [m/s]. Steering and yaw rates stay 0 (nuPlan rule 415), so that an exported scenario is the same
    one.
    """
    states = np.zeros((len(centers), state.NUM_STATE))
    states[:, :3] = state.rear_poses(centers)  # nuPlan rule 453: box centre on box centre
    cos, sin = np.cos(centers[:, 2]), np.sin(centers[:, 2])
    yaw_rate = slope(np.unwrap(centers[:, 2]), ROW_S)
    states[:, state.VX] = velocities[:, 0] * cos + velocities[:, 1] * sin
    sideways = velocities[:, 1] * cos - velocities[:, 0] * sin
    states[:, state.VY] = sideways - yaw_rate * PACIFICA.rear_axle_to_center
    states[:, state.AX] = slope(states[:, state.VX], ROW_S)
    states[:, state.AY] = states[:, state.VX] * yaw_rate
    return states


def slope(values: FloatArray, dt: float) -> FloatArray:
    """Savitzky-Golay first derivative of values (R,), `dt` [s] apart: second order, 11 samples."""
    half = min(_HALF_WINDOW, (len(values) - 1) // 2)
    if half == 0:
        return np.gradient(values, dt) if len(values) > 1 else np.zeros(len(values))
    window = 2 * half + 1
    fit = fit_weights(window, 2, 1)
    inner = np.convolve(values, fit[half, ::-1], mode="valid")
    return np.r_[fit[:half] @ values[:window], inner, fit[half + 1 :] @ values[-window:]] / dt
