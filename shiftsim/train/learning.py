"""One step of imitation: a batch of states, the loss, its gradient, and the optimiser.

The network that is trained reads measurements in units of their own (`UNITS`); CaRL's knows none,
so that its first layer takes them in when the weights are written (`to_official`).
"""

import contextlib
import ctypes
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.kernels import BoolArray, IntArray
from shiftsim.planners.learned.carl.network import CarlNetwork, Policy
from shiftsim.train.folder import BATCH, RATE, TERMS, Weights
from shiftsim.train.states import MIRRORED_ACTION, States, Values, mirror_measurements

# a measurement is divided by these: last action, velocity and acceleration of the centre
# [m/s, m/s^2], steering angle and rate [rad, rad/s], yaw rate and acceleration
UNITS = np.array([1.0, 1.0, 5.0, 0.5, 1.0, 0.5, 0.1, 0.3, 0.2, 0.5], np.float32)
_UNITS_IN = "features_extractor.state_linear.0.weight"
LANES, MICRO = 4, 16  # parts of a batch that are summed for themselves; states computed at once
FLOOR, WARM_UP = 0.01, 0.02  # end of the learning rate as a share, share of rising
DECAY, CLIP = 0.01, 5.0  # of the weights; of the norm of the gradient
AVERAGED = 0.999  # of the running mean of the weights, per step
SCALES = (0.3, 0.06)  # of errors of acceleration and steering
LATE = 3.0  # weight of braking less than the label, where it brakes
BEGUN = 0.5  # share of the learning rate, where weights are given to begin with
CERTAINTY = 0.01  # weight of the likelihood, by which the distribution gets its width
EDGE = 0.01  # labels are kept so far from the ends of [0, 1], where the density may be 0 or inf
HIDDEN, MIRRORED = 0.5, 0.25  # shares: of last actions not shown, of states in the mirror


def to_official(weights: Weights) -> Weights:
    """Weights of a network that is trained as CaRL's network has them, without units."""
    units = torch.from_numpy(UNITS).to(weights[_UNITS_IN].device)
    return {**weights, _UNITS_IN: weights[_UNITS_IN] / units}


def from_official(weights: Weights) -> Weights:
    """The inverse of `to_official`."""
    units = torch.from_numpy(UNITS).to(weights[_UNITS_IN].device)
    return {**weights, _UNITS_IN: weights[_UNITS_IN] * units}


class BatchGradient(NamedTuple):
    """Sums over the states of a batch."""

    gradients: list[Tensor]  # of the parameters
    loss: float
    numbers: Tensor  # to report


class GradientPool:
    """Gradients of batches; a CPU sums parts in an order that no number of threads changes."""

    def __init__(self, device: str, threads: int) -> None:
        self._device, self._threads = device, threads
        torch.set_num_threads(1)  # sums must not depend on the number of cores
        self._pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))

    def sum(self, compute: Callable[..., BatchGradient], *lanes: Iterable[Any]) -> BatchGradient:
        """Sum of what `compute` gives for the parts of a batch, whose arguments are `lanes`."""
        return _sum(self._pool.map(compute, *lanes))

    def load(self, rows: IntArray, read: Callable[[IntArray], NDArray[np.uint8]]) -> Tensor:
        """The rasters that `read` gives for some rows; those of a GPU are read on all threads."""
        if self._device == "cpu":
            return torch.from_numpy(read(rows))
        parts = np.array_split(rows, min(self._threads, len(rows)))
        loaded = self._pool.map(lambda part: torch.from_numpy(read(part)).to(self._device), parts)
        return torch.cat([*loaded])

    def compute(
        self,
        parameters: list[Tensor],
        count: int,
        loss_of_rows: Callable[[IntArray], tuple[Tensor, Tensor]],
    ) -> BatchGradient:
        """Gradient of so many rows; sums of losses over some of them, and of numbers to report."""

        def of_rows(rows: IntArray) -> BatchGradient:
            loss, numbers = loss_of_rows(rows)
            found = torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True)
            return BatchGradient(list(found), float(loss.detach()), numbers.cpu())

        def of_lane(rows: IntArray) -> BatchGradient:  # few at once, which stay in the cache
            starts = range(0, len(rows), MICRO)
            return _sum(of_rows(rows[start : start + MICRO]) for start in starts)

        rows = np.arange(count)
        if self._device != "cpu":
            return of_rows(rows)
        lanes = [lane for lane in np.array_split(rows, LANES) if len(lane)]
        return self.sum(of_lane, lanes)


