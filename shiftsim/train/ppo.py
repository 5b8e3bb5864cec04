"""Reinforcement learning (PPO) of CaRL's network, from one that imitation has trained.

As CaRL does it, with two differences: rewards are shares of an episode instead of percents, and the
critic, which imitation leaves untrained, learns alone at first.
"""

from functools import partial
from time import monotonic
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray
from torch import Tensor

from shiftsim.files import write_text
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.planners.learned.carl.network import CarlNetwork, Policy
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.train.curves import Say, write_table
from shiftsim.train.gradients import Gradients
from shiftsim.train.jobs import NOISES, Towns
from shiftsim.train.keeping import read_state, write_state
from shiftsim.train.learning import State, from_official, in_units, log_density, to_official
from shiftsim.train.pictures import packed, unpacked
from shiftsim.train.settings import Settings

ENVS = 8
TRAINED = "trained.txt"  # tokens that are trained on
ROLLOUT, MINIBATCH, EPOCHS = 2048, 512, 2
RATE, EPSILON, CLIP_NORM = 2.5e-4, 1e-5, 0.5
DISCOUNT, TRACE = 0.99, 0.95
CLIP, VALUE_WEIGHT = 0.1, 0.5
PERCENT = 100.0  # of the environment's reward
ALONE = 0.1  # share of the updates in which only the critic learns
RECENT = 100  # episodes whose mean return tells the best network
_KEPT_EVERY = 120.0  # s
_EDGE = 1e-7  # actions are kept so far from the ends of [0, 1]

Values = NDArray[np.float32]


class Memory(NamedTuple):
    """What one rollout went through. M steps, those of one environment after another."""

    pictures: list[bytes]
    measurements: Values  # (M, 10)
    critic: Values  # (M, 4)
    actions: Values  # (M, 2) in [0, 1]
    density: Values  # (M,) logarithm
    values: Values  # (M,) what the critic expected
    returns: Values  # (M,)
    advantages: Values  # (M,)


class UpdateResult(NamedTuple):
    """What an update came to."""

    loss: float
    clipped: float  # share of the steps at which the ratio was cut


def advantages_of(
    rewards: FloatArray, values: FloatArray, ended: NDArray[np.bool_], last: FloatArray
) -> FloatArray:
    """(T, N) generalised advantages; `ended` (T, N) tells that a step was the last of an episode.

    Nothing is expected beyond an end, whether it was an infraction or that of the scenario. `last`
    (N,) is what the critic expects after the T steps.
    """
    out = np.zeros_like(values)
    trace, after = np.zeros_like(last), last
    for step in range(len(rewards) - 1, -1, -1):
        goes_on = ~ended[step]
        error = rewards[step] + DISCOUNT * after * goes_on - values[step]
        trace = error + DISCOUNT * TRACE * goes_on * trace
        out[step], after = trace, values[step]
    return out


def judged(
    policy: Policy, values: Tensor, part: dict[str, Tensor], *, critic_only: bool
) -> tuple[Tensor, Tensor]:
    """Sum of losses over some steps of a `Memory`, and of the steps that were cut (1,)."""
    x = part["actions"].clamp(_EDGE, 1.0 - _EDGE)
    density = log_density(policy.alpha, policy.beta, x).sum(1)
    ratio = (density - part["density"]).exp()
    gain, near = part["advantages"], ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
    wanted, before = part["returns"], part["values"]
    close = before + (values - before).clamp(-CLIP, CLIP)
    off = (values - wanted).square()
    if critic_only:
        return VALUE_WEIGHT * 0.5 * off.sum(), torch.zeros(1)  # nothing was cut
    acting = -torch.minimum(ratio * gain, near * gain).sum()
    critic = 0.5 * torch.maximum(off, (close - wanted).square()).sum()
    cut = ((ratio - 1.0).abs() > CLIP).sum().detach().float().reshape(1)
    return acting + VALUE_WEIGHT * critic, cut


