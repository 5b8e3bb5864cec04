"""kill -9 at random moments, then --resume: the bytes of an undisturbed run.

`make test-kill` does it at 24 moments of a run of a minute; the tests at a few of a short one.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import children
from stores import write_toy_store

from shiftsim.runs.results import JOURNAL

HERE = Path(__file__).parent
ROUNDS = int(os.environ.get("KILL_ROUNDS", "2"))
SECONDS = float(os.environ.get("KILL_SECONDS", "2"))
PER_TASK = 0.1  # s, of drivers:Slow
TABLES = ("scores.parquet", "metrics.parquet")
PATH = [path for path in [os.environ.get("PYTHONPATH")] if path]
SIGNS = ("manifest.json", JOURNAL, ".tasks.parquet.tmp", "scores.parquet")
PATIENCE = 60 + 20 * SECONDS

pytestmark = [pytest.mark.slow, pytest.mark.thorough]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a store and an undisturbed run, and how long that took."""
    folder = tmp_path_factory.mktemp("place")
    write_toy_store(folder / "toy")
    start(folder, "warm", seeds=1).wait(PATIENCE)
    began = time.monotonic()
    process = start(folder, "undisturbed")
    assert process.wait(PATIENCE) == 0
    return folder, time.monotonic() - began


def start(folder, name, *more, seeds=0):
    """Two workers, four scenarios, as many seeds as fill the time."""
    count = seeds or max(1, round(SECONDS / PER_TASK * 2 / 4))
    words = ["run", "-p", "drivers:Slow", "-s", "./toy", "--noise", "ou-high", "--out", name]
    words += ["--seeds", ",".join(map(str, range(count))), "--workers", "2", "--quiet", *more]
    return subprocess.Popen(
        [sys.executable, "-m", "shiftsim", *words],
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *PATH])},
    )


def kill_all(process, *, workers_too):
    """kill -9 the main process, and its workers, or see them end by themselves."""
    pids = children(process.pid)
    process.kill()
    process.wait()
    for pid in pids if workers_too else ():
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{pid}").exists() for pid in pids) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def finish(folder, name):
    process = start(folder, name, "--resume")
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors.decode()
    for table in TABLES:
        assert (folder / name / table).read_bytes() == (folder / "undisturbed" / table).read_bytes()


@pytest.mark.parametrize("number", range(ROUNDS))
def test_a_run_killed_at_any_moment_is_resumed_to_the_same_bytes(place, number):
    folder, duration = place
    moment = random.Random(f"moment {number}").uniform(0.0, duration)
    process = start(folder, f"killed-{number}")
    time.sleep(moment)
    kill_all(process, workers_too=number % 2 == 0)
    finish(folder, f"killed-{number}")


@pytest.mark.parametrize("sign", SIGNS if ROUNDS > 2 else SIGNS[1:3])
def test_a_run_killed_while_it_writes_is_resumed_to_the_same_bytes(place, sign):
    name = f"at-{SIGNS.index(sign)}"
    folder, duration = place
    process = start(folder, name)
    deadline = time.monotonic() + 20 * duration
    while not (folder / name / sign).exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.0005)
    kill_all(process, workers_too=True)
    finish(folder, name)


def test_a_run_may_be_killed_again_and_again(place):
    folder, duration = place
    for number in range(min(3, ROUNDS)):
        more = ("--resume",) if number else ()
        process = start(folder, "often", *more)
        time.sleep(0.25 * duration)
        kill_all(process, workers_too=True)
    finish(folder, "often")


def test_a_killed_worker_costs_one_scenario_which_can_be_done_again(place):
    folder, _ = place
    process = start(folder, "worker")
    while not (folder / "worker" / JOURNAL).is_file() or len(children(process.pid)) < 2:
        assert process.poll() is None
        time.sleep(0.01)
    time.sleep(0.5)
    os.kill(children(process.pid)[-1], signal.SIGKILL)
    assert process.wait(PATIENCE) in (0, 3)  # 0 where it died before it had a task
    process = start(folder, "worker", "--retry-failed")
    assert process.wait(PATIENCE) == 0
    for table in TABLES:
        left, right = folder / "worker" / table, folder / "undisturbed" / table
        assert left.read_bytes() == right.read_bytes()
