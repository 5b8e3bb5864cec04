"""Gradients of a batch, in parts on several threads.

They are summed in an order that does not depend on the number of threads, so that the same seed
gives the same network.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from shiftsim.kernels import IntArray
from shiftsim.train.network import Laid, tensor_of
from shiftsim.train.pictures import Blocks

LANES, MICRO = 4, 16  # parts that are summed for themselves; states computed at once

# the blocks of some rows of a batch
See = Callable[[IntArray], Blocks]
# of weights, rows and their pictures: the sum of losses over the rows, and of numbers to report
Judge = Callable[[Laid, IntArray, Tensor], tuple[Tensor, Tensor]]


class Summed(NamedTuple):
    """What some states came to."""

    gradients: list[Tensor]  # of the weights that are laid out
    loss: float
    numbers: Tensor  # of `Judge`


class Gradients:
    """Computes gradients on a device, with so many threads."""

    def __init__(self, device: str, threads: int) -> None:
        self.device = device
        torch.set_num_threads(1)  # sums must not depend on the number of cores
        self._pool = ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))

    def of(self, ends: Laid, count: int, see: See, judge: Judge) -> Summed:
        """The sum over a batch of so many rows; `ends` are leaves."""
        rows = np.arange(count)
        if self.device != "cpu":
            blocks = np.concatenate(list(self._pool.map(see, _parts(rows))))
            return self._part(ends, rows, blocks, judge)
        lanes = np.array_split(rows, LANES)
        return _sum(self._pool.map(lambda lane: self._lane(ends, lane, see, judge), lanes))

    def _lane(self, ends: Laid, rows: IntArray, see: See, judge: Judge) -> Summed:
        """The same of some rows, few at once, so that they stay in the cache."""
        return _sum(self._part(ends, part, see(part), judge) for part in _parts(rows))

    def _part(self, ends: Laid, rows: IntArray, blocks: Blocks, judge: Judge) -> Summed:
        loss, numbers = judge(ends, rows, tensor_of(blocks, self.device))
        wanted = list(ends.values())
        gradients = torch.autograd.grad(loss, wanted, allow_unused=True, materialize_grads=True)
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
