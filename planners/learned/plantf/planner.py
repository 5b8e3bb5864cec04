"""PlanTF: imitation learning with a transformer over agents and map.

Where the official planner would fail, this one goes on and says so: without any lane in range it
keeps heading and speed; without a route on the map, or with a history shorter than 2 s, the network
is asked all the same, with no polygon on the route and with the missing samples masked.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.planners.learned import features
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.map_features import LightLookup, RoadFeatures, road_features
from shiftsim.planners.routes.correction import RouteCorrector
from shiftsim.sim.planner import History, Observation, SceneInfo
from shiftsim.world.state import AX, HEADING, PACIFICA, VX, Trajectory, center_poses

RADIUS = 100.0  # m
MAX_AGENTS = 32
START_REACH = 1.0  # m, half side of the square in which the route's start is looked for
MIN_SPEED = 0.2  # m/s, below it the steering angle counts as 0
MAX_STEER = 2.0 * np.pi / 3.0  # rad
MAX_YAW_RATE = 0.95  # rad/s
_NO_LANE = f"no lane or crosswalk within {RADIUS:g} m, heading and speed are kept"


class Features(NamedTuple):
    """What the network reads of one scene."""

    agents: features.AgentFeatures  # the ego and the agents
    road: RoadFeatures  # the map
    current_state: np.ndarray  # (7,) of `current_state`, float32
    route: tuple[int, ...]  # blocks of the corrected route


class Plans(NamedTuple):
    """What the network says of one scene, float32."""

    trajectory: np.ndarray  # (6, 80, 4) x, y [m], cosine and sine of the heading, in the ego frame
    probability: np.ndarray  # (6,) logits


class PlanTF(LearnedPlanner[Features, Plans]):
    """PlanTF with a checkpoint."""

    name = "plantf"

    def reset(self, scene: SceneInfo) -> None:
        """Prepare for a scenario: its map, its route and its lights."""
        self.degraded = self._reason = ""
        self._map, self._lights = scene.map, LightLookup(scene.map)
        blocks = scene.route_blocks
        self._corrector = RouteCorrector(scene.map, blocks, START_REACH) if blocks else None

    def features(self, observation: Observation) -> Features:
        """What the network reads."""
        history = observation.history
        rear_axle = history.ego[-1, :3].copy()
        center = center_poses(rear_axle)
        route = self._corrector.at(rear_axle) if self._corrector else ()
        on_route = np.zeros(len(self._map.blocks), np.bool_)
        on_route[list(route)] = True
        agents = features.agent_features(history, center, MAX_AGENTS)
        lights = self._lights.at(observation.lights)
        road = road_features(self._map, rear_axle, center, RADIUS, lights, on_route)
        reason = features.short_history(len(history.ego)) if self._corrector else features.NO_ROUTE
        self._reason = reason if len(road.objects) else _NO_LANE
        return Features(agents, road, current_state(history), route)

    def infer(self, scenes: Sequence[Features]) -> Sequence[Plans]:
        """Six plans per scene."""
        import torch

        with torch.inference_mode():
            out = self.network(make_batch(scenes, self.device))
            trajectories = out.trajectory.cpu().numpy()
            probabilities = out.probability.cpu().numpy()
        return [Plans(*pair) for pair in zip(trajectories, probabilities, strict=True)]

    def decode(self, output: Plans, observation: Observation) -> Trajectory:
        """The likeliest plan in the map frame."""
        self.degraded, history = self._reason, observation.history
        if self._reason == _NO_LANE:
            return features.straight_on(history)
        best = output.trajectory[int(np.argmax(output.probability))]
        return features.plan_of_poses(
            features.map_poses(features.poses_of(best), history.ego[-1]), history
        )


def current_state(history: History) -> np.ndarray:
    """(7,) x, y, heading (all 0), speed, acceleration, steering angle, yaw rate, float32."""
    ego = history.ego
    speed = ego[-1, VX]
    # nuPlan rule 302: not those of the state; they follow from the last two headings
    turn = wrap_angle(ego[-1, HEADING] - ego[-2, HEADING]) / features.STEP if len(ego) > 1 else 0.0
    steer = yaw_rate = 0.0
    if abs(speed) >= MIN_SPEED:
        angle = np.arctan(turn * PACIFICA.wheel_base / abs(speed))
        steer = min(max(angle, -MAX_STEER), MAX_STEER)
        yaw_rate = min(max(turn, -MAX_YAW_RATE), MAX_YAW_RATE)
    return np.array([0.0, 0.0, 0.0, speed, ego[-1, AX], steer, yaw_rate], np.float32)


def make_batch(scenes: Sequence[Features], device: str) -> Any:
    """Inputs of the network; padding is valid nowhere."""
    from shiftsim.planners.learned.plantf.network import Inputs

    parts = [(one.agents, one.road) for one in scenes]
    counts = [[len(part.valid) for part in same] for same in zip(*parts, strict=True)]
    arrays = [
        (
            *(agents.position, agents.heading, agents.velocity, agents.shape, agents.valid),
            # nuPlan rule 301: all agents have the category of the ego
            np.zeros_like(agents.category),
            state,
            *(road.points[:, 0], road.vectors[:, 0], road.orientations[:, 0], road.centers),
            *(road.kind, road.on_route.astype(np.int64), road.light, road.has_limit, road.limit),
            road.valid,
        )
        for agents, road, state, _ in scenes
    ]
    return Inputs(*[*features.stack_scenes(arrays, device), counts])
