"""nuPlan's IDM planner: follow the route's lanes, keep a gap to what stands in the corridor.

The corridor is the path ahead, buffered by half the ego's width, united with the ego's footprint.
"""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import box_corners, boxes_to_corners, wrap_angle
from shiftsim.geometry.corridor import (
    BAND,
    CLEAR,
    HIT,
    UNDECIDED,
    Corridor,
    corridor_polygon,
    line_distance,
    occupancy,
    without_repeats,
)
from shiftsim.geometry.polylines import RUN, Path, bound_runs, pose_at
from shiftsim.geometry.rings import SLACK, ring_bounds, rings_touch
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.routes.graph import (
    HINT,
    LanePath,
    Search,
    lane_at,
    lane_path,
    search_levels,
    sub_path,
)
from shiftsim.planners.routes.lead import (
    OVERLAPPING,
    UNKNOWN,
    LightWatch,
    Objects,
    RedLights,
    bounds_of,
    find_lead,
    keep_one_overlap,
)
from shiftsim.sim.dynamics.idm import idm_acceleration
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    NUM_STATE,
    VX,
    Tracks,
    Trajectory,
    VehicleParameters,
    rear_poses,
)

STEPS = 16
STEP = 0.5  # s
STEP_US = 500_000
HORIZON = STEPS * STEP  # s
RADIUS = 40.0  # m, objects with their centre nearer than this to the ego's are seen
_EGO_TOKEN = "ego_token"
_OVERLOOKED = frozenset(  # all its parts
    _EGO_TOKEN[i:j] for i in range(len(_EGO_TOKEN)) for j in range(i, len(_EGO_TOKEN) + 1)
)
_TIED = -1  # instead of an object to decide


def route_blocks(road: VectorMap, route: tuple[str, ...], token: str) -> list[int]:
    """Block indices of a route, NONE for ids the map does not have.

    Raises:
        PlannerError: The route is too short, or a block that must be known is not.
    """
    if len(route) < 2:
        raise PlannerError(
            f"idm: the route of scenario {token!r} has {len(route)} roadblocks, at least 2 "
            "are needed",
            hint=HINT,
        )
    blocks = [road.blocks.index.get(name, NONE) for name in route]
    # nuPlan rule 151: an unknown id is passed over, except where the planner needs the object
    for position in (0, 1, len(blocks) - 1):
        if blocks[position] == NONE:
            raise PlannerError(
                f"idm: map {road.name!r} has no roadblock {route[position]!r}, number {position} "
                f"of the route of scenario {token!r}",
                hint="the first two and the last roadblock of a route must exist",
            )
    return blocks


def plan_route(
    road: VectorMap, blocks: list[int], center: FloatArray, vehicle: VehicleParameters
) -> Search:
    """Lanes from the ego, whose box centre is (3,), to the last block of the route.

    Raises:
        PlannerError: The first two blocks of the route have no lanes.
    """
    lanes = road.lanes_of(blocks[:2])
    if not lanes:
        raise PlannerError(
            f"idm: map {road.name!r} has no lanes in the first two roadblocks of the route",
            hint=HINT,
        )
    start = lane_at(road, np.array(lanes), center, vehicle.length, vehicle.width)
    skipped = 1 if int(road.block_of[start]) == blocks[1] else 0
    allowed = set(road.lanes_of(blocks))
    # nuPlan rule 152: the goal must lie exactly as deep as the route is long
    return search_levels(
        lambda lane: [after for after in road.outgoing.at(lane).tolist() if after in allowed],
        start,
        set(road.lanes_of(blocks[-1:])),
        len(blocks) - skipped,
        only_last=True,
    )


def build_path(road: VectorMap, lanes: list[int]) -> LanePath:
    """The path along the baselines of some lanes.

    Raises:
        PlannerError: Fewer than two vertices are left.
    """
    path = lane_path(road, lanes)
    if len(path.driven.progress) < 2:
        raise PlannerError(
            f"idm: the baselines of {[road.edges.ids[e] for e in lanes]} have too few vertices",
            hint="a path needs at least three different vertices",
        )
    return path


