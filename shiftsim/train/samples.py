"""Samples of a store for PlanTF, made when they are needed: nothing is cached.

A sample is one iteration of a recording as the planner would see it, through the planner's own
features, and what ego and agents did in the 8 s after it. Half of the samples are perturbed: the
ego is moved away from where it was, and its target leads back to the recording.

Which samples there are and what is random in them depends on a seed and on places in the stream
only. A stream is cut into blocks of some scenarios; a worker makes whole blocks, which come in
their order whoever makes them.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from itertools import count
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from shiftsim.data import open_store
from shiftsim.errors import ShiftsimError
from shiftsim.geometry.boxes import boxes_to_corners, boxes_touch, wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.planners.learned import features
from shiftsim.planners.learned.plantf import planner as plantf
from shiftsim.planners.learned.plantf.network import Inputs
from shiftsim.sim.planner import History, observe_log, scene_info
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, center_poses

STEPS = features.PLAN_POSES  # of a target
BATCH, PER_BLOCK = 32, 16  # samples; scenarios
# share of iterations that are samples: those in whose 8 s the ego turns, drives on, stands
DRAWN = (0.4, 0.15, 0.05)
TURNING, STANDING = 0.35, 1.0  # rad from which it turns, m below which it stands
PERTURBED = 0.5  # share of samples
# most that x, y [m], heading [rad], speed [m/s], acceleration [m/s^2], steering angle [rad] and
# yaw rate [rad/s] are moved by
NOISE = np.array([1.0, 0.75, 0.35, 1.0, 0.5, 0.2, 0.1])
NEIGHBOURS = 10  # agents that the ego must not be moved into

_SHORT = "less than 8 s recorded after it"
_NO_ROAD = "no lane or crosswalk around it"


class Sample(NamedTuple):
    """One sample. A rows of agents, the ego first."""

    features: plantf.Features
    target: np.ndarray  # (A, 80, 3) float32, of `targets`
    valid: np.ndarray  # (A, 80) whether a row was recorded then


class Batch(NamedTuple):
    """Some samples; padding is valid nowhere."""

    inputs: Inputs
    target: Tensor  # (B, A, 80, 3)
    valid: Tensor  # (B, A, 80)

    def on(self, device: str) -> "Batch":
        """The same on a device."""
        return self._map(lambda value: value.to(device) if isinstance(value, Tensor) else value)

    def split(self, count: int) -> "list[Batch]":
        """The same in up to `count` parts."""
        size = -(-len(self.target) // count)
        starts = range(0, len(self.target), size)
        return [self._map(itemgetter(slice(start, start + size))) for start in starts]

    def _map(self, change: Callable[[Any], Any]) -> "Batch":
        """The same with all changed that goes by scenes: tensors, and lists of counts."""
        parts = {item.name: getattr(self.inputs, item.name) for item in fields(self.inputs)}
        counts = parts.pop("counts")
        moved = {name: change(value) for name, value in parts.items()}
        moved["counts"] = [change(by_scene) for by_scene in counts]
        return Batch(Inputs(**moved), change(self.target), change(self.valid))


class Block(NamedTuple):
    """What a worker hands over at once."""

    batches: list[Batch]
    failed: dict[str, int]  # how many samples could not be made, by reason


def perturbed_state(state: FloatArray, noise: FloatArray) -> FloatArray:
    """(7,) x, y, heading, speed, acceleration, steering angle, yaw rate moved by noise (7,)."""
    moved = state + noise
    moved[3] = max(moved[3], 0.0)
    return moved


def is_free(pose: FloatArray, others: FloatArray, sizes: FloatArray) -> bool:
    """Whether the ego with its rear axle at a pose (3,) touches none of boxes (N, 3), (N, 2)."""
    own = boxes_to_corners(center_poses(pose)[None], np.array([[PACIFICA.length, PACIFICA.width]]))
    return not any(boxes_touch(own[0], box) for box in boxes_to_corners(others, sizes))


def targets(present: FloatArray, future: FloatArray, frame: FloatArray) -> np.ndarray:
    """(A, 80, 3) float32 change of x, y [m] and heading [rad] since the present, 0 where NaN.

    Args:
        present: (A, 3) poses now.
        future: (A, 80, 3) poses after it.
        frame: (3,) rear axle of the ego, whose frame the changes are in.
    """
    cos, sin = np.cos(frame[2]), np.sin(frame[2])
    x, y, turn = (future[..., axis] - present[:, None, axis] for axis in range(3))
    changes = np.empty(future.shape, np.float32)
    # not wrapped: cosine and sine of the heading are what is learnt
    changes[..., 0], changes[..., 1], changes[..., 2] = cos * x + sin * y, cos * y - sin * x, turn
    changes[np.isnan(x)] = 0.0
    return changes


def make_sample(
    planner: plantf.PlanTF, scenario: Scenario, iteration: int, random: np.random.Generator
) -> Sample | str:
    """The sample of an iteration, or why there is none; `planner` was reset to the scenario."""
    row = int(scenario.iteration_rows[iteration])
    rows = row + scenario.row_step * np.arange(1, STEPS + 1)
    if rows[-1] >= len(scenario.time_us):
        return _SHORT
    observation = observe_log(scenario, iteration)
    state = None
    if random.random() < PERTURBED:
        noise = random.uniform(-NOISE, NOISE)
        state = _perturb(observation.history, noise)
    if state is not None:
        ego = observation.history.ego.copy()
        ego[-1, :3] = features.map_poses(state[:3], ego[-1])
        observation = observe_log(scenario, iteration, ego=ego)
    read = planner.features(observation)
    if not len(read.road.objects):
        return _NO_ROAD
    if state is not None:  # the steering angle that follows from a jump would be wrong
        read.current_state[3:] = state[3:]
    ego, tracks, near = observation.history.ego[-1, :3], scenario.tracks, read.agents.tracks
    future, valid = np.empty((len(near) + 1, STEPS, 3)), np.ones((len(near) + 1, STEPS), np.bool_)
    future[0], valid[1:] = scenario.ego[rows, :3], tracks.valid[rows[:, None], near].T
    future[1:] = tracks.poses[rows, near[:, None]]
    present = np.concatenate([ego[None], tracks.poses[row, near]])
    return Sample(read, targets(present, future, ego), valid)


def _perturb(history: History, noise: FloatArray) -> FloatArray | None:
    """(7,) the present state moved by noise (7,), in its own frame; None where that is no place."""
    state = perturbed_state(plantf.current_state(history).astype(np.float64), noise)
    ego, tracks = history.ego[-1], history.tracks
    near = features.nearest_agents(tracks, center_poses(ego[:3]), NEIGHBOURS)
    pose = features.map_poses(state[:3], ego)
    return state if is_free(pose, tracks.poses[-1, near], tracks.sizes[-1, near]) else None


def make_batch(samples: Sequence[Sample]) -> Batch:
    """A batch of samples."""
    inputs = plantf.make_batch([one.features for one in samples], "cpu")
    return Batch(
        inputs, *features.stack_scenes([(one.target, one.valid) for one in samples], "cpu")
    )


@dataclass(frozen=True, slots=True)
class Stream:
    """Which samples there are, in which order: the same for the same values."""

    store: str  # by name or path
    tokens: tuple[str, ...]  # scenarios, sorted
    seed: int
    batch: int = BATCH

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
        self._planner = plantf.PlanTF.asking(lambda scenes: ())

    def __call__(self, block: int) -> Block:
        """The samples of a block, in batches, the last of which may be short."""
        failed: Counter[str] = Counter()
        made: list[Sample] = []
        tokens = self._stream.tokens_of(block)
        for place, token in enumerate(tokens):
            made += self._of_scenario(token, [self._stream.seed, 2, block, place], failed)
        order = np.random.default_rng([self._stream.seed, 3, block]).permutation(len(made))
        size = self._stream.batch
        batches = [
            make_batch([made[i] for i in order[first : first + size]])
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
            failed[type(error).__name__] += 1
            return made
        for iteration in _draw(scenario, key).tolist():
            random = np.random.default_rng([*key, iteration + 1])
            try:
                one = make_sample(self._planner, scenario, iteration, random)
            except ShiftsimError as error:
                one = type(error).__name__
            if isinstance(one, str):
                failed[one] += 1
            else:
                made.append(one)
        return made


def _draw(scenario: Scenario, key: list[int]) -> IntArray:
    """Some iterations of a scenario that have a future, most of those that are rare on a road."""
    rows = scenario.iteration_rows
    later = rows + STEPS * scenario.row_step
    usable = np.flatnonzero(later < len(scenario.time_us))
    changes = scenario.ego[later[usable], :3] - scenario.ego[rows[usable], :3]
    turning = np.abs(wrap_angles(changes[:, 2])) > TURNING
    standing = np.hypot(changes[:, 0], changes[:, 1]) < STANDING
    share = np.select([turning, ~standing], DRAWN[:2], DRAWN[2])
    drawn: IntArray = usable[np.random.default_rng([*key, 0]).random(len(usable)) < share]
    return drawn


class Blocks(IterableDataset[Block]):
    """Blocks of a stream from `first` on, without end."""

    def __init__(self, stream: Stream, first: int) -> None:
        self.stream, self.first = stream, first

    def __iter__(self) -> Iterator[Block]:
        """The blocks of this worker, which are every so manyth."""
        info = get_worker_info()
        make, start = BlockMaker(self.stream), self.first + (info.id if info else 0)
        for block in count(start, info.num_workers if info else 1):
            yield make(block)


def load_blocks(stream: Stream, first: int, workers: int) -> Iterator[Block]:
    """Blocks from `first` on in their order, made by so many processes, or by this one for 0."""
    options: dict[str, Any] = {"prefetch_factor": 2} if workers else {}
    blocks = Blocks(stream, first)
    return iter(DataLoader(blocks, batch_size=None, num_workers=workers, **options))
