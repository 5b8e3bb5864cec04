"""States of agents with labels: as recorded, pushed aside, or where the network brought them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.sim.planner import rollout_rows
from shiftsim.sim.traffic.learned.features import AHEAD, NUM_FEATURES, PATH, REACH
from shiftsim.sim.traffic.learned.model import LAG, LearnedTraffic
from shiftsim.train.traffic.labels import labels_of
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

EVERY = 5  # iterations between two states of an agent
SEGMENT = 50  # iterations that the network drives before the agents are put back
ASIDE, TURNED, FASTER = 0.4, 0.05, 0.8  # m, rad, m/s: spread of what agents are pushed by
STANDING = 0.05  # share of the agents that stand and stay that is kept
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
    labels = labels_of(recorded.select(own), row, poses, speeds, closing)
    rests = (np.abs(speeds) < 0.2) & (np.abs(labels.accelerations) < 0.1)
    kept = labels.known & (~rests | (random.random(len(own)) < STANDING))
    values = np.stack([labels.accelerations, labels.curvatures, labels.distances], axis=1)
    return States(features[kept].astype(np.float32), values[kept].astype(np.float32))
