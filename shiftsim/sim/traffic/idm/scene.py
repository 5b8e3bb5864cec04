"""The arrays of one rollout with reactive traffic, as kernels take them.

A `Scene` travels whole: who drives, what is in the way, what is read of the map, and scratch.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.polylines import runs_of
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.sim.traffic.idm.buffer import curve_capacity
from shiftsim.world.layers import Lists, Polygons, Polylines
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, Tracks

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
    """Parameters of the reactive traffic; the defaults are nuPlan's."""

    target_speed: float = 10.0  # speed on a free road where the map has no limit [m/s]
    min_gap: float = 1.0  # gap kept at standstill [m]
    headway: float = 1.5  # time gap kept, and how far footprints reach ahead [s]
    accel_max: float = 1.0  # largest acceleration [m/s^2]
    decel_max: float = 2.0  # comfortable deceleration, positive [m/s^2]
    min_path_length: float = 20.0  # path kept ahead at standstill [m]
    radius: float = 100.0  # agents farther from the ego than this are removed for good [m]


class LaneGraph(NamedTuple):
    """What reactive agents read of a map. E edges."""

    baselines: Polylines  # E centre lines
    outgoing: Lists  # edges an edge leads to
    speed_limits: FloatArray  # (E,) [m/s], NaN where the map has none
    has_lights: BoolArray  # (E,) whether lights govern the edge
    stop_lines: Lists  # stop polygons of an edge
    stops: Polygons  # the stop polygons
    lights: IntArray  # (E,) which lights are listed in the present step: GREEN and RED added up


class Fleet(NamedTuple):
    """State of the reactive agents, in the order of their construction. A agents."""

    alive: BoolArray  # (A,) whether the agent is still simulated
    size: FloatArray  # (A, 2) length, width [m]
    progress: FloatArray  # (A,) along the path, not clamped to it [m]
    speed: FloatArray  # (A,) along the path [m/s]
    target: FloatArray  # (A,) speed on a free road [m/s]
    pose: FloatArray  # (A, 3) on the path at the last propagation: x [m], y [m], heading [rad]
    route: IntArray  # (A, 5) edges of the path, oldest first
    route_size: IntArray  # (A,) how many of them
    path: FloatArray  # (A, K, 4) vertices of the path: x [m], y [m], heading [rad], progress [m]
    path_size: IntArray  # (A,) how many of them
    line: FloatArray  # (A, K, 2) the path ahead [m]: vertices from `first` on, the others are gone
    runs: FloatArray  # (A, R, 4) bounds of the path's runs of segments, those driven included [m]
    first: IntArray  # (A,) where in `line` the agent is; before the path is surveyed -1


class Footprints(NamedTuple):
    """What can be in an agent's way: A agents, the ego, the ego ahead, replayed tracks; M in all.

    The footprint of an agent is its box and the buffer of the piece of its path just ahead. The ego
    ahead is where it will be soon (`courtesy`), and seldom present.
    """

    present: BoolArray  # (M,) whether it is there
    bounds: FloatArray  # (M, 4) min x, min y, max x, max y [m]
    box: FloatArray  # (M, 4, 2) corners [m]
    curve: FloatArray  # (A + 2, V, 2) buffers of the path pieces just ahead of agents and ego [m]
    curve_size: IntArray  # (A + 2,) how many vertices of them count; 0 before the first step


class Scratch(NamedTuple):
    """Room for intermediate results of one agent."""

    line: FloatArray  # (K, 2) a piece of a path [m]
    keep: BoolArray  # (K,) flags of its vertices
    runs: FloatArray  # (R, 4) bounds of a line's runs of segments [m]
    outline: FloatArray  # (W, 2) outline of the buffer of a path [m]
    near: IntArray  # (M,) footprints that may be in the corridor
    apart: FloatArray  # (M,) lower bounds of the gaps to them [m]


