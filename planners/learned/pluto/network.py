"""The network of PLUTO, with the names and shapes of its checkpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from shiftsim.planners.learned.deterministic import DriveHead, State, override_head
from shiftsim.planners.learned.network import blocks
from shiftsim.planners.learned.network.rows import (
    Linear,
    Packing,
    Scenes,
    store_by_columns,
    without_padding,
)
from shiftsim.planners.learned.pluto.network_decoder import (
    DEPTH,
    HEADS,
    MODES,
    STEPS,
    FourierEmbedding,
    MlpLayer,
    MotionHeads,
    PlanningDecoder,
    motion,
    motion_heads,
)

PREFIXES = ("model.",)  # of the names in the published checkpoint
POLYGON_CHANNELS = 10
RELEASED = {
    "dim": blocks.DIM,
    "state_channel": blocks.STATE_CHANNELS,
    "polygon_channel": 6,  # and the boundaries
    "history_channel": 9,
    "history_steps": 21,
    "future_steps": STEPS,
    "encoder_depth": DEPTH,
    "decoder_depth": DEPTH,
    "drop_path": 0.2,  # training only
    "dropout": 0.1,  # training only
    "num_heads": HEADS,
    "num_modes": MODES,
    "state_dropout": 0.75,  # training only
    "use_ego_history": False,
    "state_attn_encoder": True,
    "use_hidden_proj": True,
    "cat_x": True,
    "ref_free_traj": True,
}
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
class Inputs(blocks.SceneTensors):
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


class StaticObjectsEncoder(nn.Module):
    """Tokens of the static objects, without their poses."""

    def __init__(self) -> None:
        super().__init__()
        self.obj_encoder = FourierEmbedding(2)
        self.type_emb = nn.Embedding(4, blocks.DIM)

    def forward(self, shape: Tensor, category: Tensor, valid: Tensor) -> Tensor:
        """(B, S, 128) from sizes (B, S, 2); zero where not valid (B, S)."""
        if not category.numel():
            return shape.new_zeros(*category.shape, blocks.DIM)
        tokens: Tensor = self.obj_encoder(shape) + self.type_emb(category)
        return tokens * valid[..., None]


class AgentPredictor(blocks.Prepared):
    """Motion of the agents from their tokens."""

    def __init__(self) -> None:
        super().__init__()
        heads = (MlpLayer(blocks.DIM, 2 * blocks.DIM, 2 * STEPS) for _ in range(3))
        self.loc_predictor, self.yaw_predictor, self.vel_predictor = heads

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, A, 128) to (B, A, 80, 6)."""
        return motion(tokens, self.prepared())

    def prepare(self) -> MotionHeads:
        """The heads as one."""
        return motion_heads([self.loc_predictor, self.yaw_predictor, self.vel_predictor])


class PlutoNetwork(nn.Module):
    """The whole network."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_emb = FourierEmbedding(3)
        self.agent_encoder = blocks.AgentEncoder()
        self.map_encoder = blocks.MapEncoder(POLYGON_CHANNELS, FourierEmbedding(1))
        self.static_objects_encoder = StaticObjectsEncoder()
        self.encoder_blocks = nn.ModuleList(blocks.EncoderBlock(HEADS) for _ in range(DEPTH))
        self.norm = nn.LayerNorm(blocks.DIM)
        self.agent_predictor = AgentPredictor()
        self.planning_decoder = PlanningDecoder()
        # of the training only; the checkpoint holds it
        self.hidden_proj = nn.Sequential(
            Linear(blocks.DIM, blocks.DIM), nn.ReLU(), Linear(blocks.DIM, blocks.DIM)
        )
        self.ref_free_decoder = MlpLayer(blocks.DIM, 2 * blocks.DIM, 4 * STEPS)
        store_by_columns(self)

    def forward(self, seen: Inputs) -> Outputs:
        """Plan for a batch."""
        *counts, num_lines = seen.counts or _all_counts(seen)
        x, scenes, packing = self._encode(seen, counts)
        egos = x[scenes.firsts(x.device)]
        prediction = self.agent_predictor(packing.unpack(x)[:, 1 : seen.valid.shape[1]])
        free = self.ref_free_decoder(egos).reshape(len(egos), -1, 4)
        trajectory, probability = self.planning_decoder(seen, num_lines, x, scenes, egos)
        return Outputs(trajectory, probability, prediction, free, egos)

    def _encode(
        self, seen: Inputs, counts: Sequence[Sequence[int]]
    ) -> tuple[Tensor, Scenes, Packing]:
        """Tokens (T, 128) of ego, agents, polygons and static objects, scene by scene.

        Also how they lie, and which of all rows (B, A + M + S) they are: those without padding.
        """
        packing, scenes = without_padding((*seen.there, seen.object_valid), counts)
        middle = seen.points[:, :, 0]
        sides = [seen.points[:, :, side] - middle for side in (1, 2)]
        points = torch.cat([*blocks.along_line(middle, seen), *sides], dim=-1)
        tokens = (
            self.agent_encoder(seen),
            self.map_encoder(points, seen),
            self.static_objects_encoder(seen.object_shape, seen.object_category, seen.object_valid),
        )
        poses = packing.pack(torch.cat([seen.poses, seen.object_pose], dim=1))
        angle = (poses[:, 2:] + torch.pi) % (2.0 * torch.pi) - torch.pi
        where = self.pos_emb(torch.cat([poses[:, :2], angle], dim=-1))
        x = packing.pack(torch.cat(tokens, dim=1)) + where
        for block in self.encoder_blocks:
            x = block(x, scenes)
        return self.norm(x), scenes, packing


def _all_counts(seen: Inputs) -> list[list[int]]:
    parts = (seen.category, seen.kind, seen.object_category, seen.line_valid)
    return [[part.shape[1]] * len(part) for part in parts]


def build_network(args: Mapping[str, Any] | None = None) -> PlutoNetwork:
    """The network, without weights; there is one architecture, and no args belong to it."""
    return PlutoNetwork()


def drive_overrides(state: State) -> None:
    """Turn `base` weights into `drive` ones, in place."""
    for layer, head in DRIVE_HEADS.items():
        override_head(state, layer, head)
    for name, factor in DRIVE_SCALES.items():
        state[name] = (factor * state[name].astype("float64")).astype(state[name].dtype)
