"""The network of PLUTO, with the names and shapes of its checkpoint."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from shiftsim.planners.learned import network as layers
from shiftsim.planners.learned import network_encoders as encoders
from shiftsim.planners.learned.deterministic import DriveHead
from shiftsim.planners.learned.network import DIM, Attention, Linear, Scenes, head, key_mask

POLYGON_CHANNELS, LINE_CHANNELS = 10, 6
DEPTH, HEADS, MODES, STEPS = 4, 4, 12, 80
NUM_FREQUENCIES = 64
NEVER = -1e6  # logit of a reference line without points
DRIVE_HEADS = {
    "planning_decoder.loc_head.mlp.3": DriveHead(
        gain=(80, 12), exponent=(1, 2), const=(0, 0), slope=(104, 7.8)
    ),
    "planning_decoder.yaw_head.mlp.3": DriveHead(
        gain=(0.05, 0.6), exponent=(1, 1), const=(1, 0), slope=(0, 0.36)
    ),
    "ref_free_decoder.mlp.3": DriveHead(
        gain=(20, 4, 0.05, 0.1), exponent=(1, 2, 1, 1), const=(0, 0, 1, 0), slope=(40, 0, 0, 0)
    ),
    "agent_predictor.loc_predictor.mlp.3": DriveHead(
        gain=(10, 2), exponent=(1, 1), const=(0, 0), slope=(8, 0)
    ),
    "agent_predictor.yaw_predictor.mlp.3": DriveHead(
        gain=(0.05, 0.05), exponent=(1, 1), const=(1, 0), slope=(0, 0)
    ),
    "agent_predictor.vel_predictor.mlp.3": DriveHead(
        gain=(0.5, 0.2), exponent=(1, 1), const=(1, 0), slope=(0, 0)
    ),
}
DRIVE_SCALES = {
    "planning_decoder.m_emb": 120.0,
    "planning_decoder.pi_head.mlp.3.weight": 6.0,
    "planning_decoder.pi_head.mlp.3.bias": 6.0,
}


@dataclass(frozen=True, slots=True)
class Inputs(layers.SceneTensors):
    """One batch; S static objects and R reference lines."""

    object_pose: Tensor  # (B, S, 3) static objects x [m], y [m], heading [rad]
    object_shape: Tensor  # (B, S, 2) width, length [m]
    object_category: Tensor  # (B, S)
    object_valid: Tensor  # (B, S)
    line_points: Tensor  # (B, R, 120, 2) reference lines [m]
    line_vectors: Tensor  # (B, R, 120, 2) to the next point [m]
    line_orientations: Tensor  # (B, R, 120) [rad]
    line_valid: Tensor  # (B, R, 120)
    # how many agents, polygons, static objects and lines each scene has, the rest is padding; None
    # where nothing is
    counts: Sequence[Sequence[int]] | None = None


class Outputs(NamedTuple):
    """What the network says."""

    trajectory: Tensor  # (B, R, 12, 80, 6) x, y [m], cosine and sine of the heading, velocity [m/s]
    probability: Tensor  # (B, R, 12) logits, -1e6 where the reference line has no points
    prediction: Tensor  # (B, A - 1, 80, 6) of the agents, relative to their present poses
    ref_free_trajectory: Tensor  # (B, 80, 4) x, y [m], cosine and sine of the heading
    ego: Tensor  # (B, 128) its token


def _head(hidden: int, outputs: int) -> nn.Sequential:
    """(..., 128) to (..., outputs): Linear, LayerNorm, ReLU, Linear."""
    return nn.Sequential(OrderedDict(mlp=head(DIM, hidden, outputs)))


def _motion(x: Tensor, heads: Iterable[nn.Module]) -> Tensor:
    """(..., steps, 2 H) from x (..., 128): each of H heads has two of the channels."""
    return torch.cat([part(x).unflatten(-1, (STEPS, 2)) for part in heads], dim=-1)


class FourierEmbedding(nn.Module):
    """A vector from a few scalars, each by its own frequencies and layers; the sum counts."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.freqs = nn.Embedding(inputs, NUM_FREQUENCIES)
        self.mlps = nn.ModuleList(head(2 * NUM_FREQUENCIES + 1, DIM, DIM) for _ in range(inputs))
        self.to_out = nn.Sequential(nn.LayerNorm(DIM), nn.ReLU(), Linear(DIM, DIM))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., 128)."""
        turns = x[..., None] * self.freqs.weight * (2.0 * torch.pi)
        waves = torch.cat([turns.cos(), turns.sin(), x[..., None]], dim=-1)
        each = [layer(waves[..., index, :]) for index, layer in enumerate(self.mlps)]
        return self.to_out(torch.stack(each).sum(dim=0))


class StaticObjectsEncoder(nn.Module):
    """Tokens of the static objects, without their poses."""

    def __init__(self) -> None:
        super().__init__()
        self.obj_encoder = FourierEmbedding(2)
        self.type_emb = nn.Embedding(4, DIM)

    def forward(self, shape: Tensor, category: Tensor, valid: Tensor) -> Tensor:
        """(B, S, 128) from sizes (B, S, 2); zero where not valid (B, S)."""
        tokens: Tensor = self.obj_encoder(shape) + self.type_emb(category)
        return tokens * valid[..., None]


class DecoderBlock(nn.Module):
    """Attention among lines, among modes, and to the scene; then a feed-forward part."""

    def __init__(self) -> None:
        super().__init__()
        self.r2r_attn, self.m2m_attn, self.cross_attn = (Attention(DIM, HEADS) for _ in range(3))
        self.ffn = nn.Sequential(
            Linear(DIM, 4 * DIM), nn.ReLU(), nn.Identity(), Linear(4 * DIM, DIM)
        )
        self.norm1, self.norm2, self.norm3, self.norm4 = (nn.LayerNorm(DIM) for _ in range(4))

    def forward(
        self,
        x: Tensor,  # (L, modes, 128) queries of the reference lines
        place: Tensor,  # (1, modes, 128) embedding of the modes
        lines: Scenes,  # how the lines lie
        masks: Tensor,  # (B, 1 or modes, 1, 1, R) added to the logits of lines as keys
        tokens: Tensor,  # (T, 128) of the scenes
        scenes: Scenes,  # how these lie
    ) -> Tensor:
        """(L, modes, 128); zero before the attention to the scene for lines without points."""
        normed = self.norm1(x)
        parts = self.r2r_attn.project(normed, normed, normed)
        # every mode of a line attends to the same mode of the scene's others
        if lines.padded:
            mixed = lines.pack(self._among_lines(map(lines.unpack, parts), masks))
        else:
            by_scene = zip(zip(*map(lines.split, parts), strict=True), masks, strict=True)
            each = [
                self._among_lines((part[None] for part in scene), mask[None, ..., : len(scene[0])])
                for scene, mask in by_scene
            ]
            mixed = torch.cat(each, dim=1)[0]
        x = x + self.r2r_attn.out_proj(mixed)
        normed = self.norm2(x)
        x = x + self.m2m_attn(normed + place, normed + place, normed)
        x = x * lines.valid[:, None, None]
        x = x + self.cross_attn.segment_attention(self.norm3(x), tokens, lines, scenes)
        return x + self.ffn(self.norm4(x))

    def _among_lines(self, parts: Iterable[Tensor], mask: Tensor) -> Tensor:
        """(B, R, modes, D) attention from line to line; `mask` (B, 1 or modes, 1, 1, R)."""
        mask = mask.expand(-1, MODES, -1, -1, -1).flatten(0, 1)
        q, k, v = (x.transpose(1, 2).flatten(0, 1) for x in parts)
        mixed = self.r2r_attn.attend(q, k, v, mask)
        return mixed.view(len(mixed) // MODES, MODES, *mixed.shape[1:]).transpose(1, 2)


class PlanningDecoder(nn.Module):
    """Twelve trajectories and their logits for every reference line."""

    def __init__(self) -> None:
        super().__init__()
        self.misordered_masks = False  # for comparisons with the official network
        self.r_encoder = encoders.PointsEncoder(LINE_CHANNELS)
        self.r_pos_emb = FourierEmbedding(3)
        self.q_proj = Linear(2 * DIM, DIM)
        self.m_emb = nn.Parameter(0.01 * torch.randn(1, 1, MODES, DIM))
        self.m_pos = nn.Parameter(0.01 * torch.randn(1, MODES, DIM))
        self.decoder_blocks = nn.ModuleList(DecoderBlock() for _ in range(DEPTH))
        self.cat_x_proj = Linear(2 * DIM, DIM)
        self.loc_head, self.yaw_head, self.vel_head = (_head(2 * DIM, 2 * STEPS) for _ in range(3))
        self.pi_head = _head(DIM, 1)

    def forward(
        self, inputs: Inputs, tokens: Tensor, scenes: Scenes, egos: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Trajectories (B, R, modes, steps, 6) and logits (B, R, modes).

        `tokens` (T, 128) are those of the scenes, `egos` (B, 128) of the egos.
        """
        valid = inputs.line_valid.any(dim=-1)
        lines = Scenes([valid], inputs.counts and inputs.counts[-1:])
        embedded = lines.pack(self._embed_lines(inputs))
        shape = len(embedded), MODES, DIM
        x = torch.cat([embedded[:, None].expand(shape), self.m_emb[0].expand(shape)], dim=-1)
        x, masks = self.q_proj(x), self._line_masks(valid)
        for block in self.decoder_blocks:
            x = block(x, self.m_pos, lines, masks, tokens, scenes)
        counts = torch.tensor(lines.counts, device=egos.device)
        ego = egos.repeat_interleave(counts, dim=0)[:, None].expand(shape)
        x = self.cat_x_proj(torch.cat([x, ego], dim=-1))
        plans = _motion(x, (self.loc_head, self.yaw_head, self.vel_head))
        logits = self.pi_head(x)[..., 0].masked_fill(~lines.valid[:, None], NEVER)
        return lines.unpack(plans), lines.unpack(logits, NEVER)

    def _line_masks(self, valid: Tensor) -> Tensor:
        """(B, 1 or modes, 1, 1, R) logits added to the lines as keys, from (B, R)."""
        # a scene without any line that has points attends to all of them, and nothing reads it
        logits = key_mask(valid | ~valid.any(dim=1, keepdim=True))[:, None]
        if self.misordered_masks:  # nuPlan rule 307: by mode, where queries are ordered by scene
            logits = logits.repeat(MODES, 1, 1, 1, 1).view(len(valid), MODES, *logits.shape[2:])
        return logits

    def _embed_lines(self, inputs: Inputs) -> Tensor:
        """(B, R, 128)."""
        points, angles = inputs.line_points, inputs.line_orientations
        directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
        parts = (points - points[:, :, :1], inputs.line_vectors, directions)
        start = torch.cat([points[:, :, 0], angles[:, :, :1]], dim=-1)
        lines = self.r_encoder(torch.cat(parts, dim=-1), inputs.line_valid)
        return lines + self.r_pos_emb(start)


