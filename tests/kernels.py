"""Compile the kernels that many tests need, once, before two workers would both compile them."""

import hashlib
import importlib.util
import subprocess
import sys
from functools import cache

import numpy as np

from shiftsim.files import PACKAGE, kernel_folders, sources
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.warmup import SHARES, scene
from shiftsim.world.scenario import Scenario

GROUPS = (
    ("routes", "contacts", "pdm-closed", "plantf", "pluto"),
    ("planners", "reactive", "environment", "diffusion-planner", "carl"),
)
LEARNED = ("carl", "diffusion-planner", "plantf", "pluto")


def compile_all() -> None:
    """Do nothing where it has been done; a process for each of `GROUPS` otherwise."""
    everything = sources(path for path in PACKAGE.rglob("*.py"))
    digest = hashlib.sha256(repr(sorted(everything.items())).encode()).hexdigest()
    marker = kernel_folders()[0] / f"compiled-for-tests-{digest[:16]}"
    if marker.exists():
        return
    processes = [subprocess.Popen([sys.executable, __file__, *group]) for group in GROUPS]
    if not any([process.wait() for process in processes]):
        marker.parent.mkdir(parents=True, exist_ok=True)
        marker.touch()


def compile_share(name: str) -> None:
    """Compile one of `SHARES`, or what a planner or reactive traffic needs."""
    if name in SHARES:
        SHARES[name]()
    elif name == "reactive":
        simulate(scene(), load_planner("constant-velocity"), traffic=name)
    elif name == "environment":
        compile_environment()
    elif name not in LEARNED:
        simulate(scene(), load_planner(name))
    elif importlib.util.find_spec("torch"):
        simulate(scene(), load_planner(name, {"checkpoint": "deterministic:drive"}))


_scene = cache(scene)  # layouts of the last maps are kept


def compile_environment() -> None:
    """Drive a few steps of an environment, where there is Gymnasium."""
    if not importlib.util.find_spec("gymnasium"):
        return
    from shiftsim.env.driving import DrivingEnv

    class One:
        tokens = ("it",)

        def read(self, token: str) -> Scenario:
            return _scene()

    for observation in ("vector", "raster"):
        env = DrivingEnv(store=One(), observation=observation, terminate=False)
        env.reset()
        for _ in range(5):
            env.step(np.zeros(2))


if __name__ == "__main__":
    for share in sys.argv[1:]:
        compile_share(share)
