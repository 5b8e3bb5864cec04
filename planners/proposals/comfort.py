"""The comfort test on driven proposals.

The filters are linear, so each is a matrix, made once.
"""

import functools
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, kernel, lean_kernel
from shiftsim.planners.proposals.tracker import DT, SCORED
from shiftsim.world.state import AX, AY, HEADING

SIGNALS = ("lon_accel", "lat_accel", "jerk", "lon_jerk", "yaw_accel", "yaw_rate")


class ComfortBounds(NamedTuple):
    """Open intervals of the comfort test; the last four are symmetric."""

    lon_accel_min: float = -4.05  # m/s^2
    lon_accel_max: float = 2.40  # m/s^2
    lat_accel: float = 4.89  # m/s^2
    jerk: float = 8.37  # m/s^3
    lon_jerk: float = 4.13  # m/s^3
    yaw_accel: float = 1.93  # rad/s^2
    yaw_rate: float = 0.95  # rad/s


class Filters(NamedTuple):
    """Savitzky-Golay filters as matrices (41, 41): output = input @ filter."""

    smooth: FloatArray
    smooth_briefly: FloatArray
    slope: FloatArray
    slope_of_angle: FloatArray
    bend_of_angle: FloatArray


@functools.cache
def make_filters() -> Filters:
    """The filters; never changed."""
    from scipy.signal import savgol_filter

    def matrix(window: int, order: int, derivative: int = 0) -> FloatArray:
        samples = np.eye(SCORED + 1)
        made = savgol_filter(samples, window, order, deriv=derivative, delta=DT, axis=-1)
        return np.ascontiguousarray(made)

    # nuPlan rule 183: one parabola over the whole horizon, and 5 samples for the yaw signals,
    # because the length of the window is not passed on
    long = SCORED + 1
    return Filters(
        matrix(long, 2), matrix(8, 2), matrix(long, 2, 1), matrix(5, 2, 1), matrix(5, 3, 2)
    )


class Comfort(NamedTuple):
    """How P driven proposals feel."""

    signals: FloatArray  # (P, 6, 41) filtered signals named by `SIGNALS`
    is_within: BoolArray  # (P, 6) whether each stays strictly within its bounds


def comfort(states: FloatArray, bounds: ComfortBounds) -> Comfort:
    """The comfort test of driven states (P, 41, 11)."""
    count, steps = states.shape[:2]
    made = Comfort(
        np.empty((count, len(SIGNALS), steps)), np.empty((count, len(SIGNALS)), np.bool_)
    )
    _comfort(states, make_filters(), bounds, made)
    return made


@kernel
def _comfort(states: FloatArray, filters: Filters, bounds: ComfortBounds, made: Comfort) -> None:
    count = states.shape[1]
    raw, brief = np.empty((4, count)), np.empty(count)
    highs = (
        bounds.lon_accel_max,
        bounds.lat_accel,
        bounds.jerk,
        bounds.lon_jerk,
        bounds.yaw_accel,
        bounds.yaw_rate,
    )
    for row in range(len(states)):
        turn = 0.0
        for step in range(count):
            state = states[row, step]
            raw[0, step], raw[1, step] = state[AX], state[AY]
            raw[2, step] = np.hypot(state[AX], state[AY])
            if step > 0:
                change = state[HEADING] - states[row, step - 1, HEADING]
                turn -= 2.0 * np.pi * np.rint(change / (2.0 * np.pi))
            raw[3, step] = state[HEADING] + turn
        out = made.signals[row]
        _filter(raw[0], filters.smooth, out[0])
        _filter(raw[1], filters.smooth, out[1])
        _filter(raw[2], filters.smooth_briefly, brief)
        _filter(brief, filters.slope, out[2])
        _filter(raw[0], filters.smooth_briefly, brief)
        _filter(brief, filters.slope, out[3])
        _filter(raw[3], filters.bend_of_angle, out[4])
        _filter(raw[3], filters.slope_of_angle, out[5])
        for signal in range(6):
            low = bounds.lon_accel_min if signal == 0 else -highs[signal]
            within = True
            for step in range(count):
                within = within and low < out[signal, step] < highs[signal]
            made.is_within[row, signal] = within


@lean_kernel
def _filter(samples: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Write samples @ matrix into `out`, rounded to 8 decimals."""
    for column in range(len(out)):
        out[column] = 0.0
    for row in range(len(samples)):
        value = samples[row]
        if value != 0.0:
            for column in range(len(out)):
                out[column] += value * matrix[row, column]
    for column in range(len(out)):
        out[column] = np.rint(out[column] * 1e8) / 1e8
