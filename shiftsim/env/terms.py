"""What a reward is made of: how the step that has just been driven was.

The terms are those of CaRL. One call of a kernel per step looks at map, tracks and comfort; what it
remembers of the episode is in `Course`.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import STOPPED_SPEED, box_corners
from shiftsim.geometry.fits import filter_signal
from shiftsim.geometry.polylines import project_on_polyline
from shiftsim.geometry.rings import point_segment_distance
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics.collision import BOX_SIZE, collide, flat_tracks, set_box
from shiftsim.metrics.comfort import BOUNDED_SIGNALS, MIN_SAMPLES, Filters, bounds_of
from shiftsim.metrics.result import NUPLAN
from shiftsim.planners.routes.graph import deviation
from shiftsim.sim.log import SimulationLog
from shiftsim.world.layers import Polygons, Polylines, containing
from shiftsim.world.map import VectorMap
from shiftsim.world.state import (
    AX,
    AY,
    HEADING,
    LAST_AGENT_KIND,
    PACIFICA,
    VX,
    VY,
    YAW_ACCEL,
    YAW_RATE,
    center_poses,
)

FREE_OFFSET = 0.5  # m from the centre line that costs nothing
MAX_OVERSPEED = NUPLAN.max_overspeed  # m/s, at which the whole term is lost
TTC_STEP, TTC_TESTS = 0.2, 4  # s; a horizon of 1 s, which itself is not tested
TTC_STOPPED_SPEED = 5e-3  # m/s
NUM_CHECKS = len(BOUNDED_SIGNALS)
_RC, _LANE, _SPEED, _ON_ROUTE, _COMFORT, _TTC, _OFF_ROAD, _COLLISION, _DONE = range(9)
_LAST_AGENT = int(LAST_AGENT_KIND)
_LENGTH, _WIDTH, _TO_CENTER = PACIFICA.length, PACIFICA.width, PACIFICA.rear_axle_to_center


class Terms(NamedTuple):
    """How one step was; all but the first and the last three are factors in [0, 1]."""

    progress: float  # share of the recorded path that was gained, in [0, 1]
    lane: float  # 1 within 0.5 m of the centre line, down to 0.5
    speed: float  # 1 up to the speed limit, 0 from 2.23 m/s above it on
    on_route: float  # 0 off the lanes of the route while the recording is on them
    comfort: float  # share of nuPlan's six checks that hold over the episode so far
    ttc: float  # 0.5 from the first step on at which a contact was less than a second ahead
    off_road: bool  # a corner of the ego is off roadblocks, intersections and car parks
    collision: bool  # the ego moves and touches a track that it did not touch before
    completion: float  # share of the recorded path that lies behind the ego

    @property
    def infraction(self) -> str:
        """`off_road`, `collision`, or empty."""
        return "off_road" if self.off_road else "collision" if self.collision else ""


class Course(NamedTuple):
    """One episode as the kernels see it. K samples, N tracks, T iterations."""

    edges: Polygons
    baselines: Polylines
    left: Polylines
    right: Polylines
    limits: FloatArray  # (E,) [m/s], NaN where the map has none
    num_lanes: int
    edge_on_route: BoolArray  # (E,)
    blocks: Polygons
    num_roadblocks: int
    intersections: Polygons
    car_parks: Polygons
    expert: FloatArray  # (T, 2) recorded centres [m]
    expert_arc: FloatArray  # (T,) arc length at each of them [m]
    expert_on_route: BoolArray  # (T,) whether a lane of the route holds it
    ego: FloatArray  # (K, 11) states, as far as driven
    valid: BoolArray  # (K, N)
    poses: FloatArray  # (K, N, 3)
    velocities: FloatArray  # (K, N, 2)
    sizes: FloatArray  # (K, N, 2)
    kinds: IntArray  # (N,) AgentKind codes
    bounds: FloatArray  # (6, 2) of the comfort checks, strict
    touched: BoolArray  # (N,) written: the ego has touched the track
    signals: FloatArray  # (10, K) written: raw signals, and scratch
    found: IntArray  # (16,) scratch: edges that hold a point
    boxes: FloatArray  # (2, 9) scratch
    corners: FloatArray  # (2, 4, 2) scratch
    out: FloatArray  # (9,) written: the `Terms`


def make_course(log: SimulationLog, road: VectorMap) -> Course:
    """The course of a rollout; the arrays of `log` are filled while it goes on."""
    blocks = [road.blocks.index[name] for name in log.route if name in road.blocks.index]
    on_route = np.zeros(len(road.blocks) + 1, np.bool_)  # the last one is of edges without block
    on_route[blocks] = True
    expert = np.ascontiguousarray(center_poses(log.expert_ego[:, :3])[:, :2])
    steps = np.hypot(*np.diff(expert, axis=0).T)
    tracks = flat_tracks(log.tracks)
    count, capacity = len(log.ego), int(np.diff(road.edges.polygons.cell_ptr).max(initial=1))
    course = Course(
        edges=road.edges.polygons,
        baselines=road.baselines,
        left=road.left_boundaries,
        right=road.right_boundaries,
        limits=road.speed_limits,
        num_lanes=road.num_lanes,
        edge_on_route=on_route[road.block_of],
        blocks=road.blocks.polygons,
        num_roadblocks=road.num_roadblocks,
        intersections=road.intersections.polygons,
        car_parks=road.car_parks.polygons,
        expert=expert,
        expert_arc=np.concatenate([[0.0], np.cumsum(steps)]),
        expert_on_route=np.zeros(len(expert), np.bool_),
        ego=log.ego,
        valid=tracks.valid,
        poses=tracks.poses,
        velocities=tracks.velocities,
        sizes=tracks.sizes,
        kinds=log.tracks.kinds.copy(),
        bounds=np.array(bounds_of(NUPLAN)),
        touched=np.zeros(len(tracks.is_static), np.bool_),
        signals=np.zeros((10, count)),
        found=np.zeros(capacity, np.int64),
        boxes=np.zeros((2, BOX_SIZE)),
        corners=np.zeros((2, 4, 2)),
        out=np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
    )
    _begin(course)
    return course


def terms_of(course: Course) -> Terms:
    """The terms that `look_back` has written."""
    return make_terms(course.out.tolist())


def make_terms(out: list[float]) -> Terms:
    """Terms of nine numbers."""
    return Terms._make([*out[:_OFF_ROAD], out[_OFF_ROAD] > 0.0, out[_COLLISION] > 0.0, out[_DONE]])


@kernel
def _begin(course: Course) -> None:
    """Note where the recording is on the route, and what the ego touches before it moves."""
    for index in range(len(course.expert)):
        x, y = course.expert[index, 0], course.expert[index, 1]
        course.expert_on_route[index] = _is_on_route(course, x, y)
    _find_contacts(course, 0)
    _note_signals(course, 0)
    x, y = course.expert[0, 0], course.expert[0, 1]
    _measure_progress(course, x, y)
    course.out[_RC] = 0.0


@kernel
def look_back(course: Course, row: int, filters: Filters, step: float, square: float) -> None:
    """Write the terms of the step that led to a row into `course.out`.

    `filters` are of row + 1 samples, `step` is the mean time between these [s], and `square` its
    square [s^2].
    """
    state, out = course.ego[row], course.out
    x = state[0] + _TO_CENTER * np.cos(state[HEADING])
    y = state[1] + _TO_CENTER * np.sin(state[HEADING])
    speed = np.hypot(state[VX], state[VY])
    _measure_progress(course, x, y)
    box_corners(x, y, state[HEADING], _LENGTH, _WIDTH, course.corners[0])
    out[_OFF_ROAD] = 0.0
    for corner in range(4):
        if not _is_on_road(course, course.corners[0, corner, 0], course.corners[0, corner, 1]):
            out[_OFF_ROAD] = 1.0
    out[_ON_ROUTE] = 1.0
    if course.expert_on_route[row] and not _is_on_route(course, x, y):
        out[_ON_ROUTE] = 0.0
    lane = _current_lane(course, x, y, state[HEADING])
    out[_LANE], out[_SPEED] = 1.0, 1.0
    if lane >= 0:
        out[_LANE] = _lane_term(course, lane, x, y)
        # nuPlan rule 364: on connectors their own limit
        if speed > course.limits[lane]:  # not where it is NaN
            out[_SPEED] = max(0.0, 1.0 - (speed - course.limits[lane]) / MAX_OVERSPEED)
    out[_COLLISION] = _find_contacts(course, row) and speed >= STOPPED_SPEED
    if out[_TTC] == 1.0 and speed > TTC_STOPPED_SPEED and _is_contact_ahead(course, row, speed):
        out[_TTC] = 0.5
    _note_signals(course, row)
    if row + 1 >= MIN_SAMPLES:
        out[_COMFORT] = count_comfortable(course, row + 1, filters, step, square) / NUM_CHECKS


@kernel
def _measure_progress(course: Course, x: float, y: float) -> None:
    arc, out = course.expert_arc, course.out
    length, share = arc[-1], 0.0
    if length > 0.0:
        share = project_on_polyline(course.expert, arc, 0, len(arc), x, y) / length
    out[_RC] = max(0.0, share - out[_DONE])
    out[_DONE] = max(share, out[_DONE])


@kernel
def _is_on_road(course: Course, x: float, y: float) -> bool:
    # nuPlan rule 365: other drivable areas of the map do not count
    found = containing(course.blocks, x, y, course.found[:1])  # roadblocks come first
    if found > 0 and course.found[0] < course.num_roadblocks:
        return True
    if containing(course.intersections, x, y, course.found[:0]) > 0:
        return True
    return containing(course.car_parks, x, y, course.found[:0]) > 0


@kernel
def _is_on_route(course: Course, x: float, y: float) -> bool:
    for index in range(containing(course.edges, x, y, course.found)):
        if course.edge_on_route[course.found[index]]:
            return True
    return False


@kernel
def _current_lane(course: Course, x: float, y: float, heading: float) -> int:
    """The lane or connector that holds a point: on the route, and along the heading; else -1."""
    best, lane = np.inf, -1
    for index in range(containing(course.edges, x, y, course.found)):
        edge = course.found[index]
        error = deviation(course.baselines, edge, 1, x, y, heading)[1]
        error += 0.0 if course.edge_on_route[edge] else 2.0 * np.pi
        if error < best:
            best, lane = error, edge
    return lane


@kernel
def _lane_term(course: Course, lane: int, x: float, y: float) -> float:
    left = _line_distance(course.left, lane, x, y)
    right = _line_distance(course.right, lane, x, y)
    if lane >= course.num_lanes or min(left, right) == np.inf:
        return 1.0
    center = _line_distance(course.baselines, lane, x, y)
    room = center + min(left, right) - FREE_OFFSET + 1e-6
    return 1.0 - 0.5 * min(max((center - FREE_OFFSET) / room, 0.0), 1.0)


@kernel
def _line_distance(lines: Polylines, line: int, x: float, y: float) -> float:
    """Distance of a point from a line, inf where the line is missing [m]."""
    best, xy = np.inf, lines.xy
    for index in range(lines.ptr[line], lines.ptr[line + 1] - 1):
        ax, ay, bx, by = xy[index, 0], xy[index, 1], xy[index + 1, 0], xy[index + 1, 1]
        best = min(best, point_segment_distance(x, y, ax, ay, bx, by))
    return best


@kernel
def _set_ego(course: Course, row: int) -> None:
    state, box = course.ego[row], course.boxes[0]
    set_box(box, state, _LENGTH, _WIDTH)
    box[0] = state[0] + _TO_CENTER * box[2]
    box[1] = state[1] + _TO_CENTER * box[3]


@kernel
def _find_contacts(course: Course, row: int) -> bool:
    """Whether the ego touches tracks that it did not touch before; they are noted."""
    _set_ego(course, row)
    ego, other, is_hit = course.boxes[0], course.boxes[1], False
    for track in range(len(course.touched)):
        if course.touched[track] or not course.valid[row, track]:
            continue
        pose, size = course.poses[row, track], course.sizes[row, track]
        dx, dy = pose[0] - ego[0], pose[1] - ego[1]
        reach = ego[7] + 0.5 * (size[0] + size[1])
        if dx * dx + dy * dy > reach * reach:
            continue
        set_box(other, pose, size[0], size[1])
        if collide(ego, other, course.corners):
            course.touched[track] = is_hit = True
    return is_hit


@kernel
def _is_contact_ahead(course: Course, row: int, speed: float) -> bool:
    """Whether the ego meets a track within the horizon when everybody goes straight on."""
    ego, other = course.boxes[0], course.boxes[1]
    for track in range(len(course.touched)):
        # nuPlan rule 363: also those behind and beside the ego
        if course.touched[track] or not course.valid[row, track]:
            continue
        pose, size = course.poses[row, track], course.sizes[row, track]
        velocity, other_speed = course.velocities[row, track], 0.0
        if course.kinds[track] <= _LAST_AGENT:
            other_speed = np.hypot(velocity[0], velocity[1])
        _set_ego(course, row)
        dx, dy = pose[0] - ego[0], pose[1] - ego[1]
        reach = ego[7] + 0.5 * (size[0] + size[1]) + TTC_STEP * TTC_TESTS * (speed + other_speed)
        if dx * dx + dy * dy > reach * reach:
            continue
        set_box(other, pose, size[0], size[1])
        for _ in range(TTC_TESTS):
            ego[0] += ego[2] * speed * TTC_STEP
            ego[1] += ego[3] * speed * TTC_STEP
            other[0] += other[2] * other_speed * TTC_STEP
            other[1] += other[3] * other_speed * TTC_STEP
            if collide(ego, other, course.corners):
                return True
    return False


@kernel
def _note_signals(course: Course, row: int) -> None:
    """Write what the comfort checks filter: accelerations and the unwrapped heading."""
    state, signals = course.ego[row], course.signals
    rate, accel = state[YAW_RATE], state[YAW_ACCEL]
    signals[0, row] = state[AX] + (_TO_CENTER * (rate * rate) + _TO_CENTER * accel)
    signals[1, row] = state[AY]
    signals[2, row] = np.sqrt(state[AX] * state[AX] + state[AY] * state[AY])
    turns = 0.0
    if row > 0:
        before = course.ego[row - 1, HEADING]
        turns = signals[4, row - 1] + np.rint((state[HEADING] - before) / (2.0 * np.pi))
    signals[4, row] = turns
    signals[3, row] = state[HEADING] - 2.0 * np.pi * turns


@kernel
def count_comfortable(
    course: Course, count: int, filters: Filters, step: float, square: float
) -> int:
    """How many of nuPlan's comfort checks hold over the first `count` samples."""
    raw, smooth = course.signals[:5, :count], course.signals[5:8, :count]
    for index in range(3):
        filter_signal(raw[index], filters.smooth, 1.0, smooth[index])
    derived, held = course.signals[8, :count], 0
    filter_signal(smooth[2], filters.jerk, step, derived)
    held += _holds(derived, course.bounds[0])
    held += _holds(smooth[1], course.bounds[1])
    held += _holds(smooth[0], course.bounds[2])
    filter_signal(smooth[0], filters.jerk, step, derived)
    held += _holds(derived, course.bounds[3])
    filter_signal(raw[3], filters.yaw_accel, square, derived)
    held += _holds(derived, course.bounds[4])
    filter_signal(raw[3], filters.yaw_rate, step, derived)
    held += _holds(derived, course.bounds[5])
    return held


@kernel
def _holds(values: FloatArray, bounds: FloatArray) -> bool:
    for value in values:
        if not bounds[0] < value < bounds[1]:
            return False
    return True
