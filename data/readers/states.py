"""A recording at 20 Hz, and the states of its egos."""

import numpy as np

from shiftsim.data.readers.samples import (
    ROW_S,
    ROW_US,
    Runs,
    TrackSamples,
    rows_between,
    rows_of,
    sample_run,
)
from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.kernels import FloatArray
from shiftsim.world import state
from shiftsim.world.state import LAST_AGENT_KIND, PACIFICA, Tracks, TrafficLights

_HALF_WINDOW = 5  # rows on each side of a derivative: 0.55 s in all, second order


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

    `offset` (2,) is the UTM of the local origin [m]; the first `padding_s` lie before the
    first frame, with constant velocity.
    """
    padding = rows_of(padding_s)
    num_rows = int(np.floor(recording.duration / ROW_S + 1e-9)) + 1 + padding
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
        boxes = sample_run(recording, runs, run, row * ROW_S)
        valid[row + padding, column] = True
        poses[row + padding, column] = boxes.poses
        sizes[row + padding, column] = recording.sizes[runs.track[run], :2]
        if kinds[column] <= LAST_AGENT_KIND:
            velocities[row + padding, column] = boxes.velocities
    poses[..., :2] += offset
    tokens = tuple(run_token(recording, runs, run) for run in present.tolist())
    tracks = Tracks(valid, poses, velocities, sizes, kinds, tokens)
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
    they count from the first of the `padding` rows before the first frame.
    """
    ends = recording.time[[runs.first[run], runs.last[run]]]
    begin, end = rows_between(ends[:1], ends[1:])
    low = min(int(begin[0]) + padding, first_row)
    high = max(int(end[0]) + 1 + padding, last_row)
    times = np.arange(low - padding, high - padding).astype(np.float64) * ROW_S
    boxes = sample_run(recording, runs, run, times)
    states = ego_states(boxes.poses, boxes.velocities)
    states[:, :2] += offset
    wanted = np.ascontiguousarray(states[first_row - low : last_row - low])
    return EgoTrace(log_name, run_token(recording, runs, run), first_row, wanted)


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
