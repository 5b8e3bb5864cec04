"""Steps that a planner takes in one call: the same as one by one, where nothing else acts."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.errors import InvalidTrajectoryError
from shiftsim.planners.basic.constant_velocity import ConstantVelocity
from shiftsim.planners.basic.log_future import LogFuture
from shiftsim.sim.loop import Rollout, drive, simulate
from shiftsim.sim.traffic import LogReplay
from shiftsim.world.script import RolloutEvents
from shiftsim.world.state import AgentKind


class Asked(ConstantVelocity):
    """Notes at which iterations it is asked, and what steps it is offered."""

    def __init__(self):
        self.asked, self.courses = [], []

    def plan(self, observation):
        self.asked.append(observation.iteration)
        return super().plan(observation)

    def drive_on(self, course):
        self.courses.append((course.first, course.stop))
        return super().drive_on(course)


class Inherits(Asked):
    """Offers nothing itself."""


class Declines(Asked):
    """Takes no step at once."""

    def drive_on(self, course):
        return course.first


class OtherTraffic(LogReplay):
    """Might do anything."""


def scene(iterations=20):
    tracks = standing_tracks(400, np.array([[30.0, 0.0, 0.0]]), [AgentKind.VEHICLE])
    made = cruise_scenario(iterations=iterations, start=(10.0, 0.0, 0.3))
    return replace(made, tracks=tracks.rows(slice(0, len(made.time_us))))


def stepped(scenario, planner=None, **changes):
    rollout = Rollout(scenario, planner or ConstantVelocity(), **changes)
    while not rollout.done:
        rollout.advance(rollout.planner.plan(rollout.observe()))
    return rollout.log()


@pytest.mark.parametrize("noise", ["none", "ou-high"])
@pytest.mark.parametrize("iterations", [3, 4, 40])
def test_steps_taken_at_once_are_those_taken_one_by_one(noise, iterations):
    scenario, planner = scene(iterations), Asked()
    ours = simulate(scenario, planner, noise=noise, seed=3)
    assert planner.asked == []
    assert planner.courses == [(0, iterations - 1)]
    theirs = stepped(scenario, noise=noise, seed=3)
    for name in ("time_us", "ego", "commands", "noise", "plans", "degraded"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    assert np.isnan(ours.commands[-1]).all()  # the last plan is not executed
    taken = ours.planning_seconds
    assert ((taken > 0.0) & (taken < 60.0)).all()
    np.testing.assert_array_equal(taken, taken[0])


@pytest.mark.parametrize("future", [0, 5, 300])
@pytest.mark.parametrize("noise", ["none", "ou-high"])
def test_recorded_plans_are_driven_at_once_as_far_as_they_reach(noise, future, monkeypatch):
    scenario = cruise_scenario(iterations=40, start=(10.0, 0.0, 0.3), future_rows=future)
    asked, plan = [], LogFuture.plan

    def noted(planner, observation):
        asked.append(observation.iteration)
        return plan(planner, observation)

    monkeypatch.setattr(LogFuture, "plan", noted)
    ours = simulate(scenario, LogFuture(), noise=noise, seed=3)
    first = min((70 + future) // 2, 39)  # the first iteration from which 0.5 s were not recorded
    assert asked == [*range(first, 39)]
    theirs = stepped(scenario, LogFuture(), noise=noise, seed=3)
    for name in ("ego", "commands", "plans", "degraded"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def edited():
    script = RolloutEvents("base", "edit", "digest", (), (), np.zeros(1, np.int64))
    return replace(scene(), script=script)


@pytest.mark.parametrize(
    ("planner", "make", "options"),
    [
        (Asked(), scene, {"traffic": "reactive"}),
        (Asked(), scene, {"traffic": OtherTraffic()}),
        (Asked(), scene, {"controller": "perfect"}),
        (Asked(), scene, {"controller": "log-playback"}),
        (Asked(), edited, {}),
        (Inherits(), scene, {}),
    ],
)
def test_whatever_acts_between_steps_is_waited_for(planner, make, options):
    simulate(make(), planner, **options)
    assert planner.asked == list(range(19))
    assert planner.courses == []


def test_steps_that_were_not_taken_at_once_are_taken_one_by_one():
    planner = Declines()
    ours, theirs = simulate(scene(), planner), stepped(scene())
    assert planner.asked == list(range(19))
    np.testing.assert_array_equal(ours.ego, theirs.ego)


def test_a_plan_that_cannot_be_driven_is_told_as_ever():
    made = scene()
    time_us = made.time_us.copy()
    time_us[made.iteration_rows[4] + 1 :] += 9_000_000  # plans reach 8 s ahead
    planner = Asked()
    rollout = Rollout(replace(made, time_us=time_us), planner)
    with pytest.raises(InvalidTrajectoryError, match="iteration 4: the plan ends"):
        drive(rollout)
    assert planner.asked == [4]
    assert rollout.iteration == 4
