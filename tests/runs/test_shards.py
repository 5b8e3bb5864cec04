"""Parts of a run, made anywhere, join to the run itself."""

import sys
from pathlib import Path

import pytest

import shiftsim
from shiftsim.errors import ConfigError
from shiftsim.runs.config import make_config
from shiftsim.runs.derive import merge_runs
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare

sys.path.append(str(Path(__file__).parent))

RESULTS = ("scores.parquet", "metrics.parquet")


def settings(store, out, **more):
    values = {
        "planners": ["constant-velocity", "drivers:Together"],
        "noise": ["none", "ou-high"],
        "seeds": [0, 1],
        "store": str(store),
        "out": str(out),
        "workers": 1,
        "batch_size": 2,
    }
    return make_config(values | more)


@pytest.fixture(scope="module")
def whole(toy, tmp_path_factory):
    return execute(prepare(settings(toy, tmp_path_factory.mktemp("runs") / "whole")))


@pytest.fixture(scope="module")
def shards(toy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("shards")
    return [execute(prepare(settings(toy, folder / str(i), shard=f"{i}/3"))) for i in (1, 2, 3)]


def test_every_task_is_in_one_shard(whole, shards):
    counts = [shard.manifest["counts"]["expected"] for shard in shards]
    assert sum(counts) == whole.manifest["counts"]["expected"]
    assert min(counts) > 0


def test_merged_shards_are_the_run_itself(whole, shards, tmp_path):
    merged = merge_runs(shards[::-1], out=str(tmp_path / "merged"))
    for name in RESULTS:
        assert (merged.path / name).read_bytes() == (whole.path / name).read_bytes()
    assert merged.is_complete
    assert merged.manifest["determining"] == whole.manifest["determining"]
    assert all(whole.rollout_places.values())
    for task in whole.rollout_places:
        assert merged.rollout_rows(task)["x_m"] == whole.rollout_rows(task)["x_m"]
    assert len(list((merged.path / "rollouts").iterdir())) == len(shards)


def test_a_merged_run_may_be_resumed_and_repeated(shards, toy, tmp_path):
    merged = merge_runs(shards[:2], out=str(tmp_path / "merged"), allow_partial=True)
    assert merged.manifest["counts"]["missing"] > 0
    assert "partial" in shiftsim.open_run(merged.path).table(allow_partial=True)
    finished = execute(prepare(settings(toy, merged.path, resume=True)))
    assert finished.is_complete


def test_missing_shards_are_named(shards, tmp_path):
    with pytest.raises(ConfigError, match="shards are missing: 2/3"):
        merge_runs([shards[0], shards[2]], out=str(tmp_path / "merged"))
    assert not (tmp_path / "merged").exists()


def test_a_shard_given_twice_is_named(shards, tmp_path):
    with pytest.raises(ConfigError, match="shard 1/3 is there twice"):
        merge_runs([*shards, shards[0]], out=str(tmp_path / "merged"))


def test_shards_of_other_runs_are_refused(shards, whole, toy, tmp_path):
    other = execute(prepare(settings(toy, tmp_path / "other", shard="2/3", seeds=[0])))
    with pytest.raises(ConfigError, match=r"not of the same run: seeds differ"):
        merge_runs([shards[0], other, shards[2]], out=str(tmp_path / "merged"))
    finer = execute(prepare(settings(toy, tmp_path / "finer", shard="2/4")))
    with pytest.raises(ConfigError, match="not of the same run: their shards are 2/4 and 1/3"):
        merge_runs([shards[0], finer], out=str(tmp_path / "merged"))
    with pytest.raises(ConfigError, match="is not a shard"):
        merge_runs([shards[0], whole], out=str(tmp_path / "merged"))


@pytest.mark.parametrize("text", ["3", "0/2", "3/2", "1/0", "a/b", "1/2/3", "1/" + "9" * 5000])
def test_a_shard_that_is_none_is_refused(toy, text):
    with pytest.raises(ConfigError, match="is not i/n"):
        settings(toy, "", shard=text)


def test_shards_have_folders_of_their_own(toy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [prepare(settings(toy, "", shard=f"{i}/2")).folder.name for i in (1, 2)]
    assert names[0].removesuffix(".1-of-2") == names[1].removesuffix(".2-of-2")


def test_shards_of_labelled_planners_join_to_the_run_itself(toy, tmp_path):
    planners = ["near=idm", "far=idm", "drivers:Together"]
    more = {"planners": planners, "planner_args": {"far": {"headway": 4.0}}, "noise": ["none"]}
    runs = [execute(prepare(settings(toy, tmp_path / "whole", **more)))]
    runs += [
        execute(prepare(settings(toy, tmp_path / n, shard=f"{n}/2", **more))) for n in ("1", "2")
    ]
    merged = merge_runs(runs[1:], out=str(tmp_path / "merged"))
    for name in RESULTS:
        assert (merged.path / name).read_bytes() == (runs[0].path / name).read_bytes()
    assert set(merged.scores["planner"].to_pylist()) == {"near", "far", "drivers:Together"}
    assert prepare(settings(toy, tmp_path / "whole", resume=True, **more)).before == "complete"
    swapped = more | {
        "planners": ["near=idm", "distant=idm", "drivers:Together"],
        "planner_args": {},
    }
    with pytest.raises(ConfigError, match="planners differ"):
        prepare(settings(toy, tmp_path / "whole", resume=True, **swapped))
