"""Decoder of the Diffusion Planner: a diffusion transformer over the ego and its neighbours.

What does not depend on the noisy trajectories is computed once per plan (`prepare`): the route
encoding, the modulation at every time of the sampler, the keys and values of the scene's tokens.
`forward` is one call of the network (planner-diffusion.md §3.2).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.nets.diffusion_parts import EPS, Attention, Mixer, Mlp, tanh_gelu_
from shiftsim.planners.nets.rows import Linear

ROUTE_COLUMNS, ROUTE_TOKENS, ROUTE_CHANNELS = 4, 32, 64
FREQUENCIES, LONGEST = 128, 10000.0  # of the time embedding
NO_KEY = float("-inf")


class Prepared(NamedTuple):
    """What all calls of one plan share. S sampler times, D blocks.

    Attributes:
        modulation: By block and call: shift, scale and gate, twice, each (B, 1, hidden).
        final: By call: shift and scale of the last layer, each (B, 1, hidden).
        keys: D tensors (B, heads, N, C) of the scene's tokens.
        values: D tensors of the same shape.
        mask: (B, 1, 1, A) added to the logits of the agents.
    """

    modulation: list[list[tuple[Tensor, ...]]]
    final: list[tuple[Tensor, ...]]
    keys: list[Tensor]
    values: list[Tensor]
    mask: Tensor


class RouteEncoder(nn.Module):
    """Lanes of the route to one vector."""

    def __init__(self, lanes: int, points: int, hidden: int) -> None:
        """Make it for `lanes` lanes of `points` points."""
        super().__init__()
        self.channel_pre_project = Mlp(ROUTE_COLUMNS, ROUTE_CHANNELS, ROUTE_CHANNELS)
        self.token_pre_project = Mlp(lanes * points, ROUTE_TOKENS, ROUTE_TOKENS)
        self.Mixer = Mixer(ROUTE_TOKENS, ROUTE_CHANNELS)
        self.norm = nn.LayerNorm(ROUTE_CHANNELS, EPS)
        self.emb_project = Mlp(ROUTE_CHANNELS, hidden, hidden)

    def forward(self, route: Tensor) -> Tensor:
        """(B, lanes, points, 12) to (B, hidden); zero where there is no route."""
        points = route[..., :ROUTE_COLUMNS].flatten(1, 2)
        x = self.token_pre_project.over_rows(self.channel_pre_project(points))
        x = self.emb_project(self.norm(self.Mixer.mean(x)))
        return x * (points != 0.0).any(dim=-1).any(dim=-1, keepdim=True)


class TimeEmbedder(nn.Module):
    """Diffusion times to vectors."""

    def __init__(self, hidden: int) -> None:
        """Make it."""
        super().__init__()
        self.mlp = nn.Sequential(Linear(2 * FREQUENCIES, hidden), nn.SiLU(), Linear(hidden, hidden))

    def forward(self, times: Tensor) -> Tensor:
        """(S,) times in [0, 1] to (S, hidden)."""
        steps = torch.arange(FREQUENCIES, dtype=torch.float32, device=times.device)
        phase = times[:, None] * torch.exp(-math.log(LONGEST) * steps / FREQUENCIES)
        out: Tensor = self.mlp(torch.cat([torch.cos(phase), torch.sin(phase)], dim=-1))
        return out


class DiTBlock(nn.Module):
    """Agents look at each other, then at the scene; the second half has no residual."""

    def __init__(self, hidden: int, heads: int) -> None:
        """Make it."""
        super().__init__()
        self.norm1 = nn.LayerNorm(hidden, EPS)
        self.attn = Attention(hidden, heads)
        self.norm2 = nn.LayerNorm(hidden, EPS)
        self.mlp1 = Mlp(hidden, 4 * hidden, hidden, approximate="tanh")
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), Linear(hidden, 6 * hidden))
        self.norm3 = nn.LayerNorm(hidden, EPS)
        self.cross_attn = Attention(hidden, heads)
        self.norm4 = nn.LayerNorm(hidden, EPS)
        self.mlp2 = Mlp(hidden, 4 * hidden, hidden, approximate="tanh")

    def forward(
        self,
        x: Tensor,
        modulation: tuple[Tensor, ...],
        keys: Tensor,
        values: Tensor,
        mask: Tensor,
    ) -> Tensor:
        """(B, A, hidden) to the same; the other arguments as in `Prepared`."""
        shift1, scale1, gate1, shift2, scale2, gate2 = modulation
        y = torch.addcmul(shift1, self.norm1(x), scale1)
        x = torch.addcmul(x, gate1, self.attn(*self.attn.project_all(y), mask))
        y = torch.addcmul(shift2, self.norm2(x), scale2)
        x = torch.addcmul(x, gate2, self.mlp1(y))
        x = self.cross_attn(self.cross_attn.query(self.norm3(x)), keys, values, None)
        out: Tensor = self.mlp2(self.norm4(x))
        return out


class FinalLayer(nn.Module):
    """Tokens of the agents to trajectories."""

    def __init__(self, hidden: int, outputs: int) -> None:
        """Make it."""
        super().__init__()
        self.norm_final = nn.LayerNorm(hidden, EPS)
        self.proj = nn.Sequential(
            nn.LayerNorm(hidden, EPS),
            Linear(hidden, 4 * hidden),
            nn.GELU(approximate="tanh"),
            nn.LayerNorm(4 * hidden, EPS),
            Linear(4 * hidden, outputs),
        )
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), Linear(hidden, 2 * hidden))

    def forward(self, x: Tensor, modulation: tuple[Tensor, ...]) -> Tensor:
        """(B, A, hidden) to (B, A, outputs)."""
        shift, scale = modulation
        norm, first, _, last_norm, last = self.proj
        x = first(norm(torch.addcmul(shift, self.norm_final(x), scale)))
        out: Tensor = last(last_norm(tanh_gelu_(x)))
        return out


class DiT(nn.Module):
    """The whole decoder."""

    def __init__(
        self, *, hidden: int, heads: int, depth: int, steps: int, lanes: int, points: int
    ) -> None:
        """Make it.

        Args:
            hidden: Channels.
            heads: Of the attentions.
            depth: Blocks.
            steps: Poses of a trajectory, the present one included.
            lanes: Of the route.
            points: Of a lane.
        """
        super().__init__()
        self.route_encoder = RouteEncoder(lanes, points, hidden)
        self.agent_embedding = nn.Embedding(2, hidden)
        self.preproj = Mlp(4 * steps, 512, hidden)
        self.t_embedder = TimeEmbedder(hidden)
        self.blocks = nn.ModuleList(DiTBlock(hidden, heads) for _ in range(depth))
        self.final_layer = FinalLayer(hidden, 4 * steps)

    def prepare(self, context: Tensor, route: Tensor, absent: Tensor, times: Tensor) -> Prepared:
        """What the calls at all `times` share.

        Args:
            context: (B, N, hidden) tokens of the scene.
            route: (B, hidden) of `route_encoder`.
            absent: (B, A) agents that are not there; the ego always is.
            times: (S,) at which the network will be called.
        """
        condition = functional.silu(route + self.t_embedder(times)[:, None])[:, :, None]
        one = torch.ones((), device=context.device)
        modulation, keys, values = [], [], []
        for block in self.blocks:
            assert isinstance(block, DiTBlock)
            factors = block.adaLN_modulation[1](condition)
            hidden = factors.shape[-1] // 6
            factors[..., hidden : 2 * hidden] += one  # scales are about 1
            factors[..., 4 * hidden : 5 * hidden] += one
            modulation.append([call.chunk(6, dim=-1) for call in factors])
            key, value = block.cross_attn.keys_values(context)
            keys.append(key)
            values.append(value)
        final = self.final_layer.adaLN_modulation[1](condition)
        final[..., final.shape[-1] // 2 :] += one
        zeros = torch.zeros(absent.shape, device=context.device)
        mask = zeros.masked_fill(absent, NO_KEY)[:, None, None, :]
        ends = [call.chunk(2, dim=-1) for call in final]
        return Prepared(modulation, ends, keys, values, mask)

    def forward(self, x: Tensor, prepared: Prepared, call: int) -> Tensor:
        """One call of the network.

        Args:
            x: (B, A, 4 * steps) noisy trajectories, ego first.
            prepared: Of the plan.
            call: Which of the prepared times.

        Returns:
            (B, A, 4 * steps) clean ones.
        """
        x = self.preproj(x)
        x[:, :1] += self.agent_embedding.weight[0]
        x[:, 1:] += self.agent_embedding.weight[1]
        for index, block in enumerate(self.blocks):
            x = block(
                x,
                prepared.modulation[index][call],
                prepared.keys[index],
                prepared.values[index],
                prepared.mask,
            )
        out: Tensor = self.final_layer(x, prepared.final[call])
        return out
