"""The runner: what it costs beside simulating and scoring, how workers share, what memory it needs.

Runs repeat the demo's scenarios with many seeds. Every run is a process of its own; two lengths of
it are compared, so that its start does not count. Figures of time need a machine with nothing else
to do.
"""

import json
import subprocess
import sys
from pathlib import Path
from time import process_time

import pytest

from shiftsim.planners import load_planner
from shiftsim.runner import open_named_store
from shiftsim.simulation import simulate
from shiftsim.tasks import score_rollout

PLANNER, NOISE = "constant-velocity", "ou-high"
FEW, MANY = 1, 5  # seeds
ALL = 10_000  # scenarios of the long run
CODE = """
import json, resource, sys, time
import shiftsim
values = json.loads(sys.argv[1])
seeds = range(values.pop("num_seeds"))
began = time.perf_counter()
run = shiftsim.run("constant-velocity", noise="ou-high", seeds=seeds, **values)
wall = time.perf_counter() - began
own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
assert run.is_complete
print(json.dumps({
    "wall": wall,
    "cpu": own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime,
    "memory": own.ru_maxrss * 1024,
    "tasks": len(run.tasks),
}))
"""


def measured_run(folder: Path, **settings: object) -> dict[str, float]:
    out = folder / f"run-{len(list(folder.iterdir()))}"
    values = {"out": str(out), "all_scenarios": True, **settings}
    command = [sys.executable, "-c", CODE, json.dumps(values)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def store():
    return open_named_store("demo")


@pytest.fixture(scope="module")
def runs(store, tmp_path_factory):
    """Short and long runs with one and with two worker processes."""
    folder = tmp_path_factory.mktemp("runs")
    measured_run(folder, num_seeds=1, workers=2)  # warm
    return {
        (workers, seeds): measured_run(folder, num_seeds=seeds, workers=workers, timeout=600.0)
        for workers in (1, 2)
        for seeds in (FEW, MANY)
    }


def per_task(runs, workers, quantity):
    few, many = runs[workers, FEW], runs[workers, MANY]
    return (many[quantity] - few[quantity]) / (many["tasks"] - few["tasks"])


def verdict(is_met):
    return "met" if is_met else "NOT MET"


def test_overhead_per_scenario(store, runs):
    planner = load_planner(PLANNER)
    took = []
    for token in store.tokens:
        scenario = store.read(token)
        for seed in range(3):
            began = process_time()
            log = simulate(scenario, planner, noise=NOISE, seed=seed)
            score_rollout(scenario, log, thresholds="nuplan", traffic="nonreactive")
            took.append(process_time() - began)
    bare = sum(took[3:]) / len(took[3:])
    whole = per_task(runs, 2, "cpu")
    over = whole - bare
    print(
        f"\nper scenario {whole * 1e3:.2f} ms CPU in a run with 2 workers, of it simulate and "
        f"score {bare * 1e3:.2f} ms: overhead {over * 1e3:.2f} ms, reading and storing included, "
        f"target 2 ms {verdict(over <= 2e-3)}"
    )


def test_efficiency_of_two_workers(runs):
    one, two = (per_task(runs, workers, "wall") for workers in (1, 2))
    efficiency = one / two / 2
    print(
        f"\nper scenario {one * 1e3:.2f} ms with one worker, {two * 1e3:.2f} ms with two: "
        f"efficiency {100 * efficiency:.0f} %, target 85 % {verdict(efficiency >= 0.85)}"
    )


def test_memory_of_ten_thousand_scenarios(store, tmp_path):
    counts = [ALL // 10 // len(store.tokens) + 1, ALL // len(store.tokens) + 1]
    short, long = (measured_run(tmp_path, num_seeds=count, workers=2) for count in counts)
    text = ", ".join(f"{run['memory'] / 1e6:.0f} MB after {run['tasks']}" for run in (short, long))
    print(
        f"\nmain process: {text} scenarios in {long['wall']:.0f} s, "
        f"target 500 MB {verdict(long['memory'] <= 500e6)}"
    )
