"""The decoder of PLUTO's network: trajectories along reference lines."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from shiftsim.planners.learned.network.blocks import DIM, PointsEncoder
from shiftsim.planners.learned.network.rows import Attention, Linear, Scenes, filled, present

DEPTH, HEADS, MODES, STEPS = 4, 4, 12, 80
NUM_FREQUENCIES = 64
LINE_CHANNELS = 6
NEVER = -1e6  # logit of a reference line without points


class SeenLines(Protocol):
    """What the decoder reads of the inputs, as described there."""

    line_points: Tensor
    line_vectors: Tensor
    line_orientations: Tensor
    line_valid: Tensor


class MlpLayer(nn.Module):
    """Linear, LayerNorm, ReLU, Linear."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            Linear(inputs, hidden), nn.LayerNorm(hidden), nn.ReLU(), Linear(hidden, outputs)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        rows = x.reshape(-1, x.shape[-1])
        out = self.mlp(filled(rows))[: len(rows)]
        return out.view(*x.shape[:-1], out.shape[1])


class FourierEmbedding(nn.Module):
    """A vector from a few scalars, each by its own frequencies and layers; the sum counts."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.freqs = nn.Embedding(inputs, NUM_FREQUENCIES)
        self.mlps = nn.ModuleList(
            nn.Sequential(
                Linear(2 * NUM_FREQUENCIES + 1, DIM), nn.LayerNorm(DIM), nn.ReLU(), Linear(DIM, DIM)
            )
            for _ in range(inputs)
        )
        self.to_out = nn.Sequential(nn.LayerNorm(DIM), nn.ReLU(), Linear(DIM, DIM))

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) to (..., 128)."""
        rows = x.reshape(-1, x.shape[-1])
        few = filled(rows)[..., None]
        turns = few * self.freqs.weight * (2.0 * torch.pi)
        waves = torch.cat([turns.cos(), turns.sin(), few], dim=-1)
        total = self.mlps[0](waves[:, 0])
        for index in range(1, len(self.mlps)):
            total = total + self.mlps[index](waves[:, index])
        return self.to_out(total)[: len(rows)].view(*x.shape[:-1], DIM)


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
        self, x: Tensor, lines: "Lines", mode_position: Tensor, tokens: Tensor, scenes: Scenes
    ) -> Tensor:
        """Refine queries (L, modes, 128) of reference lines by tokens (T, 128) of the scenes."""
        x = x + self._among_lines(self.norm1(x), lines)
        normed = self.norm2(x)
        placed = normed + mode_position
        x = x + self.m2m_attn(placed, placed, normed)
        x = x * lines.valid[:, None, None]

        modes = x.shape[1]
        asking = [count * modes for count in lines.counts]
        flat = x.flatten(0, 1)
        flat = flat + self.cross_attn.among(self.norm3(flat), tokens, asking, scenes)
        flat = flat + self.ffn(self.norm4(flat))
        return flat.view(x.shape)

    def _among_lines(self, x: Tensor, lines: "Lines") -> Tensor:
        """(L, modes, 128): every mode of a line attends to the same mode of the scene's others."""
        parts = [torch.split(part, lines.counts) for part in self.r2r_attn.projected(x, x, x)]
        mixed = []
        for q, k, v, mask in zip(*parts, lines.masks, strict=True):
            by_mode = self.r2r_attn.mixed(
                q.transpose(0, 1), k.transpose(0, 1), v.transpose(0, 1), mask
            )
            mixed.append(by_mode.transpose(0, 1))
        return self.r2r_attn.out_proj(torch.cat(mixed))


class Lines(NamedTuple):
    """How the reference lines of B scenes lie one after another."""

    counts: list[int]  # how many each scene has
    valid: Tensor  # (L,) those that have points
    masks: list[Tensor]  # by scene (1 or modes, 1, 1, count) logits added to the lines attended to


