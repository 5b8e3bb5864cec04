"""Samples of a store for PlanTF, PLUTO and Diffusion Planner, made when needed: nothing is cached.

A sample is one iteration of a recording as the planner would see it, through the planner's own
features, and what ego and agents did in the 8 s after it. Half of the samples are perturbed: the
ego is moved away from where it was, and its target leads back to the recording. What differs from
planner to planner is in `KINDS`.

"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import shapely
import torch
from torch import Tensor

from shiftsim.geometry.boxes import boxes_to_corners, from_frame, to_frame, turned
from shiftsim.geometry.polylines import arc_lengths, project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned import features
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.diffusion import planner as diffusion
from shiftsim.planners.learned.diffusion.features import Features as DiffusionFeatures
from shiftsim.planners.learned.plantf import planner as plantf
from shiftsim.planners.learned.pluto import planner as pluto
from shiftsim.planners.learned.pluto.world import red_lights
from shiftsim.planners.proposals.contacts import touches_boxes
from shiftsim.sim.planner import Observation, observe_log, past_rows
from shiftsim.world.layers import contains
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, VX, VY, center_poses

STEPS = features.PLAN_POSES  # of a target
PERTURBED, SLOWED = 0.5, 0.5  # share of samples, and of these
STEP = 0.1  # s
# of the way back: acceleration and braking [m/s^2], seconds and metres to the recorded path, metres
# that are looked ahead for the recorded speed
HARDEST, TIME_BACK, NEAREST_BACK, AHEAD = (1.5, 2.0), 2.5, 8.0, 0.5
# most that x, y [m], heading [rad], speed [m/s], acceleration [m/s^2], steering angle [rad] and
# yaw rate [rad/s] are moved by
NOISE = np.array([1.0, 0.75, 0.35, 1.0, 0.5, 0.2, 0.1])
# Diffusion Planner reads the pose only; below the speed [m/s] it is not moved
MOVED_POSE = NOISE * [0, 1, 1, 0, 0, 0, 0]
MOVING = 2.0
NEIGHBOURS = 10  # agents that the ego must not be moved into, and that Diffusion Planner predicts

# a driven ego is a sample if it is so far ahead and aside [m] and turned [rad] from the path, and
# so many steps late, at most
MOST_AWAY, MOST_LATE = np.array([2.5, 1.5, NOISE[2]]), 80


class Sample(NamedTuple):
    """One sample. A rows of agents, the ego first."""

    features: Any  # of the planner
    # (A, 80, 3) of `targets`; of PLUTO (A, 80, 6) of `motion_targets`; of Diffusion Planner
    # (11, 80, 3) poses in the frame of the ego, 0 where not recorded
    target: np.ndarray
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
        parts = self._parts | {"target": self.target, "target_valid": self.valid}
        parts["projection"] = self.projection
        if "counts" in parts:
            parts["counts"] = torch.tensor(parts["counts"])
        return {name: value for name, value in parts.items() if value is not None}

    @property
    def _parts(self) -> dict[str, Any]:
        if isinstance(self.inputs, dict):
            return dict(self.inputs)
        return {item.name: getattr(self.inputs, item.name) for item in fields(self.inputs)}

    def _map(self, change: Callable[[Any], Any]) -> "Batch":
        """The same with all changed that goes by scenes: tensors, and lists of counts."""
        parts = self._parts
        counts = parts.pop("counts", None)
        moved = {name: change(value) for name, value in parts.items()}
        if counts is not None:
            moved["counts"] = [change(by_scene) for by_scene in counts]
        labels: list[Any] = [None if value is None else change(value) for value in self[1:]]
        return Batch(type(self.inputs)(**moved), *labels)


def perturbed_state(state: FloatArray, noise: FloatArray) -> FloatArray:
    """(7,) x, y, heading, speed, acceleration, steering angle, yaw rate moved by noise (7,)."""
    moved = state + noise
    moved[3] = max(moved[3], 0.0)
    return moved


def is_free(pose: FloatArray, others: FloatArray, sizes: FloatArray) -> bool:
    """Whether the ego with its rear axle at a pose (3,) touches none of boxes (N, 3), (N, 2)."""
    own = boxes_to_corners(center_poses(pose)[None], np.array([[PACIFICA.length, PACIFICA.width]]))
    return not touches_boxes(own[0], boxes_to_corners(others, sizes)).any()


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
    points, out = ego[9::10, :2], np.empty((len(lines), 8, 2), np.float32)
    for line, both in zip(lines, out, strict=True):
        xy = np.ascontiguousarray(line[:, :2])
        arc = arc_lengths(xy, np.array([0, len(xy)]))
        both[:, 0] = [project_on_polyline(xy, arc, 0, len(xy), x, y) for x, y in points.tolist()]
        both[:, 1] = shapely.distance(shapely.linestrings(xy), shapely.points(points))
    return out


def way_back(speed: float, path: FloatArray) -> FloatArray:
    """(80, 3) poses that lead an ego that is elsewhere back to the recording, as a driver would.

    Beside the recorded path the ego comes back to it within some metres; behind the recording it
    gathers speed as a car does and drives as it did at the same place, and never ahead of it. The
    targets of the authors of PlanTF and PLUTO are back at once.

    Args:
        speed: Of the ego [m/s].
        path: (B + 81, 3) recorded poses in the frame of the ego, from where it is beside: those of
            the B steps before now, if it is late, now, and of the 8 s after it.
    """
    path = path.copy()
    if np.abs(np.diff(path[:, 2])).max() > 3.0:
        path[:, 2] = np.unwrap(path[:, 2])
    steps = np.hypot(*np.diff(path[:, :2], axis=0).T)
    lengths = np.concatenate([[0.0], np.cumsum(steps)])
    lon, lat, turn = to_frame(np.zeros(3), path[0])
    along = caught_up(lengths, np.append(steps, steps[-1]) / STEP, lon, speed)
    poses = np.column_stack([np.interp(along, lengths, column) for column in path.T])
    # behind the first pose, beyond the last
    outside = along - np.minimum(np.maximum(along, 0.0), lengths[-1])
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    reach = max(NEAREST_BACK, TIME_BACK * max(speed, steps[0] / STEP))
    place = np.minimum((along - lon) / reach, 1.0)  # a cubic from the offset and its slope to 0
    slope, left = min(max(np.tan(turn), -1.0), 1.0), 1.0 - place
    aside = left**2 * (lat * (1.0 + 2.0 * place) + slope * reach * place)
    change = left * (slope * (1.0 - 3.0 * place) - 6.0 * lat / reach * place)
    poses[:, 0] = poses[:, 0] + outside * cos - aside * sin
    poses[:, 1] = poses[:, 1] + outside * sin + aside * cos
    poses[:, 2] += np.arctan(change)
    return poses


@kernel
def caught_up(lengths: FloatArray, speeds: FloatArray, place: float, speed: float) -> FloatArray:
    """(80,) places on a recorded path [m] of an ego that begins elsewhere, or with another speed.

    Args:
        lengths: (B + 81,) recorded places [m], of which the last 80 are still to come.
        speeds: (B + 81,) of the recording there [m/s].
        place: Of the ego now [m].
        speed: Of the ego now [m/s].
    """
    out, now = np.empty(STEPS), len(lengths) - STEPS - 1
    ahead = max(place, 0.0) + max(speed - speeds[0], 0.0) ** 2 / (2.0 * HARDEST[1])
    at = 0  # of the recording, where the ego is
    for step in range(len(out)):
        while at + 2 < len(lengths) and lengths[at + 1] < place + AHEAD:
            at += 1
        wanted = max(speeds[at], speeds[at + 1])
        speed = max(min(speed + HARDEST[0] * STEP, wanted), speed - HARDEST[1] * STEP)
        reached = max(min(place + speed * STEP, lengths[now + step + 1] + ahead), place)
        speed, place = (reached - place) / STEP, reached
        out[step] = place
    return out


class Moment(NamedTuple):
    """The present of a sample."""

    scenario: Scenario
    row: int  # of the recording
    observation: Observation
    state: FloatArray  # (7,) of the ego, in the frame that it was recorded in
    # row from which on the ego goes `way_back`, the present one or one before it; None if it is
    # there already, or at once
    beside: int | None

    @property
    def rows(self) -> slice:
        """Those of the 8 s after it."""
        step = self.scenario.row_step
        return slice(self.row + step, self.row + step * STEPS + 1, step)

    def future(self, near: IntArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Poses of the ego and of some tracks: (A, 3) now, (A, 80, 3) later; whether recorded."""
        scenario, tracks, rows = self.scenario, self.scenario.tracks, self.rows
        poses = _recorded(tracks.poses, near, rows.start, rows.step)
        valid = np.ones(poses.shape[:2], np.bool_)
        valid[1:] = tracks.valid[rows].take(near, axis=1).T
        now, poses[0] = self.observation.history.ego[-1:, :3], scenario.ego[rows, :3]
        if self.beside is not None:
            path = scenario.ego[self.beside : rows.stop : rows.step, :3]
            poses[0] = from_frame(way_back(self.state[3], to_frame(path, now[0])), now[0])
        return np.vstack([now, tracks.poses[self.row, near]]), poses, valid

    def velocities(self, near: IntArray, drive: FloatArray) -> FloatArray:
        """(A, 80, 2) in the frame of the map [m/s], of the same; `drive` (81, 3) is the ego's."""
        ego, velocities = self.scenario.ego[self.rows], self.scenario.tracks.velocities
        cos, sin, vx, vy = np.cos(ego[:, 2]), np.sin(ego[:, 2]), ego[:, VX], ego[:, VY]
        own = np.column_stack([cos * vx - sin * vy, sin * vx + cos * vy])
        if self.beside is not None:
            own = np.diff(drive[:, :2], axis=0) / STEP
        motion: FloatArray = _recorded(velocities, near, self.rows.start, self.rows.step)
        motion[0] = own
        return motion


