"""Streams of samples: which there are, in which order, and who makes them.

That, and what is random in a sample, depends on a seed and on places in the stream only. A stream
is cut into blocks of some scenarios; a worker makes whole blocks, which come in their order whoever
makes them.
"""

import pickle
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from itertools import count
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from shiftsim.data import open_store
from shiftsim.errors import ShiftsimError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.runs.results import Run, open_run
from shiftsim.runs.rollouts import Task
from shiftsim.sim.planner import scene_info
from shiftsim.train.samples import KINDS, STEPS, Batch, Sample, make_batch, make_sample
from shiftsim.world.scenario import Scenario

BATCH, PER_BLOCK = 32, 64  # samples; scenarios, enough that batches differ little
# share of iterations that are samples: those in whose 8 s the ego turns, drives on, stands
DRAWN = (0.4, 0.16, 0.05)
DRIVEN = 0.4  # share of those that a planner has driven
TURNING, STANDING = 0.35, 1.0  # rad from which it turns, m below which it stands
ALIGNED = 64  # bytes


class Block(NamedTuple):
    """What a worker hands over at once."""

    batches: list[Batch]
    failed: dict[str, int]  # how many samples could not be made, by reason


@dataclass(frozen=True, slots=True)
class Stream:
    """Which samples there are, in which order: the same for the same values."""

    store: str  # by name or path
    tokens: tuple[str, ...]  # scenarios, sorted
    seed: int
    batch: int = BATCH
    planner: str = "plantf"  # one of `KINDS`
    as_published: bool = False  # of `make_sample`
    driven: tuple[str, ...] = ()  # folders of runs in which a planner drove some of the scenarios

    @property
    def blocks(self) -> int:
        """Number of blocks of an epoch."""
        return -(-len(self.tokens) // PER_BLOCK)

    def tokens_of(self, block: int) -> list[str]:
        """Scenarios of a block; blocks are counted on from epoch to epoch."""
        epoch, place = divmod(block, self.blocks)
        order = np.random.default_rng([self.seed, 1, epoch]).permutation(len(self.tokens))
        return [self.tokens[i] for i in order[place * PER_BLOCK : (place + 1) * PER_BLOCK]]


class BlockMaker:
    """Makes blocks of a stream."""

    def __init__(self, stream: Stream) -> None:
        self._stream, self._store = stream, open_store(stream.store)
        self._kind = KINDS[stream.planner]
        self._planner = self._kind.planner.asking(lambda scenes: ())
        self._driven = defaultdict[str, list[tuple[Run, Task]]](list)
        for run in map(open_run, stream.driven):
            for task in (task for task, place in run.rollout_places.items() if place is not None):
                self._driven[task.token].append((run, task))

    def __call__(self, block: int) -> Block:
        """The samples of a block, in batches, the last of which may be short."""
        failed, made = Counter[str](), list[Sample]()
        tokens = self._stream.tokens_of(block)
        for place, token in enumerate(tokens):
            made += self._of_scenario(token, [self._stream.seed, 2, block, place], failed)
        order = np.random.default_rng([self._stream.seed, 3, block]).permutation(len(made))
        size = self._stream.batch
        batches = [
            make_batch([made[i] for i in order[first : first + size]], self._kind)
            for first in range(0, len(order), size)
        ]
        return Block(batches, dict(failed))

    def _of_scenario(self, token: str, key: list[int], failed: Counter[str]) -> list[Sample]:
        """Samples of a scenario."""
        made: list[Sample] = []
        try:
            scenario = self._store.read(token)
            self._planner.reset(scene_info(scenario))
        except ShiftsimError as error:
            failed[_reason(error)] += 1
            return made
        as_recorded = None, _draw(scenario, key)
        driven = [_draw_driven(*one, scenario, key) for one in self._driven[token]]
        for states, iterations in (as_recorded, *driven):
            how: dict[str, Any] = {"as_published": self._stream.as_published, "driven": states}
            for iteration in iterations.tolist():
                random = np.random.default_rng([*key, iteration + 1])
                try:
                    one = make_sample(self._planner, scenario, iteration, random, **how)
                except ShiftsimError as error:
                    one = _reason(error)
                if isinstance(one, str):
                    failed[one] += 1
                else:
                    made.append(one)
        return made


def _reason(error: ShiftsimError) -> str:
    return f"{type(error).__name__}: {error.message}"


def _usable(scenario: Scenario) -> IntArray:
    """Iterations after which 8 s are recorded."""
    later = scenario.iteration_rows + STEPS * scenario.row_step
    return np.flatnonzero(later < len(scenario.time_us))


def _draw_driven(
    run: Run, task: Task, scenario: Scenario, key: list[int]
) -> tuple[FloatArray, IntArray]:
    """States of a rollout (K, 11), and some of its iterations that have a future."""
    states, usable = run.rollout(task, scenario).ego, _usable(scenario)
    usable = usable[usable < len(states)]
    drawn = np.random.default_rng([*key, 0, task.seed]).random(len(usable)) < DRIVEN
    return states, usable[drawn]


def _draw(scenario: Scenario, key: list[int]) -> IntArray:
    """Some iterations of a scenario that have a future, most of those that are rare on a road."""
    usable = _usable(scenario)
    rows = scenario.iteration_rows[usable]
    changes = scenario.ego[rows + STEPS * scenario.row_step, :3] - scenario.ego[rows, :3]
    turning = np.abs(wrap_angles(changes[:, 2])) > TURNING
    standing = np.hypot(changes[:, 0], changes[:, 1]) < STANDING
    share = np.select([turning, ~standing], DRAWN[:2], DRAWN[2])
    drawn: IntArray = usable[np.random.default_rng([*key, 0]).random(len(usable)) < share]
    return drawn


class Packed(NamedTuple):
    """A block on its way between processes: to share each tensor takes longer than to make it."""

    frame: bytes  # pickled, without numbers
    places: list[tuple[int, int]]  # of the numbers of each tensor
    memory: torch.Tensor  # all of them, as bytes


def pack(block: Block) -> Packed:
    """A block with its numbers in one piece of memory, which processes share."""
    frame, found = BytesIO(), list[pickle.PickleBuffer]()
    pickler = pickle.Pickler(frame, 5, buffer_callback=found.append)
    pickler.dispatch_table = {torch.Tensor: lambda one: (torch.from_numpy, (one.numpy(),))}
    pickler.dump(block)
    parts = [buffer.raw() for buffer in found]
    starts = np.cumsum([0, *(-(-len(part) // ALIGNED) * ALIGNED for part in parts)]).tolist()
    memory = torch.empty(starts.pop(), dtype=torch.uint8)
    memory.share_memory_()  # type: ignore[no-untyped-call]
    places = [(start, start + len(part)) for start, part in zip(starts, parts, strict=True)]
    for (start, end), part in zip(places, parts, strict=True):
        memory.numpy().data[start:end] = part
    return Packed(frame.getvalue(), places, memory)


def unpack(packed: Packed) -> Block:
    """The block, in the memory in which it came."""
    numbers = packed.memory.numpy().data
    block: Block = pickle.loads(packed.frame, buffers=[numbers[a:b] for a, b in packed.places])
    return block


class Blocks(IterableDataset[Block | Packed]):
    """Blocks of a stream from `first` on, without end; packed by workers."""

    def __init__(self, stream: Stream, first: int) -> None:
        self.stream, self.first = stream, first

    def __iter__(self) -> Iterator[Block | Packed]:
        """The blocks of this worker, which are every so manyth."""
        info = get_worker_info()
        make, start = BlockMaker(self.stream), self.first + (info.id if info else 0)
        for block in count(start, info.num_workers if info else 1):
            yield pack(make(block)) if info else make(block)


def load_blocks(stream: Stream, first: int, workers: int) -> Iterator[Block]:
    """Blocks from `first` on in their order, made by so many processes, or by this one for 0."""
    options: dict[str, Any] = {"prefetch_factor": 2} if workers else {}
    blocks = Blocks(stream, first)
    loaded = DataLoader(blocks, batch_size=None, num_workers=workers, **options)
    return map(unpack, loaded) if workers else iter(loaded)
