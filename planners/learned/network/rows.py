"""Layers and attention whose rows do not depend on how many rows, or scenes, there are.

A scene then gets the same numbers alone and in a batch, where the library computes a row of a large
product in one way; the ways for fewer than 16 rows, or a single column, are not taken on a CPU.
Scenes of different sizes lie one after another, without any padding between them.
"""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

ROWS, COLUMNS = 16, 2  # from which on a product is computed in the way of large ones
# by count: as many rows, then the last one again up to `ROWS`
_REPEATED = [torch.arange(ROWS, device="cpu").clamp(max=count - 1) for count in range(ROWS)]
_CUBIC, _TWICE = 0.044715, 2.0 * math.sqrt(2.0 / math.pi)  # of the GELU by tanh


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """(..., outputs) of x (..., inputs), weight (outputs, inputs) and bias (outputs,)."""
    if x.is_cuda or (x.dim() == 2 and len(x) >= ROWS and len(weight) >= COLUMNS):
        return functional.linear(x, weight, bias)
    rows, outputs = x.reshape(-1, x.shape[-1]), len(weight)
    count = len(rows)
    if count == 0:
        return x.new_zeros(*x.shape[:-1], outputs)
    if count < ROWS:
        rows = rows.index_select(0, _REPEATED[count])  # quicker than zeros after them
    if outputs < COLUMNS:
        weight = weight.expand(COLUMNS, -1)
        bias = None if bias is None else bias.expand(COLUMNS)
    out = functional.linear(rows, weight, bias)
    if out.shape != (count, outputs):
        out = out[:count, :outputs]
    return out.reshape(*x.shape[:-1], outputs)


def filled(x: Tensor) -> Tensor:
    """Rows (N, C), and on a CPU the last one again up to `ROWS`, for several products in a row."""
    few = 0 < len(x) < ROWS and not x.is_cuda
    return x.index_select(0, _REPEATED[len(x)]) if few else x


