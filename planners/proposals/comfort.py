"""The comfort test of PDM-Closed on driven proposals (pdm-closed.md §8.7).

The filters are linear, so each is a matrix, made once. Windows are nuPlan's: 41 samples mean one
parabola over the whole horizon, 5 samples for the yaw signals because the length is not passed on.
"""

import functools
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, kernel, lean_kernel
from shiftsim.planners.pdm.parameters import DT, SCORED, ComfortBounds
from shiftsim.world.state import AX, AY, HEADING

SIGNALS = ("lon_accel", "lat_accel", "jerk", "lon_jerk", "yaw_accel", "yaw_rate")


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

    long = SCORED + 1
    return Filters(
        matrix(long, 2), matrix(8, 2), matrix(long, 2, 1), matrix(5, 2, 1), matrix(5, 3, 2)
    )


@kernel
def comfort(
    states: FloatArray,
    filters: Filters,
    bounds: ComfortBounds,
    signals: FloatArray,
    is_comfortable: BoolArray,
) -> None:
    """Filtered signals of P driven proposals, and whether they stay within the bounds.

    Args:
        states: (P, 41, 11) driven states.
        filters: The filters.
        bounds: The bounds.
        signals: (P, 6, 41) receives the signals named by `SIGNALS`.
        is_comfortable: (P, 6) receives whether each stays strictly within its bounds.
    """
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
        out = signals[row]
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
            is_comfortable[row, signal] = within


@lean_kernel
def _filter(samples: FloatArray, matrix: FloatArray, out: FloatArray) -> None:
    """Write samples @ matrix into `out`, rounded to 8 decimals as nuPlan does."""
    for column in range(len(out)):
        out[column] = 0.0
    for row in range(len(samples)):
        value = samples[row]
        if value != 0.0:
            for column in range(len(out)):
                out[column] += value * matrix[row, column]
    for column in range(len(out)):
        out[column] = np.rint(out[column] * 1e8) / 1e8
