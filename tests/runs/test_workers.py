import os
import subprocess
import sys
import time
from functools import partial
from itertools import pairwise
from operator import itemgetter
from pathlib import Path

import pytest

from shiftsim.errors import ConfigError
from shiftsim.runs.workers import map_unordered


class Square:
    def __call__(self, number):
        if number == 13:
            os._exit(7)
        if number == 14:
            os.kill(os.getpid(), 9)
        return os.getpid(), number**2


def broken_start():
    raise RuntimeError("no")


def run(numbers, workers, alone=0, make=Square):
    return list(map_unordered(make, numbers, workers=workers, alone=alone))


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.thorough
def test_every_task_is_done_once_for_any_number_of_workers(workers):
    outcomes = run(range(10), workers)
    assert sorted(o.task for o in outcomes) == list(range(10))
    assert all(o.result[1] == o.task**2 and not o.death for o in outcomes)


def test_workers_are_other_processes_and_are_kept():
    pids = {o.result[0] for o in run(range(12), 2)}
    assert os.getpid() not in pids
    assert 1 <= len(pids) <= 2


@pytest.mark.thorough
def test_a_worker_that_dies_costs_one_task_and_is_named():
    outcomes = {o.task: o for o in run([1, 13, 2, 14, 3, 13, 4], 2)}
    assert outcomes[13].death == "worker process ended with exit code 7"
    assert outcomes[14].death == "worker process killed by SIGKILL"
    assert [outcomes[n].result[1] for n in (1, 2, 3, 4)] == [1, 4, 9, 16]


@pytest.mark.thorough
def test_every_task_may_kill_its_worker():
    assert [o.death != "" for o in run([13] * 6, 2)] == [True] * 6


@pytest.mark.thorough
def test_workers_that_cannot_start_are_reported_instead_of_retried_for_ever(capfd):
    with pytest.raises(ConfigError, match="workers cannot start"):
        run([1], 2, make=broken_start)
    assert "RuntimeError: no" in capfd.readouterr().err


class Timed:
    def __call__(self, number):
        began = time.monotonic()
        time.sleep(0.1)
        return began, time.monotonic()


def test_leading_tasks_are_done_one_at_a_time():
    spans = sorted(o.result for o in run(range(6), 2, alone=3, make=Timed))
    assert all(before[1] <= after[0] for before, after in pairwise(spans[:4]))


@pytest.mark.thorough
def test_leading_tasks_come_first_whatever_their_groups():
    groups = [0, 0, 0, 1, 2, 1]
    for _ in range(3):
        outcomes = map_unordered(Timed, range(6), workers=2, alone=3, group=groups.__getitem__)
        began = {o.task: o.result[0] for o in outcomes}
        assert sorted(began, key=began.__getitem__)[:3] == [0, 1, 2]


class Closing:
    def __init__(self, path):
        self.path = path

    def __call__(self, number):
        return number

    def close(self):
        with open(self.path, "a") as file:
            file.write("closed\n")


@pytest.mark.parametrize("workers", [1, 2])
def test_functions_are_closed_at_the_end(workers, tmp_path):
    list(map_unordered(partial(Closing, tmp_path / "log"), range(4), workers=workers))
    assert set((tmp_path / "log").read_text().split()) == {"closed"}


class Named:
    def __call__(self, task):
        time.sleep(0.01)
        return os.getpid()


def test_workers_stay_with_a_group_and_leave_those_of_others():
    tasks = [(name, i) for name in "abcdef" for i in range(8)]
    outcomes = list(map_unordered(Named, tasks, workers=2, group=itemgetter(0)))
    assert sorted(o.task for o in outcomes) == tasks
    at = {name: {o.result for o in outcomes if o.task[0] == name} for name in "abcdef"}
    assert sum(len(pids) for pids in at.values()) <= 7  # the last one may be shared


class Late:
    def __call__(self, task):
        while task == 13:
            pass
        return task


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.thorough
def test_a_task_that_takes_too_long_is_ended_and_named(workers):
    outcomes = {o.task: o for o in map_unordered(Late, [1, 13, 2], workers=workers, limit=1.0)}
    assert [outcomes[n].result for n in (1, 2)] == [1, 2]
    assert outcomes[13].is_late
    assert outcomes[13].death == "took longer than 1 s"


class Compiles:
    def __init__(self, path):
        self.path = path

    def __call__(self, task):
        for _ in range(3):
            time.sleep(0.5)
            self.path.touch()
        time.sleep(60.0 if task == 13 else 0.0)
        return task


@pytest.mark.thorough
@pytest.mark.parametrize("alone", [0, 2])
def test_a_task_that_compiles_is_given_more_time(alone, tmp_path, monkeypatch):
    monkeypatch.setattr("shiftsim.runs.workers._TIME_TO_LOAD", 0.0)
    monkeypatch.setattr("shiftsim.runs.workers._TIME_TO_COMPILE", 1.0)
    code = tmp_path / "kernel.nbc"
    code.touch()
    monkeypatch.setattr("shiftsim.runs.workers.machine_code", lambda: [code])
    make = partial(Compiles, code)
    outcomes = {o.task: o for o in map_unordered(make, [13, 1], workers=1, alone=alone, limit=0.8)}
    assert outcomes[1].result == 1
    assert outcomes[13].is_late


class Both:
    def __call__(self, task):
        if 13 in task:
            os._exit(7)
        return sum(task)


@pytest.mark.thorough
def test_what_was_with_a_task_whose_worker_died_is_done_alone():
    tasks = [(1, 2), (3, 13, 4), (5,)]
    outcomes = {
        o.task: o.result or o.death for o in map_unordered(Both, tasks, workers=2, in_batches=True)
    }
    assert outcomes.pop((13,)) == "worker process ended with exit code 7"
    assert outcomes == {(1, 2): 3, (3,): 3, (4,): 4, (5,): 5}


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere they notice at the next message")
@pytest.mark.thorough
def test_workers_end_with_their_parent_even_in_an_endless_task(tmp_path):
    code = (
        "import sys; sys.path.append(sys.argv[1])\n"
        "from test_workers import Late\n"
        "from shiftsim.runs.workers import map_unordered\n"
        "for outcome in map_unordered(Late, [1, 13, 13], workers=2):\n"
        "    print(outcome.result, flush=True)\n"
    )
    here = str(Path(__file__).parent)
    parent = subprocess.Popen([sys.executable, "-c", code, here], stdout=subprocess.PIPE)
    parent.stdout.readline()
    listed = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() for pid in listed):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert listed


class Sleep:
    def __call__(self, seconds):
        time.sleep(seconds)
        return os.getpid()


def test_leaving_early_ends_the_workers_at_once():
    began = time.monotonic()
    outcomes = map_unordered(Sleep, [0.0, 0.0, 60.0, 60.0], workers=2)
    pids = [next(outcomes).result, next(outcomes).result]
    outcomes.close()
    assert time.monotonic() - began < 30
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_script_without_a_main_guard_may_use_workers(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import operator\n"
        "from functools import partial\n"
        "from shiftsim.runs.workers import map_unordered\n"
        "make = partial(partial, pow, 2)\n"
        "print(sorted(o.result for o in map_unordered(make, [1, 2, 3], workers=2)))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout == "[2, 4, 8]\n"
