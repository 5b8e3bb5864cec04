"""What is seen of one rollout, row by row, and the plans that are on their way.

Scenario, traffic, metrics and the log keep the truth. What is seen of a row is made once, when its
truth is there, so that every later history shows the same errors at that time:

    boxes    pose + sigma s(d) z, velocity + sigma s(d) z, size (1 + sigma s(d) z)
    ego      pose + sigma z; the boxes move with it, as the sensors do

with z stationary AR(1) processes of deviation 1, and s(d) = 0.5 + d / 40 m up to 3, which is 1 at a
distance d of 20 m. Random numbers depend on seed, scenario, track and channel, on nothing else; all
are drawn before the first row, and a row follows from the truth of the rows up to it.
"""

from collections import deque
from math import exp, sqrt
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from shiftsim.geometry.boxes import from_frame, to_frame, wrap_angle, wrap_angles
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.sim.log import Seen
from shiftsim.sim.noise import channel_key, keyed_generator
from shiftsim.sim.perception import DT, DT_MS, Drift
from shiftsim.world.state import HEADING, VX, Command, TrackArrays, Tracks, Trajectory

FAR = 50.0  # m, beyond which detections are missed twice as often
NEAR, PER_METRE, MOST = 0.5, 1.0 / 40.0, 3.0  # growth of errors with distance
SMALLEST = 0.2  # of the true length and width
_COAST = 11  # poses of the first plan beyond the latency: the tracker looks 1 s ahead
_CURVED = 0.5  # m driven, below which the curvature of a path is not known
Plan: TypeAlias = Trajectory | Command


class _Model(NamedTuple):
    """What the kernel reads of a model and of the numbers that were drawn for it."""

    keeps: float  # share of an error that stays until the next row
    missed: float  # share of detections that are missed up to `FAR`
    leaves: float  # chance that a missed track is seen in the next row
    range: float  # m
    sigmas: FloatArray  # (6,) deviations of x, y, heading, velocity x, y, and size
    errors: FloatArray  # (N, R, 6), or (0, R, 6): normals, and the processes once they were seen
    draws: FloatArray  # (N, R) in [0, 1), or (0, R) without misses; -1 where one was missed
    spans: IntArray  # (C, 3) of each column that is seen: track, first row, row behind the last


@kernel
def see_boxes(
    row: int,
    ego: FloatArray,
    believed: FloatArray,
    model: _Model,
    truth: TrackArrays,
    seen: TrackArrays,
) -> None:
    """Fill a row of what is seen, NaN so far, after those before; `ego`, `believed` are poses."""
    turn = believed[2] - ego[2]
    cos, sin = np.cos(turn), np.sin(turn)
    moves = believed[0] != ego[0] or believed[1] != ego[1] or turn != 0.0
    fresh = np.sqrt(1.0 - model.keeps * model.keeps)
    errors, draws, sigmas = model.errors, model.draws, model.sigmas
    has_errors, has_misses = len(errors) > 0, len(draws) > 0
    for column in range(len(model.spans)):
        track, begin, end = model.spans[column]
        visible = truth.valid[row, track]
        x, y, heading = truth.poses[row, track]
        vx, vy = truth.velocities[row, track]
        length, width = truth.sizes[row, track]
        distance = np.sqrt((x - ego[0]) ** 2 + (y - ego[1]) ** 2)
        is_first = column == track  # the columns of later tokens are behind all tracks
        if has_errors:
            error = errors[track, row]
            if row > 0 and is_first:
                for i in range(6):
                    error[i] = model.keeps * errors[track, row - 1, i] + fresh * error[i]
            scale = min(NEAR + PER_METRE * distance, MOST)
            x, y = x + scale * sigmas[0] * error[0], y + scale * sigmas[1] * error[1]
            heading = wrap_angle(heading + scale * sigmas[2] * error[2])
            vx, vy = vx + scale * sigmas[3] * error[3], vy + scale * sigmas[4] * error[4]
            growth = max(1.0 + scale * sigmas[5] * error[5], SMALLEST)
            length, width = length * growth, width * growth
        if has_misses:
            if is_first:
                share = model.missed * (2.0 if distance > FAR else 1.0)
                chance = share
                if row > 0 and truth.valid[row - 1, track]:
                    is_gone = draws[track, row - 1] < 0.0
                    chance = 1.0 - model.leaves if is_gone else model.leaves * share / (1.0 - share)
                if draws[track, row] < chance:
                    draws[track, row] = -1.0
            visible = visible and draws[track, row] >= 0.0
        if moves:
            dx, dy = x - ego[0], y - ego[1]
            x, y = believed[0] + cos * dx - sin * dy, believed[1] + sin * dx + cos * dy
            heading = wrap_angle(heading + turn)
            vx, vy = cos * vx - sin * vy, sin * vx + cos * vy
        visible = visible and distance <= model.range and begin <= row < end
        seen.valid[row, column] = visible
        if visible:
            pose, velocity = seen.poses[row, column], seen.velocities[row, column]
            pose[0], pose[1], pose[2] = x, y, heading
            velocity[0], velocity[1] = vx, vy
            seen.sizes[row, column, 0], seen.sizes[row, column, 1] = length, width


