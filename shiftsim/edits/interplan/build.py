"""The scenario that a code of interPlan makes, as interPlan's own classes make it.

What is drawn, is drawn from `random.Random(token)` in their order, and their oddities are kept
(nuPlan rules 700 …). Only the draws of cone headings are seeded otherwise: interPlan leaves them to
numpy's global state.
"""

import random
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import compress
from typing import Any

import numpy as np
import shapely

from shiftsim.edits.builder import EGO_SIZE, ScenarioBuilder, begin
from shiftsim.edits.density import blocks_at, draw_slots
from shiftsim.edits.interplan import codes
from shiftsim.edits.interplan.path import DrivenLanes, Plan, make_plan
from shiftsim.edits.spec import LEVELS, MANNERS, Edit, edited_id
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import boxes_to_corners, wrap_angle
from shiftsim.kernels import FloatArray
from shiftsim.world.events import (
    CAUTIOUS,
    CROSSING_SIZE,
    FOLLOW,
    LOGGED,
    STOPPED,
    Crossing,
    RolloutEvents,
    TerminationCondition,
)
from shiftsim.world.lanes import find_start, nearest_heading, poses_on_edge, start_on
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, AgentKind, center_poses, rear_poses

BUS = np.array([7.455735206604004, 2.0785977840423584])  # length, width [m]
PEDESTRIAN = np.array(CROSSING_SIZE)
CONE = np.array([0.5, 0.5])
CORRIDOR_S = 2  # s, how far ahead of new vehicles others must not be
HISTORY = 23  # samples before iteration 0
_JITTER = 0.1  # m, standard deviation of their places
_STEP = 0.1  # s
NO_EDGE = -1
SORTS = {
    "approaching_construction_zone": "construction_zone",
    "avoid_crashed_cars": "stopped_vehicle",
    "nudge_around_parked_vehicle": "stopped_vehicle",
    "overtake_parked_vehicle": "stopped_vehicle",
    "jaywalking_pedestrian": "jaywalking_pedestrian",
}


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle at iteration 0."""

    token: str
    pose: FloatArray  # (3,) centre
    size: FloatArray  # (2,) length, width [m]
    velocity: FloatArray  # (2,) [m/s]; nuPlan rule 705: of new ones in the body frame
    behavior: int = LOGGED


@dataclass(frozen=True, slots=True)
class Built:
    """What a code makes, before it is a scenario."""

    changes: Mapping[str, Any]  # what the code asks for
    scenario_type: str
    initial: FloatArray  # (11,) ego at iteration 0
    ego_speed: float | None  # where agents were changed [m/s]
    ego_edge: int  # lane or connector of the ego
    plan: Plan  # route, lanes, goal and expert
    vehicles: tuple[Vehicle, ...]
    cones: tuple[tuple[str, FloatArray], ...]  # token and pose
    pedestrians: tuple[Crossing, ...]
    past: FloatArray = field(repr=False)  # (23, V, 3) poses of the vehicles before iteration 0


def build(
    scenario: Scenario, code: str, details: Mapping[str, Any], driven_lanes: DrivenLanes
) -> Built:
    """What a code makes of a recorded scenario; `details` are those of its token."""
    changes = codes.changes_of(code, details)
    road, row = scenario.map, int(scenario.iteration_rows[0])
    logged = np.array(scenario.ego[row])
    center = center_poses(logged[None, :3])[0]
    at = road.lanes_at(center[0], center[1]) or road.connectors_at(center[0], center[1])
    ego_edge = at[0] if at else NO_EDGE
    kind = codes.scenario_type(changes, details)
    vehicles, speed, agents = _logged(scenario), None, _Agents(scenario, changes, details, ego_edge)
    if codes.edits_agents(changes):
        vehicles, speed = agents.fill(), agents.ego_speed
    initial = logged.copy()
    if speed:  # nuPlan rule 706: a speed of 0 changes nothing
        initial[VX] = speed
    plan = make_plan(scenario, changes, details, initial, driven_lanes)
    if codes.edits_agents(changes) and not vehicles and not agents.cones:
        agents.fill()  # interPlan takes an empty list for one that was not made yet
        vehicles = tuple(agents.vehicles)
    # nuPlan rule 709: interPlan seeds what it draws only where it changes agents
    draws = agents.draws if codes.edits_agents(changes) else random.Random(0)
    past = _past(road, vehicles, draws)
    return Built(
        changes,
        kind,
        initial,
        speed,
        ego_edge,
        plan,
        tuple(vehicles),
        tuple(agents.cones),
        tuple(agents.pedestrians),
        past,
    )


def _logged(scenario: Scenario) -> tuple[Vehicle, ...]:
    tracks, row = scenario.tracks, int(scenario.iteration_rows[0])
    chosen = np.flatnonzero(tracks.valid[row] & (tracks.kinds == AgentKind.VEHICLE))
    return tuple(
        Vehicle(
            tracks.tokens[i],
            np.array(tracks.poses[row, i]),
            np.array(tracks.sizes[row, i]),
            np.array(tracks.velocities[row, i]),
        )
        for i in chosen.tolist()
    )


class _Agents:
    """The vehicles, cones and pedestrians that a code puts into a scenario."""

    def __init__(
        self,
        scenario: Scenario,
        changes: Mapping[str, Any],
        details: Mapping[str, Any],
        ego_edge: int,
    ) -> None:
        self.road, self.changes, self.details = scenario.map, changes, details
        self.special = codes.special_of(changes, details)
        self.logged = _logged(scenario)
        self.ego = np.array(scenario.ego[int(scenario.iteration_rows[0])])
        self.center = center_poses(self.ego[None, :3])[0]
        if ego_edge == NO_EDGE:
            start = find_start(self.road, self.center)
            ego_edge = start.edge if start else NO_EDGE
        self.ego_edge = ego_edge
        self.draws = random.Random(scenario.token)
        self.ego_speed = float(np.hypot(self.ego[VX], self.ego[VY]))
        self.vehicles: list[Vehicle] = []
        self.bodies: list[Vehicle] = []
        self.areas: dict[int, shapely.Geometry] = {}
        self.spawned: list[Vehicle] = []
        self.cones: list[tuple[str, FloatArray]] = []
        self.pedestrians: list[Crossing] = []

    def fill(self) -> tuple[Vehicle, ...]:
        """Remove, spawn, and add what is special, in interPlan's order."""
        changes, self.vehicles = self.changes, list(self.logged)
        if "amount_of_agents" in changes:  # it goes before density
            self._remove(changes["amount_of_agents"])
        elif "density" in changes:
            self._remove(0)
            self._fill_lanes(changes["density"])
        if "special_scenario" in changes:
            if "density" not in changes:
                self._remove(0)
            self._add_special()
        return tuple(self.vehicles)

    def _remove(self, share: int) -> None:
        count = int((1.0 - share) * len(self.vehicles))
        if count < 0:
            raise ConfigError(f"a share of {share} is more than all agents", "a0 or a1")
        self.bodies = self.draws.sample(self.vehicles, count)
        gone = set(map(id, self.bodies))
        self.vehicles = [vehicle for vehicle in self.vehicles if id(vehicle) not in gone]

    def _fill_lanes(self, density: str) -> None:
        if self.ego_edge == NO_EDGE:
            raise ConfigError("the ego is on no lane at the start")
        places = self.details.get("roadblock_locations_to_spawn_agents")
        if places is not None:
            places = self.special.get("roadblock_locations_to_spawn_agents", places)
        points = tuple((float(x), float(y)) for x, y in places or ())
        gap = LEVELS[codes.DENSITIES[density]]
        slots, speed = draw_slots(self.road, self.ego_edge, self.center, gap, points, self.draws)
        self.ego_speed = self.ego_speed if speed is None else speed
        for slot in slots:
            self._add(slot.pose, slot.speed, FOLLOW)
        for x, y, extra_speed, *more in self.details.get("extra_agents_to_spawn") or ():
            options = more[0] if more else {}
            pose = np.array([x, y, 0.0])
            if options.get("snap"):
                edges = self.road.lanes_at(x, y) or self.road.connectors_at(x, y)
                if not edges:
                    raise ConfigError(f"an extra agent at ({x}, {y}) is on no lane")
                pose = start_on(self.road, edges[0], x, y).pose
            is_default = bool(more) and options["behavior"] == "default"
            self._add(pose, extra_speed, FOLLOW if is_default else CAUTIOUS)

    def _add_special(self) -> None:
        for pose in self.special.get("stopped_vehicle", ()):
            self._add(np.array(pose, np.float64), 0.0, STOPPED)
        for pose in self.special.get("stopped_bus", ()):
            self._add(np.array(pose, np.float64), 0.0, STOPPED, BUS)
        if not self.pedestrians:
            for x0, y0, x1, y1, iteration in self.special.get("pedestrian", ()):
                heading = float(np.arctan2(y1 - y0, x1 - x0))
                _, _ = self._token(), self.draws.randint(100, 1000)
                start = np.array([x0, y0, wrap_angle(heading)])
                end = np.array([x1, y1])
                self.pedestrians.append(Crossing(self._token(), start, end, iteration or 0))
        if not self.cones:
            # nuPlan rule 707: interPlan leaves these headings to numpy's global state
            turns = np.random.RandomState(0)
            for x, y, *_ in self.special.get("cones", ()):
                pose = np.array([x, y, turns.uniform(low=-np.pi, high=np.pi)])
                _, _ = self._token(), self.draws.randint(100, 1000)
                self.cones.append((self._token(), pose))

    def _token(self) -> str:
        return format(self.draws.randrange(16**16), "=16x")

    def _add(
        self, pose: FloatArray, speed: float, behavior: int, size: FloatArray | None = None
    ) -> None:
        """Add a vehicle, unless it is in the way of another one."""
        if self.bodies:
            body = self.bodies.pop(0)  # nuPlan rule 708: also where it is refused below
            token, own_size = body.token, body.size
        else:
            _, token, own_size = self._token(), self._token(), EGO_SIZE
        # nuPlan rule 700: not the speed that was computed, but the ego's velocity, or none
        velocity = self.ego[VX : VY + 1].copy() if speed else np.zeros(2)
        new = Vehicle(token, pose, own_size if size is None else size, velocity, behavior)
        area = self.areas[id(new)] = corridor(new)
        self.spawned.append(new)  # ids are of objects that live
        areas = [self.areas[id(other)] for other in self.vehicles]
        met = list(compress(self.vehicles, shapely.intersects(area, areas).tolist()))
        if met:
            if behavior == STOPPED:
                self.vehicles = [
                    other
                    for other in self.vehicles
                    if not any(other.token == one.token for one in met) or other.behavior == STOPPED
                ]
            else:
                blocks = blocks_at(self.road, float(pose[0]), float(pose[1]))
                if not blocks or blocks[0] != int(self.road.block_of[self.ego_edge]):
                    return
        self.vehicles.append(new)