class Linear(nn.Linear):
    """`torch.nn.Linear` by `linear`."""

    def forward(self, input: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return linear(input, self.weight, self.bias)


class Mlp(nn.Module):
    """Linear, GELU, Linear over the last dimension.

    The activation overwrites what it reads, so that no second tensor of that size passes through
    the cache.
    """

    def __init__(
        self, inputs: int, hidden: int, outputs: int, *, approximate: str = "none"
    ) -> None:
        """Take the channels in, between and out; the GELU is by error function, or by `tanh`."""
        super().__init__()
        self.fc1 = Linear(inputs, hidden)
        self.fc2 = Linear(hidden, outputs)
        self.approximate = approximate

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return self.fc2(self.hidden(x))

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
    return torch.ops.aten.gelu_(x)


def _over_rows(layer: Linear, x: Tensor) -> Tensor:
    """A linear layer over the last but one dimension of (B, inputs, C), without transposing."""
    weight = layer.weight.expand(len(x), -1, -1)
    return torch.baddbmm(layer.bias[:, None], weight, x)


class Scenes(NamedTuple):
    """How the rows of several scenes lie one after another."""

    counts: list[int]  # how many rows each has
    # by scene (1, 1, 1, count) logits added to its keys; None where all take part
    masks: list[Tensor | None]

    def firsts(self, device: torch.device) -> Tensor:
        """(B,) the first row of each scene."""
        return torch.tensor([0, *accumulate(self.counts[:-1])], device=device)


def make_scenes(counts: Sequence[int], keep: Tensor) -> Scenes:
    """Scenes of `counts` rows, of which those take part for which `keep` (T,) is true."""
    masks: list[Tensor | None] = []
    for part in torch.split(keep.cpu(), list(counts)):
        mask = None
        if not bool(part.all()):
            zeros = torch.zeros(len(part), dtype=torch.float32)
            mask = zeros.masked_fill(~part, -torch.inf)[None, None, None].to(keep.device)
        masks.append(mask)
    return Scenes(list(counts), masks)


class Packing(NamedTuple):
    """Which of the rows (B, N) of scenes side by side are no padding."""

    shape: tuple[int, int]
    there: Tensor | None  # (B, N); None where all are

    def pack(self, x: Tensor) -> Tensor:
        """(T, ...) the rows of x (B, N, ...) that are no padding, scene by scene."""
        return x.flatten(0, 1) if self.there is None else x[self.there]

    def unpack(self, rows: Tensor, padding: float = 0.0) -> Tensor:
        """(B, N, ...) of rows (T, ...)."""
        if self.there is None:
            return rows.reshape(*self.shape, *rows.shape[1:])
        x = rows.new_full((*self.shape, *rows.shape[1:]), padding)
        x[self.there] = rows
        return x


def make_packing(
    lengths: Sequence[int], counts: Sequence[Sequence[int]], device: torch.device
) -> Packing:
    """Of parts side by side, in `lengths` rows, of which scenes have `counts`, by part."""
    shape = len(counts[0]), sum(lengths)
    if all(count == length for length, part in zip(lengths, counts, strict=True) for count in part):
        return Packing(shape, None)
    there = [
        torch.arange(length, device=device) < torch.tensor(part, device=device)[:, None]
        for length, part in zip(lengths, counts, strict=True)
    ]
    return Packing(shape, torch.cat(there, dim=1))


def without_padding(
    parts: Sequence[Tensor], counts: Sequence[Sequence[int]] | None
) -> tuple[Packing, Scenes]:
    """How rows (B, N of all parts) of parts side by side lie without padding: the scenes they make.

    The parts (B, N) are true for rows that take part; `counts` says by part how many rows each
    scene has, None for all.
    """
    lengths = [part.shape[1] for part in parts]
    counts = counts or [[length] * len(parts[0]) for length in lengths]
    packing = make_packing(lengths, counts, parts[0].device)
    totals = list(map(sum, zip(*counts, strict=True)))
    return packing, make_scenes(totals, packing.pack(torch.cat(list(parts), dim=1)))


class Attention(nn.Module):
    """Multi-head attention with biased projections; tensors of torch's `MultiheadAttention`."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads, self.width = num_heads, dim // num_heads
        self.in_proj_weight = nn.Parameter(torch.zeros(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = Linear(dim, dim)

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Attend from (B, Q, D) to (B, N, D), scene by scene of equal sizes."""
        return self.out_proj(self.mixed(*self.projected(query, key, value)))

    def among(self, query: Tensor, context: Tensor, queries: Sequence[int], keys: Scenes) -> Tensor:
        """Attend in each scene from its rows of `query` (Q, D) to its rows of `context` (T, D).

        `queries` says how many rows of `query` each scene has, `keys` how those of `context` lie.
        """
        asked = self.projected(query, context, context)
        if len(queries) == 1:
            q, k, v = (part[None] for part in asked)
            return self.out_proj(self.mixed(q, k, v, keys.masks[0])[0])
        parts = zip(
            torch.split(asked[0], list(queries)),
            torch.split(asked[1], keys.counts),
            torch.split(asked[2], keys.counts),
            keys.masks,
            strict=True,
        )
        mixed = [self.mixed(q[None], k[None], v[None], mask)[0] for q, k, v, mask in parts]
        return self.out_proj(torch.cat(mixed))

    def projected(self, query: Tensor, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Projections of the three, each (..., D)."""
        weights, biases = self.in_proj_weight, self.in_proj_bias
        if query is key and key is value:
            q, k, v = linear(query, weights, biases).chunk(3, dim=-1)
            return q, k, v
        if key is value:
            dim = self.out_proj.in_features
            return linear(query, weights[:dim], biases[:dim]), *self.keys_values(key)
        dim = 2 * self.out_proj.in_features
        if query is key:
            q, k = linear(query, weights[:dim], biases[:dim]).chunk(2, dim=-1)
            return q, k, linear(value, weights[dim:], biases[dim:])
        q, k, v = (
            linear(x, weight, bias)
            for x, weight, bias in zip(
                (query, key, value), weights.chunk(3), biases.chunk(3), strict=True
            )
        )
        return q, k, v

    def to_itself(self, x: Tensor) -> Tensor:
        """(..., D) where every row attends to itself alone, whose weight is then 1."""
        dim = 2 * self.out_proj.in_features
        return self.out_proj(linear(x, self.in_proj_weight[dim:], self.in_proj_bias[dim:]))

    def keys_values(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Projected keys and values of a context, each (..., D)."""
        dim = self.out_proj.in_features
        k, v = linear(context, self.in_proj_weight[dim:], self.in_proj_bias[dim:]).chunk(2, dim=-1)
        return k, v

    def mixed(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, Q, D) values (B, N, D), weighted as queries and keys say; `mask` adds to logits."""
        out = functional.scaled_dot_product_attention(
            self.heads(q), self.heads(k), self.heads(v), attn_mask=mask
        )
        return out.transpose(1, 2).flatten(2)

    def heads(self, x: Tensor) -> Tensor:
        """(..., heads, N, width) of projections (..., N, D)."""
        return x.reshape(*x.shape[:-1], self.num_heads, self.width).transpose(1, 2)


def store_by_columns(network: nn.Module) -> None:
    """Lay out the weights by columns; a product with few rows reads them faster so.

    Neither names nor shapes change, and weights that are loaded later keep the layout.
    """
    for module in network.modules():
        if isinstance(module, nn.Linear):
            module.weight.data = by_columns(module.weight.data)
        elif isinstance(module, Attention):
            module.in_proj_weight.data = by_columns(module.in_proj_weight.data)


def by_columns(weight: Tensor) -> Tensor:
    """The same matrix, laid out by columns."""
    return weight.t().contiguous().t()
