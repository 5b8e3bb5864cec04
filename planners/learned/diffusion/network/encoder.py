"""Encoder of the Diffusion Planner: agents, static objects and lanes to one token each.

Unused rows make zero tokens. Rows that are used are gathered first, so that an empty road costs
little.
"""

import torch
from torch import Tensor, nn

from shiftsim.planners.learned.network.rows import Attention, Linear, Mlp

AGENT_COLUMNS, STATIC_COLUMNS, LANE_COLUMNS, LIGHT_COLUMNS = 8, 10, 8, 4
AGENT_KINDS = 3
SAMPLES, POINTS = 21, 20  # of a history, of a lane
POSITION = 7  # x, y, cos, sin, and one-hot agent, static object, lane
TOKENS, CHANNELS = 64, 128  # inside the mixers
MIDDLE = 10  # point of a lane that stands for its position
NO_KEY = float("-inf")
TOGETHER = 36  # rows that pass through the mixers at a time: what they make stays in the cache


class Mixer(nn.Module):
    """One mixer block: an MLP over the tokens, then one over the channels."""

    def __init__(self, tokens: int, channels: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels)
        self.channels_mlp = Mlp(channels, channels, channels)
        self.norm2 = nn.LayerNorm(channels)
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
        return x.mean(dim=1) + self.channels_mlp.fc2(hidden)


class MixerEncoder(nn.Module):
    """What agents and lanes have in common: samples to tokens, mixer blocks, their mean."""

    def __init__(self, columns: int, samples: int, hidden: int, depth: int) -> None:
        super().__init__()
        self.channel_pre_project = Mlp(columns, CHANNELS, CHANNELS)
        self.token_pre_project = Mlp(samples, TOKENS, TOKENS)
        self.blocks = nn.ModuleList(Mixer(TOKENS, CHANNELS) for _ in range(depth))
        self.norm = nn.LayerNorm(CHANNELS)
        self.emb_project = Mlp(CHANNELS, hidden, hidden)

    def mean(self, x: Tensor) -> Tensor:
        """(N, samples, columns) to (N, CHANNELS)."""
        if x.is_cuda or len(x) <= TOGETHER:
            return self._mean(x)
        return torch.cat([self._mean(part) for part in torch.split(x, TOGETHER)])

    def _mean(self, x: Tensor) -> Tensor:
        x = self.token_pre_project.over_rows(self.channel_pre_project(x))
        for block in self.blocks[:-1]:
            x = block(x)
        last = self.blocks[-1]
        assert isinstance(last, Mixer)
        return last.mean(x)

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


class StaticEncoder(nn.Module):
    """Static objects to tokens."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.projection = Mlp(STATIC_COLUMNS, hidden, hidden)

    def forward(self, objects: Tensor) -> Tensor:
        """(N, 10) to (N, hidden)."""
        return self.projection(objects)


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
        self.norm1 = nn.LayerNorm(hidden)
        self.attn = Attention(hidden, heads)
        self.norm2 = nn.LayerNorm(hidden)
        self.mlp = Mlp(hidden, 4 * hidden, hidden)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """(B, N, hidden) to the same; `mask` is added to the logits."""
        mixed = self.attn.mixed(*self.attn.projected(self.norm1(x), x, x), mask)
        x = x + self.attn.out_proj(mixed)
        self.mlp.add_to(x, self.norm2(x))
        return x


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
        self.static_encoder = StaticEncoder(hidden)
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
        used = [
            (agents[..., :AGENT_COLUMNS] != 0.0).any(dim=-1).any(dim=-1),
            (objects != 0.0).any(dim=-1),
            (lanes[..., :LANE_COLUMNS] != 0.0).any(dim=-1).any(dim=-1),
        ]
        valid = torch.cat(used, dim=1)
        tokens = agents.new_zeros(*valid.shape, self.pos_emb.out_features)
        split = [part.shape[1] for part in used]
        agent, static, lane = agents[used[0]], objects[used[1]], lanes[used[2]]
        made = (
            self.neighbor_encoder(agent) + self.pos_emb(_positions(agent[:, -1], 0)),
            self.static_encoder(static) + self.pos_emb(_positions(static, 1)),
            self.lane_encoder(lane, limit[used[2]], has_limit[used[2]])
            + self.pos_emb(_lane_positions(lane[:, MIDDLE])),
        )
        for out, where, token in zip(torch.split(tokens, split, dim=1), used, made, strict=True):
            out[where] = token
        valid[:, 0] = True  # an empty scene still has one key: a zero token
        mask = torch.zeros_like(valid, dtype=tokens.dtype).masked_fill(~valid, NO_KEY)
        return self.fusion(tokens, mask[:, None, None, :])


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
