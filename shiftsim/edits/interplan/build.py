"""The scenario that a code of interPlan makes, as interPlan's own classes make it.

What is drawn, is drawn from `random.Random(token)` in their order, and their oddities are kept
(nuPlan rules 700 …). Only the draws of cone headings are seeded otherwise: interPlan leaves them to
numpy's global state.
"""

import random
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely

from shiftsim.edits.builder import EGO_SIZE, ScenarioBuilder
from shiftsim.edits.density import blocks_at, draw_slots
from shiftsim.edits.interplan import codes
from shiftsim.edits.interplan.path import DrivenLanes, edges_under, make_plan
from shiftsim.edits.spec import LEVELS, MANNERS, Edit
from shiftsim.errors import ConfigError
from shiftsim.geometry.boxes import wrap_angle
from shiftsim.kernels import FloatArray
from shiftsim.world import events
from shiftsim.world.lanes import nearest_heading, poses_on_edge, start_on
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import VX, VY, AgentKind, rear_poses

BUS = np.array([7.455735206604004, 2.0785977840423584])  # length, width [m]
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


@dataclass(eq=False)
class Vehicle:
    """A vehicle at iteration 0."""

    token: str
    pose: FloatArray  # (3,) centre
    size: FloatArray  # (2,) length, width [m]
    velocity: FloatArray  # (2,) [m/s]; nuPlan rule 705: of new ones in the body frame
    behavior: int = events.LOGGED

    @cached_property
    def corridor(self) -> shapely.Geometry:
        """Where it will be within 2 s at its velocity, as wide as it is."""
        x, y, heading = self.pose
        cos, sin = np.cos(heading), np.sin(heading)
        ahead, left = self.velocity  # in the frame of the vehicle
        vx, vy = ahead * cos - left * sin, ahead * sin + left * cos
        times = np.array([0.0, CORRIDOR_S])  # interPlan has points between, on the same line
        half = self.size[0] / 2.0
        rear = (x + half * np.cos(heading + np.pi), y + half * np.sin(heading + np.pi))
        front = np.column_stack([x + times * vx + half * cos, y + times * vy + half * sin])
        line = shapely.LineString(np.concatenate([[rear, (x, y)], front]))
        return shapely.buffer(line, self.size[1] / 2.0, cap_style="flat", quad_segs=16)


