"""The decoder of PLUTO's network: trajectories along reference lines."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.network.blocks import DIM, PointsEncoder, Prepared
from shiftsim.planners.learned.network.rows import (
    ROWS,
    Attention,
    Linear,
    Packing,
    Scenes,
    by_columns,
    filled,
    linear,
    make_packing,
)

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


class MotionHeads(NamedTuple):
    """Several `MlpLayer` that read the same rows, H of them, as few products."""

    enter: tuple[Tensor, Tensor]  # (H * 256, 128) weight and (H * 256,) bias
    norm: tuple[Tensor, Tensor]  # (H, 256) scale and shift
    leave: tuple[Tensor, Tensor]  # (H, 1, 160) bias and (H, 256, 160) weight


def motion_heads(layers: Sequence[MlpLayer]) -> MotionHeads:
    """Of heads, each for two of the channels of a motion."""
    enter, bias, scale, shift, leave, leave_bias = _stacked([layer.mlp for layer in layers])
    first = by_columns(enter.flatten(0, 1)), bias.flatten()
    last = leave_bias[:, None], leave.transpose(1, 2).contiguous()
    return MotionHeads(first, (scale, shift), last)


def motion(x: Tensor, heads: MotionHeads) -> Tensor:
    """(..., steps, 2 H) from x (..., 128)."""
    rows = filled(x.reshape(-1, x.shape[-1]))
    scale, shift = heads.norm
    hidden = linear(rows, *heads.enter).view(len(rows), *scale.shape)
    hidden = torch.addcmul(shift, functional.layer_norm(hidden, scale.shape[1:]), scale).relu_()
    bias, weight = heads.leave
    out = torch.baddbmm(bias, hidden.transpose(0, 1), weight)  # (H, rows, 2 * steps)
    count = math.prod(x.shape[:-1])
    by_step = out[:, :count].view(len(scale), count, STEPS, 2).permute(1, 2, 0, 3)
    return by_step.reshape(*x.shape[:-1], STEPS, 2 * len(scale))


def _stacked(mlps: Iterable[nn.Module]) -> list[Tensor]:
    """Weights of several alike: Linear, LayerNorm, ReLU, Linear."""
    each = zip(*(mlp.parameters() for mlp in mlps), strict=True)
    return [torch.stack(part) for part in each]


class FourierEmbedding(Prepared):
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
        turns = (few * self.freqs.weight).mul_(2.0 * torch.pi)
        waves = torch.cat([turns.cos(), turns.sin(), few], dim=-1)
        (bias, weight), (scale, shift), leave = self.prepared()
        hidden = torch.baddbmm(bias, waves.transpose(0, 1), weight)  # (inputs, rows, 128)
        hidden = torch.addcmul(shift, functional.layer_norm(hidden, (DIM,)), scale).relu_()
        total = linear(hidden.transpose(0, 1).flatten(1), *leave)
        return self.to_out(total)[: len(rows)].view(*x.shape[:-1], DIM)

    def prepare(self) -> tuple[tuple[Tensor, Tensor], ...]:
        """The layers of all scalars, of which the last add up: one product reads them all."""
        weight, bias, scale, shift, leave, leave_bias = _stacked(self.mlps)
        first = bias[:, None], weight.transpose(1, 2).contiguous()
        last = by_columns(leave.transpose(0, 1).flatten(1)), leave_bias.sum(dim=0)
        return first, (scale[:, None], shift[:, None]), last


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
        self, x: Tensor, lines: "Lines", place: Tensor, tokens: Tensor, scenes: Scenes
    ) -> Tensor:
        """Refine queries (L * rows, 128) of reference lines by tokens (T, 128) of the scenes.

        `place` (rows, 384) is what the modes add to their queries, keys and values.
        """
        x = x + self._among_lines(self.norm1(x), lines)
        x = x + self._among_modes(self.norm2(x), lines, place)
        x = (x.view(len(lines.valid), -1) * lines.valid[:, None]).view(x.shape)
        asking = [count * lines.rows for count in lines.counts]
        x = x + self.cross_attn.among(self.norm3(x), tokens, asking, scenes)
        return x + self.ffn(self.norm4(x))

    def _among_lines(self, x: Tensor, lines: "Lines") -> Tensor:
        """Every mode of a line attends to the same mode of the scene's others."""
        if lines.masks is None:
            return self.r2r_attn.to_itself(x)
        by_line = (len(lines.valid), lines.rows, DIM)
        parts = [
            torch.split(part.view(by_line), lines.counts)
            for part in self.r2r_attn.projected(x, x, x)
        ]
        mixed = []
        for q, k, v, mask in zip(*parts, lines.masks, strict=True):
            by_mode = self.r2r_attn.mixed(
                q.transpose(0, 1), k.transpose(0, 1), v.transpose(0, 1), mask
            )
            mixed.append(by_mode.transpose(0, 1))
        return self.r2r_attn.out_proj(torch.cat(mixed).flatten(0, 1))

    def _among_modes(self, x: Tensor, lines: "Lines", place: Tensor) -> Tensor:
        """Every mode of a line attends to the line's others."""
        attn = self.m2m_attn
        asked = linear(x, attn.in_proj_weight, attn.in_proj_bias)
        q, k, v = (asked.view(len(lines.valid), *place.shape) + place).chunk(3, dim=-1)
        mixed = attn.mixed(q, k[:, :MODES], v[:, :MODES])
        return attn.out_proj(mixed.flatten(0, 1))


