"""A recording at 20 Hz, and the states of its egos.

Rows are 0.05 s apart, counted from the first frame; poses are linear between frames, angles by the
shorter way round. Nothing is stretched (nuPlan rule 454): time is `frame_id / frame_rate`.
"""

from dataclasses import dataclass

import numpy as np

from shiftsim.data.readers.deepplan.windows import ROW_S, Runs, rows_of
from shiftsim.data.readers.tracks.samples import TrackSamples
from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world import state
from shiftsim.world.state import LAST_AGENT_KIND, PACIFICA, Tracks, TrafficLights

_EPS = 1e-9  # s
ROW_US = 50_000  # us, as `ROW_S`
_BLOCK_ROWS = 256  # rows that are sampled at once
_HALF_WINDOW = 5  # rows on each side of a derivative: 0.55 s in all, second order


@dataclass(frozen=True)
class Samples:
    """Boxes of runs at given times. G samples, local frame."""

    poses: FloatArray  # (G, 3) box centre x [m], y [m], heading [rad]
    velocities: FloatArray  # (G, 2) [m/s]
    heights: FloatArray  # (G,) z of the box centre [m]


def sample_runs(recording: TrackSamples, runs: Runs, run: IntArray, time: FloatArray) -> Samples:
    """Boxes of runs (G,) at times (G,) since the first frame [s], linear between the frames.

    Beyond the ends of a run motion goes on: linearly for one frame, then with constant velocity and
    heading. Callers decide how far that is allowed.
    """
    out = Samples(np.empty((len(time), 3)), np.empty((len(time), 2)), np.empty(len(time)))
    _write_samples(recording, runs, run, time, np.arange(len(time)), out)
    return out


def _write_samples(
    recording: TrackSamples, runs: Runs, run: IntArray, time: FloatArray, at: IntArray, out: Samples
) -> None:
    """As `sample_runs`, into the rows `at` (G,) of `out`."""
    _sample(
        recording.time,
        recording.centers,
        recording.headings,
        recording.velocities,
        runs.first,
        runs.last,
        run,
        time,
        recording.period,
        at,
        out.poses,
        out.velocities,
        out.heights,
    )


@kernel
def _sample(
    row_time: FloatArray,
    centers: FloatArray,
    headings: FloatArray,
    velocities: FloatArray,
    firsts: IntArray,
    lasts: IntArray,
    runs: IntArray,
    times: FloatArray,
    period: float,
    at: IntArray,
    out_poses: FloatArray,
    out_velocities: FloatArray,
    out_heights: FloatArray,
) -> None:
    """Write boxes at times (G,) of runs (G,) to rows `at`; the others are as in `TrackSamples`."""
    for number in range(len(times)):
        run, time, index = runs[number], times[number], at[number]
        first, last = firsts[run], lasts[run]
        row = first + np.searchsorted(row_time[first : last + 1], time + _EPS, side="right") - 1
        row = min(max(row, first), max(last - 1, first))
        following = min(row + 1, last)
        span = row_time[following] - row_time[row] if following > row else period
        share = (time - row_time[row]) / span
        reach = period / span
        linear = min(max(share, -reach), 1.0 + reach)
        inside = min(max(share, 0.0), 1.0)
        beyond = (share - linear) * span  # s
        end = row if share < 0 else following
        for axis in range(2):
            place = centers[row, axis] + linear * (centers[following, axis] - centers[row, axis])
            out_poses[index, axis] = place + beyond * velocities[end, axis]
            change = velocities[following, axis] - velocities[row, axis]
            out_velocities[index, axis] = velocities[row, axis] + inside * change
        out_heights[index] = centers[row, 2] + linear * (centers[following, 2] - centers[row, 2])
        turn = wrap_angle(headings[following] - headings[row])
        out_poses[index, 2] = wrap_angle(headings[row] + linear * turn)


def rows_between(first_s: FloatArray, last_s: FloatArray) -> tuple[IntArray, IntArray]:
    """First and last 20 Hz row of time spans; first > last where one lies between two rows."""
    first = np.ceil(first_s / ROW_S - _EPS).astype(np.int64)
    return first, np.floor(last_s / ROW_S + _EPS).astype(np.int64)


def run_token(recording: TrackSamples, runs: Runs, run: int) -> str:
    """Track token of a run: the track id; a presence after a long hole is a track of its own."""
    number = int(runs.number[run])
    name = str(recording.track_ids[runs.track[run]])
    return f"{name}_{number + 1}" if number else name


