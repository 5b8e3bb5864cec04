"""What the authors' trainings of PlanTF, PLUTO and Diffusion Planner minimise, and how.

Losses are plain functions of a network's outputs and of what was recorded; a loss is the sum of its
terms, each of weight 1. Then the groups of parameters, the learning rates by epoch, and the first
values of a network. B scenes, A agents of which the first is the ego, T = 80 steps of 0.1 s.
"""

import copy
import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from shiftsim.planners.learned.checkpoint import network_module
from shiftsim.planners.learned.diffusion.network import DiffusionNetwork
from shiftsim.planners.learned.diffusion.network_sampler import log_alpha_at
from shiftsim.planners.learned.network import Attention
from shiftsim.planners.learned.plantf.network import Outputs as PlanTfOutputs
from shiftsim.planners.learned.pluto.network import NEVER
from shiftsim.planners.learned.pluto.network import Outputs as PlutoOutputs
from shiftsim.train.folder import TERMS, Preset, Weights
from shiftsim.train.learning import (
    BatchGradient,
    GradientPool,
    StepResult,
    TrainedNetwork,
    keep_memory,
    schedule,
)
from shiftsim.train.samples import Batch
from shiftsim.world.state import PACIFICA

Losses = dict[str, Tensor]  # terms by name, and `loss`, their sum

MODE_LENGTH = 10.0  # m of a reference line for each of PLUTO's modes
# three circles of PLUTO along the ego: places ahead of the rear axle, and their radius [m]
_THIRD = PACIFICA.length / 3.0
CIRCLES = [PACIFICA.rear_axle_to_center + place * _THIRD for place in (-1.0, 0.0, 1.0)]
CIRCLE_RADIUS = 0.5 * math.hypot(PACIFICA.width, _THIRD) - 0.2
PIXEL, INSIDE = 0.2, 0.95  # m; share of the raster in which a point counts
TEMPERATURE = 0.1  # of the contrastive loss
WARM_UP, FLOOR = 0.05, 2e-3  # here: share of rising, end of the learning rate as a share
# layers of Diffusion Planner that begin small, and at zero
_TIME = ("t_embedder.mlp.0", "t_embedder.mlp.2")
SMALL = ("pos_emb", "type_emb", "speed_limit_emb", "traffic_emb", *_TIME)
ZERO = ("adaLN_modulation.1", "final_layer.proj.4")
# here plans and predictions are in units of two rows: at once, and what they grow by per second
PLAN_MEAN = ((0.0, 0.0, 1.0, 0.0, 4.5, 0.0), (4.5, 0.0, 0.0, 0.0, 0.0, 0.0))
PLAN_SIZE = ((0.5, 0.3, 0.05, 0.15, 2.0, 1.0), (2.5, 1.5, 0.04, 0.05, 0.2, 0.2))
OTHERS_MEAN = ((0.0, 0.0, 1.0, 0.0, 0.0, 0.0), (0.0,) * 6)
OTHERS_SIZE = ((0.2, 0.2, 0.1, 0.2, 1.0, 1.0), (2.0, 2.0, 0.05, 0.05, 0.2, 0.2))
_PLACE, _HEADING, _VELOCITY, _POSE = slice(2), slice(2, 4), slice(4, 6), slice(4)
_OF_PLUTO = (("loc", _PLACE), ("yaw", _HEADING), ("vel", _VELOCITY))
LAST_LAYERS = {  # of networks, and the columns that they say
    "plantf": {"trajectory_decoder.loc.3": _POSE, "agent_predictor.3": _PLACE},
    "pluto": {
        "ref_free_decoder.mlp.3": _POSE,
        **{f"planning_decoder.{name}_head.mlp.3": columns for name, columns in _OF_PLUTO},
        **{f"agent_predictor.{name}_predictor.mlp.3": columns for name, columns in _OF_PLUTO},
    },
}
FINENESS = 5.0  # of a loss: errors above the share 1 / FINENESS of a unit count in proportion
DRAWS, EARLIEST = 8, 1e-3  # of Diffusion Planner: for each scene; least time
DECAYS = {"diffusion-planner": 0.01}  # of the weights, where it is not 1e-4 of products only
HIGHEST = {"diffusion-planner": 5e-4}  # learning rate, whatever the preset
HIDDEN = 0.5  # here: share of the scalars of the ego state that are not shown
LANES = 2  # parts of a batch that a CPU computes side by side


