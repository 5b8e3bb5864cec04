"""Layers of the Diffusion Planner: the encoder of a scene, and the diffusion transformer (DiT).

The encoder makes one token of each agent, static object and lane; unused rows are not computed, and
make zero tokens. The transformer refines trajectories of the ego and its neighbours.
"""

import math
from collections import OrderedDict
from typing import NamedTuple

import torch
from torch import Tensor, nn

from shiftsim.planners.learned.network import Attention, Linear, Mlp, key_mask

AGENT_COLUMNS, STATIC_COLUMNS, LANE_COLUMNS, LIGHT_COLUMNS = 8, 10, 8, 4
AGENT_KINDS = 3
SAMPLES, POINTS = 21, 20  # of a history, of a lane
POSITION = 7  # x, y, cos, sin, and one-hot agent, static object, lane
TOKENS, CHANNELS = 64, 128  # inside the mixers
MIDDLE = 10  # point of a lane that stands for its position
POSES = 81  # of a trajectory, the present one included
ROUTE_LANES = 25
ROUTE_COLUMNS, ROUTE_TOKENS, ROUTE_CHANNELS = 4, 32, 64
FREQUENCIES, LONGEST = 128, 10000.0  # of the time embedding


def over_rows(mlp: Mlp, x: Tensor) -> Tensor:
    """An MLP over the last but one dimension: (B, inputs, C) to (B, outputs, C)."""
    first, second = (layer.weight.expand(len(x), -1, -1) for layer in (mlp.fc1, mlp.fc2))
    hidden = mlp.act(torch.baddbmm(mlp.fc1.bias[:, None], first, x))
    return torch.baddbmm(mlp.fc2.bias[:, None], second, hidden)


class Mixer(nn.Module):
    """One mixer block: an MLP over the tokens, then one over the channels."""

    def __init__(self, tokens: int, channels: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(channels), nn.LayerNorm(channels)
        self.channels_mlp = Mlp(channels, channels, channels)
        self.tokens_mlp = Mlp(tokens, tokens, tokens)

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, C) to the same."""
        x = x + over_rows(self.tokens_mlp, self.norm1(x))
        return x + self.channels_mlp(self.norm2(x))


class MixerEncoder(nn.Module):
    """What agents and lanes have in common: samples to tokens, mixer blocks, their mean."""

    def __init__(self, columns: int, samples: int, hidden: int, depth: int) -> None:
        super().__init__()
        self.channel_pre_project = Mlp(columns, CHANNELS, CHANNELS)
        self.token_pre_project = Mlp(samples, TOKENS, TOKENS)
        self.blocks = nn.Sequential(*(Mixer(TOKENS, CHANNELS) for _ in range(depth)))
        self.norm = nn.LayerNorm(CHANNELS)
        self.emb_project = Mlp(CHANNELS, hidden, hidden)

    def mean(self, x: Tensor) -> Tensor:
        """(N, samples, columns) to (N, CHANNELS)."""
        tokens = over_rows(self.token_pre_project, self.channel_pre_project(x))
        return self.blocks(tokens).mean(dim=1)

    def token(self, x: Tensor) -> Tensor:
        """(N, CHANNELS) to (N, hidden)."""
        return self.emb_project(self.norm(x))


class AgentEncoder(MixerEncoder):
    """Histories of agents to tokens."""

    def __init__(self, hidden: int, depth: int) -> None:
        super().__init__(AGENT_COLUMNS + 1, SAMPLES, hidden, depth)
        self.type_emb = Linear(AGENT_KINDS, CHANNELS)

    def forward(self, agents: Tensor) -> Tensor:
        """(N, samples, 11) of used rows to (N, hidden)."""
        motion = agents[..., :AGENT_COLUMNS]
        present = (motion != 0.0).any(dim=-1, keepdim=True).to(motion.dtype)
        x = self.mean(torch.cat([motion, present], dim=-1))
        return self.token(x + self.type_emb(agents[:, -1, AGENT_COLUMNS:]))


class LaneEncoder(MixerEncoder):
    """Lanes to tokens."""

    def __init__(self, hidden: int, depth: int) -> None:
        super().__init__(LANE_COLUMNS, POINTS, hidden, depth)
        self.speed_limit_emb = Linear(1, CHANNELS)
        self.unknown_speed_emb = nn.Embedding(1, CHANNELS)
        self.traffic_emb = Linear(LIGHT_COLUMNS, CHANNELS)

    def forward(self, lanes: Tensor, limit: Tensor, has_limit: Tensor) -> Tensor:
        """(N, points, 12) of used rows, their limits (N, 1) and whether known, to (N, hidden)."""
        speed = torch.where(has_limit, self.speed_limit_emb(limit), self.unknown_speed_emb.weight)
        light = self.traffic_emb(lanes[:, 0, LANE_COLUMNS:])
        return self.token(self.mean(lanes[..., :LANE_COLUMNS]) + speed + light)


class FusionBlock(nn.Module):
    """Self-attention in which keys and values are not normalised (nuPlan rule 338), and an MLP."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(hidden), nn.LayerNorm(hidden)
        self.attn = Attention(hidden, heads)
        self.mlp = Mlp(hidden, 4 * hidden, hidden)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """(B, N, hidden) to the same; `mask` is added to the logits."""
        x = x + self.attn(self.norm1(x), x, x, mask)
        return x + self.mlp(self.norm2(x))


