"""The environment: a step and a reset, with each observation, in the city scene with 100 agents."""

import numpy as np
import pytest

from shiftsim.data.demo.store import bench_scene

pytest.importorskip("gymnasium")

TARGETS = {"none": 60e-6, "vector": 0.15e-3, "raster": 0.7e-3}  # s
RESET_TARGET = 8e-3  # s
ACTION = np.array([0.1, 0.0], np.float32)


class One:
    """A source of one scenario."""

    def __init__(self, scenario):
        self._scenario, self.tokens = scenario, (scenario.token,)

    def read(self, token):
        return self._scenario


@pytest.fixture(scope="module")
def source():
    return One(bench_scene(100, 0))


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
