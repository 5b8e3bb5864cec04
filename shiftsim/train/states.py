"""Labelled states: what one holds, a folder per round on disk, and how often each is drawn."""

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.planners.learned.carl.planner import MAX_STEERING
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.planners.learned.carl.view import CHANNELS, SIZE
from shiftsim.world.state import PACIFICA

_PICTURES, _NUMBERS = "pictures.bin", "states.npz"
_COLUMNS = ("measurements", "actions", "urgent")  # of a `State`, behind the picture
_SHAPE = (len(CHANNELS), SIZE, SIZE)
_CODEC = pa.Codec("zstd", 3)  # most pixels are empty: a raster takes some kilobytes
_AX, _STEERING, _YAW_ACCEL = 4, 6, 9  # of the measurements
BRAKING, HARD, TURNING, DISTURBED = -0.25, -0.6, 0.1, 0.03  # actions that count as such
URGENT = 3.0  # how much more often a state before an infraction is drawn
MIRRORED_ACTION = np.array([1, -1], np.float32)  # signs in the mirror
_MIRRORED = np.array([1, -1, 1, -1, 1, -1, -1, -1, -1, -1], np.float32)

Values = NDArray[np.float32]


class State(NamedTuple):
    """A labelled state."""

    picture: bytes  # a compressed raster
    measurements: Values  # (10,) of `CarlFeatures`
    action: Values  # (2,) what the expert would do
    is_urgent: bool = False  # whether the network ended with an infraction soon after


def compress_raster(raster: Raster) -> bytes:
    """A raster (9, 256, 256) in few bytes."""
    content: bytes = _CODEC.compress(np.ascontiguousarray(raster), asbytes=True)
    return content


def read_raster(content: Any) -> Raster:
    """The read-only raster (9, 256, 256) of `compress_raster`."""
    return np.frombuffer(_CODEC.decompress(content, int(np.prod(_SHAPE))), np.uint8).reshape(_SHAPE)


def mirror_measurements(measurements: Values) -> Values:
    """(…, 10) measurements in the mirror; the acceleration of the centre holds that of the yaw."""
    out = measurements * _MIRRORED
    turning = PACIFICA.rear_axle_to_center * measurements[..., _YAW_ACCEL]
    out[..., _AX] -= np.float32(2.0) * turning.astype(np.float32)
    return out


def write_part(folder: Path, states: Iterable[State]) -> None:
    """Write the states of one round: pictures one after the other, and where each ends."""
    partial = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    ends, rows = [0], []
    with (partial / _PICTURES).open("wb") as file:
        for picture, *row in states:
            ends.append(ends[-1] + file.write(picture))
            rows.append(row)
    columns = zip(_COLUMNS, zip(*rows, strict=True), strict=True)
    numbers: dict[str, Any] = {name: np.array(column) for name, column in columns}
    np.savez(partial / _NUMBERS, ends=np.array(ends), **numbers)
    partial.rename(folder)


class States:
    """The states of all rounds so far, N: `measurements` (N, 10) and labels `actions` (N, 2)."""

    def __init__(self, folders: Sequence[Path]) -> None:
        """`folders` are those of `write_part`; pictures are mapped from there."""
        parts = []
        for folder in folders:
            with np.load(folder / _NUMBERS) as stored:
                parts.append([stored[name] for name in ("ends", *_COLUMNS)])
        self._pictures = [np.memmap(folder / _PICTURES, np.uint8, "r") for folder in folders]
        self._ends, *numbers = zip(*parts, strict=True)
        self._first = np.cumsum([0, *(len(ends) - 1 for ends in self._ends)])
        self.measurements, self.actions, urgent = (np.concatenate(x) for x in numbers)
        weights = importance(self.measurements, self.actions, urgent)
        self._total = np.cumsum(weights / weights.sum())

    def __len__(self) -> int:
        return len(self.actions)

    def draw(self, count: int, random: np.random.Generator) -> IntArray:
        """(count,) states at random, the rare ones more often."""
        drawn: IntArray = np.searchsorted(self._total, random.random(count))
        return np.minimum(drawn, len(self) - 1)

    def rasters(self, indices: IntArray, mirrored: Sequence[bool]) -> NDArray[np.uint8]:
        """(B, 9, 256, 256) the rasters of some states; rows are left and right."""
        out = np.empty((len(indices), *_SHAPE), np.uint8)
        for place, (index, is_mirrored) in enumerate(zip(indices.tolist(), mirrored, strict=True)):
            number = int(np.searchsorted(self._first, index, side="right")) - 1
            begin, end = self._ends[number][index - int(self._first[number]) :][:2]
            raster = read_raster(self._pictures[number][begin:end])
            out[place] = raster[:, ::-1] if is_mirrored else raster
        return out


def importance(measurements: Values, actions: Values, urgent: BoolArray) -> FloatArray:
    """(N,) how often a state is drawn: braking, turning, correcting, and braking too late most."""
    steering = measurements[:, _STEERING] / MAX_STEERING
    weights = np.ones(len(actions))
    weights += actions[:, 0] < BRAKING
    weights += actions[:, 0] < HARD
    weights += URGENT * urgent
    weights += np.abs(actions[:, 1]) > TURNING
    weights += np.abs(actions[:, 1] - steering) > DISTURBED
    return weights
