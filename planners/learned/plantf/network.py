"""The network of PlanTF, with the names and shapes of its checkpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from shiftsim.planners.learned.deterministic import DriveHead, State, override_head
from shiftsim.planners.learned.network import blocks
from shiftsim.planners.learned.network.rows import Linear, store_by_columns, without_padding

PREFIXES = ("model.",)  # of the names in the published checkpoint
POLYGON_CHANNELS = 6
DEPTH, HEADS, MODES, STEPS = 4, 8, 6, 80
RELEASED = {
    "dim": blocks.DIM,
    "state_channel": blocks.STATE_CHANNELS,
    "polygon_channel": POLYGON_CHANNELS,
    "history_channel": 9,
    "history_steps": 21,
    "future_steps": STEPS,
    "encoder_depth": DEPTH,
    "drop_path": 0.2,  # training only
    "num_heads": HEADS,
    "num_modes": MODES,
    "state_dropout": 0.75,  # training only
    "use_ego_history": False,
    "state_attn_encoder": True,
}
DRIVE_HEADS = {
    "trajectory_decoder.loc.3": DriveHead(
        gain=(20, 2, 0.05, 0.05), exponent=(1, 1, 1, 1), const=(0, 0, 1, 0), slope=(40, 0, 0, 0)
    )
}


@dataclass(frozen=True, slots=True)
class Inputs(blocks.SceneTensors):
    """One batch."""

    # how many agents and polygons each scene has, the rest is padding; None where nothing is
    counts: Sequence[Sequence[int]] | None = None


class Outputs(NamedTuple):
    """What the network says."""

    trajectory: Tensor  # (B, modes, 80, 4) x, y [m], cosine and sine of the heading
    probability: Tensor  # (B, modes) logits
    # (B, A - 1, 80, 2) positions of the agents [m]; None unless asked for
    prediction: Tensor | None


class TrajectoryDecoder(nn.Module):
    """Several trajectories and their logits from the ego token."""

    def __init__(self) -> None:
        super().__init__()
        self.multimodal_proj = Linear(blocks.DIM, MODES * blocks.DIM)
        self.loc = _head(4 * STEPS)
        self.pi = _head(1)

    def forward(self, ego: Tensor) -> tuple[Tensor, Tensor]:
        """Trajectories (B, modes, steps, 4) and logits (B, modes) from (B, 128)."""
        modes = self.multimodal_proj(ego).reshape(len(ego), MODES, blocks.DIM)
        trajectories = self.loc(modes).reshape(len(ego), MODES, STEPS, 4)
        return trajectories, self.pi(modes)[..., 0]


def _head(outputs: int, *, bias: bool = True) -> nn.Sequential:
    return nn.Sequential(
        Linear(blocks.DIM, 2 * blocks.DIM, bias=bias),
        nn.LayerNorm(2 * blocks.DIM),
        nn.ReLU(),
        Linear(2 * blocks.DIM, outputs),
    )


class PlanTfNetwork(nn.Module):
    """The whole network."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_emb = nn.Sequential(
            Linear(4, blocks.DIM), nn.ReLU(), Linear(blocks.DIM, blocks.DIM)
        )
        self.agent_encoder = blocks.AgentEncoder()
        limits = nn.Sequential(Linear(1, blocks.DIM), nn.ReLU(), Linear(blocks.DIM, blocks.DIM))
        self.map_encoder = blocks.MapEncoder(POLYGON_CHANNELS, limits)
        self.encoder_blocks = nn.ModuleList(blocks.EncoderBlock(HEADS) for _ in range(DEPTH))
        self.norm = nn.LayerNorm(blocks.DIM)
        self.trajectory_decoder = TrajectoryDecoder()
        self.agent_predictor = _head(2 * STEPS, bias=False)
        store_by_columns(self)

    def forward(self, seen: Inputs, *, predict: bool = False) -> Outputs:
        """Plan for a batch; the agents' predictions only where asked for, no plan needs them."""
        points = torch.cat(blocks.along_line(seen.points, seen), dim=-1)
        packing, scenes = without_padding(seen.there, seen.counts)
        tokens = torch.cat([self.agent_encoder(seen), self.map_encoder(points, seen)], dim=1)
        x = packing.pack(tokens) + self._placed(packing.pack(seen.poses))
        egos = scenes.firsts(x.device)
        last = len(self.encoder_blocks) - 1
        for index, block in enumerate(self.encoder_blocks):
            x = block(x, scenes, egos if index == last and not predict else None)
        x = self.norm(x)
        trajectory, probability = self.trajectory_decoder(x[egos] if predict else x)
        if not predict:
            return Outputs(trajectory, probability, None)
        prediction = self.agent_predictor(packing.unpack(x)[:, 1 : seen.valid.shape[1]])
        shape = (*prediction.shape[:2], STEPS, 2)
        return Outputs(trajectory, probability, prediction.reshape(shape))

    def _placed(self, poses: Tensor) -> Tensor:
        """(T, 128) of poses (T, 3)."""
        angle = poses[:, 2]
        where = torch.stack([poses[:, 0], poses[:, 1], angle.cos(), angle.sin()], dim=-1)
        return self.pos_emb(where)


def build_network(args: Mapping[str, Any] | None = None) -> PlanTfNetwork:
    """The network, without weights; there is one architecture, and no args belong to it."""
    return PlanTfNetwork()


def drive_overrides(state: State) -> None:
    """Turn `base` weights into `drive` ones, in place."""
    for layer, head in DRIVE_HEADS.items():
        override_head(state, layer, head)
