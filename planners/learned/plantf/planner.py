"""PlanTF: imitation learning with a transformer over agents and map (planner-plantf.md).

Where the official planner would fail, this one goes on and says so: without any piece of road in
range it keeps heading and speed; without a route on the map, or with a history shorter than 2 s,
the network is asked all the same, with no polygon on the route and with the missing samples masked.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray
from shiftsim.geometry.frames import wrap_angle
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.features import (
    SAMPLES,
    AgentFeatures,
    agent_features,
    map_poses,
    straight_on,
)
from shiftsim.planners.learned.map_features import LightLookup, RoadFeatures, road_features
from shiftsim.planners.learned.plan_states import STEP, plan_of_poses
from shiftsim.planners.routes.correction import RouteCorrector
from shiftsim.sim.planner import History, Observation, SceneInfo
from shiftsim.world.state import AX, HEADING, PACIFICA, VX, Trajectory, center_poses

RADIUS = 100.0  # m
MAX_AGENTS = 32
START_REACH = 1.0  # m, half side of the square in which the route's start is looked for
MIN_SPEED = 0.2  # m/s, below it the steering angle counts as 0
MAX_STEER = 2.0 * np.pi / 3.0  # rad
MAX_YAW_RATE = 0.95  # rad/s


class Features(NamedTuple):
    """What the network reads of one scene.

    Attributes:
        agents: The ego and the agents. nuPlan: at inference all of them have the category of the
            ego, so theirs is not used (planner-plantf.md §2.2).
        road: The map.
        current_state: (7,) of `current_state`, float32.
        route: Blocks of the corrected route.
    """

    agents: AgentFeatures
    road: RoadFeatures
    current_state: np.ndarray
    route: tuple[int, ...]


class Plans(NamedTuple):
    """What the network says of one scene, float32.

    Attributes:
        trajectory: (6, 80, 4) x, y [m], cosine and sine of the heading, in the ego frame.
        probability: (6,) logits.
    """

    trajectory: np.ndarray
    probability: np.ndarray


class PlanTF(LearnedPlanner[Features, Plans]):
    """PlanTF with a checkpoint."""

    name = "plantf"

    def __init__(self, checkpoint: str, *, device: str = "cpu") -> None:
        """Load the network.

        Args:
            checkpoint: File, folder, name, or `deterministic:base|drive`; see `load_weights`.
            device: `cpu`, `cuda`, `cuda:N` or `auto`.
        """
        from shiftsim.planners.learned.checkpoint import load_weights
        from shiftsim.planners.learned.device import resolve_device
        from shiftsim.planners.learned.plantf.network import build_network

        weights = load_weights(checkpoint, "plantf", device=device)
        network = build_network()
        network.load_state_dict(weights.state)
        self._device = resolve_device(device)
        self._network = network.to(self._device).eval()
        self._reason = ""

    def reset(self, scene: SceneInfo) -> None:
        """Prepare for a scenario: its map, its route and its lights."""
        self.degraded = ""
        self._map = scene.map
        self._lights = LightLookup(scene.map)
        index = scene.map.blocks.index
        blocks = [index[name] for name in dict.fromkeys(scene.route) if name in index]
        self._corrector = RouteCorrector(scene.map, blocks, START_REACH) if blocks else None
        self._route: tuple[int, ...] = ()
        self._on_route: BoolArray = np.zeros(len(scene.map.blocks), np.bool_)

    def features(self, observation: Observation) -> Features:
        """What the network reads."""
        history = observation.history
        ego = history.ego[-1]
        center = center_poses(ego[:3])
        self._correct_route(ego[:3])
        lights = self._lights.at(observation.lights)
        agents = agent_features(history, center, MAX_AGENTS)
        road = road_features(self._map, ego[:3], center, RADIUS, lights, self._on_route)
        self._reason = self._why_makeshift(history, road)
        return Features(agents, road, current_state(history), self._route)

    def infer(self, features: Sequence[Features]) -> Sequence[Plans]:
        """Six plans per scene."""
        import torch

        with torch.inference_mode():
            out = self._network(make_batch(features, self._device))
            trajectories = out.trajectory.cpu().numpy()
            probabilities = out.probability.cpu().numpy()
        return [Plans(*pair) for pair in zip(trajectories, probabilities, strict=True)]

    def decode(self, output: Plans, observation: Observation) -> Trajectory:
        """The likeliest plan in the map frame."""
        self.degraded = self._reason
        history = observation.history
        if self._reason.startswith(_NO_ROAD):
            return straight_on(history)
        best = output.trajectory[int(np.argmax(output.probability))].astype(np.float64)
        heading = np.arctan2(best[:, 3], best[:, 2])
        poses = np.column_stack([best[:, :2], heading])
        return plan_of_poses(map_poses(poses, history.ego[-1]), history)

    def _correct_route(self, rear_axle: FloatArray) -> None:
        if self._corrector is None:
            return
        route = self._corrector.at(rear_axle)
        if route is not self._route:
            self._route = route
            self._on_route[:] = False
            self._on_route[list(route)] = True

    def _why_makeshift(self, history: History, road: RoadFeatures) -> str:
        """Why the official planner would fail here; empty where it would not."""
        if not len(road.objects):
            return f"{_NO_ROAD} {RADIUS:g} m, heading and speed are kept"
        if self._corrector is None:
            return "the scenario has no route on the map"
        if len(history.ego) < SAMPLES:
            return f"the history has {len(history.ego)} samples, not {SAMPLES}"
        return ""


_NO_ROAD = "no lane or crosswalk within"


def current_state(history: History) -> np.ndarray:
    """(7,) x, y, heading (all 0), speed, acceleration, steering angle, yaw rate, float32.

    The last two are not those of the state but follow from the last two headings
    (planner-plantf.md §2.1).
    """
    ego = history.ego
    speed = ego[-1, VX]
    turn = wrap_angle(ego[-1, HEADING] - ego[-2, HEADING]) / STEP if len(ego) > 1 else 0.0
    steer = yaw_rate = 0.0
    if abs(speed) >= MIN_SPEED:
        steer = np.clip(np.arctan(turn * PACIFICA.wheel_base / abs(speed)), -MAX_STEER, MAX_STEER)
        yaw_rate = np.clip(turn, -MAX_YAW_RATE, MAX_YAW_RATE)
    return np.array([0.0, 0.0, 0.0, speed, ego[-1, AX], steer, yaw_rate], np.float32)


def make_batch(features: Sequence[Features], device: str) -> Any:
    """Inputs of the network; padding is valid nowhere."""
    from shiftsim.planners.learned.plantf.network import STATE_CHANNELS, Inputs

    agents = [one.agents for one in features]
    roads = [one.road for one in features]
    counts = [[len(one.valid) for one in some] for some in (agents, roads)]
    rows, objects = map(max, counts)

    def of_agents(name: str) -> Any:
        return _padded([getattr(one, name) for one in agents], rows, device)

    def of_road(name: str) -> Any:
        return _padded([getattr(one, name) for one in roads], objects, device)

    return Inputs(
        position=of_agents("position"),
        heading=of_agents("heading"),
        velocity=of_agents("velocity"),
        shape=of_agents("shape"),
        valid=of_agents("valid"),
        category=of_agents("category") * 0,
        current_state=_padded(
            [one.current_state[:STATE_CHANNELS] for one in features], STATE_CHANNELS, device
        ),
        points=of_road("points")[:, :, 0],
        vectors=of_road("vectors")[:, :, 0],
        orientations=of_road("orientations")[:, :, 0],
        centers=of_road("centers"),
        kind=of_road("kind"),
        on_route=of_road("on_route").long(),
        light=of_road("light"),
        has_limit=of_road("has_limit"),
        limit=of_road("limit"),
        point_valid=of_road("valid"),
        counts=counts,
    )


def _padded(arrays: Sequence[np.ndarray], length: int, device: str) -> Any:
    """Tensor (B, length, …) of arrays (n, …), zero or false behind their ends."""
    import torch

    out = np.zeros((len(arrays), length, *arrays[0].shape[1:]), arrays[0].dtype)
    for row, array in zip(out, arrays, strict=True):
        row[: len(array)] = array
    return torch.from_numpy(out).to(device)