class Fusion(nn.Module):
    """All tokens look at each other."""

    def __init__(self, hidden: int, heads: int, depth: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(FusionBlock(hidden, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(hidden)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """(B, N, hidden) to the same; `mask` is added to the logits."""
        for block in self.blocks:
            x = block(x, mask)
        return self.norm(x)


class SceneEncoder(nn.Module):
    """The whole encoder."""

    def __init__(self, hidden: int, heads: int, depth: int) -> None:
        super().__init__()
        self.neighbor_encoder = AgentEncoder(hidden, depth)
        projection = Mlp(STATIC_COLUMNS, hidden, hidden)
        self.static_encoder = nn.Sequential(OrderedDict(projection=projection))
        self.lane_encoder = LaneEncoder(hidden, depth)
        self.fusion = Fusion(hidden, heads, depth)
        self.pos_emb = Linear(POSITION, hidden)

    def forward(
        self, agents: Tensor, objects: Tensor, lanes: Tensor, limit: Tensor, has_limit: Tensor
    ) -> Tensor:
        """Tokens (B, A + O + L, hidden) of normalised agents, static objects and lanes.

        Agents are (B, A, samples, 11), objects (B, O, 10), lanes (B, L, points, 12), limits and
        whether they are known (B, L, 1).
        """
        used = (
            (agents[..., :AGENT_COLUMNS] != 0.0).any(dim=-1).any(dim=-1),
            (objects != 0.0).any(dim=-1),
            (lanes[..., :LANE_COLUMNS] != 0.0).any(dim=-1).any(dim=-1),
        )
        agent, static, lane = agents[used[0]], objects[used[1]], lanes[used[2]]
        encoded = (
            self.neighbor_encoder(agent) + self.pos_emb(_positions(agent[:, -1], 0)),
            self.static_encoder(static) + self.pos_emb(_positions(static, 1)),
            self.lane_encoder(lane, limit[used[2]], has_limit[used[2]])
            + self.pos_emb(_lane_positions(lane[:, MIDDLE])),
        )
        parts = []
        for where, rows in zip(used, encoded, strict=True):
            part = rows.new_zeros(*where.shape, rows.shape[1])
            part[where] = rows
            parts.append(part)
        valid = torch.cat(used, dim=1)
        valid[:, 0] = True  # an empty scene still has one key: a zero token
        return self.fusion(torch.cat(parts, dim=1), key_mask(valid))


def _positions(rows: Tensor, kind: int) -> Tensor:
    """(N, 7) x, y, cos, sin and the one-hot `kind` from rows that start with the first four."""
    hot = rows.new_zeros(len(rows), POSITION - 4)
    hot[:, kind] = 1.0
    return torch.cat([rows[:, :4], hot], dim=-1)


def _lane_positions(points: Tensor) -> Tensor:
    """(N, 7) of lanes from one point each: x, y, dx, dy, …."""
    # in double precision, in which it does not matter how many there are
    angle = torch.atan2(points[:, 3].double(), points[:, 2].double())
    along = torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1).to(points.dtype)
    return _positions(torch.cat([points[:, :2], along], dim=-1), 2)


class Context(NamedTuple):
    """What does not depend on the noisy trajectories: computed once for the S calls of a plan."""

    factors: list[Tensor]  # by block (S, B, 1, 6 * hidden) shifts, scales and gates
    last_factors: Tensor  # (S, B, 1, 2 * hidden) shift and scale of the last layer
    memory: list[tuple[Tensor, Tensor]]  # by block keys and values (B, N, hidden) of the scene
    mask: Tensor  # (B, 1, 1, A) added to the logits of the agents


class RouteEncoder(nn.Module):
    """Lanes of the route to one vector."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.channel_pre_project = Mlp(ROUTE_COLUMNS, ROUTE_CHANNELS, ROUTE_CHANNELS)
        self.token_pre_project = Mlp(ROUTE_LANES * POINTS, ROUTE_TOKENS, ROUTE_TOKENS)
        self.Mixer = Mixer(ROUTE_TOKENS, ROUTE_CHANNELS)
        self.norm = nn.LayerNorm(ROUTE_CHANNELS)
        self.emb_project = Mlp(ROUTE_CHANNELS, hidden, hidden)

    def forward(self, route: Tensor) -> Tensor:
        """(B, lanes, points, 12) to (B, hidden); zero where there is no route."""
        points = route[..., :ROUTE_COLUMNS].flatten(1, 2)
        x = over_rows(self.token_pre_project, self.channel_pre_project(points))
        x = self.emb_project(self.norm(self.Mixer(x).mean(dim=1)))
        return x * (points != 0.0).any(dim=-1).any(dim=-1, keepdim=True)


class TimeEmbedder(nn.Module):
    """Diffusion times to vectors."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(Linear(2 * FREQUENCIES, hidden), nn.SiLU(), Linear(hidden, hidden))

    def forward(self, times: Tensor) -> Tensor:
        """(...) times in [0, 1] to (..., hidden)."""
        steps = torch.arange(FREQUENCIES, dtype=torch.float32, device=times.device)
        phase = times[..., None] * torch.exp(-math.log(LONGEST) * steps / FREQUENCIES)
        return self.mlp(torch.cat([torch.cos(phase), torch.sin(phase)], dim=-1))


class DiTBlock(nn.Module):
    """Agents look at each other, then at the scene; the second half has no residual."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        norms = (nn.LayerNorm(hidden) for _ in range(4))
        self.norm1, self.norm2, self.norm3, self.norm4 = norms
        self.attn, self.cross_attn = Attention(hidden, heads), Attention(hidden, heads)
        self.mlp1 = Mlp(hidden, 4 * hidden, hidden, approximate="tanh")
        self.mlp2 = Mlp(hidden, 4 * hidden, hidden, approximate="tanh")
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), Linear(hidden, 6 * hidden))

    def forward(
        self, x: Tensor, factors: Tensor, memory: tuple[Tensor, Tensor], mask: Tensor
    ) -> Tensor:
        """(B, A, hidden) to the same, by what `Context` has for this block and one call."""
        shift1, scale1, gate1, shift2, scale2, gate2 = factors.chunk(6, dim=-1)
        y = self.norm1(x) * (1.0 + scale1) + shift1
        x = x + gate1 * self.attn(y, y, y, mask)
        x = x + gate2 * self.mlp1(self.norm2(x) * (1.0 + scale2) + shift2)
        # nuPlan rule 339: the second half has no residual
        query = self.cross_attn.project_one(self.norm3(x), 0)
        x = self.cross_attn.out_proj(self.cross_attn.attend(query, *memory))
        return self.mlp2(self.norm4(x))


class FinalLayer(nn.Module):
    """Tokens of the agents to trajectories."""

    def __init__(self, hidden: int, outputs: int) -> None:
        super().__init__()
        self.norm_final = nn.LayerNorm(hidden)
        self.proj = nn.Sequential(
            nn.LayerNorm(hidden),
            Linear(hidden, 4 * hidden),
            nn.GELU(approximate="tanh"),
            nn.LayerNorm(4 * hidden),
            Linear(4 * hidden, outputs),
        )
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), Linear(hidden, 2 * hidden))

    def forward(self, x: Tensor, factors: Tensor) -> Tensor:
        """(B, A, hidden) to (B, A, outputs), by the factors of one call."""
        shift, scale = factors.chunk(2, dim=-1)
        return self.proj(self.norm_final(x) * (1.0 + scale) + shift)


class DiT(nn.Module):
    """The whole decoder."""

    def __init__(self, hidden: int, heads: int, depth: int) -> None:
        super().__init__()
        self.route_encoder = RouteEncoder(hidden)
        self.agent_embedding = nn.Embedding(2, hidden)
        self.preproj = Mlp(4 * POSES, 512, hidden)
        self.t_embedder = TimeEmbedder(hidden)
        self.blocks = nn.ModuleList(DiTBlock(hidden, heads) for _ in range(depth))
        self.final_layer = FinalLayer(hidden, 4 * POSES)

    def context(
        self, tokens: Tensor, route_lanes: Tensor, absent: Tensor, times: Tensor
    ) -> Context:
        """What calls share, from tokens of the scene (B, N, hidden) and normalised route lanes.

        `absent` (B, A) are agents that are not there, the ego always is; `times` (S, B or 1) are
        those of the calls.
        """
        condition = (self.route_encoder(route_lanes) + self.t_embedder(times))[:, :, None]
        factors, memory = [], []
        for block in self.blocks:
            assert isinstance(block, DiTBlock)
            keys, values = (block.cross_attn.project_one(tokens, number) for number in (1, 2))
            factors.append(block.adaLN_modulation(condition))
            memory.append((keys, values))
        last = self.final_layer.adaLN_modulation(condition)
        return Context(factors, last, memory, key_mask(~absent))

    def forward(self, x: Tensor, call: int, context: Context) -> Tensor:
        """Clean trajectories of noisy ones (B, A, 4 * poses), ego first, at the time of a call."""
        is_neighbour = torch.arange(x.shape[1], device=x.device).clamp(max=1)
        x = self.preproj(x) + self.agent_embedding(is_neighbour)
        for block, factors, memory in zip(
            self.blocks, context.factors, context.memory, strict=True
        ):
            x = block(x, factors[call], memory, context.mask)
        return self.final_layer(x, context.last_factors[call])
