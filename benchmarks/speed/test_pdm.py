"""PDM-Closed: one planning step, and whole scenarios, from Python, warm.

Run with `pytest benchmarks/speed/test_pdm.py -s`. Targets on one core are below.
"""

from time import process_time

import pytest
from plans import recorded_inputs

import shiftsim
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate

STEP_TARGET = 6e-3  # s, with 100 agents
SCENARIO_TARGETS = {"small": 0.12, "city": 0.25, "city with lights": 0.25}  # s, non-reactive


@pytest.fixture(scope="module")
def scenes():
    """One of the demo, and a generated city with 100 agents, without and with red lights."""
    from shiftsim.benchmarks.speed.city import bench_scene

    store = shiftsim.open_store("demo")
    return {
        "small": store.read(next(iter(store.tokens))),
        "city": bench_scene(100, 0),
        "city with lights": bench_scene(100, 0, lights=True),
    }


@pytest.fixture
def ready(scenes):
    """A planner that has planned once, and an observation."""
    scene, observations = recorded_inputs(scenes["city"])
    planner = load_planner("pdm-closed")
    planner.reset(scene)
    planner.plan(observations[0])
    return planner, observations[0]


def test_step(measure, ready):
    planner, observation = ready
    measure(planner.plan, observation, calls=3, target=STEP_TARGET)


@pytest.mark.parametrize("name", SCENARIO_TARGETS)
def test_scenario(note, scenes, size, name):
    """A whole non-reactive scenario, by CPU time."""
    planner, times = load_planner("pdm-closed"), []
    for _ in range(size(4)):
        began = process_time()
        simulate(scenes[name], planner)
        times.append(process_time() - began)
    best, target = min(times), SCENARIO_TARGETS[name]
    verdict = "met" if best <= target else "NOT MET"
    print(f"\npdm-closed, {name}: {best:.3f} s, target {target:g} s {verdict}", end="")
    note(scenario=best)
