"""The network of CaRL, with the names and shapes of its checkpoint.

Convolutions and norms compute with channels last. A raster is nearly empty, so on a CPU the first
convolution, which is half of the network, reads the pixels that are drawn and no others.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import layer_norm, softplus

from shiftsim.planners.learned.carl.drawn import convolve_drawn
from shiftsim.planners.learned.deterministic import State
from shiftsim.planners.learned.network.graphs import Replayed
from shiftsim.planners.learned.network.rows import Linear, store_by_columns

PREFIXES = ("",)  # of the names in the published checkpoint
CHANNELS, SIZE = 9, 256  # of the raster
MEASUREMENTS, VALUE_MEASUREMENTS, ACTIONS = 10, 4, 2
FEATURES, HIDDEN = 256, 512
CONVOLUTIONS = (  # channels out, kernel, stride
    *((8, 5, 2), (16, 5, 2), (24, 5, 2), (32, 5, 2)),
    *((64, 3, 2), (128, 3, 1), (256, 3, 1)),
)
CPU_BATCH = 4  # rasters at once on a CPU; what is made of more of them does not fit its caches
FLAT = 1024  # numbers that the convolutions leave
RELEASED = {
    "image_encoder": "roach_ln2",
    "in_channels": CHANNELS,
    "image": [SIZE, SIZE],
    "use_layer_norm": True,
    "use_layer_norm_policy_head": True,
    "features_dim": FEATURES,
    "states_neurons": [FEATURES, FEATURES],
    "policy_head_arch": [FEATURES, FEATURES],
    "value_head_arch": [FEATURES, FEATURES],
    "obs_num_measurements": MEASUREMENTS,
    "num_value_measurements": VALUE_MEASUREMENTS,
    "distribution": "beta",
    "beta_min_a_b_value": 1.0,
    "action_dim": ACTIONS,
    "action_low": -1.0,
    "action_high": 1.0,
    "use_lstm": False,
    "layer_norm_eps": 1e-5,
}
LEAST = 1.0  # of both parameters of the distribution
_CONSTANTS = {  # stored in the checkpoint, never trained
    "action_space_low": [-1.0, -1.0],
    "action_space_high": [1.0, 1.0],
    "action_dist.suggest_go": [2.5, 1.0],
    "action_dist.suggest_stop": [1.0, 1.5],
    "action_dist.suggest_turn": [1.0, 1.0],
}
_NORMS = tuple(f"features_extractor.cnn.{3 * layer + 1}" for layer in range(len(CONVOLUTIONS)))
RULES = {
    **dict.fromkeys(_CONSTANTS, "keep"),
    **{f"{norm}.weight": "d" for norm in _NORMS},
    **{f"{norm}.bias": "e" for norm in _NORMS},
}


class Policy(NamedTuple):
    """The distribution of the action, one independent beta distribution per number. B scenes."""

    alpha: Tensor  # (B, 2)
    beta: Tensor  # (B, 2)

    @property
    def action(self) -> Tensor:
        """(B, 2) mean action: acceleration and steering, in [-1, 1]."""
        return 2.0 * (self.alpha / (self.alpha + self.beta)) - 1.0


class FeaturesExtractor(nn.Module):
    """The raster and the measurements to one vector."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels, size = CHANNELS, SIZE
        for out, kernel, stride in CONVOLUTIONS:
            size = (size - kernel) // stride + 1
            layers += [nn.Conv2d(channels, out, kernel, stride), nn.LayerNorm((out, size, size))]
            layers.append(nn.ReLU())
            channels = out
        self.cnn = nn.Sequential(*layers, nn.Flatten())
        self.linear = _perceptron(FLAT + FEATURES, HIDDEN, FEATURES)
        self.state_linear = _perceptron(MEASUREMENTS, FEATURES, FEATURES)
        _store_channels_last(self.cnn)

    def see(self, pictures: Tensor) -> Tensor:
        """(B, 9, 256, 256) values from 0 to 255, to (B, 1024)."""
        if pictures.is_cuda:
            return self._see(pictures)
        return torch.cat([self._see(part) for part in torch.split(pictures, CPU_BATCH)])

    def _see(self, pictures: Tensor) -> Tensor:
        layers = list(self.cnn)
        hidden = _first_layer(layers[0], pictures)
        for conv, norm in zip(layers[0:-1:3], layers[1:-1:3], strict=True):
            if conv is not layers[0]:
                hidden = conv(hidden)
            assert isinstance(norm, nn.LayerNorm)
            turned = hidden.permute(0, 2, 3, 1)
            scale, shift = (part.permute(1, 2, 0) for part in (norm.weight, norm.bias))
            hidden = layer_norm(turned, scale.shape, scale, shift, norm.eps).relu_()
            hidden = hidden.permute(0, 3, 1, 2)
        return hidden.flatten(1)

    def feel(self, measurements: Tensor) -> Tensor:
        """(B, 10) to (B, 256)."""
        return self.state_linear(measurements)

    def forward(self, pictures: Tensor, measurements: Tensor) -> Tensor:
        """(B, 9, 256, 256) and (B, 10) to (B, 256)."""
        joined = torch.cat([self.see(pictures), self.feel(measurements)], dim=1)
        return self.linear(joined)


