"""The network of learned traffic: three layers, which say how hard to accelerate and to turn."""

import hashlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.errors import CheckpointError
from shiftsim.kernels import FloatArray
from shiftsim.sim.traffic.learned.features import NUM_FEATURES

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
