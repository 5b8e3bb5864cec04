"""States of agents with labels: as recorded, pushed aside, or where the network brought them.

A label is what leads an agent back to its recorded drive, wherever its own has brought it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import BoolArray, FloatArray, kernel
from shiftsim.sim.planner import rollout_rows
from shiftsim.sim.traffic.learned.features import AHEAD, NUM_FEATURES, PATH, REACH
from shiftsim.sim.traffic.learned.model import LAG, LearnedTraffic
from shiftsim.sim.traffic.learned.network import LIMITS
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
    found = list((_driven if drives else _recorded)(scenario, traffic, random))
    return join(found)


def join(parts: list[States]) -> States:
    """Several as one."""
    if not parts:
        return States(np.zeros((0, NUM_FEATURES), np.float32), np.zeros((0, 3), np.float32))
    return States(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _recorded(
    scenario: Scenario, traffic: LearnedTraffic, random: np.random.Generator
) -> Iterator[States]:
    rows, start = rollout_rows(scenario)
    recorded = scenario.tracks.rows(rows)
    for iteration in range(int(random.integers(EVERY)), scenario.num_iterations - 1, EVERY):
        tracks, row = recorded.copy(), start + iteration
        if random.random() < 0.5:
            _push(tracks, row, random)
        traffic.start(scenario, tracks, start)
        yield _labelled(scenario, traffic, recorded, tracks, iteration, row, random)


def _driven(
    scenario: Scenario, traffic: LearnedTraffic, random: np.random.Generator
) -> Iterator[States]:
    rows, start = rollout_rows(scenario)
    recorded = scenario.tracks.rows(rows)
    begin = int(random.integers(max(scenario.num_iterations - SEGMENT - 1, 1)))
    ego = scenario.ego[scenario.iteration_rows]
    while begin < scenario.num_iterations - 1:
        tracks = recorded.copy()
        traffic.start(scenario, tracks, start)
        for iteration in range(begin, min(begin + SEGMENT, scenario.num_iterations - 1)):
            row = start + iteration
            if (iteration - begin) % EVERY == EVERY - 1:
                yield _labelled(scenario, traffic, recorded, tracks, iteration, row, random)
            traffic.step(iteration, ego[iteration], tracks, row + 1)
        begin += SEGMENT


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


def _labelled(
    scenario: Scenario,
    traffic: LearnedTraffic,
    recorded: Tracks,
    tracks: Tracks,
    iteration: int,
    row: int,
    random: np.random.Generator,
) -> States:
    """The agents of one row with their labels."""
    ego = scenario.ego[scenario.iteration_rows[iteration]]
    features, own = traffic.observe(iteration, ego, tracks, row), traffic.own
    speeds = features[:, 0] * 10.0
    gap = (1.0 - features[:, _LEADER + 1]) * REACH
    closing = np.stack(
        [np.where(features[:, _LEADER] > 0.0, gap, np.inf), features[:, _LEADER + 2] * 5.0], axis=1
    )
    closing[features[:, _LEADER] == 0.0, 1] = 0.0
    poses = tracks.poses[row, own]
    labels = compute_labels(recorded.select(own), row, poses, speeds, closing)
    rests = (np.abs(speeds) < 0.2) & (np.abs(labels.accelerations) < 0.1)
    chosen = labels.known & (~rests | (random.random(len(own)) < STANDING))
    values = np.stack([labels.accelerations, labels.curvatures, labels.distances], axis=1)
    return States(features[chosen].astype(np.float32), values[chosen].astype(np.float32))


class Labels(NamedTuple):
    """Wanted controls of agents. A agents."""

    known: BoolArray  # (A,) whether there is a label
    accelerations: FloatArray  # (A,) [m/s^2]
    curvatures: FloatArray  # (A,) [rad/m]
    distances: FloatArray  # (A,) to the point that is steered to [m]; 0 where the agent stays


def compute_labels(
    recorded: Tracks, row: int, poses: FloatArray, speeds: FloatArray, closing: FloatArray
) -> Labels:
    """Labels at a row of the tracks as recorded, of agents that are elsewhere by now.

    Args:
        recorded: (B, A, …) the agents as recorded.
        row: The row that is now.
        poses: (A, 3) where they are [m], [rad]; NaN where absent.
        speeds: (A,) [m/s].
        closing: (A, 2) gap to who leads [m] and speed at which it shrinks [m/s]; inf and 0.
    """
    known = np.zeros(len(poses), np.bool_)
    out = np.zeros((len(poses), 3))
    _label(recorded.valid, recorded.poses, row, poses, speeds, known, out)
    need = np.where(
        closing[:, 1] > 0.0, closing[:, 1] ** 2 / (2.0 * np.maximum(closing[:, 0] - 1.0, 0.2)), 0.0
    )
    out[:, 0] = np.where(need > FIRM, np.minimum(out[:, 0], -need), out[:, 0])
    out[:, :2] = np.clip(out[:, :2], LIMITS[:, 0], LIMITS[:, 1])
    return Labels(known, *out.T)


@kernel
def _label(
    valid: BoolArray,
    recorded: FloatArray,
    row: int,
    poses: FloatArray,
    speeds: FloatArray,
    known: BoolArray,
    out: FloatArray,
) -> None:
    """Write the labels (A, 3); arguments as in `labels_of`."""
    for agent in range(len(poses)):
        last = row
        while last + 1 < len(valid) and valid[last + 1, agent]:
            last += 1
        x, y, heading = poses[agent]
        if np.isnan(x) or not valid[row, agent] or last - row < LEAST:
            continue
        # the recorded way: where the agent stands on it now, and where it should be
        first = row
        while first > 0 and row - first < 2 * HORIZON and valid[first - 1, agent]:
            first -= 1
        best, here, length = np.inf, 0.0, 0.0
        wanted_row = min(row + HORIZON, last)
        wanted = 0.0
        for knot in range(first, last):
            ax, ay = recorded[knot, agent, 0], recorded[knot, agent, 1]
            dx, dy = recorded[knot + 1, agent, 0] - ax, recorded[knot + 1, agent, 1] - ay
            square = dx * dx + dy * dy
            share = 0.0
            if square > 0.0:
                share = min(max(((x - ax) * dx + (y - ay) * dy) / square, 0.0), 1.0)
            apart = (x - ax - share * dx) ** 2 + (y - ay - share * dy) ** 2
            if apart < best:
                best, here = apart, length + share * np.sqrt(square)
            length += np.sqrt(square)
            if knot + 1 == wanted_row:
                wanted = length
        span = (wanted_row - row) * _STEP
        known[agent] = True
        speed = speeds[agent]
        out[agent, 0] = 2.0 * (wanted - here - speed * span) / (span * span)
        if out[agent, 0] < 0.0:  # do not brake beyond standing
            out[agent, 0] = max(out[agent, 0], -speed / 0.5)
        ahead = max(LOOK_AHEAD * speed, NEAREST)
        goal, passed = min(here + ahead, length), 0.0
        if goal - here < 1.0:
            continue
        for knot in range(first, last):
            ax, ay = recorded[knot, agent, 0], recorded[knot, agent, 1]
            dx, dy = recorded[knot + 1, agent, 0] - ax, recorded[knot + 1, agent, 1] - ay
            size = np.sqrt(dx * dx + dy * dy)
            if passed + size >= goal and size > 0.0:
                share = (goal - passed) / size
                px, py = ax + share * dx - x, ay + share * dy - y
                distance = max(np.hypot(px, py), 0.5)
                angle = wrap_angle(np.arctan2(py, px) - heading)
                out[agent, 1] = 2.0 * np.sin(angle) / distance
                out[agent, 2] = distance
                break
            passed += size
