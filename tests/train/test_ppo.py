"""Reinforcement learning: what it computes, and that it keeps what imitation has reached."""

import numpy as np
import pytest
import torch

from shiftsim.data.store.reading import open_store
from shiftsim.planners.learned.carl.network import CarlNetwork, Policy
from shiftsim.train import ppo
from shiftsim.train.driving import divide
from shiftsim.train.folder import BEST, REINFORCED
from shiftsim.train.learning import to_official
from shiftsim.train.recipe import Training


def test_advantages_are_those_worked_out_by_hand():
    rewards, values = np.array([[1.0], [0.0], [2.0]]), np.array([[0.5], [1.0], [1.5]])
    ended, last = np.array([[False], [True], [False]]), np.array([4.0])
    third = 2.0 + 0.99 * 4.0 - 1.5
    second = 0.0 - 1.0  # the episode ended: nothing is expected, and nothing flows back
    first = 1.0 + 0.99 * 1.0 - 0.5 + 0.99 * 0.95 * second
    found = ppo.advantages_of(rewards, values, ended, last)
    assert found[:, 0] == pytest.approx([first, second, third])


@pytest.fixture
def part():
    x = torch.tensor([[0.6, 0.5], [0.3, 0.7]])
    policy = Policy(torch.full((2, 2), 2.0), torch.full((2, 2), 3.0))
    density = ppo.learning.log_density(policy.alpha, policy.beta, x).sum(1)
    gain, wanted = torch.tensor([1.0, -1.0]), torch.tensor([1.0, 0.0])
    told = {"actions": x, "density": density, "advantages": gain, "returns": wanted}
    return policy, {**told, "values": torch.zeros(2)}


def test_the_loss_is_that_of_ppo(part):
    policy, told = part
    told["density"] = told["density"] - torch.log(torch.tensor([2.0, 1.05]))  # ratios 2 and 1.05
    values = torch.tensor([0.4, 0.05])
    loss, cut = ppo.ppo_loss(policy, values, told, critic_only=False)
    acting = -(min(2.0, 1.1) * 1.0 + min(1.05 * -1.0, 1.05 * -1.0))
    critic = 0.5 * (max(0.6**2, 0.9**2) + 0.05**2)  # the first one is cut at 0.1
    assert float(loss) == pytest.approx(acting + 0.5 * critic, rel=1e-5)
    assert cut.tolist() == [1.0]


def test_alone_the_critic_learns_without_being_cut(part):
    policy, told = part
    loss, cut = ppo.ppo_loss(policy, torch.tensor([0.4, 0.0]), told, critic_only=True)
    assert float(loss) == pytest.approx(0.5 * 0.5 * 0.6**2)
    assert cut.tolist() == [0.0]


@pytest.fixture
def short(monkeypatch):
    """Rollouts of 64 steps of two environments."""
    for name, value in {"ENVS": 2, "ROLLOUT": 64, "MINIBATCH": 32, "RECENT": 2}.items():
        monkeypatch.setattr(ppo, name, value)


@pytest.mark.thorough
def test_it_goes_on_from_imitation_and_writes_a_network(short, small):
    settings = small(ppo_samples=128, samples=128)
    lines = []
    Training(settings, lines.append).run()
    assert (settings.out / REINFORCED).is_file()
    assert sum("return" in line for line in lines) == 2
    assert (settings.out / REINFORCED).read_bytes() != (settings.out / BEST).read_bytes()
    again = []
    Training(settings, again.append, resume=True).run()
    assert not any("return" in line for line in again)  # all of it is done


def test_the_critic_learns_first(short, small, toy):
    settings = small(ppo_samples=64 * 20)
    settings.out.mkdir()
    store = open_store(toy)
    towns = divide(store, store.tokens, 0)
    state = to_official(CarlNetwork().state_dict())
    trainer = ppo.Trainer(settings, towns, state, "cpu")
    before = {name: value.clone() for name, value in trainer.network.state_dict().items()}
    with trainer:
        trainer.improve()
    after = trainer.network.state_dict()
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"value_head"}


@pytest.mark.thorough
def test_it_learns_to_drive_along_a_road(small, toy, monkeypatch):
    for name, value in {"ENVS": 4, "ROLLOUT": 256, "MINIBATCH": 128, "RECENT": 40}.items():
        monkeypatch.setattr(ppo, name, value)
    settings = small(ppo_samples=256 * 16)
    settings.out.mkdir()
    store = open_store(toy)
    towns = divide(store, store.tokens, 0)
    torch.manual_seed(0)
    state = to_official(CarlNetwork().state_dict())
    trainer = ppo.Trainer(settings, towns, state, "cpu")
    with trainer:
        while trainer.update < trainer.total:
            trainer.improve()
    returns = np.array(trainer.returns)
    quarter = len(returns) // 4
    assert returns[-quarter:].mean() > returns[:quarter].mean() + 5.0
