"""Diffusion Planner: samples the future of the ego and its neighbours (planner-diffusion.md).

The official planner draws its start noise from an unseeded generator; here it is keyed by seed,
scenario and iteration, so that a run can be repeated.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from shiftsim.geometry.frames import from_frame
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.diffusion.features import (
    FeatureBuilder,
    Features,
    Single,
    lane_lines,
)
from shiftsim.planners.learned.diffusion.kernels import SAMPLES
from shiftsim.planners.learned.features import PerMap
from shiftsim.planners.learned.plan_states import plan_of_poses
from shiftsim.sim.noise import keyed_generator
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import Trajectory

NOISE_SHAPE = (11, 80, 4)  # ego and neighbours, steps, x, y, cos, sin
INPUTS = (
    "neighbor_agents_past",
    "ego_current_state",
    "static_objects",
    "lanes",
    "lanes_speed_limit",
    "lanes_has_speed_limit",
    "route_lanes",
)


class DiffusionPlanner(LearnedPlanner[Features, Single]):
    """The Diffusion Planner with a checkpoint."""

    name = "diffusion-planner"

    def __init__(self, checkpoint: str, *, device: str = "cpu") -> None:
        """Load the network.

        Args:
            checkpoint: File, folder, name, or `deterministic:base|drive`; see `load_weights`.
            device: `cpu`, `cuda`, `cuda:N` or `auto`.
        """
        from shiftsim.planners.learned.checkpoint import load_weights
        from shiftsim.planners.learned.device import resolve_device
        from shiftsim.planners.learned.diffusion.network import build_network

        weights = load_weights(checkpoint, "diffusion-planner", device=device)
        network = build_network(weights.args)
        network.load_state_dict(weights.state)
        self._device = resolve_device(device)
        self._network = network.to(self._device).eval()
        self._lanes = PerMap(lane_lines)
        self._reason = ""

    def reset(self, scene: SceneInfo) -> None:
        """Prepare for a scenario: its map and its route."""
        self._build = FeatureBuilder(scene, self._lanes(scene.map))
        self._key = (scene.seed, scene.token)
        self.degraded = ""

    def features(self, observation: Observation) -> Features:
        """What the network reads, and the start noise of this iteration."""
        draw = keyed_generator(*self._key, f"planner-diffusion-{observation.iteration}")
        noise = draw.standard_normal(NOISE_SHAPE, np.float32)
        out = self._build(observation, noise)
        self._reason = why_makeshift(out, len(observation.history.ego))
        return out

    def infer(self, features: Sequence[Features]) -> Sequence[Single]:
        """Trajectories (11, 80, 4) of ego and neighbours: x, y [m], cos, sin in the ego frame."""
        import torch

        with torch.inference_mode():
            inputs = {name: self._batch(features, name) for name in INPUTS}
            out = self._network(inputs, self._batch(features, "noise"))
            return list(out.cpu().numpy())

    def decode(self, output: Single, observation: Observation) -> Trajectory:
        """The ego's trajectory in the map frame."""
        self.degraded = self._reason
        return decode_ego(output, observation)

    def _batch(self, features: Sequence[Features], name: str) -> Any:
        import torch

        stacked = np.stack([getattr(one, name) for one in features])
        return torch.from_numpy(stacked).to(self._device)


def decode_ego(output: Single, observation: Observation) -> Trajectory:
    """The ego's trajectory in the map frame, from trajectories (A, T, 4) in the ego frame."""
    ego = output[0].astype(np.float64)
    heading = np.arctan2(ego[:, 3], ego[:, 2])
    poses = from_frame(np.column_stack([ego[:, :2], heading]), observation.history.ego[-1])
    return plan_of_poses(poses, observation.history)


def why_makeshift(features: Features, num_samples: int) -> str:
    """Why the official planner would fail here; empty where it would not.

    Args:
        features: What was found.
        num_samples: Samples of the history.
    """
    if features.route is None:
        return "the scenario has no route on the map"
    if len(features.edges) == 0:
        return "no lane within 100 m"
    if num_samples < SAMPLES:
        return f"the history has {num_samples} samples; the network was trained with {SAMPLES}"
    return ""
