"""Rollouts per second on a GPU, beside the CPU: python benchmarks/speed/gpu.py STORE.

Learned planners drive whole rollouts in lock step, in batches over scenarios and seeds, as a worker
of a run does: features, one forward pass, plans, motion. All of them are scored, and compared with
those that the CPU drove one by one.
"""

import argparse
import platform
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from shiftsim.data.store.reading import open_store
from shiftsim.metrics import compute_metrics
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.device import resolve_device
from shiftsim.planners.registry import load_planner
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
    simulate_together([Rollout(cut(tasks[0][0], 3), planner.fork())])  # kernels, and the device
    logs: list[SimulationLog] = []
    began = perf_counter()
    for start in range(0, len(tasks), batch):
        part = tasks[start : start + batch]
        rollouts = [Rollout(scene, planner.fork(), seed=seed) for scene, seed in part]
        for outcome in simulate_together(rollouts):
            if isinstance(outcome, Exception):
                raise outcome
            logs.append(outcome)
    return len(tasks) / (perf_counter() - began), logs


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
        for place, planner in {"cpu": on_cpu, device: there}.items():
            for batch in given.batches:
                rate, logs = drive(planner, tasks, batch)
                found = scores(logs, driven)
                alone = found if alone is None else alone
                differ = np.count_nonzero(np.abs(found - alone) > SAME) / len(found)
                print(
                    f"{name:17} {place:7} batch {batch:3}: {rate:8.3f} rollouts/s, mean score "
                    f"{100 * found.mean():.2f}, {100 * differ:.1f} % of scores differ from "
                    f"those on the CPU at batch {given.batches[0]}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
