"""Encoders that PlanTF and PLUTO share: of histories, of the ego state, of lines and polygons.

Names and shapes of all tensors are those of the official checkpoints.
"""

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.network import (
    DIM,
    Attention,
    Conv,
    Linear,
    Mlp,
    SceneTensors,
    key_mask,
    linear,
)

NUM_AGENT_KINDS = 4
HISTORY_CHANNELS = 9
STATE_CHANNELS = 6  # of the ego state that are read
_KNOWN_STATES = 3  # of these that are never dropped in training: the pose
LINES_AT_ONCE = 64
# by level of the history encoder
_WIDTHS, _HEADS, _WINDOWS, _LENGTHS = (32, 64, 128), (2, 4, 8), (3, 3, 5), (20, 10, 5)


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


def _level(index: int) -> nn.ModuleDict:
    """Blocks of a level, and what leads to the next one."""
    dim, sizes = _WIDTHS[index], (_HEADS[index], _WINDOWS[index], _LENGTHS[index])
    blocks = nn.Sequential(_HistoryBlock(dim, *sizes), _HistoryBlock(dim, *sizes))
    level = nn.ModuleDict({"blocks": blocks})
    if index + 1 < len(_WIDTHS):
        reduction = Conv(dim, 2 * dim, stride=2, bias=False)
        parts = OrderedDict(reduction=reduction, norm=nn.LayerNorm(2 * dim))
        level["downsample"] = nn.Sequential(parts)
    return level


class HistoryEncoder(nn.Module):
    """One vector per agent from 20 steps of its history: a feature pyramid, read at its end."""

    def __init__(self) -> None:
        super().__init__()
        self.embed = nn.ModuleDict({"proj": Conv(HISTORY_CHANNELS, _WIDTHS[0])})
        self.levels = nn.ModuleList(_level(index) for index in range(len(_WIDTHS)))
        self.norm0, self.norm1, self.norm2 = (nn.LayerNorm(width) for width in _WIDTHS)
        self.lateral_convs = nn.ModuleList(Conv(width, DIM) for width in _WIDTHS)
        self.fpn_conv = Conv(DIM, DIM)

    def forward(self, steps: Tensor) -> Tensor:
        """(A, 20, 9) to (A, 128)."""
        x = self.embed["proj"](steps)
        ends = []  # (A, 2, 128) by level: what the last step of the result depends on
        norms = (self.norm0, self.norm1, self.norm2)
        for level, norm, lateral in zip(self.levels, norms, self.lateral_convs, strict=True):
            assert isinstance(level, nn.ModuleDict)
            x = level["blocks"](x)
            ends.append(lateral(norm(x[:, -3:]))[:, -2:])
            x = level["downsample"](x) if "downsample" in level else x
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
