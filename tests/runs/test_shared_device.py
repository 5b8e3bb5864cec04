"""Workers that ask the process which has the networks; here it computes on the CPU."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from processes import children
from stores import write_toy_store

from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare

pytestmark = pytest.mark.thorough

sys.path.append(str(Path(__file__).parent))  # worker processes import `drivers`, too

BAD = "0001cafe"
RESULTS = ("scores.parquet", "metrics.parquet")
NETWORKED = "drivers:Networked"


def prepared(store, out, *, trouble="", notes="", shared=True, **more):
    arguments = {NETWORKED: {"trouble": trouble, "notes": str(notes)}}
    values = {"planners": [NETWORKED], "planner_args": arguments, "store": str(store)}
    values |= {"noise": ["none", "ou-high"], "out": str(out), "workers": 2, "batch_size": 2}
    found = prepare(make_config(values | more))
    return replace(found, shared=tuple(found.planners)) if shared else found


def run(*places, **more):
    return execute(prepared(*places, **more))


def content(run):
    return [(run.path / name).read_bytes() for name in RESULTS]


def failures(run):
    return {row["token"]: row["error"] for row in run.tasks.to_pylist() if row["status"] != "ok"}


@pytest.fixture(scope="module")
def without(toy, tmp_path_factory):
    return run(toy, tmp_path_factory.mktemp("runs") / "one", workers=1, shared=False)


def test_one_process_has_the_networks_of_all_workers(toy, tmp_path, without):
    before = children(os.getpid())  # of other tests
    ours = run(toy, tmp_path / "run", notes=tmp_path / "notes")
    assert content(ours) == content(without)
    passes = [line.split() for line in (tmp_path / "notes").read_text().splitlines()]
    assert {size for _, size in passes} == {"1", "2"}
    assert len({pid for pid, _ in passes}) == 1
    assert set(children(os.getpid())) <= set(before)


@pytest.mark.parametrize("size", [1, 2])
def test_an_error_of_the_network_is_that_of_its_scenario(toy, tmp_path, without, size):
    ours = run(toy, tmp_path / "run", trouble="fail", batch_size=size)
    assert failures(ours) == {BAD: "RuntimeError: cannot infer here"}
    (row,) = {row["traceback"] for row in ours.tasks.to_pylist() if row["status"] != "ok"}
    assert 'raise RuntimeError("cannot infer here")' in row
    good = [row for row in without.scores.to_pylist() if row["token"] != BAD]
    assert ours.scores.to_pylist() == good


def test_where_the_process_ends_once_it_is_asked_again(toy, tmp_path, without):
    ours = run(toy, tmp_path / "run", trouble="die once", notes=tmp_path / "notes")
    assert content(ours) == content(without)
    pids = {line.split()[0] for line in (tmp_path / "notes").read_text().splitlines()}
    assert len(pids) == 2


def test_a_scenario_that_ends_the_process_fails_and_the_others_go_on(toy, tmp_path, without):
    ours = run(
        toy, tmp_path / "run", trouble="die", notes=tmp_path / "notes", workers=1, timeout=60
    )
    told = f"planner '{NETWORKED}': the process that holds its network has ended"
    assert failures(ours) == {BAD: told}
    good = [row for row in without.scores.to_pylist() if row["token"] != BAD]
    assert ours.scores.to_pylist() == good


def have_torch():
    """How many of the processes that this one has started have loaded torch."""
    maps = []
    for pid in children(os.getpid()):
        with suppress(OSError):
            maps.append(Path(f"/proc/{pid}/maps").read_text())
    return sum("libtorch" in text for text in maps)


@pytest.mark.learned
@pytest.mark.parametrize(
    ("names", "traffic"),
    [
        (["carl", "diffusion-planner", "plantf", "pluto"], "nonreactive"),
        (["plantf"], "planner:plantf"),
    ],
)
def test_the_learned_planners_ask_and_workers_need_no_torch(tmp_path, names, traffic):
    pytest.importorskip("torch")
    write_toy_store(tmp_path / "toy", count=3, iterations=6)
    arguments = {name: {"checkpoint": "deterministic:drive"} for name in names}
    values = {"planners": names, "planner_args": arguments, "traffic": traffic, "noise": ["none"]}
    ours = prepared(tmp_path / "toy", tmp_path / "ours", **values)
    shared = (*names, *([traffic] if traffic.startswith("planner:") else ()))
    counts = set()
    done = execute(replace(ours, shared=shared), on_progress=lambda _: counts.add(have_torch()))
    assert not failures(done)
    assert counts == {1}
    alone = run(tmp_path / "toy", tmp_path / "alone", shared=False, **values | {"workers": 1})
    assert content(done) == content(alone)


RUN = """
import sys; sys.path.append(sys.argv[1])
from test_shared_device import execute, prepared
execute(prepared(*sys.argv[2:4], notes=sys.argv[4], seeds=list(range(20)), resume=True))
"""


def start(toy, folder):
    here = str(Path(__file__).parent)
    words = [sys.executable, "-c", RUN, here, str(toy), str(folder / "run"), str(folder / "notes")]
    path = [here, str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(path)}
    return subprocess.Popen(words, env=env, stderr=subprocess.PIPE)


def when_it_infers(folder, count=30):
    deadline = time.monotonic() + 60
    notes = folder / "notes"
    while not notes.exists() or len(lines := notes.read_text().splitlines()) < count:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return int(lines[0].split()[0])


def test_kills_and_interrupts_leave_nobody_and_the_rest_is_resumed(toy, tmp_path):
    first = start(toy, tmp_path)
    owner = when_it_infers(tmp_path)
    pids = children(first.pid)
    assert owner in pids
    (other, *_) = (pid for pid in pids if pid != owner)
    os.kill(other, signal.SIGKILL)  # a worker: one batch is done again, nobody waits for it
    first.send_signal(signal.SIGINT)
    assert first.wait(60) != 0
    ended(pids)
    (tmp_path / "notes").unlink()
    second = start(toy, tmp_path)
    when_it_infers(tmp_path)
    pids = children(second.pid)
    second.kill()
    second.wait()
    ended(pids)
    assert start(toy, tmp_path).wait(120) == 0
    fresh = run(toy, tmp_path / "fresh", workers=1, shared=False, seeds=list(range(20)))
    assert [(tmp_path / "run" / name).read_bytes() for name in RESULTS] == content(fresh)


def ended(pids):
    assert pids
    deadline = time.monotonic() + 20
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.learned
def test_networks_on_a_gpu_are_shared_by_workers_that_need_little_memory(toy, monkeypatch):
    pytest.importorskip("torch")
    # the weights are loaded on the CPU nevertheless
    monkeypatch.setattr("shiftsim.planners.learned.base.resolve_device", lambda name: "cuda:0")
    asked = []
    count = "shiftsim.runs.prepare.default_workers"
    monkeypatch.setattr(count, lambda *memory: asked.append(memory) or 2)
    values = {"planners": ["carl", "idm"], "store": str(toy)}
    values["planner_args"] = {"carl": {"checkpoint": "deterministic:drive"}}
    found = prepare(make_config(values))
    assert (found.shared, found.workers, asked) == (("carl",), 2, [()])
    assert prepare(make_config(values | {"workers": 1})).shared == ()
    assert (
        prepare(make_config(values | {"executor": "dask", "scheduler": "tcp://a:1"})).shared == ()
    )
    assert prepare(make_config(values | {"isolate": True})).shared == ()
    monkeypatch.undo()
    assert prepare(make_config(values | {"workers": 2})).shared == ()
