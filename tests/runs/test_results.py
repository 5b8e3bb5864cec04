"""What a run folder holds can be read back, and scored again."""

import numpy as np
import pyarrow as pa
import pytest

import shiftsim
from shiftsim.data.store.reading import open_store
from shiftsim.errors import ConfigError, DataError
from shiftsim.planners.registry import load_planner
from shiftsim.runs.config import make_config
from shiftsim.runs.derive import rescore
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import (
    STATES,
    complete_rollout,
    decode_rows,
    encode_rows,
    rollout_rows,
)
from shiftsim.runs.task import score_rollout
from shiftsim.sim.loop import simulate
from shiftsim.sim.noise import NoiseModel, parse_noise

TOKEN = "0003cafe"
KEY = Task("constant-velocity", "ou-high", 1, TOKEN)


class PushingTraffic:
    """Everybody drifts to the left."""

    def start(self, scenario, tracks, row):
        pass

    def step(self, iteration, ego, tracks, row):
        tracks.poses[row, :, 1] = tracks.poses[row - 1, :, 1] + 0.01


def test_a_rollout_is_read_back_as_it_was_driven(clean_run, toy):
    scenario = open_store(toy).read(TOKEN)
    stored = clean_run.rollout(KEY, scenario)
    driven = simulate(
        scenario, load_planner("constant-velocity"), noise=parse_noise("ou-high"), seed=1
    )
    for name in ("time_us", "ego", "commands", "noise", "expert_time_us", "expert_ego"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(driven, name), err_msg=name)
    np.testing.assert_allclose(stored.plans[..., :2], driven.plans[..., :2], atol=0.501e-3)
    np.testing.assert_allclose(stored.plans[..., 2], driven.plans[..., 2], atol=0.501e-4)
    np.testing.assert_array_equal(stored.tracks.poses, driven.tracks.poses)
    assert (stored.token, stored.route) == (driven.token, driven.route)


@pytest.mark.thorough
def test_noise_comes_from_its_key_and_from_the_file_where_only_its_author_knows_it(
    clean_run, toy, tmp_path
):
    assert clean_run.rollout_rows(KEY)["noise_accel_mps2"].null_count == 24
    own = NoiseModel("awgn", 0.5, 0.1, name="awgn-high")  # not what that name stands for
    out = str(tmp_path / "own")
    run = shiftsim.run("constant-velocity", noise=own, seeds=[1], store=str(toy), out=out)
    task, scenario = KEY._replace(noise="awgn-high"), open_store(toy).read(TOKEN)
    driven = simulate(scenario, load_planner("constant-velocity"), noise=own, seed=1)
    assert run.rollout_rows(task)["noise_accel_mps2"].null_count == 0
    np.testing.assert_array_equal(run.rollout(task, scenario).noise, driven.noise)


def test_a_stored_rollout_has_the_score_in_the_table(clean_run, toy):
    scenario = open_store(toy).read(TOKEN)
    log = clean_run.rollout(KEY, scenario)
    scores, _ = score_rollout(scenario, log, make_config({"planners": [KEY.planner]}))
    rows = clean_run.scores.to_pylist()
    row = next(r for r in rows if Task(*(r[n] for n in Task._fields)) == KEY)
    assert {name: row[name] for name in scores} == scores


def test_tracks_are_stored_when_the_traffic_is_not_the_log(toy):
    scenario = open_store(toy).read(TOKEN)
    log = simulate(scenario, None, controller="log-playback", traffic=PushingTraffic())
    rows = decode_rows(encode_rows(rollout_rows(log, with_tracks=True)))
    back = complete_rollout(rows, scenario, KEY)
    for name in ("valid", "poses", "velocities", "sizes"):
        np.testing.assert_array_equal(getattr(back.tracks, name), getattr(log.tracks, name))
    assert not np.array_equal(back.tracks.poses[-1], scenario.tracks.poses[-1])


