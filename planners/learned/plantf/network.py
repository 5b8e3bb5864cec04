"""The network of PlanTF (planner-plantf.md §3), with the names and shapes of its checkpoint."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from shiftsim.planners.learned.deterministic import DriveHead, State, override_head
from shiftsim.planners.learned.network.blocks import (
    DIM,
    AgentEncoder,
    EncoderBlock,
    MapEncoder,
    along_line,
    history_steps,
)
from shiftsim.planners.learned.network.rows import Linear, without_padding

PREFIXES = ("model.",)  # of the names in the published checkpoint
STATE_CHANNELS = POLYGON_CHANNELS = 6
RELEASED = {
    "dim": DIM,
    "state_channel": STATE_CHANNELS,
    "polygon_channel": POLYGON_CHANNELS,
    "history_channel": 9,
    "history_steps": 21,
    "future_steps": 80,
    "encoder_depth": 4,
    "drop_path": 0.2,  # training only
    "num_heads": 8,
    "num_modes": 6,
    "state_dropout": 0.75,  # training only
    "use_ego_history": False,
    "state_attn_encoder": True,
}
DRIVE_HEADS = {
    "trajectory_decoder.loc.3": DriveHead(
        gain=(20, 2, 0.05, 0.05), exponent=(1, 1, 1, 1), const=(0, 0, 1, 0), slope=(40, 0, 0, 0)
    )
}
_ADJUSTABLE = ("encoder_depth", "num_heads", "num_modes", "future_steps")


class Inputs(NamedTuple):
    """One batch: B scenes, A rows of agents of which the first is the ego, M polygons, K points.

    Attributes:
        position: (B, A, 21, 2) in the ego frame [m].
        heading: (B, A, 21) [rad].
        velocity: (B, A, 21, 2) [m/s].
        shape: (B, A, 21, 2) width, length [m].
        valid: (B, A, 21)
        category: (B, A) indices of kinds.
        current_state: (B, 6) x, y, heading, speed, acceleration, steering angle.
        points: (B, M, K, 2) of the centre lines [m].
        vectors: (B, M, K, 2) to the next point [m].
        orientations: (B, M, K) of the vectors [rad].
        centers: (B, M, 3) pose that stands for the polygon.
        kind: (B, M) 0 lane, 1 connector, 2 crosswalk.
        on_route: (B, M) 1 where the polygon is on the route.
        light: (B, M) 0 green, 1 yellow, 2 red, 3 unknown.
        has_limit: (B, M)
        limit: (B, M) speed limit [m/s].
        point_valid: (B, M, K)
        counts: How many agents and polygons each scene has, the rest is padding; None where nothing
            is.
    """

    position: Tensor
    heading: Tensor
    velocity: Tensor
    shape: Tensor
    valid: Tensor
    category: Tensor
    current_state: Tensor
    points: Tensor
    vectors: Tensor
    orientations: Tensor
    centers: Tensor
    kind: Tensor
    on_route: Tensor
    light: Tensor
    has_limit: Tensor
    limit: Tensor
    point_valid: Tensor
    counts: Sequence[Sequence[int]] | None = None


class Outputs(NamedTuple):
    """What the network says.

    Attributes:
        trajectory: (B, modes, 80, 4) x, y [m], cosine and sine of the heading.
        probability: (B, modes) logits.
        prediction: (B, A - 1, 80, 2) positions of the agents [m]; None unless asked for.
    """

    trajectory: Tensor
    probability: Tensor
    prediction: Tensor | None


class TrajectoryDecoder(nn.Module):
    """Several trajectories and their logits from the ego token."""

    def __init__(self, num_modes: int, future_steps: int) -> None:
        super().__init__()
        self.num_modes, self.future_steps = num_modes, future_steps
        self.multimodal_proj = Linear(DIM, num_modes * DIM)
        self.loc = _head(4 * future_steps)
        self.pi = _head(1)

    def forward(self, ego: Tensor) -> tuple[Tensor, Tensor]:
        """Trajectories (B, modes, steps, 4) and logits (B, modes) from (B, 128)."""
        modes = self.multimodal_proj(ego).reshape(len(ego), self.num_modes, DIM)
        trajectories = self.loc(modes).reshape(len(ego), self.num_modes, self.future_steps, 4)
        return trajectories, self.pi(modes)[..., 0]


def _head(outputs: int, *, bias: bool = True) -> nn.Sequential:
    return nn.Sequential(
        Linear(DIM, 2 * DIM, bias=bias),
        nn.LayerNorm(2 * DIM),
        nn.ReLU(),
        Linear(2 * DIM, outputs),
    )


class PlanTfNetwork(nn.Module):
    """The whole network."""

    def __init__(self, encoder_depth: int, num_heads: int, num_modes: int, steps: int) -> None:
        super().__init__()
        self.pos_emb = nn.Sequential(Linear(4, DIM), nn.ReLU(), Linear(DIM, DIM))
        self.agent_encoder = AgentEncoder(STATE_CHANNELS)
        limits = nn.Sequential(Linear(1, DIM), nn.ReLU(), Linear(DIM, DIM))
        self.map_encoder = MapEncoder(POLYGON_CHANNELS, limits)
        self.encoder_blocks = nn.ModuleList(
            EncoderBlock(DIM, num_heads) for _ in range(encoder_depth)
        )
        self.norm = nn.LayerNorm(DIM)
        self.trajectory_decoder = TrajectoryDecoder(num_modes, steps)
        self.agent_predictor = _head(2 * steps, bias=False)

    def forward(self, seen: Inputs, *, predict: bool = False) -> Outputs:
        """Plan for a batch; the agents' predictions only where asked for, no plan needs them."""
        known = seen.valid.any(dim=-1)
        steps = history_steps(seen.position, seen.heading, seen.velocity, seen.shape, seen.valid)
        agents = self.agent_encoder(steps, known, seen.category, seen.current_state)
        poses = torch.cat([seen.position[:, :, -1], seen.heading[:, :, -1:]], dim=-1)
        poses = torch.cat([poses, seen.centers], dim=1)
        points = torch.cat(along_line(seen.points, seen), dim=-1)
        there, scenes = without_padding((known, seen.point_valid.any(dim=-1)), seen.counts)
        x = torch.cat([agents, self.map_encoder(points, seen)], dim=1)[there] + self._placed(
            poses[there]
        )
        egos = scenes.firsts(x.device)
        last = len(self.encoder_blocks) - 1
        for index, block in enumerate(self.encoder_blocks):
            x = block(x, scenes, egos if index == last and not predict else None)
        x = self.norm(x)
        trajectory, probability = self.trajectory_decoder(x[egos] if predict else x)
        if not predict:
            return Outputs(trajectory, probability, None)
        tokens = x.new_zeros(*there.shape, DIM)
        tokens[there] = x
        prediction = self.agent_predictor(tokens[:, 1 : known.shape[1]])
        shape = (*prediction.shape[:2], self.trajectory_decoder.future_steps, 2)
        return Outputs(trajectory, probability, prediction.reshape(shape))

    def _placed(self, poses: Tensor) -> Tensor:
        """(T, 128) of poses (T, 3)."""
        angle = poses[:, 2]
        where = torch.stack([poses[:, 0], poses[:, 1], angle.cos(), angle.sin()], dim=-1)
        out: Tensor = self.pos_emb(where)
        return out


def build_network(args: Mapping[str, Any] | None = None) -> PlanTfNetwork:
    """The network, by default with the released hyper-parameters.

    Args:
        args: Hyper-parameters that differ from `RELEASED`; widths and channels cannot.
    """
    chosen = {**RELEASED, **(args or {})}
    return PlanTfNetwork(*(int(chosen[name]) for name in _ADJUSTABLE))


def drive_overrides(state: State) -> None:
    """Turn `base` weights into `drive` ones, in place."""
    for layer, head in DRIVE_HEADS.items():
        override_head(state, layer, head)
