"""One line along the lanes of a route: Frenet coordinates, and who or what is ahead on it.

Frenet coordinates are (s, d, heading): arc length, offset to the left, and heading as seen from the
line. Headings turn evenly between its vertices, so that poses come back from there as they were.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from shiftsim.errors import MapError
from shiftsim.geometry.boxes import boxes_to_corners, wrap_angle, wrap_angles
from shiftsim.geometry.polylines import arc_lengths, write_frenet
from shiftsim.kernels import FloatArray, IntArray, readonly
from shiftsim.world.lanes import poses_on_edge
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import Tracks, TrafficLights, VehicleParameters, center_poses

SPACING = 1.0  # m, between the vertices of a line
BEYOND = 200.0  # m that a line goes on where its route ends
CHANGE = 40.0  # m over which it moves to another lane
MAX_CHANGE = 10.0  # m; what is farther away is no neighbour, but beyond a gap
NEAR = 5.0  # m, from the nearest of the lanes that a vehicle may be in
TURNED = 5.0  # m to the side that a heading error of 1 rad counts as
PASSED = 1.0  # m that the front bumper may be beyond a stop that still holds
PARTS = 8  # pieces of a side of a box, each straight as seen from the line
Ways = list[dict[int, tuple[float, int]]]  # of `find_ways`


class Lead(NamedTuple):
    """The nearest box in the way."""

    gap: float  # from the front bumper along the line, 0 where the box is beside us [m]
    speed: float  # along the line, negative where it comes towards us [m/s]
    token: str  # of the track


class RedLight(NamedTuple):
    """The next stop at a red light."""

    gap: float  # from the front bumper to where the connector begins, down to -1 [m]
    connector: str  # id of the connector


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A centre line, with vertices about 1 m apart. K vertices, L lanes and connectors.

    Attributes:
        poses: (K, 3) x [m], y [m], heading [rad].
        arc: (K,) arc length at each vertex [m].
        speed_limits: (K,) [m/s], NaN where the map has none.
        widths: (K,) width of the lane, its area over its length [m].
        lanes: (L,) the lanes and connectors it follows, as edges of the map.
        lane_ids: Their ids.
        starts: (L,) arc length at which each of them begins [m].
        successors: For each of them, the ids of those that it leads to.
        route_end: Arc length at which the route ends [m]; the line goes on straight ahead.
        vehicle: Dimensions of the ego.
        curvature: (K,) positive to the left [1/m].
        ahead: (K, 2) unit vectors along the headings.
    """

    poses: FloatArray
    arc: FloatArray
    speed_limits: FloatArray
    widths: FloatArray
    lanes: IntArray
    lane_ids: tuple[str, ...]
    starts: FloatArray
    successors: tuple[tuple[str, ...], ...]
    route_end: float
    vehicle: VehicleParameters
    curvature: FloatArray = field(init=False)
    ahead: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        headings = self.poses[:, 2]
        object.__setattr__(self, "curvature", np.gradient(np.unwrap(headings), self.arc))
        object.__setattr__(self, "ahead", np.stack([np.cos(headings), np.sin(headings)], axis=1))
        for item in fields(self):
            if isinstance(value := getattr(self, item.name), np.ndarray):
                object.__setattr__(self, item.name, readonly(value))

    def __repr__(self) -> str:
        return f"<Line: {self.arc[-1]:.0f} m along {len(self.lanes)} lanes and connectors>"

    def to_frenet(self, poses: ArrayLike) -> FloatArray:
        """Frenet coordinates (..., 3) of poses (..., 3), or (..., 2) of points (..., 2).

        Beyond its ends the line counts as straight.
        """
        given = _rows(poses)
        flat = np.array(given.reshape(-1, given.shape[-1])[:, :2])
        found = np.empty((len(flat), 3))
        write_frenet(self.poses, self.ahead, self.arc, flat, found)
        found = found.reshape(*given.shape[:-1], 3)
        if given.shape[-1] == 2:
            return found[..., :2]
        found[..., 2] = wrap_angles(given[..., 2] - found[..., 2])
        return found

    def to_poses(self, frenet: ArrayLike) -> FloatArray:
        """Poses (..., 3) at Frenet coordinates (..., 3); along the line where given (..., 2)."""
        given, arc = _rows(frenet), self.arc
        at = np.clip(np.searchsorted(arc, given[..., 0], side="right") - 1, 0, len(arc) - 2)
        step = arc[at + 1] - arc[at]
        share = np.clip((given[..., 0] - arc[at]) / step, 0.0, 1.0)
        blend = share[..., None]
        ahead = (1.0 - blend) * self.ahead[at] + blend * self.ahead[at + 1]
        heading = np.arctan2(ahead[..., 1], ahead[..., 0])
        cos, sin, left = np.cos(heading), np.sin(heading), given[..., 1]
        beyond = given[..., 0] - arc[at] - share * step
        xy = self.poses[at, :2] + blend * (self.poses[at + 1, :2] - self.poses[at, :2])
        turn = given[..., 2] if given.shape[-1] == 3 else 0.0
        x, y = beyond * cos - left * sin, beyond * sin + left * cos
        return np.stack([xy[..., 0] + x, xy[..., 1] + y, wrap_angles(heading + turn)], axis=-1)

    def front(self, pose: FloatArray) -> float:
        """Arc length of the front bumper of the ego whose rear axle is at a pose (3,) [m]."""
        ahead = self.vehicle.front_length * np.array([np.cos(pose[2]), np.sin(pose[2])])
        return float(self.to_frenet(pose[:2] + ahead)[0])


