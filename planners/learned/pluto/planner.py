"""PLUTO: a network proposes trajectories along reference lines, rules choose among them.

Where the official planner would fail, this one goes on and says so: without a reference line it
drives the trajectory that needs none; with a history shorter than 2 s the missing samples are
masked.
"""

from collections import namedtuple
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from shiftsim.geometry.boxes import boxes_to_corners, turned
from shiftsim.kernels import FloatArray
from shiftsim.planners.learned import features
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.map_features import LightLookup, RoadFeatures, road_features
from shiftsim.planners.learned.pluto import reference, scoring, world
from shiftsim.planners.proposals.tracker import STEP_US, STEPS
from shiftsim.planners.routes.correction import RouteCorrector
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.map import PerMap
from shiftsim.world.state import AX, STEERING, VX, VY, YAW_RATE, Trajectory

RADIUS = 120.0  # m, of agents and map
MAX_AGENTS = 48
START_HALF_SIDE = 2.5  # m, of the square in which the route's start is looked for
NO_LINE = (
    "no lane of the route is near the ego and fits its heading, the reference-free plan is driven"
)

MAX_PROPOSALS = 20  # that compete by their logits
REFERENCE_FREE_SCORE = 0.25

_areas_of = PerMap(reference.areas_of_map)


# fields of `network.Inputs` without the axis of the batch; arrays of float32, int64 and bool
SceneInputs = namedtuple(
    "SceneInputs",
    "position heading velocity shape valid category current_state points vectors orientations "
    "centers kind on_route light has_limit limit point_valid object_pose object_shape "
    "object_category object_valid line_points line_vectors line_orientations line_valid",
)