def reinforce(settings: Settings, towns: Towns, state: State, device: str, say: Say) -> State:
    """The official network with the highest mean return, from that of `state` on."""
    trainer = Trainer(settings, towns, state, device)
    kept: dict[str, Any] = {"rows": [], "best": state, "highest": -np.inf, "seconds": 0.0}
    place = settings.out / "ppo.pt"
    if place.exists():
        kept = read_state(place)
        trainer.restore(kept.pop("trainer"))
    began, noted = monotonic() - kept["seconds"], monotonic()
    with trainer:
        while trainer.update < trainer.total:
            done = trainer.improve()
            recent = trainer.returns[-RECENT:]
            mean = float(np.mean(recent)) if recent else 0.0
            if len(recent) == RECENT and mean > kept["highest"]:
                best = {name: v.clone() for name, v in trainer.network.state_dict().items()}
                kept |= {"best": to_official(best), "highest": mean}
            steps, seconds = trainer.update * ROLLOUT, monotonic() - began
            kept["rows"].append({"samples": steps, "return": mean, **done._asdict()})
            left = seconds / trainer.update * (trainer.total - trainer.update)
            say(
                f"PPO: {steps} of {trainer.total * ROLLOUT} samples  {steps / seconds:.0f} "
                f"samples/s  return {mean:.1f}  loss {done.loss:.3f}  {left / 60.0:.0f} min left"
            )
            write_table(settings.out / "ppo.parquet", kept["rows"])
            if monotonic() - noted > _KEPT_EVERY or trainer.update == trainer.total:
                noted, kept["seconds"] = monotonic(), seconds
                write_state(place, kept | {"trainer": trainer.state()})
    best_of: State = kept["best"]
    return best_of