def _sum(**terms: Tensor) -> Losses:
    return {"loss": torch.stack([term.reshape(()) for term in terms.values()]).sum(), **terms}


def _mean_of(values: Tensor, valid: Tensor) -> Tensor:
    """Sum of the values (...) that are valid (...) over their number; 0 where none is."""
    return values[valid].sum() / valid.sum().clamp(min=1)


def motion(target: Tensor) -> Tensor:
    """(..., 4) x, y, cosine and sine of the heading of (..., 3) x, y, heading."""
    angle = target[..., 2:]
    return torch.cat([target[..., :2], angle.cos(), angle.sin()], dim=-1)


class Units(NamedTuple):
    """What plans and predictions are measured in by step: in metres the last seconds outweigh all.

    Columns are x, y [m], cosine and sine of the heading, velocity [m/s].
    """

    mean: Tensor  # (80, 6) of the plan
    size: Tensor  # (80, 6) of what differs from it
    others_mean: Tensor  # (80, 6) of the predictions
    others_size: Tensor  # (80, 6)

    @classmethod
    def make(cls, device: str) -> "Units":
        """As in what was recorded in all kinds of towns, about."""
        time = 0.1 * torch.arange(1, 81, device=device)[:, None]
        rows = torch.tensor([PLAN_MEAN, PLAN_SIZE, OTHERS_MEAN, OTHERS_SIZE], device=device)
        return cls(*(at_once + per_second * time for at_once, per_second in rows))

    def layers(self, planner: str) -> dict[str, tuple[Tensor, Tensor]]:
        """By last layer of a network: mean and size of its outputs, each (outputs,)."""
        of_plan, of_others = (self.mean, self.size), (self.others_mean, self.others_size)
        found = {}
        for name, columns in LAST_LAYERS[planner].items():
            mean, size = of_others if "agent_predictor" in name else of_plan
            found[name] = mean[:, columns].flatten(), size[:, columns].flatten()
        return found

    def in_metres(self, planner: str, weights: Weights) -> Weights:
        """Weights of a network whose last layers are in these units as files have them."""
        found = dict(weights)
        for name, (mean, size) in self.layers(planner).items():
            found[f"{name}.weight"] = weights[f"{name}.weight"] * size[:, None]
            found[f"{name}.bias"] = weights[f"{name}.bias"] * size + mean
        return found


def plantf_loss(
    out: PlanTfOutputs, target: Tensor, valid: Tensor, units: Units | None = None
) -> Losses:
    """Of PlanTF: `reg_loss`, `cls_loss` of the mode nearest to the target, `prediction_loss`.

    Args:
        out: What the network says.
        target: (B, A, 80, 3) of `samples.targets`.
        valid: (B, A, 80) whether it was recorded. The terms of the ego take all of it.
        units: What errors are measured in, a fifth of it; None for metres.
    """
    ego = motion(target[:, 0])
    away = torch.linalg.vector_norm(out.trajectory[..., :2].detach() - ego[:, None, :, :2], dim=-1)
    best = away.sum(dim=-1).argmin(dim=-1)
    chosen = out.trajectory[torch.arange(len(best), device=best.device), best]
    said, others = out.prediction, target[:, 1:, :, :2]
    if units:
        chosen, ego = (value * FINENESS / units.size[:, _POSE] for value in (chosen, ego))
        said, others = (value * FINENESS / units.others_size[:, _PLACE] for value in (said, others))
    others = functional.smooth_l1_loss(said, others, reduction="none")
    return _sum(
        reg_loss=functional.smooth_l1_loss(chosen, ego),
        cls_loss=functional.cross_entropy(out.probability, best),
        prediction_loss=_mean_of(others.mean(dim=-1), valid[:, 1:]),
    )


