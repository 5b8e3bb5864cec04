"""CaRL's network as it is trained: the same function as `CarlNetwork`, computed fast.

The convolutions compute with channels last, and in bfloat16 where the processor can, which not all
do; the rest in single precision. Weights are laid out once per step (`lay_out`), and the parts of a
batch are computed with that.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from shiftsim.planners.learned.carl.network import (
    CONVOLUTIONS,
    LEAST,
    CarlNetwork,
    Policy,
)
from shiftsim.train.pictures import NUM_USED, Blocks
from shiftsim.world.state import PACIFICA

# a measurement of the network is divided by these: last action, velocity and acceleration of the
# centre [m/s, m/s^2], steering angle and rate [rad, rad/s], yaw rate and acceleration
UNITS = (1.0, 1.0, 5.0, 0.5, 1.0, 0.5, 0.1, 0.3, 0.2, 0.5)
MIRRORED_ACTION = np.array([1, -1], np.float32)  # signs in the mirror
_MIRRORED = np.array([1, -1, 1, -1, 1, -1, -1, -1, -1, -1], np.float32)
_AX, _YAW_ACCEL = 4, 9  # of the measurements
_CNN, _STATE = "features_extractor.cnn", "features_extractor.state_linear"
_HEADS = ("features_extractor.linear", _STATE, "policy_head")
_DRAWN = [0, 1, 2, 3, 5, 6, 7, 8]  # channels of `pictures.blocks_of`

Laid = dict[str, Tensor]
State = dict[str, Tensor]


def to_official(state: State) -> State:
    """A state as CaRL's network has it, which knows no units: its first layer takes them in."""
    name = f"{_STATE}.0.weight"
    return {**state, name: state[name] / torch.tensor(UNITS, device=state[name].device)}


def from_official(state: State) -> State:
    """The inverse of `to_official`."""
    name = f"{_STATE}.0.weight"
    return {**state, name: state[name] * torch.tensor(UNITS, device=state[name].device)}


def mirrored_measurements(measurements: NDArray[np.float32]) -> NDArray[np.float32]:
    """(…, 10) measurements of the ego in the mirror.

    The acceleration of the centre holds the yaw acceleration, with its sign.
    """
    out = measurements * _MIRRORED
    turning = PACIFICA.rear_axle_to_center * measurements[..., _YAW_ACCEL]
    out[..., _AX] -= np.float32(2.0) * turning.astype(np.float32)
    return out


def kind_on(device: str) -> torch.dtype:
    """What convolutions compute in: bfloat16 takes longer than floats where it is only imitated."""
    has_it = torch.cpu.get_capabilities().get("avx512_bf16", False)
    return torch.bfloat16 if has_it or device != "cpu" else torch.float32


def lay_out(network: CarlNetwork, *, critic: bool = False) -> Laid:
    """The weights of a network as `forward` wants them; gradients lead back to the network.

    Those of the critic are left out unless they are asked for.
    """
    weights: Laid = dict(network.named_parameters())
    laid: Laid = {}
    kind = kind_on(next(network.parameters()).device.type)
    for layer in range(len(CONVOLUTIONS)):
        conv, norm = f"{_CNN}.{3 * layer}", f"{_CNN}.{3 * layer + 1}"
        weight = weights[f"{conv}.weight"]
        if layer == 0:
            weight = _by_blocks(weight)
        laid[f"{conv}.weight"] = weight.to(kind).contiguous(memory_format=torch.channels_last)
        laid[f"{conv}.bias"] = weights[f"{conv}.bias"].to(kind)
        for part in ("weight", "bias"):
            turned = weights[f"{norm}.{part}"].permute(1, 2, 0)
            laid[f"{norm}.{part}"] = turned.to(kind).contiguous()
    for name, value in weights.items():
        if name not in laid and (critic or not name.startswith("value_head")):
            laid[name] = value
    return laid


