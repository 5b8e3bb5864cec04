"""The runner: what it costs beside simulating and scoring, how workers share, what memory it needs.

Runs repeat the demo's scenarios with many seeds. Every run is a process of its own; two lengths of
it are compared, so that its start does not count. Figures of time need a machine with nothing else
to do.
"""

import json
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from time import process_time

import numpy as np
import pytest

import shiftsim
from shiftsim.data import open_store
from shiftsim.planners.registry import load_planner
from shiftsim.runs.config import make_config
from shiftsim.runs.folder import RunWriter
from shiftsim.runs.results import FORMAT_VERSION
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.files import encode_rows, rollout_rows
from shiftsim.runs.tables import TaskResult
from shiftsim.runs.task import score_rollout
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.loop import simulate

PLANNER, NOISE = "constant-velocity", "ou-high"
FEW, MANY = 2, 10  # seeds
ALL = 10_000  # scenarios of the long run
MOST_EXPONENT = 1.05
CODE = """
import json, re, resource, sys, time
import shiftsim
values = json.loads(sys.argv[1])
seeds = range(values.pop("num_seeds"))
began = time.perf_counter()
run = shiftsim.run("constant-velocity", noise="ou-high", seeds=seeds, **values)
wall = time.perf_counter() - began
own, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
status = open("/proc/self/status").read()  # ru_maxrss would be inherited
assert run.is_complete
print(json.dumps({
    "wall": wall,
    "cpu": own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime,
    "memory": int(re.search(r"VmHWM:\\s*(\\d+)", status)[1]) * 1024,
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
    return open_store("demo")


@pytest.fixture(scope="module")
def seeds(size):
    """How many seeds a short and a long run have."""
    return size(FEW), size(MANY, 2)


@pytest.fixture(scope="module")
def runs(store, seeds, tmp_path_factory):
    """Short and long runs with one and with two worker processes."""
    folder = tmp_path_factory.mktemp("runs")
    measured_run(folder, num_seeds=1, workers=2)  # warm
    return {
        (workers, count): measured_run(folder, num_seeds=count, workers=workers, timeout=600.0)
        for workers in (1, 2)
        for count in seeds
    }


def per_task(runs, workers, quantity):
    few, many = (run for (count, _), run in sorted(runs.items()) if count == workers)
    return (many[quantity] - few[quantity]) / (many["tasks"] - few["tasks"])


def verdict(is_met):
    return "met" if is_met else "NOT MET"


class Answer:
    """Stands for a worker that has a result already."""

    def __init__(self, result: TaskResult) -> None:
        self.result = result

    def __call__(self, number: int) -> list[TaskResult]:
        return [self.result]


def median_seconds(function: Callable[[], object], rounds: int) -> float:
    """CPU time of one call [s]."""
    times = []
    for _ in range(rounds):
        began = process_time()
        function()
        times.append(process_time() - began)
    return float(np.median(times))


def spent() -> float:
    """CPU time of this process and of those that have ended [s]."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def handing_over(result: TaskResult, count: int) -> float:
    """CPU time of so many tasks that cost nothing, in all processes [s]."""
    began = spent()
    for _ in map_unordered(partial(Answer, result), range(count), workers=2):
        pass
    return spent() - began


def ending(folder: Path, result: TaskResult, count: int) -> float:
    """CPU time of finishing a run with so many results [s]."""
    determining: dict[str, object] = {"store": "", "traffic": "", "controller": "", "planners": {}}
    manifest = {
        **{"format": FORMAT_VERSION, "state": "finished", "split": "", "store": "", "counts": {}},
        "config": {"planners": [PLANNER], "noise": [NOISE], "seeds": [0]},
        "determining": determining | {"metric_version": "", "thresholds": {"name": ""}},
    }
    writer = RunWriter(folder, manifest)
    tasks = [result.task._replace(token=f"{number:016x}") for number in range(count)]
    for task in tasks:
        writer.add(replace(result, task=task))
    began = process_time()
    writer.finish(manifest, tasks)
    return process_time() - began


