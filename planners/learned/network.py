"""Layers of the learned planners' networks, and the blocks that PlanTF and PLUTO share.

Names and shapes of all tensors are those of the official checkpoints. Rows that only fill a batch
up are not computed: `Scenes` packs the others one after another. On a CPU a product of few rows is
computed as one of many, so that a scene gets the same numbers alone and in a batch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

DIM = 128
MIN_ROWS, MIN_COLUMNS = 12, 2  # below these CPU libraries compute products in another way


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """(..., outputs) of x (..., inputs), weight (outputs, inputs) and bias (outputs,)."""
    count, outputs = x.shape[:-1].numel(), len(weight)
    few = not x.is_cuda and 0 < count < MIN_ROWS
    if outputs >= MIN_COLUMNS and not few:
        return functional.linear(x, weight, bias)
    rows = x.reshape(count, x.shape[-1])
    if few:
        rows = functional.pad(rows, (0, 0, 0, MIN_ROWS - count))
    if outputs < MIN_COLUMNS:
        weight = weight.expand(MIN_COLUMNS, -1)
        bias = None if bias is None else bias.expand(MIN_COLUMNS)
    out = functional.linear(rows, weight, bias)[:count, :outputs]
    return out.reshape(*x.shape[:-1], outputs)


class Linear(nn.Linear):
    """`torch.nn.Linear` by `linear`."""

    def forward(self, input: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return linear(input, self.weight, self.bias)


class Conv(nn.Conv1d):
    """Convolution of three neighbours along a sequence, as one product, which is faster."""

    def __init__(self, inputs: int, outputs: int, *, stride: int = 1, bias: bool = True) -> None:
        super().__init__(inputs, outputs, 3, stride=stride, padding=1, bias=bias)

    def forward(self, input: Tensor) -> Tensor:
        """(A, length, inputs) to (A, length / stride, outputs)."""
        padded = functional.pad(input, (0, 0, 1, 1))
        windows = [padded[:, i : i + input.shape[1] : self.stride[0]] for i in range(3)]
        return linear(torch.cat(windows, -1), self.weight.transpose(1, 2).flatten(1), self.bias)


class Mlp(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(
        self, inputs: int, hidden: int, outputs: int, *, approximate: str = "none"
    ) -> None:
        """Take the channels in, between and out; the GELU is exact, or by `tanh`."""
        super().__init__()
        self.fc1 = Linear(inputs, hidden)
        self.act = nn.GELU(approximate=approximate)
        self.fc2 = Linear(hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        return self.fc2(self.act(self.fc1(x)))


def head(inputs: int, hidden: int, outputs: int, *, bias: bool = True) -> nn.Sequential:
    """Linear, LayerNorm, ReLU, Linear; `bias` is that of the first layer."""
    first = Linear(inputs, hidden, bias=bias)
    return nn.Sequential(first, nn.LayerNorm(hidden), nn.ReLU(), Linear(hidden, outputs))


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Linear, ReLU, Linear."""
    return nn.Sequential(Linear(inputs, hidden), nn.ReLU(), Linear(hidden, outputs))


class Scenes:
    """The rows of B scenes one after another, without those that fill the batch up."""

    def __init__(
        self, parts: Sequence[Tensor], counts: Sequence[Sequence[int]] | None = None
    ) -> None:
        """Take the parts (B, N) of a batch side by side: true for rows that take part in attention.

        `counts` are by part how many rows of each scene do not fill up; None where all do not.
        """
        valid = torch.cat(list(parts), dim=1)
        self.present = torch.ones_like(valid)  # (B, N of all parts)
        if counts is not None:
            each = [torch.tensor(count, device=valid.device)[:, None] for count in counts]
            numbers = [torch.arange(part.shape[1], device=valid.device) for part in parts]
            before = [number < count for number, count in zip(numbers, each, strict=True)]
            self.present = torch.cat(before, dim=1)
        self.counts: list[int] = self.present.sum(dim=1).tolist()  # rows of each scene
        self.valid = self.pack(valid)  # (T,) rows that take part in attention
        self.padded = pads(valid)
        self.masks: list[Tensor | None] = []  # by scene (1, 1, 1, count); None where all take part
        if not self.padded:
            self.masks = [
                None if bool(keys.all()) else key_mask(keys)[None]
                for keys in self.split(self.valid)
            ]

    def pack(self, x: Tensor) -> Tensor:
        """(T, ...) the rows of x (B, N, ...) that do not fill up, scene by scene."""
        return x[self.present]

    def unpack(self, rows: Tensor, fill: float = 0.0) -> Tensor:
        """(B, N, ...) of rows (T, ...)."""
        x = rows.new_full((*self.present.shape, *rows.shape[1:]), fill)
        x[self.present] = rows
        return x

    def split(self, rows: Tensor) -> tuple[Tensor, ...]:
        """Rows (T, ...) by scene."""
        return torch.split(rows, self.counts)

    def firsts(self, rows: Tensor) -> Tensor:
        """(B, ...) the first row of each scene."""
        counts = self.present.sum(dim=1)
        return rows[counts.cumsum(dim=0) - counts]


def pads(x: Tensor) -> bool:
    """Whether scenes are filled up for attention: a GPU would wait for one after another."""
    return x.is_cuda


def key_mask(valid: Tensor) -> Tensor:
    """Logits (..., 1, 1, N) added to keys: 0 where valid (..., N), else -inf."""
    zeros = torch.zeros(valid.shape, device=valid.device)
    return zeros.masked_fill(~valid, -torch.inf)[..., None, None, :]


