"""Decoder of the Diffusion Planner: a diffusion transformer over the ego and its neighbours.

What does not depend on the noisy trajectories is computed once per plan (`DiT.prepare`): the route
encoding, the modulation at every time of the sampler, the keys and values of the scene's tokens.
`Prepared` is called for every step of the sampler.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.diffusion.network.encoder import Mixer
from shiftsim.planners.learned.network.rows import Attention, Linear, Mlp, gelu_, tanh_gelu_

POSES = 81  # of a trajectory, the present one included
ROUTE_LANES, POINTS = 25, 20
ROUTE_COLUMNS, ROUTE_TOKENS, ROUTE_CHANNELS = 4, 32, 64
FREQUENCIES, LONGEST = 128, 10000.0  # of the time embedding
NO_KEY = float("-inf")


class Product(NamedTuple):
    """A linear layer at hand: (R, inputs) to (R, outputs).

    Looking up the tensors of a module takes a quarter of the time of a product with few rows.
    """

    weight: Tensor
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """Apply the layer."""
        return torch.addmm(self.bias, x, self.weight)


class Norm(NamedTuple):
    """A layer norm at hand."""

    weight: Tensor
    bias: Tensor

    def __call__(self, x: Tensor) -> Tensor:
        """Normalise over the last dimension."""
        return functional.layer_norm(x, self.weight.shape, self.weight, self.bias)


def product(layer: nn.Module) -> Product:
    """A linear layer at hand."""
    assert isinstance(layer, nn.Linear)
    return Product(layer.weight.t(), layer.bias)


def norm(layer: nn.Module) -> Norm:
    """A layer norm at hand."""
    assert isinstance(layer, nn.LayerNorm)
    return Norm(layer.weight, layer.bias)


@dataclass(frozen=True, slots=True)
class Block:
    """A `DiTBlock` at hand for one plan: its tensors are looked up once, not in every call."""

    norms: tuple[Norm, ...]  # the four of the block
    packed: Product  # queries, keys and values of the agents
    joined: Product  # out of the attention between agents
    mlp1: tuple[Product, Product]  # first and second layer
    query: Product  # into the attention to the scene
    looked: Product  # out of it
    mlp2: tuple[Product, Product]  # first and second layer
    # by call: shift, scale and gate, twice, each (B, 1, hidden)
    modulation: list[tuple[Tensor, ...]]
    keys: Tensor  # (B * heads, C, N) of the scene's tokens, scaled
    values: Tensor  # (B * heads, N, C) of the same
    mask: Tensor  # (B * heads, 1, A) added to the logits of the agents

    def __call__(self, x: Tensor, call: int) -> Tensor:
        """(B, A, hidden) to the same."""
        shift1, scale1, gate1, shift2, scale2, gate2 = self.modulation[call]
        norm1, norm2, norm3, norm4 = self.norms
        y = torch.addcmul(shift1, norm1(x), scale1).flatten(0, 1)
        x = torch.addcmul(x, gate1, self._among(y, len(x)).view_as(x))
        y = torch.addcmul(shift2, norm2(x), scale2).flatten(0, 1)
        x = torch.addcmul(x, gate2, _mlp(self.mlp1, y).view_as(x))
        # nuPlan rule 339: the second half has no residual
        return _mlp(self.mlp2, norm4(self._at_scene(norm3(x)))).view_as(x)

    def _among(self, x: Tensor, scenes: int) -> Tensor:
        """Agents (B * A, hidden) attend to those of their scene."""
        channels = self.keys.shape[1]
        parts = self.packed(x).view(scenes, -1, 3, len(self.keys) // scenes, channels)
        query, keys, values = parts.permute(2, 0, 3, 1, 4).flatten(1, 2)
        logits = torch.baddbmm(self.mask, query, keys.mT, alpha=channels**-0.5)
        return self.joined(_mixed(logits, values, scenes))

    def _at_scene(self, x: Tensor) -> Tensor:
        """Agents (B, A, hidden) attend to the tokens of their scene; (B * A, hidden)."""
        heads, channels = len(self.keys) // len(x), self.keys.shape[1]
        query = self.query(x.flatten(0, 1)).view(*x.shape[:2], heads, channels)
        logits = torch.bmm(query.transpose(1, 2).flatten(0, 1), self.keys)
        return self.looked(_mixed(logits, self.values, len(x)))


def _mixed(logits: Tensor, values: Tensor, scenes: int) -> Tensor:
    """(B * A, heads * C) of logits (B * heads, A, N) and values (B * heads, N, C)."""
    mixed = torch.bmm(logits.softmax(dim=-1), values)
    by_agent = mixed.view(scenes, -1, *mixed.shape[1:]).transpose(1, 2)
    return by_agent.reshape(-1, by_agent.shape[2] * by_agent.shape[3])


def _mlp(layers: tuple[Product, Product], x: Tensor) -> Tensor:
    first, second = layers
    return second(tanh_gelu_(first(x)))


@dataclass(frozen=True, slots=True)
class Prepared:
    """The network at hand for one plan."""

    entry: tuple[Product, Product]  # first and second layer into the blocks
    kinds: Tensor  # (A, hidden) embedding of an agent's kind, ego or neighbour
    blocks: list[Block]  # the blocks
    norms: tuple[Norm, ...]  # the three of the last layer
    exit: tuple[Product, Product]  # first and second layer out of the blocks
    # by call: shift and scale of the last layer, each (B, 1, hidden)
    modulation: list[tuple[Tensor, ...]]

    def __call__(self, x: Tensor, call: int) -> Tensor:
        """Clean trajectories of noisy ones (B, A, 4 * steps), ego first, at a prepared time.

        On a CPU, A is at least `rows.ROWS`.
        """
        shape = x.shape
        first, second = self.entry
        x = second(gelu_(first(x.flatten(0, 1)))).view(*shape[:2], -1) + self.kinds
        for block in self.blocks:
            x = block(x, call)
        shift, scale = self.modulation[call]
        norm1, norm2, norm3 = self.norms
        first, second = self.exit
        x = norm2(torch.addcmul(shift, norm1(x), scale)).flatten(0, 1)
        return second(norm3(tanh_gelu_(first(x)))).view(shape)


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
        x = self.token_pre_project.over_rows(self.channel_pre_project(points))
        x = self.emb_project(self.norm(self.Mixer.mean(x)))
        return x * (points != 0.0).any(dim=-1).any(dim=-1, keepdim=True)


class TimeEmbedder(nn.Module):
    """Diffusion times to vectors."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(Linear(2 * FREQUENCIES, hidden), nn.SiLU(), Linear(hidden, hidden))

    def forward(self, times: Tensor) -> Tensor:
        """(S,) times in [0, 1] to (S, hidden)."""
        steps = torch.arange(FREQUENCIES, dtype=torch.float32, device=times.device)
        phase = times[:, None] * torch.exp(-math.log(LONGEST) * steps / FREQUENCIES)
        return self.mlp(torch.cat([torch.cos(phase), torch.sin(phase)], dim=-1))


