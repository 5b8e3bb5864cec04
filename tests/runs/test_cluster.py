"""A dask cluster of several processes: the same units, the same bytes, also when workers die."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shiftsim.errors import ConfigError
from shiftsim.runs.config import make_config
from shiftsim.runs.execute import execute
from shiftsim.runs.prepare import prepare

pytest.importorskip("distributed", reason="needs the extra `cluster`")

HERE = Path(__file__).parent
sys.path.append(str(HERE))  # worker processes import `drivers`, too
RESULTS = ("scores.parquet", "metrics.parquet")
NOISY = {"noise": ["none", "ou-high"], "seeds": [0, 1]}
BAD = "0001cafe"

pytestmark = [pytest.mark.slow, pytest.mark.thorough]


def command(*words):
    # started as on another machine: the test's own search path is not theirs
    return subprocess.Popen([sys.executable, "-m", "distributed.cli." + words[0], *words[1:]])


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Address of a scheduler, and two workers with a thread each."""
    folder = tmp_path_factory.mktemp("dask")
    file = folder / "scheduler.json"
    head = command("dask_scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    words = ("--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard")
    workers = [
        command("dask_worker", *words, "--local-directory", str(folder / str(i)), "--name", str(i))
        for i in range(2)
    ]
    try:
        deadline = time.monotonic() + 60
        while not file.exists():
            assert time.monotonic() < deadline
            time.sleep(0.1)
        from distributed import Client

        with Client(scheduler_file=str(file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
            yield client.scheduler.address, client
    finally:
        for process in [*workers, head]:
            process.terminate()
            process.wait(30)


def settings(store, out, **more):
    values = {"planners": ["constant-velocity"], "store": str(store), "out": str(out), "workers": 1}
    return make_config(values | NOISY | more)


def on(cluster):
    return {"executor": "dask", "scheduler": cluster[0]}


def content(run):
    return [(run.path / name).read_bytes() for name in RESULTS]


@pytest.fixture(scope="module")
def here(toy, tmp_path_factory):
    return execute(prepare(settings(toy, tmp_path_factory.mktemp("runs") / "here")))


def test_a_cluster_gives_the_same_bytes(cluster, here, toy, tmp_path):
    run = execute(prepare(settings(toy, tmp_path / "run", **on(cluster))))
    assert content(run) == content(here)
    assert len([place for place in run.rollout_places.values() if place]) == 12


def test_a_dying_process_costs_one_scenario_and_no_worker(cluster, toy, tmp_path):
    before = set(cluster[1].scheduler_info()["workers"])
    run = execute(
        prepare(settings(toy, tmp_path / "run", planners=["drivers:Dying"], **on(cluster)))
    )
    failed = [row for row in run.tasks.to_pylist() if row["status"] != "ok"]
    assert [row["token"] for row in failed] == [BAD] * 3
    assert {row["error"] for row in failed} == {"worker process ended with exit code 11"}
    assert set(cluster[1].scheduler_info()["workers"]) == before


def test_a_hung_planner_is_ended_on_a_cluster(cluster, toy, tmp_path):
    more = {"planners": ["drivers:Hanging"], "timeout": 2.0, "noise": ["none"]}
    run = execute(prepare(settings(toy, tmp_path / "run", **more, **on(cluster))))
    assert run.manifest["counts"]["timeout"] == 1
    assert run.manifest["counts"]["ok"] == 3


def test_what_a_killed_worker_was_doing_is_done_by_another(cluster, toy, tmp_path):
    pids = cluster[1].run(os.getpid)
    more = {"planners": ["drivers:Slow"], "seeds": list(range(5))}
    killed = []

    def kill(progress):
        if progress.done == 5:
            killed.append(next(iter(pids.values())))
            os.kill(killed[0], signal.SIGKILL)

    run = execute(prepare(settings(toy, tmp_path / "run", **more, **on(cluster))), on_progress=kill)
    alone = execute(prepare(settings(toy, tmp_path / "alone", **more)))
    assert killed
    assert content(run) == content(alone)


def test_a_scheduler_that_is_not_there_is_named(toy, tmp_path, monkeypatch):
    monkeypatch.setattr("shiftsim.runs.workers._CONNECT", 0.5)
    config = settings(toy, tmp_path / "run", executor="dask", scheduler="tcp://127.0.0.1:9")
    with pytest.raises(ConfigError, match=r"no dask scheduler answers at 'tcp://127\.0\.0\.1:9'"):
        execute(prepare(config))


def test_a_cluster_needs_an_address(toy):
    with pytest.raises(ConfigError, match="needs a scheduler"):
        settings(toy, "", executor="dask")
