"""Speed limit: how much, and for how long, the ego is too fast."""

import numpy as np

from shiftsim.errors import MapError
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.metrics.result import MetricPart, MetricRow, Series, Thresholds, first_violation
from shiftsim.metrics.route import EdgeLists, Lanes, lanes_of
from shiftsim.world.map import VectorMap

NAME = "speed_limit_compliance"
_MIN_OVERSPEED = 1e-3  # m/s, nuPlan: floor of the threshold


def overspeed(map: VectorMap, route: EdgeLists, speed: FloatArray) -> FloatArray:
    """(K,) speed above the limit of the edges the ego is in, 0 where there is none [m/s].

    Raises:
        MapError: The ego is on a connector without neighbours, where nuPlan's own code stops too.
    """
    limits = np.empty(len(speed))
    failed = _speed_limits(lanes_of(map), map.speed_limits, route, limits)
    if failed >= 0:
        raise MapError(
            f"map {map.name!r}: connector {route.ids(map, failed)[0]!r} leads from and to no "
            "lane, so no speed limit holds on it",
            "connect it to its lanes; nuPlan cannot score the scenario either",
        )
    over = speed - limits
    return np.where(over > 0.0, over, 0.0)  # NaN: no limit


def evaluate(over: FloatArray, time_us: IntArray, thresholds: Thresholds) -> MetricPart:
    """Score by the over-speed integrated over the rollout."""
    score, violation = 1.0, first_violation(over > 0.0, over, time_us)
    if violation is not None:
        seconds = time_us * 1e-6
        duration = float(seconds[-1] - seconds[0])
        worst = max(thresholds.max_overspeed, _MIN_OVERSPEED) * duration
        if duration > 0.0:
            # nuPlan rule 76: K terms in the sum, K - 1 intervals in the duration
            loss = float(np.sum(over)) * float(np.mean(np.diff(seconds)))
            score = max(0.0, 1.0 - loss / worst)
    highest = float(over.max())
    row = MetricRow(NAME, score, highest, "meters_per_second", thresholds.max_overspeed, violation)
    is_kept = (NAME, "boolean", "BOOLEAN", violation is None)
    series = Series("over_speeding[meters_per_second]", over)
    return MetricPart.of(row, is_kept, *_violations(over, time_us), series=series)


def _violations(over: FloatArray, time_us: IntArray) -> list[tuple[str, str, str, float]]:
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
    # nuPlan rule 77: a single violation at the last sample lasts no time: 0 / 0
    weighted = sum(m * d for m, d in zip(means, durations, strict=True))
    mean = weighted / total if total > 0 else float("nan")
    unit = "meters_per_second"
    return [
        (f"number_of_violations_of_{NAME}", "count", "COUNT", len(peaks)),
        (f"max_violation_of_{NAME}", unit, "MAX", max(peaks)),
        (f"min_violation_of_{NAME}", unit, "MIN", min(peaks)),
        (f"mean_violation_of_{NAME}", unit, "MEAN", mean),
    ]


@kernel
def _speed_limits(lanes: Lanes, limits: FloatArray, route: EdgeLists, out: FloatArray) -> int:
    """Write the speed limit (K,) that holds at each sample, NaN where there is none [m/s].

    `limits` (E,) are those of the edges, NaN where missing; `route` (K, C) are the edges of the ego
    centre. Returns -1, or the first sample on connectors that have no neighbour at all.
    """
    lists, counts = route.edges, route.counts
    for i in range(len(counts)):
        out[i] = np.nan
        if counts[i] == 0:
            continue
        if lists[i, 0] < lanes.num_lanes:
            limit = limits[lists[i, 0]]
            out[i] = limit if limit != 0.0 else np.nan
            continue
        # nuPlan rule 78: a connector has the highest limit of its neighbours, not its own
        highest, found, missing = -np.inf, 0, False
        for index in range(counts[i]):
            edge = lists[i, index]
            for side in range(2):
                lists_of = lanes.incoming if side == 0 else lanes.outgoing
                for item in range(lists_of.ptr[edge], lists_of.ptr[edge + 1]):
                    limit = limits[lists_of.items[item]]
                    missing = missing or np.isnan(limit) or limit == 0.0
                    highest = max(highest, limit)
                    found += 1
        if found == 0:
            return i
        out[i] = np.nan if missing else highest
    return -1
