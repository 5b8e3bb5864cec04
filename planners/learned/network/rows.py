"""Layers and attention whose rows do not depend on how many rows, or scenes, there are.

A scene then gets the same numbers alone and in a batch, where the library computes a row of a large
product in one way; the ways for one to three rows, or a single column, are not taken on a CPU.
Scenes of different sizes lie one after another, without any padding between them.
"""

from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

ROWS, COLUMNS = 4, 2  # from which on a product is computed in the way of large ones


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """(..., outputs) of x (..., inputs), weight (outputs, inputs) and bias (outputs,)."""
    if x.is_cuda or (x.dim() == 2 and len(x) >= ROWS and len(weight) >= COLUMNS):
        return functional.linear(x, weight, bias)
    rows, outputs = x.reshape(-1, x.shape[-1]), len(weight)
    count = len(rows)
    if count < ROWS:
        rows = functional.pad(rows, (0, 0, 0, ROWS - count))
    if outputs < COLUMNS:
        weight = functional.pad(weight, (0, 0, 0, COLUMNS - outputs))
        bias = None if bias is None else functional.pad(bias, (0, COLUMNS - outputs))
    out = functional.linear(rows, weight, bias)
    if out.shape != (count, outputs):
        out = out[:count, :outputs]
    return out.reshape(*x.shape[:-1], outputs)


class Linear(nn.Linear):
    """`torch.nn.Linear` by `linear`."""

    def forward(self, input: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return linear(input, self.weight, self.bias)


class Convolution(nn.Conv2d):
    """`torch.nn.Conv2d`, on a CPU in the way of several pictures also for one."""

    def forward(self, input: Tensor) -> Tensor:
        """(B, channels, H, W) to (B, channels, H, W)."""
        if len(input) > 1 or input.is_cuda:
            return super().forward(input)
        return super().forward(input.expand(2, -1, -1, -1))[:1]


class Scenes(NamedTuple):
    """How the rows of several scenes lie one after another.

    Attributes:
        counts: How many rows each has.
        masks: By scene (1, 1, 1, count) logits added to its keys; None where all take part.
    """

    counts: list[int]
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


def present(counts: Sequence[int], length: int, device: torch.device) -> Tensor:
    """(B, length) true in the first rows of every scene, as many as it has."""
    return torch.arange(length, device=device) < torch.tensor(counts, device=device)[:, None]


def without_padding(
    parts: Sequence[Tensor], counts: Sequence[Sequence[int]] | None
) -> tuple[Tensor, Scenes]:
    """Which rows of several parts side by side are there, and how they lie.

    Args:
        parts: Each (B, N), true for rows that take part.
        counts: By part how many rows each scene has, the rest is padding; None for all.

    Returns:
        (B, N of all parts) rows that are no padding, and the scenes they make.
    """
    counts = counts or [[part.shape[1]] * len(part) for part in parts]
    there = torch.cat(
        [present(n, part.shape[1], part.device) for n, part in zip(counts, parts, strict=True)],
        dim=1,
    )
    totals = list(map(sum, zip(*counts, strict=True)))
    return there, make_scenes(totals, torch.cat(list(parts), dim=1)[there])


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
        out: Tensor = self.out_proj(self.mixed(*self.projected(query, key, value)))
        return out

    def among(self, query: Tensor, context: Tensor, queries: Sequence[int], keys: Scenes) -> Tensor:
        """Attend in each scene from its rows of `query` (Q, D) to its rows of `context` (T, D).

        Args:
            query: Rows that ask.
            context: Rows that are asked.
            queries: How many rows of `query` each scene has.
            keys: The scenes of `context`.
        """
        asked = self.projected(query, context, context)
        parts = zip(
            torch.split(asked[0], list(queries)),
            torch.split(asked[1], keys.counts),
            torch.split(asked[2], keys.counts),
            keys.masks,
            strict=True,
        )
        mixed = [self.mixed(q[None], k[None], v[None], mask)[0] for q, k, v, mask in parts]
        out: Tensor = self.out_proj(torch.cat(mixed))
        return out

    def projected(self, query: Tensor, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Projections of the three, each (..., D)."""
        weights, biases = self.in_proj_weight, self.in_proj_bias
        if query is key and key is value:
            q, k, v = linear(query, weights, biases).chunk(3, dim=-1)
            return q, k, v
        dim = self.out_proj.in_features
        if key is value:
            q = linear(query, weights[:dim], biases[:dim])
            k, v = linear(key, weights[dim:], biases[dim:]).chunk(2, dim=-1)
            return q, k, v
        q, k, v = (
            linear(x, weight, bias)
            for x, weight, bias in zip(
                (query, key, value), weights.chunk(3), biases.chunk(3), strict=True
            )
        )
        return q, k, v

    def mixed(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, Q, D) values (B, N, D), weighted as queries and keys say; `mask` adds to logits."""
        out = functional.scaled_dot_product_attention(
            self._heads(q), self._heads(k), self._heads(v), attn_mask=mask
        )
        return out.transpose(1, 2).flatten(2)

    def _heads(self, x: Tensor) -> Tensor:
        return x.reshape(*x.shape[:-1], self.num_heads, self.width).transpose(1, 2)
