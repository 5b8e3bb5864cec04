"""Reinforcement learning (PPO) of CaRL's network, from one that imitation has trained.

As CaRL does it, with two differences: rewards are shares of an episode instead of percents, and the
critic, which imitation leaves untrained, learns alone at first.
"""

from functools import partial
from time import monotonic
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from shiftsim.env.driving import DrivingEnv, vector_env
from shiftsim.files import write_text
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.planners.learned.carl.network import CarlNetwork, Policy
from shiftsim.train import folder, learning
from shiftsim.train.driving import NOISES, Towns
from shiftsim.train.folder import OnMessage, Settings, Weights
from shiftsim.train.states import Values, compress_raster, read_raster

ENVS = 8
TRAINED = "trained.txt"  # tokens that are trained on
ROLLOUT, MINIBATCH, EPOCHS = 2048, 512, 2
RATE, EPSILON, CLIP_NORM = 2.5e-4, 1e-5, 0.5
DISCOUNT, TRACE = 0.99, 0.95
CLIP, VALUE_WEIGHT = 0.1, 0.5
PERCENT = 100.0  # of the environment's reward
ALONE = 0.1  # share of the updates in which only the critic learns
RECENT = 100  # episodes whose mean return tells the best network
_WRITE_EVERY = 120.0  # s
_EDGE = 1e-7  # actions are kept so far from the ends of [0, 1]


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


def ppo_loss(
    policy: Policy, values: Tensor, part: dict[str, Tensor], *, critic_only: bool
) -> tuple[Tensor, Tensor]:
    """Loss summed over some steps of a rollout; (1,) those with a clipped ratio."""
    x = part["actions"].clamp(_EDGE, 1.0 - _EDGE)
    density = learning.log_density(policy.alpha, policy.beta, x).sum(1)
    ratio = (density - part["density"]).exp()
    advantages, clipped_ratio = part["advantages"], ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
    clipped_values = part["values"] + (values - part["values"]).clamp(-CLIP, CLIP)
    errors = (values - part["returns"]).square()
    if critic_only:
        return VALUE_WEIGHT * 0.5 * errors.sum(), torch.zeros(1)  # nothing was clipped
    acting = -torch.minimum(ratio * advantages, clipped_ratio * advantages).sum()
    critic = 0.5 * torch.maximum(errors, (clipped_values - part["returns"]).square()).sum()
    num_clipped = ((ratio - 1.0).abs() > CLIP).sum().detach().float().reshape(1)
    return acting + VALUE_WEIGHT * critic, num_clipped


def reinforce(
    settings: Settings, towns: Towns, weights: Weights, device: str, on_message: OnMessage
) -> Weights:
    """The official network with the highest mean return, from the one with `weights` on."""
    trainer = Trainer(settings, towns, weights, device)
    state: dict[str, Any] = {"rows": [], "best": weights, "highest": -np.inf, "seconds": 0.0}
    path = settings.out / "ppo.pt"
    if path.exists():
        state = folder.read_state(path)
        trainer.restore(state.pop("trainer"))
    began, written = monotonic() - state["seconds"], monotonic()
    with trainer:
        while trainer.update < trainer.total:
            result = trainer.improve()
            recent = trainer.returns[-RECENT:]
            mean = float(np.mean(recent)) if recent else 0.0
            if len(recent) == RECENT and mean > state["highest"]:
                best = {name: v.clone() for name, v in trainer.network.state_dict().items()}
                state |= {"best": learning.to_official(best), "highest": mean}
            steps, seconds = trainer.update * ROLLOUT, monotonic() - began
            state["rows"].append({"samples": steps, "return": mean, **result})
            left = seconds / 60.0 / trainer.update * (trainer.total - trainer.update)
            on_message(
                f"PPO: {steps} of {trainer.total * ROLLOUT} samples  {steps / seconds:.0f} "
                f"samples/s  return {mean:.1f}  loss {result['loss']:.3f}  {left:.0f} min left"
            )
            folder.write_table(settings.out / "ppo.parquet", state["rows"])
            if monotonic() - written > _WRITE_EVERY or trainer.update == trainer.total:
                written, state["seconds"] = monotonic(), seconds
                folder.write_state(path, state | {"trainer": trainer.state()})
    best_weights: Weights = state["best"]
    return best_weights


