"""The environment: a step and a reset, with each observation, in the city scene with 100 agents."""

from functools import partial
from operator import getitem
from time import perf_counter
from types import SimpleNamespace

import numpy as np
import pytest

from shiftsim.benchmarks.speed.city import bench_scene

pytest.importorskip("gymnasium")

TARGETS = {"none": 60e-6, "vector": 0.15e-3, "raster": 0.7e-3}  # s
RESET_TARGET = 8e-3  # s
ACTION = np.array([0.1, 0.0], np.float32)


@pytest.fixture(scope="module")
def source():
    """A source of one scenario, which can be sent to a process."""
    scenario = bench_scene(100, 0)
    read = partial(getitem, {scenario.token: scenario})
    return SimpleNamespace(tokens=(scenario.token,), read=read)


@pytest.fixture
def env(source, request):
    from shiftsim.env.driving import DrivingEnv

    return DrivingEnv(store=source, observation=request.param, noise="ou-high", terminate=False)


@pytest.mark.parametrize("env", TARGETS, indirect=True)
def test_step(measure, env, request, size):
    """The step in the middle of an episode; the metrics at its end are measured elsewhere."""
    name = request.node.callspec.params["env"]
    env.reset(seed=0)
    for _ in range(75):
        env.step(ACTION)

    def step():
        if env.episode.iteration >= 145:
            env.reset()
        env.step(ACTION)

    measure(step, calls=size(10), target=TARGETS[name])


@pytest.mark.parametrize("env", TARGETS, indirect=True)
def test_reset(measure, env):
    env.reset(seed=0)
    measure(env.reset, calls=1, target=RESET_TARGET)


def test_reset_from_a_store(measure):
    """With a scenario of the demo, which is read each time."""
    from shiftsim.env.driving import DrivingEnv

    env = DrivingEnv(store="demo")
    env.reset(seed=0)
    measure(env.reset, calls=1, target=RESET_TARGET)


def test_processes(note, size, source):
    """Steps of many environments with rasters: in one process, and in a process each."""
    import gymnasium

    import shiftsim.env

    count = size(8, 2)
    settings = {"num_envs": count, "store": source, "observation": "raster", "noise": "ou-high"}
    make = partial(gymnasium.make_vec, shiftsim.env.ID, terminate=False, **settings)
    made = {"one": make(), "each": make(num_workers=count)}
    actions = np.tile(ACTION, (count, 1))
    for envs in made.values():
        envs.reset(seed=0)
        for _ in range(size(10)):
            envs.step(actions)
    best = dict.fromkeys(made, np.inf)
    for _ in range(size(30)):  # by turns, as a machine is never quiet for long
        for name, envs in made.items():
            for _ in range(size(5)):
                began = perf_counter()
                envs.step(actions)
                best[name] = min(best[name], (perf_counter() - began) / count)
    for envs in made.values():
        envs.close()
    note(**{f"vector_step_{name}": seconds for name, seconds in best.items()})
    each = ", ".join(f"{name} {1e6 * seconds:.0f} µs" for name, seconds in best.items())
    print(f"\nper environment and step: {each}", end="")