def _rows(values: ArrayLike) -> FloatArray:
    given = np.asarray(values, np.float64)
    if given.ndim == 0 or given.shape[-1] not in (2, 3):
        raise ValueError(f"need rows of 2 or 3 numbers, got an array of shape {given.shape}")
    return given


def find_lead(line: Line, pose: FloatArray, tracks: Tracks) -> Lead | None:
    """The box nearest to the front bumper in the corridor of our width along the line, if any.

    It reaches farther than the middle of our own box. `pose` (3,) is that of the rear axle, and the
    last row of the tracks is the present.
    """
    half, middle = 0.5 * line.vehicle.width, line.to_frenet(center_poses(pose)[:2])[0]
    seen = np.flatnonzero(tracks.valid[-1])
    poses, sizes = tracks.poses[-1, seen], tracks.sizes[-1, seen]
    reach = 0.5 * np.hypot(sizes[:, 0], sizes[:, 1])
    near = line.to_frenet(poses)
    chosen = (np.abs(near[:, 1]) <= half + reach) & (near[:, 0] + reach > middle)
    seen, near = seen[chosen], near[chosen]
    if not len(seen):
        return None
    nearest = _enter(line, boxes_to_corners(poses[chosen], sizes[chosen]), half, middle)
    first = int(np.argmin(nearest))
    if nearest[first] == np.inf:
        return None
    track = seen[first]
    heading = tracks.poses[-1, track, 2] - near[first, 2]
    velocity = np.nan_to_num(tracks.velocities[-1, track])
    speed = velocity[0] * np.cos(heading) + velocity[1] * np.sin(heading)
    gap = max(float(nearest[first]) - line.front(pose), 0.0)
    return Lead(gap, float(speed), tracks.tokens[track])


def _enter(line: Line, corners: FloatArray, half: float, start: float) -> FloatArray:
    """(N,) least arc length beyond `start` within `half` of the line, of boxes (N, 4, 2); or inf.

    Their sides are cut into pieces, and those at the borders of the corridor.
    """
    sides = np.roll(corners, -1, axis=1) - corners
    shares = np.arange(PARTS)[:, None] / PARTS
    rim = (corners[:, :, None] + shares * sides[:, :, None]).reshape(len(corners), -1, 2)
    s, d = np.moveaxis(line.to_frenet(rim), -1, 0)
    along, across = np.roll(s, -1, axis=1) - s, np.roll(d, -1, axis=1) - d
    across[across == 0.0] = 1e-9
    cuts = np.sort([(-half - d) / across, (half - d) / across], axis=0).clip(0.0, 1.0)
    inside = (cuts[0] < cuts[1]) | (np.abs(d) <= half)
    inside &= np.abs(along) < MAX_CHANGE  # else its ends are beside different parts of the line
    ends = np.sort(s + cuts * along, axis=0)
    return np.where(inside & (ends[1] > start), np.maximum(ends[0], start), np.inf).min(axis=1)


