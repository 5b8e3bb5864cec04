"""The decoder of PLUTO's network: trajectories along reference lines (planner-pluto.md §3.3)."""

import torch
from torch import Tensor, nn

from shiftsim.planners.nets.blocks import DIM, Attention, PointsEncoder

NUM_FREQUENCIES = 64
LINE_CHANNELS = 6
NEVER = -1e6  # logit of a reference line without points


class MlpLayer(nn.Module):
    """Linear, LayerNorm, ReLU, Linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(inputs, hidden), nn.LayerNorm(hidden), nn.ReLU(), nn.Linear(hidden, outputs)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        out: Tensor = self.mlp(x)
        return out


class FourierEmbedding(nn.Module):
    """A vector from a few scalars, each by its own frequencies and layers; the sum counts."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.freqs = nn.Embedding(inputs, NUM_FREQUENCIES)
        self.mlps = nn.ModuleList(
            nn.Sequential(
                nn.Linear(2 * NUM_FREQUENCIES + 1, DIM),
                nn.LayerNorm(DIM),
                nn.ReLU(),
                nn.Linear(DIM, DIM),
            )
            for _ in range(inputs)
        )
        self.to_out = nn.Sequential(nn.LayerNorm(DIM), nn.ReLU(), nn.Linear(DIM, DIM))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., 128)."""
        turns = x[..., None] * self.freqs.weight * (2.0 * torch.pi)
        waves = torch.cat([turns.cos(), turns.sin(), x[..., None]], dim=-1)
        total = self.mlps[0](waves[..., 0, :])
        for index in range(1, len(self.mlps)):
            total = total + self.mlps[index](waves[..., index, :])
        out: Tensor = self.to_out(total)
        return out


class DecoderBlock(nn.Module):
    """Attention among lines, among modes, and to the scene; then a feed-forward part."""

    def __init__(self, num_heads: int, *, misordered_masks: bool) -> None:
        super().__init__()
        self.misordered_masks = misordered_masks
        self.r2r_attn = Attention(DIM, num_heads)
        self.m2m_attn = Attention(DIM, num_heads)
        self.cross_attn = Attention(DIM, num_heads)
        self.ffn = nn.Sequential(
            nn.Linear(DIM, 4 * DIM), nn.ReLU(), nn.Identity(), nn.Linear(4 * DIM, DIM)
        )
        self.norm1, self.norm2, self.norm3, self.norm4 = (nn.LayerNorm(DIM) for _ in range(4))

    def forward(
        self, x: Tensor, lines: Tensor, mode_position: Tensor, scene: Tensor, keep: Tensor
    ) -> Tensor:
        """Refine queries.

        Args:
            x: (B, R, modes, 128) queries.
            lines: (B, R) lines that have points.
            mode_position: (1, modes, 128).
            scene: (B, N, 128) tokens.
            keep: (B, N) tokens that count.

        Returns:
            (B, R, modes, 128)
        """
        batch, num_lines, modes, _ = x.shape
        normed = self.norm1(x).transpose(1, 2).reshape(batch * modes, num_lines, DIM)
        among = self.r2r_attn(normed, normed, normed, self._line_masks(lines, modes))
        x = x + among.reshape(batch, modes, num_lines, DIM).transpose(1, 2)

        normed = self.norm2(x).reshape(batch * num_lines, modes, DIM)
        placed = normed + mode_position
        x = x + self.m2m_attn(placed, placed, normed, None).reshape(x.shape)
        x = x * lines[:, :, None, None]

        flat = x.reshape(batch, num_lines * modes, DIM)
        flat = flat + self.cross_attn(self.norm3(flat), scene, scene, keep)
        flat = flat + self.ffn(self.norm4(flat))
        return flat.reshape(x.shape)

    def _line_masks(self, lines: Tensor, modes: int) -> Tensor:
        """(B modes, R) lines that take part, for queries ordered by scene and then by mode."""
        # a scene without any line attends to padding, and nothing reads it
        lines = lines | ~lines.any(dim=1, keepdim=True)
        if self.misordered_masks:
            return lines.repeat(modes, 1)  # the official order, which is by mode (§3.3)
        return lines.repeat_interleave(modes, dim=0)


class PlanningDecoder(nn.Module):
    """Twelve trajectories and their logits for every reference line."""

    def __init__(
        self, depth: int, num_heads: int, num_modes: int, steps: int, *, misordered_masks: bool
    ) -> None:
        super().__init__()
        self.steps = steps
        self.r_encoder = PointsEncoder(LINE_CHANNELS)
        self.r_pos_emb = FourierEmbedding(3)
        self.q_proj = nn.Linear(2 * DIM, DIM)
        self.m_emb = nn.Parameter(torch.zeros(1, 1, num_modes, DIM))
        self.m_pos = nn.Parameter(torch.zeros(1, num_modes, DIM))
        self.decoder_blocks = nn.ModuleList(
            DecoderBlock(num_heads, misordered_masks=misordered_masks) for _ in range(depth)
        )
        self.cat_x_proj = nn.Linear(2 * DIM, DIM)
        self.loc_head = MlpLayer(DIM, 2 * DIM, 2 * steps)
        self.yaw_head = MlpLayer(DIM, 2 * DIM, 2 * steps)
        self.vel_head = MlpLayer(DIM, 2 * DIM, 2 * steps)
        self.pi_head = MlpLayer(DIM, DIM, 1)

    def forward(
        self,
        points: Tensor,
        vectors: Tensor,
        orientations: Tensor,
        valid: Tensor,
        scene: Tensor,
        keep: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Decode.

        Args:
            points: (B, R, 120, 2) of the lines [m].
            vectors: (B, R, 120, 2) to the next point [m].
            orientations: (B, R, 120) [rad].
            valid: (B, R, 120) points that exist.
            scene: (B, N, 128) tokens, that of the ego first.
            keep: (B, N) tokens that count.

        Returns:
            Trajectories (B, R, modes, steps, 6) and logits (B, R, modes).
        """
        batch, num_lines = valid.shape[:2]
        modes = self.m_emb.shape[2]
        if num_lines == 0:
            return scene.new_zeros(batch, 0, modes, self.steps, 6), scene.new_zeros(batch, 0, modes)
        lines = valid.any(dim=-1)
        embedded = self._embed_lines(points, vectors, orientations, valid)
        shape = (batch, num_lines, modes, DIM)
        x = self.q_proj(
            torch.cat([embedded[:, :, None].expand(shape), self.m_emb.expand(shape)], dim=-1)
        )
        for block in self.decoder_blocks:
            x = block(x, lines, self.m_pos, scene, keep)
        x = self.cat_x_proj(torch.cat([x, scene[:, None, None, 0].expand(shape)], dim=-1))
        heads = (self.loc_head, self.yaw_head, self.vel_head)
        steps = (batch, num_lines, modes, self.steps, 2)
        trajectory = torch.cat([head(x).reshape(steps) for head in heads], dim=-1)
        logits = self.pi_head(x)[..., 0].masked_fill(~lines[:, :, None], NEVER)
        return trajectory, logits

    def _embed_lines(
        self, points: Tensor, vectors: Tensor, orientations: Tensor, valid: Tensor
    ) -> Tensor:
        """(B, R, 128)."""
        parts = (
            points - points[:, :, :1],
            vectors,
            torch.stack([orientations.cos(), orientations.sin()], dim=-1),
        )
        start = torch.cat([points[:, :, 0], orientations[:, :, :1]], dim=-1)
        out: Tensor = self.r_encoder(torch.cat(parts, dim=-1), valid) + self.r_pos_emb(start)
        return out
