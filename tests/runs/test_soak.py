"""A long run ends as it began: the same memory, the same open files, the same scores.

`make test-long` does 20,000 rollouts for each kind of traffic, the thorough tests 600.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
import pytest
from processes import children
from stores import write_toy_store

import shiftsim

PLANNERS = ("constant-velocity", "idm", "log-future", "pdm-closed")
WORKERS = int(os.environ.get("SOAK_WORKERS", "2"))


class Sample(NamedTuple):
    """One process after some rollouts."""

    done: int  # rollouts of the run
    pid: int
    memory: float  # resident [MB]
    handles: int  # open files and sockets


def look(pid, done):
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    status = dict(line.split(":", 1) for line in lines)
    handles = len(os.listdir(f"/proc/{pid}/fd"))
    return Sample(done, pid, int(status["VmRSS"].split()[0]) / 1024, handles)


def soak(folder, traffic, scenarios, seeds):
    """A run, another one of its last scenarios alone, their ids, and what was seen of the first."""
    store = write_toy_store(folder / "toy", count=scenarios, iterations=12)
    samples = []

    def watch(progress):
        if progress.done % 20 == 0:
            pids = [os.getpid(), *children(os.getpid())]
            samples.extend(look(pid, progress.done) for pid in pids)

    settings = {"noise": "ou-mid", "store": str(store), "traffic": traffic, "save_rollouts": "none"}
    workers = {"workers": WORKERS, "timeout": 600.0}  # with a limit one worker is a process, too
    run = shiftsim.run(
        list(PLANNERS),
        seeds=range(seeds),
        out=str(folder / "long"),
        on_progress=watch,
        **settings,
        **workers,
    )
    assert run.is_complete
    last = sorted(set(rows(run)["token"].to_pylist()))[-scenarios // 20 :]
    (folder / "last.txt").write_text("\n".join(last))
    again = shiftsim.run(
        list(PLANNERS),
        seeds=range(seeds),
        out=str(folder / "short"),
        split=str(folder / "last.txt"),
        **settings,
        **workers,
    )
    return run, again, last, samples


def rows(run):
    return pq.read_table(run.path / "scores.parquet")


def check(folder, traffic, *, scenarios, seeds, warm, growth):
    """Memory grows by a factor of at most `growth` after the first `warm` rollouts."""
    run, again, last, samples = soak(folder, traffic, scenarios, seeds)
    total = scenarios * len(PLANNERS) * seeds
    for pid in {sample.pid for sample in samples}:
        seen = [sample for sample in samples if sample.pid == pid]
        early = [s for s in seen if warm <= s.done <= 1.5 * warm]
        late = [s for s in seen if s.done >= total - 0.5 * warm]
        name = "the main process" if pid == os.getpid() else "a worker"
        before, after = (np.median([s.memory for s in part]) for part in (early, late))
        print(f"{name}: {before:.1f} MB, then {after:.1f} MB; {late[-1].handles} handles")
        assert after <= growth * before, name
        allowed = max(seen[0].handles, *(s.handles for s in early))
        assert max(s.handles for s in late) <= allowed, name
    keep = [token in last for token in rows(run)["token"].to_pylist()]
    assert rows(run).filter(keep).equals(rows(again))
    assert rows(again).num_rows == len(last) * len(PLANNERS) * seeds


@pytest.mark.slow
@pytest.mark.thorough
@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
def test_memory_and_scores_stay_over_600_rollouts(tmp_path, traffic):
    check(tmp_path, traffic, scenarios=150, seeds=1, warm=200, growth=1.02)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
def test_memory_and_scores_stay_over_20000_rollouts(tmp_path, traffic):
    check(tmp_path, traffic, scenarios=1000, seeds=5, warm=2000, growth=1.05)
