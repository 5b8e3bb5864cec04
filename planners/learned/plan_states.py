"""Plans of learned planners: poses every 0.1 s, with the velocities that nuPlan gives them.

The LQR tracker reads the poses only; perfect tracking reads the rest too.
"""

import numpy as np

from shiftsim.kernels import FloatArray
from shiftsim.sim.planner import History
from shiftsim.world.state import AY, HEADING, NUM_STATE, VX, Trajectory

STEP = 0.1  # s, between poses of a plan
_WINDOW = np.arange(-2, 3)  # samples of the derivative filter, a parabola through five
_SLOPE = _WINDOW / 10.0
_BEND = (_WINDOW**2 - 2.0) / 7.0


def plan_of_poses(poses: FloatArray, history: History) -> Trajectory:
    """The present state followed by a plan.

    Velocities and accelerations are derivatives of history and plan together, taken on the uneven
    past and on the plan resampled at the last interval of the past (nuPlan rule 390).

    Args:
        poses: (H, 3) rear axle x [m], y [m], heading [rad] in the map frame, 0.1 s apart, from
            0.1 s after the present on; at least 4.
        history: The last samples, the present one included.

    Returns:
        (H + 1) states with log time stamps.
    """
    past_s = np.asarray(history.time_us * 1e-6, np.float64)
    times = np.arange(0.0, len(poses) * STEP - STEP / 2.0, STEP) + STEP + past_s[-1]
    states = np.zeros((len(poses) + 1, NUM_STATE))
    states[0] = history.ego[-1]
    states[1:, :3] = poses
    states[1:, VX : AY + 1] = _motion(history.ego[:, :3], past_s, states[:, :3], times)
    time_us = np.empty(len(states), np.int64)
    time_us[0] = history.time_us[-1]
    time_us[1:] = times * 1e6  # nuPlan rule 391: truncated, a microsecond may be lost
    return Trajectory(time_us, states)


def _motion(
    past: FloatArray, past_s: FloatArray, planned: FloatArray, times: FloatArray
) -> FloatArray:
    """(H, 4) velocity and acceleration of a plan, each forward and to the right (not left).

    Of poses (N, 3) at times (N,) in the past, and (H + 1, 3) planned, the present one first, at
    times (H,) behind it [s].
    """
    now = past_s[-1]
    step = now - past_s[-2] if len(past) > 1 else STEP
    count = int(np.ceil((times[-1] + 1e-6 - now) / step)) - 1
    if count < len(_WINDOW):  # after a gap in the recording
        step, count = STEP, len(times)
    grid = now + step * np.arange(1, count + 1)
    even = _interpolate(grid, np.concatenate([[now], times]), planned)
    samples = np.concatenate([past[:, :2], even[:, :2]])
    spacing = (grid[-1] - past_s[0]) / (len(samples) - 1)
    index = np.arange(len(past), len(samples))
    center = np.clip(index, 2, len(samples) - 3)  # the first and last window serve their ends
    window = samples[center[:, None] + _WINDOW] - samples[center, None]
    bend = np.einsum("k,nkc->nc", _BEND, window) / spacing**2
    ahead = (index - center)[:, None] * spacing
    slope = np.einsum("k,nkc->nc", _SLOPE, window) / spacing + bend * ahead
    cos, sin = np.cos(even[:, HEADING]), np.sin(even[:, HEADING])
    parts = []
    for x, y in (slope.T, bend.T):
        parts += [x * cos + y * sin, x * sin - y * cos]  # nuPlan rule 392
    return _interpolate(times, grid, np.stack(parts, axis=1))


def _interpolate(at: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Rows of `values` between the knots; the outer steps go on beyond their ends."""
    after = np.clip(np.searchsorted(knots, at), 1, len(knots) - 1)
    before = after - 1
    along = (at - knots[before]) / (knots[after] - knots[before])
    return values[before] + along[:, None] * (values[after] - values[before])