@kernel
def _recorded(values: FloatArray, near: IntArray, first: int, step: int) -> FloatArray:
    """(1 + N, 80, k) of some tracks from a row on, behind a first one that is not yet known."""
    out = np.empty((1 + len(near), STEPS, values.shape[2]))
    for track in range(len(near)):
        for place in range(STEPS):
            for axis in range(values.shape[2]):
                out[1 + track, place, axis] = values[first + place * step, near[track], axis]
    return out


def _plantf_sample(planner: plantf.PlanTF, read: plantf.Features, now: Moment) -> Sample | str:
    if not len(read.road.objects):
        return "no lane or crosswalk around it"
    read.current_state[3:] = now.state[3:]
    present, poses, valid = now.future(read.agents.tracks)
    return Sample(read, targets(present, poses, present[0]), valid)


def _pluto_sample(planner: pluto.Pluto, read: pluto.SceneInputs, now: Moment) -> Sample | str:
    if not read.line_valid.any():
        return "no reference line"
    read.current_state[3:] = now.state[3:]
    seen = planner.surroundings
    present, poses, valid = now.future(seen.agents.tracks)
    valid[0, steps_before_red(planner, now, poses[0]) :] = False
    motion = now.velocities(seen.agents.tracks, np.vstack([present[:1], poses[0]]))
    target = motion_targets(present, poses, motion, present[0])
    return Sample(read, target, valid, projections(seen.lines, poses[0]))


