"""PlanTF, PLUTO and CaRL as their papers draw them: what our networks are measured against.

Written from the descriptions alone with torch's own modules, under the names of the checkpoints, so
that weights load as they are: `torch.nn.MultiheadAttention`, batches filled up with rows that are
masked, and nothing of ours.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

DIM = 128


def plain_network(planner: str, network: nn.Module) -> nn.Module:
    """The plain network of a planner with the weights of ours."""
    made = {"plantf": PlainPlanTf, "pluto": PlainPluto, "carl": PlainCarl}[planner]().eval()
    made.load_state_dict(network.state_dict())
    return made


def mlp(*sizes: int, act: Callable[[], nn.Module] = nn.ReLU) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), act()]
    return nn.Sequential(*layers[:-1])


def normed(inputs: int, hidden: int, outputs: int, *, bias: bool = True) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden, bias=bias),
        nn.LayerNorm(hidden),
        nn.ReLU(),
        nn.Linear(hidden, outputs),
    )


class Mlp(nn.Module):
    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(dim, hidden), nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x)))


class Block(nn.Module):
    def __init__(self, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(DIM), nn.LayerNorm(DIM)
        self.attn = nn.MultiheadAttention(DIM, heads, batch_first=True)
        self.mlp = Mlp(DIM, 4 * DIM)

    def forward(self, x: Tensor, absent: Tensor) -> Tensor:
        y = self.norm1(x)
        x = x + self.attn(y, y, y, key_padding_mask=absent, need_weights=False)[0]
        return x + self.mlp(self.norm2(x))


class Neighbourhood(nn.Module):
    def __init__(self, dim: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads, self.window = heads, window
        self.rpb = nn.Parameter(torch.zeros(heads, 2 * window - 1))
        self.qkv, self.proj = nn.Linear(dim, 3 * dim), nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        count, length, dim = x.shape
        qkv = self.qkv(x).reshape(count, length, 3, self.heads, dim // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        start = (torch.arange(length) - self.window // 2).clamp(0, length - self.window)
        seen = start[:, None] + torch.arange(self.window)  # (L, window)
        bias = self.rpb[:, seen - torch.arange(length)[:, None] + self.window - 1]
        q = q * q.shape[-1] ** -0.5
        logits = (q[..., None, :] * k[:, :, seen]).sum(-1) + bias
        mixed = (logits.softmax(-1)[..., None] * v[:, :, seen]).sum(-2)
        return self.proj(mixed.transpose(1, 2).reshape(count, length, dim))


class HistoryBlock(nn.Module):
    def __init__(self, dim: int, heads: int, window: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.attn, self.mlp = Neighbourhood(dim, heads, window), Mlp(dim, 3 * dim)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class Downsample(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.reduction = nn.Conv1d(dim, 2 * dim, 3, stride=2, padding=1, bias=False)
        self.norm = nn.LayerNorm(2 * dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.norm(self.reduction(x.transpose(1, 2)).transpose(1, 2))


class Level(nn.Module):
    def __init__(self, dim: int, heads: int, window: int, *, last: bool) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(HistoryBlock(dim, heads, window) for _ in range(2))
        self.downsample = None if last else Downsample(dim)


class Embed(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.proj = nn.Conv1d(9, 32, 3, padding=1)


class History(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.embed = Embed()
        shapes = ((32, 2, 3), (64, 4, 3), (128, 8, 5))
        self.levels = nn.ModuleList(Level(*shape, last=shape[0] == DIM) for shape in shapes)
        self.norm0, self.norm1, self.norm2 = (nn.LayerNorm(shape[0]) for shape in shapes)
        self.lateral_convs = nn.ModuleList(
            nn.Conv1d(shape[0], DIM, 3, padding=1) for shape in shapes
        )
        self.fpn_conv = nn.Conv1d(DIM, DIM, 3, padding=1)

    def forward(self, steps: Tensor) -> Tensor:
        x = self.embed.proj(steps.transpose(1, 2)).transpose(1, 2)
        outs = []
        norms = (self.norm0, self.norm1, self.norm2)
        for level, norm, lateral in zip(self.levels, norms, self.lateral_convs, strict=True):
            for block in level.blocks:  # type: ignore[union-attr]
                x = block(x)
            outs.append(lateral(norm(x).transpose(1, 2)))
            if level.downsample is not None:
                x = level.downsample(x)  # type: ignore[operator]
        merged = outs[2]
        for out in (outs[1], outs[0]):
            merged = out + functional.interpolate(
                merged, scale_factor=2.0, mode="linear", align_corners=False
            )
        return self.fpn_conv(merged)[:, :, -1]


class EgoState(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.linears = nn.ModuleList(nn.Linear(1, DIM) for _ in range(6))
        self.attn = nn.MultiheadAttention(DIM, 4, batch_first=True)
        self.pos_embed = nn.Parameter(torch.zeros(1, 6, DIM))
        self.query = nn.Parameter(torch.zeros(1, 1, DIM))

    def forward(self, state: Tensor) -> Tensor:
        tokens = torch.stack([layer(state[:, i, None]) for i, layer in enumerate(self.linears)], 1)
        tokens = tokens + self.pos_embed
        query = self.query.repeat(len(state), 1, 1)
        return self.attn(query, tokens, tokens, need_weights=False)[0][:, 0]


class Agents(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.history_encoder, self.ego_state_emb = History(), EgoState()
        self.type_emb = nn.Embedding(4, DIM)

    def forward(self, seen: Any) -> Tensor:
        both = seen.valid[..., 1:] & seen.valid[..., :-1]
        there = seen.valid.any(-1)
        turned = torch.where(both, seen.heading.diff(dim=2), 0.0)
        parts = [
            torch.where(both[..., None], seen.position.diff(dim=2), 0.0),
            torch.where(both[..., None], seen.velocity.diff(dim=2), 0.0),
            torch.stack([turned.cos(), turned.sin()], -1),
            seen.shape[:, :, 1:],
            both[..., None].float(),
        ]
        steps = torch.cat(parts, -1)
        tokens = torch.zeros(*there.shape, DIM)
        tokens[there] = self.history_encoder(steps[there])
        tokens[:, 0] = self.ego_state_emb(seen.current_state[:, :6])
        return tokens + self.type_emb(seen.category)


class Points(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first_mlp, self.second_mlp = (
            nn.Sequential(nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU(), nn.Linear(b, c))
            for a, b, c in ((channels, 128, 256), (512, 256, DIM))
        )

    def forward(self, points: Tensor, keep: Tensor) -> Tensor:
        first = torch.zeros(*keep.shape, 256)
        first[keep] = self.first_mlp(points[keep])
        pooled = first.amax(-2, keepdim=True)
        both = torch.cat([first, pooled.expand_as(first)], -1)
        second = torch.zeros(*keep.shape, DIM)
        second[keep] = self.second_mlp(both[keep])
        return second.amax(-2)


class Map(nn.Module):
    def __init__(self, channels: int, speed: nn.Module) -> None:
        super().__init__()
        self.polygon_encoder, self.speed_limit_emb = Points(channels), speed
        self.type_emb, self.on_route_emb = nn.Embedding(3, DIM), nn.Embedding(2, DIM)
        self.traffic_light_emb, self.unknown_speed_emb = nn.Embedding(4, DIM), nn.Embedding(1, DIM)

    def forward(self, points: Tensor, seen: Any) -> Tensor:
        tokens = self.polygon_encoder(points, seen.point_valid)
        limit = self.speed_limit_emb(seen.limit[..., None])
        limit = torch.where(seen.has_limit[..., None], limit, self.unknown_speed_emb.weight)
        tokens = tokens + self.type_emb(seen.kind) + self.on_route_emb(seen.on_route)
        return tokens + self.traffic_light_emb(seen.light) + limit


def _lines(middle: Tensor, origin: Tensor, vectors: Tensor, angle: Tensor) -> list[Tensor]:
    return [middle - origin, vectors, torch.stack([angle.cos(), angle.sin()], -1)]


def _poses(seen: Any) -> Tensor:
    now = torch.cat([seen.position[:, :, -1], seen.heading[:, :, -1:]], -1)
    return torch.cat([now, seen.centers], 1)


class Decoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.multimodal_proj = nn.Linear(DIM, 6 * DIM)
        self.loc, self.pi = normed(DIM, 256, 320), normed(DIM, 256, 1)


class PlainPlanTf(nn.Module):
    """PlanTF."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_emb = mlp(4, DIM, DIM)
        self.agent_encoder, self.map_encoder = Agents(), Map(6, mlp(1, DIM, DIM))
        self.encoder_blocks = nn.ModuleList(Block(8) for _ in range(4))
        self.norm, self.trajectory_decoder = nn.LayerNorm(DIM), Decoder()
        self.agent_predictor = normed(DIM, 256, 160, bias=False)

    def forward(self, seen: Any) -> tuple[Tensor, Tensor]:
        """(B, 6, 80, 4) and (B, 6)."""
        pose = _poses(seen)
        where = torch.cat([pose[..., :2], pose[..., 2:].cos(), pose[..., 2:].sin()], -1)
        centers = seen.centers[:, :, None, :2]
        points = torch.cat(_lines(seen.points, centers, seen.vectors, seen.orientations), -1)
        x = torch.cat([self.agent_encoder(seen), self.map_encoder(points, seen)], 1)
        x = x + self.pos_emb(where)
        absent = ~torch.cat([seen.valid.any(-1), seen.point_valid.any(-1)], 1)
        for block in self.encoder_blocks:
            x = block(x, absent)
        x = self.norm(x)
        self.agent_predictor(x[:, 1 : seen.valid.shape[1]])  # no plan needs it
        head = self.trajectory_decoder
        modes = head.multimodal_proj(x[:, 0]).view(-1, 6, DIM)
        return head.loc(modes).view(-1, 6, 80, 4), head.pi(modes)[..., 0]


