"""Building blocks of the Diffusion Planner's network, with the names of its checkpoint."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.network.rows import Linear, linear

EPS = 1e-5  # of the layer norms; torch's default, and the official networks keep it
_CUBIC, _TWICE = 0.044715, 2.0 * math.sqrt(2.0 / math.pi)  # of the GELU by tanh


class Mlp(nn.Module):
    """Linear, GELU, Linear over the last dimension.

    The activation overwrites what it reads, so that no second tensor of that size passes through
    the cache.
    """

    def __init__(
        self, inputs: int, hidden: int, outputs: int, *, approximate: str = "none"
    ) -> None:
        """Make it.

        Args:
            inputs: Channels in.
            hidden: Channels between.
            outputs: Channels out.
            approximate: Of the GELU: `none` (error function) or `tanh`.
        """
        super().__init__()
        self.fc1 = Linear(inputs, hidden)
        self.fc2 = Linear(hidden, outputs)
        self.approximate = approximate

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        out: Tensor = self.fc2(self.hidden(x))
        return out

    def hidden(self, x: Tensor) -> Tensor:
        """(..., hidden) what the second layer reads."""
        return self._activated(self.fc1(x))

    def over_rows(self, x: Tensor) -> Tensor:
        """The same over the last but one dimension: (..., inputs, C) to (..., outputs, C)."""
        return _over_rows(self.fc2, self._activated(_over_rows(self.fc1, x)))

    def add_to(self, x: Tensor, read: Tensor) -> None:
        """Add `forward(read)` to x (..., outputs)."""
        hidden = self.hidden(read).flatten(0, -2)
        x += self.fc2.bias
        x.view(-1, x.shape[-1]).addmm_(hidden, self.fc2.weight.t())

    def add_over_rows_to(self, x: Tensor, read: Tensor) -> None:
        """Add `over_rows(read)` to x (..., outputs, C)."""
        hidden = self._activated(_over_rows(self.fc1, read))
        x += self.fc2.bias[:, None]
        x.baddbmm_(self.fc2.weight.expand(len(x), -1, -1), hidden)

    def _activated(self, x: Tensor) -> Tensor:
        return tanh_gelu_(x) if self.approximate == "tanh" else gelu_(x)


def tanh_gelu_(x: Tensor) -> Tensor:
    """The GELU by tanh, in place: `1 + tanh(z)` is `2 sigmoid(2 z)`, which is computed faster."""
    twice = torch.addcmul(x, x * x, x, value=_CUBIC).mul_(_TWICE)
    return x.mul_(twice.sigmoid_())


def gelu_(x: Tensor) -> Tensor:
    """The GELU by the error function, in place."""
    out: Tensor = torch.ops.aten.gelu_(x)
    return out


def _over_rows(layer: Linear, x: Tensor) -> Tensor:
    """A linear layer over the last but one dimension of (B, inputs, C), without transposing."""
    weight = layer.weight.expand(len(x), -1, -1)
    return torch.baddbmm(layer.bias[:, None], weight, x)


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


class Attention(nn.Module):
    """Multi-head attention with packed input projections, as `torch.nn.MultiheadAttention`."""

    def __init__(self, channels: int, heads: int) -> None:
        """Make it."""
        super().__init__()
        self.in_proj_weight = nn.Parameter(torch.empty(3 * channels, channels))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * channels))
        self.out_proj = Linear(channels, channels)
        self.channels, self.heads = channels, heads
        nn.init.xavier_uniform_(self.in_proj_weight)

    def forward(self, query: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None) -> Tensor:
        """Attend and project.

        Args:
            query: (B, H, Q, D) projected queries.
            keys: (B, H, K, D) projected keys.
            values: (B, H, K, D) projected values.
            mask: Added to the logits, broadcast to (B, H, Q, K); None where all keys count alike.

        Returns:
            (B, Q, H * D).
        """
        mixed = functional.scaled_dot_product_attention(query, keys, values, attn_mask=mask)
        out = linear(mixed.transpose(1, 2).flatten(2), self.out_proj.weight, self.out_proj.bias)
        return out

    def query(self, x: Tensor) -> Tensor:
        """(B, H, Q, D) queries of (B, Q, C)."""
        first = self.channels
        return self._split(linear(x, self.in_proj_weight[:first], self.in_proj_bias[:first]))

    def keys_values(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values (B, H, K, D) of (B, K, C)."""
        first = self.channels
        both = linear(x, self.in_proj_weight[first:], self.in_proj_bias[first:])
        keys, values = both.chunk(2, dim=-1)
        return self._split(keys), self._split(values)

    def _split(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:-1], self.heads, -1).transpose(1, 2)


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