def resample(
    recording: TrackSamples,
    runs: Runs,
    *,
    log_name: str,
    city: str,
    offset: FloatArray,
    padding_s: float = 0.0,
) -> Recording:
    """A whole recording at 20 Hz in UTM, every run a track.

    `offset` (2,) is the UTM of the local origin [m]; the first `padding_s` are made up before the
    first frame, with constant velocity.
    """
    padding = rows_of(padding_s)
    num_rows = int(np.floor(recording.duration / ROW_S + _EPS)) + 1 + padding
    first, last = rows_between(recording.time[runs.first], recording.time[runs.last])
    first = np.where(recording.frame[runs.first] == 0, -padding, first)
    kept = np.flatnonzero(last >= first)
    kept = kept[np.lexsort((kept, first[kept]))]  # tracks in the order of appearance
    kinds = recording.kinds[runs.track[kept]]
    shape = num_rows, len(kept)
    valid = np.zeros(shape, np.bool_)
    out = Samples(np.full((*shape, 3), np.nan), np.full((*shape, 2), np.nan), np.empty(shape))
    flat = Samples(out.poses.reshape(-1, 3), out.velocities.reshape(-1, 2), out.heights.ravel())
    for start in range(-padding, num_rows - padding, _BLOCK_ROWS):  # more would need more memory
        low = np.maximum(first[kept], start)
        counts = np.maximum(np.minimum(last[kept] + 1, start + _BLOCK_ROWS) - low, 0)
        column = np.repeat(np.arange(len(kept)), counts)
        row = np.arange(len(column)) + np.repeat(low - np.cumsum(counts) + counts, counts)
        at = (row + padding) * len(kept) + column
        valid.ravel()[at] = True
        _write_samples(recording, runs, kept[column], row * ROW_S, at, flat)
    out.poses[..., :2] += offset
    out.velocities[:, kinds > LAST_AGENT_KIND] = np.nan
    sizes = np.where(valid[..., None], recording.sizes[runs.track[kept], :2], np.nan)
    tokens = tuple(run_token(recording, runs, run) for run in kept.tolist())
    tracks = Tracks(valid, out.poses, out.velocities, sizes, kinds, tokens)
    times = recording.start_us + (np.arange(num_rows) - padding) * ROW_US
    return Recording(log_name, city, times, tracks, TrafficLights.empty(num_rows))


def ego_trace(
    recording: TrackSamples,
    runs: Runs,
    run: int,
    *,
    log_name: str,
    offset: FloatArray,
    first_row: int,
    last_row: int,
    padding: int = 0,
) -> EgoTrace:
    """States of a run as the ego: the Pacifica's box centre on the recorded one.

    `offset` (2,) is the UTM of the local origin [m]. The rows first_row … last_row - 1 are wanted;
    they count from the first of the `padding` rows made up before the first frame.
    """
    ends = recording.time[[runs.first[run], runs.last[run]]]
    begin, end = rows_between(ends[:1], ends[1:])
    low = min(int(begin[0]) + padding, first_row)
    high = max(int(end[0]) + 1 + padding, last_row)
    times = np.arange(low - padding, high - padding).astype(np.float64) * ROW_S
    samples = sample_runs(recording, runs, np.full(len(times), run, np.int64), times)
    states = ego_states(samples.poses, samples.velocities)
    states[:, :2] += offset
    kept = np.ascontiguousarray(states[first_row - low : last_row - low])
    return EgoTrace(log_name, run_token(recording, runs, run), first_row, kept)


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
    """Savitzky-Golay first derivative of values (R,), `dt` seconds apart.

    Second order, 11 samples; the ends by the last fit.
    """
    half = min(_HALF_WINDOW, (len(values) - 1) // 2)
    if half == 0:
        return np.gradient(values, dt) if len(values) > 1 else np.zeros(len(values))
    offsets = np.arange(-half, half + 1.0)
    weights = offsets / (offsets @ offsets)
    out = np.empty(len(values))
    out[half : len(values) - half] = np.convolve(values, weights[::-1], mode="valid")
    fit = np.linalg.pinv(np.vander(offsets, min(3, len(offsets)), increasing=True))
    for part, where in (
        (values[: 2 * half + 1], slice(0, half)),
        (values[-2 * half - 1 :], slice(len(values) - half, len(values))),
    ):
        _, rate, bend = fit @ part
        at = offsets[:half] if where.start == 0 else offsets[half + 1 :]
        out[where] = rate + 2.0 * bend * at
    return out / dt