class InterplanEditor:
    """What a code makes of a recorded scenario; `vehicles` are those at iteration 0."""

    def __init__(self, scenario: Scenario, edit: Edit, driven_lanes: DrivenLanes) -> None:
        self.builder = builder = ScenarioBuilder(scenario, edit, scenario.token)
        self.changes = codes.changes_of(edit.code, edit.details)
        self.special = codes.special_of(self.changes, edit.details)
        self.scenario_type = codes.scenario_type(self.changes, edit.details)
        self.road, now = scenario.map, builder.now
        x, y, _ = builder.center
        edges = self.road.lanes_at(x, y) or self.road.connectors_at(x, y)
        self.ego_edge = edges[0] if edges else NO_EDGE
        self.ego_velocity = scenario.ego[now, VX : VY + 1]
        self.ego_speed = float(np.hypot(*self.ego_velocity))
        self.bodies: list[Vehicle] = []  # removed vehicles, for new ones to take
        self.cones: dict[str, FloatArray] = {}  # pose by token
        self.crossings: list[events.Crossing] = []
        tracks = scenario.tracks
        logged = np.flatnonzero(tracks.valid[now] & (tracks.kinds == AgentKind.VEHICLE)).tolist()
        arrays = (tracks.poses[now], tracks.sizes[now], tracks.velocities[now])
        self.vehicles = [Vehicle(tracks.tokens[i], *(a[i] for a in arrays)) for i in logged]
        recorded = list(self.vehicles)
        edits_agents = codes.edits_agents(self.changes)
        initial = np.array(scenario.ego[now])
        if edits_agents:
            self._fill()
            if self.ego_speed:  # nuPlan rule 706: a speed of 0 changes nothing
                initial[VX] = self.ego_speed
        self.plan = make_plan(scenario, self.changes, edit.details, initial, driven_lanes)
        if edits_agents and not self.vehicles and not self.cones:
            # interPlan takes an empty list for one that was not made yet
            self.vehicles = recorded
            self._fill()
        self._build(initial, edits_agents)

    def result(self) -> Scenario:
        """The edited scenario."""
        builder, tokens = self.builder, self.builder.tracks.tokens
        sorts = SORTS.get(self.scenario_type, "")
        obstacles = {
            "construction_zone": [pose[:2] for pose in self.cones.values()],
            "stopped_vehicle": [v.pose[:2] for v in self.vehicles if v.behavior == events.STOPPED],
            "jaywalking_pedestrian": [crossing.end for crossing in self.crossings],
        }.get(sorts, [])
        letter = self.changes.get("observation", "")
        policy = codes.POLICIES.get(letter, builder.edit.agents or MANNERS[0])
        return builder.finish(
            self.scenario_type,
            MANNERS.index(policy),
            crossings=tuple(replace(w, track=tokens.index(w.token)) for w in self.crossings),
            profile="interplan",
            sorts=sorts,
            obstacles=np.array(obstacles).reshape(-1, 2),
        )

    def _fill(self) -> None:
        """Remove, spawn, and add what is special, in interPlan's order."""
        changes = self.changes
        if "amount_of_agents" in changes:  # it goes before density
            self._remove(changes["amount_of_agents"])
        elif "density" in changes:
            self._remove(0)
            self._fill_lanes(changes["density"])
        if "special_scenario" in changes:
            if "density" not in changes:
                self._remove(0)
            self._add_special()

    def _remove(self, share: int) -> None:
        count = int((1.0 - share) * len(self.vehicles))
        if count < 0:
            raise ConfigError(f"a share of {share} is more than all agents", "a0 or a1")
        self.bodies = self.builder.draws.sample(self.vehicles, count)
        self.vehicles = [vehicle for vehicle in self.vehicles if vehicle not in self.bodies]

    def _fill_lanes(self, density: str) -> None:
        builder, road, details = self.builder, self.road, self.builder.edit.details
        if self.ego_edge == NO_EDGE:
            raise ConfigError("the ego is on no lane at the start")
        places = details.get("roadblock_locations_to_spawn_agents")
        if places is not None:
            places = self.special.get("roadblock_locations_to_spawn_agents", places)
        points = tuple((float(x), float(y)) for x, y in places or ())
        gap = LEVELS[codes.DENSITIES[density]]
        slots, speed = draw_slots(road, self.ego_edge, builder.center, gap, points, builder.draws)
        self.ego_speed = self.ego_speed if speed is None else speed
        for slot in slots:
            self._add(slot.pose, slot.speed, events.FOLLOW)
        for x, y, extra_speed, *more in details.get("extra_agents_to_spawn") or ():
            options = more[0] if more else {}
            pose = np.array([x, y, 0.0])
            if options.get("snap"):
                edges = road.lanes_at(x, y) or road.connectors_at(x, y)
                if not edges:
                    raise ConfigError(f"an extra agent at ({x}, {y}) is on no lane")
                pose = start_on(road, edges[0], x, y).pose
            is_default = bool(more) and options["behavior"] == "default"
            self._add(pose, extra_speed, events.FOLLOW if is_default else events.CAUTIOUS)

    def _add_special(self) -> None:
        for pose in self.special.get("stopped_vehicle", ()):
            self._add(np.array(pose, np.float64), 0.0, events.STOPPED)
        for pose in self.special.get("stopped_bus", ()):
            self._add(np.array(pose, np.float64), 0.0, events.STOPPED, BUS)
        if not self.crossings:
            for x0, y0, x1, y1, iteration in self.special.get("pedestrian", ()):
                heading = wrap_angle(float(np.arctan2(y1 - y0, x1 - x0)))
                start, end = np.array([x0, y0, heading]), np.array([x1, y1])
                self.crossings.append(
                    events.Crossing(self._new_token(), start, end, iteration or 0)
                )
        if not self.cones:
            # nuPlan rule 707: interPlan leaves these headings to numpy's global state
            turns = np.random.RandomState(0)
            for x, y, *_ in self.special.get("cones", ()):
                pose = np.array([x, y, turns.uniform(low=-np.pi, high=np.pi)])
                self.cones[self._new_token()] = pose

    def _draw_token(self) -> str:
        return format(self.builder.draws.randrange(16**16), "=16x")

    def _new_token(self) -> str:
        """As interPlan draws it: after another token and a number that it does not use."""
        _, _ = self._draw_token(), self.builder.draws.randint(100, 1000)
        return self._draw_token()

    def _add(
        self, pose: FloatArray, speed: float, behavior: int, size: FloatArray | None = None
    ) -> None:
        """Add a vehicle, unless it is in the way of another one."""
        if self.bodies:
            body = self.bodies.pop(0)  # nuPlan rule 708: also where it is refused below
            token, body_size = body.token, body.size
        else:
            _, token, body_size = self._draw_token(), self._draw_token(), EGO_SIZE
        # nuPlan rule 700: not the speed that was computed, but the ego's velocity, or none
        velocity = self.ego_velocity if speed else np.zeros(2)
        new = Vehicle(token, pose, body_size if size is None else size, velocity, behavior)
        corridors = [other.corridor for other in self.vehicles]
        meets = shapely.intersects(new.corridor, corridors).tolist()
        met = {other.token for other, is_met in zip(self.vehicles, meets, strict=True) if is_met}
        if met and behavior == events.STOPPED:
            self.vehicles = [
                other
                for other in self.vehicles
                if other.token not in met or other.behavior == events.STOPPED
            ]
        elif met:
            blocks = blocks_at(self.road, float(pose[0]), float(pose[1]))
            if not blocks or blocks[0] != int(self.road.block_of[self.ego_edge]):
                return
        self.vehicles.append(new)

    def _build(self, initial: FloatArray, edits_agents: bool) -> None:
        """Put everything into the builder; the ego starts in the state `initial` (11,)."""
        builder, plan, scenario = self.builder, self.plan, self.builder.recorded
        stays = builder.tracks.kinds != AgentKind.VEHICLE
        builder.select(stays & (not edits_agents))
        # nuPlan rule 709: interPlan seeds what it draws only where it changes agents
        self._add_vehicles(builder.draws if edits_agents else random.Random(0))
        if self.cones:
            poses = np.array(list(self.cones.values()))
            builder.add(list(self.cones), AgentKind.TRAFFIC_CONE, CONE, poses)
        if self.crossings:
            tokens, starts = zip(*((w.token, w.start) for w in self.crossings), strict=True)
            size, poses = np.array(events.CROSSING_SIZE), np.array(starts)
            builder.add(tokens, AgentKind.PEDESTRIAN, size, poses, valid=False)
        ego, later = np.array(scenario.ego), scenario.iteration_rows[1:]
        if "goal" in self.changes:
            ego[later] = initial
            ego[later, :3] = rear_poses(plan.centers[1:])
        ego[builder.now] = initial
        builder.change(ego=ego, route=plan.route, mission_goal=plan.goal)
        builder.termination = events.TerminationCondition(plan.line[:, :2], plan.end)

    def _add_vehicles(self, draws: random.Random) -> None:
        """The vehicles at iteration 0, and before it where they were with noise."""
        builder, vehicles = self.builder, self.vehicles
        past = _past(self.road, vehicles, draws)
        if not vehicles:
            return
        rows = builder.now - builder.scenario.row_step * np.arange(HISTORY, 0, -1)
        known = rows >= 0
        behaviors = np.array([vehicle.behavior for vehicle in vehicles])
        shape = (len(builder.scenario.time_us), len(vehicles))
        poses, valid = np.empty((*shape, 3)), np.zeros(shape, np.bool_)
        poses[:] = [vehicle.pose for vehicle in vehicles]
        poses[rows[known]] = past[known]
        valid[rows[known]] = valid[builder.now] = True
        valid[builder.now :, behaviors == events.STOPPED] = True
        builder.add(
            [vehicle.token for vehicle in vehicles],
            AgentKind.VEHICLE,
            np.array([vehicle.size for vehicle in vehicles]),
            poses,
            valid=valid,
            velocities=np.array([vehicle.velocity for vehicle in vehicles]),
            behaviors=behaviors,
        )


def _past(road: VectorMap, vehicles: list[Vehicle], draws: random.Random) -> FloatArray:
    """(23, V, 3) where the vehicles were, oldest first, with noise."""
    found = enumerate(_edge_and_progress(road, vehicle) for vehicle in vehicles)
    agents = [(number, *start) for number, start in found if start is not None]
    out = np.array([[vehicle.pose for vehicle in vehicles]] * HISTORY).reshape(HISTORY, -1, 3)
    if not agents:
        return out
    numbers, edges, starts = map(np.array, zip(*agents, strict=True))
    # nuPlan rule 709: with noise, standing ones as well
    noise = [draws.gauss(0, _JITTER) for _ in range(HISTORY * len(agents))]
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


def _edge_and_progress(road: VectorMap, vehicle: Vehicle) -> tuple[int, float] | None:
    edges = edges_under(road, vehicle.pose, vehicle.size)
    if len(edges) == 1:
        return edges[0], road.progress_on(edges[0], *vehicle.pose[:2].tolist())
    if not edges:
        return None
    start = nearest_heading(road, edges, vehicle.pose)
    return start.edge, start.progress
