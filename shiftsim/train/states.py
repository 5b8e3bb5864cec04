"""Labelled states on disk: a folder per round, whole or not there."""

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.planners.learned.carl.planner import MAX_STEERING
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.train.driving import State
from shiftsim.train.pictures import unpacked

_PICTURES, _NUMBERS = "pictures.bin", "states.npz"
_STEERING = 6  # of the measurements
BRAKING, HARD, TURNING, DISTURBED = -0.25, -0.6, 0.1, 0.03  # actions that count as such
URGENT = 3.0  # how much more often a state before an infraction is drawn

Values = NDArray[np.float32]


class Part(NamedTuple):
    """The states of one round. N states."""

    pictures: NDArray[np.uint8]  # one after the other, mapped from disk
    ends: IntArray  # (N + 1,) where each begins and the last one ends
    measurements: Values  # (N, 10)
    actions: Values  # (N, 2) labels
    urgent: BoolArray  # (N,) whether the network ended with an infraction soon after


def write_part(folder: Path, states: Iterable[State]) -> None:
    """Write the states of one round."""
    partial = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    ends, measurements, actions, urgent = [0], [], [], []
    with (partial / _PICTURES).open("wb") as file:
        for state in states:
            ends.append(ends[-1] + file.write(state.picture))
            measurements.append(state.measurements)
            actions.append(state.action)
            urgent.append(state.is_urgent)
    np.savez(
        partial / _NUMBERS,
        ends=np.array(ends),
        measurements=np.stack(measurements),
        actions=np.stack(actions),
        urgent=np.array(urgent),
    )
    partial.rename(folder)


def read_part(folder: Path) -> Part:
    """The states of one round."""
    pictures = np.memmap(folder / _PICTURES, np.uint8, "r")
    with np.load(folder / _NUMBERS) as numbers:
        names = ("ends", "measurements", "actions", "urgent")
        return Part(pictures, *(numbers[name] for name in names))


class States:
    """The states of all rounds so far."""

    def __init__(self, parts: Iterable[Part]) -> None:
        self._parts = list(parts)
        sizes = [len(part.actions) for part in self._parts]
        self._first = np.concatenate([[0], np.cumsum(sizes)])
        self.measurements = np.concatenate([part.measurements for part in self._parts])
        self.actions = np.concatenate([part.actions for part in self._parts])
        urgent = np.concatenate([part.urgent for part in self._parts])
        weights = importance(self.measurements, self.actions, urgent)
        self._total = np.cumsum(weights / weights.sum())

    def __len__(self) -> int:
        return len(self.actions)

    def draw(self, count: int, random: np.random.Generator) -> IntArray:
        """(count,) states at random, the rare ones more often."""
        drawn: IntArray = np.searchsorted(self._total, random.random(count))
        return np.minimum(drawn, len(self) - 1)

    def picture(self, index: int) -> Raster:
        """The raster of a state."""
        which = int(np.searchsorted(self._first, index, side="right")) - 1
        part, row = self._parts[which], index - int(self._first[which])
        return unpacked(part.pictures[part.ends[row] : part.ends[row + 1]])


def importance(measurements: Values, actions: Values, urgent: BoolArray) -> FloatArray:
    """(N,) how often a state is drawn, in relation: braking, turning and correcting more.

    Most of all where the network did not brake in time.
    """
    steering = measurements[:, _STEERING] / MAX_STEERING
    weights = np.ones(len(actions))
    weights += actions[:, 0] < BRAKING
    weights += actions[:, 0] < HARD
    weights += URGENT * urgent
    weights += np.abs(actions[:, 1]) > TURNING
    weights += np.abs(actions[:, 1] - steering) > DISTURBED
    return weights
