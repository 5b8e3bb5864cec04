"""The step loop: what is seen, stored and moved, and in which order."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.errors import ConfigError, DataError, InvalidTrajectoryError, PlannerError
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.sim import loop
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.log import DEFAULT
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.sim.noise import NoiseModel
from shiftsim.world.events import RolloutEvents, TerminationCondition
from shiftsim.world.state import NUM_STATE, VX, Command, Trajectory, X


class Recorder:
    """Drives straight on and keeps what it was shown."""

    def reset(self, scene):
        self.scene = scene
        self.seen = []

    def plan(self, observation):
        self.seen.append(observation)
        times = np.arange(81) * 0.1
        x, y, heading = observation.ego.pose
        poses = np.c_[x + 8.0 * times, np.full(81, y), np.full(81, heading)]
        return Trajectory.from_poses(times, poses)


class Pusher:
    """Returns one command for ever."""

    def reset(self, scene):
        pass

    def plan(self, observation):
        return Command(1.0, 0.0)


def test_the_planner_is_asked_once_per_stored_sample():
    planner = Recorder()
    log = simulate(cruise_scenario(iterations=151), planner)
    assert [seen.iteration for seen in planner.seen] == list(range(150))
    assert len(log.time_us) == len(log.ego) == len(log.plans) == 150
    assert len(log.expert_ego) == 151


def test_the_last_answer_is_never_executed():
    log = simulate(cruise_scenario(iterations=20), Recorder())
    assert np.isnan(log.commands[-1]).all()
    assert np.isfinite(log.commands[:-1]).all()


def test_the_history_covers_two_point_one_seconds():
    planner = Recorder()
    simulate(cruise_scenario(), planner)
    for seen in (planner.seen[0], planner.seen[1], planner.seen[149]):
        assert len(seen.history.time_us) == 22
        assert seen.history.time_us[-1] == seen.time_us
        assert seen.history.time_us[-1] - seen.history.time_us[0] == 2_100_000
        assert np.isfinite(seen.history.ego).all()


def test_missing_past_rows_make_the_history_shorter():
    planner = Recorder()
    simulate(cruise_scenario(history_rows=7), planner)
    assert [len(seen.history.time_us) for seen in planner.seen[:3]] == [4, 5, 6]
    assert len(planner.seen[40].history.time_us) == 22


def test_a_constant_plan_is_tracked_at_its_speed():
    log = simulate(cruise_scenario(speed=8.0), Recorder())
    np.testing.assert_allclose(log.ego[:, VX], 8.0, atol=1e-6)
    assert log.ego[-1, X] - log.ego[0, X] == pytest.approx(8.0 * 14.9, abs=1e-6)


def test_a_command_goes_to_the_motion_model_without_a_tracker():
    log = simulate(cruise_scenario(speed=0.0, iterations=12), Pusher())
    np.testing.assert_array_equal(log.commands[:-1], np.tile([1.0, 0.0], (10, 1)))
    # first step: the low-pass filter lets a third of the command through
    assert log.ego[1, VX] == pytest.approx(0.1 / 3.0, abs=1e-12)
    assert np.isnan(log.plans).all()


def test_noise_of_zero_strength_is_bitwise_the_clean_run():
    clean = simulate(cruise_scenario(), Recorder())
    silent = simulate(cruise_scenario(), Recorder(), noise=NoiseModel("ou", 0.0, 0.0), seed=4)
    assert clean.ego.tobytes() == silent.ego.tobytes()


def test_noise_acts_on_the_command_and_is_stored():
    clean = simulate(cruise_scenario(), Recorder())
    noisy = simulate(cruise_scenario(), Recorder(), noise="ou-high", seed=4)
    assert np.abs(noisy.noise).max() > 0.1
    assert np.abs(noisy.ego - clean.ego).max() > 0.1
    # the first step of the filter passes a third of command and noise
    accel = (noisy.commands[0, 0] + noisy.noise[0, 0]) / 3.0
    assert noisy.ego[1, VX] == pytest.approx(8.0 + 0.1 * accel, abs=1e-9)


def test_noise_does_not_depend_on_the_planner():
    first = simulate(cruise_scenario(), Recorder(), noise="awgn-low", seed=1)
    second = simulate(cruise_scenario(), Pusher(), noise="awgn-low", seed=1)
    np.testing.assert_array_equal(first.noise, second.noise)


def test_perfect_tracking_puts_the_ego_where_the_plan_says():
    log = simulate(cruise_scenario(), Recorder(), controller="perfect")
    np.testing.assert_allclose(np.diff(log.ego[:, X]), 0.8, atol=1e-9)


def test_log_playback_repeats_the_recording():
    scenario = cruise_scenario()
    log = simulate(scenario, None, controller="log-playback")
    np.testing.assert_array_equal(log.ego, scenario.expert[:-1])


def test_the_scenario_is_not_changed_by_a_run():
    scenario = cruise_scenario()
    before = scenario.ego.tobytes()
    simulate(scenario, Recorder(), noise="ou-high", seed=1)
    assert scenario.ego.tobytes() == before


def test_fewer_than_three_iterations_are_refused():
    with pytest.raises(DataError, match="has 2 iterations"):
        simulate(cruise_scenario(iterations=2), Recorder())


def test_an_unknown_controller_is_refused():
    with pytest.raises(ConfigError, match="ilqr"):
        simulate(cruise_scenario(), Recorder(), controller="ilqr")


class ConversionFailure(Recorder):
    """Returns a plan that ends before the next step."""

    def plan(self, observation):
        return Trajectory.from_poses(np.array([0.0, 0.01, 0.02]), np.zeros((3, 3)))


def test_a_plan_that_ends_before_the_next_step_is_refused():
    with pytest.raises(InvalidTrajectoryError):
        simulate(cruise_scenario(), ConversionFailure())


def test_registered_planners_drive(rng):
    log = simulate(cruise_scenario(), ConstantVelocity())
    np.testing.assert_allclose(log.ego[:, VX], 8.0, atol=1e-6)


class Watcher:
    """Traffic that keeps what it was told, and moves nobody."""

    def start(self, scenario, tracks, row):
        self.first, self.told = row, []

    def step(self, iteration, ego, tracks, row):
        self.told.append((iteration, ego.copy(), row))
        ego[:] = 0.0  # which moves nobody


def test_the_traffic_sees_the_ego_of_the_iteration_that_ends_and_writes_the_next():
    watcher = Watcher()
    log = simulate(cruise_scenario(iterations=8), Recorder(), traffic=watcher)
    assert watcher.first == 21
    assert [iteration for iteration, _, _ in watcher.told] == list(range(6))
    assert [row for _, _, row in watcher.told] == list(range(22, 28))
    np.testing.assert_array_equal([ego for _, ego, _ in watcher.told], log.ego[:-1])


def uneven(accel, steering, num_steps, dt):
    """Noise that differs in every step and channel."""
    return np.arange(2.0 * num_steps).reshape(num_steps, 2) * [0.1, 0.01]


@pytest.mark.parametrize("planner", [Recorder, Pusher])
def test_each_channel_of_the_noise_of_a_step_acts_on_its_own_command(planner):
    model = NoiseModel("custom", function=uneven)
    log = simulate(cruise_scenario(iterations=8), planner(), noise=model)
    np.testing.assert_array_equal(log.noise, uneven(None, None, 7, 0.1))
    for step in range(6):
        after = np.empty(NUM_STATE)
        now, then = log.time_us[step : step + 2]
        command_and_step(now, then, log.ego[step], log.commands[step], *log.noise[step], after)
        np.testing.assert_array_equal(log.ego[step + 1], after)


def test_every_plan_is_kept_in_the_map_frame():
    log = simulate(cruise_scenario(iterations=8), Recorder())
    assert log.plans.shape == (7, 18, 3)
    seconds = [*np.arange(0, 11) / 10, *range(2, 9)]
    ahead = log.ego[:, None, X] + 8.0 * np.array(seconds)
    np.testing.assert_allclose(log.plans[..., 0], ahead, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(log.plans[..., 1:], 0.0)


def test_a_planner_may_watch_a_log_playback():
    scenario, planner = cruise_scenario(iterations=8), Recorder()
    log = simulate(scenario, planner, controller="log-playback")
    np.testing.assert_array_equal(log.ego, scenario.expert[:-1])
    assert len(planner.seen) == 7
    assert np.isfinite(log.plans).all()
    assert np.isnan(log.commands).all()


@pytest.mark.parametrize("controller", ["lqr", "perfect"])
def test_only_a_log_playback_goes_without_a_planner(controller):
    with pytest.raises(ConfigError, match=f"'{controller}' needs a planner"):
        simulate(cruise_scenario(), None, controller=controller)


def test_perfect_tracking_refuses_commands():
    with pytest.raises(ConfigError, match="returns a trajectory, not a command"):
        simulate(cruise_scenario(), Pusher(), controller="perfect")


def test_three_iterations_are_enough():
    assert len(simulate(cruise_scenario(iterations=3), Recorder()).time_us) == 2


class Makeshift(Recorder):
    """Falls back at some iterations."""

    degraded = ""

    def plan(self, observation):
        self.degraded = "no way" if observation.iteration in (2, 5) else ""
        return super().plan(observation)


def test_makeshift_plans_are_counted_and_refused_where_that_is_asked():
    log = simulate(cruise_scenario(iterations=8), Makeshift())
    assert np.flatnonzero(log.degraded).tolist() == [2, 5]
    with pytest.raises(PlannerError, match="fell back at iteration 2: no way"):
        simulate(cruise_scenario(iterations=8), Makeshift(), strict=True)


class Clock:
    """Every look at it takes three seconds."""

    now = 0.0

    def __call__(self):
        self.now += 3.0
        return self.now


class Group(Recorder):
    """Plans for several scenarios at once."""

    def fork(self):
        return Group()

    def plan_batch(self, planners, observations):
        return [p.plan(o) for p, o in zip(planners, observations, strict=True)]


def test_the_time_that_a_plan_took_is_that_of_the_clock(monkeypatch):
    monkeypatch.setattr(loop, "perf_counter", Clock())
    log = simulate(cruise_scenario(iterations=5), Recorder())
    np.testing.assert_array_equal(log.planning_seconds, 3.0)
    rollouts = [Rollout(cruise_scenario(iterations=n), Group()) for n in (5, 7)]
    first, second = simulate_together(rollouts)
    np.testing.assert_array_equal(first.planning_seconds, 1.5)
    np.testing.assert_array_equal(second.planning_seconds, [1.5] * 4 + [3.0] * 2)
    unplanned = simulate(cruise_scenario(iterations=5), None, controller="log-playback")
    np.testing.assert_array_equal(unplanned.planning_seconds, 0.0)


def test_by_default_nothing_disturbs_the_ego():
    assert (DEFAULT.noise, DEFAULT.seed, DEFAULT.strict) == ("none", 0, False)
    planner = Recorder()
    assert not simulate(cruise_scenario(iterations=4), planner).noise.any()
    assert planner.scene.seed == 0


@pytest.mark.parametrize("history_rows", [0, 7, 60])
def test_the_past_of_the_ego_is_that_of_the_recording(history_rows):
    scenario, planner = cruise_scenario(history_rows=history_rows, iterations=6), Recorder()
    simulate(scenario, planner)
    row = scenario.iteration_rows[0]
    past = np.arange(row % 2, row + 1, 2)[-22:]
    first = planner.seen[0].history
    np.testing.assert_array_equal(first.ego, scenario.ego[past])
    np.testing.assert_array_equal(first.time_us, scenario.time_us[past])


@pytest.mark.parametrize("strange", [0, 1])
def test_only_the_first_plan_is_doubted(strange):
    class Elsewhere(Recorder):
        def plan(self, observation):
            plan = super().plan(observation)
            if len(self.seen) == strange + 1:
                plan.states[:, X] += 42.0
            return plan

    rollout = Rollout(cruise_scenario(iterations=5), Elsewhere())
    loop.drive(rollout)
    assert ("42 m away" in rollout.warning) == (strange == 0)


def test_a_doubt_is_told_where_the_user_calls():
    class Elsewhere(Recorder):
        def plan(self, observation):
            plan = super().plan(observation)
            plan.states[:, X] += 42.0
            return plan

    with pytest.warns(UserWarning, match="42 m away") as told:
        simulate(cruise_scenario(iterations=5), Elsewhere())
    assert told[0].filename == __file__


@pytest.mark.parametrize(("progress", "samples"), [(20.0, 12), (20.5, 13), (500.0, 19)])
def test_a_rollout_ends_one_sample_after_the_ego_has_reached_the_finish(progress, samples):
    finish = TerminationCondition(np.array([[0.0, 0.0], [600.0, 0.0]]), progress)
    script = RolloutEvents("a", "b", "c", (), (), np.zeros(0, np.int64), termination=finish)
    scenario = replace(cruise_scenario(iterations=20), script=script)
    log = simulate(scenario, Recorder(), controller="perfect")
    assert len(log.ego) == samples  # 0.8 m each, from 11.461 m on