def steps_before_red(planner: pluto.Pluto, now: Moment, ego: FloatArray) -> int:
    """Steps of the ego (80, 3) before its centre is on a connector of the route that is red now."""
    road = now.scenario.map
    assert planner.route is not None
    red = red_lights(road, planner.route, now.observation).tolist()
    for step, (x, y, _) in enumerate(center_poses(ego) if red else ()):
        if any(contains(road.edges.polygons, connector, x, y) for connector in red):
            return step
    return STEPS


def _diffusion_sample(planner: Any, read: DiffusionFeatures, now: Moment) -> Sample | str:
    if not len(read.edges):
        return "no lane within 100 m"
    present, poses, recorded = now.future(read.agents[:NEIGHBOURS])
    poses = to_frame(poses, present[0])
    target = np.zeros((1 + NEIGHBOURS, STEPS, 3), np.float32)
    valid = np.zeros(target.shape[:2], np.bool_)
    target[: len(poses)], valid[: len(poses)] = np.nan_to_num(poses), recorded
    return Sample(read, target, valid)


class Kind(NamedTuple):
    """What of samples is a planner's own."""

    planner: type[LearnedPlanner[Any, Any]]
    tries: int  # of finding a free place for the moved ego
    label: Callable[[Any, Any, Moment], Sample | str]  # of a planner and its features
    make_inputs: Callable[..., Any]  # of its network, from features
    noise: FloatArray = NOISE
    slowest: float = 0.0  # m/s at which the ego is moved