class Trainer:
    """PPO of one network on many environments."""

    def __init__(self, settings: Settings, towns: Towns, state: State, device: str) -> None:
        """`state` is that of an official network; `towns` are those to train in."""
        self.network = CarlNetwork()
        self.network.load_state_dict(from_official(state))
        self.network.to(device)
        self.total = max(1, settings.ppo_samples // ROLLOUT)
        self.update, self.returns = 0, list[float]()
        self._settings, self._device = settings, device
        self._gradients = Gradients(device, settings.workers)
        self._optimiser = torch.optim.Adam(self.network.parameters(), lr=RATE, eps=EPSILON)
        tokens = sorted(token for found in towns.trained.values() for token in found)
        write_text(settings.out / TRAINED, "\n".join(tokens) + "\n")
        self._envs: Any = None

    def __enter__(self) -> "Trainer":
        makers = [partial(_make, self._settings, number) for number in range(ENVS)]
        mode = AutoresetMode.SAME_STEP
        self._envs = (
            SyncVectorEnv(makers, autoreset_mode=mode)
            if self._settings.workers == 1
            else AsyncVectorEnv(makers, autoreset_mode=mode, context="spawn")
        )
        seeds = np.random.default_rng([self._settings.seed, 4, self.update])
        numbers = seeds.integers(2**31, size=ENVS).tolist()
        self._seen, _ = self._envs.reset(seed=numbers)
        self._sums = np.zeros(ENVS)
        return self

    def __exit__(self, *_: object) -> None:
        self._envs.close()

    def improve(self) -> UpdateResult:
        """Drive one rollout, and learn from it."""
        random = np.random.default_rng([self._settings.seed, 5, self.update])
        torch.manual_seed(int(random.integers(2**31)))
        memory = self._drive(ROLLOUT // ENVS)
        share = self.update / self.total
        for group in self._optimiser.param_groups:
            group["lr"] = RATE * (1.0 - share)
        loss = cut = 0.0
        for _ in range(EPOCHS):
            order = random.permutation(len(memory.pictures))
            for first in range(0, len(order), MINIBATCH):
                rows = order[first : first + MINIBATCH]
                done, clipped = self._learn(memory, rows, critic_only=share < ALONE)
                loss, cut = loss + done * len(rows), cut + clipped
        self.update += 1
        return UpdateResult(loss / EPOCHS / len(order), cut / EPOCHS / len(order))

    def _drive(self, steps: int) -> Memory:
        """Act in all environments for so many steps."""
        pictures: list[bytes] = []
        measured, critic = np.zeros((steps, ENVS, 10)), np.zeros((steps, ENVS, 4))
        actions, ended = np.zeros((steps, ENVS, 2)), np.zeros((steps, ENVS), np.bool_)
        density, values, rewards = np.zeros((3, steps, ENVS))
        with torch.no_grad():
            for step in range(steps):
                seen = self._seen
                policy, value = self._ask(seen)
                x = torch.distributions.Beta(policy.alpha, policy.beta).sample()
                x = x.clamp(_EDGE, 1.0 - _EDGE)
                density[step] = log_density(policy.alpha, policy.beta, x).sum(1).cpu()
                actions[step], values[step] = x.cpu(), value.cpu()
                pictures += [packed(raster) for raster in seen["raster"]]
                measured[step], critic[step] = seen["measurements"], seen["value_measurements"]
                asked = (2.0 * actions[step] - 1.0).astype(np.float32)
                self._seen, reward, infraction, is_over, _ = self._envs.step(asked)
                rewards[step], ended[step] = reward / PERCENT, infraction | is_over
                self._count(reward, ended[step])
            last = self._ask(self._seen)[1].cpu().numpy().astype(np.float64)
        gains = advantages_of(rewards, values, ended, last)
        numbers = (measured, critic, actions, density, values, gains + values, gains)
        flat = [found.reshape(-1, *found.shape[2:]).astype(np.float32) for found in numbers]
        return Memory(pictures, *flat)

    def _ask(self, seen: dict[str, Any]) -> tuple[Policy, Tensor]:
        rasters = torch.from_numpy(seen["raster"]).to(self._device)
        measured = torch.from_numpy(seen["measurements"]).to(self._device)
        critic = torch.from_numpy(seen["value_measurements"]).to(self._device)
        features = self.network.features_extractor(rasters, in_units(measured))
        return self.network.policy(features), self.network.value(features, critic)[:, 0]

    def _count(self, reward: FloatArray, over: NDArray[np.bool_]) -> None:
        self._sums += reward
        self.returns += self._sums[over].tolist()
        self._sums[over] = 0.0

    def _learn(self, memory: Memory, order: IntArray, *, critic_only: bool) -> tuple[float, float]:
        names = ("measurements", "critic", "actions", "density", "values", "returns", "advantages")
        chosen = {name: torch.from_numpy(getattr(memory, name)[order]) for name in names}
        gain = chosen["advantages"]
        chosen["advantages"] = (gain - gain.mean()) / (gain.std() + 1e-8)

        def get_rasters(rows: IntArray) -> Raster:
            return np.stack([unpacked(memory.pictures[index]) for index in order[rows]])

        def evaluate(rows: IntArray, rasters: Tensor) -> tuple[Tensor, Tensor]:
            part = {name: value[rows].to(rasters.device) for name, value in chosen.items()}
            measured = in_units(part["measurements"])
            features = self.network.features_extractor(rasters, measured)
            policy = self.network.policy(features)
            known = features.detach() if critic_only else features
            values = self.network.value(known, part["critic"])[:, 0]
            return judged(policy, values, part, critic_only=critic_only)

        found = self._gradients.of(self.network, len(order), get_rasters, evaluate)
        torch._foreach_div_(found.gradients, float(len(order)))
        for parameter, gradient in zip(self.network.parameters(), found.gradients, strict=True):
            parameter.grad = gradient
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), CLIP_NORM)
        self._optimiser.step()
        return found.loss / len(order), float(found.numbers[0])

    def state(self) -> dict[str, Any]:
        """All that is needed to go on, with new episodes."""
        return {
            "network": self.network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
            "update": self.update,
            "returns": self.returns[-RECENT:],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self.update, self.returns = state["update"], list(state["returns"])


def _make(settings: Settings, number: int) -> gymnasium.Env[Any, Any]:
    """One environment; the noises are dealt out as in imitation."""
    from shiftsim.env.driving import DrivingEnv

    places = (np.arange(ENVS) + 0.5) / ENVS
    noise = list(NOISES)[int(np.searchsorted(np.cumsum(list(NOISES.values())), places[number]))]
    split = str(settings.out / TRAINED)
    return DrivingEnv(
        store=settings.store, split=split, observation="raster", reward="regular", noise=noise
    )
