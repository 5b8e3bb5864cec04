"""The comfort test on driven proposals."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.fits import Filter, filter_signal, make_filter
from shiftsim.kernels import BoolArray, FloatArray, kernel
from shiftsim.planners.proposals.tracker import DT, SCORED
from shiftsim.world.state import AX, AY, HEADING

SIGNALS = ("lon_accel", "lat_accel", "jerk", "lon_jerk", "yaw_accel", "yaw_rate")


class ComfortBounds(NamedTuple):
    """Open intervals of the comfort test; the last five are symmetric."""

    lon_accel_min: float = -4.05  # m/s^2
    lon_accel_max: float = 2.40  # m/s^2
    lat_accel: float = 4.89  # m/s^2
    jerk: float = 8.37  # m/s^3
    lon_jerk: float = 4.13  # m/s^3
    yaw_accel: float = 1.93  # rad/s^2
    yaw_rate: float = 0.95  # rad/s


class Comfort(NamedTuple):
    """Comfort of P driven proposals."""

    signals: FloatArray  # (P, 6, 41) filtered signals named by `SIGNALS`
    is_within: BoolArray  # (P, 6) whether each stays strictly within its bounds
    score: FloatArray  # (P,) 1 where all do, else 0


def comfort(states: FloatArray, bounds: ComfortBounds) -> Comfort:
    """The comfort test of driven states (P, 41, 11)."""
    # nuPlan rule 183: one parabola over the whole horizon, and 5 samples for the yaw signals,
    # because the length of the window is not passed on
    whole = SCORED + 1
    windows = ((whole, 2, 0), (8, 2, 0), (whole, 2, 1), (5, 2, 1), (5, 3, 2))
    signals = np.empty((len(states), len(SIGNALS), whole))
    is_within = np.ones(signals.shape[:2], np.bool_)
    filters = tuple(make_filter(*window) for window in windows)
    _filter_signals(states, filters, np.array(bounds, np.float64), signals, is_within)
    return Comfort(signals, is_within, np.where(np.all(is_within, axis=1), 1.0, 0.0))


@kernel
def _filter_signals(
    states: FloatArray,
    filters: tuple[Filter, ...],
    bounds: FloatArray,  # (7,) those of `ComfortBounds`
    out: FloatArray,
    is_within: BoolArray,
) -> None:
    """Write the signals (P, 6, 41) of states, and where they leave their bounds."""
    count, (smooth, smooth_briefly, slope, turn_rate, turn_accel) = states.shape[1], filters
    raw, brief = np.empty((4, count)), np.empty(count)  # acceleration ahead, aside, any; heading
    for row in range(len(states)):
        turn, signals = 0.0, out[row]
        for step in range(count):
            ahead, aside = states[row, step, AX], states[row, step, AY]
            raw[0, step], raw[1, step], raw[2, step] = ahead, aside, np.hypot(ahead, aside)
            if step > 0:
                change = states[row, step, HEADING] - states[row, step - 1, HEADING]
                turn -= 2.0 * np.pi * np.rint(change / (2.0 * np.pi))
            raw[3, step] = states[row, step, HEADING] + turn
        filter_signal(raw[0], smooth, 1.0, signals[0])
        filter_signal(raw[1], smooth, 1.0, signals[1])
        filter_signal(raw[2], smooth_briefly, 1.0, brief)
        filter_signal(brief, slope, DT, signals[2])
        filter_signal(raw[0], smooth_briefly, 1.0, brief)
        filter_signal(brief, slope, DT, signals[3])
        filter_signal(raw[3], turn_accel, DT * DT, signals[4])
        filter_signal(raw[3], turn_rate, DT, signals[5])
        for number in range(len(signals)):
            high = bounds[1 + number]
            low = bounds[0] if number == 0 else -high
            for step in range(count):
                if not low < signals[number, step] < high:
                    is_within[row, number] = False
