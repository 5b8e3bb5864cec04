"""Branches of one state: 32 plans of 8 s, driven and rated, and a snapshot."""

import pickle

import numpy as np
import pytest

import shiftsim
from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.sim.loop import Rollout

TARGETS = {"nonreactive": 15e-3, "reactive": 150e-3}  # s
COUNT, STEPS = 32, 80


@pytest.fixture
def rollout(request):
    out = Rollout(bench_scene(30, 0), ConstantVelocity(), traffic=request.param)
    while out.iteration < 40:
        out.advance(out.planner.plan(out.observe()))
    return out


@pytest.mark.parametrize("rollout", TARGETS, indirect=True)
def test_branches(measure, rollout, request):
    snapshot, speed = rollout.snapshot(), float(rollout.observe().ego.values[3])
    times = 0.1 * np.arange(1, STEPS + 1)
    turns = np.linspace(-0.05, 0.05, COUNT)[:, None] * times
    plans = np.stack([speed * times * np.cos(turns), speed * times * np.sin(turns), turns], -1)

    def branch():
        shiftsim.branch(snapshot, plans, STEPS)

    name = request.node.callspec.params["rollout"]
    measure(branch, calls=1, target=TARGETS[name])


@pytest.mark.parametrize("rollout", ["reactive"], indirect=True)
def test_a_snapshot(measure, rollout, size):
    assert len(pickle.dumps(rollout.snapshot())) < 20_000
    measure(rollout.snapshot, calls=size(100), target=50e-6)
