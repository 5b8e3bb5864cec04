"""The vector environment of our own: the same as Gymnasium's, whatever the number of processes."""

import multiprocessing
import os
import signal
import subprocess
import sys
import warnings
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import shiftsim.env
from shiftsim.env.driving import DrivingEnv
from shiftsim.env.parallel import DrivingVectorEnv
from shiftsim.errors import ConfigError, InvalidTrajectoryError, ShiftsimError

COUNT, STEPS = 5, 60  # so many steps are more than two episodes


class Course:
    """An observation of several parts, and with a state of its own."""

    space = gymnasium.spaces.Dict(
        {
            "parts": gymnasium.spaces.Tuple(
                (gymnasium.spaces.Discrete(1000), gymnasium.spaces.Box(-1e4, 1e4, (2,)))
            )
        }
    )

    def start(self, episode):
        self.origin = episode.log.ego[0, :2].copy()

    def look(self, episode):
        moved = episode.log.ego[episode.iteration, :2] - self.origin
        return {"parts": (episode.iteration, moved.astype(np.float32))}


class Dying:
    """An observation that takes a process with it, but not that of the test."""

    space = gymnasium.spaces.Discrete(1)

    def start(self, episode): ...

    def look(self, episode):
        if episode.iteration == 2 and multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return 0


def actions(step):
    """Actions of a step, different in every environment."""
    places = np.arange(COUNT)
    return np.stack([np.sin(0.1 * step + places), 0.02 * np.cos(places)], axis=1).astype("f4")


def same(one, other):
    """Whether two things that environments return are equal to the last bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, tuple) or (isinstance(one, np.ndarray) and one.dtype == object):
        return all(same(a, b) for a, b in zip(one, other, strict=True))
    return type(one) is type(other) and np.array_equal(one, other)


def roll(envs, steps=STEPS):
    """Everything that reset and so many steps return."""
    out = [envs.reset(seed=5)]
    out += [envs.step(actions(step)) for step in range(steps)]
    envs.close()
    return out


NEXT, SAME = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP


@pytest.mark.slow
@pytest.mark.parametrize(
    ("observation", "mode", "workers"),
    [
        ("raster", NEXT, 1),
        ("vector", SAME, 1),
        ("vector", NEXT, 2),
        (Course(), SAME, 3),
        pytest.param("raster", SAME, 2, marks=pytest.mark.thorough),
        pytest.param(Course(), NEXT, COUNT, marks=pytest.mark.thorough),
    ],
)
def test_it_does_what_gymnasiums_does_whatever_the_number_of_workers(
    toy, observation, mode, workers
):
    settings = {
        "store": str(toy),
        "noise": "ou-low",
        "observation": observation,
        "penalty": -1.0,
    }
    theirs = gymnasium.make_vec(
        shiftsim.env.ID,
        num_envs=COUNT,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        **settings,
    )
    ours = gymnasium.make_vec(
        shiftsim.env.ID, num_envs=COUNT, num_workers=workers, autoreset_mode=mode, **settings
    )
    assert isinstance(ours, DrivingVectorEnv)
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    steps = 30 if observation == "raster" else STEPS
    expected, found = roll(theirs, steps), roll(ours, steps)
    ends = np.array([step[2] | step[3] for step in expected[1:]])
    assert ends.sum(axis=0).min() >= 1
    for one, other in zip(expected, found, strict=True):
        assert same(one, other)


def test_what_was_seen_is_not_written_over_while_it_is_held(toy):
    envs = DrivingVectorEnv(2, store=str(toy), observation="raster", noise="ou-low")
    held, before = [], []
    observations, _ = envs.reset(seed=0)
    for step in range(6):
        part = observations["raster"][1, 6:]  # a view of a view holds it too
        held.append(part)
        before.append(part.copy())
        observations = envs.step(actions(step)[:2])[0]
    for one, other in zip(held, before, strict=True):
        np.testing.assert_array_equal(one, other)
    assert any((one != other).any() for one, other in pairwise(before))


def test_what_is_let_go_is_used_again(toy):
    envs = DrivingVectorEnv(2, store=str(toy), observation="raster")
    observations = envs.reset(seed=0)[0]
    places = set()
    for step in range(6):
        observations = envs.step(actions(step)[:2])[0]
        places.add(observations["raster"].ctypes.data)
    assert len(places) == 2


@pytest.mark.slow
def test_a_process_that_dies_is_one_clear_error(toy):
    envs = DrivingVectorEnv(4, num_workers=2, store=str(toy), observation=Dying())
    envs.reset(seed=0)
    processes = multiprocessing.active_children()
    assert len(processes) == 1
    envs.step(np.zeros((4, 2)))
    with pytest.raises(ShiftsimError, match="environments 0 to 1 ended with SIGKILL"):
        envs.step(np.zeros((4, 2)))
    with pytest.raises(ConfigError, match="are closed"):
        envs.step(np.zeros((4, 2)))
    assert not any(process.is_alive() for process in processes)


@pytest.mark.slow
def test_an_error_in_a_process_is_that_error(toy):
    envs = DrivingVectorEnv(3, num_workers=2, store=str(toy), observation="none")
    envs.reset(seed=0)
    wrong = np.zeros((3, 2))
    wrong[0] = np.nan
    with pytest.raises(InvalidTrajectoryError):
        envs.step(wrong)
    assert envs.closed


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_workers": 3}, "3 workers for 2 environments"),
        ({"num_workers": 0}, "0 workers for 2 environments"),
        ({"autoreset_mode": "Disabled"}, "autoreset_mode 'Disabled' is not offered"),
        ({"num_workers": 2, "reward": lambda episode: 0.0}, "reward .* cannot be sent"),
        ({"reward": "regulr"}, "reward 'regulr' unknown"),
    ],
)
def test_settings_that_are_wrong_are_named(toy, settings, message):
    with pytest.raises(ConfigError, match=message):
        DrivingVectorEnv(2, store=str(toy), **settings)


def test_observations_without_a_fixed_shape_are_refused(toy):
    class Words(Course):
        space = gymnasium.spaces.Text(8)

    class Many(Course):
        space = gymnasium.spaces.Sequence(gymnasium.spaces.Discrete(3))

    for observer in (Words(), Many()):
        with pytest.raises(ConfigError, match="not arrays of fixed shape"):
            DrivingVectorEnv(2, store=str(toy), observation=observer)


def test_wrong_calls_are_named(toy):
    envs = DrivingVectorEnv(2, store=str(toy), observation="none", render_mode="rgb_array")
    with pytest.raises(ConfigError, match=r"shape \(2,\); it must be \(2, 2\)"):
        envs.step(np.zeros(2))
    with pytest.raises(ConfigError, match="3 seeds for 2 environments"):
        envs.reset(seed=[1, 2, 3])
    _, infos = envs.reset(seed=[7, None], options={"token": "0001cafe", "noise_seed": 3})
    assert list(infos["token"]) == ["0001cafe"] * 2
    assert [picture.shape for picture in envs.render()] == [(256, 256, 3)] * 2


def test_environments_do_not_share_an_observer_or_a_traffic_model(toy):
    one = Course()
    first, other = (DrivingEnv(store=str(toy), observation=one) for _ in range(2))
    assert first.observer is not other.observer


SCRIPT = """
import gymnasium
import numpy as np

