"""The agents of one rollout with everything they look at, as the arrays that kernels take."""

from dataclasses import dataclass

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.errors import TrafficError
from shiftsim.sim.traffic.idm.agents import Start, more_room
from shiftsim.sim.traffic.idm.buffer import curve_room
from shiftsim.sim.traffic.idm.footprints import Obstacles, Scratch, move_agent, set_box
from shiftsim.sim.traffic.idm.grid import make_grid
from shiftsim.sim.traffic.idm.paths import Fleet, Roads
from shiftsim.sim.traffic.idm.shapes import PIECE
from shiftsim.sim.traffic.idm.step import (
    DONE,
    LONGER_CURVES,
    LONGER_PATHS,
    STRAYED,
    Driving,
    Row,
    advance,
    write_agents,
)
from shiftsim.world.layers import Polygons
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LightStatus, Tracks

_CURVE_ROOM = 256  # vertices of a footprint to begin with
_EXTRA_POINTS = 2  # a piece of a path has at most two more vertices than the path


@dataclass(slots=True)
class Scene:
    """State of the reactive traffic of one rollout.

    Attributes:
        fleet: The agents.
        agents: (A,) their tracks.
        replayed: (R,) tracks that are replayed from the log.
        roads: The map.
        stops: Its stop polygons.
        obstacles: Agents, ego, and room for all replayed tracks.
        scratch: Room for the kernels.
        light_edges: (C,) edges whose lights are listed.
        lights: (T, C) LightStatus codes at the iterations.
        status: (E,) LightStatus codes of the present step.
        spans: (T - 1,) length of each step [s].
        driving: Parameters.
    """

    fleet: Fleet
    agents: IntArray
    replayed: IntArray
    roads: Roads
    stops: Polygons
    obstacles: Obstacles
    scratch: Scratch
    light_edges: IntArray
    lights: IntArray
    status: IntArray
    spans: FloatArray
    driving: Driving

    def advance(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move the agents from one iteration to the next and write where they are.

        Args:
            iteration: The iteration that ends.
            ego: (11,) ego state at that iteration.
            tracks: Holds the replayed tracks.
            row: Row of `tracks` of the next iteration.

        Raises:
            TrafficError: An agent is outside of its own corridor.
        """
        # nuPlan: the ego is one step old, lights and replayed objects are one step ahead (§12 Q11)
        self.status[self.light_edges] = self.lights[iteration + 1]
        first = 0
        while True:
            end, what = self._try_step(iteration, ego, row_of(tracks, row), first)
            if end == DONE:
                return
            if end == STRAYED:
                raise TrafficError(
                    f"reactive agent {tracks.tokens[self.agents[what]]} is outside of its own path "
                    f"at iteration {iteration + 1}",
                    hint="nuPlan fails here as well; --traffic reactive-fixed goes on",
                )
            if end == LONGER_PATHS:
                self.fleet = more_room(self.fleet, what)
                self.scratch = make_scratch(self.fleet, self.stops, len(self.obstacles.present))
            while end == LONGER_CURVES and self._move(what) < 0:
                self.obstacles = _longer_curves(self.obstacles)
            first = what + 1 if end == LONGER_CURVES else 0

    def _try_step(self, iteration: int, ego: FloatArray, row: Row, first: int) -> tuple[int, int]:
        end: tuple[int, int] = advance(
            self.fleet,
            self.agents,
            self.replayed,
            self.obstacles,
            self.roads,
            self.stops,
            self.status,
            self.driving,
            ego,
            row,
            self.spans[iteration],
            self.scratch,
            first,
        )
        return end

    def _move(self, agent: int) -> int:
        made: int = move_agent(
            self.fleet, agent, self.obstacles, self.scratch, self.driving.headway
        )
        return made

    def write(self, tracks: Tracks, row: int) -> None:
        """Write the agents into a row; those that are gone are not valid there."""
        write_agents(self.fleet, self.agents, row_of(tracks, row))


def make_scene(
    scenario: Scenario,
    fleet: Fleet,
    starts: list[Start],
    agents: IntArray,
    replayed: IntArray,
    driving: Driving,
) -> Scene:
    """The scene at iteration 0.

    Args:
        scenario: The scenario.
        fleet: A agents.
        starts: Where they are on the map.
        agents: (A,) their tracks.
        replayed: (R,) tracks that are replayed from the log.
        driving: Parameters.
    """
    road, count = scenario.map, len(agents)
    obstacles = _make_obstacles(count, count + 1 + len(replayed))
    poses = [start.pose for start in starts]
    # the first gaps are measured between snapped boxes, not footprints (§10.2)
    for agent, pose in enumerate(poses):
        set_box(obstacles, agent, *pose, *fleet.size[agent])
    lights = scenario.traffic_lights
    known = [i for i, name in enumerate(lights.connector_ids) if name in road.edges.index]
    edges = [road.edges.index[lights.connector_ids[i]] for i in known]
    seconds = scenario.iteration_times * 1e-6  # nuPlan: a difference of epoch seconds (§12 Q1)
    return Scene(
        fleet=fleet,
        agents=agents,
        replayed=replayed,
        roads=roads_of(road),
        stops=road.stop_polygons.polygons,
        obstacles=obstacles,
        scratch=make_scratch(fleet, road.stop_polygons.polygons, len(obstacles.present)),
        light_edges=np.array(edges, np.int64),
        lights=lights.status[scenario.iteration_rows][:, known].astype(np.int64),
        status=np.full(len(road.edges), LightStatus.ABSENT, np.int64),
        spans=np.diff(seconds),
        driving=driving,
    )


def row_of(tracks: Tracks, row: int) -> Row:
    """One row of tracks as kernels take it."""
    return Row(tracks.valid[row], tracks.poses[row], tracks.velocities[row], tracks.sizes[row])


def roads_of(road: VectorMap) -> Roads:
    """What reactive agents read of a map."""
    return Roads(
        road.baselines,
        road.outgoing,
        road.speed_limits,
        road.has_traffic_lights,
        road.stop_lines,
    )


def make_scratch(fleet: Fleet, stops: Polygons, num_obstacles: int) -> Scratch:
    """Room for the kernels, enough for the longest path of the fleet."""
    points = fleet.path.shape[1] + _EXTRA_POINTS
    return Scratch(
        line=np.zeros((points, 2)),
        keep=np.zeros(points, np.bool_),
        pieces=np.zeros((points // PIECE + 1, 4)),
        corridor=np.zeros((curve_room(points), 2)),
        hits=np.zeros(num_obstacles, np.int64),
        apart=np.zeros(num_obstacles),
        stop=np.zeros((np.diff(stops.ring_ptr).max(initial=0), 2)),
        stop_bounds=np.zeros(4),
        grid=make_grid(num_obstacles),
    )


def _make_obstacles(num_agents: int, count: int) -> Obstacles:
    return Obstacles(
        present=np.zeros(count, np.bool_),
        bounds=np.zeros((count, 4)),
        box=np.zeros((count, 4, 2)),
        speed=np.zeros(count),
        heading=np.zeros(count),
        curve=np.zeros((num_agents, _CURVE_ROOM, 2)),
        curve_size=np.zeros(num_agents, np.int64),
    )


def _longer_curves(obstacles: Obstacles) -> Obstacles:
    num_agents, room = obstacles.curve.shape[:2]
    curve = np.zeros((num_agents, 2 * room, 2))
    curve[:, :room] = obstacles.curve
    return obstacles._replace(curve=curve)


def forget(tracks: Tracks, row: int, which: BoolArray) -> None:
    """Remove tracks (a mask) from a row on."""
    tracks.valid[row:, which] = False
    for values in (tracks.poses, tracks.velocities, tracks.sizes):
        values[row:, which] = np.nan