def corridor(vehicle: Vehicle) -> shapely.Geometry:
    """Where a vehicle will be within 2 s at its velocity, as wide as it is."""
    x, y, heading = vehicle.pose
    cos, sin = np.cos(heading), np.sin(heading)
    ahead, left = vehicle.velocity  # in the frame of the vehicle
    vx, vy = ahead * cos - left * sin, ahead * sin + left * cos
    times = np.array([0.0, CORRIDOR_S])  # interPlan has points between, on the same straight line
    half = vehicle.size[0] / 2.0
    rear = (x + half * np.cos(heading + np.pi), y + half * np.sin(heading + np.pi))
    front = np.column_stack([x + times * vx + half * cos, y + times * vy + half * sin])
    line = shapely.LineString(np.concatenate([[rear, (x, y)], front]))
    return shapely.buffer(line, vehicle.size[1] / 2.0, cap_style="flat", quad_segs=16)


def _past(road: VectorMap, vehicles: tuple[Vehicle, ...], draws: random.Random) -> FloatArray:
    """(23, V, 3) where the vehicles were, oldest first, with noise."""
    found = enumerate(_segment(road, vehicle) for vehicle in vehicles)
    movers = [(number, *start) for number, start in found if start is not None]
    out = np.array([[vehicle.pose for vehicle in vehicles]] * HISTORY).reshape(HISTORY, -1, 3)
    if not movers:
        return out
    numbers, edges, starts = map(np.array, zip(*movers, strict=True))
    # nuPlan rule 709: with noise, standing ones as well
    noise = [draws.gauss(0, _JITTER) for _ in range(HISTORY * len(movers))]
    speeds = np.array([vehicles[number].velocity[0] for number in numbers.tolist()])
    back = speeds * _STEP * np.arange(HISTORY, 0, -1)[:, None]
    along = starts - (back + np.array(noise).reshape(HISTORY, -1))
    edges = np.tile(edges, (HISTORY, 1))
    for row, column in np.argwhere(along < 0.0).tolist():
        before = road.incoming.at(int(edges[row, column])).tolist()
        if before:
            edges[row, column] = before[0]
            along[row, column] += road.baselines.length(before[0])
        else:
            along[row, column] = 0.0
    for edge in np.unique(edges).tolist():
        rows, columns = np.nonzero(edges == edge)
        out[rows, numbers[columns]] = poses_on_edge(road, edge, along[rows, columns])
    return out


