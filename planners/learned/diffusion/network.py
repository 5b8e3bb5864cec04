"""The Diffusion Planner's network: scene encoder and diffusion decoder.

`state_dict()` has the keys, shapes and types of the official checkpoint.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from shiftsim.errors import CheckpointError
from shiftsim.planners.learned.deterministic import keyed_normals
from shiftsim.planners.learned.diffusion.network_layers import Context, DiT, SceneEncoder
from shiftsim.planners.learned.diffusion.network_sampler import SCHEDULE, STATE, sample
from shiftsim.world.ranges import CHECKPOINT, require

_XY = ([10.0, 0.0], [20.0, 20.0])  # mean and std [m]


def _normaliser(*std: float) -> dict[str, list[float]]:
    mean = [*_XY[0], *[0.0] * len(std)]
    return {"mean": mean, "std": [*_XY[1], *std]}


_LANE = _normaliser(*[20.0] * 6, *[1.0] * 4)
DEFAULT_ARGS: Mapping[str, Any] = {
    "future_len": 80,
    "time_len": 21,
    "agent_num": 32,
    "static_objects_num": 5,
    "lane_len": 20,
    "lane_num": 70,
    "route_len": 20,
    "route_num": 25,
    "encoder_depth": 3,
    "decoder_depth": 3,
    "num_heads": 6,
    "hidden_dim": 192,
    "predicted_neighbor_num": 10,
    "state_normalizer": _normaliser(1.0, 1.0),
    "observation_normalizer": {
        "ego_current_state": _normaliser(1.0, 1.0, 20.0, 20.0, 20.0, 20.0, 1.0, 1.0),
        "neighbor_agents_past": _normaliser(1.0, 1.0, *[20.0] * 4, 1.0, 1.0, 1.0),
        "static_objects": _normaliser(*[1.0] * 2, 20.0, 20.0, *[1.0] * 4),
        "lanes": _LANE,
        "lanes_speed_limit": {"mean": [0.0], "std": [20.0]},
        "route_lanes": _LANE,
        "route_lanes_speed_limit": {"mean": [0.0], "std": [20.0]},
    },
}

_NAME = "diffusion-planner"
_FIXED = {name for name in DEFAULT_ARGS if name.endswith(("_num", "_len"))}  # by the features
_FINAL = "decoder.decoder.dit.final_layer.proj.4"
_DRIVE_AMPLITUDES = (0.3, 0.05, 0.0, 0.05)
_DRIVE_STEP, _DRIVE_OFFSET, _DRIVE_SCALE = 0.6, 10.0, 20.0  # m per step; x is stored (x - 10) / 20


class Normaliser(nn.Module):
    """Subtract a mean, divide by a scale; rows that are all zero stay so."""

    mean: Tensor
    std: Tensor

    def __init__(self, statistics: Mapping[str, Any]) -> None:
        """Take mean and std, the same for every agent (nested lists around one row are fine)."""
        super().__init__()
        for name in ("mean", "std"):
            values = torch.tensor(statistics[name], dtype=torch.float32)
            row = values.reshape(-1, values.shape[-1])[0]
            self.register_buffer(name, row.clone(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) normalised."""
        used = (x != 0.0).any(dim=-1, keepdim=True)
        return torch.where(used, (x - self.mean) / self.std, 0.0)