class Lines(NamedTuple):
    """How the reference lines of B scenes lie one after another."""

    counts: list[int]  # how many each scene has
    valid: Tensor  # (L,) those that have points
    # by scene (1 or modes, 1, 1, count) logits added to the lines attended to; None where each
    # scene has one, which attends to itself
    masks: list[Tensor] | None
    rows: int  # of a line: the modes, and the last one again where products would have too few rows


def make_lines(
    valid: Tensor, counts: Sequence[int], packing: Packing, *, misordered_masks: bool
) -> Lines:
    """From lines (B, R) that have points, of which `counts` are no padding."""
    if set(counts) == {1} and not misordered_masks:
        rows = ROWS if len(counts) == 1 and not valid.is_cuda else MODES
        return Lines(list(counts), packing.pack(valid), None, rows)
    # a scene without any line that has points attends to all of them, and nothing reads it
    attended = valid | ~valid.any(dim=1, keepdim=True)
    logits = torch.zeros(valid.shape, device=valid.device).masked_fill(~attended, -torch.inf)
    if misordered_masks:  # nuPlan rule 307: by mode, where the queries are ordered by scene
        logits = logits.repeat(MODES, 1).reshape(len(valid), MODES, -1)
    else:
        logits = logits[:, None]
    masks = [row[:, None, None, :count] for row, count in zip(logits, counts, strict=True)]
    return Lines(list(counts), packing.pack(valid), masks, MODES)


class PlanningDecoder(Prepared):
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
        valid = seen.line_valid.any(dim=-1)
        if not any(counts):
            shape = (*valid.shape, MODES)
            return tokens.new_zeros(*shape, STEPS, 6), tokens.new_full(shape, NEVER)
        packing = make_packing([valid.shape[1]], [counts], valid.device)
        lines = make_lines(valid, counts, packing, misordered_masks=self.misordered_masks)
        modes, places, heads = self.prepared()
        wide = (len(lines.valid), lines.rows, DIM)
        embedded = packing.pack(self._embed_lines(seen))
        pairs = [embedded[:, None].expand(wide), modes[: lines.rows].expand(wide)]
        x = self.q_proj(torch.cat(pairs, dim=-1).flatten(0, 1))
        for block, place in zip(self.decoder_blocks, places, strict=True):
            x = block(x, lines, place[: lines.rows], tokens, scenes)
        if len(egos) > 1:
            egos = egos.repeat_interleave(torch.tensor(counts, device=egos.device), dim=0)
        x = self.cat_x_proj(torch.cat([x, egos[:, None].expand(wide).flatten(0, 1)], dim=-1))
        plans = motion(x.view(wide), heads)[:, :MODES]
        logits = self.pi_head(x).view(wide[:2])[:, :MODES]
        logits = logits.masked_fill(~lines.valid[:, None], NEVER)
        return packing.unpack(plans), packing.unpack(logits, NEVER)

    def prepare(self) -> tuple[Tensor, list[Tensor], MotionHeads]:
        """Modes (rows, 128), what they add in each block (rows, 384), and the heads as one."""
        again = torch.arange(ROWS, device=self.m_pos.device).clamp(max=MODES - 1)
        modes, position = self.m_emb[0, 0][again], self.m_pos[0][again]
        places = []
        for block in self.decoder_blocks:
            assert isinstance(block, DecoderBlock)
            place = position @ block.m2m_attn.in_proj_weight[: 2 * DIM].t()
            places.append(functional.pad(place, (0, DIM)))  # values have no place
        heads = motion_heads([self.loc_head, self.yaw_head, self.vel_head])
        return modes, places, heads

    def _embed_lines(self, seen: SeenLines) -> Tensor:
        """(B, R, 128)."""
        points, angles = seen.line_points, seen.line_orientations
        directions = torch.stack([angles.cos(), angles.sin()], dim=-1)
        parts = (points - points[:, :, :1], seen.line_vectors, directions)
        start = torch.cat([points[:, :, 0], angles[:, :, :1]], dim=-1)
        lines = self.r_encoder(torch.cat(parts, dim=-1), seen.line_valid)
        return lines + self.r_pos_emb(start)