def leaves(laid: Laid) -> Laid:
    """The same numbers, cut off from the network: gradients end here."""
    return {name: value.detach().requires_grad_() for name, value in laid.items()}


def _by_blocks(weight: Tensor) -> Tensor:
    """The first convolution (8, 9, 5, 5) as one of blocks, (8, 32, 3, 3)."""
    drawn = functional.pad(weight[:, _DRAWN], (0, 1, 0, 1))
    split = drawn.reshape(len(weight), NUM_USED, 3, 2, 3, 2)
    return split.permute(0, 3, 5, 1, 2, 4).reshape(len(weight), 4 * NUM_USED, 3, 3)


def tensor_of(blocks: Blocks, device: str = "cpu") -> Tensor:
    """(B, 32, 128, 128) of `pictures.blocks_of`, channels last."""
    bits = torch.from_numpy(blocks).to(device).view(torch.bfloat16)
    return bits.to(kind_on(bits.device.type)).permute(0, 3, 1, 2)


def see(laid: Laid, pictures: Tensor) -> Tensor:
    """(B, 1024) of pictures (B, 32, 128, 128) in blocks."""
    hidden = pictures
    for layer, (_, _, stride) in enumerate(CONVOLUTIONS):
        conv, norm = f"{_CNN}.{3 * layer}", f"{_CNN}.{3 * layer + 1}"
        step = 1 if layer == 0 else stride
        hidden = functional.conv2d(
            hidden, laid[f"{conv}.weight"], laid[f"{conv}.bias"], stride=step
        )
        turned = hidden.permute(0, 2, 3, 1)
        scale, shift = laid[f"{norm}.weight"], laid[f"{norm}.bias"]
        turned = functional.layer_norm(turned, turned.shape[1:], scale, shift)
        hidden = functional.relu(turned, inplace=True).permute(0, 3, 1, 2)
    return hidden.flatten(1).float()


def features_of(laid: Laid, pictures: Tensor, measurements: Tensor) -> Tensor:
    """(B, 256) of pictures in blocks and measurements (B, 10) in their units."""
    units = torch.tensor(UNITS, device=measurements.device)
    felt = _perceptron(laid, _STATE, measurements / units)
    joined = torch.cat([see(laid, pictures), felt], dim=1)
    return _perceptron(laid, "features_extractor.linear", joined)


def policy_of(laid: Laid, features: Tensor) -> Policy:
    """The policy for features (B, 256)."""
    hidden = _perceptron(laid, "policy_head", features)
    heads: list[Any] = []
    for head in ("dist_mu.0", "dist_sigma.0"):
        out = functional.linear(hidden, laid[f"{head}.weight"], laid[f"{head}.bias"])
        heads.append(functional.softplus(out) + LEAST)
    return Policy(*heads)


def value_of(laid: Laid, features: Tensor, measurements: Tensor) -> Tensor:
    """(B,) what the critic expects, from features (B, 256) and its own measurements (B, 4)."""
    hidden = _perceptron(laid, "value_head", torch.cat([features, measurements], dim=1))
    last = "value_head.6"
    return functional.linear(hidden, laid[f"{last}.weight"], laid[f"{last}.bias"]).squeeze(1)


def forward(laid: Laid, pictures: Tensor, measurements: Tensor) -> Policy:
    """The policy for pictures (B, 32, 128, 128) in blocks and measurements (B, 10)."""
    return policy_of(laid, features_of(laid, pictures, measurements))


def _perceptron(laid: Laid, name: str, x: Tensor) -> Tensor:
    for index in (0, 3):
        weight, bias = laid[f"{name}.{index}.weight"], laid[f"{name}.{index}.bias"]
        x = functional.linear(x, weight, bias)
        norm = f"{name}.{index + 1}"
        x = functional.layer_norm(x, x.shape[1:], laid[f"{norm}.weight"], laid[f"{norm}.bias"])
        x = functional.relu(x)
    return x
