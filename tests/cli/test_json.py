"""With --json the output of a command is JSON only, whatever planners and metrics print."""

import json

import pytest
from stores import write_toy_store

from shiftsim.cli import main

pytestmark = pytest.mark.filterwarnings("default")  # planners and metrics warn on purpose

NOISY = """
import warnings
import numpy as np
import shiftsim

print("imported")
warnings.warn("imported")

class Loud:
    def __init__(self):
        print("made")

    def reset(self, scene):
        print("reset")

    def plan(self, observation):
        print("planned")
        warnings.warn("planned")
        times = np.arange(5) * 0.1  # shorter than the tracker looks ahead: one more warning
        x, y, heading = observation.ego.pose
        poses = np.c_[x + 8.0 * times, np.full(5, y), np.full(5, heading)]
        return shiftsim.Trajectory.from_poses(times, poses)

def metric(log, road):
    print("measured")
    return 1.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("json")
    write_toy_store(out / "store", count=3)
    (out / "loud.py").write_text(NOISY)
    return out


@pytest.fixture
def call(folder, capfd, monkeypatch):
    """The output of a command in the folder, as JSON."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)

    def run(*words):
        with pytest.raises(SystemExit):
            main([*words, "--json"])
        return json.loads(capfd.readouterr().out)

    return run


RUN = "run -p ./loud.py:Loud --store store --metric loud:metric --out runs/{name}"


@pytest.fixture
def made(call, folder):
    """A run with a planner and a metric that print."""
    path = folder / "runs" / "made"
    if not path.exists():
        call(*RUN.format(name="made").split(), "--workers", "1")
    return str(path)


@pytest.mark.thorough
@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_run(call, workers):
    found = call(*RUN.format(name=f"workers-{workers}").split(), "--workers", workers)
    assert found["counts"]["ok"] == 3


def test_a_dry_run(call):
    assert call(*RUN.format(name="dry").split(), "--dry-run")[0]["tasks"] == 3


def test_a_benchmark(call):
    words = "bench semantic-shift -p ./loud.py:Loud --store store --limit 2 --workers 1"
    assert call(*words.split(), "--out", "runs/bench")
    assert call(*words.split(), "--out", "runs/dry-bench", "--dry-run")


@pytest.mark.thorough
@pytest.mark.parametrize(
    "words",
    [
        "score {run} --metric loud:metric --thresholds deepplan --out runs/scored --workers 1",
        "report {run}",
        "explain {run}",
        "explain {run} 0001cafe",
        "diff {run} {run}",
        "planners check ./loud.py:Loud --store store",
        "planners list",
        "planners",
        "check store",
        "stats store",
        "split store --out mine.toml",
        "export nuplan store --out exported",
        "export results {run} --out results --tables-only",
        "filter store --workers 1",
        "data",
    ],
)
def test_other_commands(call, made, words):
    call(*words.format(run=made).split())