class Fourier(nn.Module):
    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.freqs = nn.Embedding(inputs, 64)
        self.mlps = nn.ModuleList(normed(129, DIM, DIM) for _ in range(inputs))
        self.to_out = nn.Sequential(nn.LayerNorm(DIM), nn.ReLU(), nn.Linear(DIM, DIM))

    def forward(self, x: Tensor) -> Tensor:
        turn = x[..., None] * self.freqs.weight * (2.0 * torch.pi)
        waves = torch.cat([turn.cos(), turn.sin(), x[..., None]], -1)
        parts = [layer(waves[..., i, :]) for i, layer in enumerate(self.mlps)]
        return self.to_out(torch.stack(parts).sum(0))


class Head(nn.Module):
    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.mlp = normed(DIM, hidden, outputs)

    def forward(self, x: Tensor) -> Tensor:
        return self.mlp(x)


class Static(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.obj_encoder, self.type_emb = Fourier(2), nn.Embedding(4, DIM)


class Predictor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        heads = (Head(256, 160) for _ in range(3))
        self.loc_predictor, self.yaw_predictor, self.vel_predictor = heads


class DecoderBlock(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        attends = (nn.MultiheadAttention(DIM, 4, batch_first=True) for _ in range(3))
        self.r2r_attn, self.m2m_attn, self.cross_attn = attends
        self.ffn = nn.Sequential(nn.Linear(DIM, 512), nn.ReLU(), nn.Identity(), nn.Linear(512, DIM))
        self.norm1, self.norm2, self.norm3, self.norm4 = (nn.LayerNorm(DIM) for _ in range(4))

    def forward(
        self, x: Tensor, place: Tensor, line_absent: Tensor, tokens: Tensor, absent: Tensor
    ) -> Tensor:
        batch, lines, modes, _ = x.shape
        y = x.transpose(1, 2).reshape(batch * modes, lines, DIM)
        z = self.norm1(y)
        mask = line_absent.repeat_interleave(modes, 0)  # lines of the scene, mode by mode
        y = y + self.r2r_attn(z, z, z, key_padding_mask=mask, need_weights=False)[0]
        x = y.view(batch, modes, lines, DIM).transpose(1, 2)
        there = ~line_absent
        y = x[there]
        z = self.norm2(y)
        y = y + self.m2m_attn(z + place, z + place, z, need_weights=False)[0]
        x = torch.zeros_like(x)
        x[there] = y
        y = x.reshape(batch, lines * modes, DIM)
        y = (
            y
            + self.cross_attn(
                self.norm3(y), tokens, tokens, key_padding_mask=absent, need_weights=False
            )[0]
        )
        return (y + self.ffn(self.norm4(y))).view(x.shape)


class LineDecoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.r_encoder, self.r_pos_emb = Points(6), Fourier(3)
        self.q_proj, self.cat_x_proj = nn.Linear(2 * DIM, DIM), nn.Linear(2 * DIM, DIM)
        self.m_emb = nn.Parameter(torch.zeros(1, 1, 12, DIM))
        self.m_pos = nn.Parameter(torch.zeros(1, 12, DIM))
        self.decoder_blocks = nn.ModuleList(DecoderBlock() for _ in range(4))
        self.loc_head, self.yaw_head, self.vel_head = (Head(256, 160) for _ in range(3))
        self.pi_head = Head(DIM, 1)

    def forward(self, seen: Any, tokens: Tensor, absent: Tensor) -> tuple[Tensor, Tensor]:
        points, angle = seen.line_points, seen.line_orientations
        first = points[:, :, :1]
        parts = torch.cat(_lines(points, first, seen.line_vectors, angle), -1)
        start = torch.cat([first[:, :, 0], angle[..., :1]], -1)
        lines = self.r_encoder(parts, seen.line_valid) + self.r_pos_emb(start)
        shape = (*lines.shape[:2], 12, DIM)
        modes = self.m_emb.expand(shape)
        x = self.q_proj(torch.cat([lines[:, :, None].expand(shape), modes], -1))
        line_absent = ~seen.line_valid.any(-1)
        for block in self.decoder_blocks:
            x = block(x, self.m_pos, line_absent, tokens, absent)
        x = self.cat_x_proj(torch.cat([x, tokens[:, None, None, 0].expand(shape)], -1))
        heads = (self.loc_head, self.yaw_head, self.vel_head)
        plans = torch.cat([head(x).view(*shape[:3], 80, 2) for head in heads], -1)
        return plans, self.pi_head(x)[..., 0].masked_fill(line_absent[..., None], -1e6)


class PlainPluto(nn.Module):
    """PLUTO."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_emb, self.agent_encoder = Fourier(3), Agents()
        self.map_encoder, self.static_objects_encoder = Map(10, Fourier(1)), Static()
        self.encoder_blocks = nn.ModuleList(Block(4) for _ in range(4))
        self.norm, self.agent_predictor = nn.LayerNorm(DIM), Predictor()
        self.planning_decoder = LineDecoder()
        self.hidden_proj, self.ref_free_decoder = mlp(DIM, DIM, DIM), Head(256, 320)

    def forward(self, seen: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(B, R, 12, 80, 6), (B, R, 12), (B, A - 1, 80, 6) and (B, 80, 4)."""
        middle, left, right = seen.points.unbind(2)
        centers = seen.centers[:, :, None, :2]
        along = _lines(middle, centers, seen.vectors, seen.orientations)
        points = torch.cat([*along, left - middle, right - middle], -1)
        net = self.static_objects_encoder
        static = net.obj_encoder(seen.object_shape) + net.type_emb(seen.object_category)
        static = torch.where(seen.object_valid[..., None], static, 0.0)
        pose = torch.cat([_poses(seen), seen.object_pose], 1)
        angle = (pose[..., 2:] + torch.pi) % (2.0 * torch.pi) - torch.pi
        x = torch.cat([self.agent_encoder(seen), self.map_encoder(points, seen), static], 1)
        x = x + self.pos_emb(torch.cat([pose[..., :2], angle], -1))
        there = [seen.valid.any(-1), seen.point_valid.any(-1), seen.object_valid]
        absent = ~torch.cat(there, 1)
        for block in self.encoder_blocks:
            x = block(x, absent)
        x = self.norm(x)
        agents = x[:, 1 : seen.valid.shape[1]]
        net = self.agent_predictor
        heads = (net.loc_predictor, net.yaw_predictor, net.vel_predictor)
        motion = torch.cat([head(agents).view(*agents.shape[:2], 80, 2) for head in heads], -1)
        free = self.ref_free_decoder(x[:, 0]).view(-1, 80, 4)
        return *self.planning_decoder(seen, x, absent), motion, free


class Extractor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels, size = 9, 256
        for out, kernel, stride in (
            *((8, 5, 2), (16, 5, 2), (24, 5, 2), (32, 5, 2)),
            *((64, 3, 2), (128, 3, 1), (256, 3, 1)),
        ):
            size = (size - kernel) // stride + 1
            norm = nn.LayerNorm((out, size, size))
            layers += [nn.Conv2d(channels, out, kernel, stride), norm, nn.ReLU()]
            channels = out
        self.cnn = nn.Sequential(*layers, nn.Flatten())
        self.linear, self.state_linear = _layers(1280, 512, 256), _layers(10, 256, 256)


def _layers(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


class PlainCarl(nn.Module):
    """CaRL's policy; the critic's weights are held, and it is not asked."""

    def __init__(self) -> None:
        super().__init__()
        self.features_extractor, self.policy_head = Extractor(), _layers(256, 256, 256)
        self.dist_mu, self.dist_sigma = (nn.Sequential(nn.Linear(256, 2)) for _ in range(2))
        self.value_head = nn.Sequential(*_layers(260, 256, 256), nn.Linear(256, 1))
        self.action_dist = nn.Module()
        for name in ("suggest_go", "suggest_stop", "suggest_turn"):
            self.action_dist.register_buffer(name, torch.zeros(2))
        for name in ("action_space_low", "action_space_high"):
            self.register_buffer(name, torch.zeros(2))

    def forward(self, pictures: Tensor, measurements: Tensor) -> Tensor:
        """(B, 2) actions in [-1, 1]."""
        net = self.features_extractor
        seen = net.cnn(pictures / 255.0)
        hidden = self.policy_head(net.linear(torch.cat([seen, net.state_linear(measurements)], 1)))
        alpha, beta = (
            functional.softplus(h(hidden)) + 1.0 for h in (self.dist_mu, self.dist_sigma)
        )
        return 2.0 * (alpha / (alpha + beta)) - 1.0
