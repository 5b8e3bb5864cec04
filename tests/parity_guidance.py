"""Collision guidance of the Diffusion Planner's sampler.

Off in the published configuration; here to compare with its reference. Boxes that come within a
metre of the ego's, or overlap it, push the ego sideways; the push is smoothed over time. It follows
from the distances in closed form, because headings and neighbours count as fixed.
"""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from shiftsim.planners.learned.diffusion.network import DiffusionNetwork
from shiftsim.planners.learned.diffusion.network_sampler import SCHEDULE, STATE
from shiftsim.world.state import PACIFICA

SCALE = 0.5  # of the gradient
WEIGHT = 3.0  # of the energy
FIRST, LAST = 0.1, 0.005  # diffusion times between which it acts
REACH, MARGIN = 1.0, 1.0  # m: distance that counts as near, and what both boxes are enlarged by
REAR_TO_CENTER = 1.67  # m, of the ego; nuPlan's is 1.461
_SPREAD, _HALF = 2.0, 10  # of the smoothing: exp(-s^2 / 4) for s from -2 to 2 over 21 samples
_FAR = 1e5  # m
_FEW = 1e-5  # keeps means of nothing at zero

Network = Callable[[Tensor, int], Tensor]


def with_guidance(
    call: Network, network: DiffusionNetwork, agents: Tensor, absent: Tensor
) -> Network:
    """The network for `sample` with the push added to the clean trajectories.

    `agents` (B, N, samples, 11) are not normalised; `absent` (B, A) are predicted, but not there.
    """
    count = absent.shape[1] - 1
    sizes = agents[:, :count, -1, [7, 6]]  # length, width

    def guided(x: Tensor, number: int) -> Tensor:
        clean = call(x, number)
        time = float(SCHEDULE.call_times[number])
        if not LAST < time < FIRST:
            return clean
        states = clean.view(*clean.shape[:-1], -1, STATE).clone()
        states[:, :, 0] = x[..., :STATE]
        push = _push(network.denormalise(states), sizes, ~absent[:, 1:])
        factor = SCALE * WEIGHT * float(SCHEDULE.sigma[number] ** 2 / SCHEDULE.alpha[number])
        out = clean.view_as(states).clone()
        out[:, 0, :, :2] += factor * push * network.state_normaliser.std[:2]
        return out.flatten(2)

    return guided


def _push(states: Tensor, sizes: Tensor, present: Tensor) -> Tensor:
    """(B, T, 2) gradient of the energy by the ego's positions, sideways and smoothed.

    Of trajectories (B, A, T, 4), ego first, neighbours' sizes (B, A - 1, 2) [m] and their presence.
    """
    heading = functional.normalize(states[..., 2:], dim=-1)
    ego = states[:, :1, 1:, :2] + REAR_TO_CENTER * heading[:, :1, 1:]
    body = torch.tensor([PACIFICA.length, PACIFICA.width], device=states.device)
    distance, away = _distances(
        ego - states[:, 1:, 1:, :2],
        heading[:, :1, 1:],
        heading[:, 1:, 1:],
        body + MARGIN,
        sizes[:, :, None] + MARGIN,
    )
    near = (1.0 - distance / REACH).clamp(min=0.0) * present[..., None]
    total, slope = near.new_zeros(len(near)), torch.zeros_like(near)
    for group in (near > 1.0, (near > 0.0) & (near <= 1.0)):
        size = group.sum(dim=(1, 2)) + _FEW
        total = total + (near * group).sum(dim=(1, 2)) / size
        slope = slope + group / size[:, None, None]
    force = (slope[..., None] * away).sum(dim=1) / REACH * torch.exp(total)[:, None, None]
    force = functional.pad(force, (0, 0, 1, 0))  # nothing at the present
    left = torch.stack([-heading[:, 0, :, 1], heading[:, 0, :, 0]], dim=-1)
    return _smoothed((force * left).sum(dim=-1))[..., None] * left


def _smoothed(values: Tensor) -> Tensor:
    """(B, T) weighted sums over neighbouring samples; the ends go on."""
    at = torch.linspace(-_SPREAD, _SPREAD, 2 * _HALF + 1, device=values.device)
    weights = torch.exp(-(at**2) / 4.0)
    padded = functional.pad(values[:, None], (_HALF, _HALF), mode="replicate")
    return functional.conv1d(padded, weights[None, None])[:, 0]


def _distances(
    offset: Tensor, first: Tensor, second: Tensor, size: Tensor, other: Tensor
) -> tuple[Tensor, Tensor]:
    """Signed distances of boxes along their own axes, and which way the first gets away.

    Separated boxes have the smallest gap over the axes that separate them (which is not their
    distance), others minus the least overlap. `offset` (B, N, T, 2) leads from the second centre to
    the first; headings are unit vectors, sizes length and width.
    """
    gaps, axes = [], []
    for heading in (first, second):
        for axis in (heading, _turned(heading)):
            reach = _half_width(axis, first, size) + _half_width(axis, second, other)
            along = (axis * offset).sum(dim=-1)
            for side in (1.0, -1.0):
                gaps.append(side * along - reach)
                axes.append((side * axis).expand_as(offset))
    gap = torch.stack(gaps, dim=-1)
    overlap = (gap < 0.0).all(dim=-1)
    outside = torch.where(gap < 0.0, _FAR, gap).min(dim=-1)
    inside = gap.max(dim=-1)
    distance = torch.where(overlap, inside.values, outside.values)
    chosen = torch.where(overlap, inside.indices, outside.indices)
    index = chosen[..., None, None].expand(*chosen.shape, 1, 2)
    return distance, torch.stack(axes, dim=-2).gather(-2, index)[..., 0, :]


def _turned(heading: Tensor) -> Tensor:
    return torch.stack([-heading[..., 1], heading[..., 0]], dim=-1)


def _half_width(axis: Tensor, heading: Tensor, size: Tensor) -> Tensor:
    """Half the extent of a box along an axis."""
    along = (axis * heading).sum(dim=-1).abs() * size[..., 0]
    across = (axis * _turned(heading)).sum(dim=-1).abs() * size[..., 1]
    return 0.5 * (along + across)