def next_red(line: Line, pose: FloatArray, lights: TrafficLights) -> RedLight | None:
    """The next connector on the line with a red light, which the front bumper has not passed."""
    front, red = line.front(pose), set(lights.red(-1))
    for name, start in zip(line.lane_ids, line.starts.tolist(), strict=True):
        if name in red and start > front - PASSED:
            return RedLight(start - front, name)
    return None


def route_line(
    road: VectorMap, blocks: Sequence[int], pose: FloatArray | None, vehicle: VehicleParameters
) -> Line:
    """The line along the blocks of a route, from the lane of the rear axle at `pose` (3,) on.

    Where that lane does not lead on, the line moves to one that does; without a pose it begins in
    the lane of the first block from where it need not. Without a route it goes straight on.

    Raises:
        MapError: There is no lane to begin in.
    """
    ways = find_ways(road, blocks)
    lanes = [lane for level in ways for lane in level] or list(range(len(road.edges)))
    if not lanes or (pose is None and not ways):
        what = f"map {road.name!r} has no lane for the line to begin in"
        raise MapError(what, "give the pose of the ego where the scenario has no route")
    progress = 0.0
    if pose is None:
        chain = [min(ways[0], key=lambda lane: ways[0][lane])]
    else:
        costs = {lane: cost for level in ways for lane, (cost, _) in level.items()}
        lane, progress = _lane_under(road, lanes, costs, center_poses(pose, vehicle))
        chain = [lane]
    for level in ways:
        if chain[-1] in level and level[chain[-1]][1] != NONE:
            chain.append(level[chain[-1]][1])
    return _make_line(road, chain, progress, vehicle)


def find_ways(road: VectorMap, blocks: Sequence[int]) -> Ways:
    """What it takes to follow a route from every lane of its blocks, of those that have any.

    By lane: how far a line moves to the side on its way from there on [m], and the lane that comes
    next, or NONE.
    """
    ways: Ways = []
    for block in reversed(blocks):
        lanes = road.block_edges.at(block).tolist()
        if not ways:
            level = dict.fromkeys(lanes, (0.0, NONE))
        else:
            # a late move costs a little more than an early one
            costs = {after: 1.01 * cost for after, (cost, _) in ways[0].items()}
            level = {
                lane: min((_jump(road, lane, after) + cost, after) for after, cost in costs.items())
                for lane in lanes
            }
        ways = [level, *ways] if level else ways
    return ways


def _jump(road: VectorMap, lane: int, after: int) -> float:
    """Distance between the end of a lane and the start of another; turns break ties [m]."""
    away = road.baselines.at(after)[0] - road.baselines.at(lane)[-1]
    distance = 0.0 if after in road.outgoing.at(lane) else float(np.hypot(*away))
    return distance + 1e-3 * _turn(road, lane, after)


def _turn(road: VectorMap, lane: int, after: int) -> float:
    """How far a vehicle turns on a lane that comes after another one [rad]."""
    end, way = road.baselines.at(lane)[-2:], road.baselines.at(after)[[0, -1]]
    (x, y), (to_x, to_y) = end[1] - end[0], way[1] - way[0]
    return abs(float(wrap_angle(np.arctan2(to_y, to_x) - np.arctan2(y, x))))