class Trainer:
    """PPO of one network on many environments."""

    def __init__(self, settings: Settings, towns: Towns, weights: Weights, device: str) -> None:
        """`weights` are those of an official network; `towns` are those to train in."""
        self.network = CarlNetwork()
        self.network.load_state_dict(learning.from_official(weights))
        self.network.to(device)
        self.total = max(1, settings.ppo_samples // ROLLOUT)
        self.update, self.returns = 0, list[float]()
        self._settings, self._device = settings, device
        self._pool = learning.GradientPool(device, settings.workers)
        self._optimiser = torch.optim.Adam(self.network.parameters(), lr=RATE, eps=EPSILON)
        write_text(settings.out / TRAINED, "\n".join(towns.trained_tokens) + "\n")
        self._envs: Any = None

    def __enter__(self) -> "Trainer":
        makers = [partial(_make, self._settings, number) for number in range(ENVS)]
        mode = AutoresetMode.SAME_STEP
        self._envs = vector_env(makers, self._settings.workers, autoreset_mode=mode)
        seeds = np.random.default_rng([self._settings.seed, 4, self.update])
        numbers = seeds.integers(2**31, size=ENVS).tolist()
        self._observations, _ = self._envs.reset(seed=numbers)
        self._sums = np.zeros(ENVS)
        return self

    def __exit__(self, *_: object) -> None:
        self._envs.close()

    def improve(self) -> dict[str, float]:
        """Drive one rollout and learn from it: mean loss, share of steps with a clipped ratio."""
        random = np.random.default_rng([self._settings.seed, 5, self.update])
        torch.manual_seed(int(random.integers(2**31)))
        pictures, arrays = self._drive(ROLLOUT // ENVS)
        loss = clipped = 0.0
        for _ in range(EPOCHS):
            order = random.permutation(len(pictures))
            for first in range(0, len(order), MINIBATCH):
                rows = order[first : first + MINIBATCH]
                mean_loss, count = self._learn(pictures, arrays, rows)
                loss, clipped = loss + mean_loss * len(rows), clipped + count
        self.update += 1
        return {"loss": loss / EPOCHS / len(order), "clipped": clipped / EPOCHS / len(order)}

    def _drive(self, steps: int) -> tuple[list[bytes], dict[str, Values]]:
        """Act in all environments for so many steps; M steps in all, the environments in turn.

        They come to M rasters, `measurements` (M, 10), `critic` (M, 4), `actions` (M, 2) in [0, 1];
        (M,) `density`, a logarithm, `values` as the critic expected, `returns` and `advantages`.
        """
        pictures: list[bytes] = []
        measured, critic = np.zeros((steps, ENVS, 10)), np.zeros((steps, ENVS, 4))
        actions, ended = np.zeros((steps, ENVS, 2)), np.zeros((steps, ENVS), np.bool_)
        density, values, rewards = np.zeros((3, steps, ENVS))
        with torch.no_grad():
            for step in range(steps):
                batch = self._observations
                policy, value = self._evaluate(*_inputs(batch))
                x = torch.distributions.Beta(policy.alpha, policy.beta).sample()
                x = x.clamp(_EDGE, 1.0 - _EDGE)
                density[step] = learning.log_density(policy.alpha, policy.beta, x).sum(1).cpu()
                actions[step], values[step] = x.cpu(), value.cpu()
                pictures += [compress_raster(raster) for raster in batch["raster"]]
                measured[step], critic[step] = batch["measurements"], batch["value_measurements"]
                sent = (2.0 * actions[step] - 1.0).astype(np.float32)
                self._observations, reward, infraction, is_over, _ = self._envs.step(sent)
                rewards[step], ended[step] = reward / PERCENT, infraction | is_over
                self._sums += reward
                self.returns += self._sums[ended[step]].tolist()
                self._sums[ended[step]] = 0.0
            last = self._evaluate(*_inputs(self._observations))[1].cpu().numpy().astype(np.float64)
        gains = advantages_of(rewards, values, ended, last)
        acted = {"actions": actions, "density": density, "values": values}
        learnt = {"returns": gains + values, "advantages": gains}
        found = {"measurements": measured, "critic": critic, **acted, **learnt}
        flat = {name: x.reshape(-1, *x.shape[2:]).astype(np.float32) for name, x in found.items()}
        return pictures, flat

    def _evaluate(self, *inputs: Any, critic_only: bool = False) -> tuple[Policy, Tensor]:
        """The policy and what the critic expects (B,); alone it does not change the features."""
        rasters, measured, critic = (torch.as_tensor(a, device=self._device) for a in inputs)
        features = self.network.features_extractor(rasters, measured)
        read = features.detach() if critic_only else features
        return self.network.policy(features), self.network.value(read, critic)[:, 0]

    def _learn(
        self, pictures: list[bytes], arrays: dict[str, Values], order: IntArray
    ) -> tuple[float, float]:
        critic_only = self.update / self.total < ALONE
        chosen = {name: torch.from_numpy(values[order]) for name, values in arrays.items()}
        chosen["measurements"] /= torch.from_numpy(learning.UNITS)
        gain = chosen["advantages"]
        chosen["advantages"] = (gain - gain.mean()) / (gain.std() + 1e-8)

        def loss_of_rows(rows: IntArray) -> tuple[Tensor, Tensor]:
            rasters = self._pool.load(rows, read)
            part = {name: value[rows].to(self._device) for name, value in chosen.items()}
            inputs = (rasters, part["measurements"], part["critic"])
            policy, values = self._evaluate(*inputs, critic_only=critic_only)
            return ppo_loss(policy, values, part, critic_only=critic_only)

        def read(rows: IntArray) -> NDArray[np.uint8]:
            return np.stack([read_raster(pictures[index]) for index in order[rows]])

        trained: list[Tensor] = list(self.network.parameters())
        count, rate = len(order), RATE * (1.0 - self.update / self.total)
        found = self._pool.compute(trained, count, loss_of_rows)
        learning.apply_gradient(self._optimiser, trained, found, count, clip=CLIP_NORM, rate=rate)
        return found.loss / count, float(found.numbers[0])

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


def _inputs(batch: dict[str, Any]) -> tuple[Values, ...]:
    """What the network reads of observations."""
    return batch["raster"], batch["measurements"] / learning.UNITS, batch["value_measurements"]


def _make(settings: Settings, number: int) -> gymnasium.Env[Any, Any]:
    """One environment; the noises are dealt out as in imitation."""
    places = (np.arange(ENVS) + 0.5) / ENVS
    noise = list(NOISES)[int(np.searchsorted(np.cumsum(list(NOISES.values())), places[number]))]
    split = str(settings.out / TRAINED)
    return DrivingEnv(
        store=settings.store, split=split, observation="raster", reward="regular", noise=noise
    )