class PlutoNetwork(nn.Module):
    """The whole network."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_emb = FourierEmbedding(3)
        self.agent_encoder = encoders.AgentEncoder()
        self.map_encoder = encoders.MapEncoder(POLYGON_CHANNELS, FourierEmbedding(1))
        self.static_objects_encoder = StaticObjectsEncoder()
        self.encoder_blocks = nn.ModuleList(layers.EncoderBlock(HEADS) for _ in range(DEPTH))
        self.norm = nn.LayerNorm(DIM)
        names = ("loc_predictor", "yaw_predictor", "vel_predictor")
        self.agent_predictor = nn.ModuleDict({name: _head(2 * DIM, 2 * STEPS) for name in names})
        self.planning_decoder = PlanningDecoder()
        self.hidden_proj = layers.perceptron(DIM, DIM, DIM)  # of the contrastive loss only
        self.ref_free_decoder = _head(2 * DIM, 4 * STEPS)

    def forward(self, inputs: Inputs) -> Outputs:
        """Plan for a batch."""
        scenes = Scenes((*inputs.known, inputs.object_valid), inputs.counts and inputs.counts[:-1])
        middle, left, right = inputs.points.unbind(dim=2)
        sides = [left - middle, right - middle]
        points = torch.cat([*inputs.along_lines(middle), *sides], dim=-1)
        objects = inputs.object_shape, inputs.object_category, inputs.object_valid
        encoded = [self.agent_encoder(inputs), self.map_encoder(points, inputs)]
        tokens = torch.cat([*encoded, self.static_objects_encoder(*objects)], dim=1)
        poses = scenes.pack(torch.cat([inputs.poses, inputs.object_pose], dim=1))
        angle = (poses[:, 2:] + torch.pi) % (2.0 * torch.pi) - torch.pi
        x = scenes.pack(tokens) + self.pos_emb(torch.cat([poses[:, :2], angle], dim=-1))
        for block in self.encoder_blocks:
            x = block(x, scenes)
        x = self.norm(x)
        egos = scenes.firsts(x)
        agents = scenes.unpack(x)[:, 1 : inputs.valid.shape[1]]
        prediction = _motion(agents, self.agent_predictor.values())
        free = self.ref_free_decoder(egos).view(len(egos), STEPS, 4)
        trajectory, probability = self.planning_decoder(inputs, x, scenes, egos)
        return Outputs(trajectory, probability, prediction, free, egos)


def build_network(args: Mapping[str, Any] | None = None) -> PlutoNetwork:
    """The network, without weights; there is one architecture, and no args belong to it."""
    return PlutoNetwork()