import shiftsim.env


class Speed:
    space = gymnasium.spaces.Box(0.0, 100.0, (1,))

    def start(self, episode): ...
    def look(self, episode):
        return np.array([episode.observe().ego.speed], np.float32)


def main():
    envs = gymnasium.make_vec(
        "shiftsim/Driving-v0", num_envs=2, num_workers=2, store=STORE, observation=Speed()
    )
    print(envs.reset(seed=0)[0].shape)
    envs.close()

"""


@pytest.mark.slow
@pytest.mark.parametrize("guard", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_a_script_needs_its_guard_and_nothing_else(toy, tmp_path, guard):
    script = tmp_path / "script.py"
    call = 'if __name__ == "__main__":\n    main()\n' if guard else "main()\n"
    script.write_text(SCRIPT.replace("STORE", repr(str(toy))) + call)
    environment = os.environ | {"PYTHONPATH": str(Path(shiftsim.__file__).parent.parent)}
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, env=environment, timeout=120
    )
    if guard:
        assert done.stdout.strip() == "(2, 1)", done.stderr
    else:
        assert "environments 0 to 0 ended with exit code 1" in done.stderr


def test_gymnasium_warns_of_nothing(toy):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        envs = gymnasium.make_vec(shiftsim.env.ID, num_envs=2, store=str(toy))
        wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
        wrapped.reset(seed=0)
        for step in range(30):
            infos = wrapped.step(actions(step)[:2])[-1]
            if "episode" in infos:
                assert infos["episode"]["l"].max() > 0
                break
        else:
            pytest.fail("no episode ended")
