"""Reactive traffic: vehicles follow the lane graph behind whoever is in front (IDM).

Equal to nuPlan's IDM agents, oddities included: bicycles, late vehicles and vehicles off the lanes
vanish, replayed tracks count as standing, gaps are measured between footprints that reach 1.5 s
ahead, and agents react to the ego of the iteration before. Where nuPlan's simulation fails, this
one raises a TrafficError: an agent is outside of the corridor along its own path, or starts on a
baseline too short to be a path.

Vehicles of the first frame are put on the baseline of the lane or connector they are in; those for
which there is none, or no space, are not simulated.
"""

from copy import copy
from typing import Any

import numpy as np

from shiftsim.errors import ConfigError, TrafficError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.sim.traffic.idm.paths import (
    append_baseline,
    clamp_progress,
    finish_path,
    pose_on_path,
    set_box,
)
from shiftsim.sim.traffic.idm.scene import (
    MAX_ROUTE,
    REPLAYED_KINDS,
    Fleet,
    Footprints,
    IdmParameters,
    Scene,
    lane_graph,
    make_scene,
    with_longer_paths,
)
from shiftsim.sim.traffic.idm.step import LEFT_PATH, LONGER_PATHS, advance_steps, write_agents
from shiftsim.sim.traffic.idm.yielding import make_yielding
from shiftsim.sim.traffic.lanes import light_flags
from shiftsim.world.events import CAUTIOUS, LOGGED, OFF
from shiftsim.world.lanes import Start, find_start, find_starts
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, VX, VY, AgentKind, Tracks, center_poses

_MIN_VERTICES = 3  # of a baseline: a path of fewer than two cannot be driven, and one is lost
_EGO_SIZE = np.array([PACIFICA.length, PACIFICA.width])


