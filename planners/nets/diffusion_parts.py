"""Building blocks of the Diffusion Planner's network, with the names of its checkpoint."""

import torch
from torch import Tensor, nn
from torch.nn import functional

EPS = 1e-5  # of the layer norms; torch's default, and the official networks keep it


class Mlp(nn.Module):
    """Linear, GELU, Linear over the last dimension."""

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
        self.fc1 = nn.Linear(inputs, hidden)
        self.fc2 = nn.Linear(hidden, outputs)
        self.approximate = approximate

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        out: Tensor = self.fc2(self.hidden(x))
        return out

    def hidden(self, x: Tensor) -> Tensor:
        """(..., hidden) what the second layer reads."""
        return functional.gelu(self.fc1(x), approximate=self.approximate)

    def over_rows(self, x: Tensor) -> Tensor:
        """The same over the last but one dimension: (..., inputs, C) to (..., outputs, C)."""
        hidden = functional.gelu(_over_rows(self.fc1, x), approximate=self.approximate)
        return _over_rows(self.fc2, hidden)


def _over_rows(layer: nn.Linear, x: Tensor) -> Tensor:
    """A linear layer over the last but one dimension of (B, inputs, C), without transposing."""
    weight = layer.weight.expand(len(x), -1, -1)
    return torch.baddbmm(layer.bias[:, None], weight, x)


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
        """(B, T, C) to (B, T, C)."""
        x = x + self.tokens_mlp.over_rows(self.norm1(x))
        return x + self.channels_mlp(self.norm2(x))

    def mean(self, x: Tensor) -> Tensor:
        """(B, C) mean over the tokens of what `forward` returns.

        The last layer is linear, so it is applied to the mean instead of to every token.
        """
        x = x + self.tokens_mlp.over_rows(self.norm1(x))
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
        self.out_proj = nn.Linear(channels, channels)
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
        out: Tensor = self.out_proj(mixed.transpose(1, 2).flatten(2))
        return out

    def query(self, x: Tensor) -> Tensor:
        """(B, H, Q, D) queries of (B, Q, C)."""
        first = self.channels
        return self._split(
            functional.linear(x, self.in_proj_weight[:first], self.in_proj_bias[:first])
        )

    def keys_values(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values (B, H, K, D) of (B, K, C)."""
        first = self.channels
        both = functional.linear(x, self.in_proj_weight[first:], self.in_proj_bias[first:])
        keys, values = both.chunk(2, dim=-1)
        return self._split(keys), self._split(values)

    def project_all(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values (B, H, K, D) of the same (B, K, C)."""
        query, keys, values = functional.linear(x, self.in_proj_weight, self.in_proj_bias).chunk(
            3, dim=-1
        )
        return self._split(query), self._split(keys), self._split(values)

    def _split(self, x: Tensor) -> Tensor:
        return x.view(*x.shape[:-1], self.heads, -1).transpose(1, 2)