def test_a_rollout_of_another_scenario_is_refused(clean_run, toy):
    store = open_store(toy)
    log = simulate(store.read("0000cafe"), None, controller="log-playback")
    rows = rollout_rows(log, with_tracks=False)
    times = pa.array(log.time_us + 1)
    moved = pa.RecordBatch.from_arrays([times, *rows.columns[1:]], schema=STATES)
    task = KEY._replace(token="0000cafe")
    assert complete_rollout(rows, store.read("0000cafe"), task).token == "0000cafe"
    with pytest.raises(DataError, match="not the one that was driven"):
        complete_rollout(moved, store.read("0000cafe"), task)


def test_rescoring_gives_the_bytes_of_a_run_with_those_thresholds(clean_run, toy, tmp_path):
    again = rescore(clean_run, thresholds="deepplan", out=str(tmp_path / "again"), workers=1)
    direct = shiftsim.run(
        ["constant-velocity", "log-future"],
        noise=["none", "ou-high"],
        seeds=[0, 1],
        store=str(toy),
        thresholds="deepplan",
        workers=1,
        out=str(tmp_path / "direct"),
    )
    for name in ("scores.parquet", "metrics.parquet"):
        assert (again.path / name).read_bytes() == (direct.path / name).read_bytes()
    assert again.manifest["determining"] == direct.manifest["determining"]
    assert again.manifest["rescored_from"] == clean_run.path.name
    scenario = open_store(toy).read(TOKEN)
    np.testing.assert_array_equal(
        again.rollout(KEY, scenario).ego, direct.rollout(KEY, scenario).ego
    )


def test_rescoring_needs_stored_rollouts(toy, tmp_path):
    run = shiftsim.run(
        "constant-velocity",
        store=str(toy),
        limit=1,
        workers=1,
        save_rollouts="none",
        out=str(tmp_path / "run"),
    )
    with pytest.raises(DataError, match="holds no rollouts for 1 of 1 tasks"):
        rescore(run, thresholds="deepplan", out=str(tmp_path / "again"))


def test_the_manifest_says_what_the_run_depended_on(clean_run, toy):
    manifest = clean_run.manifest
    determining = manifest["determining"]
    assert determining["store"] == open_store(toy).hash
    assert determining["seeds"] == [0, 1]
    assert determining["thresholds"]["least_min_ttc"] == 0.95
    assert set(determining["planners"]) == {"constant-velocity", "log-future"}
    assert {"shiftsim", "python", "numpy", "numba"} <= set(manifest["versions"])
    assert manifest["counts"] == {"expected": 24, "ok": 24, "failed": 0, "timeout": 0, "missing": 0}


def test_timings_are_in_the_tasks_table_only(clean_run):
    assert clean_run.tasks["simulate_seconds"].null_count == 0
    for table in (clean_run.scores, clean_run.metrics):
        assert not [name for name in table.column_names if "seconds" in name]


def test_rows_are_sorted_by_task(clean_run):
    keys = [tuple(row[n] for n in Task._fields) for row in clean_run.scores.to_pylist()]
    assert keys == sorted(keys)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"run": 1}'])
def test_a_broken_manifest_is_named(tmp_path, content):
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(DataError, match=r"manifest\.json is missing or broken"):
        shiftsim.open_run(tmp_path)


def test_a_missing_run_is_named_with_those_there_are(clean_run):
    with pytest.raises(ConfigError, match="no run folder") as caught:
        shiftsim.open_run(clean_run.path.parent / "other")
    assert "clean" in caught.value.hint


def test_a_damaged_rollout_file_is_named(clean_run, toy, tmp_path):
    run = shiftsim.run(
        "constant-velocity", store=str(toy), limit=1, workers=1, out=str(tmp_path / "run")
    )
    (part,) = (run.path / "rollouts").iterdir()
    part.write_bytes(part.read_bytes()[:100])
    scenario = open_store(toy).read("0000cafe")
    with pytest.raises(DataError, match=r"part-00000\.parquet"):
        run.rollout(Task("constant-velocity", "none", 0, "0000cafe"), scenario)
