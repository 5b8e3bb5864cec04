"""Samples of a store for PlanTF and PLUTO, made when they are needed: nothing is cached.

A sample is one iteration of a recording as the planner would see it, through the planner's own
features, and what ego and agents did in the 8 s after it. Half of the samples are perturbed: the
ego is moved away from where it was, and its target leads back to the recording. What differs from
planner to planner is in `KINDS`.

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
import shapely
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from shiftsim.data import open_store
from shiftsim.errors import ShiftsimError
from shiftsim.geometry.boxes import boxes_to_corners, boxes_touch, turned, wrap_angles
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.planners.learned import features
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.plantf import planner as plantf
from shiftsim.planners.learned.pluto import planner as pluto
from shiftsim.planners.learned.pluto.world import red_lights
from shiftsim.sim.planner import History, Observation, observe_log, scene_info
from shiftsim.world.layers import contains
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, VX, VY, center_poses

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
_NO_LINE = "no reference line"


class Sample(NamedTuple):
    """One sample. A rows of agents, the ego first."""

    features: Any  # of the planner
    target: np.ndarray  # (A, 80, 3) of `targets`; of PLUTO (A, 80, 6) of `motion_targets`
    valid: BoolArray  # (A, 80) steps that count
    projection: np.ndarray | None = None  # (R, 8, 2) of `projections`, of PLUTO only


class Batch(NamedTuple):
    """Some samples; padding is valid nowhere."""

    inputs: Any  # of the planner's network
    target: Tensor  # (B, A, 80, 3 or 6)
    valid: Tensor  # (B, A, 80)
    projection: Tensor | None = None  # (B, R, 8, 2)

    def on(self, device: str) -> "Batch":
        """The same on a device."""
        return self._map(lambda value: value.to(device) if isinstance(value, Tensor) else value)

    def split(self, count: int) -> "list[Batch]":
        """The same in up to `count` parts."""
        size = -(-len(self.target) // count)
        starts = range(0, len(self.target), size)
        return [self._map(itemgetter(slice(start, start + size))) for start in starts]

    def tensors(self) -> dict[str, Tensor]:
        """All by name; `counts` (parts, B) are how many rows of a part are not padding."""
        labels = {name: value for name, value in self._asdict().items() if value is not None}
        del labels["inputs"]
        return {**self._parts, "counts": torch.tensor(self.inputs.counts), **labels}

    @property
    def _parts(self) -> dict[str, Any]:
        return {item.name: getattr(self.inputs, item.name) for item in fields(self.inputs)}

    def _map(self, change: Callable[[Any], Any]) -> "Batch":
        """The same with all changed that goes by scenes: tensors, and lists of counts."""
        parts = self._parts
        counts = parts.pop("counts")
        moved = {name: change(value) for name, value in parts.items()}
        moved["counts"] = [change(by_scene) for by_scene in counts]
        labels: list[Any] = [None if value is None else change(value) for value in self[1:]]
        return Batch(type(self.inputs)(**moved), *labels)


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


def motion_targets(
    present: FloatArray, future: FloatArray, velocities: FloatArray, frame: FloatArray
) -> np.ndarray:
    """(A, 80, 6) float32 of PLUTO: change of x, y [m], its turn's cosine and sine, velocity [m/s].

    As `targets`, with velocities (A, 80, 2) in the frame of the map, which are only turned.
    """
    changes = targets(present, future, frame)
    angle, velocity = changes[..., 2:], turned(velocities, frame[2])
    parts = [changes[..., :2], np.cos(angle), np.sin(angle), velocity]
    motion: np.ndarray = np.concatenate(parts, axis=-1, dtype=np.float32)
    motion[np.isnan(future[..., 0])] = 0.0
    return motion


def projections(lines: Sequence[FloatArray], ego: FloatArray) -> np.ndarray:
    """(R, 8, 2) float32 arc length and distance [m] of the ego on each line, after 1 to 8 s.

    Args:
        lines: R reference lines (K, 3).
        ego: (80, 3) poses of the rear axle in the 8 s.
    """
    points = shapely.points(ego[9::10, :2])
    curves = np.array([shapely.linestrings(line[:, :2]) for line in lines])[:, None]
    both = [shapely.line_locate_point(curves, points), shapely.distance(curves, points)]
    return np.stack(both, axis=-1).astype(np.float32)


class Future(NamedTuple):
    """What was recorded in the 8 s after a sample. A rows of agents, the ego first."""

    present: FloatArray  # (A, 3) poses now
    poses: FloatArray  # (A, 80, 3)
    velocities: FloatArray  # (A, 80, 2) in the frame of the map [m/s]
    valid: BoolArray  # (A, 80) whether there was a row


class Moment(NamedTuple):
    """The present of a sample."""

    scenario: Scenario
    row: int  # of the recording
    observation: Observation

    def future(self, near: IntArray) -> Future:
        """Of the ego from where it is now, and of some tracks."""
        scenario, tracks, step = self.scenario, self.scenario.tracks, self.scenario.row_step
        rows = slice(self.row + step, self.row + step * STEPS + 1, step)
        ego = scenario.ego[rows]
        poses, velocities, valid = (  # (80, A - 1, ...); indexing with two arrays is slow
            values[rows].take(near, axis=1)
            for values in (tracks.poses, tracks.velocities, tracks.valid)
        )
        cos, sin, vx, vy = np.cos(ego[:, 2]), np.sin(ego[:, 2]), ego[:, VX], ego[:, VY]
        own = np.column_stack([cos * vx - sin * vy, sin * vx + cos * vy])
        return Future(
            np.vstack([self.observation.history.ego[-1:, :3], tracks.poses[self.row, near]]),
            np.concatenate([ego[None, :, :3], poses.swapaxes(0, 1)]),
            np.concatenate([own[None], velocities.swapaxes(0, 1)]),
            np.vstack([np.ones((1, STEPS), np.bool_), valid.T]),
        )


def _plantf_sample(planner: plantf.PlanTF, read: plantf.Features, now: Moment) -> Sample | str:
    if not len(read.road.objects):
        return _NO_ROAD
    future = now.future(read.agents.tracks)
    return Sample(read, targets(future.present, future.poses, future.present[0]), future.valid)


def _pluto_sample(planner: pluto.Pluto, read: pluto.SceneInputs, now: Moment) -> Sample | str:
    if not read.line_valid.any():
        return _NO_LINE
    seen = planner.surroundings
    future = now.future(seen.agents.tracks)
    future.valid[0, steps_before_red(planner, now, future.poses[0]) :] = False
    target = motion_targets(*future[:3], future.present[0])
    return Sample(read, target, future.valid, projections(seen.lines, future.poses[0]))


def steps_before_red(planner: pluto.Pluto, now: Moment, ego: FloatArray) -> int:
    """Steps of the ego (80, 3) before its centre is on a connector of the route that is red now."""
    road = now.scenario.map
    assert planner.route is not None
    red = red_lights(road, planner.route, now.observation).tolist()
    for step, (x, y, _) in enumerate(center_poses(ego) if red else ()):
        if any(contains(road.edges.polygons, connector, x, y) for connector in red):
            return step
    return STEPS


class Kind(NamedTuple):
    """What of samples is a planner's own."""

    planner: type[LearnedPlanner[Any, Any]]
    tries: int  # of finding a free place for the moved ego
    label: Callable[[Any, Any, Moment], Sample | str]  # of a planner and its features
    make_inputs: Callable[..., Any]  # of its network, from features


