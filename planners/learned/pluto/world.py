"""What PLUTO's candidates can collide with: static objects, predicted agents, red lights.

The objects are at known places at 0, 0.1, … 4 s (planner-pluto.md §5.2). Array axes: T = 41 times,
O objects, static ones first.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry.boxes import box_corners, boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.planners.learned.pluto.reference import Drivable, RouteLanes
from shiftsim.sim.planner import Observation
from shiftsim.world.layers import Polygons, meets_convex
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, LightStatus, Tracks

SCORED = 40  # steps of 0.1 s
STATIC_KINDS = (
    AgentKind.CZONE_SIGN,
    AgentKind.BARRIER,
    AgentKind.TRAFFIC_CONE,
    AgentKind.GENERIC_OBJECT,
)  # in the order of the network's categories
SEEN_RADIUS = 120.0  # m, of static objects in the features
SCORED_RADIUS = 50.0  # m, of static objects that are collided with


class StaticObjects(NamedTuple):
    """Static objects on the drivable areas, in the map frame. S objects.

    Attributes:
        poses: (S, 3) centre x [m], y [m], heading [rad].
        sizes: (S, 2) length, width [m].
        categories: (S,) place of the kind in `STATIC_KINDS`.
        distances: (S,) to the centre of the ego [m].
    """

    poses: FloatArray
    sizes: FloatArray
    categories: IntArray
    distances: FloatArray


class World(NamedTuple):
    """Everything a candidate can hit.

    Attributes:
        boxes: (T, O, 4, 2) corners [m].
        centers: (T, O, 2) centres [m].
        speeds: (T, O) [m/s].
        radii: (O,) half diagonals [m].
        is_agent: (O,) whether an object is an agent.
        touched: (O,) whether it touches the ego now.
        lights: Connectors of the route whose light is red.
    """

    boxes: FloatArray
    centers: FloatArray
    speeds: FloatArray
    radii: FloatArray
    is_agent: BoolArray
    touched: BoolArray
    lights: IntArray


def static_objects(tracks: Tracks, drivable: Drivable, x: float, y: float) -> StaticObjects:
    """Static objects of the last row around the ego centre (x, y), by category."""
    kinds = tracks.kinds
    categories = np.full(len(kinds), -1)
    for category, kind in enumerate(STATIC_KINDS):
        categories[kinds == kind] = category
    poses, sizes = tracks.poses[-1], tracks.sizes[-1]
    here = np.flatnonzero(tracks.valid[-1] & (categories >= 0))
    distances = np.hypot(poses[here, 0] - x, poses[here, 1] - y)
    here, distances = here[distances <= SEEN_RADIUS], distances[distances <= SEEN_RADIUS]
    if len(here):
        corners = boxes_to_corners(poses[here], sizes[here])
        on_road = _touch_areas(drivable.areas.polygons, drivable.admitted, corners)
        here, distances = here[on_road], distances[on_road]
    order = np.argsort(categories[here], kind="stable")
    here = here[order]
    return StaticObjects(poses[here], sizes[here], categories[here], distances[order])


@kernel
def _touch_areas(polygons: Polygons, admitted: IntArray, corners: FloatArray) -> BoolArray:
    """(S,) whether a box (S, 4, 2) shares a point with an admitted area."""
    out = np.zeros(len(corners), np.bool_)
    for index in range(len(corners)):
        box = corners[index]
        for area in admitted:
            if bounds_meet(polygons.bounds[area], box) and meets_convex(polygons, area, box):
                out[index] = True
                break
    return out


@kernel
def bounds_meet(bounds: FloatArray, box: FloatArray) -> bool:
    """Whether the bounds of a polygon and of a box (4, 2) overlap."""
    return (
        max(box[0, 0], box[1, 0], box[2, 0], box[3, 0]) >= bounds[0]
        and max(box[0, 1], box[1, 1], box[2, 1], box[3, 1]) >= bounds[1]
        and min(box[0, 0], box[1, 0], box[2, 0], box[3, 0]) <= bounds[2]
        and min(box[0, 1], box[1, 1], box[2, 1], box[3, 1]) <= bounds[3]
    )


def red_lights(road: VectorMap, route: RouteLanes, observation: Observation) -> IntArray:
    """Connectors of the route whose light is red."""
    red = [name for name, s in observation.traffic_lights.items() if s == LightStatus.RED]
    edges = [road.edges.index[name] for name in red if name in road.edges.index]
    return np.array([edge for edge in edges if route.is_on[edge]], np.int64)


def make_world(
    static: StaticObjects,
    agents: tuple[FloatArray, FloatArray, FloatArray],
    lights: IntArray,
    footprint: FloatArray,
) -> World:
    """Put everything in its place.

    Args:
        static: Static objects.
        agents: Poses (A, 81, 3), speeds (A, 81) and sizes (A, 2) length, width of the agents.
        lights: Connectors whose light is red.
        footprint: (4, 2) corners of the ego now [m].
    """
    near = static.distances <= SCORED_RADIUS
    poses, speeds, sizes = agents
    num_static, count = int(near.sum()), int(near.sum()) + len(poses)
    world = World(
        np.empty((SCORED + 1, count, 4, 2)),
        np.empty((SCORED + 1, count, 2)),
        np.zeros((SCORED + 1, count)),
        np.empty(count),
        np.arange(count) >= num_static,
        np.zeros(count, np.bool_),
        lights,
    )
    _place(static.poses[near], static.sizes[near], poses, speeds, sizes, footprint, world)
    return world


@kernel
def _place(
    static_poses: FloatArray,
    static_sizes: FloatArray,
    poses: FloatArray,
    speeds: FloatArray,
    sizes: FloatArray,
    footprint: FloatArray,
    out: World,
) -> None:
    """Fill in the boxes of all times."""
    num_static = len(static_poses)
    for index in range(len(out.radii)):
        agent = index - num_static
        length, width = sizes[agent] if agent >= 0 else static_sizes[index]
        out.radii[index] = 0.5 * np.hypot(length, width)
        for step in range(len(out.boxes)):
            pose = poses[agent, step] if agent >= 0 else static_poses[index]
            out.centers[step, index, 0], out.centers[step, index, 1] = pose[0], pose[1]
            box_corners(pose[0], pose[1], pose[2], length, width, out.boxes[step, index])
            if agent >= 0:
                out.speeds[step, index] = speeds[agent, step]
        out.touched[index] = convex_intersect(out.boxes[0, index], footprint)
