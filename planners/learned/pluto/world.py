"""What PLUTO's proposals can collide with: static objects, predicted agents, red lights."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import box_corners, boxes_to_corners
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.learned.pluto.reference import Drivable, RouteLanes
from shiftsim.planners.proposals.contacts import Obstacles, touches_boxes
from shiftsim.planners.proposals.tracker import SCORED
from shiftsim.planners.routes.lead import red_lanes
from shiftsim.sim.planner import Observation
from shiftsim.world.layers import meeting
from shiftsim.world.map import VectorMap
from shiftsim.world.state import AgentKind, Tracks

STATIC_KINDS = (
    AgentKind.CZONE_SIGN,
    AgentKind.BARRIER,
    AgentKind.TRAFFIC_CONE,
    AgentKind.GENERIC_OBJECT,
)  # in the order of the network's categories
_CATEGORY = np.array([STATIC_KINDS.index(k) if k in STATIC_KINDS else -1 for k in AgentKind])
SEEN_RADIUS = 120.0  # m, of static objects in the features
SCORED_RADIUS = 50.0  # m, of static objects that are collided with


class StaticObjects(NamedTuple):
    """Static objects on the drivable areas, in the map frame. S objects."""

    poses: FloatArray  # (S, 3) centre x [m], y [m], heading [rad]
    sizes: FloatArray  # (S, 2) length, width [m]
    categories: IntArray  # (S,) place of the kind in `STATIC_KINDS`
    distances: FloatArray  # (S,) to the centre of the ego [m]


class Agents(NamedTuple):
    """Where the agents are now and will be, in the map frame. A agents."""

    poses: FloatArray  # (A, 81, 3) centre x [m], y [m], heading [rad], every 0.1 s from now on
    speeds: FloatArray  # (A, 81) [m/s]
    sizes: FloatArray  # (A, 2) length, width [m]


class World(NamedTuple):
    """Everything a proposal can hit."""

    # static objects, then agents, at 0, 0.1, … 4 s; what touches the ego now is ignored
    obstacles: Obstacles
    lights: IntArray  # connectors of the route whose light is red


def static_objects(tracks: Tracks, drivable: Drivable, x: float, y: float) -> StaticObjects:
    """Static objects of the last row around the ego centre (x, y), by category."""
    categories = _CATEGORY[tracks.kinds]
    poses, sizes = tracks.poses[-1], tracks.sizes[-1]
    here = np.flatnonzero(tracks.valid[-1] & (categories >= 0))
    distances = np.hypot(poses[here, 0] - x, poses[here, 1] - y)
    here, distances = here[distances <= SEEN_RADIUS], distances[distances <= SEEN_RADIUS]
    if len(here):
        areas = drivable.areas.polygons
        is_near = np.zeros(len(areas.bounds), np.bool_)
        is_near[drivable.selected] = True
        corners = boxes_to_corners(poses[here], sizes[here])
        on_road = [is_near[meeting(areas, box)].any() for box in corners]
        here, distances = here[on_road], distances[on_road]
    order = np.argsort(categories[here], kind="stable")
    here = here[order]
    return StaticObjects(poses[here], sizes[here], categories[here], distances[order])


def red_lights(road: VectorMap, route: RouteLanes, observation: Observation) -> IntArray:
    """Connectors of the route whose light is red."""
    red = red_lanes(road, observation.lights)
    return np.array([lane for lane in red if route.is_on[lane]], np.int64)


def make_world(
    static: StaticObjects, agents: Agents, lights: IntArray, footprint: FloatArray
) -> World:
    """Everything in its place; `footprint` (4, 2) has the corners of the ego now [m]."""
    near, rows = static.distances <= SCORED_RADIUS, SCORED + 1
    standing, count = static.poses[near], int(near.sum())
    still = np.zeros((rows, count))
    poses = np.concatenate(
        [np.broadcast_to(standing, (rows, count, 3)), agents.poses[:, :rows].swapaxes(0, 1)], axis=1
    )
    sizes = np.concatenate([static.sizes[near], agents.sizes])
    centers = np.ascontiguousarray(poses[..., :2])
    boxes = np.empty((*poses.shape[:2], 4, 2))
    _place(poses, sizes, boxes)
    obstacles = Obstacles(
        boxes=boxes,
        centers=centers,
        centroids=centers,
        speeds=np.concatenate([still, agents.speeds[:, :rows].T], axis=1),
        radii=0.5 * np.hypot(sizes[:, 0], sizes[:, 1]),
        is_agent=np.arange(len(sizes)) >= count,
        ignored=touches_boxes(footprint, boxes[0]),
    )
    return World(obstacles, lights)


@kernel
def _place(poses: FloatArray, sizes: FloatArray, boxes: FloatArray) -> None:
    """Write the corners (T, O, 4, 2) of boxes with poses (T, O, 3) and sizes (O, 2)."""
    for step in range(len(boxes)):
        for index in range(len(sizes)):
            x, y, heading = poses[step, index, 0], poses[step, index, 1], poses[step, index, 2]
            box_corners(x, y, heading, sizes[index, 0], sizes[index, 1], boxes[step, index])