def keep_memory() -> None:
    """Have Linux's C library keep what tensors leave: clearing pages takes a third of a step."""
    if sys.platform == "linux":
        for option, value in ((-4, 0), (-1, 2**30), (-2, 2**26)):  # mmap_max, trim, top_pad
            with contextlib.suppress(AttributeError):  # a C library without
                ctypes.CDLL(None).mallopt(option, value)


def _sum(parts: Iterable[BatchGradient]) -> BatchGradient:
    first, *others = parts
    loss, numbers = first.loss, first.numbers
    for other in others:
        with torch.no_grad():  # torch 2.6 fills in zeros that want a gradient of their own
            for total, gradient in zip(first.gradients, other.gradients, strict=True):
                total.add_(gradient)
        loss, numbers = loss + other.loss, numbers + other.numbers
    return BatchGradient(first.gradients, loss, numbers)


def apply_gradient(
    optimiser: torch.optim.Optimizer,
    parameters: list[Tensor],
    found: BatchGradient,
    count: int,
    *,
    clip: float,
    rate: float,
) -> None:
    """One step of an optimiser down the mean gradient of so many states, clipped to a norm."""
    for parameter, gradient in zip(parameters, found.gradients, strict=True):
        parameter.grad = (gradient / count).contiguous()  # as a GPU needs it
    torch.nn.utils.clip_grad_norm_(parameters, clip)
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.step()


class Batch(NamedTuple):
    """States as they are learnt from. B states."""

    indices: IntArray  # (B,)
    mirrored: BoolArray  # (B,)
    measurements: Values  # (B, 10)
    actions: Values  # (B, 2)


def draw_batch(states: States, key: Iterable[int], size: int = BATCH) -> Batch:
    """A batch that depends on the key and the states only."""
    random = np.random.default_rng(list(key))
    indices = states.draw(size, random)
    mirrored, hidden = random.random(size) < MIRRORED, random.random(size) < HIDDEN
    measurements, actions = states.measurements[indices], states.actions[indices]
    measurements[mirrored] = mirror_measurements(measurements[mirrored])
    actions[mirrored] *= MIRRORED_ACTION
    measurements[hidden, :2] = 0.0
    return Batch(indices, mirrored, measurements, actions)


