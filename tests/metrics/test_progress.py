"""Progress along the expert's route and in the lane: kernels against slow versions, the borders."""

from types import SimpleNamespace

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds

from shiftsim.errors import MapError
from shiftsim.metrics import progress
from shiftsim.metrics.progress import Progress, evaluate, evaluate_direction, expert_chain, windowed
from shiftsim.metrics.result import NUPLAN, Thresholds, Violation
from shiftsim.metrics.route import EdgeLists
from shiftsim.world.layers import make_layer, make_polylines

TIMES = 1_000_000 + 100_000 * np.arange(30, dtype=np.int64)


def random_chain(rng: np.random.Generator, length: int) -> tuple[list, list]:
    """Areas that overlap a little or leave gaps, and a bent line through each."""
    areas, lines, x = [], [], 0.0
    for _ in range(length):
        width = rng.uniform(5.0, 20.0)
        areas.append(shapely.box(x, -6.0, x + width, 6.0))
        at = np.sort(rng.uniform(x - 2.0, x + width + 2.0, 4))
        lines.append(np.c_[at, rng.uniform(-3.0, 3.0, 4)])
        x += width + rng.uniform(-2.0, 2.0)
    return areas, lines


def along(line: np.ndarray, x: float, y: float) -> float:
    return shapely.LineString(line).project(shapely.Point(x, y))


def slow_progress(areas: list, lines: list, points: np.ndarray) -> list[float]:
    """Progress of every point over the one before along the areas in order."""
    at, previous, out = 0, along(lines[0], *points[0]), [0.0]
    for x, y in points[1:].tolist():
        inside = [n for n in range(at, len(areas)) if areas[n].contains(shapely.Point(x, y))]
        if not inside:
            out.append(0.0)
            continue
        here, there = inside[0], along(lines[inside[0]], x, y)
        if here == at:
            out.append(there - previous)
        else:
            rest = shapely.LineString(lines[at]).length - previous
            # each area that is passed over: from where the one before ends to where the next starts
            passed = sum(
                along(lines[n], *lines[n + 1][0]) - along(lines[n], *lines[n - 1][-1])
                for n in range(at + 1, here)
            )
            out.append(rest + passed + there - along(lines[here], *lines[at][-1]))
        at, previous = here, there
    return out


@given(seeds)
def test_progress_along_a_chain_is_that_of_a_slow_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    areas, lines = random_chain(rng, int(rng.integers(1, 6)))
    polygons = make_layer([str(n) for n in range(len(areas))], areas).polygons
    # forwards mostly, now and then beside the road or back
    x = np.cumsum(rng.uniform(-2.0, 12.0, 15))
    points = np.c_[x, rng.choice([0.0, 2.0, 50.0], 15, p=[0.5, 0.35, 0.15]), np.zeros(15)]
    chain, out = np.arange(len(areas)), np.empty(15)
    progress._progress_along(polygons, make_polylines(lines), chain, chain, points, out)
    np.testing.assert_allclose(out, slow_progress(areas, lines, points[:, :2]), atol=1e-9)


def slow_in_lane(lines: list, route: EdgeLists, points: np.ndarray) -> list[float]:
    """Progress of every point along the line of its first edge."""
    out, edge, previous = [], (route.at(0) or [-1])[0], None
    for sample, (x, y) in enumerate(points.tolist()):
        moved, edges = 0.0, route.at(sample)
        if edges and edges[0] != edge:
            edge, previous = edges[0], None
        elif edges:
            here = along(lines[edge], x, y)
            if previous is not None and here != 0.0:
                moved = here - previous
            previous = here
        out.append(moved)
    return out


@given(seeds)
def test_progress_in_the_lane_is_that_of_a_slow_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    _, lines = random_chain(rng, 3)
    # at an arc length of 0 nothing is known: most points must lie beyond the start of the lines
    x = 5.0 + np.cumsum(rng.uniform(-3.0, 6.0, 30))
    points = np.c_[x, rng.uniform(-4.0, 4.0, (30, 2))]
    edges = np.repeat(rng.integers(0, 3, 10), 3)
    edges[:9] = 0
    route = EdgeLists(edges[:, None], (rng.random(30) < 0.8).astype(np.int64))
    road = SimpleNamespace(baselines=make_polylines(lines))
    out = progress.lane_progress(road, route, points)
    np.testing.assert_allclose(out, slow_in_lane(lines, route, points[:, :2]), atol=1e-9)


def test_the_first_edge_of_all_is_met_anew_when_the_ego_starts_on_none() -> None:
    lines = make_polylines([np.array([[0.0, y], [90.0, y]]) for y in (0.0, 4.0)])
    route = EdgeLists(np.ones((4, 1), np.int64), np.array([0, 1, 1, 1]))
    points = np.c_[[5.0, 7.0, 10.0, 14.0], np.zeros((4, 2))]
    out = progress.lane_progress(SimpleNamespace(baselines=lines), route, points)
    assert out.tolist() == [0.0, 0.0, 0.0, 4.0]


def route_of(*lists: list[int]) -> EdgeLists:
    edges = np.full((len(lists), 3), 7)
    for row, found in zip(edges, lists, strict=True):
        row[: len(found)] = found
    return EdgeLists(edges, np.array([len(found) for found in lists]))