def _lane_under(
    road: VectorMap, lanes: list[int], costs: dict[int, float], center: FloatArray
) -> tuple[int, float]:
    """The lane that fits a pose (3,) best, and the arc length of the pose on it [m]."""
    x, y, heading = center.tolist()
    bounds = road.edges.polygons.bounds[lanes]
    apart = np.maximum(bounds[:, :2] - center[:2], center[:2] - bounds[:, 2:]).clip(0.0)
    away = np.hypot(apart[:, 0], apart[:, 1])
    best = (np.inf, NONE, 0.0)
    for place in np.flatnonzero(away <= away.min() + NEAR).tolist():
        lane = lanes[place]
        progress = road.progress_on(lane, x, y)
        at = poses_on_edge(road, lane, np.array([progress]))[0]
        fit = float(np.hypot(at[0] - x, at[1] - y) + TURNED * abs(wrap_angle(at[2] - heading)))
        best = min(best, (fit + 0.1 * costs.get(lane, 0.0), lane, progress))
    return best[1:]


def _make_line(
    road: VectorMap, chain: list[int], progress: float, vehicle: VehicleParameters
) -> Line:
    """The line along lanes, and on from there; `progress` [m] on the first lane is the ego's."""
    lanes = _with_those_beyond(road, chain)
    firsts = np.cumsum([0, *(len(road.baselines.at(lane)) for lane in lanes)])
    xy = _joined(road, lanes, firsts, progress)
    arc = arc_lengths(xy, np.array([0, len(xy)]))
    even = np.linspace(0.0, arc[-1], max(int(np.ceil(arc[-1] / SPACING)), 1) + 1)
    points = np.stack([np.interp(even, arc, xy[:, axis]) for axis in (0, 1)], axis=1)
    slope, length = np.gradient(points, axis=0), arc_lengths(points, np.array([0, len(points)]))
    place = np.searchsorted(arc[firsts[:-1]], even, side="right") - 1
    edges, ids = np.array(lanes), road.edges.ids
    widths = [road.edges.shape(lane).area / road.baselines.length(lane) for lane in lanes]
    return Line(
        poses=np.column_stack([points, np.arctan2(slope[:, 1], slope[:, 0])]),
        arc=length,
        speed_limits=road.speed_limits[edges[place]],
        widths=np.array(widths)[place],
        lanes=edges,
        lane_ids=tuple(ids[lane] for lane in lanes),
        starts=np.interp(arc[firsts[:-1]], even, length),
        successors=tuple(tuple(ids[e] for e in road.outgoing.at(lane)) for lane in lanes),
        route_end=float(np.interp(arc[firsts[len(chain)] - 1], even, length)),
        vehicle=vehicle,
    )


def _with_those_beyond(road: VectorMap, chain: list[int]) -> list[int]:
    """Lanes, and those that lead on from the last one, as straight as they can."""
    lanes, beyond = list(chain), 0.0
    while beyond < BEYOND:
        ahead = [lane for lane in road.outgoing.at(lanes[-1]).tolist() if lane not in lanes]
        if not ahead:
            break
        lanes.append(min(ahead, key=lambda lane: _turn(road, lanes[-1], lane)))
        beyond += road.baselines.length(lanes[-1])
    return lanes


def _joined(road: VectorMap, lanes: list[int], firsts: IntArray, progress: float) -> FloatArray:
    """(V, 2) vertices of the baselines of lanes, moved where one does not lead to the next.

    `firsts` (L + 1,) are the first vertices of each. No move begins before `progress` [m].
    """
    xy = np.concatenate([road.baselines.at(lane) for lane in lanes])
    starts = np.cumsum([0.0, *(road.baselines.length(lane) for lane in lanes)])
    along = arc_lengths(xy, firsts) + np.repeat(starts[:-1], np.diff(firsts))
    moved = xy.copy()
    for place, (lane, after) in enumerate(pairwise(lanes), 1):
        jump = xy[firsts[place]] - xy[firsts[place] - 1]
        if after in road.outgoing.at(lane) or np.hypot(*jump) >= MAX_CHANGE:
            continue
        begin = max(progress, starts[place] - 0.5 * CHANGE)
        share = np.clip((along - begin) / CHANGE, 0.0, 1.0)
        weight = share * share * (3.0 - 2.0 * share)
        weight[firsts[place] :] -= 1.0
        moved += weight[:, None] * jump
    return moved
