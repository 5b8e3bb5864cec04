"""Closed-loop metrics and the score of one rollout, from its arrays and the map alone.

`compute_metrics` is `judge(measure(log, road), thresholds)`: the geometry is measured once, and any
number of threshold profiles can be applied to it.
"""

from collections.abc import Sequence

from shiftsim.metrics.custom import CustomMetric, add_metrics, load_metric
from shiftsim.metrics.result import Collision, MetricRow, Series, Statistic, Violation
from shiftsim.metrics.score import (
    MULTIPLIERS,
    SHORT_NAMES,
    WEIGHTS,
    Measurements,
    MetricResult,
    judge,
    measure,
)
from shiftsim.metrics.thresholds import DEEPPLAN, NUPLAN, PROFILES, Thresholds, thresholds_of
from shiftsim.sim.log import SimulationLog
from shiftsim.world.map import VectorMap

METRIC_VERSION = "1"  # raised with any change of a definition

__all__ = [
    "DEEPPLAN",
    "METRIC_VERSION",
    "MULTIPLIERS",
    "NUPLAN",
    "PROFILES",
    "SHORT_NAMES",
    "WEIGHTS",
    "Collision",
    "CustomMetric",
    "Measurements",
    "MetricResult",
    "MetricRow",
    "Series",
    "Statistic",
    "Thresholds",
    "Violation",
    "add_metrics",
    "compute_metrics",
    "judge",
    "load_metric",
    "measure",
    "thresholds_of",
]


def compute_metrics(
    log: SimulationLog,
    road: VectorMap,
    *,
    thresholds: str | Thresholds = "nuplan",
    own: Sequence[str | CustomMetric] = (),
) -> MetricResult:
    """Score one rollout as nuPlan does.

    Args:
        log: The rollout.
        road: Map it was driven on.
        thresholds: Profile name, or thresholds of your own.
        own: Metrics of your own, as callables or `module:attribute`; they are reported in
            `extra` and never enter the score.

    Raises:
        DataError: The rollout is too short or not finite.
        MapError: The map is such that nuPlan's own code stops.
    """
    result = judge(measure(log, road), thresholds)
    return add_metrics(result, log, road, own) if own else result


if __name__ == "metrics":  # pragma: no cover
    raise ImportError("import it as shiftsim.metrics")