def pluto_assignment(projection: Tensor, lines: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """(B,) reference line and mode that PLUTO has to choose, by (B, R, 8, 2) of `projections`.

    `lines` (B, R) say whether a line has points, `valid` (B, 80) which steps of the ego count.
    """
    # their index is a second late, unless all steps count
    at = (valid.sum(dim=-1) // 10).clamp(0, projection.shape[2] - 1)
    scene = torch.arange(len(at), device=at.device)
    length, distance = projection[scene, :, at].unbind(dim=-1)
    line = (distance + 1e6 * ~lines).argmin(dim=-1)
    mode = (length[scene, line] / MODE_LENGTH).floor().long()
    return line, mode.clamp(0, 11)


def road_loss(trajectory: Tensor, signed: Tensor) -> Tensor:
    """How deep the ego is beyond the edge of the road, mean over circles and steps that are.

    It drives (B, 80, 4). `signed` (B, H, W) is the distance [m] to the edge, positive on the road:
    column x / 0.2 + W / 2, row -y / 0.2 + H / 2. It is read half a pixel behind and to the left, as
    the authors do.
    """
    height, width = signed.shape[-2:]
    ahead = signed.new_tensor(CIRCLES)[:, None]
    places = trajectory[:, :, None, :2] + ahead * trajectory[:, :, None, 2:4]
    scale = signed.new_tensor([2.0 / width, -2.0 / height]) / PIXEL
    grid = places * scale
    read = functional.grid_sample(signed[:, None], grid, align_corners=False)[:, 0]
    depth = CIRCLE_RADIUS - read
    begins = signed[:, height // 2, width // 2] > 0.0
    counted = (depth > 0.0) & (grid.abs() < INSIDE).all(dim=-1) & begins[:, None, None]
    return depth[counted].sum() / (counted.sum() + 1e-6)


def contrastive_loss(hidden: Tensor, valid: Tensor) -> Tensor:
    """How much nearer anchors are to positives than to negatives; (3B, C), in this order.

    `valid` (B,) says which negatives there are; without any the loss is 0.
    """
    anchor, positive, negative = functional.normalize(hidden, dim=-1).chunk(3)
    near = [(anchor * other).sum(dim=-1) / TEMPERATURE for other in (positive, negative)]
    logits = torch.stack(near, dim=-1)
    return _mean_of(torch.logsumexp(logits, dim=-1) - logits[:, 0], valid)


def pluto_loss(
    out: PlutoOutputs,
    target: Tensor,
    valid: Tensor,
    projection: Tensor,
    *,
    signed: Tensor | None = None,
    contrast: tuple[Tensor, Tensor] | None = None,
    units: Units | None = None,
) -> Losses:
    """Of PLUTO.

    Args:
        out: What the network says.
        target: (B, A, 80, 6) of `samples.motion_targets`.
        valid: (B, A, 80) steps that count.
        projection: (B, R, 8, 2) of `samples.projections`.
        signed: (B, H, W) of `road_loss`, or None for no such term.
        contrast: Arguments of `contrastive_loss`. The batch is then anchors, positives, negatives,
            of which the last third counts in no other term.
        units: As of `plantf_loss`.
    """
    count = len(target) * 2 // 3 if contrast else len(target)
    target, valid, scene = target[:count], valid[:count], torch.arange(count, device=target.device)
    trajectory, logits = out.trajectory[:count], out.probability[:count]
    lines = logits[..., 0] > NEVER
    line, mode = pluto_assignment(projection[:count], lines, valid[:, 0])
    chosen, ego = trajectory[scene, line, mode], target[:, 0]

    def error(said: Tensor, recorded: Tensor, counted: Tensor, sizes: Tensor | None) -> Tensor:
        if sizes is not None:
            said, recorded = (v * FINENESS / sizes[:, : v.shape[-1]] for v in (said, recorded))
        each = functional.smooth_l1_loss(said, recorded, reduction="none").sum(dim=-1)
        return _mean_of(each, counted)

    own, of_others = (units.size, units.others_size) if units else (None, None)
    terms = {
        "reg_loss": error(chosen, ego, valid[:, 0], own),
        "cls_loss": functional.cross_entropy(logits.flatten(1), line * logits.shape[-1] + mode),
        "ref_free_reg_loss": error(out.ref_free_trajectory[:count], ego[..., :4], valid[:, 0], own),
        "prediction_loss": error(out.prediction[:count], target[:, 1:], valid[:, 1:], of_others),
    }
    if signed is not None:
        terms["collision_loss"] = road_loss(chosen, signed[:count])
    if contrast:
        terms["contrastive_loss"] = contrastive_loss(*contrast)
    return _sum(**terms)


def diffusion_loss(said: Tensor, clean: Tensor, valid: Tensor) -> Losses:
    """Of Diffusion Planner: how well trajectories are restored to which noise was added.

    Both are (B, A, 80, 4) normalised x, y, cosine and sine of the heading, the ego first; `clean`
    is 0 where not recorded. `valid` (B, A - 1, 80) are recorded steps of the neighbours.
    """
    error = (said - clean).square().sum(dim=-1)
    return _sum(
        neighbor_prediction_loss=_mean_of(error[:, 1:], valid),
        ego_planning_loss=error[:, 0].mean(),
    )


def diffusion_losses(network: DiffusionNetwork, batch: Batch, random: torch.Generator) -> Losses:
    """Of Diffusion Planner, mean over `DRAWS` of time and noise, which share the encoder."""
    scene = network.normalise(batch.inputs)
    current, absent = network.present(scene)
    poses = motion(batch.target)
    clean = network.state_normaliser(torch.where(batch.valid[..., None], poses, 0.0))
    options: dict[str, Any] = {"device": clean.device, "generator": random}
    times = EARLIEST + (1.0 - EARLIEST) * torch.rand((DRAWS, len(clean)), **options)
    context = network.context(scene, absent, times)
    found = []
    for call, time in enumerate(times):
        alpha = torch.exp(log_alpha_at(time))[:, None, None, None]
        noise = torch.randn(clean.shape, **options)
        noisy = alpha * clean + torch.sqrt(1.0 - alpha**2) * noise
        states = torch.cat([current[:, :, None], noisy], dim=2)
        said = network.dit(states.flatten(2), call, context).view(states.shape)[:, :, 1:]
        found.append(diffusion_loss(said, clean, batch.valid[:, 1:]))
    return {name: torch.stack([one[name] for one in found]).mean() for name in found[0]}


def parameter_groups(network: nn.Module) -> list[dict[str, Any]]:
    """Groups of an optimiser: weights of products decay, all else does not."""
    decayed, plain = list[Tensor](), list[Tensor]()
    for module in network.modules():
        products = isinstance(module, nn.Linear | nn.Conv1d | Attention)
        for name, value in module.named_parameters(recurse=False):
            (decayed if products and "weight" in name else plain).append(value)
    return [{"params": decayed, "weight_decay": 1e-4}, {"params": plain, "weight_decay": 0.0}]


def rate_of_epoch(epoch: float, epochs: int = 25, warm_up: float = 3, rate: float = 1e-3) -> float:
    """Learning rate of PlanTF and PLUTO: rises by epochs, then falls with a cosine to 1e-6."""
    if epoch < warm_up:
        return rate * (epoch + 1) / warm_up
    along = (epoch - warm_up) / (epochs - warm_up)
    return 1e-6 + 0.5 * (rate - 1e-6) * (1.0 + math.cos(math.pi * along))


def diffusion_rate_of_epoch(epoch: int, rate: float = 5e-4) -> float:
    """Learning rate of Diffusion Planner: rises over five epochs, then stays."""
    return rate * min(1.0, 0.1 + 0.9 * epoch / 4)


def begin(network: nn.Module, seed: int) -> None:
    """First values as of the authors, from a seed."""
    random = torch.Generator().manual_seed(seed)
    for name, module in network.named_modules():
        if isinstance(module, nn.Linear):
            if name.endswith(SMALL):
                nn.init.normal_(module.weight, 0.0, 0.02, generator=random)
            elif name.endswith(ZERO):
                nn.init.zeros_(module.weight)
            else:
                nn.init.xavier_uniform_(module.weight, generator=random)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
        elif isinstance(module, nn.Embedding):
            nn.init.normal_(module.weight, 0.0, 0.02, generator=random)


def losses_of(
    planner: str, network: Any, batch: Batch, random: torch.Generator, units: Units | None = None
) -> Losses:
    """Of a network that is trained; of PLUTO without the road and without contrast."""
    if planner == "diffusion-planner":
        return diffusion_losses(network, batch, random)
    network.agent_encoder.ego_state_emb.random = random
    out = network(batch.inputs)
    if planner == "pluto":
        assert batch.projection is not None
        return pluto_loss(out, batch.target, batch.valid, batch.projection, units=units)
    return plantf_loss(out, batch.target, batch.valid, units)


def _scale(mean: Tensor, size: Tensor, module: nn.Module, inputs: Any, output: Tensor) -> Tensor:
    """Hook of a layer: its outputs times sizes, above means."""
    return mean + size * output


class ImitationLearner(TrainedNetwork):
    """The network of PlanTF, PLUTO or Diffusion Planner, trained on samples of a store.

    A CPU computes the parts of a batch side by side, each with statistics of its own, as the
    authors' processes do without synchronisation; those of the first part are kept.
    """

    def __init__(self, planner: str, device: str, preset: Preset, total: int, seed: int) -> None:
        """`total` steps are to be done; the learning rate falls towards their end."""
        torch.manual_seed(seed)
        network = network_module(planner).build_network()
        begin(network, seed)
        network.to(device).train()
        self._units = None
        if planner in LAST_LAYERS and not preset.published:
            self._units = Units.make(device)
            for name, (mean, size) in self._units.layers(planner).items():
                network.get_submodule(name).register_forward_hook(partial(_scale, mean, size))
            network.agent_encoder.ego_state_emb.state_dropout = HIDDEN
        groups = parameter_groups(network)
        if planner in DECAYS:
            groups = [{"params": list(network.parameters()), "weight_decay": DECAYS[planner]}]
        super().__init__(network, groups, total, betas=(0.9, 0.999))
        self.batch, self._preset, self._device, self._seed = preset.batch, preset, device, seed
        self._planner, self.terms = planner, tuple(TERMS[planner])
        self.place = (0, 0)  # of the next batch: the block of the stream, and the batch in it
        count = LANES if device == "cpu" else 1
        self._pool = GradientPool(device, count)
        self.trained = list(network.parameters())
        self._lanes = [network]
        for _ in range(count - 1):
            shared = {id(value): value for value in self.trained}  # the rest is copied
            self._lanes.append(copy.deepcopy(network, shared))
        keep_memory()

    def learn(self, batch: Batch) -> StepResult:
        """Do one step."""
        parts = batch.on(self._device).split(len(self._lanes))
        found = self._pool.sum(self._gradient, self._lanes, parts, range(len(parts)))
        rounds, rate = self._preset.rounds, self._preset.rate
        epoch = self.step * rounds // self.total
        if not self._preset.published:
            highest = min(rate, HIGHEST.get(self._planner, rate))
            rate = highest * schedule(self.step / self.total, WARM_UP, FLOOR)
        elif self._planner == "diffusion-planner":
            rate = diffusion_rate_of_epoch(epoch)
        else:
            rate = rate_of_epoch(epoch, rounds, rate=rate)
        return self.apply(found, len(parts), rate)

    def _gradient(self, network: Any, batch: Batch, number: int) -> BatchGradient:
        """Of one part of a batch."""
        key = np.random.SeedSequence([self._seed, 4, self.step, number])
        drawn = int(key.generate_state(1, np.uint64)[0] >> np.uint64(1))
        random = torch.Generator(self._device).manual_seed(drawn)
        losses = losses_of(self._planner, network, batch, random, self._units)
        gradients = torch.autograd.grad(  # of PLUTO some layers serve the contrast only
            losses["loss"], self.trained, allow_unused=True, materialize_grads=True
        )
        numbers = torch.stack([losses[name].detach() for name in self.terms]).cpu()
        return BatchGradient(list(gradients), float(losses["loss"].detach()), numbers)

    def driving(self) -> Weights:
        """The network that drives."""
        if self._preset.published and self._planner != "diffusion-planner":
            return self.network.state_dict()
        weights = super().driving()
        return self._units.in_metres(self._planner, weights) if self._units else weights

    def state(self) -> dict[str, Any]:
        """All that is needed to go on."""
        return {**super().state(), "place": list(self.place)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from `state`."""
        super().restore(state)
        self.place = tuple(state["place"])
