"""Several scenarios in lock step: each one as if it were alone, whatever happens to the others."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import cruise_scenario, standing_tracks

from shiftsim.errors import DataError, InvalidTrajectoryError, PlannerError
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.sim.traffic import LogReplay
from shiftsim.sim.traffic.learned.model import LearnedTraffic
from shiftsim.world.state import AgentKind, Command, Trajectory

TIMES = np.arange(41) * 0.1
POISON = -1.0  # a feature at which the "network" fails


class Weaver(LearnedPlanner):
    """Straight on with a speed that the "network" makes of ego, tracks and what it saw before."""

    def __init__(self, fail_at=None, how="features", makeshift=()):
        self.batches = []  # shared by all forks, as a network is
        self.trouble = (fail_at, how, tuple(makeshift))

    def reset(self, scene):
        self.token, self.seen = scene.token, []
        self.fail_at, self.how, self.makeshift = self.trouble

    def features(self, observation):
        if observation.iteration == self.fail_at and self.how == "features":
            raise ZeroDivisionError("no features")
        self.seen.append(observation.iteration)
        near = np.nansum(observation.tracks.poses[..., 0])
        poison = observation.iteration == self.fail_at and self.how == "infer"
        steps = POISON if poison else len(self.seen)
        return np.array([*observation.ego.pose, observation.ego.speed, near, steps])

    def infer(self, features):
        self.batches.append(len(features))
        if any(row[-1] == POISON for row in features):
            raise ZeroDivisionError("no output")
        return [5.0 + 3.0 * np.sin(row.sum()) for row in features]

    def decode(self, output, observation):
        failing = observation.iteration == self.fail_at
        if failing and self.how == "decode":
            raise ZeroDivisionError("no plan")
        self.degraded = "no way" if observation.iteration in self.makeshift else ""
        x, y, heading = observation.ego.pose
        poses = np.c_[x + output * TIMES, np.full(41, y), np.full(41, heading)]
        if failing and self.how == "plan":
            poses[3] = np.nan
        return Trajectory.from_poses(TIMES, poses)


class Commander(Weaver):
    """Answers with commands."""

    def decode(self, output, observation):
        return Command(0.1 * (output - observation.ego.speed), 0.0)


def scene(number, iterations=20):
    tracks = standing_tracks(400, np.array([[30.0 + number, 0.0, 0.0]]), [AgentKind.VEHICLE])
    start = (10.0 + number, 0.1 * number, 0.0)
    made = cruise_scenario(iterations=iterations, speed=5.0 + number, start=start)
    return (
        made
        if number % 2
        else cruise_scenario(
            iterations=iterations, start=start, tracks=tracks.rows(slice(0, len(made.time_us)))
        )
    )


def forks_of(planner, count):
    return [planner.fork() for _ in range(count)]


def together(scenarios, planners, **options):
    rollouts = [Rollout(s, p, **options) for s, p in zip(scenarios, planners, strict=True)]
    return simulate_together(rollouts)


def assert_same(log, expected):
    """All but the time that planning took."""
    assert isinstance(log, SimulationLog)
    for field in fields(SimulationLog):
        if field.name in ("planning_seconds", "tracks", "traffic_lights"):
            continue
        a, b = getattr(log, field.name), getattr(expected, field.name)
        if isinstance(a, np.ndarray):
            assert a.tobytes() == b.tobytes(), field.name
        else:
            assert a == b, field.name
    np.testing.assert_array_equal(log.tracks.poses, expected.tracks.poses)


@pytest.mark.parametrize("planner", [Weaver, Commander])
@pytest.mark.parametrize("noise", ["none", "ou-high"])
def test_scenarios_together_are_bit_for_bit_as_each_alone(planner, noise):
    scenes = [scene(number) for number in range(5)]
    logs = together(scenes, forks_of(planner(), 5), noise=noise, seed=3)
    for one, log in zip(scenes, logs, strict=True):
        assert_same(log, simulate(one, planner(), noise=noise, seed=3))


def test_reactive_traffic_of_one_scenario_does_not_see_another():
    scenes = [scene(number) for number in range(4)]
    logs = together(scenes, forks_of(Weaver(), 4), traffic="reactive")
    for one, log in zip(scenes, logs, strict=True):
        assert_same(log, simulate(one, Weaver(), traffic="reactive"))


@given(lengths=st.lists(st.integers(3, 12), min_size=1, max_size=5))
@settings(max_examples=10)
def test_scenarios_of_any_lengths_end_when_they_are_over(lengths):
    planner = Weaver()
    scenes = [scene(number, length) for number, length in enumerate(lengths)]
    logs = together(scenes, forks_of(planner, len(scenes)))
    assert [len(log.time_us) for log in logs] == [length - 1 for length in lengths]
    for one, log in zip(scenes, logs, strict=True):
        assert_same(log, simulate(one, Weaver()))


def test_the_batch_shrinks_as_scenarios_end():
    planner = Weaver()
    together([scene(0, 4), scene(1, 6), scene(2, 4)], forks_of(planner, 3))
    assert planner.batches == [3, 3, 3, 1, 1]


@pytest.mark.parametrize(
    ("how", "kind"),
    [
        ("features", ZeroDivisionError),
        ("decode", ZeroDivisionError),
        ("plan", InvalidTrajectoryError),
    ],
)
@pytest.mark.parametrize("fail_at", [0, 7])
def test_an_error_in_one_scenario_ends_no_other(how, kind, fail_at):
    planner = Weaver()
    scenes = [scene(number) for number in range(4)]
    planners = forks_of(planner, 4)
    planners[2].trouble = (fail_at, how, ())
    logs = together(scenes, planners)
    assert type(logs[2]) is kind
    for index in (0, 1, 3):
        assert_same(logs[index], simulate(scenes[index], Weaver()))
    full = fail_at + (how != "features")
    assert planner.batches == [4] * full + [3] * (19 - full)


def test_a_scene_at_which_the_network_fails_ends_no_other():
    planner = Weaver()
    scenes = [scene(number) for number in range(4)]
    planners = forks_of(planner, 4)
    planners[2].trouble = (7, "infer", ())
    logs = together(scenes, planners)
    assert isinstance(logs[2], ZeroDivisionError)
    for index in (0, 1, 3):
        assert_same(logs[index], simulate(scenes[index], Weaver()))
    assert planner.batches == [4] * 8 + [1] * 4 + [3] * 11


@pytest.mark.parametrize("count", [1, 3])
def test_a_network_that_fails_at_every_scene_ends_all(count):
    planners = forks_of(Weaver(0, "infer"), count)
    logs = together([scene(number) for number in range(count)], planners)
    assert [str(log) for log in logs] == ["no output"] * count


def test_a_batch_in_which_all_fail_is_over():
    planners = forks_of(Weaver(2, "features"), 3)
    logs = together([scene(number) for number in range(3)], planners)
    assert [str(log) for log in logs] == ["no features"] * 3
    assert planners[0].batches == [3, 3]


def test_makeshift_plans_are_counted_where_they_are():
    planners = forks_of(Weaver(), 3)
    planners[1].trouble = (None, "", (0, 4, 5))
    logs = together([scene(number) for number in range(3)], planners)
    assert [int(log.degraded.sum()) for log in logs] == [0, 3, 0]
    assert np.flatnonzero(logs[1].degraded).tolist() == [0, 4, 5]


def test_a_strict_run_ends_the_scenario_with_a_makeshift_and_no_other():
    planners = forks_of(Weaver(), 3)
    planners[1].trouble = (None, "", (4,))
    logs = together([scene(number) for number in range(3)], planners, strict=True)
    assert isinstance(logs[1], PlannerError)
    assert "fell back at iteration 4: no way" in str(logs[1])
    assert all(isinstance(logs[index], SimulationLog) for index in (0, 2))


def test_the_time_of_a_batch_is_shared_among_its_scenarios():
    logs = together([scene(number) for number in range(3)], forks_of(Weaver(), 3))
    np.testing.assert_array_equal(logs[0].planning_seconds, logs[2].planning_seconds)
    assert (logs[0].planning_seconds > 0.0).all()


def test_forks_are_independent_of_the_planner_they_are_made_from():
    planner = Weaver()
    first = simulate(scene(1), planner)
    forked = planner.fork()
    simulate(scene(3), forked)
    assert planner.seen != []
    assert planner.token == first.token
    assert planner.seen is not forked.seen


def test_too_short_a_scenario_is_refused_before_the_batch_starts():
    with pytest.raises(DataError, match="at least 3 are needed"):
        together([scene(0, 2)], forks_of(Weaver(), 1))


class Counting(LearnedTraffic):
    """Learned traffic that notes how many rollouts a forward pass is for."""

    def __init__(self):
        super().__init__()
        self.batches = []  # shared by all forks

    def step_batch(self, models, moves):
        self.batches.append(len(moves))
        super().step_batch(models, moves)


def test_traffic_networks_move_several_rollouts_with_one_pass():
    scenes = [scene(2 * number, iterations=12 + 2 * number) for number in range(3)]
    alone = [simulate(one, ConstantVelocity(), traffic=LearnedTraffic()) for one in scenes]
    original = Counting()
    rollouts = [Rollout(one, ConstantVelocity(), traffic=original.fork()) for one in scenes]
    logs = simulate_together(rollouts)
    # 11, 13 and 15 samples; the last answer is never executed
    assert original.batches == [3] * 10 + [2] * 2 + [1] * 2
    for log, expected in zip(logs, alone, strict=True):
        assert np.abs(log.tracks.poses - expected.tracks.poses).max() < 1e-5
        assert log.ego.tobytes() == expected.ego.tobytes()


class Fails(ConstantVelocity):
    """Fails in the fourth step."""

    def plan(self, observation):
        if observation.iteration == 3:
            raise ZeroDivisionError("no plan")
        return super().plan(observation)


class ConversionFailure(LogReplay):
    """Fails in the sixth step."""

    def step(self, iteration, ego, tracks, row):
        if iteration == 5:
            raise ZeroDivisionError("no way")


def test_planners_without_a_network_and_traffic_that_fails_end_their_own_rollout_only():
    scenes = [scene(number) for number in range(3)]
    models = [LogReplay(), ConversionFailure(), LogReplay()]
    planners = [ConstantVelocity(), ConstantVelocity(), Fails()]
    rollouts = [Rollout(s, p, traffic=t) for s, p, t in zip(scenes, planners, models, strict=True)]
    first, second, third = simulate_together(rollouts)
    assert_same(first, simulate(scenes[0], ConstantVelocity()))
    assert (str(second), str(third)) == ("no way", "no plan")