def loss_of(policy: Policy, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Sum of losses over (B, 2) labels, and (2,) the sums of absolute errors.

    The mean of the distribution, which is what the policy does, is fitted to the label, and to
    brake too little is worse than too much: a pedestrian may be one pixel. The width is fitted by
    likelihood, with the mean as given.
    """
    error = policy.action - actions
    scales = torch.tensor(SCALES, device=error.device)
    fit = functional.smooth_l1_loss(error / scales, torch.zeros_like(error), reduction="none")
    is_late = (actions[:, 0] < 0.0) & (error[:, 0] > 0.0)
    each = torch.stack([torch.where(is_late, LATE * fit[:, 0], fit[:, 0]), fit[:, 1]])
    total = policy.alpha + policy.beta
    mean = (policy.alpha / total).detach()
    label = ((actions + 1.0) / 2.0).clamp(EDGE, 1.0 - EDGE)
    likely = log_density(mean * total, (1.0 - mean) * total, label)
    return each.sum() - CERTAINTY * likely.sum(), error.detach().abs().sum(0)


def log_density(alpha: Tensor, beta: Tensor, x: Tensor) -> Tensor:
    """Logarithm of the density of beta distributions at x in (0, 1)."""
    scale = torch.lgamma(alpha + beta) - torch.lgamma(alpha) - torch.lgamma(beta)
    return scale + (alpha - 1.0) * torch.log(x) + (beta - 1.0) * torch.log1p(-x)


@dataclass
class StepResult:
    """What a step came to: means over the batch."""

    loss: float
    terms: dict[str, float]  # by name in the table of the curve


class TrainedNetwork:
    """A network, its optimiser, and the running mean of its weights, which is what drives."""

    batch: int  # samples of a step
    terms: tuple[str, ...]  # what is reported of one
    trained: list[Tensor]  # parameters

    def __init__(
        self, network: nn.Module, groups: list[dict[str, Any]], total: int, *, betas: Any
    ) -> None:
        """`total` steps are to be done; `groups` of parameters are those of the optimiser."""
        self.network, self.total, self.step = network, total, 0
        self.optimiser = torch.optim.AdamW(groups, lr=RATE, betas=betas, fused=True)
        self.mean = {name: value.detach().clone() for name, value in self._averaged.items()}

    @property
    def _averaged(self) -> dict[str, Tensor]:
        """Weights, and statistics of what goes through them."""
        values = self.network.state_dict().items()
        return {name: value for name, value in values if value.is_floating_point()}

    def apply(self, found: BatchGradient, count: int, rate: float) -> StepResult:
        """One step down the mean of so many gradients; its weights go into the mean, too."""
        apply_gradient(self.optimiser, self.trained, found, count, clip=CLIP, rate=rate)
        self.step += 1
        drift = 1.0 - min(AVERAGED, (1.0 + self.step) / (10.0 + self.step))
        for name, value in self._averaged.items():
            self.mean[name].lerp_(value, drift)
        means = (found.numbers / count).tolist()
        return StepResult(found.loss / count, dict(zip(self.terms, means, strict=True)))

    def driving(self) -> Weights:
        """The network with the mean weights, which drives; as files have it."""
        return {**self.network.state_dict(), **self.mean}

    def state(self) -> dict[str, Any]:
        """All that is needed to go on."""
        network, mean = self.network.state_dict(), self.mean
        optimiser = self.optimiser.state_dict()
        return {"network": network, "mean": mean, "optimiser": optimiser, "step": self.step}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        self.network.load_state_dict(state["network"])
        for name, value in state["mean"].items():
            self.mean[name].copy_(value)
        self.optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]


class Learner(TrainedNetwork):
    """CaRL's network, trained by imitation."""

    batch, terms = BATCH, tuple(TERMS["carl"])

    def __init__(
        self, device: str, threads: int, total: int, seed: int, begin: Weights | None = None
    ) -> None:
        """`total` steps are to be done; `begin` are weights to begin with."""
        torch.manual_seed(seed)
        network = CarlNetwork()
        self._rate = RATE * BEGUN if begin else RATE
        if begin:
            network.load_state_dict(begin)
        network.to(device)
        named = network.named_parameters()
        self.trained = [value for name, value in named if not name.startswith("value_head")]
        plain = [value for value in self.trained if value.dim() not in (2, 4)]
        decayed = [value for value in self.trained if value.dim() in (2, 4)]
        groups = [
            {"params": decayed, "weight_decay": DECAY},
            {"params": plain, "weight_decay": 0.0},
        ]
        super().__init__(network, groups, total, betas=(0.9, 0.99))
        self._device, self._pool = device, GradientPool(device, threads)

    def learn(self, states: States, batch: Batch) -> StepResult:
        """Do one step."""
        count = len(batch.indices)

        def loss_of_rows(rows: IntArray) -> tuple[Tensor, Tensor]:
            arrays = batch.measurements[rows] / UNITS, batch.actions[rows]
            measured, label = (torch.from_numpy(a).to(self._device) for a in arrays)
            return loss_of(self.network(self._pool.load(rows, read), measured), label)

        def read(rows: IntArray) -> NDArray[np.uint8]:
            return states.rasters(batch.indices[rows], batch.mirrored[rows].tolist())

        found = self._pool.compute(self.trained, count, loss_of_rows)
        return self.apply(found, count, self._rate * schedule(self.step / self.total))

    def driving(self) -> Weights:
        """The network with the mean weights, without units."""
        return to_official(super().driving())


def schedule(done: float, warm_up: float = WARM_UP, floor: float = FLOOR) -> float:
    """Learning rate as a share of the highest, after a share of all steps: up, then a cosine."""
    if done < warm_up:
        return (done + 1e-4) / (warm_up + 1e-4)
    along = min((done - warm_up) / (1.0 - warm_up), 1.0)
    return float(floor + (1.0 - floor) * 0.5 * (1.0 + np.cos(np.pi * along)))