KINDS = {
    "plantf": Kind(plantf.PlanTF, 1, _plantf_sample, plantf.make_batch),
    "pluto": Kind(pluto.Pluto, 5, _pluto_sample, pluto.make_batch),
    "diffusion-planner": Kind(
        diffusion.DiffusionPlanner, 1, _diffusion_sample, diffusion.make_inputs, MOVED_POSE, MOVING
    ),
}


def make_sample(
    planner: LearnedPlanner[Any, Any],
    scenario: Scenario,
    iteration: int,
    random: np.random.Generator,
    *,
    as_published: bool = False,
    driven: FloatArray | None = None,
) -> Sample | str:
    """The sample of an iteration, or why there is none; `planner` was reset to the scenario.

    A moved ego of PlanTF and PLUTO is back at once `as_published`; otherwise, and of Diffusion
    Planner always, it goes `way_back`, and half of them are slower by any share of their speed.

    Args:
        planner: Whose features.
        scenario: The recording.
        iteration: Of the scenario.
        random: Draws what is random.
        as_published: See above.
        driven: (K, 11) states in which a planner has driven the ego, instead of those recorded.
    """
    row, kind = int(scenario.iteration_rows[iteration]), KINDS[planner.name]
    if row + STEPS * scenario.row_step >= len(scenario.time_us):
        return "less than 8 s recorded after it"
    ego = beside = None
    if driven is not None:
        ego, beside = _drive(scenario, iteration, driven)
        if beside is None:
            return "driven far from the recording"
    observation = observe_log(scenario, iteration, ego=ego)
    history = observation.history
    # recordings know no steering angle and no yaw rate: they are derived, and not from a jump
    state = plantf.current_state(history).astype(np.float64)
    if driven is None and random.random() < PERTURBED and state[3] >= kind.slowest:
        noise = random.uniform(-kind.noise, kind.noise)
        if kind.noise[3] and not as_published and random.random() < SLOWED:
            noise[3] = -random.random() * state[3]
        ego, tracks = history.ego.copy(), history.tracks
        near = features.nearest_agents(tracks, center_poses(ego[-1, :3]), NEIGHBOURS)
        boxes = tracks.poses[-1, near], tracks.sizes[-1, near]
        place = partial(features.map_poses, ego=history.ego[-1])
        moved = free_state(state, noise, lambda at: is_free(place(at), *boxes), kind.tries)
        if moved is not None:
            state, ego[-1, :3] = moved, place(moved[:3])
            observation = replace(observation, history=replace(history, ego=ego))
            beside = None if as_published and kind.noise[3] else row
    now = Moment(scenario, row, observation, state, beside)
    return kind.label(planner, planner.features(observation), now)


def _drive(scenario: Scenario, iteration: int, driven: FloatArray) -> tuple[FloatArray, int | None]:
    """Past states of a driven ego, and the row that it is beside, maybe late; None where far."""
    row = int(scenario.iteration_rows[iteration])
    ego = scenario.ego[past_rows(scenario, iteration)].copy()
    states = driven[max(iteration + 1 - len(ego), 0) : iteration + 1]
    ego[len(ego) - len(states) :] = states
    before = np.arange(row, -1, -scenario.row_step)[: MOST_LATE + 1]
    near = int(np.hypot(*(scenario.ego[before, :2] - ego[-1, :2]).T).argmin())
    away = np.abs(to_frame(ego[-1, :3], scenario.ego[before[near], :3]))
    return ego, None if (away > MOST_AWAY).any() else int(before[near])


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
