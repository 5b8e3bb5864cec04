"""Blocks that the networks of PlanTF and PLUTO share; names and shapes as in their checkpoints.

Only inference is meant: no dropout, no drop path. What the official code computes and then throws
away is not computed here: the ego's own history, and all but the last step of an agent's.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.network.rows import (
    Attention,
    Linear,
    Mlp,
    Scenes,
    by_columns,
    linear,
)

DIM = 128
NUM_AGENT_KINDS = 4
HISTORY_CHANNELS = 9
STATE_CHANNELS = 6  # of the ego state that are read
# by level of the history encoder
_WIDTHS, _HEADS, _WINDOWS, _LENGTHS = (32, 64, 128), (2, 4, 8), (3, 3, 5), (20, 10, 5)
_MLP_RATIO = 3  # of the history encoder
_LINES_AT_ONCE = 64  # on a CPU: what is computed for them stays in its cache


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
    def there(self) -> tuple[Tensor, Tensor]:
        """Agents (B, A) and polygons (B, M) of which anything is known."""
        return self.valid.any(dim=-1), self.point_valid.any(dim=-1)

    @property
    def poses(self) -> Tensor:
        """(B, A + M, 3) of the agents now, and of the polygons."""
        now = torch.cat([self.position[:, :, -1], self.heading[:, :, -1:]], dim=-1)
        return torch.cat([now, self.centers], dim=1)


class Prepared(nn.Module):
    """A module that computes with numbers made from its weights, as joined layers are.

    They are made once for inference, and each time in training, where weights change.
    """

    def __init__(self) -> None:
        super().__init__()
        self._kept: Any = None
        self.register_load_state_dict_post_hook(_forget)  # type: ignore[no-untyped-call]

    def prepared(self) -> Any:
        """What `prepare` gives, kept until other weights are loaded."""
        if not torch.is_inference_mode_enabled():
            return self.prepare()
        if self._kept is None:
            self._kept = self.prepare()
        return self._kept

    def prepare(self) -> Any:
        """What depends on the weights alone."""
        raise NotImplementedError


def _forget(module: Prepared, keys: object) -> None:
    """Called when a module has got other weights."""
    module._kept = None


class EncoderBlock(nn.Module):
    """Pre-norm transformer block."""

    def __init__(self, num_heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(DIM)
        self.attn = Attention(DIM, num_heads)
        self.norm2 = nn.LayerNorm(DIM)
        self.mlp = Mlp(DIM, 4 * DIM, DIM)

    def forward(self, x: Tensor, scenes: Scenes, asking: Tensor | None = None) -> Tensor:
        """Tokens (T, D) of scenes after the block, or those (B,) that are asked for alone."""
        normed = self.norm1(x)
        if asking is None:
            x = x + self.attn.among(normed, normed, scenes.counts, scenes)
        else:
            ones = [1] * len(asking)
            x = x[asking] + self.attn.among(normed[asking], normed, ones, scenes)
        return x + self.mlp(self.norm2(x))


class NeighborhoodAttention(Prepared):
    """Attention along a sequence to the `window` nearest positions; windows shift at the ends."""

    def __init__(self, dim: int, num_heads: int, window: int, length: int) -> None:
        super().__init__()
        self.num_heads, self.window, self.length = num_heads, window, length
        self.rpb = nn.Parameter(torch.zeros(num_heads, 2 * window - 1))
        self.qkv = Linear(dim, 3 * dim)
        self.proj = Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        """(A * length, D) to the same."""
        qkv = self.qkv(x).view(-1, self.length, 3, self.num_heads, x.shape[1] // self.num_heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(q, k, v, attn_mask=self.prepared())
        return self.proj(mixed.transpose(1, 2).reshape(x.shape))

    def prepare(self) -> Tensor:
        """(1, heads, L, L) logits added to a pair of positions, -inf outside of the window."""
        positions = torch.arange(self.length, device=self.rpb.device)
        first = (positions - self.window // 2).clamp(0, self.length - self.window)
        ahead = positions[None, :] - first[:, None]
        offset = positions[None, :] - positions[:, None] + self.window - 1
        bias = self.rpb[:, offset.clamp(0, 2 * self.window - 2)]
        return bias.masked_fill((ahead < 0) | (ahead >= self.window), -torch.inf)[None]


class _HistoryBlock(nn.Module):
    def __init__(self, dim: int, num_heads: int, window: int, length: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim)
        self.attn = NeighborhoodAttention(dim, num_heads, window, length)
        self.norm2 = nn.LayerNorm(dim)
        self.mlp = Mlp(dim, _MLP_RATIO * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class _Downsample(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.reduction = nn.Conv1d(dim, 2 * dim, 3, stride=2, padding=1, bias=False)
        self.norm = nn.LayerNorm(2 * dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(_convolved(self.reduction, functional.pad(x, (0, 0, 1, 1)), 2))


class _Level(nn.Module):
    def __init__(self, index: int) -> None:
        super().__init__()
        dim, sizes = _WIDTHS[index], (_HEADS[index], _WINDOWS[index], _LENGTHS[index])
        self.blocks = nn.ModuleList(_HistoryBlock(dim, *sizes) for _ in range(2))
        self.downsample = _Downsample(dim) if index + 1 < len(_WIDTHS) else None

    def forward(self, x: Tensor) -> Tensor:
        rows = x.flatten(0, 1)
        for block in self.blocks:
            rows = block(rows)
        return rows.view(x.shape)


class _Embed(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.proj = nn.Conv1d(HISTORY_CHANNELS, _WIDTHS[0], 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return _convolved(self.proj, functional.pad(x, (0, 0, 1, 1)))


class HistoryEncoder(Prepared):
    """One vector per agent from 20 steps of its history: a feature pyramid, read at the end.

    The vector depends on the last three steps of each level, and on these as one product does.
    """

    def __init__(self) -> None:
        super().__init__()
        self.embed = _Embed()
        self.levels = nn.ModuleList(_Level(index) for index in range(len(_WIDTHS)))
        self.norm0, self.norm1, self.norm2 = (nn.LayerNorm(width) for width in _WIDTHS)
        self.lateral_convs = nn.ModuleList(nn.Conv1d(width, DIM, 3, padding=1) for width in _WIDTHS)
        self.fpn_conv = nn.Conv1d(DIM, DIM, 3, padding=1)

    def forward(self, steps: Tensor) -> Tensor:
        """(A, 20, 9) to (A, 128)."""
        x = self.embed(steps)
        ends = []
        for level, norm in zip(self.levels, (self.norm0, self.norm1, self.norm2), strict=True):
            assert isinstance(level, _Level)
            x = level(x)
            ends.append(norm(x[:, -3:]).flatten(1))
            if level.downsample is not None:
                x = level.downsample(x)
        return linear(torch.cat(ends, dim=1), *self.prepared())

    def prepare(self) -> tuple[Tensor, Tensor]:
        """Weight (128, 672) and bias (128,) of the product: what unit vectors and zeros give."""
        weight = self.fpn_conv.weight
        sizes = [3 * width for width in _WIDTHS]
        units = torch.eye(sum(sizes) + 1, dtype=torch.float64, device=weight.device)[:, :-1]
        merged: Tensor | None = None
        parts = zip(torch.split(units, sizes, dim=1), self.lateral_convs, strict=True)
        for end, lateral in reversed([*parts]):
            own = _end(lateral, end.reshape(len(units), 3, -1))
            merged = own if merged is None else own + _upsampled_end(merged)
        assert merged is not None
        out = _end(self.fpn_conv, merged)[:, 0]
        return by_columns((out[:-1] - out[-1]).t()).to(weight.dtype), out[-1].to(weight.dtype)


def _convolved(conv: nn.Module, x: Tensor, stride: int = 1) -> Tensor:
    """Convolution of width 3 without padding, (A, L, C) to (A, L', C'), as one product."""
    assert isinstance(conv, nn.Conv1d)
    windows = x.unfold(1, 3, stride).flatten(2)
    return linear(windows, conv.weight.flatten(1), conv.bias)


def _end(conv: nn.Module, end: Tensor) -> Tensor:
    """The last k - 1 steps of a padded convolution, of the last k steps before it (A, k, C)."""
    assert isinstance(conv, nn.Conv1d)
    assert conv.bias is not None
    windows = functional.pad(end, (0, 0, 0, 1)).unfold(1, 3, 1).flatten(2)
    return windows @ conv.weight.to(end.dtype).flatten(1).t() + conv.bias


def _upsampled_end(end: Tensor) -> Tensor:
    """The last two steps of a sequence upsampled linearly by 2, of its last two steps."""
    before, last = end[:, 0], end[:, 1]
    return torch.stack([0.25 * before + 0.75 * last, last], dim=1)


class EgoStateEncoder(Prepared):
    """One vector from the scalars of the ego state: a learned query attends to a token for each.

    A token is a straight line in its scalar. So are the query's logits, and what is mixed.
    """

    def __init__(self) -> None:
        super().__init__()
        self.linears = nn.ModuleList(Linear(1, DIM) for _ in range(STATE_CHANNELS))
        self.attn = Attention(DIM, 4)
        self.pos_embed = nn.Parameter(torch.zeros(1, STATE_CHANNELS, DIM))
        self.query = nn.Parameter(torch.zeros(1, 1, DIM))

    def forward(self, state: Tensor) -> Tensor:
        """(B, >= 6) to (B, 128)."""
        start, slope, mixing = self.prepared()
        scalars = state[:, None, :STATE_CHANNELS]
        weights = torch.addcmul(start, slope, scalars).softmax(dim=-1)
        read = torch.cat([weights, weights * scalars], dim=-1).flatten(1)
        return linear(read, mixing, self.attn.out_proj.bias)

    def prepare(self) -> tuple[Tensor, Tensor, Tensor]:
        """Logits (heads, 6) where scalars are zero, their slopes, and what is mixed (128, 48)."""
        attn, layers = self.attn, [layer for layer in self.linears if isinstance(layer, Linear)]
        starts = (torch.stack([layer.bias for layer in layers]) + self.pos_embed[0]).double()
        slopes = torch.cat([layer.weight for layer in layers], dim=1).t().double()
        by_head = (-1, attn.num_heads, attn.width)

        def read(weight: Tensor, bias: Tensor) -> Tensor:
            both = [starts @ weight.t() + bias, slopes @ weight.t()]
            return torch.cat(both).view(by_head)  # (12, heads, width)

        ask, key, value = attn.in_proj_weight.double().chunk(3)
        ask_bias, key_bias, value_bias = attn.in_proj_bias.double().chunk(3)
        query = (self.query[0].double() @ ask.t() + ask_bias).view(by_head)
        logits = (read(key, key_bias) * query).sum(-1).t() / math.sqrt(attn.width)
        out = attn.out_proj.weight.double().view(by_head)
        mixing = torch.einsum("ohw,thw->oht", out, read(value, value_bias)).flatten(1)
        start, slope = logits.chunk(2, dim=1)
        kind = self.query.dtype
        return start.to(kind), slope.to(kind), mixing.to(kind)


class AgentEncoder(nn.Module):
    """Tokens of the ego and the agents, without their poses."""

    def __init__(self) -> None:
        super().__init__()
        self.history_encoder = HistoryEncoder()
        self.ego_state_emb = EgoStateEncoder()
        self.type_emb = nn.Embedding(NUM_AGENT_KINDS, DIM)

    def forward(self, seen: SceneTensors) -> Tensor:
        """(B, A, 128)."""
        steps, (others, _) = _history_steps(seen), seen.there
        others[:, 0] = False  # nuPlan rule 306: the ego's history is not used
        tokens = steps.new_zeros(*others.shape, DIM)
        if others.any():
            tokens[others] = self.history_encoder(steps[others])
        tokens[:, 0] = self.ego_state_emb(seen.current_state)
        return tokens + self.type_emb(seen.category)


def _history_steps(seen: SceneTensors) -> Tensor:
    """(B, A, 20, 9) what changed in each step of an agent's history."""
    both = seen.valid[..., 1:] & seen.valid[..., :-1]
    moved = seen.position.diff(dim=2).masked_fill(~both[..., None], 0.0)
    faster = seen.velocity.diff(dim=2).masked_fill(~both[..., None], 0.0)
    turned = seen.heading.diff(dim=2).masked_fill(~both, 0.0)
    directions = torch.stack([turned.cos(), turned.sin()], -1)
    # nuPlan rule 304: changes count only between valid samples, but the shape counts always
    parts = [moved, faster, directions, seen.shape[:, :, 1:]]
    return torch.cat([*parts, both[..., None].to(moved.dtype)], dim=-1)


