"""States of agents with labels: as recorded, pushed aside, or where the network brought them.

A label is what leads an agent back to its recorded drive, wherever its own has brought it.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import arc_lengths, point_on_polyline, project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray
from shiftsim.sim.planner import rollout_rows
from shiftsim.sim.traffic.learned.features import AHEAD, NUM_FEATURES, PATH, REACH
from shiftsim.sim.traffic.learned.model import LAG, LIMITS, LearnedTraffic
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

EVERY = 5  # iterations between two states of an agent
SEGMENT = 50  # iterations that the network drives before the agents are put back
ASIDE, TURNED, FASTER = 0.4, 0.05, 0.8  # m, rad, m/s: spread of what agents are pushed by
STANDING = 0.05  # share of the agents that stand and stay that is kept
HORIZON = 15  # iterations: when an agent should be where it was recorded
LEAST = 5  # iterations that must be recorded for a label
LOOK_AHEAD, NEAREST = 1.0, 3.0  # s and m, whichever is farther: the point that is steered to
FIRM = 1.5  # m/s^2 of braking that another in the way asks for before it counts
_STEP = 0.1  # s
_LEADER = PATH + 2 * len(AHEAD)


class States(NamedTuple):
    """What agents saw, and what they should have done. S states."""

    features: NDArray[np.float32]  # (S, F)
    labels: NDArray[np.float32]  # (S, 3) acceleration, curvature, distance steered to


def states_of(
    scenario: Scenario, traffic: LearnedTraffic, random: np.random.Generator, *, drives: bool
) -> States:
    """States of one scenario: recorded and pushed aside, or, if it `drives`, of the network."""
    rows, start = rollout_rows(scenario)
    recorded, ego = scenario.tracks.rows(rows), scenario.ego[scenario.iteration_rows]
    last = scenario.num_iterations - 1

    def pushed() -> Iterator[tuple[int, Tracks]]:
        for iteration in range(int(random.integers(EVERY)), last, EVERY):
            tracks = recorded.copy()
            if random.random() < 0.5:
                _push(tracks, start + iteration, random)
            traffic.start(scenario, tracks, start)
            yield iteration, tracks

    def driven() -> Iterator[tuple[int, Tracks]]:
        first = int(random.integers(max(last - SEGMENT, 1)))
        for begin in range(first, last, SEGMENT):
            tracks = recorded.copy()
            traffic.start(scenario, tracks, start)
            for iteration in range(begin, min(begin + SEGMENT, last)):
                if (iteration - begin) % EVERY == EVERY - 1:
                    yield iteration, tracks
                traffic.step(iteration, ego[iteration], tracks, start + iteration + 1)

    parts = []
    for iteration, tracks in driven() if drives else pushed():
        row = start + iteration
        features = traffic.observe(iteration, ego[iteration], tracks, row)
        own, speeds = traffic.own, features[:, 0] * 10.0
        gap = (1.0 - features[:, _LEADER + 1]) * REACH
        leads = features[:, _LEADER] > 0.0
        shrinking = np.where(leads, features[:, _LEADER + 2] * 5.0, 0.0)
        closing = np.column_stack([np.where(leads, gap, np.inf), shrinking])
        poses = tracks.poses[row, own]
        labels = compute_labels(recorded.select(own), row, poses, speeds, closing)
        rests = (np.abs(speeds) < 0.2) & (np.abs(labels[:, 0]) < 0.1)
        chosen = ~np.isnan(labels[:, 0]) & (~rests | (random.random(len(own)) < STANDING))
        parts.append(States(*(x[chosen].astype(np.float32) for x in (features, labels))))
    return join(parts)


def join(parts: list[States]) -> States:
    """Several as one."""
    none = States(np.zeros((0, NUM_FEATURES), np.float32), np.zeros((0, 3), np.float32))
    return States(*(np.concatenate(arrays) for arrays in zip(none, *parts, strict=True)))


def _push(tracks: Tracks, row: int, random: np.random.Generator) -> None:
    """Push everyone aside, now and a little before."""
    count = tracks.num_tracks
    aside, turned = random.normal(0.0, ASIDE, count), random.normal(0.0, TURNED, count)
    faster = random.normal(0.0, FASTER, count)
    speeds = np.hypot(*np.nan_to_num(tracks.velocities[row]).T)
    faster = np.where(speeds < 0.3, 0.0, np.maximum(faster, -speeds))
    for at in {row, max(row - LAG, 0)}:
        heading = tracks.poses[at, :, 2].copy()
        tracks.poses[at, :, 0] -= aside * np.sin(heading)
        tracks.poses[at, :, 1] += aside * np.cos(heading)
        tracks.poses[at, :, 2] += turned
        tracks.velocities[at, :, 0] += faster * np.cos(heading)
        tracks.velocities[at, :, 1] += faster * np.sin(heading)


def compute_labels(
    recorded: Tracks, row: int, poses: FloatArray, speeds: FloatArray, closing: FloatArray
) -> FloatArray:
    """(A, 3) labels at a row of agents as recorded, which are at `poses` (A, 3) by now.

    They are an acceleration [m/s^2], a curvature [rad/m] and the distance to the point that is
    steered to [m], 0 where the agent stays; NaN where there is none. `closing` (A, 2) is the gap to
    who leads [m] and the speed at which it shrinks [m/s]; inf and 0.
    """
    out = np.full((len(poses), 3), np.nan)
    for agent in np.flatnonzero(recorded.valid[row] & ~np.isnan(poses[:, 0])).tolist():
        valid = recorded.valid[:, agent]
        last = _last_in_a_row(valid[row:]) + row
        first = row - _last_in_a_row(valid[row::-1][: 2 * HORIZON + 1])
        if last - row >= LEAST:
            line = np.ascontiguousarray(recorded.poses[first : last + 1, agent, :2])
            out[agent] = _label(line, row - first, poses[agent], float(speeds[agent]))
    need = np.where(
        closing[:, 1] > 0.0, closing[:, 1] ** 2 / (2.0 * np.maximum(closing[:, 0] - 1.0, 0.2)), 0.0
    )
    out[:, 0] = np.where(need > FIRM, np.minimum(out[:, 0], -need), out[:, 0])
    out[:, :2] = np.clip(out[:, :2], LIMITS[:, 0], LIMITS[:, 1])
    return out


def _last_in_a_row(valid: BoolArray) -> int:
    """Index of the last of the samples that are valid from the first one on."""
    return len(valid) - 1 if valid.all() else int(np.argmin(valid)) - 1


def _label(
    line: FloatArray, row: int, pose: FloatArray, speed: float
) -> tuple[float, float, float]:
    """A label of an agent at a pose that should be at a row of the positions `line` (V, 2)."""
    x, y, heading = pose.tolist()
    arc = arc_lengths(line, np.array([0, len(line)]))
    here = project_on_polyline(line, arc, 0, len(line), x, y)
    wanted_row = min(row + HORIZON, len(line) - 1)
    span = (wanted_row - row) * _STEP
    acceleration = 2.0 * (float(arc[wanted_row]) - here - speed * span) / (span * span)
    if acceleration < 0.0:  # do not brake beyond standing
        acceleration = max(acceleration, -speed / 0.5)
    goal = min(here + max(LOOK_AHEAD * speed, NEAREST), float(arc[-1]))
    if goal - here < 1.0:
        return acceleration, 0.0, 0.0
    px, py = point_on_polyline(line, arc, 0, len(line), goal)
    distance = max(math.hypot(px - x, py - y), 0.5)
    angle = wrap_angle(math.atan2(py - y, px - x) - heading)
    return acceleration, 2.0 * math.sin(angle) / distance, distance
