"""Compile the kernels that many tests need, once, before two workers would both compile them."""

import importlib.util
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from worlds import cruise_scenario, standing_tracks

from shiftsim.kernels import CACHE_FOLDER, kernel_hash
from shiftsim.metrics import compute_metrics
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind

GROUPS = (
    ("pdm-closed", "plantf", "pluto"),
    ("metrics", "reactive", "environment", "diffusion-planner", "carl"),
)
LEARNED = ("carl", "diffusion-planner", "plantf", "pluto")


def compile_all() -> None:
    """Do nothing where it has been done; a process for each of `GROUPS` otherwise."""
    marker = Path(CACHE_FOLDER, f"compiled-for-tests-{kernel_hash()}")
    if marker.exists():
        return
    processes = [subprocess.Popen([sys.executable, __file__, *group]) for group in GROUPS]
    if not any([process.wait() for process in processes]):
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()


def compile_share(name: str) -> None:
    """Compile the metrics, or what a planner, reactive traffic or the environment needs."""
    if name == "metrics":
        log = simulate(scene(), load_planner("constant-velocity"))
        compute_metrics(log, scene().map)
    elif name == "reactive":
        simulate(scene(), load_planner("constant-velocity"), traffic=name)
    elif name == "environment":
        compile_environment()
    elif name not in LEARNED:
        simulate(scene(), load_planner(name))
    elif importlib.util.find_spec("torch"):
        simulate(scene(), load_planner(name, {"checkpoint": "deterministic:drive"}))


@cache
def scene() -> Scenario:
    """A slow ego close behind a car, a cone on the lane, another car, in time for every model."""
    scenario = cruise_scenario(speed=4.0, iterations=12, start=(205.0, 0.0, 0.0))
    poses = np.array([[217.0, 0.0, 0.0], [240.0, 0.2, 0.0], [225.0, 3.5, 0.1]])
    kinds = [AgentKind.VEHICLE, AgentKind.TRAFFIC_CONE, AgentKind.VEHICLE]
    return replace(scenario, tracks=standing_tracks(len(scenario.time_us), poses, kinds))


def compile_environment() -> None:
    """Drive a few steps of an environment, where there is Gymnasium."""
    if not importlib.util.find_spec("gymnasium"):
        return
    from shiftsim.env.driving import DrivingEnv

    class One:
        tokens = ("it",)

        def read(self, token: str) -> Scenario:
            return scene()

    for observation in ("vector", "raster"):
        env = DrivingEnv(store=One(), observation=observation, terminate=False)
        env.reset()
        for _ in range(5):
            env.step(np.zeros(2))


if __name__ == "__main__":
    for share in sys.argv[1:]:
        compile_share(share)
