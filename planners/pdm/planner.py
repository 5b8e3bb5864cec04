"""PDM-Closed: the strongest rule-based planner of the nuPlan challenge, with the same numbers.

It drives 15 proposals along the centerline of the route and two paths beside it, simulates each,
scores them, and returns the best one, or an emergency brake (pdm-closed.md). Here the state that
survives from step to step is kept; everything else is in the `pdm_*` modules.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.errors import ConfigError, PlannerError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.planners.pdm.forecast import (
    LIGHT_TOKEN,
    Occupants,
    make_occupants,
    select_tracks,
    touched,
)
from shiftsim.planners.pdm.parameters import STEP_US, STEPS, FollowingModel, PdmParameters
from shiftsim.planners.pdm.path import PdmPath, make_path, offset_poses
from shiftsim.planners.pdm.route import centerline, follow_route, lane_off_road, nearest_vertex
from shiftsim.planners.pdm.scorer import Road
from shiftsim.planners.pdm.step import Step, plan_step
from shiftsim.planners.proposals.areas import Areas, admit, covering, index_ranks, make_areas
from shiftsim.planners.route_correction import Start, correct_route, find_start, known_blocks
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.layers import square_around
from shiftsim.world.map import VectorMap
from shiftsim.world.state import NUM_STATE, LightStatus, Trajectory

START_HALF_WIDTH = 1.0  # m, of the square around the rear axle that is searched for the start
MAX_COVERING = 64  # areas over one point


@dataclass(frozen=True, slots=True)
class Route:
    """What PDM-Closed decides once per scenario.

    Attributes:
        start: Where it begins.
        corrected: Blocks of the corrected route.
        lanes: Lanes and connectors of these blocks, in order.
        areas: The drivable areas of the map, those of the route marked.
    """

    start: Start
    corrected: list[int]
    lanes: IntArray
    areas: Areas


@dataclass(frozen=True, slots=True)
class Seen:
    """What one step was planned from.

    Attributes:
        occupants: What is around.
        tokens: Of the occupants, red lights included.
        road: The map of the step.
        lane: The current lane.
    """

    occupants: Occupants
    tokens: list[str]
    road: Road
    lane: int


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
        self._paths: list[PdmPath] = []
        self.collided: list[str] = []
        self.route: Route | None = None
        self.centerline: FloatArray | None = None
        self.seen: Seen | None = None

    def reset(self, scene: SceneInfo) -> None:
        """Look up the route; it is corrected at the first plan.

        Raises:
            PlannerError: The route is empty or unknown to the map.
        """
        known_blocks(scene.map, scene.route, scene.token, self.name)
        self._scene = scene
        self._paths, self.collided = [], []
        self.route = self.centerline = self.seen = None

    def plan(self, observation: Observation) -> Trajectory:
        """81 poses, 0.1 s apart, without speeds (pdm-closed.md §10)."""
        states = np.zeros((STEPS + 1, NUM_STATE))
        states[:, :3] = self.step(observation).poses
        return Trajectory(observation.time_us + STEP_US * np.arange(STEPS + 1), states)

    def step(self, observation: Observation) -> Step:
        """One planning step with everything that led to the plan."""
        scene = self._scene
        if scene is None:
            raise PlannerError("pdm-closed: plan() was called before reset()")
        ego, center = observation.history.ego[-1].copy(), observation.ego.center
        vehicle, params = scene.vehicle, self.parameters
        if self.route is None:
            self.route = start_route(scene.map, scene.route, ego, scene.token)
        route = self.route
        admitted = admit(scene.map, route.areas, center[0], center[1], params.map_radius)
        size = (vehicle.length, vehicle.width)
        lane = current_lane(scene.map, route, admitted, ego, center, size)
        if not self._paths:
            self._follow(scene.map, route, lane)
        tracks = observation.history.tracks
        chosen = select_tracks(tracks, center[0], center[1], set(self.collided), params)
        lights = self._red_lights(scene.map, route, observation)
        edges = scene.map.edges
        occupants = make_occupants(tracks, chosen, [edges.rings(i)[0] for i in lights])
        tokens = [tracks.tokens[i] for i in chosen.tolist()]
        tokens += [LIGHT_TOKEN + edges.ids[i] for i in lights]
        footprint = boxes_to_corners(center, np.array(size))
        self.collided += [tokens[i] for i in touched(occupants, footprint)]
        if self.collided:
            occupants.ignored[:] = [token in self.collided for token in tokens]
        limit = float(scene.map.speed_limits[lane])
        limit = params.fallback_velocity if np.isnan(limit) else limit
        road = Road(route.areas, admitted, scene.map.intersections.polygons, self._paths[0])
        self.seen = Seen(occupants, tokens, road, lane)
        return plan_step(
            ego,
            limit * np.array(params.speed_fractions),
            self._paths,
            occupants,
            road,
            vehicle,
            params,
        )

    def _follow(self, road: VectorMap, route: Route, lane: int) -> None:
        """Lay the centerline and the paths beside it, once per scenario."""
        line = centerline(road, follow_route(road, route.corrected, lane).edges)
        self.centerline = line
        offsets = self.parameters.lateral_offsets
        self._paths = [make_path(line), *(make_path(offset_poses(line, by)) for by in offsets)]

    def _red_lights(self, road: VectorMap, route: Route, observation: Observation) -> list[int]:
        """Connectors of the route whose light is red."""
        red = [n for n, s in observation.traffic_lights.items() if s == LightStatus.RED]
        edges = [road.edges.index.get(name, -1) for name in red]
        return [edge for edge in edges if edge >= 0 and route.areas.on_route[edge]]


def start_route(road: VectorMap, ids: Sequence[str], ego: FloatArray, token: str) -> Route:
    """Correct a route at the start of a scenario (pdm-closed.md §3).

    Args:
        road: The map.
        ids: Roadblock ids of the route.
        ego: (11,) ego state.
        token: Id of the scenario, for messages.

    Raises:
        PlannerError: The route is empty, unknown to the map, or has no lanes.
    """
    blocks = known_blocks(road, ids, token, PdmClosed.name)
    square = square_around(float(ego[0]), float(ego[1]), START_HALF_WIDTH)
    start = find_start(road, blocks, ego[:3], square)
    corrected = list(dict.fromkeys(correct_route(road, blocks, start)))
    lanes = [edge for block in corrected for edge in road.block_edges.at(block).tolist()]
    if not lanes:
        raise PlannerError(
            f"pdm-closed: the route of scenario {token!r} has no lanes",
            hint="correct the route of the scenario, or leave it out",
        )
    return Route(start, corrected, np.array(lanes), make_areas(road, lanes))


def current_lane(
    road: VectorMap,
    route: Route,
    admitted: IntArray,
    ego: FloatArray,
    center: FloatArray,
    size: tuple[float, float],
) -> int:
    """The lane of the route that the ego is on (pdm-closed.md §4.1).

    Args:
        road: The map.
        route: The corrected route.
        admitted: Drivable areas of this step.
        ego: (11,) ego state.
        center: (3,) its centre x [m], y [m], heading [rad].
        size: Its length and width [m].
    """
    areas, errors = lanes_at(road, route, admitted, ego)
    if not areas:
        return int(lane_off_road(road.edges.polygons, route.lanes, center, *size))
    least = min(errors)
    tied = [area for area, error in zip(areas, errors, strict=True) if error == least]
    if len(tied) > 1:
        tied = in_index_order(route, admitted, tied)
    return int(route.areas.edge[tied[0]])


def lanes_at(
    road: VectorMap, route: Route, admitted: IntArray, ego: FloatArray
) -> tuple[list[int], list[float]]:
    """Areas of the route under the rear axle, and their heading errors [rad]."""
    found = np.empty(MAX_COVERING, np.int64)
    areas, x, y = route.areas, float(ego[0]), float(ego[1])
    under = found[: covering(areas, admitted, x, y, found)].tolist()
    under = [area for area in under if areas.on_route[area]]
    lines, heading = road.baselines, float(ego[2])
    return under, [nearest_vertex(lines, int(areas.edge[a]), x, y, heading)[1] for a in under]


def in_index_order(route: Route, admitted: IntArray, chosen: list[int]) -> list[int]:
    """Some of the admitted areas, in the order in which nuPlan's spatial index yields them."""
    ranks = index_ranks(route.areas.polygons.bounds[admitted])
    rank_of = dict(zip(admitted.tolist(), ranks.tolist(), strict=True))
    return sorted(chosen, key=rank_of.__getitem__)


def _floats(name: str, value: Sequence[float] | str) -> tuple[float, ...]:
    items = [item for item in value.split(",") if item] if isinstance(value, str) else value
    try:
        return tuple(float(item) for item in items)
    except (TypeError, ValueError):
        raise ConfigError(
            f"pdm-closed: {name}={value!r} is not a list of numbers",
            hint=f"for example {name}=0.5,1.0",
        ) from None
