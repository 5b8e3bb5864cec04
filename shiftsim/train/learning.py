"""One step of imitation: a batch of states, the loss, and the optimiser."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from shiftsim.kernels import BoolArray, IntArray
from shiftsim.planners.learned.carl.network import CarlNetwork, Policy
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.train.gradients import Gradients
from shiftsim.train.pictures import stack_rasters
from shiftsim.train.states import States, Values
from shiftsim.world.state import PACIFICA

BATCH = 64  # states of a step
RATE, FLOOR, WARM_UP = 1e-3, 0.01, 0.02  # learning rate, its end as a share, share of rising
DECAY, CLIP = 0.01, 5.0  # of the weights; of the norm of the gradient
AVERAGED = 0.999  # of the running mean of the weights, per step
SCALES = (0.3, 0.06)  # of errors of acceleration and steering
LATE = 3.0  # weight of braking less than the label, where it brakes
BEGUN = 0.5  # share of the learning rate, where weights are given to begin with
CERTAINTY = 0.01  # weight of the likelihood, by which the distribution gets its width
EDGE = 0.01  # labels are kept so far from the ends of [0, 1], where the density may be 0 or inf
HIDDEN, MIRRORED = 0.5, 0.25  # shares: of last actions not shown, of states in the mirror
# a network in training reads measurements divided by these: last action, velocity and acceleration
# of the centre [m/s, m/s^2], steering angle and rate [rad, rad/s], yaw rate and acceleration
UNITS = (1.0, 1.0, 5.0, 0.5, 1.0, 0.5, 0.1, 0.3, 0.2, 0.5)
MIRRORED_ACTION = np.array([1, -1], np.float32)  # signs in the mirror
_MIRRORED = np.array([1, -1, 1, -1, 1, -1, -1, -1, -1, -1], np.float32)
_AX, _YAW_ACCEL = 4, 9  # of the measurements
_FIRST_WEIGHT = "features_extractor.state_linear.0.weight"

State = dict[str, Tensor]


class Batch(NamedTuple):
    """States as they are learnt from. B states."""

    indices: IntArray  # (B,)
    mirrored: BoolArray  # (B,)
    measurements: Values  # (B, 10)
    actions: Values  # (B, 2)


def to_official(state: State) -> State:
    """A state as the planner has it, which knows no units: its first layer takes them in."""
    weight = state[_FIRST_WEIGHT]
    return {**state, _FIRST_WEIGHT: weight / torch.tensor(UNITS, device=weight.device)}


def from_official(state: State) -> State:
    """The inverse of `to_official`."""
    weight = state[_FIRST_WEIGHT]
    return {**state, _FIRST_WEIGHT: weight * torch.tensor(UNITS, device=weight.device)}


def in_units(measurements: Tensor) -> Tensor:
    """Measurements (B, 10) as a network in training reads them."""
    return measurements / torch.tensor(UNITS, device=measurements.device)


def mirrored_measurements(measurements: Values) -> Values:
    """(…, 10) measurements of the ego in the mirror.

    The acceleration of the centre holds the yaw acceleration, with its sign.
    """
    out = measurements * _MIRRORED
    turning = PACIFICA.rear_axle_to_center * measurements[..., _YAW_ACCEL]
    out[..., _AX] -= np.float32(2.0) * turning.astype(np.float32)
    return out


def draw_batch(states: States, key: Iterable[int], size: int = BATCH) -> Batch:
    """A batch that depends on the key and the states only."""
    random = np.random.default_rng(list(key))
    indices = states.draw(size, random)
    mirrored, hidden = random.random(size) < MIRRORED, random.random(size) < HIDDEN
    measurements, actions = states.measurements[indices], states.actions[indices]
    measurements[mirrored] = mirrored_measurements(measurements[mirrored])
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
    """What a step came to."""

    loss: float  # mean over the batch
    errors: tuple[float, float]  # mean absolute errors of acceleration and steering


class Learner:
    """A network, its optimiser, and the running mean of its weights, which is what drives."""

    def __init__(
        self, device: str, threads: int, total: int, seed: int, begin: State | None = None
    ) -> None:
        """`total` steps are to be done; the learning rate falls towards their end.

        `begin` are weights to begin with.
        """
        torch.manual_seed(seed)
        self.network, self.total, self.step = CarlNetwork(), total, 0
        self._rate = RATE * BEGUN if begin else RATE
        if begin:
            self.network.load_state_dict(begin)
        self.network.to(device)
        self.mean = {name: value.detach().clone() for name, value in self._parameters.items()}
        plain = [value for value in self._trained if value.dim() != 2 and value.dim() != 4]
        heavy = [value for value in self._trained if value.dim() in (2, 4)]
        groups = [{"params": heavy, "weight_decay": DECAY}, {"params": plain, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=RATE, betas=(0.9, 0.99), fused=True)
        self._gradients = Gradients(device, threads)

    @property
    def _parameters(self) -> dict[str, Tensor]:
        return dict(self.network.named_parameters())

    @property
    def _trained(self) -> list[Tensor]:
        return [v for name, v in self._parameters.items() if not name.startswith("value_head")]

    def learn(self, states: States, batch: Batch) -> StepResult:
        """Do one step."""
        count = len(batch.indices)

        def get_rasters(rows: IntArray) -> Raster:
            rasters = [states.picture(int(index)) for index in batch.indices[rows]]
            return stack_rasters(rasters, batch.mirrored[rows].tolist())

        def evaluate(rows: IntArray, rasters: Tensor) -> tuple[Tensor, Tensor]:
            measured = torch.from_numpy(batch.measurements[rows]).to(rasters.device)
            label = torch.from_numpy(batch.actions[rows]).to(rasters.device)
            return loss_of(self.network(rasters, in_units(measured)), label)

        gradients, loss, errors = self._gradients.of(self.network, count, get_rasters, evaluate)
        torch._foreach_div_(gradients, float(count))
        for group in self.optimiser.param_groups:
            group["lr"] = self._rate * schedule(self.step / self.total)
        for parameter, gradient in zip(self.network.parameters(), gradients, strict=True):
            parameter.grad = gradient
        torch.nn.utils.clip_grad_norm_(self._trained, CLIP)
        self.optimiser.step()
        self.step += 1
        self._average()
        means = (errors / count).tolist()
        return StepResult(loss / count, (means[0], means[1]))

    def _average(self) -> None:
        keep = min(AVERAGED, (1.0 + self.step) / (10.0 + self.step))
        means, now = list(self.mean.values()), [self._parameters[name] for name in self.mean]
        torch._foreach_lerp_(means, [value.detach() for value in now], 1.0 - keep)

    def driving(self) -> State:
        """The state of the network with the mean weights."""
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


def schedule(done: float) -> float:
    """Learning rate as a share of the highest, after a share of all steps: up, then a cosine."""
    if done < WARM_UP:
        return (done + 1e-4) / (WARM_UP + 1e-4)
    along = min((done - WARM_UP) / (1.0 - WARM_UP), 1.0)
    return float(FLOOR + (1.0 - FLOOR) * 0.5 * (1.0 + np.cos(np.pi * along)))
