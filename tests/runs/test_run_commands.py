"""Settings of long runs on the command line."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pyarrow import parquet

import shiftsim
from shiftsim.cli import main
from shiftsim.runs.journal import has_entries
from shiftsim.runs.results import JOURNAL

HERE = Path(__file__).parent
sys.path.append(str(HERE))  # worker processes import `drivers`, too


@pytest.fixture
def call(capsys, toy):
    """Exit code, output and errors of a command on the toy store."""

    def run(*words, store=True):
        more = ("--store", str(toy)) if store else ()
        with pytest.raises(SystemExit) as left:
            main([*map(str, words), *more])
        printed = capsys.readouterr()
        return left.value.code, printed.out, printed.err

    return run


def test_shards_are_run_and_merged(call, tmp_path):
    folders = [tmp_path / str(i) for i in (1, 2)]
    for i, folder in enumerate(folders, start=1):
        words = ("-p", "constant-velocity", "--shard", f"{i}/2", "--workers", 1, "--out", folder)
        code, out, _ = call("run", *words)
        assert code == 0
        assert f"(shard {i}/2)" in out
    code, _, err = call("merge", folders[0], "--out", tmp_path / "all", store=False)
    assert (code, "shards are missing: 2/2" in err) == (1, True)
    code, out, _ = call("merge", *folders, "--out", tmp_path / "all", store=False)
    assert code == 0
    assert len(shiftsim.open_run(tmp_path / "all").scores) == 4
    code, out, _ = call(
        "merge", folders[0], "--out", tmp_path / "part", "--allow-partial", store=False
    )
    assert code == 3
    assert "partial" in out


def test_a_shard_without_tasks_is_done(call, tmp_path):
    words = ("run", "-p", "constant-velocity", "--limit", 1, "--workers", 1, "--shard")
    outs = [call(*words, f"{i}/2", "--out", tmp_path / str(i)) for i in (1, 2)]
    assert [code for code, _, _ in outs] == [0, 0]
    assert sum("no task falls into shard" in out for _, out, _ in outs) == 1
    code, _, _ = call("merge", tmp_path / "1", tmp_path / "2", "--out", tmp_path / "m", store=False)
    assert code == 0


def test_a_run_is_not_scored_into_itself(call, tmp_path):
    run = tmp_path / "run"
    call("run", "-p", "constant-velocity", "--limit", 1, "--workers", 1, "--out", run)
    before = (run / "tasks.parquet").read_bytes()
    code, _, err = call("score", run, "--out", run)
    assert (code, "is the run that is scored" in err) == (1, True)
    assert (run / "tasks.parquet").read_bytes() == before


def test_seeds_may_be_given_one_by_one(call):
    words = ("-p", "constant-velocity", "-n", "ou-high", "--seeds", "0-1", "--seeds", 3)
    assert "seeds 0 1 3" in " ".join(call("run", *words, "--dry-run")[1].split())


def test_resuming_and_its_state_are_printed(call, tmp_path):
    words = ("run", "-p", "constant-velocity", "--workers", 1, "--out", tmp_path / "run")
    assert "nothing there yet" in call(*words, "--resume")[1]
    code, out, _ = call(*words, "--resume")
    assert code == 0
    assert "is complete already" in out
    assert f"what {tmp_path / 'run'} holds will be replaced" in call(*words)[1]
    code, _, err = call(*words, "--resume", "--thresholds", "deepplan")
    assert code == 1
    assert "thresholds differ" in err


def test_checkpoint_device_and_batch_size_are_printed(call, tmp_path):
    pytest.importorskip("torch")
    words = ("run", "-p", "plantf", "-p", "idm", "--dry-run", "--batch-size", 8, "--strict")
    checkpoint = ("--checkpoint", "deterministic:drive")
    code, out, _ = call(*words, *checkpoint, "--out", tmp_path / "run")
    assert code == 0
    assert "checkpoint=deterministic:drive" in out
    assert "device=cpu" in out
    assert "batch size 8   strict" in out


@pytest.mark.parametrize(
    ("words", "fact"),
    [
        (("--checkpoint", "x.ckpt"), "constant-velocity takes none"),
        (("--checkpoint", "constant-velocity=x.ckpt"), "planner with a checkpoint"),
        (("-p", "plantf", "--checkpoint", "plantff=a.ckpt"), "'plantff' unknown"),
        (("--device", "gpu"), "device 'gpu' unknown"),
        (("--batch-size", "0"), "batch_size is 0"),
        (("--timeout", "-1"), "timeout is -1.0"),
        (("--executor", "ray"), "executor 'ray' unknown"),
        (("--executor", "dask"), "needs a scheduler"),
        (("--controller", "pid"), "controller 'pid' unknown"),
        (("--planner-arg", "idn.x=1", "-p", "idm"), "planner 'idn' unknown"),
        (("-p", "my_file.py"), "is a file: which of its classes is meant?"),
        (("--seeds", "3-1"), "begin behind their end"),
        (("--shard", "3/2"), "is not i/n"),
        (("--save-rollouts", "some"), "save_rollouts 'some' unknown"),
    ],
)
def test_wrong_settings_are_found_before_the_first_task(call, tmp_path, words, fact):
    code, _, err = call("run", "-p", "constant-velocity", *words, "--out", tmp_path / "run")
    assert code == 1
    assert fact in err
    assert not (tmp_path / "run").exists()


def test_only_failed_rollouts_are_kept_where_asked_for(call, tmp_path):
    words = ("-p", "constant-velocity", "-n", "ou-high", "--seeds", "0,1", "--workers", 1)
    call("run", *words, "--save-rollouts", "failed", "--out", tmp_path / "run")
    run = shiftsim.open_run(tmp_path / "run")
    scores = {(row["seed"], row["token"]): row["cls"] for row in run.scores.to_pylist()}
    kept = {(t.seed, t.token) for t, place in run.rollout_places.items() if place}
    assert kept == {key for key, score in scores.items() if score == 0.0}
    assert 0 < len(kept) < len(scores)
    (path,) = (run.path / "rollouts").iterdir()
    stored = parquet.read_table(path, columns=["seed", "token"]).to_pylist()
    assert {(row["seed"], row["token"]) for row in stored} == kept


@pytest.mark.thorough
@pytest.mark.slow
def test_a_request_to_end_keeps_what_is_finished_and_says_how_to_go_on(toy, tmp_path):
    words = ["run", "-p", "drivers:Slow", "--noise", "ou-high", "--seeds", "0,1,2,3,4,5,6,7"]
    words += ["--store", str(toy), "--out", "run", "--workers", "2", "--quiet"]
    command = [sys.executable, "-m", "shiftsim", *words]
    paths = [str(HERE), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    )
    while not has_entries(tmp_path / "run" / JOURNAL):
        assert process.poll() is None
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "kept: run; go on with: shiftsim run -p drivers:Slow" in err
    assert err.rstrip().endswith("--resume")
    done = subprocess.run([*command, "--resume"], cwd=tmp_path, env=environment, check=False)
    assert done.returncode == 0
    assert shiftsim.open_run(tmp_path / "run").is_complete


def test_a_run_says_where_its_data_was_made_up(toy, capsys, monkeypatch):
    from dataclasses import replace

    from shiftsim.runs import prepare

    words = ("-p", "constant-velocity", "--store", str(toy), "--dry-run")
    main_of = prepare.prepare
    for generator in ({}, {"name": "towns", "seed": 1, "towns": 300}):
        monkeypatch.setattr(
            prepare, "prepare", lambda config, g=generator: replace(main_of(config), provenance=g)
        )
        with pytest.raises(SystemExit):
            main(["run", *words])
        line = "data        generated, not recorded: towns, seed 1, towns 300\n"
        assert (line in capsys.readouterr().out) == bool(generator)


NAMED = """
from shiftsim.planners.registry import load_planner


