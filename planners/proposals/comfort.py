"""The comfort test on driven proposals.

The filters are linear, so each is a matrix, made once.
"""

import functools
from typing import NamedTuple

import numpy as np

from shiftsim.geometry.fits import fit_weights
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.proposals.tracker import DT, SCORED
from shiftsim.world.state import AX, AY, HEADING

SIGNALS = ("lon_accel", "lat_accel", "jerk", "lon_jerk", "yaw_accel", "yaw_rate")
ROWS, COLUMNS, BLOCK, BAND = 44, 48, 4, 16  # of padded filters, see `Filters`
_SMOOTH, _BRIEFLY, _SLOPE, _SLOPE_OF_ANGLE, _BEND_OF_ANGLE = range(5)  # filters
# accelerations ahead, aside and of any direction, heading, two of them filtered once, then SIGNALS
_AHEAD, _ASIDE, _ANY, _TURN, _BRIEF_ANY, _BRIEF_AHEAD, _TESTED = range(7)
_STAGES = (  # what is filtered, by which filter, to what
    (_AHEAD, _SMOOTH, _TESTED),
    (_ASIDE, _SMOOTH, _TESTED + 1),
    (_ANY, _BRIEFLY, _BRIEF_ANY),
    (_BRIEF_ANY, _SLOPE, _TESTED + 2),
    (_AHEAD, _BRIEFLY, _BRIEF_AHEAD),
    (_BRIEF_AHEAD, _SLOPE, _TESTED + 3),
    (_TURN, _BEND_OF_ANGLE, _TESTED + 4),
    (_TURN, _SLOPE_OF_ANGLE, _TESTED + 5),
)


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
    """Savitzky-Golay filters as matrices: output = input @ matrix.

    Blocks of rows and columns that the processor takes at once; what is beyond 41 is zero.
    """

    matrices: FloatArray  # (5, 44, 48) those numbered above
    # (5, 11, 4, 16) the columns that the rows of a block reach, of the short filters
    bands: FloatArray
    starts: IntArray  # (5, 11) first of these columns


@functools.cache
def make_filters() -> Filters:
    """The filters; never changed."""
    # nuPlan rule 183: one parabola over the whole horizon, and 5 samples for the yaw signals,
    # because the length of the window is not passed on
    long = SCORED + 1
    windows = ((long, 2, 0), (8, 2, 0), (long, 2, 1), (5, 2, 1), (5, 3, 2))
    matrices = np.zeros((len(windows), ROWS, COLUMNS))
    for matrix, (window, degree, order) in zip(matrices, windows, strict=True):
        # inside the signal in the middle of a window, at its edges in the first or last window
        inside = fit_weights(window, degree, order, np.zeros(1))[0] / DT**order
        edges = fit_weights(window, degree, order) / DT**order
        for sample in range(long):
            first = min(max(sample - (window - 1) // 2, 0), long - window)
            is_edge = sample < window // 2 or sample >= long - window // 2
            row = edges[sample - first] if is_edge else inside
            matrix[first : first + window, sample] = row
    blocks = matrices.reshape(len(windows), -1, BLOCK, COLUMNS)
    starts = np.minimum((blocks != 0.0).any(axis=2).argmax(axis=2), COLUMNS - BAND)
    columns = starts[:, :, None, None] + np.arange(BAND)
    return Filters(matrices, np.take_along_axis(blocks, columns, axis=3), starts)


class Comfort(NamedTuple):
    """How P driven proposals feel."""

    signals: FloatArray  # (P, 6, 41) filtered signals named by `SIGNALS`
    is_within: BoolArray  # (P, 6) whether each stays strictly within its bounds
    score: FloatArray  # (P,) 1 where all do, else 0


def comfort(states: FloatArray, bounds: ComfortBounds) -> Comfort:
    """The comfort test of driven states (P, 41, 11)."""
    made = empty_comfort(states)
    feel(states, make_filters(), bounds, made)
    return made


def empty_comfort(states: FloatArray) -> Comfort:
    """Arrays for the comfort test of driven states (P, 41, 11)."""
    count, steps = states.shape[:2]
    return Comfort(
        np.empty((count, len(SIGNALS), steps)),
        np.empty((count, len(SIGNALS)), np.bool_),
        np.empty(count),
    )


@kernel
def feel(states: FloatArray, filters: Filters, bounds: ComfortBounds, made: Comfort) -> None:
    """Fill in the comfort test."""
    count = states.shape[1]
    highs = (
        bounds.lon_accel_max,
        bounds.lat_accel,
        bounds.jerk,
        bounds.lon_jerk,
        bounds.yaw_accel,
        bounds.yaw_rate,
    )
    signals, sums = np.zeros((_TESTED + len(highs), ROWS)), np.empty(COLUMNS)
    for row in range(len(states)):
        turn = 0.0
        for step in range(count):
            state = states[row, step]
            signals[_AHEAD, step], signals[_ASIDE, step] = state[AX], state[AY]
            magnitude = abs(state[AX]) if state[AY] == 0.0 else np.hypot(state[AX], state[AY])
            signals[_ANY, step] = magnitude
            if step > 0:
                change = state[HEADING] - states[row, step - 1, HEADING]
                turn -= 2.0 * np.pi * np.rint(change / (2.0 * np.pi))
            signals[_TURN, step] = state[HEADING] + turn
        for source, number, target in _STAGES:
            _filter(signals[source], filters, number, sums, signals[target])
        made.score[row] = 1.0
        for signal in range(len(highs)):
            low = bounds.lon_accel_min if signal == 0 else -highs[signal]
            within = True
            for step in range(count):
                value = signals[_TESTED + signal, step]
                within = within and low < value < highs[signal]
                made.signals[row, signal, step] = value
            made.is_within[row, signal] = within
            if not within:
                made.score[row] = 0.0


@kernel
def _filter(
    samples: FloatArray, filters: Filters, number: int, sums: FloatArray, out: FloatArray
) -> None:
    """Write samples (44,) times a matrix into `out` (44,), rounded to 8 decimals; the last 3 are 0.

    `sums` (48,) is scratch.
    """
    is_short = number != _SMOOTH and number != _SLOPE
    for row in range(ROWS):
        # nothing is left out where it would not be 0
        is_short = is_short and samples[row] - samples[row] == 0.0
    for column in range(COLUMNS):
        sums[column] = 0.0
    for block in range(filters.starts.shape[1]):
        row = BLOCK * block
        a, b, c, d = samples[row], samples[row + 1], samples[row + 2], samples[row + 3]
        if a == 0.0 and b == 0.0 and c == 0.0 and d == 0.0:
            continue
        start = filters.starts[number, block] if is_short else 0
        rows, part = filters.matrices[number, row : row + BLOCK], sums[start : start + COLUMNS]
        if is_short:
            rows = filters.bands[number, block]
        for column in range(min(rows.shape[1], len(part))):
            total = part[column] + a * rows[0, column] + b * rows[1, column]
            part[column] = total + c * rows[2, column] + d * rows[3, column]
    for column in range(ROWS):
        out[column] = np.rint(sums[column] * 1e8) / 1e8
