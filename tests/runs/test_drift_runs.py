"""Runs under perception, localization and latency: tasks, tables and what is stored."""

import numpy as np
import pytest

import shiftsim
from shiftsim.report.figures import figures
from shiftsim.report.groups import read_groups
from shiftsim.runs.config import make_config
from shiftsim.runs.prepare import prepare
from shiftsim.sim.loop import simulate

PLANNERS = ("constant-velocity", "log-future")
WORDS = ("none", "mid+miss-high+dropout-high")


@pytest.fixture(scope="module")
def drifted(toy, tmp_path_factory):
    """Two planners under two perceptions and two latencies."""
    return driven(toy, tmp_path_factory.mktemp("runs") / "drift", workers=1)


def driven(toy, out, **more):
    kinds = {"perception": list(WORDS), "localization": "low", "latency": [0, 200]}
    return shiftsim.run(
        list(PLANNERS),
        noise=["ou-high"],
        seeds=[0, 1],
        store=str(toy),
        limit=2,
        out=str(out),
        **kinds,
        **more,
    )


def plan(toy, **values):
    config = {"planners": ["idm"], "store": str(toy), "out": "", "workers": 1}
    return prepare(make_config(config | values))


def test_a_run_is_the_product_of_what_drifts(toy):
    found = plan(toy, noise=["none", "ou-low"], perception=["low"], latency=[0, 300])
    names = {task.noise for task in found.tasks}
    assert names == {
        "perception-low",
        "perception-low+latency-300",
        "ou-low+perception-low",
        "ou-low+perception-low+latency-300",
    }
    assert set(found.config.noise) == names
    again = prepare(found.config)  # settings of a run are those of the same run
    assert again.fingerprint == found.fingerprint


def test_latency_alone_has_no_seeds(toy):
    tasks = plan(toy, latency=[0, 100], perception=["none", "low"], seeds=[0, 1]).tasks
    seeds = {name: {t.seed for t in tasks if t.noise == name} for name in {t.noise for t in tasks}}
    assert seeds == {
        "none": {0},
        "latency-100": {0},
        "perception-low": {0, 1},
        "perception-low+latency-100": {0, 1},
    }


def test_drift_is_part_of_the_identity_of_a_run(toy):
    base = plan(toy).fingerprint
    assert plan(toy, perception=["none"], latency=[0]).fingerprint == base
    for change in ({"perception": ["low"]}, {"localization": ["low"]}, {"latency": [100]}):
        assert plan(toy, **change).fingerprint["noise"] != base["noise"]


def test_rollouts_come_back_with_what_was_seen(toy, drifted):
    store = shiftsim.open_store(str(toy))
    for task in drifted.rollout_places:
        late, wrong = "latency-200" in task.noise, "perception" in task.noise
        setting = {"latency": 200 if late else 0, "perception": WORDS[wrong], "seed": task.seed}
        planner = shiftsim.load_planner(task.planner)
        fresh = simulate(store[task.token], planner, noise="ou-high", localization="low", **setting)
        log = drifted.rollout(task, store[task.token])
        np.testing.assert_array_equal(log.ego, fresh.ego)
        np.testing.assert_array_equal(log.noise, fresh.noise)
        np.testing.assert_array_equal(log.seen.ego, fresh.seen.ego)
        seen, expected = log.seen.tracks, fresh.seen.tracks
        columns = [expected.tokens.index(token) for token in seen.tokens]
        assert seen.valid.sum() == expected.valid.sum()
        np.testing.assert_array_equal(seen.kinds, expected.kinds[columns])
        np.testing.assert_allclose(seen.poses, expected.poses[:, columns], rtol=0, atol=1e-6)


def test_nothing_is_seen_of_rollouts_without(toy, tmp_path):
    run = shiftsim.run(
        "constant-velocity",
        perception=["none", "low"],
        store=str(toy),
        limit=1,
        workers=1,
        out=str(tmp_path / "run"),
    )
    store = shiftsim.open_store(str(toy))
    seen = {t.noise: run.rollout(t, store[t.token]).seen for t in run.rollout_places}
    assert seen["none"] is None
    assert seen["perception-low"] is not None


@pytest.mark.thorough
def test_two_workers_give_the_same_bytes_as_one(toy, drifted, tmp_path):
    other = driven(toy, tmp_path / "two", workers=2)
    for name in ("scores.parquet", "metrics.parquet"):
        assert (other.path / name).read_bytes() == (drifted.path / name).read_bytes()


def test_tables_and_figures_say_what_drifts_and_who_is_given_the_recording(toy, tmp_path):
    run = shiftsim.run(
        list(PLANNERS),
        noise=["none", "perception-low", "latency-100", "latency-300"],
        store=str(toy),
        limit=2,
        workers=1,
        out=str(tmp_path / "run"),
    )
    text = run.table("drift")
    assert "log-future bears a latency of 300 ms (NR), the longest that was run." in text
    assert "given the recording drive by it, whatever is seen: log-future" in text
    pytest.importorskip("matplotlib")
    names = [figure.name.partition("_")[0] for figure in figures(read_groups([run]))]
    assert {"perception", "latency"} <= {*names}
