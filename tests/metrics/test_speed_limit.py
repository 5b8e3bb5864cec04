"""Which limit holds where, what it costs to exceed it, and the statistics of the violations."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from strategies import seeds

from shiftsim.errors import MapError
from shiftsim.metrics.result import NUPLAN, Thresholds, Violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.metrics.speed_limit import NAME, evaluate, overspeed
from shiftsim.world.layers import make_lists, make_polygons

LANES, EDGES = 4, 8
TIMES = 1_000_000 + 100_000 * np.arange(11, dtype=np.int64)
LIMITS = np.array([10.0, 20.0, np.nan, 0.0, 99.0, 99.0, np.nan, 99.0])


def road(into: list[list[int]], out: list[list[int]]) -> SimpleNamespace:
    ids = [f"e{index}" for index in range(EDGES)]
    edges = SimpleNamespace(polygons=make_polygons([]), ids=ids)
    lists = {"incoming": make_lists(into), "outgoing": make_lists(out)}
    return SimpleNamespace(edges=edges, num_lanes=LANES, speed_limits=LIMITS, name="toy", **lists)


def slow_limit(edges: list[int], into: list[list[int]], out: list[list[int]]) -> float:
    """The limit at a sample, infinite without; nothing where nuPlan stops."""
    if not edges:
        return np.inf
    asked = edges[:1] if edges[0] < LANES else [n for e in edges for n in into[e] + out[e]]
    limits = LIMITS[asked]
    return np.inf if (np.isnan(limits) | (limits == 0.0)).any() else limits.max()


@given(seeds)
def test_limits_are_those_of_a_slow_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    into, out = (
        [rng.choice([0, 1, 1, 2, 3], rng.integers(0, 3)).tolist() for _ in range(EDGES)]
        for _ in range(2)
    )
    for edge in range(LANES, EDGES):
        into[edge].append(int(rng.integers(0, 2)))
    first = rng.integers(0, EDGES, 30)
    counts = rng.integers(0, 4, 30)
    # lanes come alone, connectors in company
    others = rng.integers(LANES, EDGES, (30, 2))
    counts[(first < LANES) & (counts > 1)] = 1
    route = EdgeLists(np.c_[first, others], counts)
    speed = rng.choice([0.0, 10.0, 15.0, 20.0, 120.0], 30)
    expected = [
        max(0.0, v - slow_limit(route.at(n), into, out)) for n, v in enumerate(speed.tolist())
    ]
    assert overspeed(road(into, out), route, speed).tolist() == expected


def test_the_first_connector_without_neighbours_is_named() -> None:
    lonely: list[list[int]] = [[] for _ in range(EDGES)]
    route = EdgeLists(np.array([[0, 0], [5, 6], [6, 5]]), np.array([1, 2, 2]))
    with pytest.raises(MapError, match="connector 'e5' leads"):
        overspeed(road(lonely, lonely), route, np.zeros(3))
    out = [[1] for _ in range(EDGES)]
    assert not overspeed(road(lonely, out), route, np.zeros(3)).any()
    assert not overspeed(road(out, lonely), route, np.zeros(3)).any()


def test_two_violations_are_told_apart_and_weighed_by_their_time() -> None:
    over = np.array([0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.0, 0.0])
    part = evaluate(over, TIMES, NUPLAN)
    assert part.row.violation == Violation(1, int(TIMES[1]), None, 1.0)
    assert part.row.value == 3.0
    assert part.row.score == pytest.approx(1.0 - 5.5 * 0.1 / (2.23 * 1.0), abs=1e-9)
    of = f"violation_of_{NAME}"
    assert {s.name: pytest.approx(s.value) for s in part.statistics} == {
        NAME: 0.0,
        f"number_of_violations_of_{NAME}": 2.0,
        f"max_{of}": 3.0,
        f"min_{of}": 0.5,
        f"mean_{of}": (2.0 * 0.2 + 0.5 * 0.3) / 0.5,
    }


@pytest.mark.parametrize(
    ("last", "mean"), [((1.0, 0.0, 3.0), 1.0), ((0.0, 2.0, 4.0), 3.0), ((0.0, 0.0, 5.0), np.nan)]
)
def test_a_violation_that_lasts_to_the_end_ends_at_the_last_sample(
    last: tuple[float, ...], mean: float
) -> None:
    over = np.array([0.0] * 8 + list(last))
    assert evaluate(over, TIMES, NUPLAN).statistics[-1].value == pytest.approx(mean, nan_ok=True)


def test_a_violation_from_the_start_is_one() -> None:
    part = evaluate(np.array([2.0, 2.0, *[0.0] * 9]), TIMES, NUPLAN)
    assert part.statistics[1].value == 1.0
    assert part.row.violation == Violation(0, int(TIMES[0]), None, 2.0)


@pytest.mark.parametrize(("allowed", "score"), [(2.0, 0.5), (1.0, 0.0), (0.0, 0.0), (4.0, 0.75)])
def test_the_loss_is_relative_to_the_allowed_excess(allowed: float, score: float) -> None:
    over = np.array([0.0, *[1.0] * 10])
    part = evaluate(over, TIMES, Thresholds("x", max_overspeed=allowed))
    assert part.row.score == pytest.approx(score, abs=1e-9)
    assert part.row.threshold == allowed


def test_without_any_allowance_the_smallest_counts() -> None:
    over = np.array([1e-4, *[0.0] * 10])
    part = evaluate(over, TIMES, Thresholds("x", max_overspeed=0.0))
    assert part.row.score == pytest.approx(1.0 - 1e-5 / 1e-3, abs=1e-9)


def test_a_rollout_without_duration_loses_nothing() -> None:
    part = evaluate(np.array([3.0]), TIMES[:1], NUPLAN)
    assert part.row.score == 1.0
    assert part.row.violation is not None


def test_no_violation_has_no_statistics_but_the_verdict() -> None:
    part = evaluate(np.zeros(11), TIMES, NUPLAN)
    assert part.row[:3] == (NAME, 1.0, 0.0)
    assert part.row.violation is None
    assert [s.value for s in part.statistics] == [1.0]
