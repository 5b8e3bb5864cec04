"""The network of CaRL, with the names and shapes of its checkpoint."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from shiftsim.planners.learned.deterministic import State
from shiftsim.planners.learned.network import Linear

CHANNELS, SIZE = 9, 256  # of the raster
MEASUREMENTS, VALUE_MEASUREMENTS, ACTIONS = 10, 4, 2
FEATURES, HIDDEN = 256, 512
CONVOLUTIONS = (  # channels out, kernel, stride
    *((8, 5, 2), (16, 5, 2), (24, 5, 2), (32, 5, 2)),
    *((64, 3, 2), (128, 3, 1), (256, 3, 1)),
)
RASTERS_AT_ONCE = 4  # on a CPU: what is computed of more does not fit its caches
FLAT = 1024  # numbers that the convolutions leave
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

    def encode_raster(self, rasters: Tensor) -> Tensor:
        """(B, 9, 256, 256) values from 0 to 255, to (B, 1024)."""
        at_once = len(rasters) if rasters.is_cuda else RASTERS_AT_ONCE
        parts = torch.split(rasters, at_once)
        return torch.cat([self.cnn(part / 255.0) for part in parts])

    def forward(self, rasters: Tensor, measurements: Tensor) -> Tensor:
        """(B, 9, 256, 256) and (B, 10) to (B, 256)."""
        parts = [self.encode_raster(rasters), self.state_linear(measurements)]
        return self.linear(torch.cat(parts, dim=1))


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

    def forward(self, rasters: Tensor, measurements: Tensor) -> Policy:
        """The policy for (B, 9, 256, 256) rasters of 0 to 255 and (B, 10) measurements."""
        return self.policy(self.features_extractor(rasters, measurements))

    def policy(self, features: Tensor) -> Policy:
        """The policy for (B, 256) features."""
        hidden = self.policy_head(features)
        # in double precision, in which it does not matter how many numbers there are
        parts = (softplus(part(hidden).double()) for part in (self.dist_mu, self.dist_sigma))
        return Policy(*(part.to(hidden.dtype) + LEAST for part in parts))

    def value(self, features: Tensor, value_measurements: Tensor) -> Tensor:
        """(B, 1) what the critic expects, from (B, 256) features and (B, 4) measurements."""
        return self.value_head(torch.cat([features, value_measurements], dim=1))


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
