"""Each broken planner breaks one rule; the check must name that rule, and only that one."""

import re
import time
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.errors import ConfigError
from shiftsim.planners.contract import check_planner
from shiftsim.world.state import Command, Trajectory

TIMES = np.arange(41) * 0.1


class Straight:
    def reset(self, scene):
        self.calls = 0

    def plan(self, observation):
        x, y, heading = observation.ego.pose
        return self.poses(x, y, heading, observation.ego.speed)

    def poses(self, x, y, heading, speed):
        along = TIMES * speed
        poses = np.c_[x + along * np.cos(heading), y + along * np.sin(heading), 0 * TIMES + heading]
        return Trajectory.from_poses(TIMES, poses)


class NeedsArgument(Straight):
    def __init__(self, gain):
        self.gain = gain


class NoReset:
    def plan(self, observation):
        return Command(0.0, 0.0)


class FailsInReset(Straight):
    def reset(self, scene):
        raise RuntimeError("no weights")


class FailsInPlan(Straight):
    def plan(self, observation):
        raise KeyError("lane")


class ReturnsPoses(Straight):
    def plan(self, observation):
        return np.zeros((3, 3))


class WrongShape(Straight):
    def plan(self, observation):
        return Trajectory(np.arange(81) * 100_000, np.zeros((81, 3)), relative=True)


class RepeatsATime(Straight):
    def plan(self, observation):
        return Trajectory.from_poses([0.0, 0.1, 0.1], np.zeros((3, 3)))


class NotFinite(Straight):
    def poses(self, x, y, heading, speed):
        return Trajectory.from_poses(TIMES, np.full((41, 3), np.nan))


class StopsShort(Straight):
    def plan(self, observation):
        plan = super().plan(observation)
        times = observation.time_us - 4_000_000 + plan.time_us
        return Trajectory(times, plan.states)


class TwoPoses(Straight):
    def plan(self, observation):
        plan = super().plan(observation)
        return Trajectory(plan.time_us[:2], plan.states[:2], relative=True)


class TooLong(Straight):
    def plan(self, observation):
        plan = super().plan(observation)
        return Trajectory(plan.time_us * 1_000_000, plan.states, relative=True)


class Short(Straight):
    def plan(self, observation):
        plan = super().plan(observation)
        return Trajectory(plan.time_us[:6], plan.states[:6], relative=True)


class EgoFrame(Straight):
    def plan(self, observation):
        return self.poses(0.0, 0.0, 0.0, observation.ego.speed)


class Beside(Straight):
    def poses(self, x, y, heading, speed):
        return super().poses(x, y + 3.0, heading, speed)


class FailsLater(Straight):
    def plan(self, observation):
        if observation.iteration == 30:
            return super().poses(np.nan, 0.0, 0.0, 1.0)
        return super().plan(observation)


class InDegrees(Straight):
    def poses(self, x, y, heading, speed):
        plan = super().poses(x, y, heading, speed)
        plan.states[5:, 2] = 90.0
        return plan


class Backwards(Straight):
    def poses(self, x, y, heading, speed):
        return super().poses(x, y, heading + np.pi, speed)


class Random(Straight):
    def poses(self, x, y, heading, speed):
        return super().poses(x + np.random.default_rng().normal() * 0.01, y, heading, speed)


class KeepsState(Straight):
    calls = 0

    def reset(self, scene): ...

    def poses(self, x, y, heading, speed):
        self.calls += 1
        return super().poses(x, y + 0.001 * self.calls, heading, speed)


class WritesEgo(Straight):
    def plan(self, observation):
        observation.history.ego[-1, 0] += 1.0
        return super().plan(observation)


class ForcesWrites(Straight):
    def plan(self, observation):
        observation.history.ego.flags.writeable = True
        observation.history.ego[0, 10] += 1.0
        return super().plan(observation)


class HoldsALambda(Straight):
    def __init__(self):
        self.gain = lambda speed: speed


class BadCommand(Straight):
    def plan(self, observation):
        return Command(float("inf"), 0.0)


class Leaves(Straight):
    def plan(self, observation):
        raise SystemExit("no weights")


class InThirtyTwoBits(Straight):
    def poses(self, x, y, heading, speed):
        plan = super().poses(x, y, heading, speed)
        plan.states[:, :2] = plan.states[:, :2].astype(np.float32)
        return plan


class SteersInDegrees(Straight):
    def plan(self, observation):
        return Command(0.0, 30.0)


class KeepsInTheClass(Straight):
    seen: ClassVar = []

    def reset(self, scene):
        KeepsInTheClass.seen.append(scene.token)
        self.works = scene.token == "other" or "other" not in self.seen

    def poses(self, x, y, heading, speed):
        return super().poses(x if self.works else np.nan, y, heading, speed)


class Hangs(Straight):
    def plan(self, observation):
        if observation.iteration == 3:
            raise KeyboardInterrupt  # as from the terminal, while this does not end
        return super().plan(observation)