class DiTBlock(nn.Module):
    """Agents look at each other, then at the scene; the second half has no residual."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(hidden)
        self.attn = Attention(hidden, heads)
        self.norm2 = nn.LayerNorm(hidden)
        self.mlp1 = Mlp(hidden, 4 * hidden, hidden, approximate="tanh")
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), Linear(hidden, 6 * hidden))
        self.norm3 = nn.LayerNorm(hidden)
        self.cross_attn = Attention(hidden, heads)
        self.norm4 = nn.LayerNorm(hidden)
        self.mlp2 = Mlp(hidden, 4 * hidden, hidden, approximate="tanh")

    def at_hand(self, context: Tensor, modulation: list[tuple[Tensor, ...]], mask: Tensor) -> Block:
        """The block for one plan: tokens of the scene (B, N, hidden), the rest as in `Block`."""
        attend = self.cross_attn
        first, weight = attend.out_proj.in_features, attend.in_proj_weight
        keys, values = (attend.heads(part) for part in attend.keys_values(context))
        return Block(
            norms=tuple(norm(getattr(self, f"norm{number}")) for number in (1, 2, 3, 4)),
            packed=Product(self.attn.in_proj_weight.t(), self.attn.in_proj_bias),
            joined=product(self.attn.out_proj),
            mlp1=(product(self.mlp1.fc1), product(self.mlp1.fc2)),
            query=Product(weight[:first].t(), attend.in_proj_bias[:first]),
            looked=product(attend.out_proj),
            mlp2=(product(self.mlp2.fc1), product(self.mlp2.fc2)),
            modulation=modulation,
            keys=(keys * keys.shape[-1] ** -0.5).mT.flatten(0, 1).contiguous(),
            values=values.flatten(0, 1).contiguous(),
            mask=mask,
        )


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


class DiT(nn.Module):
    """The whole decoder."""

    def __init__(self, hidden: int, heads: int, depth: int) -> None:
        super().__init__()
        self.heads = heads
        self.route_encoder = RouteEncoder(hidden)
        self.agent_embedding = nn.Embedding(2, hidden)
        self.preproj = Mlp(4 * POSES, 512, hidden)
        self.t_embedder = TimeEmbedder(hidden)
        self.blocks = nn.ModuleList(DiTBlock(hidden, heads) for _ in range(depth))
        self.final_layer = FinalLayer(hidden, 4 * POSES)

    def prepare(self, context: Tensor, route: Tensor, absent: Tensor, times: Tensor) -> Prepared:
        """What the calls at all `times` (S,) share.

        `context` (B, N, hidden) are tokens of the scene, `route` (B, hidden) that of the route,
        `absent` (B, A) agents that are not there; the ego always is.
        """
        condition = functional.silu(route + self.t_embedder(times)[:, None])[:, :, None]
        one = torch.ones((), device=context.device)
        zeros = torch.zeros(absent.shape, device=context.device).masked_fill(absent, NO_KEY)
        mask = zeros.repeat_interleave(self.heads, dim=0)[:, None]
        blocks = []
        for block in self.blocks:
            assert isinstance(block, DiTBlock)
            factors = block.adaLN_modulation[1](condition)
            hidden = factors.shape[-1] // 6
            factors[..., hidden : 2 * hidden] += one  # scales are about 1
            factors[..., 4 * hidden : 5 * hidden] += one
            calls = [call.chunk(6, dim=-1) for call in factors]
            blocks.append(block.at_hand(context, calls, mask))
        last = self.final_layer
        final = last.adaLN_modulation[1](condition)
        final[..., final.shape[-1] // 2 :] += one
        is_neighbour = torch.arange(absent.shape[1], device=context.device).clamp(max=1)
        return Prepared(
            entry=(product(self.preproj.fc1), product(self.preproj.fc2)),
            kinds=self.agent_embedding(is_neighbour),
            blocks=blocks,
            norms=(norm(last.norm_final), norm(last.proj[0]), norm(last.proj[3])),
            exit=(product(last.proj[1]), product(last.proj[4])),
            modulation=[call.chunk(2, dim=-1) for call in final],
        )
