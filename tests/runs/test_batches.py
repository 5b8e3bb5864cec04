"""Planners that answer for several scenarios at once."""

import sys
from pathlib import Path

import pytest

from shiftsim.errors import ConfigError
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare

sys.path.append(str(Path(__file__).parent))  # worker processes import `drivers`, too

BAD = "0001cafe"
RESULTS = ("scores.parquet", "metrics.parquet")
NOISY = {"noise": ["none", "ou-high"], "seeds": [0, 1]}


def run(store, out, *, trouble="", notes="", **more):
    arguments = {"trouble": trouble, "notes": str(notes)}
    values = {
        "planners": ["drivers:Together"],
        "planner_args": {"drivers:Together": arguments},
        "store": str(store),
        "out": str(out),
        "workers": 1,
    }
    return execute(prepare(make_config(values | NOISY | more)))


def content(run):
    return [(run.path / name).read_bytes() for name in RESULTS]


@pytest.fixture(scope="module")
def one_by_one(toy, tmp_path_factory):
    return run(toy, tmp_path_factory.mktemp("runs") / "one")


@pytest.mark.parametrize(("size", "workers"), [(2, 1), (5, 1), (5, 2), (64, 1)])
@pytest.mark.thorough
def test_batches_give_the_rows_of_single_scenarios(toy, tmp_path, one_by_one, size, workers):
    together = run(toy, tmp_path / "run", batch_size=size, workers=workers)
    assert content(together) == content(one_by_one)
    assert together.manifest["determining"]["batch_size"] == size
    assert together.tasks["simulate_seconds"].null_count == 0


def test_the_scenarios_of_a_batch_share_their_passes(toy, tmp_path):
    run(toy, tmp_path / "run", batch_size=5, notes=tmp_path / "notes")
    sizes = [int(line) for line in (tmp_path / "notes").read_text().split()]
    assert sizes == [1] * 24 + [5] * 24 + [5] * 24 + [1] * 24


def test_the_batch_size_does_not_matter_to_planners_that_know_no_batches(toy, tmp_path):
    values = {"planners": ["constant-velocity"], "store": str(toy), "workers": 1}
    folders = [prepare(make_config({**values, "batch_size": size})).fingerprint for size in (1, 16)]
    assert folders[0] == folders[1]


@pytest.mark.parametrize("trouble", ["reset", "features"])
def test_a_failure_in_one_scenario_does_not_touch_the_others(toy, tmp_path, one_by_one, trouble):
    result = run(toy, tmp_path / "run", trouble=trouble, batch_size=5)
    failed = [row["token"] for row in result.tasks.to_pylist() if row["status"] == "failed"]
    assert failed == [BAD] * 3
    good = [row for row in one_by_one.scores.to_pylist() if row["token"] != BAD]
    assert result.scores.to_pylist() == good


def test_where_the_common_pass_fails_the_scenarios_are_done_one_by_one(toy, tmp_path, one_by_one):
    result = run(toy, tmp_path / "run", trouble="pass", batch_size=5)
    assert content(result) == content(one_by_one)


@pytest.mark.thorough
@pytest.mark.slow
def test_a_death_in_a_batch_costs_one_scenario(toy, tmp_path, one_by_one):
    result = run(toy, tmp_path / "run", trouble="death", batch_size=5, workers=2)
    failed = [row for row in result.tasks.to_pylist() if row["status"] == "failed"]
    assert [row["token"] for row in failed] == [BAD] * 3
    assert {row["error"] for row in failed} == {"worker process ended with exit code 11"}
    good = [row for row in one_by_one.scores.to_pylist() if row["token"] != BAD]
    assert result.scores.to_pylist() == good


@pytest.mark.parametrize("size", [1, 5])
def test_fallback_steps_are_counted_or_fail_a_strict_run(toy, tmp_path, size):
    counted = run(toy, tmp_path / "counted", trouble="lost", batch_size=size)
    steps = {row["token"]: row["degraded_steps"] for row in counted.scores.to_pylist()}
    assert steps[BAD] >= 1
    assert sum(steps.values()) == steps[BAD]
    strict = run(toy, tmp_path / "strict", trouble="lost", batch_size=size, strict=True)
    failed = [row for row in strict.tasks.to_pylist() if row["status"] == "failed"]
    assert [row["token"] for row in failed] == [BAD] * 3
    assert "lost" in failed[0]["error"]


@pytest.mark.thorough
def test_a_traffic_network_moves_the_scenarios_of_a_batch_together(toy, tmp_path):
    values = {"planners": ["constant-velocity"], "planner_args": {}, "noise": ["none"]}
    values |= {"traffic": "learned", "batch_size": 2}
    one, two = (run(toy, tmp_path / str(workers), workers=workers, **values) for workers in (1, 2))
    assert one.manifest["determining"]["batch_size"] == 2
    assert content(one) == content(two)
    alone = run(toy, tmp_path / "alone", **values | {"batch_size": 1})
    assert one.scores["cls"].to_pylist() == pytest.approx(alone.scores["cls"].to_pylist())


def test_one_planner_may_have_a_batch_size_of_its_own(toy, tmp_path, one_by_one):
    name, both = "drivers:Together", ["one=drivers:Together", "two=drivers:Together"]
    arguments = {"one": {"trouble": ""}, "two": {"trouble": "", "batch_size": 2}}
    plan = prepare(
        make_config(
            {"planners": both, "planner_args": arguments, "store": str(toy), "workers": 1}
            | NOISY
            | {"out": str(tmp_path / "run")}
        )
    )
    sizes = {batch[0].planner: len(batch) for batch in sorted(plan.batches, key=len)}
    assert plan.fingerprint["planners"]["two"]["batch_size"] == 2
    assert sizes == {"one": 1, "two": 2}
    run = execute(plan)
    scores = run.scores.drop_columns(["planner"])
    assert scores.slice(0, len(scores) // 2) == scores.slice(len(scores) // 2)
    assert run.manifest["config"]["planners"] == ["one", "two"]
    assert name == run.manifest["determining"]["planners"]["two"]["planner"]


def test_a_batch_size_is_refused_where_there_are_no_batches(toy):
    values = {"planners": ["a=idm"], "store": str(toy), "workers": 1}
    with pytest.raises(ConfigError, match="answers for one scenario at a time"):
        prepare(make_config({**values, "planner_args": {"a": {"batch_size": 2}}}))
    with pytest.raises(ConfigError, match="batch_size 'many'"):
        prepare(make_config({**values, "planner_args": {"a": {"batch_size": "many"}}}))