class Attention(nn.Module):
    """Multi-head attention with the tensors of `torch.nn.MultiheadAttention`."""

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads, self.width = num_heads, dim // num_heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.zeros(3 * dim))
        self.out_proj = Linear(dim, dim)
        nn.init.xavier_uniform_(self.in_proj_weight)

    def forward(
        self, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None = None
    ) -> Tensor:
        """Attend from (B, Q, D) to (B, N, D); `mask` is added to the logits (B, heads, Q, N)."""
        return self.out_proj(self.attend(*self.project(query, key, value), mask))

    def segment_attention(
        self, query: Tensor, context: Tensor, asking: Scenes, scenes: Scenes
    ) -> Tensor:
        """Attend in each scene from its rows of `query` (Q, ..., D) to those of `context` (T, D).

        `asking` says how the rows of `query` lie, `scenes` how those of `context` do.
        """
        q, k, v = self.project(query, context, context)
        if scenes.padded:
            dense, mask = asking.unpack(q), key_mask(scenes.unpack(scenes.valid, False))
            keys, values = scenes.unpack(k), scenes.unpack(v)
            mixed = asking.pack(
                self.attend(dense.flatten(1, -2), keys, values, mask).view_as(dense)
            )
        else:
            parts = (asking.split(q), scenes.split(k), scenes.split(v), scenes.masks)
            mixed = torch.cat(
                [
                    self.attend(q.flatten(0, -2)[None], k[None], v[None], mask)[0].view_as(q)
                    for q, k, v, mask in zip(*parts, strict=True)
                ]
            )
        return self.out_proj(mixed)

    def project(self, query: Tensor, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Projections of the three, each (..., D)."""
        if query is key is value:
            q, k, v = linear(query, self.in_proj_weight, self.in_proj_bias).chunk(3, dim=-1)
            return q, k, v
        return self.project_one(query, 0), self.project_one(key, 1), self.project_one(value, 2)

    def project_one(self, x: Tensor, number: int) -> Tensor:
        """(..., D) projected as queries (0), keys (1) or values (2)."""
        weight, bias = self.in_proj_weight.chunk(3)[number], self.in_proj_bias.chunk(3)[number]
        return linear(x, weight, bias)

    def attend(self, q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
        """(B, Q, D) values (B, N, D), weighted as projected queries and keys say."""
        q, k, v = (
            x.reshape(*x.shape[:2], self.num_heads, self.width).transpose(1, 2) for x in (q, k, v)
        )
        mask = None if mask is None else mask.to(q.dtype)
        out = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        return out.transpose(1, 2).flatten(2)


@dataclass(frozen=True, slots=True)
class SceneTensors:
    """Agents and map of B scenes: A rows of agents of which the first is the ego, M polygons."""

    position: Tensor  # (B, A, 21, 2) in the ego frame [m]
    heading: Tensor  # (B, A, 21) [rad]
    velocity: Tensor  # (B, A, 21, 2) [m/s]
    shape: Tensor  # (B, A, 21, 2) width, length [m]
    valid: Tensor  # (B, A, 21)
    category: Tensor  # (B, A) indices of kinds
    current_state: Tensor  # (B, >= 6) x, y, heading, speed, acceleration, steering angle
    # (B, M, K, 2) of the centre lines [m]; of PLUTO (B, M, 3, K, 2) of the boundaries, too
    points: Tensor
    vectors: Tensor  # (B, M, K, 2) along the centre line, to the next point [m]
    orientations: Tensor  # (B, M, K) of these vectors [rad]
    centers: Tensor  # (B, M, 3) pose that stands for the polygon
    kind: Tensor  # (B, M) 0 lane, 1 connector, 2 crosswalk
    on_route: Tensor  # (B, M) 1 where the polygon is on the route
    light: Tensor  # (B, M) 0 green, 1 yellow, 2 red, 3 unknown
    has_limit: Tensor  # (B, M)
    limit: Tensor  # (B, M) speed limit [m/s]
    point_valid: Tensor  # (B, M, K)

    @property
    def known(self) -> tuple[Tensor, Tensor]:
        """Agents (B, A) and polygons (B, M) of which anything is known."""
        return self.valid.any(dim=-1), self.point_valid.any(dim=-1)

    @property
    def poses(self) -> Tensor:
        """(B, A + M, 3) of the agents now, and of the polygons."""
        now = torch.cat([self.position[:, :, -1], self.heading[:, :, -1:]], dim=-1)
        return torch.cat([now, self.centers], dim=1)

    def along_lines(self, middle: Tensor) -> list[Tensor]:
        """Of each point of the centre lines (B, M, K, 2): place, vector, direction, each (…, 2)."""
        directions = torch.stack([self.orientations.cos(), self.orientations.sin()], dim=-1)
        return [middle - self.centers[:, :, None, :2], self.vectors, directions]


class EncoderBlock(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, num_heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(DIM), nn.LayerNorm(DIM)
        self.attn = Attention(DIM, num_heads)
        self.mlp = Mlp(DIM, 4 * DIM, DIM)

    def forward(self, x: Tensor, scenes: Scenes) -> Tensor:
        """Tokens (T, D) of scenes to the same."""
        normed = self.norm1(x)
        x = x + self.attn.segment_attention(normed, normed, scenes, scenes)
        return x + self.mlp(self.norm2(x))
