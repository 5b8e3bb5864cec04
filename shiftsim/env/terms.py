"""The terms that rewards are computed from: how the last step was driven, as CaRL rates it.

One kernel call per step reads map and tracks; `EpisodeState` holds what it remembers.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import STOPPED_SPEED, box_corners
from shiftsim.geometry.polylines import project_on_polyline
from shiftsim.geometry.rings import point_segment_distance
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.metrics.collision import BOX_SIZE, FlatTracks, collide, flat_tracks, set_box
from shiftsim.metrics.comfort import MIN_SAMPLES, comfort_signals, within_bounds
from shiftsim.metrics.result import NUPLAN
from shiftsim.planners.routes.graph import deviation
from shiftsim.sim.log import SimulationLog
from shiftsim.world.layers import Polygons, Polylines, containing
from shiftsim.world.map import VectorMap
from shiftsim.world.state import HEADING, PACIFICA, VX, VY, center_poses

FREE_OFFSET = 0.5  # m from the centre line that costs nothing
MAX_OVERSPEED = NUPLAN.max_overspeed  # m/s, at which the whole term is lost
TTC_STEP, TTC_TESTS = 0.2, 4  # s; a horizon of 1 s, which itself is not tested
TTC_STOPPED_SPEED = 5e-3  # m/s
_PROGRESS, _LANE, _SPEED, _ON_ROUTE, _COMFORT, _TTC, _OFF_ROAD, _COLLISION, _DONE = range(9)
_START = (0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)  # the terms before the first step
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


class EpisodeState(NamedTuple):
    """One episode as the kernels read it. K samples, N tracks, T iterations."""

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
    ego: FloatArray  # (K, 11) states, as far as driven
    tracks: FlatTracks
    touched: BoolArray  # (N,) written: the ego has touched the track
    found: IntArray  # (16,) scratch: edges that hold a point
    boxes: FloatArray  # (2, 9) scratch
    corners: FloatArray  # (2, 4, 2) scratch
    out: FloatArray  # (9,) written: the `Terms`


def make_state(log: SimulationLog, road: VectorMap) -> EpisodeState:
    """State at the start of a rollout; the arrays of `log` are filled while it is driven."""
    blocks = [road.blocks.index[name] for name in log.route if name in road.blocks.index]
    expert = np.ascontiguousarray(center_poses(log.expert_ego[:, :3])[:, :2])
    steps = np.hypot(*np.diff(expert, axis=0).T)
    tracks = flat_tracks(log.tracks)
    state = EpisodeState(
        edges=road.edges.polygons,
        baselines=road.baselines,
        left=road.left_boundaries,
        right=road.right_boundaries,
        limits=road.speed_limits,
        num_lanes=road.num_lanes,
        edge_on_route=np.isin(road.block_of, blocks),
        blocks=road.blocks.polygons,
        num_roadblocks=road.num_roadblocks,
        intersections=road.intersections.polygons,
        car_parks=road.car_parks.polygons,
        expert=expert,
        expert_arc=np.concatenate([[0.0], np.cumsum(steps)]),
        ego=log.ego,
        tracks=tracks,
        touched=np.zeros(len(tracks.is_static), np.bool_),
        found=np.zeros(int(np.diff(road.edges.polygons.cell_ptr).max(initial=1)), np.int64),
        boxes=np.zeros((2, BOX_SIZE)),
        corners=np.zeros((2, 4, 2)),
        out=np.zeros(len(Terms._fields)),
    )
    _update(state, 0)  # contacts at the start are not the ego's fault
    state.out[:] = _START
    return state


def compute_reward_terms(state: EpisodeState, log: SimulationLog, row: int) -> Terms:
    """Terms of the step that led to a row of the log; rows have to come one after the other."""
    if row > 0:
        _update(state, row)
    if row + 1 >= MIN_SAMPLES:
        signals = comfort_signals(log.time_us[: row + 1], log.ego[: row + 1])
        checks = within_bounds(signals, NUPLAN)
        state.out[_COMFORT] = sum(checks) / len(checks)
    out = state.out.tolist()
    return Terms._make([*out[:_OFF_ROAD], out[_OFF_ROAD] > 0.0, out[_COLLISION] > 0.0, out[_DONE]])


@kernel
def _update(episode: EpisodeState, row: int) -> None:
    """Write all terms but comfort of the step that led to a row to `out`."""
    state, out = episode.ego[row], episode.out
    x = state[0] + _TO_CENTER * np.cos(state[HEADING])
    y = state[1] + _TO_CENTER * np.sin(state[HEADING])
    speed = np.hypot(state[VX], state[VY])
    arc, share = episode.expert_arc, 0.0
    if arc[-1] > 0.0:
        share = project_on_polyline(episode.expert, arc, 0, len(arc), x, y) / arc[-1]
    out[_PROGRESS], out[_DONE] = max(0.0, share - out[_DONE]), max(share, out[_DONE])
    out[_OFF_ROAD] = 0.0
    box_corners(x, y, state[HEADING], _LENGTH, _WIDTH, episode.corners[0])
    for corner in range(4):
        cx, cy = episode.corners[0, corner, 0], episode.corners[0, corner, 1]
        # nuPlan rule 365: other drivable areas of the map do not count
        found = containing(episode.blocks, cx, cy, episode.found[:1])  # roadblocks come first
        if (
            not (found > 0 and episode.found[0] < episode.num_roadblocks)
            and containing(episode.intersections, cx, cy, episode.found[:0]) == 0
            and containing(episode.car_parks, cx, cy, episode.found[:0]) == 0
        ):
            out[_OFF_ROAD] = 1.0
    out[_ON_ROUTE] = 1.0
    if _is_on_route(episode, episode.expert[row, 0], episode.expert[row, 1]):
        out[_ON_ROUTE] = 1.0 if _is_on_route(episode, x, y) else 0.0
    # the lane or connector that holds the ego: on the route, and along its heading
    best, lane = np.inf, -1
    for index in range(containing(episode.edges, x, y, episode.found)):
        edge = episode.found[index]
        error = deviation(episode.baselines, edge, 1, x, y, state[HEADING])[1]
        error += 0.0 if episode.edge_on_route[edge] else 2.0 * np.pi
        if error < best:
            best, lane = error, edge
    out[_LANE], out[_SPEED] = 1.0, 1.0
    if lane >= 0:
        left = _line_distance(episode.left, lane, x, y)
        right = _line_distance(episode.right, lane, x, y)
        if lane < episode.num_lanes and min(left, right) < np.inf:
            center = _line_distance(episode.baselines, lane, x, y)
            room = center + min(left, right) - FREE_OFFSET + 1e-6
            out[_LANE] = 1.0 - 0.5 * min(max((center - FREE_OFFSET) / room, 0.0), 1.0)
        # nuPlan rule 364: on connectors their own limit
        if speed > episode.limits[lane]:  # not where it is NaN
            out[_SPEED] = max(0.0, 1.0 - (speed - episode.limits[lane]) / MAX_OVERSPEED)
    is_hit, is_ahead = _find_contacts(episode, row, speed)
    out[_COLLISION] = is_hit and speed >= STOPPED_SPEED
    if is_ahead and speed > TTC_STOPPED_SPEED:
        out[_TTC] = 0.5


@kernel
def _is_on_route(episode: EpisodeState, x: float, y: float) -> bool:
    for index in range(containing(episode.edges, x, y, episode.found)):
        if episode.edge_on_route[episode.found[index]]:
            return True
    return False


@kernel
def _line_distance(lines: Polylines, line: int, x: float, y: float) -> float:
    """Distance of a point from a line, inf where the line is missing [m]."""
    best, xy = np.inf, lines.xy
    for index in range(lines.ptr[line], lines.ptr[line + 1] - 1):
        ax, ay, bx, by = xy[index, 0], xy[index, 1], xy[index + 1, 0], xy[index + 1, 1]
        best = min(best, point_segment_distance(x, y, ax, ay, bx, by))
    return best


@kernel
def _find_contacts(episode: EpisodeState, row: int, speed: float) -> tuple[bool, bool]:
    """Whether the ego touches a track for the first time, and whether it will within the horizon.

    Touched tracks are noted. In the horizon everybody goes straight on at constant speed.
    """
    tracks, is_hit, is_ahead = episode.tracks, False, False
    for track in range(len(episode.touched)):
        if episode.touched[track] or not tracks.valid[row, track]:
            continue
        state, ego, other = episode.ego[row], episode.boxes[0], episode.boxes[1]
        set_box(ego, state, _LENGTH, _WIDTH)
        ego[0] = state[0] + _TO_CENTER * ego[2]
        ego[1] = state[1] + _TO_CENTER * ego[3]
        pose, size = tracks.poses[row, track], tracks.sizes[row, track]
        velocity, other_speed = tracks.velocities[row, track], 0.0
        if not tracks.is_static[track]:
            other_speed = np.hypot(velocity[0], velocity[1])
        dx, dy = pose[0] - ego[0], pose[1] - ego[1]
        reach = ego[7] + 0.5 * (size[0] + size[1]) + TTC_STEP * TTC_TESTS * (speed + other_speed)
        if dx * dx + dy * dy > reach * reach:
            continue
        set_box(other, pose, size[0], size[1])
        if collide(ego, other, episode.corners):
            episode.touched[track] = is_hit = True
            continue
        # nuPlan rule 363: also those behind and beside the ego
        for _ in range(TTC_TESTS):
            ego[0] += ego[2] * speed * TTC_STEP
            ego[1] += ego[3] * speed * TTC_STEP
            other[0] += other[2] * other_speed * TTC_STEP
            other[1] += other[3] * other_speed * TTC_STEP
            is_ahead = is_ahead or collide(ego, other, episode.corners)
            if is_ahead:
                break
    return is_hit, is_ahead
