"""Gradients of a batch, in parts on several threads.

They are summed in an order that does not depend on the number of threads, so that the same seed
gives the same network.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from shiftsim.kernels import IntArray
from shiftsim.planners.learned.carl.raster import Raster

LANES, MICRO = 4, 16  # parts that are summed for themselves; states computed at once

# the rasters (B, 9, 256, 256) of some rows of a batch
GetRasters = Callable[[IntArray], Raster]
# of rows and their rasters: the sum of losses over the rows, and of numbers to report
Evaluate = Callable[[IntArray, Tensor], tuple[Tensor, Tensor]]


class Summed(NamedTuple):
    """What some states came to."""

    gradients: list[Tensor]  # of the parameters of the network
    loss: float
    numbers: Tensor  # of `Evaluate`


class Gradients:
    """Computes gradients on a device, with so many threads."""

    def __init__(self, device: str, threads: int) -> None:
        self.device = device
        torch.set_num_threads(1)  # sums must not depend on the number of cores
        self._pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))

    def of(
        self, network: nn.Module, count: int, get_rasters: GetRasters, evaluate: Evaluate
    ) -> Summed:
        """The sum over a batch of so many rows."""
        ends: list[Tensor] = [*network.parameters()]
        rows = np.arange(count)
        if self.device != "cpu":
            rasters = np.concatenate(list(self._pool.map(get_rasters, _parts(rows))))
            return self._part(ends, rows, rasters, evaluate)
        lanes = np.array_split(rows, LANES)
        return _sum(
            self._pool.map(lambda lane: self._lane(ends, lane, get_rasters, evaluate), lanes)
        )

    def _lane(
        self, ends: list[Tensor], rows: IntArray, get_rasters: GetRasters, evaluate: Evaluate
    ) -> Summed:
        """The same of some rows, few at once, so that they stay in the cache."""
        return _sum(self._part(ends, part, get_rasters(part), evaluate) for part in _parts(rows))

    def _part(
        self, ends: list[Tensor], rows: IntArray, rasters: Raster, evaluate: Evaluate
    ) -> Summed:
        loss, numbers = evaluate(rows, torch.from_numpy(rasters).to(self.device))
        gradients = torch.autograd.grad(loss, ends, allow_unused=True, materialize_grads=True)
        return Summed(list(gradients), float(loss.detach()), numbers.cpu())


def _parts(rows: IntArray) -> Iterator[IntArray]:
    return (rows[first : first + MICRO] for first in range(0, len(rows), MICRO))


def _sum(parts: Iterable[Summed]) -> Summed:
    first, *others = parts
    loss, numbers = first.loss, first.numbers
    for other in others:
        torch._foreach_add_(first.gradients, other.gradients)
        loss, numbers = loss + other.loss, numbers + other.numbers
    return Summed(first.gradients, loss, numbers)
