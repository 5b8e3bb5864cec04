"""Diffusion Planner: samples the future of the ego and its neighbours.

The official planner draws its start noise from an unseeded generator; here it is keyed by seed,
scenario and iteration, so that a run can be repeated.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from shiftsim.geometry.boxes import from_frame
from shiftsim.planners.learned import features
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.diffusion.features import (
    FeatureBuilder,
    Features,
    Single,
    lane_lines,
)
from shiftsim.sim.noise import keyed_generator
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.map import PerMap
from shiftsim.world.state import Trajectory

NOISE_SHAPE = (11, 80, 4)  # ego and neighbours, steps, x, y, cos, sin
INPUTS = (
    *("neighbor_agents_past", "ego_current_state", "static_objects"),
    *("lanes", "lanes_speed_limit", "lanes_has_speed_limit", "route_lanes"),
)

_lanes_of = PerMap(lane_lines)


class DiffusionPlanner(LearnedPlanner[Features, Single]):
    """The Diffusion Planner with a checkpoint."""

    name = "diffusion-planner"

    def reset(self, scene: SceneInfo) -> None:
        """Prepare for a scenario: its map and its route."""
        self._build = FeatureBuilder(scene, _lanes_of(scene.map))
        self._key = (scene.seed, scene.token)
        self.degraded = self._reason = ""

    def features(self, observation: Observation) -> Features:
        """What the network reads, and the start noise of this iteration."""
        draw = keyed_generator(*self._key, f"planner-diffusion-{observation.iteration}")
        noise = draw.standard_normal(NOISE_SHAPE, np.float32)
        out = self._build(observation, noise)
        # why the official planner would fail here
        if out.route is None:
            self._reason = features.NO_ROUTE
        elif len(out.edges) == 0:
            self._reason = "no lane within 100 m"
        else:
            self._reason = features.short_history(len(observation.history.ego))
        return out

    def infer(self, scenes: Sequence[Features]) -> Sequence[Single]:
        """Trajectories (11, 80, 4) of ego and neighbours: x, y [m], cos, sin in the ego frame."""
        import torch

        with torch.inference_mode():
            inputs = make_inputs(scenes, self.device)
            (noise,) = features.stack_scenes([[one.noise] for one in scenes], self.device)
            return list(self.network(inputs, noise).cpu().numpy())

    def decode(self, output: Single, observation: Observation) -> Trajectory:
        """The ego's trajectory in the map frame."""
        self.degraded = self._reason
        history = observation.history
        return features.plan_of_poses(
            from_frame(features.poses_of(output[0]), history.ego[-1]), history
        )


def make_inputs(scenes: Sequence[Features], device: str) -> dict[str, Any]:
    """Tensors that the network reads, by name."""
    rows = [[getattr(one, name) for name in INPUTS] for one in scenes]
    return dict(zip(INPUTS, features.stack_scenes(rows, device), strict=True))