class Sensing:
    """What is seen of the rows of a rollout; `see` fills the arrays."""

    def __init__(
        self, drift: Drift, seed: int, token: str, truth: tuple[FloatArray, Tracks]
    ) -> None:
        """Draw all errors; the truth, ego (R, 11) and tracks over R rows, is there row by row."""
        self._ego, self._tracks = truth
        self._rows, self._key = 0, (seed, token)
        model, place, rows = drift.perception, drift.localization, len(self._ego)
        tokens, kinds = self._tracks.tokens, self._tracks.kinds
        begins = self._draw("dropout", model.lost) < model.lost * DT
        spans = _spans(begins, max(round(model.lost_for / DT), 1), len(tokens))
        table = np.array([span[1:] for span in spans], np.int64).reshape(-1, 3)
        drawn = _Model(
            keeps=exp(-DT / model.tau),
            missed=model.missed,
            leaves=DT / model.gap,
            range=model.range,
            sigmas=model.sigmas,
            errors=self._draw("boxes", float(model.sigmas.max()), 6),
            draws=self._draw("miss", model.missed),
            spans=table,
        )
        self._shift: FloatArray | None = None
        if place.acts:
            normals = keyed_generator(seed, token, "localization").standard_normal((rows, 3))
            sigmas = (place.position, place.position, place.heading)
            self._shift = ar1(normals, place.tau) * sigmas
        self.ego = self._ego if self._shift is None else np.full(self._ego.shape, np.nan)
        names = tuple(f"{tokens[at]}~{n}" if n else tokens[at] for n, at, *_ in spans)
        shape = (rows, len(spans))
        boxes = [np.full((*shape, width), np.nan) for width in (3, 2, 2)]
        arrays = TrackArrays._make([np.zeros(shape, np.bool_), *boxes])
        self.tracks = Tracks(*arrays, kinds[table[:, 0]], names)
        self._given = drawn, self._tracks.arrays, arrays

    def _draw(self, channel: str, share: float, *shape: int) -> FloatArray:
        """(N, R) uniform numbers, or (N, R, *shape) normals; (0, …) where the share is 0.

        Those of a track come from its `keyed_generator`, without making each of them.
        """
        tokens = self._tracks.tokens if share else ()
        out = np.empty((len(tokens), len(self._ego), *shape))
        generator = keyed_generator(*self._key, channel)
        draw: Any = generator.standard_normal if shape else generator.random
        state: Any = generator.bit_generator.state
        for number, track in enumerate(tokens):
            key = channel_key(*self._key, f"{channel}\n{track}")
            state["state"]["key"] = np.frombuffer(key, "<u8")
            generator.bit_generator.state = state
            draw(out=out[number])
        return out

    def see(self, row: int) -> None:
        """Make what is seen of the rows up to one, whose truth is there."""
        for one in range(self._rows, row + 1):
            pose = believed = self._ego[one, :3]
            if self._shift is not None:
                self.ego[one] = self._ego[one]
                believed = self.ego[one, :3]
                believed += self._shift[one]
                believed[HEADING] = wrap_angles(believed[HEADING])
            see_boxes(one, pose, believed, *self._given)
        self._rows = max(self._rows, row + 1)

    def to_truth(self, plan: Plan, row: int) -> Plan:
        """A plan that was made in a row, moved from where the ego seemed to be to where it is."""
        if self._shift is None or isinstance(plan, Command):
            return plan
        states = plan.states.copy()
        here, there = self.ego[row, :3], self._ego[row, :3]
        states[:, :3] = from_frame(to_frame(states[:, :3], here), there)
        return Trajectory(plan.time_us, states)

    def seen(self, rows: slice) -> Seen:
        """What was seen of some rows."""
        return Seen(self.ego[rows, :3], self.tracks.rows(rows))


