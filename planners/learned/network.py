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
NUM_AGENT_KINDS = 4
HISTORY_CHANNELS = 9
STATE_CHANNELS = 6  # of the ego state that are read
_KNOWN_STATES = 3  # of these that are never dropped in training: the pose
MIN_ROWS, MIN_COLUMNS = 12, 2  # below these CPU libraries compute products in another way
LINES_AT_ONCE = 64
# by level of the history encoder
_WIDTHS, _HEADS, _WINDOWS, _LENGTHS = (32, 64, 128), (2, 4, 8), (3, 3, 5), (20, 10, 5)


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


class NeighborhoodAttention(nn.Module):
    """Attention along a sequence to the `window` nearest positions; windows shift at the ends."""

    offsets: Tensor
    outside: Tensor

    def __init__(self, dim: int, num_heads: int, window: int, length: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.rpb = nn.Parameter(0.02 * torch.randn(num_heads, 2 * window - 1))
        self.qkv = Linear(dim, 3 * dim)
        self.proj = Linear(dim, dim)
        positions = torch.arange(length)
        ahead = positions - (positions - window // 2).clamp(0, length - window)[:, None]
        offsets = positions - positions[:, None] + window - 1
        outside = (ahead < 0) | (ahead >= window)
        self.register_buffer("offsets", offsets.clamp(0, 2 * window - 2), persistent=False)
        self.register_buffer("outside", outside, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(A, length, D) to the same."""
        q, k, v = self.qkv(x).unflatten(-1, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        bias = self.rpb[:, self.offsets].masked_fill(self.outside, -torch.inf)
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=bias[None])
        return self.proj(mixed.transpose(1, 2).flatten(2))


class _HistoryBlock(nn.Module):
    def __init__(self, dim: int, num_heads: int, window: int, length: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.attn = NeighborhoodAttention(dim, num_heads, window, length)
        self.mlp = Mlp(dim, 3 * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class _Downsample(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.reduction = Conv(dim, 2 * dim, stride=2, bias=False)
        self.norm = nn.LayerNorm(2 * dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.reduction(x))


class _Level(nn.Module):
    def __init__(self, index: int) -> None:
        super().__init__()
        dim, sizes = _WIDTHS[index], (_HEADS[index], _WINDOWS[index], _LENGTHS[index])
        self.blocks = nn.Sequential(*(_HistoryBlock(dim, *sizes) for _ in range(2)))
        self.downsample = _Downsample(dim) if index + 1 < len(_WIDTHS) else nn.Identity()


class HistoryEncoder(nn.Module):
    """One vector per agent from 20 steps of its history: a feature pyramid, read at its end."""

    def __init__(self) -> None:
        super().__init__()
        self.embed = nn.ModuleDict({"proj": Conv(HISTORY_CHANNELS, _WIDTHS[0])})
        self.levels = nn.ModuleList(_Level(index) for index in range(len(_WIDTHS)))
        self.norm0, self.norm1, self.norm2 = (nn.LayerNorm(width) for width in _WIDTHS)
        self.lateral_convs = nn.ModuleList(Conv(width, DIM) for width in _WIDTHS)
        self.fpn_conv = Conv(DIM, DIM)

    def forward(self, steps: Tensor) -> Tensor:
        """(A, 20, 9) to (A, 128)."""
        x = self.embed["proj"](steps)
        ends = []  # (A, 2, 128) by level: what the last step of the result depends on
        norms = (self.norm0, self.norm1, self.norm2)
        for level, norm, lateral in zip(self.levels, norms, self.lateral_convs, strict=True):
            assert isinstance(level, _Level)
            x = level.blocks(x)
            ends.append(lateral(norm(x[:, -3:]))[:, -2:])
            x = level.downsample(x)
        merged = ends.pop()
        while ends:
            near, last = merged[:, -2:-1], merged[:, -1:]  # twice as fine, by linear interpolation
            merged = ends.pop() + torch.cat([0.25 * near + 0.75 * last, last], dim=1)
        return self.fpn_conv(merged)[:, -1]


class EgoStateEncoder(nn.Module):
    """One vector from the scalars of the ego state: a learned query attends to a token for each."""

    def __init__(self) -> None:
        super().__init__()
        self.state_dropout = 0.75  # share of scalars that are not shown in training
        self.random: torch.Generator | None = None  # draws them; None for torch's own
        self.linears = nn.ModuleList(Linear(1, DIM) for _ in range(STATE_CHANNELS))
        self.attn = Attention(DIM, 4)
        self.pos_embed = nn.Parameter(0.02 * torch.randn(1, STATE_CHANNELS, DIM))
        self.query = nn.Parameter(0.02 * torch.randn(1, 1, DIM))

    def forward(self, state: Tensor) -> Tensor:
        """(B, >= 6) to (B, 128)."""
        each = (layer(state[:, i : i + 1]) for i, layer in enumerate(self.linears))
        tokens = torch.stack(list(each), dim=1) + self.pos_embed
        mask = None
        if self.training:
            shape = len(state), STATE_CHANNELS - _KNOWN_STATES
            drawn = torch.rand(shape, device=state.device, generator=self.random)
            shown = drawn >= self.state_dropout
            mask = key_mask(functional.pad(shown, (_KNOWN_STATES, 0), value=True))
        query = self.query.expand(len(state), -1, -1)
        return self.attn(query, tokens, tokens, mask)[:, 0]


class AgentEncoder(nn.Module):
    """Tokens of the ego and the agents, without their poses."""

    def __init__(self) -> None:
        super().__init__()
        self.history_encoder = HistoryEncoder()
        self.ego_state_emb = EgoStateEncoder()
        self.type_emb = nn.Embedding(NUM_AGENT_KINDS, DIM)

    def forward(self, scene: SceneTensors) -> Tensor:
        """(B, A, 128)."""
        steps, others = _history_steps(scene), scene.known[0].clone()
        others[:, 0] = False  # nuPlan rule 306: the ego's history is not used
        tokens = steps.new_zeros(*others.shape, DIM)
        if others.any():
            tokens[others] = self.history_encoder(steps[others])
        tokens[:, 0] = self.ego_state_emb(scene.current_state)
        return tokens + self.type_emb(scene.category)


def _history_steps(scene: SceneTensors) -> Tensor:
    """(B, A, 20, 9) what changed in each step of an agent's history."""
    both = scene.valid[..., 1:] & scene.valid[..., :-1]
    moved = scene.position.diff(dim=2).masked_fill(~both[..., None], 0.0)
    faster = scene.velocity.diff(dim=2).masked_fill(~both[..., None], 0.0)
    turned = scene.heading.diff(dim=2).masked_fill(~both, 0.0)
    directions = torch.stack([turned.cos(), turned.sin()], dim=-1)
    # nuPlan rule 304: changes count only between valid samples, but the shape counts always
    parts = [moved, faster, directions, scene.shape[:, :, 1:], both[..., None].to(moved.dtype)]
    return torch.cat(parts, dim=-1)


class PointsEncoder(nn.Module):
    """One vector per polyline from its valid points; rows of invalid points count as zeros."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first_mlp, self.second_mlp = (
            nn.Sequential(
                Linear(inputs, hidden), nn.BatchNorm1d(hidden), nn.ReLU(), Linear(hidden, outputs)
            )
            for inputs, hidden, outputs in ((channels, 128, 256), (512, 256, DIM))
        )

    def forward(self, points: Tensor, valid: Tensor) -> Tensor:
        """(B, M, K, channels) with `valid` (B, M, K) to (B, M, 128)."""
        known = valid.any(dim=-1)
        lines, of_lines = points[known], valid[known]
        # training takes the statistics of all of them; else few at once stay in the cache of a CPU
        at_once = LINES_AT_ONCE if not (self.training or points.is_cuda) else max(len(lines), 1)
        parts = zip(torch.split(lines, at_once), torch.split(of_lines, at_once), strict=True)
        tokens = points.new_zeros(*known.shape, DIM)
        tokens[known] = torch.cat([self._encode(*part) for part in parts])
        return tokens

    def _encode(self, points: Tensor, valid: Tensor) -> Tensor:
        """(M, K, channels) with `valid` (M, K) to (M, 128)."""
        first = self.first_mlp(points[valid])
        # the second part reads a point beside the maximum over its line, the same for all of them
        enter = self.second_mlp[0]
        assert isinstance(enter, Linear)
        own, of_line = torch.split(enter.weight, first.shape[1], dim=1)
        shared = linear(_pooled(first, valid), of_line)
        hidden = linear(first, own, enter.bias) + shared[valid.nonzero()[:, 0]]
        return _pooled(self.second_mlp[1:](hidden), valid)


def _pooled(values: Tensor, valid: Tensor) -> Tensor:
    """(M, C) maximum over the points of each line, of the values (T, C) of the valid ones."""
    dense = values.new_zeros(*valid.shape, values.shape[1])
    dense[valid] = values
    return dense.amax(dim=1)


class MapEncoder(nn.Module):
    """Tokens of the polygons, without their poses."""

    def __init__(self, channels: int, speed_limit_emb: nn.Module) -> None:
        super().__init__()
        self.polygon_encoder = PointsEncoder(channels)
        self.speed_limit_emb = speed_limit_emb
        self.type_emb, self.on_route_emb = nn.Embedding(3, DIM), nn.Embedding(2, DIM)
        self.traffic_light_emb = nn.Embedding(4, DIM)
        self.unknown_speed_emb = nn.Embedding(1, DIM)

    def forward(self, points: Tensor, scene: SceneTensors) -> Tensor:
        """(B, M, 128) from what is known of each point, (B, M, K, channels)."""
        tokens = self.polygon_encoder(points, scene.point_valid)
        known = self.speed_limit_emb(scene.limit[..., None])
        speed = torch.where(scene.has_limit[..., None], known, self.unknown_speed_emb.weight)
        tokens = tokens + self.type_emb(scene.kind) + self.on_route_emb(scene.on_route)
        return tokens + self.traffic_light_emb(scene.light) + speed