class Named:
    name = "mine"

    def __init__(self, headway: float = 1.5):
        self.inner = load_planner("idm", {"headway": headway})

    def reset(self, scene):
        self.inner.reset(scene)

    def plan(self, observation):
        return self.inner.plan(observation)


class Other(Named): ...


class Borrowed(Named):
    name = "idm"
"""


def test_the_name_of_a_class_is_that_in_tables_unless_a_label_is_given(call, tmp_path):
    file = tmp_path / "named_planners.py"
    file.write_text(NAMED)
    planners = [f"{file}:Named", f"far={file}:Named", f"{file}:Borrowed"]
    words = [word for planner in planners for word in ("-p", planner)]
    more = ("--planner-arg", "far.headway=4", "--workers", 1, "--limit", 1)
    code, out, _ = call("run", *words, *more, "--out", tmp_path / "run")
    run = shiftsim.open_run(tmp_path / "run")
    assert code == 0
    assert f"planner     far = {file}:Named  headway=4" in out
    assert run.manifest["config"]["planners"] == ["mine", "far", f"{file}:Borrowed"]
    assert run.manifest["config"]["planner_args"] == {"far": {"headway": 4}}
    assert set(run.scores["planner"].to_pylist()) == {"mine", "far", f"{file}:Borrowed"}

    code, out, _ = call(
        "report", tmp_path / "run", "-t", "scores", "--label", "mine=M", store=False
    )
    assert [line.split()[0] for line in out.splitlines()[2:4]] == ["M", "far"]

    twins = ("-p", f"{file}:Named", "-p", f"{file}:Other", *more[2:])
    code, out, _ = call("run", *twins, "--out", tmp_path / "twins", "-q")
    named = shiftsim.open_run(tmp_path / "twins").manifest["config"]["planners"]
    assert named == [f"{file}:Named", f"{file}:Other"]


@pytest.mark.thorough
def test_an_isolated_planner_has_its_own_name_too(call, tmp_path):
    file = tmp_path / "named_planners.py"
    file.write_text(NAMED)
    words = ("-p", f"{file}:Named", "--isolate", "--workers", 1, "--limit", 1, "-q")
    code, _, _ = call("run", *words, "--out", tmp_path / "run")
    assert code == 0
    assert shiftsim.open_run(tmp_path / "run").manifest["config"]["planners"] == ["mine"]