class CarlNetwork(nn.Module):
    """Policy and critic."""

    def __init__(self) -> None:
        super().__init__()
        self.action_dist = nn.Module()
        for name, value in _CONSTANTS.items():
            owner, _, leaf = name.rpartition(".")
            self.get_submodule(owner).register_buffer(leaf, torch.tensor(value))
        self.features_extractor = FeaturesExtractor()
        self.policy_head = _perceptron(FEATURES, FEATURES, FEATURES)
        self.dist_mu = nn.Sequential(Linear(FEATURES, ACTIONS))
        self.dist_sigma = nn.Sequential(Linear(FEATURES, ACTIONS))
        self.value_head = nn.Sequential(
            *_perceptron(FEATURES + VALUE_MEASUREMENTS, FEATURES, FEATURES), Linear(FEATURES, 1)
        )
        self.act = Replayed(self._act)
        store_by_columns(self)

    def _act(self, pictures: Tensor, measurements: Tensor) -> Tensor:
        """(B, 2) the mean action; the arguments are those of `forward`."""
        return self(pictures, measurements).action

    def forward(self, pictures: Tensor, measurements: Tensor) -> Policy:
        """The policy for (B, 9, 256, 256) pictures of 0 to 255 and (B, 10) measurements."""
        return self.policy(self.features_extractor(pictures, measurements))

    def policy(self, features: Tensor) -> Policy:
        """The policy for (B, 256) features."""
        hidden = self.policy_head(features)
        return Policy(
            *(_softplus(head(hidden)) + LEAST for head in (self.dist_mu, self.dist_sigma))
        )

    def value(self, features: Tensor, value_measurements: Tensor) -> Tensor:
        """(B, 1) what the critic expects, from (B, 256) features and (B, 4) measurements."""
        return self.value_head(torch.cat([features, value_measurements], dim=1))


def _first_layer(layer: nn.Module, pictures: Tensor) -> Tensor:
    """(B, 8, 126, 126), channels last, of pictures (B, 9, 256, 256) of 0 to 255."""
    assert isinstance(layer, nn.Conv2d)
    assert layer.bias is not None
    if pictures.is_cuda or pictures.dtype != torch.uint8 or torch.is_grad_enabled():
        whole = pictures.to(torch.float32, memory_format=torch.channels_last, copy=True)
        return layer(whole.div_(255.0))
    weight = layer.weight.permute(1, 2, 3, 0).numpy()
    channels, size = weight.shape[-1], (pictures.shape[-1] - weight.shape[1]) // 2 + 1
    out = layer.bias.expand(len(pictures), size, size, channels).contiguous()
    for picture, made in zip(pictures.contiguous().numpy(), out.numpy(), strict=True):
        convolve_drawn(picture, picture.view(np.uint64), weight, made)
    return out.permute(0, 3, 1, 2)


def _store_channels_last(cnn: nn.Sequential) -> None:
    """Lay out weights as they are read; names and shapes stay, and so does it when they are loaded.

    Those of the first convolution have the channels that it makes last, the others those they read.
    """
    for layer in cnn:
        if isinstance(layer, nn.Conv2d):
            layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)
        elif isinstance(layer, nn.LayerNorm):
            for part in (layer.weight, layer.bias):
                part.data = part.data.permute(1, 2, 0).contiguous().permute(2, 0, 1)
    first = cnn[0].weight
    assert isinstance(first, Tensor)
    first.data = first.data.permute(1, 2, 3, 0).contiguous().permute(3, 0, 1, 2)


def _softplus(x: Tensor) -> Tensor:
    """In double precision, in which it does not matter how many numbers there are."""
    return softplus(x.double()).to(x.dtype)


def _perceptron(size: int, hidden: int, out: int) -> nn.Sequential:
    return nn.Sequential(
        *(Linear(size, hidden), nn.LayerNorm(hidden), nn.ReLU()),
        *(Linear(hidden, out), nn.LayerNorm(out), nn.ReLU()),
    )


def build_network(args: Mapping[str, Any] | None = None) -> CarlNetwork:
    """The network, without weights; all published checkpoints share one architecture."""
    return CarlNetwork()


def drive_overrides(state: State) -> None:
    """Make deterministic weights react more in acceleration than in steering, in place."""
    gain = np.array([[4.0], [0.05]])
    for head, bias in (("dist_mu", [2.5, 0.0]), ("dist_sigma", [0.0, 0.0])):
        weight = state[f"{head}.0.weight"]
        state[f"{head}.0.weight"] = (weight.astype(np.float64) * gain).astype(weight.dtype)
        state[f"{head}.0.bias"] = np.array(bias, state[f"{head}.0.bias"].dtype)