BLOCKS = SimpleNamespace(
    name="toy",
    block_of=np.array([0, 0, 1, 2, 1, 0, -1, -1]),
    edges=SimpleNamespace(ids=[f"e{index}" for index in range(8)]),
)


@pytest.mark.parametrize(
    ("lists", "chain"),
    [
        ([[0], [0], [2], [3]], [0, 2, 3]),
        ([[0], [1], [2]], [0, 2]),  # the second edge lies in the same block
        ([[0], [], [0], [2]], [0, 2]),
        ([[], [2], [0]], [2, 0]),
        ([[0], [2, 3], [3, 2], [2]], [0, 2]),  # shares an edge with the list before
        ([[0, 2], [2], [3]], [0, 3]),
        ([[2, 3], [3, 4], [4], [0]], [2, 0]),
        ([[2, 3], [2, 0], [3], [1]], [2, 1]),  # as does the third with the first
        ([[2], [3, 2], [3]], [2, 3]),
        ([[2], [3, 2], [3, 4]], [2, 3]),  # the last list that counted is the one to compare with
        ([[2], [4, 3]], [2]),  # the first edge of a list decides
        ([[0], [2], [0]], [0, 2, 0]),
        ([[0], [2], [5]], [0, 2, 5]),  # back in the first block
        ([[], []], []),
    ],
)
def test_the_chain_has_one_edge_for_each_block_that_is_entered(
    lists: list[list[int]], chain: list[int]
) -> None:
    assert expert_chain(BLOCKS, route_of(*lists)).tolist() == chain


def test_an_edge_without_a_block_is_named_only_when_it_matters() -> None:
    with pytest.raises(MapError, match="'e6' on the expert's route"):
        expert_chain(BLOCKS, route_of([0], [6]))
    assert expert_chain(BLOCKS, route_of([0], [0, 6])).tolist() == [0]


FLOOR = NUPLAN.score_progress
RATIOS = [
    (30.0, 60.0, 0.5),
    (60.0, 30.0, 1.0),
    (1.0, 1.0, 1.0),
    (0.5, 10.0, FLOOR / 10.0),
    (-FLOOR, 10.0, FLOOR / 10.0),
    (np.nextafter(-FLOOR, -3.0), 10.0, 0.0),
    (1.0, 0.0, 1.0),
]


@pytest.mark.parametrize(("ego", "expert", "ratio"), RATIOS)
def test_the_ratio_counts_little_progress_as_the_least(
    ego: float, expert: float, ratio: float
) -> None:
    along, making = evaluate(Progress(np.array([0.0, ego]), np.array([0.0, expert]), True), NUPLAN)
    assert along.row.score == along.row.value == pytest.approx(ratio, abs=1e-12)
    assert [s.value for s in along.statistics] == pytest.approx([expert, ego, ratio])
    assert along.series is not None
    assert making.row.score == making.statistics[0].value == float(ratio >= 0.2)
    assert making.row.value == along.row.value


@pytest.mark.parametrize(("ego", "score"), [(2.0, 1.0), (1.99, 0.0)])
def test_a_fifth_of_the_expert_is_progress(ego: float, score: float) -> None:
    own = Thresholds("x", score_progress=0.1)
    _, making = evaluate(Progress(np.array([ego]), np.array([10.0]), True), own)
    assert making.row.score == score


def test_without_a_route_the_ratio_is_one_and_the_ego_has_no_statistic() -> None:
    along, making = evaluate(Progress(np.array([-9.0]), np.array([0.0]), False), NUPLAN)
    assert along.row.score == making.row.score == 1.0
    assert [s.name.split("_")[0] for s in along.statistics] == ["expert", "ego"]
    assert "ratio" in along.statistics[1].name
    assert along.series is None


@pytest.mark.parametrize(
    ("step_us", "horizon", "more"),
    [(100_000, 1.0, 10), (100_000, 0.55, 5), (99_999, 1.0, 10), (100_001, 1.0, 9)],
)
def test_the_window_has_one_sample_more_than_steps(
    step_us: int, horizon: float, more: int, rng: np.random.Generator
) -> None:
    values = rng.normal(size=30)
    sums = windowed(values, 5 + step_us * np.arange(30), horizon)
    expected = [values[max(0, n - more) : n + 1].sum() for n in range(30)]
    np.testing.assert_allclose(sums, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("back", "score"),
    [(0.0, 1.0), (1.99, 1.0), (2.0, 0.5), (5.99, 0.5), (6.0, 0.0), (9.0, 0.0)],
)
def test_going_back_by_a_bound_breaks_it(back: float, score: float) -> None:
    values = np.zeros(30)
    values[12] = -back
    part = evaluate_direction(values, TIMES, NUPLAN)
    assert part.row.score == part.statistics[0].value == score
    assert part.row.value == back
    assert part.statistics[1].value == -back
    expected = Violation(12, int(TIMES[12]), None, back) if back >= 2.0 else None
    assert part.row.violation == expected
    assert part.series is not None
    assert part.series.values.tolist() == [-back if 12 <= n <= 22 else 0.0 for n in range(30)]
