"""The arrays of one rollout with reactive traffic, as kernels take them.

A `Scene` travels whole: who drives, what is in the way, what is read of the map, and scratch.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray
from shiftsim.sim.traffic.idm.buffer import curve_capacity
from shiftsim.sim.traffic.idm.shapes import PIECE
from shiftsim.world.layers import Lists, Polygons, Polylines
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, LightStatus, Tracks

# Kinds that are replayed from the log, in nuPlan's order of observation.
REPLAYED_KINDS = (
    AgentKind.PEDESTRIAN,
    AgentKind.BARRIER,
    AgentKind.CZONE_SIGN,
    AgentKind.TRAFFIC_CONE,
    AgentKind.GENERIC_OBJECT,
)
HEADING, PROGRESS = 2, 3  # columns of a path vertex, after x and y
MAX_ROUTE = 5  # segments an agent remembers, nuPlan
_CURVE_CAPACITY = 256  # vertices of a footprint to begin with
_EXTRA_POINTS = 2  # a piece of a path has at most two more vertices than the path


class IdmParameters(NamedTuple):
    """Parameters of the reactive traffic; the defaults are nuPlan's.

    Attributes:
        target_speed: Speed on a free road where the map has no limit [m/s].
        min_gap: Gap kept at standstill [m].
        headway: Time gap kept, and how far footprints reach ahead [s].
        accel_max: Largest acceleration [m/s^2].
        decel_max: Comfortable deceleration, positive [m/s^2].
        min_path_length: Path kept ahead at standstill [m].
        radius: Agents farther from the ego than this are removed for good [m].
    """

    target_speed: float = 10.0
    min_gap: float = 1.0
    headway: float = 1.5
    accel_max: float = 1.0
    decel_max: float = 2.0
    min_path_length: float = 20.0
    radius: float = 100.0


class LaneGraph(NamedTuple):
    """What reactive agents read of a map. E edges.

    Attributes:
        baselines: E centre lines.
        outgoing: Edges an edge leads to.
        speed_limits: (E,) [m/s], NaN where the map has none.
        has_lights: (E,) whether lights govern the edge.
        stop_lines: Stop polygons of an edge.
        stops: The stop polygons.
        status: (E,) LightStatus codes of the present step.
    """

    baselines: Polylines
    outgoing: Lists
    speed_limits: FloatArray
    has_lights: BoolArray
    stop_lines: Lists
    stops: Polygons
    status: IntArray


class Fleet(NamedTuple):
    """State of the reactive agents, in the order of their construction. A agents.

    Attributes:
        alive: (A,) whether the agent is still simulated.
        size: (A, 2) length, width [m].
        progress: (A,) along the path, not clamped to it [m].
        speed: (A,) along the path [m/s].
        target: (A,) speed on a free road [m/s].
        pose: (A, 3) on the path at the last propagation: x [m], y [m], heading [rad].
        route: (A, 5) edges of the path, oldest first.
        route_size: (A,) how many of them.
        path: (A, K, 4) vertices of the path: x [m], y [m], heading [rad], progress [m].
        path_size: (A,) how many of them.
    """

    alive: BoolArray
    size: FloatArray
    progress: FloatArray
    speed: FloatArray
    target: FloatArray
    pose: FloatArray
    route: IntArray
    route_size: IntArray
    path: FloatArray
    path_size: IntArray


class Footprints(NamedTuple):
    """What can be in an agent's way: A agents, then the ego, then replayed tracks; M in all.

    The footprint of an agent is its box and the buffer of the piece of its path just ahead.

    Attributes:
        present: (M,) whether it is there.
        bounds: (M, 4) min x, min y, max x, max y [m].
        box: (M, 4, 2) corners [m].
        curve: (A, V, 2) buffers of the path pieces just ahead of the agents [m].
        curve_size: (A,) how many vertices of them count; 0 before the first step.
    """

    present: BoolArray
    bounds: FloatArray
    box: FloatArray
    curve: FloatArray
    curve_size: IntArray


class Scratch(NamedTuple):
    """Room for intermediate results of one agent.

    Attributes:
        line: (K, 2) a piece of a path [m].
        keep: (K,) flags of its vertices.
        pieces: (C, 4) bounding boxes of the line's pieces [m].
        corridor: (W, 2) outline of the buffer of the path ahead [m].
        near: (M,) footprints that may be in the corridor.
        apart: (M,) lower bounds of the gaps to them [m].
    """

    line: FloatArray
    keep: BoolArray
    pieces: FloatArray
    corridor: FloatArray
    near: IntArray
    apart: FloatArray


class Scene(NamedTuple):
    """The reactive traffic of one rollout.

    Attributes:
        parameters: How agents drive; all numbers are floats.
        graph: The lanes.
        fleet: The agents.
        agents: (A,) their tracks.
        replayed: (R,) tracks that are replayed from the log.
        footprints: Of agents, ego and replayed tracks.
        scratch: Intermediate results.
    """

    parameters: IdmParameters
    graph: LaneGraph
    fleet: Fleet
    agents: IntArray
    replayed: IntArray
    footprints: Footprints
    scratch: Scratch


class Row(NamedTuple):
    """One row of tracks, as in `Tracks`: (N,), (N, 3), (N, 2), (N, 2)."""

    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray


def row_of(tracks: Tracks, row: int) -> Row:
    """One row of tracks as kernels take it."""
    return Row(tracks.valid[row], tracks.poses[row], tracks.velocities[row], tracks.sizes[row])


def lane_graph(map: VectorMap) -> LaneGraph:
    """What agents read of a map; no light is listed yet."""
    return LaneGraph(
        map.baselines,
        map.outgoing,
        map.speed_limits,
        map.has_traffic_lights,
        map.stop_lines,
        # maps are read-only, which to a kernel is another type than footprints are
        Polygons._make(array.copy() for array in map.stop_polygons.polygons),
        np.full(len(map.edges), LightStatus.ABSENT, np.int64),
    )


def make_scene(
    parameters: IdmParameters, graph: LaneGraph, fleet: Fleet, agents: IntArray, replayed: IntArray
) -> Scene:
    """The scene at iteration 0, with nothing in anyone's way yet (attributes as of `Scene`)."""
    num_agents = len(agents)
    count = num_agents + 1 + len(replayed)
    footprints = Footprints(
        present=np.zeros(count, np.bool_),
        bounds=np.zeros((count, 4)),
        box=np.zeros((count, 4, 2)),
        curve=np.zeros((num_agents, _CURVE_CAPACITY, 2)),
        curve_size=np.zeros(num_agents, np.int64),
    )
    scratch = _make_scratch(fleet.path.shape[1], count)
    return Scene(parameters, graph, fleet, agents, replayed, footprints, scratch)


def _make_scratch(longest_path: int, count: int) -> Scratch:
    points = longest_path + _EXTRA_POINTS
    return Scratch(
        line=np.zeros((points, 2)),
        keep=np.zeros(points, np.bool_),
        pieces=np.zeros((points // PIECE + 1, 4)),
        corridor=np.zeros((curve_capacity(points), 2)),
        near=np.zeros(count, np.int64),
        apart=np.zeros(count),
    )


def with_longer_paths(scene: Scene, needed: int) -> Scene:
    """The same scene, for paths of `needed` vertices and more."""
    path = np.zeros((len(scene.agents), 2 * needed, 4))
    path[:, : scene.fleet.path.shape[1]] = scene.fleet.path
    scratch = _make_scratch(2 * needed, len(scene.footprints.present))
    return scene._replace(fleet=scene.fleet._replace(path=path), scratch=scratch)


def with_longer_curves(scene: Scene) -> Scene:
    """The same scene, for footprints of twice as many vertices."""
    before = scene.footprints.curve
    curve = np.zeros((len(before), 2 * before.shape[1], 2))
    curve[:, : before.shape[1]] = before
    return scene._replace(footprints=scene.footprints._replace(curve=curve))
