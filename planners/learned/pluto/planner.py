"""PLUTO: a network proposes trajectories along reference lines, rules choose among them.

Where the official planner would fail, this one goes on and says so: without a reference line it
drives the trajectory that needs none; with a history shorter than 2 s the missing samples are
masked.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import FloatArray
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.features import (
    NO_ROUTE,
    AgentFeatures,
    agent_features,
    route_blocks,
    short_history,
)
from shiftsim.planners.learned.map_features import LightLookup, RoadFeatures, road_features
from shiftsim.planners.learned.plan_states import plan_of_poses
from shiftsim.planners.learned.pluto import proposals, reference, world
from shiftsim.planners.learned.pluto.brake import brake, must_brake
from shiftsim.planners.learned.pluto.inputs import SceneInputs, scene_inputs, stack
from shiftsim.planners.learned.pluto.scoring import Place, Scores, nearest_line, score
from shiftsim.planners.per_map import PerMap
from shiftsim.planners.proposals.tracker import STEP_US
from shiftsim.planners.routes.correction import RouteCorrector
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import VX, VY, Trajectory

RADIUS = 120.0  # m, of agents and map
MAX_AGENTS = 48
START_HALF_SIDE = 2.5  # m, of the square in which the route's start is looked for
NO_LINE = (
    "no lane of the route is near the ego and fits its heading, the reference-free plan is driven"
)

_areas_of = PerMap(reference.map_areas)


@dataclass(frozen=True, slots=True)
class Sight:
    """What one step saw."""

    drivable: reference.Drivable  # drivable areas
    static: world.StaticObjects  # static objects on them
    lines: list[FloatArray]  # reference lines (K, 3)
    agents: AgentFeatures  # the agents, nearest first
    road: RoadFeatures  # lanes, connectors and crosswalks


@dataclass(frozen=True, slots=True)
class Choice:
    """How one step chose."""

    poses: FloatArray  # (P, 81, 3) proposals
    learned: FloatArray  # (P,) their scores by the network
    agents: world.Agents  # the agents, now and predicted
    scores: Scores  # of the proposals
    best: int  # number of the best one
    braked: bool  # whether the emergency brake replaces it


class Pluto(LearnedPlanner[SceneInputs, proposals.Output]):
    """PLUTO with its rule-based choice."""

    name = "pluto"
    _scene: SceneInfo | None = None
    route: reference.RouteLanes | None = None  # lanes of the corrected route, from the first step
    sight: Sight | None = None  # what the last step saw
    choice: Choice | None = None  # how it chose; None where it had no reference line

    def reset(self, scene: SceneInfo) -> None:
        """Look up the route; it is corrected at the first step."""
        self._blocks = route_blocks(scene)
        self._scene, self._lights = scene, LightLookup(scene.map)
        self.route = self.sight = self.choice = None
        self.degraded = ""

    def features(self, observation: Observation) -> SceneInputs:
        """Arrays of the network; what they were made from is kept in `sight`."""
        scene = self._scene
        if scene is None:
            raise PlannerError(f"{self.name}: plan() was called before reset()")
        road, history = scene.map, observation.history
        ego, center = history.ego[-1].copy(), observation.ego.center
        if self.route is None:
            known = self._blocks
            blocks = RouteCorrector(road, known, START_HALF_SIDE).at(ego[:3]) if known else ()
            self.route = reference.route_lanes(road, _areas_of(road), blocks)
        route = self.route
        drivable = reference.drivable_near(road, route, center[0], center[1])
        static = world.static_objects(history.tracks, drivable, center[0], center[1])
        lines = reference.reference_lines(road, route, ego[:3], center)
        agents = agent_features(history, center, MAX_AGENTS)
        lights = self._lights.at(observation.lights)
        near = road_features(road, ego[:3], center, RADIUS, lights, route.has_block)
        self.sight = Sight(drivable, static, lines, agents, near)
        return scene_inputs(ego, agents, near, static, reference.line_features(lines, ego[:3]))

    def infer(self, features: Sequence[SceneInputs]) -> list[proposals.Output]:
        """One forward pass."""
        import torch

        from shiftsim.planners.learned.pluto.network import Inputs

        with torch.inference_mode():
            outputs = self.network(Inputs(*stack(features, self.device)))
        arrays = [getattr(outputs, name).cpu().numpy() for name in proposals.Output._fields]
        return [
            proposals.Output(
                trajectory[: len(scene.line_valid)],
                logits[: len(scene.line_valid)],
                prediction[: len(scene.category) - 1],
                free,
            )
            for scene, trajectory, logits, prediction, free in zip(features, *arrays, strict=True)
        ]

    def decode(self, output: proposals.Output, observation: Observation) -> Trajectory:
        """The best proposal, an emergency brake, or the reference-free trajectory."""
        assert self.sight is not None
        assert self._scene is not None
        history, self.choice = observation.history, None
        # where the official planner would fail
        reason = short_history(len(history.ego)) if self.sight.lines else NO_LINE
        self.degraded = reason if self._blocks else NO_ROUTE
        if not self.sight.lines:
            free = proposals.headings_of(output.ref_free_trajectory)
            return _plan(proposals.to_map(free, history.ego[-1, :3]), observation)
        self.choice = choice = self._choose(output, observation)
        if not choice.braked:
            return _plan(choice.poses[choice.best, 1:], observation)
        ego, fault_time = history.ego[-1].copy(), choice.scores.fault_times[choice.best]
        states = brake(choice.poses[choice.best], ego, float(fault_time), self._scene.vehicle)
        return Trajectory(observation.time_us + STEP_US * np.arange(len(states)), states)

    def _choose(self, output: proposals.Output, observation: Observation) -> Choice:
        sight = self.sight
        assert sight is not None
        ego, tracks = observation.history.ego[-1].copy(), observation.history.tracks
        poses, learned = proposals.best_proposals(output, ego[:3])
        seen, rows = sight.agents, sight.agents.tracks
        local = np.concatenate([seen.position[1:, -1], seen.heading[1:, -1:]], axis=1)
        present = (tracks.poses[-1, rows], tracks.velocities[-1, rows])
        motion = proposals.predicted_agents(output, local, *present, ego[:3])
        agents = world.Agents(*motion, tracks.sizes[-1, rows])
        return self.rate(observation, poses, learned, agents)

    def rate(
        self, observation: Observation, poses: FloatArray, learned: FloatArray, agents: world.Agents
    ) -> Choice:
        """The choice among proposals (P, 81, 3) of the last step, which was of this observation.

        `learned` (P,) are their scores by the network.
        """
        scene, sight, route = self._scene, self.sight, self.route
        assert scene is not None
        assert sight is not None
        assert route is not None
        ego = observation.history.ego[-1].copy()
        size = np.array([scene.vehicle.length, scene.vehicle.width])
        footprint = boxes_to_corners(observation.ego.center, size)
        lights = world.red_lights(scene.map, route, observation)
        others = world.make_world(sight.static, agents, lights, footprint)
        place = Place(sight.drivable, scene.map.edges.polygons, nearest_line(sight.lines, ego))
        scores = score(poses, learned, ego, others, place, scene.vehicle)
        best = int(np.argmax(scores.total))  # the first one on ties
        speed = float(np.hypot(ego[VX], ego[VY]))
        braked = must_brake(speed, float(scores.fault_times[best]))
        return Choice(poses, learned, agents, scores, best, braked)


def _plan(poses: FloatArray, observation: Observation) -> Trajectory:
    """Poses from 0.1 s on as a plan."""
    plan = plan_of_poses(poses, observation.history)
    # nuPlan rule 249: the plan starts at the first pose, not at the ego
    plan.states[0] = plan.states[1]
    return plan
