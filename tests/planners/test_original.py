"""Copies of a planner: what they share, and what they do not."""

import threading

import numpy as np
import pytest

from shiftsim.errors import ConfigError
from shiftsim.kernels import readonly
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.prototype import PlannerPrototype
from shiftsim.planners.registry import run_planner


class Holder(ConstantVelocity):
    def __init__(self):
        self.seen = [1]
        self.table = readonly(np.arange(5.0))
        self.scratch = np.zeros(5)
        self.closed = []

    def close(self):
        self.closed.append(True)


def test_a_copy_has_a_state_of_its_own_and_shares_what_nobody_can_write():
    original = PlannerPrototype(Holder)
    first = original.copy()
    first.seen.append(2)
    first.scratch[0] = 7.0
    second = original.copy()
    assert second.seen == [1]
    assert second.scratch[0] == 0.0
    assert second.table is first.table is original.planner.table


def test_networks_are_shared():
    torch = pytest.importorskip("torch")

    class Net(ConstantVelocity):
        def __init__(self):
            self.network = torch.nn.Linear(3, 3)
            self.steps = []

    Net.__qualname__ = Net.__name__
    globals()["Net"] = Net
    original = PlannerPrototype(Net)
    copied = original.copy()
    assert copied.network is original.planner.network
    assert copied.steps is not original.planner.steps


class Locked(Holder):
    """Cannot be pickled."""

    def __init__(self):
        super().__init__()
        self.lock = threading.Lock()


def test_what_cannot_be_pickled_is_made_again():
    made = []

    def make():
        made.append(Locked())
        return made[-1]

    original = PlannerPrototype(make)
    assert original.copy() is made[1]
    assert original.copy() is made[2]


class Team(ConstantVelocity):
    def __init__(self):
        self.forks = 0

    def fork(self):
        self.forks += 1
        return Team()

    def plan_batch(self, planners, observations):
        return [one.plan(seen) for one, seen in zip(planners, observations, strict=True)]


def test_a_batch_planner_is_forked():
    original = PlannerPrototype(Team)
    assert original.planner.forks == 0
    copied = original.copy()
    assert original.planner.forks == 1
    assert copied.forks == 0


def test_an_instance_is_forked_or_copied_or_refused():
    planner = Team()
    assert run_planner(planner, {}).prototype.copy() is not planner
    assert planner.forks == 1
    with pytest.raises(ConfigError, match="cannot be copied"):
        run_planner(Locked(), {})


def test_a_copy_is_closed_when_it_has_driven():
    original = PlannerPrototype(Holder)
    copied = original.copy()
    original.release(copied)
    assert copied.closed == [True]
    assert original.planner.closed == []