class PointsEncoder(Prepared):
    """One vector per polyline from its valid points; rows of invalid points count as zeros."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first_mlp = _points_mlp(channels, 128, 256)
        self.second_mlp = _points_mlp(512, 256, DIM)

    def forward(self, points: Tensor, keep: Tensor) -> Tensor:
        """(B, M, K, channels) with `keep` (B, M, K) to (B, M, 128)."""
        lines, valid = points.flatten(0, 1), keep.flatten(0, 1)
        size = _LINES_AT_ONCE if points.device.type == "cpu" else max(len(lines), 1)
        layers = self.prepared()
        parts = zip(torch.split(lines, size), torch.split(valid, size), strict=True)
        encoded = torch.cat([_encode_lines(*part, layers) for part in parts])
        return encoded.reshape(*keep.shape[:2], encoded.shape[1])

    def prepare(self) -> "_Layers":
        """The layers of both parts."""
        return _joined(self.first_mlp, self.second_mlp)


class _Layers(NamedTuple):
    """Layers of an encoder, with normalisation in the one before, joined where no ReLU is between.

    The second part reads a point and what its line says, which is the same for all of its points.
    """

    enter: tuple[Tensor, Tensor]  # weight and bias: (channels) to (128)
    leave: nn.Module  # (128) to (256), of which the line has the maximum
    own: Tensor  # (256, 128) weight from within the first part to within the second one
    line: tuple[Tensor, Tensor]  # weight and bias: the maximum (256) to (256)
    last: nn.Module  # (256) to the outputs


def _joined(first: nn.Sequential, second: nn.Sequential) -> _Layers:
    weight, bias = _folded(second)
    leave = first[3]
    assert isinstance(leave, Linear)
    half = leave.out_features
    # rounded once
    own = weight[:, :half].double() @ leave.weight.double()
    line_bias = bias.double() + weight[:, :half].double() @ leave.bias.double()
    line = weight[:, half:], line_bias.to(bias.dtype)
    return _Layers(_folded(first), leave, own.to(weight.dtype), line, second[3])


def _folded(mlp: nn.Sequential) -> tuple[Tensor, Tensor]:
    """Weight and bias of the first layer with the normalisation in them."""
    layer, norm, _, _ = mlp
    assert isinstance(layer, Linear)
    assert isinstance(norm, nn.BatchNorm1d)
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
    return layer.weight * scale[:, None], (layer.bias - norm.running_mean) * scale + norm.bias


def _encode_lines(points: Tensor, keep: Tensor, layers: _Layers) -> Tensor:
    """(M, out) from (M, K, channels) with `keep` (M, K)."""
    (row,) = torch.nonzero(keep.flatten(), as_tuple=True)
    inner = linear(points.flatten(0, 1).index_select(0, row), *layers.enter).relu_()
    pooled = _pooled(layers.leave(inner), row, keep)
    mixed = linear(inner, layers.own)
    mixed += linear(pooled, *layers.line).index_select(0, row // keep.shape[1])
    return _pooled(layers.last(mixed.relu_()), row, keep)


def _points_mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        Linear(inputs, hidden), nn.BatchNorm1d(hidden), nn.ReLU(), Linear(hidden, outputs)
    )


def _pooled(values: Tensor, row: Tensor, keep: Tensor) -> Tensor:
    """(M, C) maximum over the points of each line; points without a value count as zero."""
    dense = values.new_zeros(keep.numel(), values.shape[1])
    dense.index_add_(0, row, values)  # twice as quick as to copy
    return dense.reshape(*keep.shape, values.shape[1]).amax(dim=1)


class MapEncoder(nn.Module):
    """Tokens of the polygons, without their poses."""

    def __init__(self, channels: int, speed_limit_emb: nn.Module) -> None:
        super().__init__()
        self.polygon_encoder = PointsEncoder(channels)
        self.speed_limit_emb = speed_limit_emb
        self.type_emb = nn.Embedding(3, DIM)
        self.on_route_emb = nn.Embedding(2, DIM)
        self.traffic_light_emb = nn.Embedding(4, DIM)
        self.unknown_speed_emb = nn.Embedding(1, DIM)

    def forward(self, points: Tensor, seen: SceneTensors) -> Tensor:
        """(B, M, 128) from what is known of each point, (B, M, K, channels)."""
        tokens = self.polygon_encoder(points, seen.point_valid)
        known = self.speed_limit_emb(seen.limit[..., None])
        speed = torch.where(seen.has_limit[..., None], known, self.unknown_speed_emb.weight)
        tokens = tokens + self.type_emb(seen.kind) + self.on_route_emb(seen.on_route)
        return tokens + self.traffic_light_emb(seen.light) + speed


def along_line(middle: Tensor, seen: SceneTensors) -> list[Tensor]:
    """Of each point of the centre lines (B, M, K, 2): place, vector and direction, each (…, 2)."""
    angle = seen.orientations
    directions = torch.stack([angle.cos(), angle.sin()], dim=-1)
    return [middle - seen.centers[:, :, None, :2], seen.vectors, directions]
