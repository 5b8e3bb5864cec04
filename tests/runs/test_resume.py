"""Runs that were stopped go on: nothing finished is done again, nothing is mixed."""

import errno
import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import shiftsim
from shiftsim.errors import ConfigError, DataError
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.journal import Journal
from shiftsim.runs.manifest import difference
from shiftsim.runs.prepare import prepare
from shiftsim.runs.results import JOURNAL
from shiftsim.runs.rollouts import Task
from shiftsim.runs.tables import TaskResult
from shiftsim.runs.workers import Outcome

sys.path.append(str(Path(__file__).parent))  # worker processes import `drivers`, too

BAD = "0001cafe"
RESULTS = ("scores.parquet", "metrics.parquet")
NOISY = {"noise": ["none", "ou-high"], "seeds": [0, 1]}


def settings(store, out, **more):
    values = {"planners": ["constant-velocity"], "store": str(store), "out": str(out), "workers": 1}
    return make_config(values | more)


def content(run):
    return [(run.path / name).read_bytes() for name in RESULTS]


class Stop(Exception):
    """Stands for the end of the process."""


def stop_after(count):
    """Ends a run hard after some tasks."""

    def check(progress):
        if progress.done >= count:
            raise Stop

    return check


@pytest.fixture(scope="module")
def undisturbed(toy, tmp_path_factory):
    return execute(prepare(settings(toy, tmp_path_factory.mktemp("runs") / "run", **NOISY)))


@pytest.fixture
def stopped(toy, tmp_path):
    """Folder of a run as kill -9 leaves it after 5 of 12 tasks, without a chance to clean up."""

    def kill(progress):
        if progress.done == 5:
            shutil.copytree(tmp_path / "first", tmp_path / "run")
            raise Stop

    with pytest.raises(Stop):
        execute(prepare(settings(toy, tmp_path / "first", **NOISY)), on_progress=kill)
    shutil.rmtree(tmp_path / "first")
    return tmp_path / "run"


def test_a_stopped_run_is_visible_and_says_what_to_do(stopped):
    assert json.loads((stopped / "manifest.json").read_text())["state"] == "running"
    journal = Journal(stopped / JOURNAL, keep=True)
    assert len(list(journal.items())) == 5
    journal.close()
    with pytest.raises(DataError, match="not finished") as caught:
        shiftsim.open_run(stopped)
    assert "--resume" in caught.value.hint


def test_resuming_does_only_what_is_left_and_gives_the_same_bytes(stopped, toy, undisturbed):
    seen = []
    prepared = prepare(settings(toy, stopped, resume=True, **NOISY))
    run = execute(prepared, on_progress=seen.append)
    assert [progress.done for progress in seen] == list(range(6, 13))
    assert content(run) == content(undisturbed)
    assert sorted(path.name for path in stopped.iterdir()) == sorted(
        ["manifest.json", "rollouts", "tasks.parquet", *RESULTS]
    )
    assert [path.name for path in (stopped / "rollouts").iterdir()] == ["part-00000.parquet"]


@pytest.mark.parametrize("cut", [1, 40, 5000, 100_000])
def test_what_a_power_failure_took_is_made_again(stopped, toy, undisturbed, cut):
    journal = stopped / f"{JOURNAL}-wal"
    os.truncate(journal, journal.stat().st_size - cut)
    run = execute(prepare(settings(toy, stopped, resume=True, **NOISY)))
    assert content(run) == content(undisturbed)
    for task in undisturbed.rollout_places:
        assert run.rollout_rows(task)["x_m"] == undisturbed.rollout_rows(task)["x_m"]


def test_halves_of_files_that_a_killed_process_leaves_do_no_harm(stopped, toy, undisturbed):
    for name in (".scores.parquet.tmp", ".manifest.json.tmp", "rollouts/.part-00000.parquet.tmp"):
        (stopped / name).write_bytes(b"half")
    run = execute(prepare(settings(toy, stopped, resume=True, **NOISY)))
    assert content(run) == content(undisturbed)
    assert not list((stopped / "rollouts").glob(".*"))


def test_an_unfinished_run_is_not_overwritten_by_chance(stopped, toy):
    with pytest.raises(ConfigError, match="holds an unfinished run") as caught:
        prepare(settings(toy, stopped, **NOISY))
    assert "--resume" in caught.value.hint


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"seeds": [0, 2]}, "seeds"),
        ({"thresholds": "deepplan"}, "thresholds"),
        ({"traffic": "reactive"}, "traffic"),
        ({"limit": 3}, "scenarios"),
        ({"planners": ["log-future"]}, "planners"),
        ({"strict": True}, "strict"),
        ({"shard": "1/2"}, "shard"),
    ],
)
def test_resuming_with_other_settings_names_what_differs(stopped, toy, change, name):
    with pytest.raises(ConfigError, match=rf"holds another run: .*{name}.* differ"):
        prepare(settings(toy, stopped, resume=True, **(NOISY | change)))