class Policy(NamedTuple):
    """What drives along the path."""

    length: float  # of the ego [m]
    width: float  # of the ego [m]
    target_velocity: float  # speed on a free road [m/s]
    min_gap: float  # gap kept at standstill [m]
    headway: float  # time gap kept [s]
    accel_max: float  # largest acceleration [m/s^2]
    decel_max: float  # largest deceleration, positive [m/s^2]


class Idm:
    """Intelligent Driver Model along the route."""

    name = "idm"

    def __init__(
        self,
        *,
        target_velocity: float = 10.0,
        min_gap: float = 1.0,
        headway: float = 1.5,
        accel_max: float = 1.0,
        decel_max: float = 3.0,
    ) -> None:
        """Set the model's parameters.

        Args:
            target_velocity: Speed on a free road where the map has no speed limit [m/s].
            min_gap: Gap kept at standstill [m].
            headway: Time gap kept [s].
            accel_max: Largest acceleration [m/s^2].
            decel_max: Largest deceleration, positive [m/s^2].
        """
        self._fallback_velocity = target_velocity
        self._limits = (min_gap, headway, accel_max, decel_max)
        self._scene: SceneInfo | None = None
        self._blocks: list[int] = []
        self._lights: LightWatch | None = None
        self.route_plan: Search | None = None
        self.path: LanePath | None = None
        self.target_velocity = target_velocity

    def reset(self, scene: SceneInfo) -> None:
        """Look up the route; the path is built at the first plan.

        Raises:
            PlannerError: The route is too short or unknown to the map.
        """
        self._scene = scene
        self._blocks = route_blocks(scene.map, scene.route, scene.token)
        self._lights = LightWatch(scene.map, scene.map.lanes_of(self._blocks))
        self.route_plan = self.path = None

    def plan(self, observation: Observation) -> Trajectory:
        """17 states, 0.5 s apart, from the path's point nearest to the ego on."""
        centers, speeds = self.roll_out(observation)
        states = np.zeros((STEPS + 1, NUM_STATE))
        states[:, :3] = rear_poses(centers)
        states[:, VX] = speeds
        return Trajectory(observation.time_us + STEP_US * np.arange(STEPS + 1), states)

    def roll_out(self, observation: Observation) -> tuple[FloatArray, FloatArray]:
        """Box centres (17, 3) x [m], y [m], heading [rad] and speeds (17,) [m/s] of the plan."""
        scene = self._scene
        if scene is None or self._lights is None:
            raise PlannerError("idm: plan() was called before reset()")
        ego = observation.ego
        path = self.path or self._make_path(scene, observation)
        policy = Policy(
            scene.vehicle.length, scene.vehicle.width, self.target_velocity, *self._limits
        )
        centers, motion = np.empty((STEPS + 1, 3)), np.empty((STEPS + 1, 2))
        centers[0] = ego.center
        start = path.project(centers[0, 0], centers[0, 1])
        motion[0] = start, ego.values[VX]
        red = self._lights.at(observation.lights)
        objects = objects_around(observation.history.tracks, centers[0], red)
        count = len(objects.speeds)
        apart, footprint = np.empty(count), np.empty((4, 2))
        known, step = np.full((STEPS, count), UNKNOWN), 0
        trees: dict[tuple[int, ...], shapely.STRtree] = {}
        while True:
            step, lead = _roll_on(
                step, path.driven, objects, policy, centers, motion, apart, known, footprint
            )
            if step == STEPS:
                break
            unsure = np.flatnonzero(known[step] == UNDECIDED) if lead == _TIED else [lead]
            if len(unsure):
                line = sub_path(path.driven, *_reach(path.driven, motion[step, 0], policy))
                corridor = corridor_polygon(shapely.LineString(line[:, :2]), 0.5 * policy.width)
                corridor = corridor.union(shapely.Polygon(footprint))
            for index in unsure:
                ring = objects.xy[objects.ptr[index] : objects.ptr[index + 1]]
                touches = corridor.intersects(shapely.Polygon(ring))
                known[step, index] = HIT if touches else CLEAR
            if lead == _TIED:
                keep_one_overlap(objects, known[step], footprint, trees)
        centers[0] = pose_at(path.driven, start)
        centers[0, 2] = wrap_angle(centers[0, 2])
        return centers, motion[:, 1]

    def _make_path(self, scene: SceneInfo, observation: Observation) -> LanePath:
        """Choose lanes and target velocity, once per scenario."""
        ego = observation.ego
        self.route_plan = plan_route(scene.map, self._blocks, ego.center, scene.vehicle)
        self.path = build_path(scene.map, self.route_plan.path)
        limit = float(scene.map.speed_limits[self.route_plan.path[0]])
        if np.isnan(limit) or limit == 0.0:
            # nuPlan rule 155: the value of the scenario before, where a planner is used again; here
            # a scenario never depends on those before it
            limit = self._fallback_velocity
        # nuPlan rule 156: the target is that of the first lane for the whole scenario
        self.target_velocity = max(limit, ego.speed)
        if self.target_velocity <= 0.0:
            raise PlannerError(
                f"idm: the speed limit at the start of scenario {scene.token!r} is {limit} m/s",
                hint="speed limits must be positive, or absent",
            )
        return self.path


