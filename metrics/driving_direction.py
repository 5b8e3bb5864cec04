"""Driving direction: how far the ego goes back along its lane within a short window."""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.metrics import kernels_progress
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Statistic, Violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.metrics.thresholds import Thresholds
from shiftsim.world.map import VectorMap

NAME = "driving_direction_compliance"


def lane_progress(road: VectorMap, route: EdgeLists, centers: FloatArray) -> FloatArray:
    """(K,) progress of the centres (K, 3) along the baseline of their edge since the last [m]."""
    out = np.empty(len(centers))
    kernels_progress.progress_in_lane(road.baselines, route.edges, route.counts, centers, out)
    return out


def windowed(progress: FloatArray, time_us: IntArray, horizon: float) -> FloatArray:
    """(K,) sum of the progress over the samples of the last `horizon` seconds [m]."""
    # nuPlan: truncated division, then one sample more than that (nuplan-metrics.md §13 Q2)
    steps = int(horizon * 1e6 / float(np.mean(np.diff(time_us))))
    padded = np.concatenate([np.zeros(steps), progress])
    sums: FloatArray = np.lib.stride_tricks.sliding_window_view(padded, steps + 1).sum(axis=1)
    return sums


def judge(progress: FloatArray, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Score 1, 0.5 or 0 by the largest regress within a window."""
    horizon = thresholds.driving_direction_horizon
    sums = windowed(progress, time_us, horizon)
    lowest = float(sums.min())
    regress = abs(lowest)
    score = 0.0
    if regress < thresholds.driving_direction_compliance:
        score = 1.0
    elif regress < thresholds.driving_direction_violation:
        score = 0.5
    violation = None
    if score < 1.0:
        at = int(np.argmax(-sums >= thresholds.driving_direction_compliance))
        violation = Violation(at, int(time_us[at]), None, float(-sums[at]))
    seconds = f"{horizon:g}"
    return MetricPart(
        MetricRow(
            NAME, score, regress, "meters", thresholds.driving_direction_compliance, violation
        ),
        (
            Statistic(NAME, f"{NAME}_score", "value", "VALUE", score),
            Statistic(
                NAME,
                f"min_progress_along_driving_direction_in_{seconds}_second_interval",
                "meters",
                "MIN",
                -regress,
            ),
        ),
        Series(f"progress_along_driving_direction_in_last_{seconds}_seconds_[m]", sums),
    )