def test_what_differs_of_a_planner_is_named():
    idm = {"planner": "idm", "arguments": {}}
    before = {"determining": {"planners": {"a": idm, "b": idm}, "noise": 1}}
    after = {"planners": {"a": idm, "b": idm | {"arguments": {"headway": 3.0}}}, "noise": 1}
    assert difference(before, after) == "planners (b: arguments) differ"


def test_another_version_of_the_code_is_not_mixed_in(stopped, toy, monkeypatch):
    monkeypatch.setattr("shiftsim.runs.prepare.code_digest", lambda: "another")
    with pytest.raises(ConfigError, match="code differ"):
        prepare(settings(toy, stopped, resume=True, **NOISY))


def test_resuming_by_name_with_other_settings_names_what_differs(toy, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(Stop):
        execute(prepare(settings(toy, "", **NOISY)), on_progress=stop_after(2))
    with pytest.raises(ConfigError, match="is another one: thresholds differ"):
        prepare(settings(toy, "", resume=True, thresholds="deepplan", **NOISY))
    assert prepare(settings(toy, "", resume=True, **NOISY)).before == "unfinished"
    assert prepare(settings(toy, "", thresholds="deepplan", **NOISY)).before == "new"


def test_a_planner_that_nobody_can_compare_does_not_resume(toy, tmp_path):
    how = {"store": str(toy), "out": str(tmp_path / "run"), "workers": 1, "noise": "ou-high"}
    policies = [shiftsim.policy_planner(lambda seen, gain=gain: [gain, 0.0]) for gain in (0.1, 0.2)]
    with pytest.raises(Stop):
        shiftsim.run({"mine": policies[0]}, on_progress=stop_after(1), **how)
    with pytest.raises(ConfigError, match="'mine' holds what cannot be pickled"):
        shiftsim.run({"mine": policies[1]}, resume=True, **how)


def test_resuming_where_nothing_is_yet_begins_anew(toy, tmp_path, undisturbed):
    run = execute(prepare(settings(toy, tmp_path / "run", resume=True, **NOISY)))
    assert content(run) == content(undisturbed)


def test_resuming_a_complete_run_does_nothing(undisturbed, toy):
    before = (undisturbed.path / "tasks.parquet").stat().st_mtime_ns
    execute(prepare(settings(toy, undisturbed.path, resume=True, **NOISY)))
    assert (undisturbed.path / "tasks.parquet").stat().st_mtime_ns == before


def test_an_interrupted_run_goes_on_from_its_tables(toy, tmp_path, undisturbed):
    def press(progress):
        if progress.done == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        execute(prepare(settings(toy, tmp_path / "run", **NOISY)), on_progress=press)
    partial = shiftsim.open_run(tmp_path / "run")
    assert (partial.manifest["state"], partial.manifest["counts"]["ok"]) == ("interrupted", 7)
    assert not (partial.path / JOURNAL).exists()
    seen = []
    prepared = prepare(settings(toy, partial.path, resume=True, **NOISY))
    run = execute(prepared, on_progress=seen.append)
    assert len(seen) == 5
    assert content(run) == content(undisturbed)
    assert run.tasks["simulate_seconds"].null_count == 0


def test_a_complete_run_stays_while_it_is_made_again(undisturbed, toy, tmp_path):
    folder = shutil.copytree(undisturbed.path, tmp_path / "again")
    with pytest.raises(Stop):
        execute(prepare(settings(toy, folder, **NOISY)), on_progress=stop_after(3))
    assert content(shiftsim.open_run(folder)) == content(undisturbed)
    run = execute(prepare(settings(toy, folder, resume=True, **NOISY)))
    assert content(run) == content(undisturbed)


def test_what_failed_is_done_again_when_asked_for(toy, tmp_path, monkeypatch):
    mood = tmp_path / "mood"
    monkeypatch.setenv("MOOD", str(mood))
    mood.write_text("bad")
    config = settings(toy, tmp_path / "run", planners=["drivers:Moody"])
    first = execute(prepare(config))
    assert first.manifest["counts"]["failed"] == 1
    mood.write_text("good")
    assert execute(prepare(replace(config, resume=True))).manifest["counts"]["failed"] == 1
    seen = []
    again = execute(prepare(replace(config, retry_failed=True)), on_progress=seen.append)
    assert len(seen) == 1
    assert again.is_complete
    clean = execute(prepare(replace(config, out=str(tmp_path / "clean"))))
    assert content(again) == content(clean)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_a_hung_planner_is_ended_and_named(toy, tmp_path, workers):
    config = settings(
        toy, tmp_path / "run", planners=["drivers:Hanging"], timeout=2.0, workers=workers
    )
    run = execute(prepare(config))
    assert run.manifest["counts"] == {
        "expected": 4,
        "ok": 3,
        "failed": 0,
        "timeout": 1,
        "missing": 0,
    }
    late = next(task for task in run.tasks.to_pylist() if task["status"] == "timeout")
    assert (late["token"], late["error"]) == (BAD, "took longer than 2 s")


def test_two_processes_do_not_write_the_same_run(tmp_path):
    writer = RunWriter(tmp_path / "run", {"format": 3})
    with pytest.raises(ConfigError, match="another process is working on"):
        RunWriter(tmp_path / "run", {"format": 3}, resume=True)
    writer.close()
    RunWriter(tmp_path / "run", {"format": 3}, resume=True).close()


def test_a_full_disk_keeps_what_is_finished(toy, tmp_path, undisturbed, monkeypatch):
    prepared = prepare(settings(toy, tmp_path / "run", **NOISY))
    add = RunWriter.add

    def add_until_full(self, result, **more):
        if len(self.ended) == 4:
            raise OSError(28, "No space left on device")
        add(self, result, **more)

    monkeypatch.setattr(RunWriter, "add", add_until_full)
    with pytest.raises(DataError, match="cannot be written: No space left") as caught:
        execute(prepared)
    assert "--resume" in caught.value.hint
    monkeypatch.undo()
    run = execute(prepare(settings(toy, tmp_path / "run", resume=True, **NOISY)))
    assert content(run) == content(undisturbed)


def test_a_result_that_does_not_fit_on_the_disk_is_taken_back(tmp_path):
    writer = RunWriter(tmp_path / "run", {"format": 3})
    writer.add(TaskResult(Task("p", "none", 0, "a"), "ok", rollout=b"some bytes of a rollout"))
    (pages,) = writer._journal._database.execute("pragma page_count").fetchone()
    writer._journal._database.execute(f"pragma max_page_count = {pages}")
    with pytest.raises(OSError, match="No space left"):
        writer.add(TaskResult(Task("p", "none", 0, "b"), "ok", rollout=bytes(1 << 20)))
    assert list(writer.ended) == [Task("p", "none", 0, "a")]
    writer._journal._database.execute("pragma max_page_count = 100000")
    writer.add(TaskResult(Task("p", "none", 0, "c"), "ok"))
    writer.close()
    again = RunWriter(tmp_path / "run", {"format": 3}, resume=True)
    assert [task.token for task in again.ended] == ["a", "c"]
    first, _ = again.ended.values()
    assert again._journal.data(first.number) == b"some bytes of a rollout"
    again.close()


def test_a_file_system_without_locks_is_no_hindrance(tmp_path, monkeypatch):
    import fcntl

    def refuse(*arguments):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    monkeypatch.setattr(fcntl, "lockf", refuse)
    writer = RunWriter(tmp_path / "run", {"format": 3})
    writer.add(TaskResult(Task("p", "none", 0, "a"), "ok"))
    writer.close()
    again = RunWriter(tmp_path / "run", {"format": 3}, resume=True)
    assert len(again.ended) == 1
    again.close()


def test_an_output_that_cannot_be_written_is_one_error(toy, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises((DataError, ConfigError), match="file"):
        execute(prepare(settings(toy, tmp_path / "file" / "run")))


def test_a_worker_that_died_is_told_from_one_that_was_late():
    from shiftsim.runs.execute import results_of

    task = Task("p", "none", 0, "a")
    (died,) = results_of(Outcome((task,), None, "worker process killed by SIGKILL"))
    (late,) = results_of(Outcome((task,), None, "took longer than 2 s", is_late=True))
    assert (died.status, late.status) == ("failed", "timeout")


@pytest.mark.parametrize(
    ("kept", "free", "message"),
    [
        ("all", 500e3, r"12 tasks: about 1\.0 MB, but '.*' has 0\.5 MB free"),
        ("none", 50e3, "12 tasks: about"),
        ("none", 500e3, ""),
        ("all", 2e6, ""),
    ],
)
def test_a_run_that_the_disk_cannot_hold_is_refused(
    toy, tmp_path, monkeypatch, kept, free, message
):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=free))
    config = settings(toy, tmp_path / "not" / "yet" / "run", save_rollouts=kept, **NOISY)
    if not message:
        prepare(config)
        return
    with pytest.raises(DataError, match=message) as caught:
        prepare(config)
    assert ("--save-rollouts failed" in caught.value.hint) == (kept == "all")
    assert not (tmp_path / "not").exists()