def objects_around(tracks: Tracks, center: FloatArray, red: RedLights) -> Objects:
    """What the ego, whose box centre is (3,), sees of the last row of tracks, then red lights."""
    poses, sizes = tracks.poses[-1], tracks.sizes[-1]
    distance = np.hypot(poses[:, 0] - center[0], poses[:, 1] - center[1])
    near = np.flatnonzero(tracks.valid[-1] & (distance < RADIUS))
    # nuPlan rule 157: whatever has a part of "ego_token" for a token is overlooked
    if not _OVERLOOKED.isdisjoint([tracks.tokens[i] for i in near.tolist()]):
        near = near[[tracks.tokens[i] not in _OVERLOOKED for i in near.tolist()]]
    poses, sizes = poses.take(near, 0), sizes.take(near, 0)
    velocities = tracks.velocities[-1].take(near, 0)
    speeds = np.hypot(velocities[:, 0], velocities[:, 1])
    speeds[tracks.kinds[near] > LAST_AGENT_KIND] = 0.0
    count, nothing = len(near), np.zeros(len(red.lanes))
    xy = np.concatenate([boxes_to_corners(poses, sizes).reshape(-1, 2), red.xy])
    ptr = np.concatenate([4 * np.arange(count), 4 * count + red.ptr])
    turns, speeds = np.concatenate([poses[:, 2], nothing]), np.concatenate([speeds, nothing])
    return Objects(xy, ptr, bounds_of(xy, ptr), turns, speeds)


@kernel
def _reach(path: Path, progress: float, policy: Policy) -> tuple[float, float]:
    """Progress at the ends of the stretch that would be covered at the target velocity [m]."""
    end = path.progress[-1]
    ahead = progress + abs(policy.target_velocity) * HORIZON
    return min(max(progress, 0.0), end), min(max(ahead, 0.0), end)


@kernel
def _accelerate(policy: Policy, speed: float, gap: float, speed_ahead: float) -> float:
    """Acceleration behind a lead, within the limits [m/s^2]."""
    _, _, target, min_gap, headway, accel_max, decel_max = policy
    accel = idm_acceleration(
        speed, gap, speed_ahead, target, min_gap, headway, accel_max, decel_max
    )
    return min(max(accel, -decel_max), accel_max)


@kernel
def _speed_along(objects: Objects, index: int, heading: float) -> float:
    """Speed of an object along a heading [m/s]."""
    return objects.speeds[index] * np.cos(wrap_angle(objects.headings[index] - heading))


