"""How sure a mean is: cluster bootstrap, paired randomisation test, Holm's correction.

Scenarios of one recording overlap in time and share traffic, so they are not independent; the
recordings are. Everything here therefore draws or flips whole recordings ("clusters").
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.kernels import FloatArray, IntArray
from shiftsim.report.groups import Group
from shiftsim.report.tables import Interval

DRAWS = 10_000
SEED = 20_260_101  # of every draw here, so that a report can be repeated to the digit
CONFIDENCE = 0.95
FEW_CLUSTERS = 20  # below, percentile intervals are known to be too narrow
_BLOCK = 500  # draws held in memory at once
_EXACT_CLUSTERS = 13  # up to here all 2^G sign patterns are fewer than DRAWS


def score_interval(group: Group, name: str = "cls") -> Interval | None:
    """Bootstrap interval of a group's score; None unless complete and of several recordings."""
    values = group.scenario_means(name)
    if not len(values) or not np.isfinite(values).all():
        return None
    return bootstrap_interval(100.0 * values, cluster_codes(group.data.recordings))


def cluster_codes(clusters: Sequence[str]) -> IntArray:
    """(S,) number of every scenario's recording, from 0 on."""
    return np.unique(np.asarray(clusters, dtype=str), return_inverse=True)[1].astype(np.int64)


def bootstrap_interval(
    values: FloatArray, clusters: IntArray, *, draws: int = DRAWS
) -> Interval | None:
    """Percentile interval of the mean of values (S,), clusters drawn; None with fewer than two."""
    sums, sizes = np.bincount(clusters, values), np.bincount(clusters).astype(np.float64)
    count = len(sums)
    if count < 2:
        return None
    rng = np.random.default_rng(SEED)
    means = []
    for size in _blocks(draws):
        drawn = rng.multinomial(count, np.full(count, 1.0 / count), size=size).astype(np.float64)
        means.append((drawn @ sums) / (drawn @ sizes))
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(np.concatenate(means), [tail, 1.0 - tail])
    return Interval(float(low), float(high))


def _blocks(draws: int) -> list[int]:
    """Sizes of the parts in which so many samples are drawn."""
    return [min(_BLOCK, draws - start) for start in range(0, draws, _BLOCK)]


class Comparison(NamedTuple):
    """Two planners on the same scenarios."""

    difference: float  # mean of first minus second
    interval: Interval | None  # of that mean; None with fewer than two clusters
    p_value: float  # two-sided, that the sign of every recording's difference is a toss of a coin
    smallest_p: float  # the smallest value the test can give with so few recordings
    wins: int  # scenarios on which the first is better
    ties: int  # scenarios on which both are equal
    losses: int  # scenarios on which the first is worse


def compare(first: FloatArray, second: FloatArray, clusters: IntArray) -> Comparison:
    """Compare (S,) scores of two planners on the same scenarios, of the recordings `clusters`."""
    delta = first - second
    interval, tested = bootstrap_interval(delta, clusters), sign_flip_test(delta, clusters)
    counts = (int(np.sum(which)) for which in (delta > 0.0, delta == 0.0, delta < 0.0))
    return Comparison(float(delta.mean()), interval, *tested, *counts)


def forest(found: Sequence[Comparison]) -> list[str]:
    """A forest plot, line by line: the axis, then mean and interval of each, beside a zero line."""
    bars = [one.interval or Interval(one.difference, one.difference) for one in found]
    reach = 10.0 * max(1.0, np.ceil(max(max(-bar.low, bar.high) for bar in bars) / 10.0))

    def x(value: float) -> str:
        return f"{100.0 + 95.0 * value / reach:.1f}"

    ticks = ((-reach, "start"), (0.0, "middle"), (reach, "end"))
    words = (f'<text x="{x(at)}" y="11" text-anchor="{side}">{at:g}</text>' for at, side in ticks)
    lines = ["".join(words).replace(">-", ">−")]
    for one, bar in zip(found, bars, strict=True):
        low, mean, high = map(x, (bar.low, one.difference, bar.high))
        lines.append(
            f'<path d="M100-2V18"/><path d="M{low} 8H{high}"/><circle cx="{mean}" cy="8" r="4"/>'
        )
    return [
        f'<svg class="forest" viewBox="0 0 200 16" aria-hidden="true">{one}</svg>' for one in lines
    ]


def sign_flip_test(
    delta: FloatArray, clusters: IntArray, *, draws: int = DRAWS
) -> tuple[float, float]:
    """Two-sided p-value of a mean difference by signs of whole clusters, and the smallest one."""
    sums = np.bincount(clusters, delta)
    observed = abs(float(sums.sum()))
    # sums that differ by rounding alone are as extreme as the observed one
    bound = observed - 1e-12 * max(1.0, float(np.abs(sums).sum()))
    if len(sums) <= _EXACT_CLUSTERS:
        patterns = np.arange(2 ** len(sums))[:, None] >> np.arange(len(sums))
        flipped = np.abs(((patterns & 1) * 2.0 - 1.0) @ sums)
        return float(np.mean(flipped >= bound)), float(2.0 ** (1 - len(sums)))
    rng = np.random.default_rng(SEED)
    count = 0
    for size in _blocks(draws):
        signs = rng.integers(0, 2, size=(size, len(sums))) * 2.0 - 1.0
        count += int(np.sum(np.abs(signs @ sums) >= bound))
    return (count + 1.0) / (draws + 1.0), 1.0 / (draws + 1.0)


def rank_correlation(first: FloatArray, second: FloatArray) -> float | None:
    """Spearman's correlation of (S,) values; None for fewer than three, or constant ones."""
    if len(first) < 3 or np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return None
    from scipy.stats import spearmanr

    return float(spearmanr(first, second).statistic)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: p-values that may all be compared with one level."""
    values = np.asarray(p_values, np.float64)
    order = np.argsort(values, kind="stable")
    out = np.zeros(len(values))
    scaled = np.minimum(1.0, (len(values) - np.arange(len(values))) * values[order])
    out[order] = np.maximum.accumulate(scaled)
    return out.tolist()