class IdmTraffic:
    """Vehicles follow the lanes behind whoever is ahead; other kinds are replayed from the log."""

    def __init__(self, parameters: IdmParameters | None = None) -> None:
        """Traffic with nuPlan's parameters, or others."""
        self._parameters = IdmParameters(*map(float, parameters or IdmParameters()))
        self._scene: Scene | None = None

    def __deepcopy__(self, memo: Any) -> "IdmTraffic":
        """A model that goes on from here; what agents read of the map stays one."""
        other = copy(self)
        if (scene := self._scene) is not None:
            other._scene = _copied(scene)
        return other

    def start(
        self, scenario: Scenario, tracks: Tracks, row: int, own: IntArray | None = None
    ) -> None:
        """Put the vehicles of iteration 0 on their lanes; clear what is not simulated.

        With `own`, of these tracks only; what others move stays, and is replayed to the agents.
        """
        kinds = tracks.kinds
        ego = scenario.ego[scenario.iteration_rows[0]]
        foreign = np.zeros(len(kinds), np.bool_)
        if own is not None:
            foreign = ~np.isin(np.arange(len(kinds)), own)
        script = scenario.script
        keeps_oddities = script is not None and script.profile == "interplan"
        if script is not None:  # what an edit has stopped stands, and is in the way
            foreign |= script.stopped
        is_replayed = np.isin(kinds, REPLAYED_KINDS) | foreign
        is_agent = tracks.valid[row] & (kinds == AgentKind.VEHICLE) & ~foreign
        is_standing = tracks.valid[row] & is_replayed
        if script is not None and keeps_oddities:
            # nuPlan rules 701, 702: logged vehicles are not simulated, and movers may overlap
            # stopped vehicles and pedestrians at the start
            is_agent &= script.behaviors != LOGGED
            is_standing &= ~script.stopped & (kinds != AgentKind.PEDESTRIAN)
        vehicles, standing = np.flatnonzero(is_agent), np.flatnonzero(is_standing)
        poses, sizes = tracks.poses[row], tracks.sizes[row]
        taken = np.concatenate(
            [
                boxes_to_corners(poses[standing], sizes[standing]),
                boxes_to_corners(center_poses(ego[None, :3]), _EGO_SIZE[None]),
            ]
        )
        starts = place_agents(scenario.map, poses[vehicles], sizes[vehicles], taken)
        placed = [start for start in starts if start is not None]
        agents = vehicles[np.array([start is not None for start in starts], np.bool_)]
        velocity = tracks.velocities[row, agents]
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        speed = np.where(np.isnan(speed), np.hypot(ego[VX], ego[VY]), speed)
        target = self._parameters.target_speed
        fleet = make_fleet(scenario.map, placed, sizes[agents], speed, target)
        replayed = np.flatnonzero(is_replayed)
        graph = lane_graph(scenario.map)
        policy, cautious, seed = OFF, np.zeros(len(agents), np.bool_), 0
        if script is not None:
            policy, seed = script.yielding, script.seed
            cautious = script.behaviors[agents] == CAUTIOUS
        steps = scenario.num_iterations
        yielding = make_yielding(scenario.map, policy, cautious, seed, steps)
        self._scene = make_scene(self._parameters, graph, fleet, agents, replayed, yielding)
        self._map, self._stopped = scenario.map, np.zeros(0, np.int64)
        if script is not None and keeps_oddities:
            self._stopped = np.flatnonzero(script.stopped)
        # nuPlan rule 129: the first gaps are measured between boxes on the lanes, not footprints
        for agent, start in enumerate(placed):
            set_box(self._scene.footprints, agent, *start.pose, *fleet.size[agent])
        self._light_edges, self._lights = light_flags(scenario)
        # nuPlan rule 11: a difference of epoch seconds
        self._spans = np.diff(scenario.iteration_times * 1e-6)
        _remove(tracks, row, ~is_replayed)
        write_agents(fleet, agents, tracks.map_arrays(lambda array: array[row]).arrays)

    def step(self, iteration: int, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Move the agents; replayed tracks and lights are those of the next iteration.

        Raises:
            TrafficError: An agent is outside of its own corridor.
        """
        self.step_many(iteration, ego[None], tracks, row)

    def step_many(self, iteration: int, egos: FloatArray, tracks: Tracks, row: int) -> None:
        """Several steps, with the ego states (S, 11) at their beginnings; else as `step`."""
        scene = self._scene
        if scene is None:
            raise ConfigError("traffic was stepped before it was started", hint="call start first")
        done, looks = 0, scene.yielding.policy != OFF
        while done < len(egos):
            if looks:
                start = find_start(self._map, center_poses(egos[done, None, :3])[0])
                edge = NONE if start is None else self._map.block_of[start.edge]
                scene.yielding.ego_block[0] = edge
            if len(self._stopped):
                self._drop_far(egos[done], tracks, row + done)
            stop = done + 1 if looks or len(self._stopped) else len(egos)
            known = self._spans, self._light_edges, self._lights
            given = row + done, egos[done:stop], iteration + done
            count, end, what = advance_steps(scene, tracks.arrays, *given, *known)
            done += count
            if end == LEFT_PATH:
                raise TrafficError(
                    f"reactive agent {tracks.tokens[scene.agents[what]]} is outside of its own "
                    f"path at iteration {iteration + done + 1}",
                    hint="nuPlan fails here as well; leave the scenario out, or use other traffic",
                )
            if end == LONGER_PATHS:
                self._scene = scene = with_longer_paths(scene, what)

    def _drop_far(self, ego: FloatArray, tracks: Tracks, row: int) -> None:
        """Remove stopped vehicles that are far from the ego, for good: nuPlan rule 712."""
        x, y, _ = center_poses(ego[None, :3])[0]
        poses = tracks.poses[row, self._stopped]
        far = np.hypot(poses[:, 0] - x, poses[:, 1] - y) > self._parameters.radius
        if far.any():
            gone = np.zeros(tracks.num_tracks, np.bool_)
            gone[self._stopped[far]] = True
            _remove(tracks, row, gone)
            self._stopped = self._stopped[~far]


def _copied(scene: Scene) -> Scene:
    """The same scene, in arrays of its own where a step writes."""
    # long arrays that are not full are made anew
    scene = with_longer_paths(scene, -(-scene.fleet.path.shape[1] // 2))
    curve, yielding = scene.footprints.curve, scene.yielding
    written = {name: getattr(yielding, name).copy() for name in ("num_drawn", "ego_block")}
    return scene._replace(
        graph=scene.graph._replace(lights=scene.graph.lights.copy()),
        fleet=Fleet._make(array.copy() for array in scene.fleet),
        footprints=Footprints._make(a if a is curve else a.copy() for a in scene.footprints),
        yielding=yielding._replace(**written),
    )


def _remove(tracks: Tracks, row: int, which: np.ndarray) -> None:
    """Remove tracks (a mask) from a row on."""
    tracks.valid[row:] &= ~which
    for values in tracks.arrays[1:]:
        np.copyto(values[row:], np.nan, where=which[:, None])


def place_agents(
    map: VectorMap, poses: FloatArray, sizes: FloatArray, taken: FloatArray
) -> list[Start | None]:
    """Starts of vehicles, in order; None for those that cannot be simulated.

    A start whose box touches one of `taken` (M, 4, 2), such as the ego's, or that of an earlier
    agent, is dropped. Vehicles are given by logged centres (N, 3) and sizes (N, 2).

    Raises:
        TrafficError: A vehicle starts on a baseline too short to be a path.
    """
    starts = find_starts(map, poses)
    places = [pose if s is None else s.pose for pose, s in zip(poses, starts, strict=True)]
    corners = boxes_to_corners(np.reshape(places, (-1, 3)), sizes)
    occupied, count = np.concatenate([taken, corners]), np.int64(len(taken))
    out: list[Start | None] = []
    for start, box in zip(starts, corners, strict=True):
        if start is not None and touches_any(box, occupied, count):
            start = None
        if start is not None and len(map.baselines.at(start.edge)) < _MIN_VERTICES:
            raise TrafficError(
                f"map {map.name}: the baseline of {map.edges.ids[start.edge]}, on which a "
                f"vehicle starts, has fewer than {_MIN_VERTICES} vertices",
                hint="nuPlan fails here as well; leave the scenario out, or use other traffic",
            )
        if start is not None:
            occupied[count] = box
            count += 1
        out.append(start)
    return out


@kernel
def touches_any(box: FloatArray, boxes: FloatArray, count: int) -> bool:
    """Whether a box (4, 2) touches one of the first `count` of others (M, 4, 2)."""
    for index in range(count):
        if convex_intersect(box, boxes[index]):
            return True
    return False


def make_fleet(
    map: VectorMap,
    starts: list[Start],
    sizes: FloatArray,  # (A, 2) length, width [m]
    speeds: FloatArray,  # (A,) speed along the path [m/s]
    default_target: float,  # speed on a free road where no speed limit is known yet [m/s]
) -> Fleet:
    """Agents at their starts."""
    count = len(starts)
    longest = max([len(map.baselines.at(start.edge)) for start in starts], default=2)
    fleet = Fleet(
        alive=np.ones(count, np.bool_),
        size=np.ascontiguousarray(sizes, np.float64),
        progress=np.array([start.progress for start in starts], np.float64),
        speed=np.array(speeds, np.float64),
        target=np.zeros(count),
        pose=np.zeros((count, 3)),
        route=np.zeros((count, MAX_ROUTE), np.int64),
        route_size=np.ones(count, np.int64),
        path=np.zeros((count, longest, 4)),
        path_size=np.zeros(count, np.int64),
    )
    target = default_target
    for agent, start in enumerate(starts):
        limit = float(map.speed_limits[start.edge])
        # nuPlan rule 121: an agent without a limit inherits that of the agent before it
        target = limit if np.isfinite(limit) and limit != 0.0 else target
        fleet.target[agent] = target
        fleet.route[agent, 0] = start.edge
        path = fleet.path[agent]
        size = finish_path(path, append_baseline(map.baselines, start.edge, path, 0))
        fleet.path_size[agent] = size
        fleet.pose[agent] = pose_on_path(path, size, clamp_progress(path, size, start.progress))
    return fleet
