"""What must not matter: where the world lies, the order of tracks, what is far away."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from json_worlds import read_world
from rollouts import WORLDS, boxes, load_world, move_world, with_tracks
from strategies import OFFSETS, rigid_motions, seeds
from worlds import join_tracks

from shiftsim.metrics import MetricResult, compute_metrics

LOADED = {path.stem: load_world(path) for path in WORLDS}
worlds = st.sampled_from(sorted(LOADED))


@cache
def plain(name: str) -> MetricResult:
    return compute_metrics(*read_world(LOADED[name]))


def assert_same(result: MetricResult, other: MetricResult, *, without: str = "") -> None:
    for metric, score in other.scores.items():
        if score is not None and metric != without:
            # coordinates near 4e6 m are spaced 5e-10 m
            assert result.scores[metric] == pytest.approx(score, abs=1e-6), metric
    ours = [(c.time_us, c.token, c.collision_type) for c in result.measurements.collisions]
    theirs = [(c.time_us, c.token, c.collision_type) for c in other.measurements.collisions]
    assert sorted(ours) == sorted(theirs)


@given(worlds, rigid_motions(), st.sampled_from(OFFSETS))
def test_scores_do_not_depend_on_where_the_world_lies(
    name: str, motion: tuple[float, float, float], offset: tuple[float, float]
) -> None:
    angle, dx, dy = motion
    moved = move_world(LOADED[name], angle, dx + offset[0], dy + offset[1])
    result = compute_metrics(*read_world(moved))
    assert_same(result, plain(name))
    assert result.score == pytest.approx(plain(name).score, abs=1e-6)


@given(worlds)
def test_a_mirrored_world_scores_the_same(name: str) -> None:
    mirrored = compute_metrics(*read_world(move_world(LOADED[name], 0.0, 0.0, 0.0, mirror=True)))
    # the centre acceleration adds the yaw acceleration with its sign: comfort is not symmetric
    assert_same(mirrored, plain(name), without="ego_is_comfortable")


@given(worlds, seeds)
def test_the_order_of_tracks_does_not_matter(name: str, seed: int) -> None:
    log, road = read_world(LOADED[name])
    order = np.random.default_rng(seed).permutation(log.tracks.num_tracks)
    result = compute_metrics(with_tracks(log, log.tracks.select(order)), road)
    assert_same(result, plain(name))
    assert result.score == plain(name).score


@given(worlds, st.floats(-np.pi, np.pi), st.floats(1e3, 1e5))
def test_a_far_track_changes_nothing(name: str, angle: float, distance: float) -> None:
    log, road = read_world(LOADED[name])
    x, y = log.ego[0, 0] + distance * np.cos(angle), log.ego[0, 1] + distance * np.sin(angle)
    far = boxes(len(log.time_us), (x, y, angle), velocity=(3.0, 4.0))
    result = compute_metrics(with_tracks(log, join_tracks([log.tracks, far])), road)
    assert result.scores == plain(name).scores
    assert result.score == plain(name).score
    assert result.statistics == plain(name).statistics


@given(worlds, seeds)
def test_scores_stay_between_zero_and_one(name: str, seed: int) -> None:
    log, road = read_world(LOADED[name])
    log.ego[:] += np.random.default_rng(seed).normal(size=log.ego.shape) * 0.5
    result = compute_metrics(log, road)
    assert all(0.0 <= s <= 1.0 for s in result.scores.values() if s is not None)
    assert 0.0 <= result.score <= 1.0


@pytest.mark.parametrize("path", WORLDS, ids=lambda path: path.stem)
def test_measuring_changes_neither_rollout_nor_map(path: Path) -> None:
    log, road = read_world(LOADED[path.stem])
    before = (log.ego.copy(), log.tracks.poses.copy(), road.edges.polygons.xy.copy())
    compute_metrics(log, road)
    for kept, now in zip(before, (log.ego, log.tracks.poses, road.edges.polygons.xy), strict=True):
        np.testing.assert_array_equal(kept, now)