class Courtesy(NamedTuple):
    """What agents make of where the ego will be; A agents."""

    manner: int  # as in `world.events`; OFF for nuPlan's agents, which do not look ahead
    cautious: BoolArray  # (A,) to whom the ego always stands
    edges: Polygons  # areas of the lanes and connectors
    block_of: IntArray  # (E,) block of an edge
    draws: IntArray  # (D,) 0 or 1, for agents of mixed manners
    drawn: IntArray  # (1,) how many were used
    ego_block: IntArray  # (1,) block of the ego's lane
    line: FloatArray  # (5, 2) scratch for the ego's path [m]
    keep: BoolArray  # (5,) flags of its vertices


class Scene(NamedTuple):
    """The reactive traffic of one rollout."""

    parameters: IdmParameters  # how agents drive; all numbers are floats
    graph: LaneGraph  # the lanes
    fleet: Fleet  # the agents
    agents: IntArray  # (A,) their tracks
    replayed: IntArray  # (R,) tracks that are replayed from the log
    footprints: Footprints  # of agents, ego and replayed tracks
    courtesy: Courtesy  # how agents treat the ego
    scratch: Scratch  # intermediate results


class Row(NamedTuple):
    """One row of tracks, as in `Tracks`: (N,), (N, 3), (N, 2), (N, 2); or T of them."""

    valid: BoolArray
    poses: FloatArray
    velocities: FloatArray
    sizes: FloatArray


def rows_of(tracks: Tracks, index: int | slice = slice(None)) -> Row:
    """One row of tracks, or many, as kernels take them."""
    parts = tracks.valid, tracks.poses, tracks.velocities, tracks.sizes
    return Row._make(part[index] for part in parts)


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
        np.zeros(len(map.edges), np.int64),
    )


def make_scene(
    parameters: IdmParameters,
    graph: LaneGraph,
    fleet: Fleet,
    agents: IntArray,
    replayed: IntArray,
    courtesy: Courtesy,
) -> Scene:
    """The scene at iteration 0, with nothing in anyone's way yet (attributes as of `Scene`)."""
    num_agents = len(agents)
    count = num_agents + 2 + len(replayed)
    footprints = Footprints(
        present=np.zeros(count, np.bool_),
        bounds=np.zeros((count, 4)),
        box=np.zeros((count, 4, 2)),
        curve=np.zeros((num_agents + 2, _CURVE_CAPACITY, 2)),
        curve_size=np.zeros(num_agents + 2, np.int64),
    )
    scratch = _make_scratch(fleet.path.shape[1], count)
    return Scene(parameters, graph, fleet, agents, replayed, footprints, courtesy, scratch)


def _make_scratch(longest_path: int, count: int) -> Scratch:
    points = longest_path + _EXTRA_POINTS
    return Scratch(
        line=np.zeros((points, 2)),
        keep=np.zeros(points, np.bool_),
        runs=np.zeros((runs_of(points), 4)),
        outline=np.zeros((curve_capacity(points), 2)),
        near=np.zeros(count, np.int64),
        apart=np.zeros(count),
    )


def with_longer_paths(scene: Scene, needed: int) -> Scene:
    """The same scene, for paths of `needed` vertices and more."""
    fleet, count = scene.fleet, 2 * needed
    path, line, runs = make_paths(len(scene.agents), count)
    for longer, before in ((path, fleet.path), (line, fleet.line), (runs, fleet.runs)):
        longer[:, : before.shape[1]] = before
    scratch = _make_scratch(count, len(scene.footprints.present))
    return scene._replace(fleet=fleet._replace(path=path, line=line, runs=runs), scratch=scratch)


def make_paths(num_agents: int, longest: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Empty paths of at most `longest` vertices, and their `line` and `runs`, as in `Fleet`."""
    return (
        np.zeros((num_agents, longest, 4)),
        np.zeros((num_agents, longest, 2)),
        np.zeros((num_agents, runs_of(longest), 4)),
    )


def with_longer_curves(scene: Scene) -> Scene:
    """The same scene, for footprints of twice as many vertices."""
    before = scene.footprints.curve
    curve = np.zeros((len(before), 2 * before.shape[1], 2))
    curve[:, : before.shape[1]] = before
    return scene._replace(footprints=scene.footprints._replace(curve=curve))