def _segment(road: VectorMap, vehicle: Vehicle) -> tuple[int, float] | None:
    """Edge and progress of a vehicle; by its corners where its centre is on a gap of connectors."""
    x, y = float(vehicle.pose[0]), float(vehicle.pose[1])
    is_lane = bool(road.lanes_at(x, y))
    if not is_lane and not len(road.intersections.containing(x, y)):
        return None
    points = [(x, y), *boxes_to_corners(vehicle.pose, vehicle.size).tolist()]
    for px, py in points:
        edges = road.lanes_at(px, py) if is_lane else road.connectors_at(px, py)
        if edges:
            if len(edges) == 1:
                return edges[0], road.progress_on(edges[0], x, y)
            start = nearest_heading(road, edges, vehicle.pose)
            return start.edge, start.progress
    return None


def assemble(scenario: Scenario, built: Built, edit: Edit) -> Scenario:
    """The scenario of what a code has made."""
    builder = begin(scenario)
    tracks, now = builder.tracks, builder.now
    if codes.edits_agents(built.changes):
        builder.keep(np.zeros(tracks.num_tracks, np.bool_))
    else:
        builder.keep(tracks.kinds != AgentKind.VEHICLE)
    _add_vehicles(builder, built)
    for token, pose in built.cones:
        builder.add(token, AgentKind.TRAFFIC_CONE, CONE, builder.still(pose))
    rows = len(scenario.time_us)
    for crossing in built.pedestrians:
        absent = np.zeros(rows, np.bool_)
        builder.add(
            crossing.token,
            AgentKind.PEDESTRIAN,
            PEDESTRIAN,
            builder.still(crossing.start),
            valid=absent,
        )
    plan = built.plan
    ego = np.array(scenario.ego)
    if "goal" in built.changes:
        ego[scenario.iteration_rows[1:]] = built.initial
        ego[scenario.iteration_rows[1:], :3] = rear_poses(plan.centers[1:])
    ego[now] = built.initial
    places = {token: i for i, token in enumerate(builder.tracks.tokens)}
    stopped = [v.pose[:2] for v in built.vehicles if v.behavior == STOPPED]
    sorts = SORTS.get(built.scenario_type, "")
    obstacles = {
        "construction_zone": [pose[:2] for _, pose in built.cones],
        "stopped_vehicle": stopped,
        "jaywalking_pedestrian": [crossing.end for crossing in built.pedestrians],
    }.get(sorts, [])
    letter = built.changes.get("observation", "")
    policy = codes.POLICIES.get(letter, edit.agents or MANNERS[0])
    script = RolloutEvents(
        base=scenario.token,
        name=edit.name,
        digest=edit.digest,
        words=edit.words,
        tokens=tuple(builder.touched),
        behaviors=builder.behaviors,
        yielding=MANNERS.index(policy),
        crossings=tuple(replace(w, track=places[w.token]) for w in built.pedestrians),
        termination=TerminationCondition(plan.line[:, :2], plan.end),
        profile="interplan",
        sorts=sorts,
        obstacles=np.array(obstacles).reshape(-1, 2),
    )
    return replace(
        builder.scenario,
        token=edited_id(scenario.token, edit),
        scenario_type=built.scenario_type,
        tracks=builder.tracks,
        ego=ego,
        route=plan.route,
        mission_goal=plan.goal,
        script=script,
    )


def _add_vehicles(builder: ScenarioBuilder, built: Built) -> None:
    """The vehicles at iteration 0, and before it where they were with noise."""
    scenario, now = builder.scenario, builder.now
    rows = now - scenario.row_step * np.arange(HISTORY, 0, -1)
    known = rows >= 0
    if not built.vehicles:
        return
    tokens, behaviors = zip(*((v.token, v.behavior) for v in built.vehicles), strict=True)
    sizes = np.array([vehicle.size for vehicle in built.vehicles])
    velocities = np.array([vehicle.velocity for vehicle in built.vehicles])
    shape = (len(scenario.time_us), len(tokens))
    poses = np.empty((*shape, 3))
    poses[:] = [vehicle.pose for vehicle in built.vehicles]
    poses[rows[known]] = built.past[known]
    valid = np.zeros(shape, np.bool_)
    valid[now] = True
    valid[rows[known]] = True
    valid[now:, np.array(behaviors) == STOPPED] = True
    moves = np.broadcast_to(velocities, (*shape, 2))
    builder.add_all(tokens, AgentKind.VEHICLE, sizes, poses, valid, moves, behaviors=behaviors)
