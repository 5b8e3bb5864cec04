"""What a benchmark will cost, against what it did cost."""

from statistics import median
from time import perf_counter

import pytest
from stores import write_toy_store

from shiftsim.benchmarks import load_track
from shiftsim.benchmarks.bench import plan_bench, run_bench
from shiftsim.benchmarks.estimate import estimate, total

SETTINGS = {"planners": ["constant-velocity", "log-future"], "noise": ["none", "ou-high"]}


@pytest.fixture
def plan_at(tmp_path):
    """Plans four runs' worth of short tasks in one process."""
    store = write_toy_store(tmp_path / "toy", count=12)
    settings = SETTINGS | {"store": str(store), "seeds": [0, 1, 2], "workers": 1}
    return lambda name: plan_bench(load_track("state-drift"), settings, out=str(tmp_path / name))


@pytest.fixture
def plan(plan_at):
    """One of them."""
    return plan_at("bench")


def folder_size(folder):
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


@pytest.mark.slow
@pytest.mark.thorough
def test_a_small_benchmark_costs_what_was_estimated_within_a_factor_of_two(plan_at):
    ratios = []
    for name in ("one", "two", "three"):  # the machine may be busy with others during one of them
        plan = plan_at(name)
        found = total(estimate(plan))
        began = perf_counter()
        run_bench(plan)
        ratios.append(found.hours * 3600.0 / (perf_counter() - began))
        assert found.tasks == plan.num_tasks == 2 * 2 * 12 * (1 + 3)
        assert 0.5 < found.disk / folder_size(plan.folder) < 2.0
    assert 0.5 < median(ratios) < 2.0


@pytest.mark.slow
@pytest.mark.thorough
def test_shards_divide_the_time_and_not_the_work(plan):
    one, four = estimate(plan), estimate(plan, shards=4)
    assert [(cost.run, cost.planner, cost.tasks) for cost in one] == [
        (cost.run, cost.planner, cost.tasks) for cost in four
    ]
    assert len(one) == 4
    assert not plan.folder.exists()
    assert 0.1 < total(four).hours / total(one).hours < 0.6
