"""A bundled run needs nothing but its folder."""

import json
import shutil

import numpy as np
import pytest
from commands import call

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.errors import DataError
from shiftsim.runs.derive import rescore
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import BUNDLE, bundle_run, open_run_store

TOKEN = "0001cafe"


@pytest.fixture
def moved(toy, tmp_path):
    """A bundled run of three scenarios, elsewhere, its store gone."""
    store = shutil.copytree(toy, tmp_path / "toy")
    run = shiftsim.run(
        "constant-velocity",
        store=str(store),
        limit=3,
        workers=1,
        bundle=True,
        out=str(tmp_path / "run"),
    )
    shutil.rmtree(store)
    return shiftsim.open_run(shutil.move(run.path, tmp_path / "elsewhere"))


def test_a_bundle_holds_the_scenarios_that_were_used(moved, toy):
    bundle, original = open_run_store(moved), open_store(toy)
    assert bundle.tokens == original.tokens[:3]
    assert bundle.hash == original.hash == moved.manifest["determining"]["store"]
    copied, scenario = bundle.read(TOKEN), original.read(TOKEN)
    np.testing.assert_array_equal(copied.ego, scenario.ego)
    np.testing.assert_array_equal(copied.tracks.poses, scenario.tracks.poses)
    assert copied.route == scenario.route


def test_a_bundled_run_is_read_and_scored_again_without_its_store(moved, tmp_path):
    scenario = open_run_store(moved).read(TOKEN)
    log = moved.rollout(Task("constant-velocity", "none", 0, TOKEN), scenario)
    assert np.isfinite(log.ego).all()
    again = rescore(moved, thresholds="deepplan", workers=1, out=str(tmp_path / "again"))
    assert again.manifest["counts"]["ok"] == 3


def test_a_bundle_that_was_changed_is_refused(moved):
    manifest = moved.path / "store" / "store.json"
    content = json.loads(manifest.read_text())
    content["hash"] = content["hash"][::-1]
    manifest.write_text(json.dumps(content))
    with pytest.raises(DataError, match="is not the one run"):
        open_run_store(moved)


def test_a_store_that_moved_is_asked_for(toy, tmp_path):
    store = shutil.copytree(toy, tmp_path / "toy")
    run = shiftsim.run(
        "constant-velocity", store=str(store), limit=1, workers=1, out=str(tmp_path / "run")
    )
    shutil.rmtree(store)
    with pytest.raises(DataError, match="is not at") as caught:
        open_run_store(run)
    assert "--store" in caught.value.hint
    assert "shiftsim bundle RUN" in caught.value.hint
    assert open_run_store(run, str(toy)).tokens == open_store(toy).tokens


@pytest.fixture
def finished(toy, tmp_path):
    """Two scenarios driven in a store of their own, which is no part of the run."""
    store = shutil.copytree(toy, tmp_path / "toy")
    settings = {"store": str(store), "limit": 2, "workers": 1, "out": str(tmp_path / "run")}
    return shiftsim.run("constant-velocity", **settings), settings


@pytest.mark.thorough
def test_any_finished_run_is_bundled_later(finished, toy, tmp_path):
    run, _ = finished
    done = call(tmp_path, "bundle", run.path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == f"2 scenarios in 1 map → {run.path / BUNDLE}"
    shutil.rmtree(tmp_path / "toy")
    moved = shiftsim.open_run(shutil.move(run.path, tmp_path / "elsewhere"))
    assert open_run_store(moved).tokens == open_store(toy).tokens[:2]
    assert bundle_run(moved).tokens == open_store(toy).tokens[:2]


def test_a_finished_run_is_bundled_by_resuming_it(finished):
    _, settings = finished
    again = shiftsim.run("constant-velocity", **settings, resume=True, bundle=True)
    assert len(open_store(again.path / BUNDLE)) == 2
    assert again.manifest["bundle"]["hash"] == open_store(again.path / BUNDLE).hash


def test_a_store_that_moved_is_bundled_from_where_it_is(finished, toy, tmp_path):
    run, _ = finished
    shutil.rmtree(tmp_path / "toy")
    with pytest.raises(DataError, match="is not at"):
        bundle_run(run)
    assert bundle_run(run, str(toy)).tokens == open_store(toy).tokens[:2]


def test_half_a_bundle_of_a_killed_process_is_made_anew(finished):
    run, _ = finished
    (run.path / BUNDLE).mkdir()
    assert open_run_store(run).path != run.path / BUNDLE
    assert list(bundle_run(run).tokens) == run.scores["token"].to_pylist()
