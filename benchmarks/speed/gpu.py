"""Rollouts per second on a GPU, beside the CPU: python benchmarks/speed/gpu.py STORE.

Learned planners drive whole rollouts in lock step, in batches over scenarios and seeds, as a worker
of a run does: features, one forward pass, plans, motion. All of them are scored, and compared with
those that the CPU drove one by one. Then several workers do the same, and one process has the
network for all of them; there reading and scoring count, too.
"""

import argparse
import platform
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from time import monotonic, perf_counter
from typing import Any

import numpy as np

from shiftsim.data.store.reading import open_store
from shiftsim.metrics import compute_metrics
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.checkpoint import resolve_device
from shiftsim.planners.learned.owner import Address, InferenceClient, InferenceServer, new_address
from shiftsim.planners.registry import load_planner, planner_factory
from shiftsim.processes import in_background
from shiftsim.runs.config import default_workers
from shiftsim.runs.workers import map_unordered
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.loop import Rollout, simulate_together
from shiftsim.world.scenario import Scenario

PLANNERS = ("plantf", "pluto", "diffusion-planner", "carl")
BATCHES = (1, 16, 64, 256)
SAME = 1e-6  # of scores


def device_name(device: str) -> str:
    """What a device of torch is called."""
    import torch

    if device != "cpu":
        return torch.cuda.get_device_name(device)
    with open("/proc/cpuinfo") as lines:
        names = [line.partition(": ")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def drive(
    planner: LearnedPlanner, tasks: Sequence[tuple[Scenario, int]], batch: int
) -> tuple[float, list[SimulationLog]]:
    """Rollouts per second over all tasks, of a scenario and a seed each, and their logs.

    Raises:
        Exception: Whatever ended one of the rollouts.
    """
    warm(planner, tasks[0][0])
    began = perf_counter()
    logs = rollouts(planner, tasks, batch)
    return len(tasks) / (perf_counter() - began), logs


def warm(planner: LearnedPlanner, scenario: Scenario) -> None:
    """Compile the kernels, and set up the device."""
    simulate_together([Rollout(cut(scenario, 3), planner.fork())])


def rollouts(
    planner: LearnedPlanner, tasks: Sequence[tuple[Scenario, int]], batch: int
) -> list[SimulationLog]:
    """The logs of scenarios and seeds, driven in batches."""
    logs: list[SimulationLog] = []
    for start in range(0, len(tasks), batch):
        part = tasks[start : start + batch]
        begun = [Rollout(scene, planner.fork(), seed=seed) for scene, seed in part]
        for outcome in simulate_together(begun):
            if isinstance(outcome, Exception):
                raise outcome
            logs.append(outcome)
    return logs


class Worker:
    """Drives batches of (token, seed) with a planner whose network another process has."""

    def __init__(self, store: str, iterations: int, name: str, address: Address) -> None:
        """Open the store, and be ready."""
        self.store, self.iterations = open_store(store), iterations
        self.planner = planner_factory(name).asking(InferenceClient(address, name))
        warm(self.planner, self.read(self.store.tokens[0]))

    def read(self, token: str) -> Scenario:
        """A scenario, cut where that is asked for."""
        scenario = self.store.read(token)
        return cut(scenario, self.iterations) if self.iterations else scenario

    def __call__(self, tasks: Sequence[tuple[str, int]]) -> tuple[float, float, np.ndarray]:
        """When they began and ended [s], and their scores."""
        began = monotonic()
        pairs = [(self.read(token), seed) for token, seed in tasks]
        found = scores(rollouts(self.planner, pairs, len(pairs)), [scene for scene, _ in pairs])
        return began, monotonic(), found


class Repeating:
    """A planner whose network takes no time, to see what asking another process costs."""

    def __init__(self, outputs: Sequence[Any]) -> None:
        self.outputs = outputs

    def infer(self, features: Sequence[Any]) -> Sequence[Any]:
        """The same outputs every time."""
        return self.outputs


def drive_in_workers(
    make_planner: Any, make_worker: Any, tasks: Sequence[tuple[str, int]], batch: int, workers: int
) -> tuple[float, np.ndarray]:
    """Rollouts per second of all workers, and the scores, with one process for the network.

    Raises:
        RuntimeError: A worker died.
    """
    address = new_address()
    parts = [tuple(tasks[start : start + batch]) for start in range(0, len(tasks), batch)]
    done = {}
    with in_background(partial(InferenceServer, make_planner, address)):
        make = partial(make_worker, address)
        for outcome in map_unordered(make, parts, workers=workers):
            if outcome.result is None:
                raise RuntimeError(outcome.death)
            done[outcome.task] = outcome.result
    spent = max(ended for _, ended, _ in done.values()) - min(began for began, *_ in done.values())
    return len(tasks) / spent, np.concatenate([done[part][2] for part in parts])


def cut(scenario: Scenario, iterations: int) -> Scenario:
    """The first iterations of a scenario."""
    return replace(scenario, iteration_rows=scenario.iteration_rows[:iterations])


def scores(logs: Sequence[SimulationLog], scenarios: Sequence[Scenario]) -> np.ndarray:
    """(S,) of rollouts."""
    pairs = zip(logs, scenarios, strict=True)
    return np.array([compute_metrics(log, scene.map).score for log, scene in pairs])


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print a line for each planner, device and size of a batch."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("store")
    parser.add_argument("--device", default="auto", help="what is measured beside the CPU [auto]")
    parser.add_argument("--planners", nargs="+", default=PLANNERS)
    parser.add_argument("--checkpoint", default="deterministic:drive")
    parser.add_argument("--batches", nargs="+", type=int, default=BATCHES)
    parser.add_argument("--scenarios", type=int, default=64, help="the first of the store [64]")
    parser.add_argument("--seeds", type=int, default=4, help="rollouts of each scenario [4]")
    parser.add_argument("--iterations", type=int, default=0, help="0: all of a scenario [0]")
    parser.add_argument("--workers", type=int, default=default_workers(), help="[one per core]")
    given = parser.parse_args(arguments)

    store = open_store(given.store)
    scenes = [store.read(token) for token in store.tokens[: given.scenarios]]
    scenes = [cut(scene, given.iterations) for scene in scenes] if given.iterations else scenes
    tasks = [(scene, seed) for seed in range(given.seeds) for scene in scenes]
    driven = [scene for scene, _ in tasks]
    device = resolve_device(given.device)
    for place in dict.fromkeys(("cpu", device)):
        print(f"{place}: {device_name(place)}")
    if device == "cpu":
        print("no GPU: the same path on the CPU")
    for name in given.planners:
        options = {"checkpoint": given.checkpoint}
        on_cpu = load_planner(name, {**options, "device": "cpu"})
        there = on_cpu if device == "cpu" else load_planner(name, {**options, "device": device})
        alone: np.ndarray | None = None
        tokens = [(scene.token, seed) for scene, seed in tasks]
        for place, planner in {"cpu": on_cpu, device: there}.items():
            for batch in given.batches:
                rate, logs = drive(planner, tasks, batch)
                found = scores(logs, driven)
                alone = found if alone is None else alone
                print(row(name, place, f"batch {batch:3}", rate, found, alone), flush=True)
        make_planner = {name: partial(load_planner, name, {**options, "device": device})}
        make_worker = partial(Worker, given.store, given.iterations, name)
        for batch in given.batches:
            if batch * given.workers > len(tasks):
                continue  # some would have nothing to do
            rate, found = drive_in_workers(make_planner, make_worker, tokens, batch, given.workers)
            what = f"batch {batch:3}, {given.workers} workers"
            print(row(name, device, what, rate, found, alone), flush=True)


def row(
    name: str, place: str, what: str, rate: float, found: np.ndarray, alone: np.ndarray | None
) -> str:
    """A line of the table."""
    differ = np.count_nonzero(np.abs(found - alone) > SAME) / len(found)
    return (
        f"{name:17} {place:7} {what}: {rate:8.3f} rollouts/s, mean score {100 * found.mean():.2f}, "
        f"{100 * differ:.1f} % of scores differ from those on the CPU one at a time"
    )


if __name__ == "__main__":
    from shiftsim.benchmarks.speed import gpu  # by a name that workers can import

    gpu.main()
