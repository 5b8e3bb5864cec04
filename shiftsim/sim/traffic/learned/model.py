"""Learned traffic: a small network says how vehicles, bicycles and pedestrians go on.

All agents of a step are answered at once. The network imitates recorded agents; what it was trained
on is in docs/traffic_weights.md.
"""

import hashlib
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.errors import CheckpointError, ConfigError
from shiftsim.geometry.boxes import wrap_angles
from shiftsim.kernels import FloatArray, IntArray
from shiftsim.sim.traffic import Move
from shiftsim.sim.traffic.lanes import NO_LANE, RED, Lanes, lanes_of, light_flags
from shiftsim.sim.traffic.learned.features import NUM_FEATURES, Motion, move_agents, observe_agents
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    PACIFICA,
    AgentKind,
    Tracks,
    center_poses,
    map_velocity,
)

HIDDEN = 96
WEIGHTS = Path(__file__).parent / "weights.npz"
SCALES = np.array([2.0, 0.3])  # m/s^2, rad/m: what an output of 1 means
LIMITS = np.array([[-8.0, 4.0], [-0.3, 0.3]])  # m/s^2, rad/m
SHAPES = {
    "first": (NUM_FEATURES, HIDDEN),
    "first_bias": (HIDDEN,),
    "second": (HIDDEN, HIDDEN),
    "second_bias": (HIDDEN,),
    "last": (HIDDEN, 2),
    "last_bias": (2,),
}

Single = NDArray[np.float32]


class Weights(NamedTuple):
    """Arrays of the network, shapes as in `SHAPES`."""

    first: Single
    first_bias: Single
    second: Single
    second_bias: Single
    last: Single
    last_bias: Single


