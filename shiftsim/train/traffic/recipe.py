"""Training learned traffic: imitation of recorded agents, in rounds (DAgger).

The first round collects recorded states, some of them pushed aside; in later rounds the network
drives all agents beside the recorded ego, and where that leads is labelled with the way back. Each
round trains on the states of all rounds so far, and the last network is measured in towns left out.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.data import open_store
from shiftsim.files import atomic_write
from shiftsim.runs.scenarios import usable_tokens
from shiftsim.sim.traffic import Traffic, make_traffic
from shiftsim.sim.traffic.learned.features import NUM_FEATURES
from shiftsim.sim.traffic.learned.model import HIDDEN, SCALES, LearnedTraffic, Weights
from shiftsim.train.driving import divide
from shiftsim.train.folder import OnMessage, TrafficSettings, make_folder, write_table
from shiftsim.train.traffic.realism import compare
from shiftsim.train.traffic.states import States, join, states_of

WEIGHTS, TABLE, CURVE = "weights.npz", "realism.parquet", "losses.parquet"
BATCH, RATE, FLOOR = 1024, 2e-3, 0.02
ASIDE = 0.3  # m beside the point steered to that weigh as much as 1 m/s^2


def train_traffic(settings: TrafficSettings, on_message: OnMessage) -> Path:
    """Train, write weights, losses and the table of realism, and return the file of the weights.

    The same settings on the same machine give the same weights. It is a ConfigError if the folder
    is not empty, a DataError if the store is not there, or has too few scenarios.
    """
    out, seed = settings.out, settings.seed
    store = open_store(settings.store)
    towns = divide(store, usable_tokens(store, settings.split), seed)
    trained = [token for group in towns.trained.values() for token in sorted(group)]
    tested = [token for group in towns.tested.values() for token in sorted(group)]
    make_folder(out)
    torch.set_num_threads(1)  # sums in one order
    network, parts, losses = new_network(seed), list[States](), list[dict[str, Any]]()
    file = out / WEIGHTS
    write_weights(file, weights_of(network))
    for number in range(settings.rounds):
        traffic = LearnedTraffic(file)  # which drives from the second round on
        chosen = np.random.default_rng([seed, 3, number]).permutation(trained)
        for place, token in enumerate(chosen[: settings.scenarios].tolist()):
            random = np.random.default_rng([seed, number, place])
            parts.append(states_of(store.read(token), traffic, random, drives=number > 0))
        found = learn(network, join(parts), settings.epochs, seed + number)
        write_weights(file, weights_of(network))
        epochs = enumerate(found, start=1)
        losses += [{"round": number + 1, "epoch": epoch, "loss": loss} for epoch, loss in epochs]
        count = sum(len(part.features) for part in parts)
        on_message(f"round {number + 1} of {settings.rounds}: {count} states, loss {found[-1]:.3f}")
    write_table(out / CURVE, losses)
    order = np.random.default_rng([seed, 4]).permutation(tested)[: settings.tests].tolist()
    models: dict[str, Callable[[], Traffic]] = {
        "learned": partial(LearnedTraffic, file),
        **{name: partial(make_traffic, name) for name in ("reactive", "constant-velocity")},
    }
    write_table(out / TABLE, compare(map(store.read, order), models))
    return file


def write_weights(path: Path, weights: Weights) -> None:
    """Write weights as `LearnedTraffic` reads them."""
    with atomic_write(path) as partial_file, partial_file.open("wb") as stream:
        np.savez(stream, **weights._asdict())


def new_network(seed: int) -> nn.Sequential:
    """A network that has learnt nothing."""
    torch.manual_seed(seed)
    last = nn.Linear(HIDDEN, 2)
    nn.init.zeros_(last.weight)
    return nn.Sequential(
        nn.Linear(NUM_FEATURES, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), last
    )


def weights_of(network: nn.Sequential) -> Weights:
    """Its weights, as the traffic takes them: of each layer a matrix, transposed, and a bias."""
    arrays = (parameter.detach().numpy().T for parameter in network.parameters())
    return Weights(*map(np.ascontiguousarray, arrays))


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
    controls = out * torch.tensor(SCALES, dtype=out.dtype)
    harder = functional.huber_loss(controls[:, 0], labels[:, 0], delta=1.0)
    aside = 0.5 * labels[:, 2] ** 2 * (controls[:, 1] - labels[:, 1]) / ASIDE
    return harder + functional.huber_loss(aside, torch.zeros_like(aside), delta=1.0)