class DiffusionNetwork(nn.Module):
    """The whole network."""

    def __init__(self, args: Mapping[str, Any]) -> None:
        """Make it with the dimensions and normalisers of an official args.json."""
        super().__init__()
        hidden, heads = int(args["hidden_dim"]), int(args["num_heads"])
        self.num_agents = 1 + int(args["predicted_neighbor_num"])
        encoder = SceneEncoder(hidden, heads, int(args["encoder_depth"]))
        dit = DiT(hidden, heads, int(args["decoder_depth"]))
        self.encoder = nn.ModuleDict({"encoder": encoder})
        self.decoder = nn.ModuleDict({"decoder": nn.ModuleDict({"dit": dit})})
        self.normalisers = nn.ModuleDict(
            {name: Normaliser(row) for name, row in args["observation_normalizer"].items()}
        )
        self.state_normaliser = Normaliser(args["state_normalizer"])

    @property
    def dit(self) -> DiT:
        """The diffusion transformer."""
        dit = self.get_submodule("decoder.decoder.dit")
        assert isinstance(dit, DiT)
        return dit

    def normalise(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The inputs as the network reads them; those without a normaliser as they are."""
        return {
            name: self.normalisers[name](value) if name in self.normalisers else value
            for name, value in inputs.items()
        }

    def encode(self, scene: Mapping[str, Tensor]) -> Tensor:
        """(B, N, hidden) tokens of normalised inputs."""
        return self.encoder["encoder"](
            scene["neighbor_agents_past"],
            scene["static_objects"],
            scene["lanes"],
            scene["lanes_speed_limit"],
            scene["lanes_has_speed_limit"],
        )

    def present(self, scene: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Present states (B, A, 4) of the ego and its neighbours, and who is absent (B, A)."""
        neighbours = scene["neighbor_agents_past"][:, : self.num_agents - 1, -1]
        ego = scene["ego_current_state"][:, None, :STATE]
        absent = (neighbours[..., :STATE] == 0.0).all(dim=-1)
        nobody = torch.zeros_like(absent[:, :1])
        states = torch.cat([ego, neighbours[..., :STATE]], dim=1)
        return states, torch.cat([nobody, absent], dim=1)

    def context(
        self, scene: Mapping[str, Tensor], absent: Tensor, times: Tensor | None = None
    ) -> Context:
        """What the calls of one plan share, from normalised inputs and absent agents (B, A).

        `times` (S, B or 1) are those of the calls; without them they are the sampler's.
        """
        if times is None:
            times = SCHEDULE.call_times.to(absent.device)[:, None]
        return self.dit.context(self.encode(scene), scene["route_lanes"], absent, times)

    def forward(self, inputs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Trajectories (B, A, T, 4), ego first: x, y [m], cos, sin in the ego frame.

        They begin at the next step; `noise`, of the same shape, is standard normal.
        """
        scene = self.normalise(inputs)
        current, absent = self.present(scene)
        context = self.context(scene, absent)
        states = sample(lambda x, call: self.dit(x, call, context), current, noise)
        return self.denormalise(states[:, :, 1:])

    def denormalise(self, states: Tensor) -> Tensor:
        """(..., 4) x, y [m], cos, sin of normalised ones."""
        return states * self.state_normaliser.std + self.state_normaliser.mean


def build_network(args: Mapping[str, Any] | None = None) -> DiffusionNetwork:
    """The network without its weights, by an args.json or of the official dimensions.

    Raises CheckpointError: settings lack something, or are of a network that reads other features.
    """
    if args is not None:
        _check(args)
    return DiffusionNetwork(DEFAULT_ARGS if args is None else args)


def _check(args: Mapping[str, Any]) -> None:
    for name, value in DEFAULT_ARGS.items():
        if name not in args:
            raise _wrong(f"{name!r} is missing")
        if name in _FIXED and args[name] != value:
            raise _wrong(f"{name} is {args[name]!r}, the features have {value}")
        if name in CHECKPOINT:
            require(CHECKPOINT, name, float(args[name]), f"args of {_NAME}:", error=CheckpointError)
    kind = args.get("diffusion_model_type", "x_start")
    if kind != "x_start":
        raise _wrong(f"diffusion_model_type is {kind!r}, known is 'x_start'")
    given = {**args["observation_normalizer"], "state": args["state_normalizer"]}
    known = {**DEFAULT_ARGS["observation_normalizer"], "state": DEFAULT_ARGS["state_normalizer"]}
    for name, row in known.items():
        for part in ("mean", "std"):
            values = np.asarray(given.get(name, {}).get(part, []), np.float64)
            require(CHECKPOINT, part, values, f"args of {_NAME}: {name}", error=CheckpointError)
            if values.ndim == 0 or values.shape[-1] != len(row[part]) or not values.size:
                what = f"{part} of the normaliser of {name!r} has shape {values.shape}"
                raise _wrong(f"{what}, not ({len(row[part])},)")


def _wrong(what: str) -> CheckpointError:
    hint = "use the args.json that was published with the checkpoint"
    return CheckpointError(f"args of {_NAME}: {what}", hint)


def drive_overrides(state: dict[str, np.ndarray]) -> None:
    """Turn the last layer of deterministic weights into a ramp forward, in place."""
    weight, bias = state[f"{_FINAL}.weight"], state[f"{_FINAL}.bias"]
    steps = len(bias) // STATE
    rows = keyed_normals(f"{_FINAL}.weight#drive", (STATE, weight.shape[1]))
    rows /= np.sqrt(weight.shape[1])
    ramp = np.arange(steps)[:, None] / (steps - 1) * np.array(_DRIVE_AMPLITUDES)
    weights = (ramp[:, :, None] * rows).reshape(weight.shape)
    state[f"{_FINAL}.weight"] = weights.astype(weight.dtype)
    offsets = np.zeros((steps, STATE))
    offsets[:, 0] = (_DRIVE_STEP * np.arange(steps) - _DRIVE_OFFSET) / _DRIVE_SCALE
    offsets[:, 2] = 1.0
    state[f"{_FINAL}.bias"] = offsets.reshape(-1).astype(bias.dtype)
