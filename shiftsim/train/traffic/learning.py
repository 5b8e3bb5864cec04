"""The network of learned traffic as it is trained."""

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.sim.traffic.learned.features import NUM_FEATURES
from shiftsim.sim.traffic.learned.network import HIDDEN, SCALES, Weights
from shiftsim.train.traffic.states import States

BATCH, RATE, FLOOR = 1024, 2e-3, 0.02
ASIDE = 0.3  # m beside the point steered to that weigh as much as 1 m/s^2


def new_network(seed: int) -> nn.Sequential:
    """A network that has learnt nothing."""
    torch.manual_seed(seed)
    last = nn.Linear(HIDDEN, 2)
    nn.init.zeros_(last.weight)
    return nn.Sequential(
        nn.Linear(NUM_FEATURES, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), last
    )


def weights_of(network: nn.Sequential) -> Weights:
    """Its weights, as the traffic takes them."""
    arrays: list[np.ndarray] = []
    for parameter in network.parameters():  # a weight, transposed, and a bias of each layer
        arrays.append(np.ascontiguousarray(parameter.detach().numpy().T))
    return Weights(*arrays)


def learn(network: nn.Sequential, states: States, epochs: int, seed: int) -> list[float]:
    """Train on all states; the mean loss of each epoch."""
    torch.manual_seed(seed)
    features, labels = map(torch.from_numpy, states)
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    steps = max(epochs * (len(features) // BATCH), 1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, RATE * FLOOR)
    losses = []
    count = max(len(features) // BATCH, 1)
    for _ in range(epochs):
        total, order = 0.0, torch.randperm(len(features))
        for first in range(0, count * BATCH, BATCH):
            part = order[first : first + BATCH]
            loss = _loss(network(features[part]), labels[part])
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            optimiser.step()
            schedule.step()
            total += float(loss.detach())
        losses.append(total / count)
    return losses


def _loss(out: Tensor, labels: Tensor) -> Tensor:
    made = out * torch.tensor(SCALES, dtype=out.dtype)
    harder = functional.huber_loss(made[:, 0], labels[:, 0], delta=1.0)
    aside = 0.5 * labels[:, 2] ** 2 * (made[:, 1] - labels[:, 1]) / ASIDE
    return harder + functional.huber_loss(aside, torch.zeros_like(aside), delta=1.0)
