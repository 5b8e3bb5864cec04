"""Comfort: seven smoothed or differentiated signals, and six bounds on them.

Savitzky-Golay filters with `mode="interp"`: interior samples are weighted sums over a window, the
first and last half windows lie on the polynomial fitted to the first or last window. Signals
shorter than the window lie on one fit altogether.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.errors import DataError
from shiftsim.geometry.fits import Filter, filter_signal, make_filter
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.metrics.result import (
    MetricPart,
    MetricRow,
    Series,
    Thresholds,
    Violation,
    first_violation,
)
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    NUM_STATE,
    VX,
    YAW_ACCEL,
    YAW_RATE,
    center_accelerations,
)

NAME = "ego_is_comfortable"
MIN_SAMPLES = 4  # the yaw acceleration is a cubic fit
_YAW_WINDOW = 5  # samples
# samples, degree and derivative of filters: smooth, jerk, yaw rate, yaw acceleration
_FILTERS = ((8, 2, 0), (15, 2, 1), (_YAW_WINDOW, 2, 1), (_YAW_WINDOW, 3, 2))


class ComfortSignals(NamedTuple):
    """Processed signals of one rollout, all (K,)."""

    lon_accel: FloatArray  # smoothed longitudinal acceleration at the centre [m/s^2]
    lat_accel: FloatArray  # smoothed lateral acceleration at the centre [m/s^2]
    mag_accel: FloatArray  # smoothed magnitude of the acceleration at the rear axle [m/s^2]
    lon_jerk: FloatArray  # derivative of `lon_accel` [m/s^3]
    mag_jerk: FloatArray  # derivative of `mag_accel` [m/s^3]
    yaw_rate: FloatArray  # first derivative of the heading [rad/s]
    yaw_accel: FloatArray  # second derivative of the heading [rad/s^2]


# What is bounded, in nuPlan's order: devkit metric name, signal, unit; as that of `bounds_of`.
_BOUNDED = (
    ("ego_jerk", "mag_jerk", "meters_per_second_cubed"),
    ("ego_lat_acceleration", "lat_accel", "meters_per_second_squared"),
    ("ego_lon_acceleration", "lon_accel", "meters_per_second_squared"),
    ("ego_lon_jerk", "lon_jerk", "meters_per_second_cubed"),
    ("ego_yaw_acceleration", "yaw_accel", "radians_per_second_squared"),
    ("ego_yaw_rate", "yaw_rate", "radians_per_second"),
)
BOUNDED_SIGNALS = {metric: signal for metric, signal, _ in _BOUNDED}
_UNITS = {metric: unit for metric, _, unit in _BOUNDED}


def comfort_signals(time_us: IntArray, states: FloatArray) -> ComfortSignals:
    """The seven signals of states (K, 11) at times (K,) [us], rounded to 8 decimals as nuPlan does.

    Raises:
        DataError: There are fewer than 4 samples, or the stamps do not increase.
    """
    if len(time_us) < MIN_SAMPLES:
        raise DataError(
            f"{len(time_us)} samples are too few for the comfort metrics, which fit cubics to "
            f"{MIN_SAMPLES} of them",
            f"simulate at least {MIN_SAMPLES + 1} iterations",
        )
    steps = np.diff(time_us / 1e6)
    if not (steps > 0.0).all():
        at = int(np.flatnonzero(~(steps > 0.0))[0]) + 1
        raise DataError(f"time stamps of the rollout do not increase at sample {at}")
    step = float(np.mean(steps))
    center = np.ascontiguousarray(center_accelerations(states).T)
    # nuPlan rule 80: magnitudes are taken at the rear axle, components at the centre
    magnitude = np.sqrt(states[:, AX] ** 2 + states[:, AY] ** 2)
    smooth, jerk, yaw_rate, yaw_accel = filters_of(len(time_us))
    lon, lat, mag = (_filtered(v, smooth, 1.0) for v in (*center, magnitude))
    heading = unwrap(states[:, HEADING])
    return ComfortSignals(
        lon_accel=lon,
        lat_accel=lat,
        mag_accel=mag,
        lon_jerk=_filtered(lon, jerk, step),
        mag_jerk=_filtered(mag, jerk, step),
        yaw_rate=_filtered(heading, yaw_rate, step),
        yaw_accel=_filtered(heading, yaw_accel, step**2),
    )


def derived_states(time_us: IntArray, poses: FloatArray) -> FloatArray:
    """(K, 11) states of rear-axle poses (K, 3) at times (K,) [us]; steering is not known: 0.

    Positions go through a filter of window 5 and degree 2, whose derivatives are turned into the
    heading, as nuPlan's planners of networks do; yaw rates are those of the metrics above.
    """
    step, count = float(np.mean(np.diff(time_us / 1e6))), len(poses)
    window, turned = min(_YAW_WINDOW, count), np.exp(-1j * poses[:, HEADING])
    states = np.zeros((count, NUM_STATE))
    states[:, :3] = poses
    for column, order in ((VX, 1), (AX, 2)):
        how, scale = make_filter(window, 2, order), step**order
        x, y = (_filtered(poses[:, axis] - poses[0, axis], how, scale) for axis in (0, 1))
        along = (x + 1j * y) * turned
        states[:, column], states[:, column + 1] = along.real, along.imag
    heading, (_, _, yaw_rate, yaw_accel) = unwrap(poses[:, HEADING]), filters_of(count)
    states[:, YAW_RATE] = _filtered(heading, yaw_rate, step)
    states[:, YAW_ACCEL] = _filtered(heading, yaw_accel, step**2)
    return states


def bounds_of(thresholds: Thresholds) -> list[tuple[float, float]]:
    """Lower and upper bound of each entry of `BOUNDED_SIGNALS`."""
    t = thresholds
    return [
        (-t.max_abs_mag_jerk, t.max_abs_mag_jerk),
        (-t.max_abs_lat_accel, t.max_abs_lat_accel),
        (t.min_lon_accel, t.max_lon_accel),
        (-t.max_abs_lon_jerk, t.max_abs_lon_jerk),
        (-t.max_abs_yaw_accel, t.max_abs_yaw_accel),
        (-t.max_abs_yaw_rate, t.max_abs_yaw_rate),
    ]


def within_bounds(signals: ComfortSignals, thresholds: Thresholds) -> list[bool]:
    """Whether each entry of `BOUNDED_SIGNALS` stays strictly within its bounds throughout."""
    bounded = (getattr(signals, name) for name in BOUNDED_SIGNALS.values())
    return [
        bool(((low < values) & (values < high)).all())
        for values, (low, high) in zip(bounded, bounds_of(thresholds), strict=True)
    ]


def evaluate(
    signals: ComfortSignals, time_us: IntArray, thresholds: Thresholds
) -> tuple[list[MetricPart], MetricPart]:
    """The six unscored signals in the order of `BOUNDED_SIGNALS`, and the comfort score."""
    series = {metric: getattr(signals, name) for metric, name in BOUNDED_SIGNALS.items()}
    values, bounds = np.array([*series.values()]), np.array(bounds_of(thresholds))
    low, high = bounds[:, :1], bounds[:, 1:]
    broken = ~((low < values) & (values < high))
    worst = np.argmin(np.minimum(values - low, high - values), axis=1)
    nearest = values[np.arange(len(values)), worst]
    extremes = values.max(axis=1), values.min(axis=1)
    figures = np.array([nearest, *extremes, values.mean(axis=1), _percentiles_90(values)])
    is_broken: list[bool] = np.logical_or.reduce(broken, axis=1).tolist()
    parts = []
    for index, (metric, signal) in enumerate(series.items()):
        violation = first_violation(broken[index], signal, time_us) if is_broken[index] else None
        numbers = figures[:, index].tolist()
        parts.append(_part(metric, signal, bounds[index].tolist(), numbers, violation))
    violations = [part.row.violation for part in parts if part.row.violation is not None]
    score = float(not violations)
    first = min(violations, key=lambda violation: violation.iteration, default=None)
    row = MetricRow(NAME, score, float(len(violations)), "count", 0.0, first)
    return parts, MetricPart.of(row, (NAME, "boolean", "BOOLEAN", score))


def _part(
    metric: str,
    values: FloatArray,
    bounds: list[float],
    figures: list[float],  # the value nearest to a bound; largest, smallest, mean, 90th percentile
    violation: Violation | None,
) -> MetricPart:
    (low, high), (value, *others), unit = bounds, figures, _UNITS[metric]
    nearest = low if value - low < high - value else high
    row = MetricRow(metric, None, value, unit, nearest, violation)
    kinds = (("max", "MAX"), ("min", "MIN"), ("avg", "MEAN"), ("p90", "P90"))
    return MetricPart.of(
        row,
        *((f"{n}_{metric}", unit, kind, v) for (n, kind), v in zip(kinds, others, strict=True)),
        (f"abs_{metric}_within_bounds", "boolean", "BOOLEAN", violation is None),
        series=Series(unit, values),
    )


def _percentiles_90(values: FloatArray) -> FloatArray:
    """The 90th percentile of rows by numpy's method `closest_observation`, not interpolated."""
    rank = values.shape[1] * 0.9 - 1.5
    below = int(np.floor(rank))
    # nuPlan rule 82: an exact tie goes to the even rank, as in the numpy 1.26 that nuPlan pins
    tie = rank == below and below % 2 == 0
    found: FloatArray = np.sort(values, axis=1)[:, max(0, below if tie else below + 1)]
    return found


def unwrap(angles: FloatArray) -> FloatArray:
    """Angles (..., K) without turns of 2 pi between neighbours."""
    turns = np.cumsum(np.rint(np.diff(angles) / (2.0 * np.pi)), axis=-1)
    out = np.array(angles, np.float64)
    out[..., 1:] -= 2.0 * np.pi * turns
    return out


def filters_of(count: int) -> list[Filter]:
    """Those of `_FILTERS`, of signals with so many samples."""
    return [make_filter(min(window, count), *order) for window, *order in _FILTERS]


def _filtered(values: FloatArray, how: Filter, scale: float) -> FloatArray:
    out = np.empty(len(values))
    filter_signal(values, how, scale, out)
    return out