@kernel
def _roll_on(
    first: int,  # row that is known
    path: Path,
    objects: Objects,
    policy: Policy,
    centers: FloatArray,  # (17, 3) box centres x [m], y [m], heading [rad]
    motion: FloatArray,  # (17, 2) progress [m] and speed [m/s]
    apart: FloatArray,  # (M,) distances of the objects from the path, inf where they are far [m]
    known: IntArray,  # (16, M) what every object is to the corridor at every step, or UNKNOWN
    footprint: FloatArray,  # (4, 2) receives the corners of the ego in the row returned [m]
) -> tuple[int, int]:
    """Fill the rows behind `first` until the end, or until it is open what the lead is.

    Returns:
        The row, and the UNDECIDED object to decide, or _TIED where several are touched. The last
        row has nothing to decide.
    """
    length, half_width, count = policy.length, 0.5 * policy.width, len(objects.speeds)
    xy, ptr = objects.xy, objects.ptr
    radius = 0.5 * np.hypot(length, policy.width) + SLACK  # of the footprint, which is on the path
    reach = 1.5 * (1.0 + BAND) * half_width  # of the corridor, the corners of its ends included
    if first == 0:
        # objects stand still: what is far from the whole path is far from every stretch of it
        progress = motion[0, 0] + STEP * min(motion[0, 1], 0.0)
        begin = max(min(np.searchsorted(path.progress, progress), len(path.xy) - 1) - 1, 0)
        ahead = Corridor(path.xy, path.runs, begin, len(path.xy), half_width)
        for index in range(count):
            ring = xy[ptr[index] : ptr[index + 1]]
            apart[index] = line_distance(ahead, ring, ring_bounds(ring), 0.0, max(radius, reach))
    for step in range(first, STEPS):
        progress, speed, heading = motion[step, 0], motion[step, 1], centers[step, 2]
        box_corners(centers[step, 0], centers[step, 1], heading, length, policy.width, footprint)
        low, high = _reach(path, progress, policy)
        poses = sub_path(path, low, high)
        line, runs = np.empty((len(poses), 2)), np.empty(((len(poses) - 2) // RUN + 1, 4))
        for vertex in range(len(poses)):
            line[vertex, 0], line[vertex, 1] = poses[vertex, 0], poses[vertex, 1]
        bound_runs(line, runs)
        begin, end = without_repeats(line, 0, len(line))
        corridor = Corridor(line, runs, begin, end, half_width)
        for index in range(count):
            if known[step, index] != UNKNOWN:
                continue
            known[step, index] = CLEAR
            if step > 0 and apart[index] > radius and apart[index] > reach:
                continue
            ring = xy[ptr[index] : ptr[index + 1]]
            if rings_touch(footprint, ring):
                known[step, index] = OVERLAPPING
            elif apart[index] <= reach:
                known[step, index] = occupancy(corridor, ring, True)
        # nuPlan rule 158: all objects stand still during the roll-out; their speeds count only here
        lead, gap = find_lead(footprint, objects, known[step])
        if lead < 0:
            accel = _accelerate(policy, speed, path.progress[-1] - progress - 0.5 * length, 0.0)
        elif known[step, lead] == UNDECIDED:
            return step, lead
        else:
            accel = _accelerate(policy, speed, gap, _speed_along(objects, lead, heading))
        if lead >= 0 and known[step, lead] == OVERLAPPING:
            # most often the ego brakes as hard as it can for each of them
            for index in range(lead + 1, count):
                if known[step, index] == OVERLAPPING:
                    speed_ahead = _speed_along(objects, index, heading)
                    if _accelerate(policy, speed, gap, speed_ahead) != accel:
                        return step, _TIED
        motion[step + 1, 0] = progress + STEP * speed
        motion[step + 1, 1] = max(0.0, speed + STEP * accel)
        x, y, heading = pose_at(path, motion[step + 1, 0])
        centers[step + 1, 0], centers[step + 1, 1] = x, y
        centers[step + 1, 2] = wrap_angle(heading)
    return STEPS, _TIED
