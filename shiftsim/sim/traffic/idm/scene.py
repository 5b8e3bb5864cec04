"""The arrays of one rollout with reactive traffic, as kernels take them.

A `Scene` travels whole: who drives, what is in the way, what is read of the map, and scratch.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.corridor import Corridor
from shiftsim.geometry.polylines import RUN
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.sim.traffic.idm.buffer import curve_capacity
from shiftsim.world.layers import Lists, Polygons, Polylines
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind

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


class Footprints(NamedTuple):
    """What can be in an agent's way: A agents, the ego, the ego ahead, replayed tracks; M in all.

    The footprint of an agent is its box and the buffer of the piece of its path just ahead. The ego
    ahead is where it will be soon (`yielding`), and seldom present.
    """

    present: BoolArray  # (M,) whether it is there
    bounds: FloatArray  # (M, 4) min x, min y, max x, max y [m]
    box: FloatArray  # (M, 4, 2) corners [m]
    curve: FloatArray  # (A + 2, V, 2) buffers of the path pieces just ahead of agents and ego [m]
    curve_size: IntArray  # (M,) how many vertices of them count; 0 before the first step
    apart: FloatArray  # (M,) scratch: least distances to one of them [m]


class Footprint(NamedTuple):
    """One of the footprints."""

    box: FloatArray  # (4, 2) corners [m]
    curve: FloatArray  # (V, 2) buffer of its path piece, maybe empty [m]


class Ahead(NamedTuple):
    """The corridor ahead of one agent."""

    corridor: Corridor
    outline: FloatArray  # (V, 2) its outline [m]
    outline_size: IntArray  # (1,) how many of its vertices count; -1 before it is made


class Scratch(NamedTuple):
    """Room for intermediate results of one agent."""

    line: FloatArray  # (K, 2) a piece of a path [m]
    runs: FloatArray  # (R, 4) bounds of its runs of segments, as in `Path` [m]
    outline: FloatArray  # this and the next one as in `Ahead`
    outline_size: IntArray


class Yielding(NamedTuple):
    """What agents make of where the ego will be; A agents."""

    policy: int  # as in `world.events`; OFF for nuPlan's agents, which do not look ahead
    cautious: BoolArray  # (A,) to whom the ego always stands
    edges: Polygons  # areas of the lanes and connectors
    block_of: IntArray  # (E,) block of an edge
    draws: IntArray  # (D,) 0 or 1, for the policy MIXED
    num_drawn: IntArray  # (1,) how many were used
    ego_block: IntArray  # (1,) block of the ego's lane


class Scene(NamedTuple):
    """The reactive traffic of one rollout."""

    parameters: IdmParameters  # how agents drive; all numbers are floats
    graph: LaneGraph  # the lanes
    fleet: Fleet  # the agents
    agents: IntArray  # (A,) their tracks
    replayed: IntArray  # (R,) tracks that are replayed from the log
    footprints: Footprints  # of agents, ego and replayed tracks
    yielding: Yielding  # how agents treat the ego
    scratch: Scratch  # intermediate results


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
    yielding: Yielding,
) -> Scene:
    """The scene at iteration 0, with nothing in anyone's way yet (attributes as of `Scene`)."""
    count = len(agents) + 2 + len(replayed)
    footprints = Footprints(
        present=np.zeros(count, np.bool_),
        bounds=np.zeros((count, 4)),
        box=np.zeros((count, 4, 2)),
        curve=_make_curves(fleet),
        curve_size=np.zeros(count, np.int64),
        apart=np.empty(count),
    )
    scratch = _make_scratch(fleet)
    return Scene(parameters, graph, fleet, agents, replayed, footprints, yielding, scratch)


def _make_curves(fleet: Fleet) -> FloatArray:
    # room for any curve: pages that nobody writes take no memory
    num_agents, longest, _ = fleet.path.shape
    return np.empty((num_agents + 2, curve_capacity(longest + _EXTRA_POINTS), 2))


def _make_scratch(fleet: Fleet) -> Scratch:
    points = fleet.path.shape[1] + _EXTRA_POINTS
    runs, outline = np.empty(((points - 2) // RUN + 1, 4)), np.empty((curve_capacity(points), 2))
    return Scratch(np.empty((points, 2)), runs, outline, np.zeros(1, np.int64))


def with_longer_paths(scene: Scene, needed: int) -> Scene:
    """The same scene, for paths of `needed` vertices and more."""
    path = np.zeros((len(scene.agents), 2 * needed, 4))
    path[:, : scene.fleet.path.shape[1]] = scene.fleet.path
    fleet, curve = scene.fleet._replace(path=path), _make_curves(scene.fleet._replace(path=path))
    longest = int(scene.footprints.curve_size.max())
    curve[:, :longest] = scene.footprints.curve[:, :longest]
    footprints = scene.footprints._replace(curve=curve)
    return scene._replace(fleet=fleet, footprints=footprints, scratch=_make_scratch(fleet))
