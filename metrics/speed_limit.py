"""Speed limit: how much, and for how long, the ego is too fast."""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import MapError
from shiftsim.metrics import kernels_progress
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Statistic, Violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.metrics.thresholds import Thresholds
from shiftsim.world.map import VectorMap

NAME = "speed_limit_compliance"
_MIN_OVERSPEED = 1e-3  # m/s, nuPlan: floor of the threshold


def overspeed(road: VectorMap, route: EdgeLists, speed: FloatArray) -> FloatArray:
    """(K,) speed above the limit of the edges the ego is in, 0 where there is none [m/s].

    Raises:
        MapError: The ego is on a connector without neighbours, where nuPlan's own code stops too.
    """
    limits = np.empty(len(speed))
    failed = kernels_progress.speed_limits_along(
        road.num_lanes,
        road.incoming,
        road.outgoing,
        road.speed_limits,
        route.edges,
        route.counts,
        limits,
    )
    if failed >= 0:
        raise MapError(
            f"map {road.name!r}: connector {route.ids(road, failed)[0]!r} leads from and to no "
            "lane, so no speed limit holds on it",
            "connect it to its lanes; nuPlan cannot score the scenario either",
        )
    over = speed - limits
    return np.where(over > 0.0, over, 0.0)  # NaN: no limit


def judge(over: FloatArray, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Score by the over-speed integrated over the rollout."""
    score, violation = 1.0, None
    if (over > 0.0).any():
        at = int(np.argmax(over > 0.0))
        violation = Violation(at, int(time_us[at]), None, float(over[at]))
        seconds = time_us * 1e-6
        duration = float(seconds[-1] - seconds[0])
        worst = max(thresholds.max_overspeed, _MIN_OVERSPEED) * duration
        if duration > 0.0:
            # nuPlan: K terms in the sum, K - 1 intervals in the duration (§13 Q13)
            loss = float(np.sum(over)) * float(np.mean(np.diff(seconds)))
            score = max(0.0, 1.0 - loss / worst)
    highest = float(over.max())
    row = MetricRow(NAME, score, highest, "meters_per_second", thresholds.max_overspeed, violation)
    statistics = (
        Statistic(NAME, NAME, "boolean", "BOOLEAN", float(violation is None)),
        *_violations(over, time_us),
    )
    return MetricPart(row, statistics, Series("over_speeding[meters_per_second]", over))


def _violations(over: FloatArray, time_us: IntArray) -> list[Statistic]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], over > 0.0, [False]])))
    if len(edges) == 0:
        return []
    last = len(over) - 1
    peaks, means, durations = [], [], []
    for start, stop in edges.reshape(-1, 2).tolist():
        peaks.append(float(over[start:stop].max()))
        means.append(float(np.mean(over[start:stop])))
        durations.append(int(time_us[min(stop, last)] - time_us[start]))
    total = sum(durations)
    # a single violation at the last sample lasts no time: 0 / 0 (nuplan-metrics.md §14)
    weighted = sum(m * d for m, d in zip(means, durations, strict=True))
    mean = weighted / total if total > 0 else float("nan")
    unit = "meters_per_second"
    return [
        Statistic(NAME, f"number_of_violations_of_{NAME}", "count", "COUNT", float(len(peaks))),
        Statistic(NAME, f"max_violation_of_{NAME}", unit, "MAX", max(peaks)),
        Statistic(NAME, f"min_violation_of_{NAME}", unit, "MIN", min(peaks)),
        Statistic(NAME, f"mean_violation_of_{NAME}", unit, "MEAN", mean),
    ]
