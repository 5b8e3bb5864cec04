"""Weights that anybody can make again from the names of a network's tensors.

They stand in for official checkpoints, which cannot be shipped, in tests and smoke runs. What a
network computes with them has no meaning; that it computes the same as the official code has.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shiftsim.kernels import FloatArray

State = dict[str, NDArray[Any]]

NUM_STEPS = 80  # poses of a trajectory head


def deterministic_state(
    state: Mapping[str, NDArray[Any]], rules: Mapping[str, str] | None = None
) -> State:
    """A copy of a network's state with every floating tensor replaced by keyed normal numbers.

    `rules` (`a` to `e`, or `keep`) are of tensors which the table of names does not fit.
    """
    out: State = {}
    for name, value in state.items():
        rule = (rules or {}).get(name) or rule_of(name, value.ndim)
        if rule == "keep" or value.dtype.kind != "f":
            out[name] = value.copy()
        else:
            out[name] = np.asarray(_value(rule, name, value.shape)).astype(value.dtype)
    return out


def network_weights(module: Any, variant: str) -> State:
    """Deterministic weights, `base` or `drive`, of the network of a planner's module."""
    built = {name: value.numpy() for name, value in module.build_network().state_dict().items()}
    state = deterministic_state(built, getattr(module, "RULES", None))
    if variant == "drive":
        for layer, head in getattr(module, "DRIVE_HEADS", {}).items():
            override_head(state, layer, head)
        for name, factor in getattr(module, "DRIVE_SCALES", {}).items():
            state[name] = (factor * state[name].astype(np.float64)).astype(state[name].dtype)
        if override := getattr(module, "drive_overrides", None):
            override(state)
    return state


def rule_of(name: str, ndim: int) -> str:
    """The letter of the rule by which a tensor is filled."""
    leaf = name.split(".")[-1]
    if leaf == "running_var":
        return "a"
    if leaf == "running_mean":
        return "b"
    if ndim >= 2:
        return "c"
    return "d" if ndim == 1 and leaf == "weight" else "e"


def keyed_normals(key: str, shape: tuple[int, ...]) -> FloatArray:
    """Standard normal numbers that depend on the key alone."""
    generator = np.random.Generator(np.random.PCG64(zlib.crc32(key.encode("utf-8"))))
    return generator.standard_normal(shape)


def _value(rule: str, name: str, shape: tuple[int, ...]) -> FloatArray:
    z = keyed_normals(name, shape)
    if rule == "a":
        return 1.0 + 0.1 * np.abs(z)
    if rule == "c":
        return z / np.sqrt(prod(shape[1:]))
    if rule == "d":
        return 1.0 + 0.02 * z
    return 0.02 * z


@dataclass(frozen=True, slots=True)
class DriveHead:
    """How the last layer of a trajectory head becomes a smooth ramp forward. C channels."""

    gain: tuple[float, ...]  # factors on the weights
    exponent: tuple[float, ...]  # powers of the time fraction
    const: tuple[float, ...]  # constant parts of the bias
    slope: tuple[float, ...]  # parts of the bias that grow with time


def override_head(state: State, layer: str, head: DriveHead) -> None:
    """Rewrite `<layer>.weight` and `<layer>.bias`, whose outputs are (80, C) in C order.

    With the fraction f = (t + 1) / 80: weight[t, c] = gain[c] f^exponent[c] base[79, c] and
    bias[t, c] = const[c] + slope[c] f^exponent[c].
    """
    weight, bias = state[f"{layer}.weight"], state[f"{layer}.bias"]
    last = weight.reshape(NUM_STEPS, len(head.gain), -1)[-1].astype(np.float64)
    fraction = (np.arange(NUM_STEPS, dtype=np.float64)[:, None] + 1.0) / NUM_STEPS
    ramp = fraction ** np.array(head.exponent)
    scaled = (np.array(head.gain) * ramp)[:, :, None] * last
    state[f"{layer}.weight"] = scaled.reshape(weight.shape).astype(weight.dtype)
    offsets = np.array(head.const) + np.array(head.slope) * ramp
    state[f"{layer}.bias"] = offsets.reshape(bias.shape).astype(bias.dtype)
