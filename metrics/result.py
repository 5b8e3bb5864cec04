"""What a metric reports: rows, violations, statistics, series, and the result of a rollout."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray


class Violation(NamedTuple):
    """Where a bound is broken first.

    Attributes:
        iteration: Sample.
        time_us: Its time stamp [us].
        partner: Token of the other track, or None.
        value: The value that breaks the bound, in the unit of the metric.
    """

    iteration: int
    time_us: int
    partner: str | None
    value: float


def first_violation(broken: BoolArray, values: FloatArray, time_us: IntArray) -> Violation | None:
    """The first of the samples (K,) at which a bound is broken, with its value; None without."""
    if not broken.any():
        return None
    at = int(np.argmax(broken))
    return Violation(at, int(time_us[at]), None, float(values[at]))


class MetricRow(NamedTuple):
    """One metric of one rollout.

    Attributes:
        metric: Devkit metric name.
        score: In [0, 1]; None for a metric that is not scored.
        value: The number behind the score.
        unit: Unit of value and threshold.
        threshold: Bound on the value; None where there is none.
        violation: First violation, or None.
    """

    metric: str
    score: float | None
    value: float
    unit: str
    threshold: float | None
    violation: Violation | None


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
    """First contact of the ego with a track.

    Attributes:
        iteration: Sample.
        time_us: Its time stamp [us].
        token: The track.
        kind: Its AgentKind code.
        collision_type: One of `COLLISION_TYPES`.
        delta_v: Change of speed of two equal masses [m/s].
        at_fault: Whether the ego is to blame.
    """

    iteration: int
    time_us: int
    token: str
    kind: int
    collision_type: str
    delta_v: float
    at_fault: bool