def test_overhead_per_scenario(store, size, tmp_path):
    scenario = store.read(store.tokens[0])
    task = Task(PLANNER, NOISE, 0, scenario.token)
    log = simulate(scenario, load_planner(PLANNER), noise=NOISE)
    scores, metrics = score_rollout(scenario, log, make_config({"planners": [PLANNER]}))

    def encode() -> bytes:
        return encode_rows(rollout_rows(log, with_tracks=False))

    result = TaskResult(task, "ok", scores=scores, metrics=metrics, rollout=encode())
    writer = RunWriter(tmp_path / "run", {})
    few, more = size(200, 10), size(2000, 20)
    parts = {
        "encode the rollout": median_seconds(encode, size(200)),
        "put the result on disk": median_seconds(partial(writer.add, result), size(200)),
        "hand over task and result": (handing_over(result, few + more) - handing_over(result, few))
        / more,
        "tables and files at the end": ending(tmp_path / "ended", result, more) / more,
    }
    writer.close()
    over = sum(parts.values())
    text = ", ".join(f"{name} {value * 1e3:.2f}" for name, value in parts.items())
    print(
        f"\noverhead per scenario beyond reading, simulating and scoring: {over * 1e3:.2f} ms "
        f"({text}), target 2 ms {verdict(over <= 2e-3)}"
    )


def test_efficiency_of_two_workers(runs):
    one, two = (per_task(runs, workers, "wall") for workers in (1, 2))
    efficiency = one / two / 2
    print(
        f"\nper scenario {one * 1e3:.2f} ms with one worker, {two * 1e3:.2f} ms with two: "
        f"efficiency {100 * efficiency:.0f} %, target 85 % {verdict(efficiency >= 0.85)}"
    )


def test_cost_over_the_number_of_scenarios(size, note, tmp_path):
    """How CPU time above that of a single scenario grows to 1,000: a fitted exponent."""
    cpu, most = itemgetter("cpu"), size(13, 2)
    measured_run(tmp_path, num_seeds=1, workers=1, limit=1)  # warm

    def spent_by(**settings):
        return min((measured_run(tmp_path, workers=1, **settings) for _ in range(size(2))), key=cpu)

    one = spent_by(num_seeds=1, limit=1)
    runs = [spent_by(num_seeds=count) for count in sorted({1, (most + 2) // 3, most})]
    counts, costs = [run["tasks"] for run in runs], [cpu(run) - cpu(one) for run in runs]
    exponent = np.polyfit(np.log(counts), np.log(costs), 1)[0]
    shown = ", ".join(f"{count}: {cost:.2f}" for count, cost in zip(counts, costs, strict=True))
    print(
        f"\none scenario: {cpu(one):.2f} CPU-s with all that a run needs, more for {shown}; "
        f"exponent {exponent:.2f}, at most {MOST_EXPONENT:g} {verdict(exponent <= MOST_EXPONENT)}"
    )
    note(**{f"scenarios_{count}": cost for count, cost in zip(counts, costs, strict=True)})


def test_memory_of_ten_thousand_scenarios(store, size, tmp_path):
    scenarios = size(ALL, 20)
    counts = [scenarios // 10 // len(store.tokens) + 1, scenarios // len(store.tokens) + 1]
    short, long = (measured_run(tmp_path, num_seeds=count, workers=2) for count in counts)
    text = ", ".join(f"{run['memory'] / 1e6:.0f} MB after {run['tasks']}" for run in (short, long))
    print(
        f"\nmain process: {text} scenarios in {long['wall']:.0f} s, "
        f"target 500 MB {verdict(long['memory'] <= 500e6)}"
    )


@pytest.mark.parametrize(("traffic", "target"), [("nonreactive", 20.0), ("reactive", 30.0)])
@pytest.mark.parametrize("planner", ["idm", "pdm-closed"])
def test_room_of_rollouts_on_disk(planner, traffic, target, size, tmp_path):
    run = shiftsim.run(
        planner,
        noise=NOISE,
        split="demo-mini",
        limit=size(16, 2),
        traffic=traffic,
        workers=1,
        out=str(tmp_path / "run"),
    )
    files = (run.path / "rollouts").iterdir()
    each = sum(file.stat().st_size for file in files) / len(run.tasks) / 1e3
    print(
        f"\nrollout of {planner} in {traffic} traffic: {each:.1f} kB, target {target:.0f} kB "
        f"{verdict(each <= target)}"
    )
