"""From measurements to scores: thresholds, metrics in nuPlan's order, and the weighted sum."""

from collections.abc import Mapping
from dataclasses import dataclass

from shiftsim.metrics import (
    collision,
    comfort,
    drivable_area,
    driving_direction,
    lane_change,
    progress,
    speed_limit,
    time_to_collision,
)
from shiftsim.metrics.measurements import Measurements
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Statistic
from shiftsim.metrics.thresholds import Thresholds, thresholds_of

MULTIPLIERS = (
    "no_ego_at_fault_collisions",
    "drivable_area_compliance",
    "ego_is_making_progress",
    "driving_direction_compliance",
)
WEIGHTS = {
    "ego_progress_along_expert_route": 5.0,
    "time_to_collision_within_bound": 5.0,
    "speed_limit_compliance": 4.0,
    "ego_is_comfortable": 2.0,
}
SHORT_NAMES = {
    "no_ego_at_fault_collisions": "NCR",
    "drivable_area_compliance": "DAC",
    "ego_is_making_progress": "EMP",
    "driving_direction_compliance": "DDC",
    "ego_progress_along_expert_route": "PER",
    "time_to_collision_within_bound": "TTC",
    "speed_limit_compliance": "SLC",
    "ego_is_comfortable": "EIC",
    "score": "CLS",
}


@dataclass(frozen=True, slots=True)
class MetricResult:
    """Everything nuPlan says about one rollout under one threshold profile.

    Attributes:
        score: Closed-loop score in [0, 1].
        scores: Score by devkit metric name, None for metrics without one; always the same order.
        rows: One row per metric, in the same order.
        statistics: Named statistics, grouped by metric.
        series: One value per sample, by metric.
        thresholds: Name of the threshold profile.
        measurements: Routes, collisions, signals and distances behind the scores.
        extra: Rows of the user's own metrics; they never enter the score.
    """

    score: float
    scores: dict[str, float | None]
    rows: tuple[MetricRow, ...]
    statistics: tuple[Statistic, ...]
    series: dict[str, Series]
    thresholds: str
    measurements: Measurements
    extra: tuple[MetricRow, ...] = ()


def judge(measurements: Measurements, thresholds: str | Thresholds = "nuplan") -> MetricResult:
    """Apply one threshold profile to a measured rollout."""
    profile = thresholds_of(thresholds)
    parts = _parts(measurements, profile)
    scores = {part.row.metric: part.row.score for part in parts}
    return MetricResult(
        score=closed_loop_score(scores),
        scores=scores,
        rows=tuple(part.row for part in parts),
        statistics=tuple(statistic for part in parts for statistic in part.statistics),
        series={part.row.metric: part.series for part in parts if part.series is not None},
        thresholds=profile.name,
        measurements=measurements,
    )


def closed_loop_score(scores: Mapping[str, float | None]) -> float:
    """Product of the multipliers times the weighted mean of the other metrics.

    A metric without a score is left out of numerator and weights; one that is not listed has
    weight 1 (nuplan-metrics.md §1).
    """
    product, total, weights = 1.0, 0.0, 0.0
    for metric, score in scores.items():
        if score is None:
            continue
        if metric in MULTIPLIERS:
            product *= score
        else:
            weight = WEIGHTS.get(metric, 1.0)
            total += weight * score
            weights += weight
    return product * (total / weights if weights > 0.0 else 0.0)


def _parts(m: Measurements, profile: Thresholds) -> list[MetricPart]:
    signals, comfortable = comfort.judge(m.comfort, m.time_us, profile)
    along, making = progress.judge(m.progress, profile)
    area, corners = drivable_area.judge(m.drivable, m.time_us, profile)
    return [
        lane_change.judge(m.lanes, m.time_us, profile),
        *signals,
        along,
        area,
        corners,
        collision.judge(m.collisions, profile),
        time_to_collision.judge(m.ttc, m.time_us, profile),
        speed_limit.judge(m.overspeed, m.time_us, profile),
        comfortable,
        making,
        driving_direction.judge(m.lane_progress, m.time_us, profile),
    ]
