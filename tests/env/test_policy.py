"""Policies of the environment as planners: the same scores, from functions and from files."""

import copy
import hashlib
import json
import pickle
import shutil
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import shiftsim
from shiftsim.env.driving import DrivingEnv
from shiftsim.errors import ConfigError, InvalidTrajectoryError, MissingExtraError
from shiftsim.planners.registry import load_planner, planner_fingerprint, run_planner
from shiftsim.sim.planner import sees_recording

TOKEN = "0001cafe"  # of the toy store: a car is parked in the lane


def as_bytes(seen):
    parts = seen.values() if isinstance(seen, dict) else [seen]
    return b"".join(np.asarray(part).tobytes() for part in parts)


class Weaving:
    """Acts by all that it sees, and notes what that was."""

    def __init__(self, action="command", space=None):
        self.action, self.observation_space, self.seen = action, space, []

    def __call__(self, seen):
        self.seen.append(as_bytes(seen))
        turn = 1e-3 * (zlib_of(self.seen[-1]) % 100) - 0.05
        if self.action == "command":
            return np.array([8 * turn, turn], np.float32)
        ahead = np.arange(1, 11, dtype=np.float32)
        return np.stack([0.7 * ahead, 0.1 * turn * ahead, turn * ahead], axis=1)


def zlib_of(content):
    return int(hashlib.sha256(content).hexdigest()[:8], 16)


def scores_of_episode(env, policy, row):
    """What the environment says at the end of the episode of a row of the scores."""
    seen, _ = env.reset(options={"token": row["token"], "noise_seed": row["seed"]})
    truncated = False
    while not truncated:
        seen, _, _, truncated, info = env.step(policy(seen))
    return info["scores"]


def check_scores(run, env, policy):
    rows = run.scores.to_pylist()
    assert rows
    for row in rows:
        scores = scores_of_episode(env, policy, row)
        assert len(scores) == 9
        assert scores == {name: row[name] for name in scores}


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["none", "ou-high"])
@pytest.mark.parametrize("action", ["command", "trajectory"])
@pytest.mark.parametrize("observation", ["none", "vector", "raster"])
def test_the_scores_are_those_of_the_environment(toy, tmp_path, observation, action, noise):
    policy = Weaving(action)
    planner = shiftsim.policy_planner(policy, observation=observation, action=action)
    settings = {"store": str(toy), "noise": noise}
    run = shiftsim.run(planner, seeds=[3], workers=1, out=str(tmp_path / "run"), **settings)
    env = DrivingEnv(observation=observation, action=action, terminate=False, **settings)
    space = env.observation_space
    if observation == "raster":  # only those who are shown the recording have the rest
        env = gymnasium.wrappers.FilterObservation(env, ["raster", "measurements"])
    check_scores(run, env, policy)
    assert not sees_recording(planner)
    assert space is not None


@pytest.mark.parametrize("observation", ["vector", "raster"])
@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
def test_it_is_shown_what_the_environment_shows(observation, traffic):
    settings = {"noise": "ou-high", "traffic": traffic}
    env = DrivingEnv(observation=observation, terminate=False, **settings)
    mine, other = (Weaving(space=env.observation_space) for _ in range(2))
    planner = shiftsim.policy_planner(mine)
    scenario = shiftsim.open_store("demo")["01f13e"]
    shiftsim.simulate(scenario, planner, seed=5, **settings)
    scores_of_episode(env, other, {"token": scenario.token, "seed": 5})
    assert len(mine.seen) == len(other.seen) + 1 == scenario.num_iterations - 1
    # the environment has the order of its space, the raster that of the observer
    assert mine.seen[:-1] == other.seen if observation == "vector" else True
    assert sees_recording(planner) == (observation == "raster")