class Choosy(Straight):
    def reset(self, scene):
        self.works = scene.token != "other"

    def poses(self, x, y, heading, speed):
        return super().poses(x if self.works else np.nan, y, heading, speed)


class Slow(Straight):
    def plan(self, observation):
        time.sleep(0.11 if observation.iteration % 10 == 5 else 0.0)
        return super().plan(observation)


BROKEN = [
    (NeedsArgument, "error", "constructor", "missing 1 required"),
    (NoReset, "error", "methods", "no method reset"),
    (FailsInReset, "error", "runs", r"reset\(\) failed: RuntimeError: no weights"),
    (FailsInPlan, "error", "runs", "at iteration 0 failed: KeyError: 'lane'"),
    (FailsLater, "error", "finite", "iteration 30: x of state 0 is nan"),
    (InDegrees, "warning", "heading", "90.0 rad, more than a full turn"),
    (ReturnsPoses, "error", "type", "returned ndarray"),
    (WrongShape, "error", "shapes", r"float64 \(81, 3\)"),
    (RepeatsATime, "error", "times", "not after time 1"),
    (NotFinite, "error", "finite", "x of state 0 is nan"),
    (StopsShort, "error", "covers the next step", "ends at time"),
    (TwoPoses, "error", "three poses", "2 states over 0.1 s"),
    (EgoFrame, "error", "starts at the ego", "50.0 m away"),
    (Beside, "warning", "starts at the ego", "3.0 m away"),
    (Backwards, "warning", "heading", "differs from the ego's by 3.14 rad"),
    (Random, "error", "deterministic", "differ at iteration 0"),
    (KeepsState, "error", "survives reset", "differs at iteration 0"),
    (WritesEgo, "error", "inputs untouched", "read-only"),
    (ForcesWrites, "error", "inputs untouched", "cannot set WRITEABLE flag"),
    (TooLong, "error", "length", "more than an hour after time 0"),
    (Short, "warning", "length", "less than 1 s ahead"),
    (HoldsALambda, "error", "pickles", "cannot be sent to a worker"),
    (BadCommand, "error", "finite", "acceleration inf"),
    (Leaves, "error", "runs", r"plan\(\) at iteration 0 failed: SystemExit: no weights"),
    (SteersInDegrees, "warning", "units", "steering_rate 30: no car does more than 10"),
    (Hangs, "error", "ends", r"plan\(\) at iteration 3 had not ended .*test_contract.py:\d+"),
]


@pytest.mark.filterwarnings("default")  # times that repeat are divided by
@pytest.mark.parametrize(("planner", "severity", "check", "message"), BROKEN)
def test_a_broken_rule_is_named_with_a_remedy(planner, severity, check, message):
    findings = check_planner(planner, cruise_scenario(start=(50.0, 0.0, 0.0)))
    bad = {f.check: f for f in findings if f.severity != "note"}
    assert list(bad) == [check]
    assert bad[check].severity == severity
    assert bad[check].hint
    assert re.search(message, bad[check].message), bad


def test_a_planner_may_be_named():
    findings = check_planner("constant-velocity", cruise_scenario())
    assert {found.severity for found in findings} == {"note"}
    with pytest.raises(ConfigError, match="planner 'idmm' unknown"):
        check_planner("idmm", cruise_scenario())


def test_an_exception_is_named_with_its_line():
    (found,) = check_planner(FailsInPlan, cruise_scenario())
    line = FailsInPlan.plan.__code__.co_firstlineno + 1
    assert found.message.endswith(f"({__file__}:{line})")


def test_a_planner_that_fails_on_another_scenario_only_is_named_with_it():
    other = replace(cruise_scenario(), token="other")
    found = [f for f in check_planner(Choosy, cruise_scenario(), other) if f.check == "finite"]
    assert found[0].message.startswith("scenario other, iteration 0")


def test_state_that_makes_a_scenario_fail_after_another_is_named():
    other = replace(cruise_scenario(), token="other")
    found, *_ = check_planner(KeepsInTheClass, cruise_scenario(), other)
    assert found.check == "company"
    assert found.message.startswith("after scenario other, iteration 0: x of state 0 is nan")


@pytest.mark.parametrize(("east", "step"), [(5_650_000.0, "0.5 m"), (400.0, None)])
def test_positions_of_thirty_two_bits_are_warned_of_where_that_is_coarse(east, step):
    found = check_planner(InThirtyTwoBits, cruise_scenario(start=(east, 0.0, 0.0)))
    coarse = [f.message for f in found if f.check == "precision"]
    assert len(coarse) == (1 if step else 0)
    assert step is None or f"{step} apart" in coarse[0]


def test_slow_plans_are_told_with_their_share():
    (found,) = check_planner(Slow(), cruise_scenario(iterations=31))
    assert (found.severity, found.check) == ("warning", "run time")
    assert "10% of the plans take longer than the 100 ms" in found.message


def test_a_good_planner_gets_its_run_time_only():
    findings = check_planner(Straight(), cruise_scenario())
    assert [(f.severity, f.check) for f in findings] == [("note", "run time")]
