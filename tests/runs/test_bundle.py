"""A bundled run needs nothing but its folder."""

import json
import shutil

import numpy as np
import pytest

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.errors import DataError
from shiftsim.runs.derive import rescore
from shiftsim.runs.rollouts import Task
from shiftsim.runs.scenarios import open_run_store

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
    assert open_run_store(run, str(toy)).tokens == open_store(toy).tokens
