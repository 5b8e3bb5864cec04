"""The network of PlanTF, with the names and shapes of its checkpoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from shiftsim.planners.learned import network as layers
from shiftsim.planners.learned import network_encoders as encoders
from shiftsim.planners.learned.deterministic import DriveHead
from shiftsim.planners.learned.network import DIM, Linear, head, perceptron

POLYGON_CHANNELS = 6
DEPTH, HEADS, MODES, STEPS = 4, 8, 6, 80
DRIVE_HEADS = {
    "trajectory_decoder.loc.3": DriveHead(
        gain=(20, 2, 0.05, 0.05), exponent=(1, 1, 1, 1), const=(0, 0, 1, 0), slope=(40, 0, 0, 0)
    )
}


@dataclass(frozen=True, slots=True)
class Inputs(layers.SceneTensors):
    """One batch."""

    # by agents and polygons how many each scene has, the rest is padding; None where nothing is
    counts: Sequence[Sequence[int]] | None = None


class Outputs(NamedTuple):
    """What the network says."""

    trajectory: Tensor  # (B, modes, 80, 4) x, y [m], cosine and sine of the heading
    probability: Tensor  # (B, modes) logits
    prediction: Tensor  # (B, A - 1, 80, 2) positions of the agents [m]


class TrajectoryDecoder(nn.Module):
    """Several trajectories and their logits from the ego token."""

    def __init__(self) -> None:
        super().__init__()
        self.multimodal_proj = Linear(DIM, MODES * DIM)
        self.loc = head(DIM, 2 * DIM, 4 * STEPS)
        self.pi = head(DIM, 2 * DIM, 1)

    def forward(self, ego: Tensor) -> tuple[Tensor, Tensor]:
        """Trajectories (B, modes, steps, 4) and logits (B, modes) from (B, 128)."""
        modes = self.multimodal_proj(ego).view(len(ego), MODES, DIM)
        return self.loc(modes).view(len(ego), MODES, STEPS, 4), self.pi(modes)[..., 0]


class PlanTfNetwork(nn.Module):
    """The whole network."""

    def __init__(self) -> None:
        super().__init__()
        self.pos_emb = perceptron(4, DIM, DIM)
        self.agent_encoder = encoders.AgentEncoder()
        self.map_encoder = encoders.MapEncoder(POLYGON_CHANNELS, perceptron(1, DIM, DIM))
        self.encoder_blocks = nn.ModuleList(layers.EncoderBlock(HEADS) for _ in range(DEPTH))
        self.norm = nn.LayerNorm(DIM)
        self.trajectory_decoder = TrajectoryDecoder()
        self.agent_predictor = head(DIM, 2 * DIM, 2 * STEPS, bias=False)

    def forward(self, inputs: Inputs) -> Outputs:
        """Plan for a batch."""
        scenes = layers.Scenes(inputs.known, inputs.counts)
        points = torch.cat(inputs.along_lines(inputs.points), dim=-1)
        tokens = torch.cat([self.agent_encoder(inputs), self.map_encoder(points, inputs)], dim=1)
        poses = scenes.pack(inputs.poses)
        angle = poses[:, 2:]
        x = scenes.pack(tokens)
        x = x + self.pos_emb(torch.cat([poses[:, :2], angle.cos(), angle.sin()], dim=-1))
        for block in self.encoder_blocks:
            x = block(x, scenes)
        x = self.norm(x)
        agents = scenes.unpack(x)[:, 1 : inputs.valid.shape[1]]
        prediction = self.agent_predictor(agents).view(*agents.shape[:2], STEPS, 2)
        trajectory, probability = self.trajectory_decoder(scenes.firsts(x))
        return Outputs(trajectory, probability, prediction)


def build_network(args: Mapping[str, Any] | None = None) -> PlanTfNetwork:
    """The network, without weights; there is one architecture, and no args belong to it."""
    return PlanTfNetwork()
