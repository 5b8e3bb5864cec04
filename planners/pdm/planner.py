"""PDM-Closed: the strongest rule-based planner of the nuPlan challenge, with the same numbers.

It drives 15 proposals along the centerline of the route and two paths beside it, simulates each,
scores them, and returns the best one, or an emergency brake. Here is what survives from step to
step.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shiftsim.errors import ConfigError, PlannerError
from shiftsim.geometry.polylines import make_path
from shiftsim.kernels import FloatArray
from shiftsim.planners.pdm.corridor import Paths
from shiftsim.planners.pdm.forecast import (
    LIGHT_TOKEN,
    Forecast,
    make_forecast,
    select_tracks,
    touched,
)
from shiftsim.planners.pdm.parameters import FollowingModel, PdmParameters
from shiftsim.planners.pdm.rollout import Proposals, Scene, extend, roll_out
from shiftsim.planners.pdm.route import Route, current_lane, follow_route, offset_poses, start_route
from shiftsim.planners.pdm.scorer import Place, Scores, score
from shiftsim.planners.proposals.areas import select_areas
from shiftsim.planners.proposals.places import ego_box
from shiftsim.planners.proposals.tracker import DT, SCORED, STEP_US, STEPS, Driven, drive_proposals
from shiftsim.planners.routes.correction import known_blocks
from shiftsim.planners.routes.graph import centerline
from shiftsim.planners.routes.lead import LightWatch
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world import state
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Trajectory, VehicleParameters, center_poses, rear_poses

MAX_ACCEL, MIN_ACCEL = 2.40, -4.05  # m/s^2
STOPPED = 0.2  # m/s


def brake_speed(ego: FloatArray, vehicle: VehicleParameters) -> float:
    """Speed of the reference that makes the tracker brake, usually backwards [m/s]."""
    speed = float(ego[state.VX])
    if speed > STOPPED:
        return 1.1 * (speed + float(np.clip(-10.0 * speed, MIN_ACCEL, MAX_ACCEL)))
    # nuPlan rule 194: the centre's acceleration without the angular term
    accel = float(ego[state.AX]) + vehicle.rear_axle_to_center * float(ego[state.YAW_RATE]) ** 2
    return float(np.clip(-4.0 * speed - accel, MIN_ACCEL, MAX_ACCEL))


def brake_poses(ego: FloatArray, vehicle: VehicleParameters) -> FloatArray:
    """(81, 3) rear-axle poses straight along the heading of an ego state (11,)."""
    center = center_poses(ego[None, :3], vehicle)[0]
    travel = brake_speed(ego, vehicle) * DT * np.arange(STEPS + 1)
    centers = np.tile(center, (STEPS + 1, 1))
    centers[:, 0] += travel * np.cos(ego[state.HEADING])
    centers[:, 1] += travel * np.sin(ego[state.HEADING])
    return rear_poses(centers, vehicle)


class Step(NamedTuple):
    """What one step came to. P = 15 proposals, 5 speeds on each of 3 paths."""

    poses: FloatArray  # (81, 3) the plan, rear axle x [m], y [m], heading [rad]
    best: int  # number of the best proposal
    braked: bool  # whether the emergency brake replaces it
    proposals: Proposals  # as rolled out
    driven: Driven  # as driven by the tracker
    scores: Scores  # of the driven proposals


def choose(scores: Scores, ego: FloatArray, params: PdmParameters) -> tuple[int, bool]:
    """Number of the best proposal, and whether the emergency brake replaces it."""
    best = int(np.argmax(scores.total))  # the first one on ties
    is_near = DT * scores.collision_index[best] <= params.brake_time
    return best, bool(is_near and np.hypot(ego[state.VX], ego[state.VY]) <= params.brake_speed)


_TIMES = STEP_US * np.arange(STEPS + 1)  # us


class Seen(NamedTuple):
    """What one step was planned from."""

    forecast: Forecast  # what is around
    tokens: list[str]  # of the tracks, then of the red lights
    place: Place  # the map of the step
    lane: int  # the current lane


class PdmClosed:
    """Predictive Driver Model, closed-loop variant."""

    name = "pdm-closed"

    def __init__(
        self,
        *,
        speed_fractions: Sequence[float] | str = (0.2, 0.4, 0.6, 0.8, 1.0),
        lateral_offsets: Sequence[float] | str = (-1.0, 1.0),
        fallback_velocity: float = 15.0,
        min_gap: float = 1.0,
        headway: float = 1.5,
        accel_max: float = 1.5,
        decel_max: float = 3.0,
        map_radius: float = 50.0,
    ) -> None:
        """Set the most used parameters; `parameters` holds all of them and may be replaced.

        Args:
            speed_fractions: Target speeds as shares of the lane's limit, slowest first; as text
                separated by commas.
            lateral_offsets: Of the paths beside the centerline, left is positive [m]; likewise.
            fallback_velocity: Stands in for a missing speed limit [m/s].
            min_gap: Gap kept at standstill [m].
            headway: Time gap kept [s].
            accel_max: Largest acceleration [m/s^2].
            decel_max: Largest deceleration, positive [m/s^2].
            map_radius: How far objects and the map are seen [m].
        """
        self.parameters = PdmParameters(
            speed_fractions=_floats("speed_fractions", speed_fractions),
            lateral_offsets=_floats("lateral_offsets", lateral_offsets),
            fallback_velocity=fallback_velocity,
            following=FollowingModel(min_gap, headway, accel_max, decel_max),
            map_radius=map_radius,
        )
        self._scene: SceneInfo | None = None
        self.paths: Paths | None = None
        self._lights: LightWatch | None = None
        self.collided: list[str] = []
        self.route: Route | None = None
        self.centerline: FloatArray | None = None
        self.seen: Seen | None = None

    def reset(self, scene: SceneInfo) -> None:
        """Look up the route, or a PlannerError; it is corrected at the first plan."""
        known_blocks(scene.map, scene.route, scene.token, self.name)
        self._scene = scene
        self.collided = []
        self.route = self.centerline = self.paths = self.seen = self._lights = None

    def plan(self, observation: Observation) -> Trajectory:
        """81 poses, 0.1 s apart, without speeds."""
        states = np.zeros((STEPS + 1, state.NUM_STATE))
        states[:, :3] = self.step(observation).poses
        return Trajectory(observation.time_us + _TIMES, states)

    def step(self, observation: Observation) -> Step:
        """One planning step with everything that led to the plan."""
        seen, paths, limit = self.look(observation)
        assert self._scene is not None
        ego = observation.history.ego[-1].copy()
        return self.step_in(seen, paths, ego, limit, self._scene.vehicle)

    def look(self, observation: Observation) -> tuple[Seen, Paths, float]:
        """What a step is planned from: what is seen, the paths, the lane's speed limit [m/s]."""
        scene = self._scene
        if scene is None:
            raise PlannerError("pdm-closed: plan() was called before reset()")
        ego, center = observation.history.ego[-1].copy(), observation.ego.center
        vehicle, params = scene.vehicle, self.parameters
        if self.route is None:
            self.route = start_route(scene.map, scene.route, ego, scene.token)
        route = self.route
        selected = select_areas(scene.map, center[0], center[1], params.map_radius)
        lane = current_lane(scene.map, route, selected, ego, center, ego_box(vehicle))
        paths = self.paths
        if paths is None:
            lanes = follow_route(scene.map, route.corrected, lane).path
            paths = self.follow(centerline(scene.map, lanes))
        forecast, tokens = self._forecast(scene.map, route, observation, center)
        place = Place(route.areas, selected, scene.map.intersections.polygons, paths.at(0))
        self.seen = Seen(forecast, tokens, place, lane)
        return self.seen, paths, float(scene.map.speed_limits[lane])

    def follow(self, line: FloatArray) -> Paths:
        """Lay the centerline (K, 3) and the paths beside it, once per scenario."""
        self.centerline, offsets = line, self.parameters.lateral_offsets
        lines = [line, *(offset_poses(line, by) for by in offsets)]
        paths = [make_path(item) for item in lines]
        self.paths = Paths(*(np.stack(arrays) for arrays in zip(*paths, strict=True)))
        return self.paths

    def step_in(
        self, seen: Seen, paths: Paths, ego: FloatArray, limit: float, vehicle: VehicleParameters
    ) -> Step:
        """One planning step in what an ego (11,) sees; arguments as for `scene_in`.

        Proposals are rolled out, driven and scored, and the best one is chosen.
        """
        scene, targets = self.scene_in(seen, paths, ego, limit, vehicle)
        proposals = roll_out(scene, ego, targets)
        poses = np.ascontiguousarray(proposals.poses[:, :, : SCORED + 1])
        driven = drive_proposals(poses.reshape(-1, SCORED + 1, 3), ego, vehicle)
        others, params = seen.forecast.others, self.parameters
        scores = score(driven.states, seen.place, others, scene.size, params)
        best, braked = choose(scores, ego, params)
        plan = brake_poses(ego, vehicle) if braked else extend(proposals, scene, best)
        return Step(plan, best, braked, proposals, driven, scores)

    def scene_in(
        self, seen: Seen, paths: Paths, ego: FloatArray, limit: float, vehicle: VehicleParameters
    ) -> tuple[Scene, FloatArray]:
        """What proposals are rolled out in, and target speeds; what the ego touches is ignored.

        `limit` is the speed limit of the lane, NaN where it has none [m/s].
        """
        size, params = ego_box(vehicle), self.parameters
        self.collided += [seen.tokens[i] for i in touched(seen.forecast, ego, size)]
        if self.collided:
            seen.forecast.ignored[:] = [token in self.collided for token in seen.tokens]
        limit = params.fallback_velocity if math.isnan(limit) else limit
        targets = limit * np.array(params.speed_fractions)
        return Scene(paths, seen.forecast, size, params.following), targets

    def _forecast(
        self, road: VectorMap, route: Route, observation: Observation, center: FloatArray
    ) -> tuple[Forecast, list[str]]:
        """What is around, and the tokens of tracks and red lights."""
        tracks = observation.history.tracks
        chosen = select_tracks(tracks, center[0], center[1], set(self.collided), self.parameters)
        if self._lights is None:
            self._lights = LightWatch(road, route.lanes.tolist())
        red = self._lights.at(observation.lights)
        tokens = [tracks.tokens[i] for i in chosen.tolist()]
        tokens += [LIGHT_TOKEN + road.edges.ids[i] for i in red.lanes]
        return make_forecast(tracks, chosen, red), tokens


def _floats(name: str, value: Sequence[float] | str) -> tuple[float, ...]:
    items = [item for item in value.split(",") if item] if isinstance(value, str) else value
    try:
        return tuple(float(item) for item in items)
    except (TypeError, ValueError):
        raise ConfigError(
            f"pdm-closed: {name}={value!r} is not a list of numbers",
            hint=f"for example {name}=0.5,1.0",
        ) from None