class Output(NamedTuple):
    """What the network says about one scenario, in the ego frame. All float32."""

    trajectory: np.ndarray  # (R, 12, 80, 6) x, y [m], cos, sin of the heading, velocity [m/s]
    probability: np.ndarray  # (R, 12) logits
    # (A, 80, 6) of the agents, relative to their present poses; columns likewise
    prediction: np.ndarray
    ref_free_trajectory: np.ndarray  # (80, 4) x, y [m], cos, sin of the heading


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What one step saw."""

    drivable: reference.Drivable  # drivable areas
    static: world.StaticObjects  # static objects on them
    lines: list[FloatArray]  # reference lines (K, 3)
    agents: features.AgentFeatures  # the agents, nearest first
    road: RoadFeatures  # lanes, connectors and crosswalks


@dataclass(frozen=True, slots=True)
class Choice:
    """How one step chose."""

    poses: FloatArray  # (P, 81, 3) proposals
    learned: FloatArray  # (P,) their scores by the network
    agents: world.Agents  # the agents, now and predicted
    scores: scoring.Scores  # of the proposals
    best: int  # number of the best one
    braked: bool  # whether the emergency brake replaces it


class Pluto(LearnedPlanner[SceneInputs, Output]):
    """PLUTO with its rule-based choice."""

    name = "pluto"
    route: reference.RouteLanes | None = None  # lanes of the corrected route, from the first step
    surroundings: Surroundings  # what the last step saw
    choice: Choice | None = None  # how it chose; None where it had no reference line

    def reset(self, scene: SceneInfo) -> None:
        """Look up the route; it is corrected at the first step."""
        self._blocks = scene.route_blocks
        self._scene, self._lights = scene, LightLookup(scene.map)
        self.route = self.choice = None
        self.degraded = ""

    def features(self, observation: Observation) -> SceneInputs:
        """Arrays of the network; what they were made from is kept in `surroundings`."""
        road, history = self._scene.map, observation.history
        ego, center = history.ego[-1].copy(), observation.ego.center
        if self.route is None:
            known = self._blocks
            blocks = RouteCorrector(road, known, START_HALF_SIDE).at(ego[:3]) if known else ()
            self.route = reference.route_lanes(road, _areas_of(road), blocks)
        route = self.route
        drivable = reference.drivable_near(road, route, center[0], center[1])
        static = world.static_objects(history.tracks, drivable, center[0], center[1])
        lines = reference.reference_lines(road, route, ego[:3], center)
        agents = features.agent_features(history, center, MAX_AGENTS)
        lights = self._lights.at(observation.lights)
        near = road_features(road, ego[:3], center, RADIUS, lights, route.has_block)
        self.surroundings = Surroundings(drivable, static, lines, agents, near)
        return scene_inputs(ego, agents, near, static, reference.line_features(lines, ego[:3]))

    def infer(self, scenes: Sequence[SceneInputs]) -> list[Output]:
        """One forward pass."""
        import torch

        with torch.inference_mode():
            outputs = self.network(make_batch(scenes, self.device))
        arrays = [getattr(outputs, name).cpu().numpy() for name in Output._fields]
        return [
            Output(
                trajectory[: len(scene.line_valid)],
                logits[: len(scene.line_valid)],
                prediction[: len(scene.category) - 1],
                free,
            )
            for scene, trajectory, logits, prediction, free in zip(scenes, *arrays, strict=True)
        ]

    def decode(self, output: Output, observation: Observation) -> Trajectory:
        """The best proposal, an emergency brake, or the reference-free trajectory."""
        history, self.choice = observation.history, None
        # where the official planner would fail
        reason = features.short_history(len(history.ego)) if self.surroundings.lines else NO_LINE
        self.degraded = reason if self._blocks else features.NO_ROUTE
        if not self.surroundings.lines:
            free = headings_of(output.ref_free_trajectory)
            return _plan(to_map(free, history.ego[-1, :3]), observation)
        self.choice = choice = self._choose(output, observation)
        if not choice.braked:
            return _plan(choice.poses[choice.best, 1:], observation)
        ego, fault_time = history.ego[-1].copy(), choice.scores.fault_times[choice.best]
        states = scoring.brake(
            choice.poses[choice.best], ego, float(fault_time), self._scene.vehicle
        )
        return Trajectory(observation.time_us + STEP_US * np.arange(len(states)), states)

    def _choose(self, output: Output, observation: Observation) -> Choice:
        ego, tracks = observation.history.ego[-1].copy(), observation.history.tracks
        poses, learned = best_proposals(output, ego[:3])
        seen, rows = self.surroundings.agents, self.surroundings.agents.tracks
        local = np.concatenate([seen.position[1:, -1], seen.heading[1:, -1:]], axis=1)
        present = (tracks.poses[-1, rows], tracks.velocities[-1, rows])
        motion = predicted_agents(output, local, *present, ego[:3])
        agents = world.Agents(*motion, tracks.sizes[-1, rows])
        return self.rate(observation, poses, learned, agents)

    def rate(
        self, observation: Observation, poses: FloatArray, learned: FloatArray, agents: world.Agents
    ) -> Choice:
        """The choice among proposals (P, 81, 3) of this step, with scores (P,) by the network."""
        scene, surroundings, route = self._scene, self.surroundings, self.route
        assert route is not None
        ego = observation.history.ego[-1].copy()
        size = np.array([scene.vehicle.length, scene.vehicle.width])
        footprint = boxes_to_corners(observation.ego.center, size)
        lights = world.red_lights(scene.map, route, observation)
        hazards = world.make_world(surroundings.static, agents, lights, footprint)
        line = scoring.nearest_line(surroundings.lines, ego)
        place = scoring.Place(surroundings.drivable, scene.map.edges.polygons, line)
        scores = scoring.score(poses, learned, ego, hazards, place, scene.vehicle)
        best = int(np.argmax(scores.total))  # the first one on ties
        speed = float(np.hypot(ego[VX], ego[VY]))
        braked = scoring.must_brake(speed, float(scores.fault_times[best]))
        return Choice(poses, learned, agents, scores, best, braked)


def scene_inputs(
    ego: FloatArray,
    agents: features.AgentFeatures,
    road: RoadFeatures,
    static: world.StaticObjects,
    lines: reference.LineFeatures,
) -> SceneInputs:
    """What the network reads of one scene."""
    local = static.poses - ego[:3]  # headings are not wrapped
    objects = np.column_stack([turned(local[:, :2], ego[2]), local[:, 2]]).astype(np.float32)
    return SceneInputs(
        *agents[1:],
        current_state(ego),
        *(road.points, road.vectors[:, 0], road.orientations[:, 0], road.centers),
        *(road.kind, road.on_route.astype(np.int64), road.light, road.has_limit, road.limit),
        road.valid,
        *(objects, static.sizes[:, ::-1].astype(np.float32)),
        *(static.categories, np.ones(len(static.poses), np.bool_)),
        *lines,
    )


def current_state(ego: FloatArray) -> np.ndarray:
    """(7,) float32: pose in its own frame, speed, acceleration, steering angle, yaw rate."""
    own = [0.0, 0.0, 0.0, ego[VX], ego[AX], ego[STEERING], ego[YAW_RATE]]
    return np.array(own, np.float32)


def make_batch(scenes: Sequence[SceneInputs], device: str) -> Any:
    """Inputs of the network; scenes with fewer rows are filled up with zeros."""
    from shiftsim.planners.learned.pluto.network import Inputs

    parts = ("category", "kind", "object_category", "line_valid")
    counts = [[len(getattr(scene, name)) for scene in scenes] for name in parts]
    return Inputs(*[*features.stack_scenes(scenes, device), counts])


def headings_of(trajectory: np.ndarray) -> np.ndarray:
    """Poses (..., 3) float32 from columns x, y, cos, sin."""
    return np.concatenate(
        [trajectory[..., :2], np.arctan2(trajectory[..., 3:4], trajectory[..., 2:3])], -1
    )


def to_map(poses: np.ndarray, rear: FloatArray) -> FloatArray:
    """Poses (..., 3) of the ego frame in the map frame; headings are not wrapped."""
    cos, sin = np.cos(rear[2]), np.sin(rear[2])
    x, y, heading = np.moveaxis(poses.astype(np.float64), -1, 0)
    moved = (x * cos - y * sin + rear[0], x * sin + y * cos + rear[1], heading + rear[2])
    return np.stack(moved, axis=-1)


def best_proposals(output: Output, rear: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Poses (P, 81, 3) and scores (P,) of what competes, best logit first, the reference-free last.

    There must be at least one reference line; `rear` (3,) is the rear axle.
    """
    logits = output.probability.reshape(-1)
    # nuPlan rule 244: NumPy's default sort, and a softmax over what it keeps
    best = np.argsort(-logits)[:MAX_PROPOSALS]
    powers = np.exp(logits[best] - logits[best].max())
    scores = np.append((powers / powers.sum()).astype(np.float64), REFERENCE_FREE_SCORE)
    chosen = output.trajectory.reshape(-1, STEPS, output.trajectory.shape[-1])[best]
    free = output.ref_free_trajectory[None]
    local = np.concatenate([headings_of(chosen), headings_of(free)])
    poses = to_map(local, rear)
    # nuPlan rule 245: the pose of 0.1 s is also that of 0 s
    return np.concatenate([poses[:, :1], poses], axis=1), scores


def predicted_agents(
    output: Output, local: np.ndarray, present: FloatArray, velocity: FloatArray, rear: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Poses (A, 81, 3) in the map frame and speeds (A, 81) of agents from now on, every 0.1 s.

    Now they are at `local` (A, 3) in the ego frame, which is `present` in that of the map, with a
    velocity (A, 2) [m/s]; `rear` (3,) is the rear axle.
    """
    motion = output.prediction
    poses, speeds = np.empty((len(present), STEPS + 1, 3)), np.empty((len(present), STEPS + 1))
    poses[:, 0] = present
    poses[:, 1:] = to_map(headings_of(motion) + local[:, None], rear)
    speeds[:, 0] = np.hypot(velocity[:, 0], velocity[:, 1])
    speeds[:, 1:] = np.hypot(motion[..., 4], motion[..., 5])
    return poses, speeds


def _plan(poses: FloatArray, observation: Observation) -> Trajectory:
    """Poses from 0.1 s on as a plan."""
    plan = features.plan_of_poses(poses, observation.history)
    # nuPlan rule 249: the plan starts at the first pose, not at the ego
    plan.states[0] = plan.states[1]
    return plan
