"""PDM-Closed: one planning step, from Python, warm.

Run with `pytest benchmarks/speed/test_pdm.py -s`. Targets on one core: 6 ms with 100 agents.
"""

import pytest
from plans import recorded_inputs

from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate


@pytest.fixture(scope="module")
def scenario():
    """A generated city with 100 agents around the ego."""
    from shiftsim.data.demo.store import bench_scene

    return bench_scene(100, 0)


@pytest.fixture
def ready(scenario):
    """A planner that has planned once, and an observation."""
    scene, observations = recorded_inputs(scenario)
    planner = load_planner("pdm-closed")
    planner.reset(scene)
    planner.plan(observations[0])
    return planner, observations[0]


def test_step(measure, ready):
    planner, observation = ready
    measure(planner.plan, observation, calls=3, target=6e-3)


def test_scenario(benchmark, scenario):
    """A whole non-reactive scenario."""
    planner = load_planner("pdm-closed")
    benchmark.pedantic(simulate, args=(scenario, planner), rounds=3, warmup_rounds=1)
    if benchmark.enabled:
        print(f"\nscenario: {benchmark.stats.stats.median:.2f} s", end="")
