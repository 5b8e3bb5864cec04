"""Many environments at once: the same in one process and in several."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError
from gymnasium.vector import AutoresetMode

import shiftsim.env
from shiftsim.env.driving import DrivingEnv, DrivingVectorEnv
from shiftsim.errors import ConfigError, InvalidTrajectoryError, ShiftsimError

pytestmark = pytest.mark.thorough

COUNT, STEPS = 5, 60  # so many steps are more than two episodes


class Moved:
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


@pytest.mark.parametrize(
    ("observation", "mode", "workers"),
    [
        ("raster", NEXT, 1),
        ("vector", NEXT, 2),
        (Moved(), SAME, 3),
        pytest.param("raster", SAME, 2, marks=pytest.mark.thorough),
        pytest.param(Moved(), NEXT, COUNT, marks=pytest.mark.thorough),
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
    assert ours.metadata["autoreset_mode"] == mode
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    steps = 30 if observation == "raster" else STEPS
    expected, found = roll(theirs, steps), roll(ours, steps)
    ends = np.array([step[2] | step[3] for step in expected[1:]])
    assert ends.sum(axis=0).min() >= 1
    for one, other in zip(expected, found, strict=True):
        assert same(one, other)


def test_a_process_that_dies_is_one_clear_error(toy):
    envs = DrivingVectorEnv(2, num_workers=2, store=str(toy), observation=Dying())
    envs.reset(seed=0)
    processes = multiprocessing.active_children()
    assert len(processes) == 2
    envs.step(np.zeros((2, 2)))
    with pytest.raises(ShiftsimError, match=r"environment \d ended with SIGKILL"):
        envs.step(np.zeros((2, 2)))
    with pytest.raises(ClosedEnvironmentError):
        envs.step(np.zeros((2, 2)))
    assert not any(process.is_alive() for process in processes)


def test_a_process_that_is_stopped_is_one_clear_error_in_time(toy):
    envs = DrivingVectorEnv(2, num_workers=2, store=str(toy), observation="none", timeout=60.0)
    envs.reset(seed=0)
    envs._timeout = 0.5  # what is compiled is compiled
    processes = multiprocessing.active_children()
    os.kill(envs.processes[1].pid, signal.SIGSTOP)
    with pytest.raises(ShiftsimError, match=r"environment 1 has not answered for 0\.5 s"):
        envs.step(np.zeros((2, 2)))
    with pytest.raises(ClosedEnvironmentError):
        envs.step(np.zeros((2, 2)))
    assert not any(process.is_alive() for process in processes)


@pytest.mark.filterwarnings("default")  # Gymnasium warns of the process that it ends
def test_an_error_in_a_process_is_that_error(toy):
    envs = DrivingVectorEnv(2, num_workers=2, store=str(toy), observation="none")
    envs.reset(seed=0)
    wrong = np.zeros((2, 2))
    wrong[0] = np.nan
    with pytest.raises(InvalidTrajectoryError):
        envs.step(wrong)
    assert envs.closed


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_workers": 3}, "3 workers for 2 environments"),
        ({"num_workers": 0}, "0 workers for 2 environments"),
        ({"reward": "regulr"}, "reward 'regulr' unknown"),
        ({"num_workers": 2, "reward": "regulr"}, "reward 'regulr' unknown"),
    ],
)
def test_settings_that_are_wrong_are_named(toy, settings, message):
    with pytest.raises(ConfigError, match=message):
        DrivingVectorEnv(2, store=str(toy), **settings)


def test_options_reach_every_environment(toy):
    envs = DrivingVectorEnv(2, store=str(toy), observation="none", render_mode="rgb_array")
    _, infos = envs.reset(seed=[7, None], options={"token": "0001cafe", "noise_seed": 3})
    assert list(infos["token"]) == ["0001cafe"] * 2
    assert [picture.shape for picture in envs.render()] == [(256, 256, 3)] * 2


def test_environments_do_not_share_an_observer_or_a_traffic_model(toy):
    one = Moved()
    first, other = (DrivingEnv(store=str(toy), observation=one) for _ in range(2))
    assert first.observer is not other.observer


def test_environments_of_one_process_share_the_store(toy):
    envs = gymnasium.make_vec(
        shiftsim.env.ID, num_envs=2, vectorization_mode="sync", store=str(toy)
    )
    envs.reset(seed=0)
    one, other = (env.unwrapped.episode.scenario for env in envs.envs)
    assert one.map is other.map


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
        assert re.search(r"environment \d ended with exit code 1", done.stderr)


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
