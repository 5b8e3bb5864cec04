"""Rule-based planners and the check of a plan: figures per call, from Python, warm.

Run with `pytest benchmarks/speed/test_planners.py -s`.
"""

from dataclasses import replace

import numpy as np
import pytest
from plans import recorded_inputs

from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import Rollout, simulate
from shiftsim.sim.plan_check import find_fault
from shiftsim.world.state import LightStatus, TrafficLights

LIGHTS_TARGET = 0.3e-3  # s


@pytest.fixture(scope="module")
def scenario():
    """A generated city with 100 agents around the ego."""
    from shiftsim.benchmarks.speed.city import bench_scene

    return bench_scene(100, 0)


@pytest.fixture(scope="module")
def lit_scenario():
    """The same city with lights, and connectors of 150 vertices."""
    from shiftsim.benchmarks.speed.city import bench_scene

    return bench_scene(100, 0, lights=True)


@pytest.mark.parametrize("name", ["constant-velocity", "simple", "log-future", "idm"])
def test_plan(measure, scenario, name):
    planner = load_planner(name)
    scene, observations = recorded_inputs(scenario, planner)
    planner.reset(scene)
    planner.plan(observations[0])
    measure(planner.plan, observations[0], calls=10)


def test_idm_at_red_lights(measure, scenario):
    """All lanes and connectors of the city are red."""
    scene, observations = recorded_inputs(scenario)
    ids = scene.map.edges.ids
    lights = TrafficLights(ids, np.full((1, len(ids)), 2, np.int8)).readonly()
    planner = load_planner("idm")
    planner.reset(scene)
    measure(planner.plan, replace(observations[0], lights=lights), calls=2, target=LIGHTS_TARGET)


def test_idm_at_a_red_light_with_large_connectors(measure, lit_scenario):
    """What a rollout asks for at a junction whose connectors have 150 vertices."""
    planner = load_planner("idm")
    observation = Rollout(lit_scenario, planner).observe()
    assert (observation.lights.status == LightStatus.RED).sum() > 100
    measure(planner.plan, observation, calls=2, target=LIGHTS_TARGET)


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
def test_idm_scenario_with_large_connectors(measure, lit_scenario, traffic):
    planner = load_planner("idm")
    measure(lambda: simulate(lit_scenario, planner, traffic=traffic), calls=1)


def test_check_plan(measure, scenario):
    scene, observations = recorded_inputs(scenario)
    planner = load_planner("constant-velocity")
    planner.reset(scene)
    plan = planner.plan(observations[0])
    now, after = observations[0].time_us, observations[1].time_us
    measure(find_fault, plan, now, after)