def make_lines(valid: Tensor, counts: Sequence[int], *, misordered_masks: bool) -> Lines:
    """From lines (B, R) that have points, of which `counts` are no padding."""
    # a scene without any line that has points attends to all of them, and nothing reads it
    attended = valid | ~valid.any(dim=1, keepdim=True)
    logits = torch.zeros(valid.shape, device=valid.device).masked_fill(~attended, -torch.inf)
    if misordered_masks:  # nuPlan rule 307: by mode, where the queries are ordered by scene
        logits = logits.repeat(MODES, 1).reshape(len(valid), MODES, -1)
    else:
        logits = logits[:, None]
    masks = [row[:, None, None, :count] for row, count in zip(logits, counts, strict=True)]
    there = present(counts, valid.shape[1], valid.device)
    return Lines(list(counts), valid[there], masks)


class PlanningDecoder(nn.Module):
    """Twelve trajectories and their logits for every reference line."""

    def __init__(self) -> None:
        super().__init__()
        self.misordered_masks = False  # for comparisons with the official network
        self.r_encoder = PointsEncoder(LINE_CHANNELS)
        self.r_pos_emb = FourierEmbedding(3)
        self.q_proj = Linear(2 * DIM, DIM)
        self.m_emb = nn.Parameter(torch.zeros(1, 1, MODES, DIM))
        self.m_pos = nn.Parameter(torch.zeros(1, MODES, DIM))
        self.decoder_blocks = nn.ModuleList(DecoderBlock() for _ in range(DEPTH))
        self.cat_x_proj = Linear(2 * DIM, DIM)
        heads = (MlpLayer(DIM, 2 * DIM, 2 * STEPS) for _ in range(3))
        self.loc_head, self.yaw_head, self.vel_head = heads
        self.pi_head = MlpLayer(DIM, DIM, 1)

    def forward(
        self, seen: SeenLines, counts: Sequence[int], tokens: Tensor, scenes: Scenes, egos: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Trajectories (B, R, modes, steps, 6) and logits (B, R, modes).

        `counts` says how many lines of each scene are no padding; `tokens` (T, 128) are those of
        the scenes, `egos` (B, 128) of the egos.
        """
        valid = seen.line_valid
        shape = (*valid.shape[:2], MODES)
        trajectory = tokens.new_zeros(*shape, STEPS, 6)
        logits = tokens.new_full(shape, NEVER)
        if not any(counts):
            return trajectory, logits
        lines = make_lines(valid.any(dim=-1), counts, misordered_masks=self.misordered_masks)
        there = present(counts, valid.shape[1], valid.device)
        embedded = self._embed_lines(seen)[there]
        wide = (len(embedded), MODES, DIM)
        x = self.q_proj(
            torch.cat([embedded[:, None].expand(wide), self.m_emb[0].expand(wide)], dim=-1)
        )
        for block in self.decoder_blocks:
            x = block(x, lines, self.m_pos, tokens, scenes)
        own = egos.repeat_interleave(torch.tensor(counts, device=egos.device), dim=0)
        x = self.cat_x_proj(torch.cat([x, own[:, None].expand(wide)], dim=-1))
        heads = (self.loc_head, self.yaw_head, self.vel_head)
        steps = (len(x), MODES, STEPS, 2)
        trajectory[there] = torch.cat([head(x).reshape(steps) for head in heads], dim=-1)
        logits[there] = self.pi_head(x)[..., 0].masked_fill(~lines.valid[:, None], NEVER)
        return trajectory, logits

    def _embed_lines(self, seen: SeenLines) -> Tensor:
        """(B, R, 128)."""
        points, angles = seen.line_points, seen.line_orientations
        directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
        parts = (points - points[:, :, :1], seen.line_vectors, directions)
        start = torch.cat([points[:, :, 0], angles[:, :, :1]], dim=-1)
        lines = self.r_encoder(torch.cat(parts, dim=-1), seen.line_valid)
        return lines + self.r_pos_emb(start)
