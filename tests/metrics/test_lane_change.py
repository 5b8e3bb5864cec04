"""Lane changes on made-up lists of edges, against a slow version with sets."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from strategies import seeds

from shiftsim.metrics.lane_change import NAME, LaneChanges, evaluate, lane_changes
from shiftsim.metrics.result import NUPLAN
from shiftsim.metrics.route import EdgeLists
from shiftsim.world.layers import make_lists

EDGES = 6
TIMES = 1_000_000 + 100_000 * np.arange(40, dtype=np.int64)
FL, RL, RR, FR = range(4)


def shared_edges(
    corners: list[list[int]], into: list[list[int]], out: list[list[int]]
) -> list[int]:
    """Edges that hold all corners, or that connect theirs."""

    def extended(edges: list[int], neighbours: list[list[int]]) -> set[int]:
        return set(edges).union(*(neighbours[edge] for edge in edges))

    common = set.intersection(*map(set, corners))
    if common:
        return sorted(common)
    left, right = set(corners[RL]), set(corners[RR])
    if not (left & extended(corners[RR], out) or right & extended(corners[RL], out)):
        return []
    return sorted(
        extended(corners[RR], out)
        & extended(corners[FL], into)
        & extended(corners[FR], into)
        & extended(corners[RL], out)
    )


def slow_lane_changes(
    lists: list[list[list[int]]], into: list[list[int]], out: list[list[int]]
) -> tuple[list[int], list[tuple[int, int, bool]]]:
    """State of every sample, and opening sample, closing sample and failure of every change."""
    states, changes, opened, initial, before = [], [], None, [], []
    for sample, corners in enumerate(lists):
        empty = sum(not corner for corner in corners)
        shared = [] if empty else shared_edges(corners, into, out)
        state = len(shared) if shared else (0 if empty == 4 else -1)
        if opened is not None and state >= 0:
            came_back = {edge for start in initial for edge in (start, *out[start])} & set(shared)
            changes.append((opened, sample, state == 0 or bool(came_back)))
            opened = None
        elif opened is None and sample > 0 and state < 0 and states[-1] > 0:
            opened, initial = sample, before
        states.append(state)
        before = shared
    if opened is not None:
        changes.append((opened, len(lists) - 1, True))
    return states, changes


def random_lists(rng: np.random.Generator, samples: int) -> list[list[list[int]]]:
    """Edges of the four corners; neighbouring samples and corners resemble each other."""
    lists = []
    corners = [[0], [0], [0], [0]]
    for _ in range(samples):
        what = rng.random()
        if what < 0.1:
            corners = [[], [], [], []]
        elif what < 0.4:
            corners = [sorted(rng.choice(EDGES, rng.integers(1, 3), replace=False))] * 4
        else:
            corners = [
                corner
                if rng.random() < 0.6
                else sorted(rng.choice(EDGES, rng.integers(0, 4), replace=False).tolist())
                for corner in corners
            ]
        lists.append([[int(edge) for edge in corner] for corner in corners])
    return lists


def edge_lists(lists: list[list[list[int]]]) -> EdgeLists:
    counts = np.array([[len(corner) for corner in corners] for corners in lists], np.int64)
    edges = np.full((*counts.shape, 3), EDGES - 1, np.int64)
    for index in np.ndindex(counts.shape):
        edges[index][: counts[index]] = lists[index[0]][index[1]]
    return EdgeLists(edges, counts)


@given(seeds)
def test_states_and_changes_are_those_of_the_slow_version(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        out = [sorted(set(rng.choice(EDGES, rng.integers(0, 3)).tolist())) for _ in range(EDGES)]
        into = [[a for a in range(EDGES) if b in out[a]] for b in range(EDGES)]
        lists = random_lists(rng, int(rng.integers(1, 20)))
        road = SimpleNamespace(incoming=make_lists(into), outgoing=make_lists(out))
        found = lane_changes(road, edge_lists(lists))
        states, changes = slow_lane_changes(lists, into, out)
        assert found.states.tolist() == states
        assert found.is_common.tolist() == [state > 0 for state in states]
        rows = zip(found.start.tolist(), found.end.tolist(), found.failed.tolist(), strict=True)
        assert list(rows) == changes


def changes_of(*rows: tuple[int, int, bool]) -> LaneChanges:
    start, end, failed = zip(*rows, strict=True) if rows else ((), (), ())
    return LaneChanges(
        np.ones(40, np.int64),
        np.array(start, np.int64),
        np.array(end, np.int64),
        np.array(failed, np.bool_),
    )


def test_durations_and_the_share_that_failed_are_reported() -> None:
    part = evaluate(changes_of((3, 8, True), (10, 21, False), (30, 38, False)), TIMES, NUPLAN)
    assert part.row.value == pytest.approx(1.0 / 3.0)
    assert {s.name: pytest.approx(s.value) for s in part.statistics} == {
        f"number_of_{NAME}": 3.0,
        f"max_{NAME}_duration": 1.1,
        f"avg_{NAME}_duration": 0.8,
        f"ratio_of_failed_{NAME}": 1.0 / 3.0,
        f"{NAME}_fail_rate_below_threshold": 0.0,
    }


@pytest.mark.parametrize(("failed", "within"), [(3, 1.0), (4, 0.0)])
def test_a_failed_share_of_three_tenths_still_passes(failed: int, within: float) -> None:
    rows = [(n, n + 1, n < failed) for n in range(10)]
    assert evaluate(changes_of(*rows), TIMES, NUPLAN).statistics[-1].value == within


def test_no_change_at_all_passes_without_durations() -> None:
    part = evaluate(changes_of(), TIMES, NUPLAN)
    assert part.row.value == 0.0
    assert [s.value for s in part.statistics] == [0.0, 1.0]
