"""Plans of learned planners: poses every 0.1 s, with the velocities that nuPlan gives them.

The LQR tracker reads the poses only; perfect tracking reads the rest too.
"""

import numpy as np

from shiftsim import state
from shiftsim.arrays import FloatArray, kernel
from shiftsim.planner import History
from shiftsim.state import NUM_STATE, Trajectory

STEP = 0.1  # s, between poses of a plan
_HALF = 2  # half window of the derivative filter: five samples, second order


def plan_of_poses(poses: FloatArray, history: History) -> Trajectory:
    """The present state followed by a plan.

    nuPlan: velocities and accelerations are derivatives of history and plan together, taken on the
    uneven past and on the plan resampled at the last interval of the past; their lateral parts
    point to the right (planner-plantf.md §4).

    Args:
        poses: (H, 3) rear axle x [m], y [m], heading [rad] in the map frame, 0.1 s apart, from
            0.1 s after the present on.
        history: The last samples, the present one included.

    Returns:
        (H + 1) states with log time stamps.
    """
    present = history.time_us[-1] * 1e-6
    times = np.arange(0.0, len(poses) * STEP - STEP / 2.0, STEP) + STEP + present
    states = np.zeros((len(poses) + 1, NUM_STATE))
    states[0] = history.ego[-1]
    states[1:, :3] = poses
    _fill_motion(history.ego, history.time_us * 1e-6, times, states)
    time_us = np.empty(len(states), np.int64)
    time_us[0] = history.time_us[-1]
    time_us[1:] = times * 1e6  # nuPlan: truncated, a microsecond may be lost
    return Trajectory(time_us, states)


@kernel
def _fill_motion(past: FloatArray, past_s: FloatArray, times: FloatArray, out: FloatArray) -> None:
    """Write velocities and accelerations of the plan into rows 1… of `out` (H + 1, 11)."""
    count = len(past)
    step = past_s[-1] - past_s[-2] if count > 1 else STEP
    planned = int(np.ceil((times[-1] + 1e-6 - past_s[-1]) / step)) - 1
    total = count + planned
    samples, seconds = np.empty((total, 3)), np.empty(total)
    samples[:count], seconds[:count] = past[:, :3], past_s
    for index in range(planned):
        seconds[count + index] = past_s[-1] + (index + 1) * step
        _interpolate(past_s[-1], times, out, seconds[count + index], samples[count + index])
    spacing = (seconds[-1] - seconds[0]) / (total - 1)
    motion = np.empty((planned, 4))
    for index in range(planned):
        _derive(samples, count + index, spacing, motion[index])
    for index in range(len(times)):
        _interpolate_motion(seconds[count:], motion, times[index], out[index + 1])


@kernel
def _interpolate(
    start: float, times: FloatArray, states: FloatArray, now: float, out: FloatArray
) -> None:
    """Pose between the states at `start` and `times`; the last step goes on beyond its end."""
    after = min(max(int(np.searchsorted(times, now)), 0), len(times) - 1)
    before = start if after == 0 else times[after - 1]
    along = (now - before) / (times[after] - before)
    for column in range(3):
        first, last = states[after, column], states[after + 1, column]
        out[column] = first + along * (last - first)


@kernel
def _derive(samples: FloatArray, index: int, spacing: float, out: FloatArray) -> None:
    """Velocity and acceleration, forward and to the right, of a parabola through five samples."""
    center = max(min(index, len(samples) - 1 - _HALF), _HALF)
    ahead = (index - center) * spacing
    slope, bend = np.zeros(2), np.zeros(2)
    for axis in range(2):
        for k in range(-_HALF, _HALF + 1):
            value = samples[center + k, axis] - samples[center, axis]
            slope[axis] += k * value / (10.0 * spacing)
            bend[axis] += (k * k - 2.0) * value / (7.0 * spacing * spacing)
        slope[axis] += bend[axis] * ahead
    cos, sin = np.cos(samples[index, 2]), np.sin(samples[index, 2])
    out[0] = slope[0] * cos + slope[1] * sin
    out[1] = slope[0] * sin - slope[1] * cos  # nuPlan: positive to the right
    out[2] = bend[0] * cos + bend[1] * sin
    out[3] = bend[0] * sin - bend[1] * cos


@kernel
def _interpolate_motion(
    seconds: FloatArray, motion: FloatArray, now: float, out: FloatArray
) -> None:
    """Motion at a time; the first and the last step go on beyond their ends."""
    if len(seconds) < 2:
        out[state.VX : state.AY + 1] = motion[0]
        return
    after = min(max(int(np.searchsorted(seconds, now)), 1), len(seconds) - 1)
    along = (now - seconds[after - 1]) / (seconds[after] - seconds[after - 1])
    for column in range(4):
        first, last = motion[after - 1, column], motion[after, column]
        out[state.VX + column] = first + along * (last - first)
