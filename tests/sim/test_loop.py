"""The step loop: what is seen, stored and moved, and in which order."""

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.errors import ConfigError, DataError, InvalidTrajectoryError
from shiftsim.planners.basic.constant_velocity import ConstantVelocity
from shiftsim.sim.loop import simulate
from shiftsim.sim.noise import NoiseModel
from shiftsim.world.state import VX, Command, Trajectory, X


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


class Broken(Recorder):
    """Returns a plan that ends before the next step."""

    def plan(self, observation):
        return Trajectory.from_poses(np.array([0.0, 0.01, 0.02]), np.zeros((3, 3)))


def test_a_plan_that_ends_before_the_next_step_is_refused():
    with pytest.raises(InvalidTrajectoryError):
        simulate(cruise_scenario(), Broken())


def test_registered_planners_drive(rng):
    log = simulate(cruise_scenario(), ConstantVelocity())
    np.testing.assert_allclose(log.ego[:, VX], 8.0, atol=1e-6)