KINDS = {
    "plantf": Kind(plantf.PlanTF, 1, _plantf_sample, plantf.make_batch),
    "pluto": Kind(pluto.Pluto, 5, _pluto_sample, pluto.make_batch),
}


def make_sample(
    planner: LearnedPlanner[Any, Any],
    scenario: Scenario,
    iteration: int,
    random: np.random.Generator,
) -> Sample | str:
    """The sample of an iteration, or why there is none; `planner` was reset to the scenario."""
    row, kind = int(scenario.iteration_rows[iteration]), KINDS[planner.name]
    if row + STEPS * scenario.row_step >= len(scenario.time_us):
        return _SHORT
    observation = observe_log(scenario, iteration)
    # recordings know no steering angle and no yaw rate: they are derived, and not from a jump
    state = plantf.current_state(observation.history).astype(np.float64)
    if random.random() < PERTURBED:
        noise = random.uniform(-NOISE, NOISE)
        moved = _perturb(observation.history, state, noise, kind.tries)
        if moved is not None:
            ego, state = observation.history.ego.copy(), moved
            ego[-1, :3] = features.map_poses(state[:3], ego[-1])
            observation = observe_log(scenario, iteration, ego=ego)
    read = planner.features(observation)
    read.current_state[3:] = state[3:]
    return kind.label(planner, read, Moment(scenario, row, observation))


def _perturb(
    history: History, state: FloatArray, noise: FloatArray, tries: int
) -> FloatArray | None:
    """(7,) the state moved by noise (7,), in its own frame; None where that is no place."""
    ego, tracks = history.ego[-1], history.tracks
    near = features.nearest_agents(tracks, center_poses(ego[:3]), NEIGHBOURS)
    boxes = tracks.poses[-1, near], tracks.sizes[-1, near]
    return free_state(
        state, noise, lambda pose: is_free(features.map_poses(pose, ego), *boxes), tries
    )


def free_state(
    state: FloatArray, noise: FloatArray, free: Callable[[FloatArray], bool], tries: int
) -> FloatArray | None:
    """(7,) state moved by noise (7,) to a free pose (3,), by half of it at each further try.

    Of several tries the last one counts anyway, as PLUTO's does; None where a single one fails.
    """
    for number in range(tries):
        moved = perturbed_state(state, noise * 0.5**number)
        if free(moved[:3]):
            return moved
    return moved if tries > 1 else None


def make_batch(samples: Sequence[Sample], kind: Kind) -> Batch:
    """A batch of samples."""
    inputs = kind.make_inputs([one.features for one in samples], "cpu")
    labels = [[value for value in one[1:] if value is not None] for one in samples]
    return Batch(inputs, *features.stack_scenes(labels, "cpu"))


@dataclass(frozen=True, slots=True)
class Stream:
    """Which samples there are, in which order: the same for the same values."""

    store: str  # by name or path
    tokens: tuple[str, ...]  # scenarios, sorted
    seed: int
    batch: int = BATCH
    planner: str = "plantf"  # one of `KINDS`

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
