"""Building blocks of the Diffusion Planner's network, with the names of its checkpoint."""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.network.rows import Attention, Mlp

EPS = 1e-5  # of the layer norms; torch's default, and the official networks keep it


def store_by_columns(network: nn.Module) -> None:
    """Lay out the weights by columns; a product with few rows reads them faster so.

    Neither names nor shapes change, and weights that are loaded later keep the layout.
    """
    for module in network.modules():
        if isinstance(module, nn.Linear):
            module.weight.data = module.weight.data.t().contiguous().t()
        elif isinstance(module, Attention):
            module.in_proj_weight.data = module.in_proj_weight.data.t().contiguous().t()


class Mixer(nn.Module):
    """One mixer block: an MLP over the tokens, then one over the channels."""

    def __init__(self, tokens: int, channels: int) -> None:
        """Make it for (tokens, channels) inputs."""
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, EPS)
        self.channels_mlp = Mlp(channels, channels, channels)
        self.norm2 = nn.LayerNorm(channels, EPS)
        self.tokens_mlp = Mlp(tokens, tokens, tokens)

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, C) to the same, in place."""
        self.tokens_mlp.add_over_rows_to(x, self.norm1(x))
        self.channels_mlp.add_to(x, self.norm2(x))
        return x

    def mean(self, x: Tensor) -> Tensor:
        """(B, C) mean over the tokens of what `forward` returns; x does not survive.

        The last layer is linear, so it is applied to the mean instead of to every token.
        """
        self.tokens_mlp.add_over_rows_to(x, self.norm1(x))
        hidden = self.channels_mlp.hidden(self.norm2(x)).mean(dim=1)
        out: Tensor = x.mean(dim=1) + self.channels_mlp.fc2(hidden)
        return out


class Product(NamedTuple):
    """A linear layer at hand: (R, inputs) to (R, outputs).

    Looking up the tensors of a module takes a quarter of the time of a product with few rows.
    """

    weight: Tensor
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """Apply the layer."""
        return torch.addmm(self.bias, x, self.weight)


class Norm(NamedTuple):
    """A layer norm at hand."""

    weight: Tensor
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """Normalise over the last dimension."""
        return functional.layer_norm(x, self.weight.shape, self.weight, self.bias, EPS)


def product(layer: nn.Module) -> Product:
    """A linear layer at hand."""
    assert isinstance(layer, nn.Linear)
    return Product(layer.weight.t(), layer.bias)


def norm(layer: nn.Module) -> Norm:
    """A layer norm at hand."""
    assert isinstance(layer, nn.LayerNorm)
    return Norm(layer.weight, layer.bias)
