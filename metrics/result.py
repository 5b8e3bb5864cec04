"""What a metric reports: rows, violations, statistics, series, and the result of a rollout."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray


class Violation(NamedTuple):
    """Where a bound is broken first."""

    iteration: int  # sample
    time_us: int  # its time stamp [us]
    partner: str | None  # token of the other track, or None
    value: float  # the value that breaks the bound, in the unit of the metric


def first_violation(broken: BoolArray, values: FloatArray, time_us: IntArray) -> Violation | None:
    """The first of the samples (K,) at which a bound is broken, with its value; None without."""
    if not broken.any():
        return None
    at = int(np.argmax(broken))
    return Violation(at, int(time_us[at]), None, float(values[at]))


class MetricRow(NamedTuple):
    """One metric of one rollout."""

    metric: str  # devkit metric name
    score: float | None  # in [0, 1]; None for a metric that is not scored
    value: float  # the number behind the score
    unit: str  # unit of value and threshold
    threshold: float | None  # bound on the value; None where there is none
    violation: Violation | None  # first violation, or None


class Statistic(NamedTuple):
    """One statistic with the name nuPlan gives it; booleans are 0 or 1."""

    metric: str
    name: str
    unit: str
    kind: str
    value: float


class Series(NamedTuple):
    """One value per sample, (K,), and its unit as nuPlan names it."""

    unit: str
    values: FloatArray


@dataclass(frozen=True, slots=True)
class MetricPart:
    """What one metric contributes to the result."""

    row: MetricRow
    statistics: tuple[Statistic, ...] = ()
    series: Series | None = None


class Collision(NamedTuple):
    """First contact of the ego with a track."""

    iteration: int  # sample
    time_us: int  # its time stamp [us]
    token: str  # the track
    kind: int  # its AgentKind code
    collision_type: str  # one of `COLLISION_TYPES`
    delta_v: float  # change of speed of two equal masses [m/s]
    at_fault: bool  # whether the ego is to blame
