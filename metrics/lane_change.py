"""Lane changes: counted and timed, never scored."""

import numpy as np

from shiftsim.arrays import IntArray
from shiftsim.metrics.result import MetricPart, MetricRow, Statistic
from shiftsim.metrics.route import LaneChanges
from shiftsim.metrics.thresholds import Thresholds

NAME = "ego_lane_change"


def judge(lanes: LaneChanges, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Number and duration of the lane changes, and the share that failed."""
    count = len(lanes.start)
    statistics = [Statistic(NAME, f"number_of_{NAME}", "count", "COUNT", float(count))]
    ratio = 0.0
    if count:
        durations = (time_us[lanes.end] - time_us[lanes.start]) * 1e-6
        ratio = float(lanes.failed.sum()) / count
        statistics += [
            Statistic(NAME, f"max_{NAME}_duration", "seconds", "MAX", float(durations.max())),
            Statistic(NAME, f"avg_{NAME}_duration", "seconds", "MEAN", float(np.mean(durations))),
            Statistic(NAME, f"ratio_of_failed_{NAME}", "ratio", "RATIO", ratio),
        ]
    within = ratio <= thresholds.max_lane_change_fail_rate
    name = f"{NAME}_fail_rate_below_threshold"
    statistics.append(Statistic(NAME, name, "boolean", "BOOLEAN", float(within)))
    bound = thresholds.max_lane_change_fail_rate
    return MetricPart(MetricRow(NAME, None, ratio, "ratio", bound, None), tuple(statistics))
