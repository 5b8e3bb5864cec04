"""Many environments at once, in one process and in several."""

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import shiftsim.env

CONTEXT = {"sync": {}, "async": {"context": "spawn"}}
COUNT, STEPS = 3, 60  # so many steps are more than two episodes


def roll(toy, mode, autoreset):
    envs = gymnasium.make_vec(
        shiftsim.env.ID,
        num_envs=COUNT,
        vectorization_mode=mode,
        vector_kwargs={"autoreset_mode": autoreset} | CONTEXT[mode],
        store=str(toy),
        noise="ou-low",
        terminate=False,
    )
    assert envs.metadata["autoreset_mode"] == autoreset
    first, infos = envs.reset(seed=5)
    seen, rewards, ends = [first], [], []
    for _ in range(STEPS):
        observation, reward, _, truncated, _ = envs.step(np.zeros((COUNT, 2), np.float32))
        seen.append(observation)
        rewards.append(reward)
        ends.append(truncated)
    envs.close()
    return np.array(seen), np.array(rewards), np.array(ends), list(infos["token"])


@pytest.mark.slow
@pytest.mark.parametrize("autoreset", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_one_process_and_several_do_the_same(toy, autoreset):
    together, apart = (roll(toy, mode, autoreset) for mode in ("sync", "async"))
    for one, other in zip(together, apart, strict=True):
        np.testing.assert_array_equal(one, other)
    seen, _, ends, tokens = together
    assert len(set(tokens)) > 1
    # 25 iterations: 23 steps, and the step that resets where that is one of its own
    period = 24 if autoreset is AutoresetMode.NEXT_STEP else 23
    np.testing.assert_array_equal(np.flatnonzero(ends[:, 0]), np.arange(22, STEPS, period))
    assert np.ptp(seen[:, :, 0]) > 0.0


def test_environments_of_one_process_share_the_store(toy):
    envs = gymnasium.make_vec(
        shiftsim.env.ID, num_envs=2, vectorization_mode="sync", store=str(toy)
    )
    envs.reset(seed=0)
    one, other = (env.unwrapped.episode.scenario for env in envs.envs)
    assert one.map is other.map
