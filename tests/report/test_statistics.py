"""Intervals and tests against brute force and known cases."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shiftsim.report.groups import seed_deviation
from shiftsim.report.statistics import (
    bootstrap_interval,
    cluster_codes,
    compare,
    holm,
    rank_correlation,
    sign_flip_test,
)


def test_recordings_are_numbered_whatever_their_names():
    np.testing.assert_array_equal(cluster_codes(["b", "a", "b", "c"]), [1, 0, 1, 2])


def test_the_interval_agrees_with_every_possible_draw():
    values = np.array([0.0, 1.0, 0.5, 0.2, 0.9, 0.3])
    clusters = np.array([0, 0, 0, 1, 2, 2])
    means = []
    for drawn in itertools.product(range(3), repeat=3):
        means.append(np.concatenate([values[clusters == cluster] for cluster in drawn]).mean())

    found = bootstrap_interval(values, clusters)

    # each extreme has a probability of 1/27, more than the 2.5 % that are cut off
    assert found.low == pytest.approx(min(means), abs=1e-12)
    assert found.high == pytest.approx(max(means), abs=1e-12)


def test_the_interval_agrees_with_a_loop_over_draws(rng):
    clusters = np.repeat(np.arange(12), rng.integers(1, 9, 12))
    values = rng.random(len(clusters))
    means = []
    for _ in range(20_000):
        drawn = rng.integers(0, 12, 12)
        means.append(np.concatenate([values[clusters == cluster] for cluster in drawn]).mean())
    low, high = np.quantile(means, [0.025, 0.975])

    found = bootstrap_interval(values, clusters)

    assert found.low == pytest.approx(low, abs=0.006)
    assert found.high == pytest.approx(high, abs=0.006)


def test_the_interval_holds_the_truth_about_as_often_as_it_says(rng):
    hits = 0
    for _ in range(300):
        clusters = np.repeat(np.arange(40), 5)
        values = np.repeat(rng.normal(size=40), 5) + 0.3 * rng.normal(size=200)
        found = bootstrap_interval(values, clusters, draws=1000)
        hits += found.low <= 0.0 <= found.high
    assert 0.90 <= hits / 300 <= 0.98


def test_scenarios_of_one_recording_do_not_make_the_interval_narrower(rng):
    base = rng.random(10)
    alone = bootstrap_interval(base, np.arange(10))
    repeated = bootstrap_interval(np.repeat(base, 30), np.repeat(np.arange(10), 30))
    assert repeated.low == pytest.approx(alone.low, abs=1e-12)
    assert repeated.high == pytest.approx(alone.high, abs=1e-12)


def test_the_interval_is_the_same_every_time(rng):
    values, clusters = rng.random(50), rng.integers(0, 10, 50)
    assert bootstrap_interval(values, clusters) == bootstrap_interval(values, clusters)


def test_one_recording_has_no_interval():
    assert bootstrap_interval(np.array([0.1, 0.9]), np.zeros(2, np.int64)) is None


def test_few_recordings_are_tested_with_all_patterns_of_signs():
    delta = np.array([0.3, 0.1, -0.05, 0.2, 0.4])
    clusters = np.array([0, 1, 1, 2, 3])
    sums = [0.3, 0.05, 0.2, 0.4]
    patterns = itertools.product((-1, 1), repeat=4)
    expected = np.mean([abs(np.dot(signs, sums)) >= 0.95 - 1e-12 for signs in patterns])

    p_value, smallest = sign_flip_test(delta, clusters)

    assert p_value == expected == 2 / 16
    assert smallest == 2 / 16


def test_many_recordings_are_tested_with_random_signs(rng):
    clusters = np.arange(40)
    strong, _ = sign_flip_test(rng.normal(1.0, 0.1, 40), clusters)
    none, _ = sign_flip_test(np.tile([1.0, -1.0], 20), clusters)
    assert strong == pytest.approx(1 / 10_001)
    assert none == 1.0


def test_the_test_rejects_equal_planners_as_often_as_it_should(rng):
    rejected = 0
    for _ in range(400):
        p_value, _ = sign_flip_test(rng.normal(size=15), np.arange(15), draws=400)
        rejected += p_value <= 0.05
    assert 0.02 <= rejected / 400 <= 0.09


def test_a_comparison_counts_wins_and_is_the_mean_of_the_differences():
    found = compare(np.array([1.0, 0.5, 0.2]), np.array([0.0, 0.5, 0.4]), np.array([0, 1, 2]))
    assert (found.wins, found.ties, found.losses) == (1, 1, 1)
    assert found.difference == pytest.approx(0.8 / 3)


def test_equal_scores_are_no_difference():
    same = np.array([0.1, 0.7, 0.4])
    found = compare(same, same, np.array([0, 1, 2]))
    assert found.p_value == 1.0
    assert (found.interval.low, found.interval.high) == (0.0, 0.0)


def test_holm_has_its_textbook_values():
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03, 0.005]), [0.03, 0.06, 0.06, 0.02])


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_lies_between_no_correction_and_bonferronis(p_values):
    found = np.array(holm(p_values))
    plain = np.array(p_values)
    assert (found >= plain).all()
    assert found.max() <= 1.0
    assert found[np.argmin(plain)] == min(1.0, len(plain) * plain.min())
    order = np.argsort(plain, kind="stable")
    assert (np.diff(found[order]) >= 0.0).all()


def test_the_deviation_over_seeds_is_the_sample_deviation():
    assert seed_deviation(np.array([1.0, 2.0, 4.0])) == pytest.approx(np.sqrt(7.0 / 3.0))
    assert seed_deviation(np.array([1.0])) is None


def test_rank_correlation_is_that_of_the_ranks():
    first = np.array([1.0, 2.0, 3.0, 4.0])
    assert rank_correlation(first, np.exp(first)) == pytest.approx(1.0)
    assert rank_correlation(first, -(first**3)) == pytest.approx(-1.0)
    # of ties the mean rank: ranks 1, 2.5, 2.5, 4 of the second
    assert rank_correlation(first, np.array([0.0, 5.0, 5.0, 6.0])) == pytest.approx(0.9486833)
    assert rank_correlation(first, np.zeros(4)) is None
    assert rank_correlation(first[:2], first[:2]) is None