def load_weights(path: str | Path = WEIGHTS) -> Weights:
    """Weights from an `.npz`.

    Raises:
        CheckpointError: The file is missing, or does not hold the arrays of this network.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name].astype(np.float32) for name in SHAPES}
    except (OSError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{path}: no weights of learned traffic: {error}",
            hint="make them with `shiftsim train traffic`",
        ) from error
    for name, shape in SHAPES.items():
        if arrays[name].shape != shape:
            found = f"array {name!r} has shape {arrays[name].shape}, not {shape}"
            raise CheckpointError(
                f"{path}: {found}", hint="make them with this version's `shiftsim train traffic`"
            )
    return Weights(**arrays)


def digest(weights: Weights) -> str:
    """SHA-256 of the numbers."""
    return hashlib.sha256(b"".join(array.tobytes() for array in weights)).hexdigest()


def controls(weights: Weights, features: FloatArray, speeds: FloatArray) -> FloatArray:
    """(A, 2) acceleration [m/s^2] and yaw rate [rad/s] of agents with features (A, F)."""
    hidden = np.maximum(features.astype(np.float32) @ weights.first + weights.first_bias, 0.0)
    hidden = np.maximum(hidden @ weights.second + weights.second_bias, 0.0)
    out = (hidden @ weights.last + weights.last_bias).astype(np.float64) * SCALES
    out = np.clip(out, LIMITS[:, 0], LIMITS[:, 1])
    out[:, 1] *= speeds
    return out


LAG = 3  # rows over which accelerations and turns are measured
_EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


class LearnedTraffic:
    """Vehicles, bicycles and pedestrians move as a network says; static objects are replayed.

    A track that the recording brings in later begins as recorded, and nobody leaves.
    """

    def __init__(self, weights: str | Path = WEIGHTS) -> None:
        """Traffic with the weights that come with shiftsim, or with those of a file."""
        self._weights = load_weights(weights)
        self.fingerprint = {"weights": digest(self._weights)}  # goes into what identifies a run
        self._lanes: Lanes | None = None

    def fork(self) -> "LearnedTraffic":
        """Traffic with the same weights, for one more rollout."""
        return copy(self)

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Note who moves: the tracks `own` (all by default), static objects apart."""
        moves = tracks.kinds <= LAST_AGENT_KIND
        if own is not None:
            moves = moves & np.isin(np.arange(tracks.num_tracks), own)
        self.own = np.flatnonzero(moves)
        self._lanes = lanes_of(scenario.map)
        self._followed = np.full(len(self.own), NO_LANE, np.int64)
        self._features = np.zeros((len(self.own), NUM_FEATURES))
        self._moved = np.zeros((len(self.own), 4))
        self._spans = np.diff(scenario.iteration_times) * 1e-6
        self._light_edges, lights = light_flags(scenario)
        self._red = (lights & RED) != 0
        self._kinds = np.append(tracks.kinds, AgentKind.VEHICLE)

    def observe(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> FloatArray:
        """(A, F) features of the agents at an iteration, whose row is `row`; zeros where absent.

        The array is written again by the next call.
        """
        if self._lanes is None:
            raise ConfigError("traffic was stepped before it was started", hint="call start first")
        self._motion = self._seen(iteration, ego, tracks, row)
        self._lanes.is_red[self._light_edges] = self._red[iteration]
        observe_agents(self._lanes, self._motion, self.own, self._followed, self._features)
        return self._features

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move everyone who was there a step ago."""
        self.step_batch([self], [Move(iteration, ego, tracks, row)])

    def step_batch(self, models: "Sequence[LearnedTraffic]", moves: Sequence[Move]) -> None:
        """The same for forks in several rollouts, with one forward pass."""
        pairs = list(zip(models, moves, strict=True))
        features = [
            model.observe(move.iteration, move.ego, move.tracks, move.row - 1)
            for model, move in pairs
        ]
        speeds = [model._motion.speeds[model.own] for model in models]
        out = controls(self._weights, np.concatenate(features), np.concatenate(speeds))
        ends = np.cumsum([len(model.own) for model in models])
        for (model, move), part in zip(pairs, np.split(out, ends[:-1]), strict=True):
            model._write(move, part)

    def _write(self, move: Move, out: FloatArray) -> None:
        """Move the agents by their controls (A, 2)."""
        iteration, _, tracks, row = move
        motion, own = self._motion, self.own
        move_agents(motion, own, out, self._spans[iteration], self._moved)
        there = motion.present[own]
        who, moved = own[there], self._moved[there]
        x, y = moved[:, 3] * np.cos(moved[:, 2]), moved[:, 3] * np.sin(moved[:, 2])
        sizes = tracks.sizes[row - 1, who]
        tracks.put(row, who, moved[:, :3], np.column_stack([x, y]), sizes)

    def _seen(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> Motion:
        """Everyone at a row, the ego last."""
        before = max(row - LAG, 0)
        poses = np.concatenate([tracks.poses[row], center_poses(ego[None, :3])])
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        velocities = np.nan_to_num(np.concatenate([tracks.velocities[row], [map_velocity(ego)]]))
        speeds = velocities[:, 0] * cos + velocities[:, 1] * sin
        old = np.nan_to_num(tracks.velocities[before])
        heading = tracks.poses[before, :, 2]
        span = max((row - before) * self._spans[iteration], 1e-3)
        was_there = np.append(tracks.valid[before] & tracks.valid[row], False)
        change, turn = np.zeros(len(poses)), np.zeros(len(poses))
        change[:-1] = (
            speeds[:-1] - old[:, 0] * np.cos(heading) - old[:, 1] * np.sin(heading)
        ) / span
        turn[:-1] = wrap_angles(poses[:-1, 2] - heading) / span
        return Motion(
            present=np.append(tracks.valid[row], True),
            poses=poses,
            speeds=speeds,
            accelerations=np.where(was_there, change, 0.0),
            turns=np.where(was_there, turn, 0.0),
            velocities=velocities,
            sizes=np.concatenate([tracks.sizes[row], _EGO_SIZE[None]]),
            kinds=self._kinds,
        )
