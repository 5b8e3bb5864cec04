"""The real command line: what it prints, what it writes, and how it ends."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stores import write_toy_store

import shiftsim

PLANNER = """
import time
from shiftsim.planners.basic import ConstantVelocity

class Failing(ConstantVelocity):
    def reset(self, scene):
        super().reset(scene)
        if scene.token.startswith("0001"):
            raise ValueError("lost the way")

class Slow(ConstantVelocity):
    def plan(self, observation):
        time.sleep(0.05)
        return super().plan(observation)


class Slower(Slow):
    def plan(self, observation):
        time.sleep(0.15)
        return super().plan(observation)
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a store `toy`, planners, and a run of it."""
    folder = tmp_path_factory.mktemp("place")
    write_toy_store(folder / "shiftsim-data" / "toy")
    (folder / "mine.py").write_text(PLANNER)
    done = call(folder, "run", "-p", "constant-velocity", "-s", "toy", "--out", "runs/good")
    assert done.returncode == 0, done.stderr
    return folder


def environment():
    return {k: v for k, v in os.environ.items() if k != "SHIFTSIM_DATA"} | {"COLUMNS": "200"}


def call(folder, *words):
    return subprocess.run(
        [sys.executable, "-m", "shiftsim", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        env=environment(),
        check=False,
    )


@pytest.mark.thorough
def test_a_run_prints_every_setting_and_the_table(place):
    done = call(place, "run", "-p", "constant-velocity", "-s", "toy", "--workers", "1")
    assert done.returncode == 0
    for text in ("noise       none", "seeds 0", "traffic nonreactive", "4 of 4 scenarios found"):
        assert text in done.stdout
    assert "thresholds nuplan · metrics v" in done.stdout
    assert "100 %  4/4" in done.stderr
    folder = next(Path(place, "runs").glob("constant-velocity_none_toy_*"))
    assert (folder / "scores.parquet").is_file()


def test_a_dry_run_checks_and_writes_nothing(place):
    done = call(place, "run", "-p", "simple", "-s", "toy", "--dry-run")
    assert done.returncode == 0
    assert "nothing simulated" in done.stdout
    assert not list(Path(place, "runs").glob("simple*"))


def test_flags_win_over_the_settings_file(place):
    Path(place, "run.toml").write_text(
        'planners = ["simple"]\nstore = "toy"\nnoise = ["ou-low"]\n'
        "[planner_args.simple]\nmax_velocity = 3.0\n"
    )
    done = call(place, "run", "--config", "run.toml", "--noise", "awgn-low", "--dry-run")
    assert "noise       awgn-low " in done.stdout
    assert "max_velocity=3.0" in done.stdout


@pytest.mark.parametrize(
    ("words", "code", "fact", "hint"),
    [
        (("run", "-p", "idn", "-s", "toy"), 1, "planner 'idn' unknown", "did you mean 'idm'?"),
        (("run", "-s", "toy"), 1, "no planner", "--planner idm"),
        (("run", "-p", "idm", "-s", "toi"), 2, "no store 'toi'", "there are: toy"),
        (("run", "-p", "idm", "--nose", "none"), 1, "No such option", "run --help"),
        (("run", "-p", "idm", "-s", "toy", "--seeds", "x"), 1, "seeds 'x'", "--seeds 0,1,2"),
        (("run", "-p", "idm", "-s", "toy", "--workers", "0"), 1, "workers '0'", "auto"),
        (("run", "--config", "absent.toml"), 1, "cannot read 'absent.toml'", "check the path"),
        (("run", "-p", "mine:Absent", "-s", "toy"), 1, "no class 'Absent'", "Failing, Slow"),
        (("report", "runs/absent"), 1, "no run folder", "runs/good"),
        (("explain", "runs/good", "beef"), 1, "no scenario 'beef'", "there are 00"),
        (("check", "absent"), 2, "absent", ""),
        (("verify", "."), 1, "without --experiment", "pytest tests/parity --reference DIR"),
        (("jump",), 1, "No such command", "--help"),
    ],
)
@pytest.mark.thorough
def test_errors_are_a_fact_and_a_hint_without_a_traceback(place, words, code, fact, hint):
    done = call(place, *words)
    lines = done.stderr.splitlines()
    assert done.returncode == code
    assert lines[0].startswith("error: ")
    assert fact in lines[0]
    assert hint in "".join(lines[1:])
    assert len(lines) <= 2


def test_debug_shows_the_traceback(place):
    done = call(place, "run", "-p", "idn", "-s", "toy", "--debug")
    assert "Traceback" in done.stderr


@pytest.mark.thorough
def test_failed_tasks_withhold_the_score_and_are_explained(place):
    words = ("run", "-p", "mine:Failing", "-s", "toy", "--out", "runs/bad", "--workers", "1")
    done = call(place, *words)
    assert done.returncode == 3
    assert "– (3/4 done)" in done.stdout
    assert "ValueError: lost the way" in done.stdout
    partial = call(place, "report", "runs/bad", "--allow-partial")
    assert "partial (3/4)" in partial.stdout
    explained = call(place, "explain", "runs/bad", "0001")
    assert "ValueError: lost the way" in explained.stdout
    assert "see it" not in explained.stdout
    assert "Traceback" in explained.stdout


def test_a_score_is_explained_metric_by_metric(place):
    done = call(place, "explain", "runs/good", "0003")
    assert done.returncode == 0
    assert "constant-velocity none  CLS" in done.stdout
    for short in ("NCR", "DAC", "EMP", "DDC", "PER", "TTC", "SLC", "EIC"):
        assert short in done.stdout


@pytest.mark.thorough
def test_reading_commands_speak_json(place):
    report = json.loads(call(place, "report", "runs/good", "--json").stdout)
    assert report[0]["counts"]["ok"] == 4
    assert json.loads(call(place, "explain", "runs/good", "0003", "--json").stdout)[0]["metrics"]
    assert json.loads(call(place, "check", "toy", "--json").stdout) == []
    names = [
        entry["name"] for entry in json.loads(call(place, "planners", "list", "--json").stdout)
    ]
    assert {"idm", "log-future", "constant-velocity"} <= set(names)


@pytest.mark.thorough
def test_stored_rollouts_are_scored_again(place):
    done = call(place, "score", "runs/good", "--thresholds", "deepplan", "--out", "runs/relaxed")
    assert done.returncode == 0
    assert "thresholds deepplan" in done.stdout
    assert shiftsim.open_run(place / "runs" / "relaxed").is_complete


@pytest.mark.thorough
def test_planners_are_checked(place):
    assert call(place, "planners", "check", "mine:Slow", "--store", "toy").returncode == 0
    done = call(place, "planners", "check", "mine:Failing", "--store", "toy", "--token", "0001cafe")
    assert done.returncode == 1
    assert "lost the way" in done.stdout


@pytest.mark.thorough
@pytest.mark.slow
def test_an_interrupt_ends_with_130_and_says_what_is_kept(place):
    command = [sys.executable, "-m", "shiftsim", "run", "-p", "mine:Slower", "-s", "toy"]
    process = subprocess.Popen(
        [*command, "--workers", "2", "--out", "runs/stopped"],
        cwd=place,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment(),
    )
    first = process.stderr.readline()
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=60)
    assert "1/4" in first
    assert process.returncode == 130, rest
    assert "kept: runs/stopped" in rest
    run = shiftsim.open_run(place / "runs" / "stopped")
    assert run.manifest["state"] == "interrupted"
    assert run.manifest["counts"]["ok"] >= 1
    assert run.manifest["counts"]["missing"] >= 1


@pytest.mark.slow
@pytest.mark.thorough
def test_the_demo_runs_from_recordings_to_the_table(tmp_path):
    done = call(tmp_path, "demo", "--limit", "2")
    assert done.returncode in (0, 3), done.stderr
    for name in ("log-future", "idm", "constant-velocity"):
        assert f"\n {name} " in done.stdout
    assert "next:" in done.stdout
    assert (tmp_path / "shiftsim-data" / "demo" / "store.json").is_file()


@pytest.mark.thorough
def test_doctor_finds_this_installation_well(tmp_path):
    done = call(tmp_path, "doctor", "--json")
    assert done.returncode == 0, done.stdout
    found = json.loads(done.stdout)
    assert found["cases"] > 100
    assert found["mismatches"] == []


@pytest.mark.thorough
def test_help_names_only_commands_that_exist(tmp_path):
    done = call(tmp_path, "--help")
    assert done.returncode == 0
    for command in ("demo", "run", "score", "report", "explain", "check", "verify", "convert"):
        assert f" {command} " in done.stdout
        assert call(tmp_path, command, "--help").returncode == 0