def _spans(begins: BoolArray, length: int, count: int) -> list[tuple[int, ...]]:
    """Rows in which tracks, lost for some where a drop-out begins (N or 0, R), have one token.

    Of each the drop-outs before, the track, the first row, and the row behind the last.
    """
    found = list[tuple[int, ...]]()
    for track in range(count):
        begin = number = 0
        for row in np.flatnonzero(begins[track : track + 1]).tolist():
            if row >= begin:  # not lost already
                found.append((number, track, begin, row))
                begin, number = row + length, number + 1
        found.append((number, track, begin, begins.shape[1]))
    return sorted(found, key=lambda span: (span[0] > 0, span[1], span[0]))


def ar1(normals: FloatArray, tau: float) -> FloatArray:
    """Stationary AR(1) process (R, ...) of deviation 1 and time `tau` [s], in place of normals."""
    keeps = exp(-DT / tau)
    normals[1:] *= sqrt(1.0 - keeps * keeps)
    for row in range(1, len(normals)):
        normals[row] += keeps * normals[row - 1]
    return normals


def first_plans(milliseconds: int, past: FloatArray, now_us: int) -> deque[Plan]:
    """Those under way at first: keep speed and curvature of the past (H, 11), the present last."""
    steps = milliseconds // DT_MS
    pose, before = past[-1, :3], past[max(len(past) - 6, 0), :3]
    driven = float(np.hypot(*(pose - before)[:2]))
    turn = float(wrap_angles(pose[2:] - before[2])[0])
    curvature = turn / driven if driven > _CURVED else 0.0
    times, step = DT * np.arange(steps + _COAST), DT * past[-1, VX]
    heading = pose[2] + curvature * step * np.arange(len(times))
    middle = heading[:-1] + 0.5 * curvature * step
    x, y = (np.append(0.0, np.cumsum(step * of(middle))) for of in (np.cos, np.sin))
    poses = np.column_stack([pose[0] + x, pose[1] + y, heading])
    return deque[Plan]([Trajectory.from_poses(times, poses).starting_at(now_us)] * steps)


def exchange(waiting: deque[Plan], plan: Plan, next_us: int) -> Plan:
    """The plan that is followed until `next_us`, as this one is made; it goes on as it ends."""
    waiting.append(plan)
    plan = waiting.popleft()
    if isinstance(plan, Command) or plan.time_us[-1] >= next_us:
        return plan
    states, (before, last) = plan.states, plan.time_us[-2:].tolist()
    end = states[-1].copy()
    end[:2] += (states[-1, :2] - states[-2, :2]) * (next_us - last) / (last - before)
    return Trajectory(np.append(plan.time_us, next_us), np.vstack([states, end]))
