"""nuPlan's IDM planner: follow the route's lanes, keep a gap to what stands in the corridor.

Everything that moves is taken as standing still during the 8 s roll-out; its speed enters only
through the desired gap (idm-planner.md §4, quirk I3).
"""

import numpy as np
import shapely

from shiftsim.arrays import FloatArray, IntArray, kernel
from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import box_corners, boxes_to_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.planners.idm.corridor import (
    CLEAR,
    HIT,
    OPEN,
    UNKNOWN,
    Occupants,
    find_lead,
    find_sides,
    near_path,
    sub_path,
)
from shiftsim.planners.idm.path import (
    Path,
    RoutePlan,
    build_path,
    candidate_edges,
    interpolate,
    plan_route,
    route_blocks,
)
from shiftsim.sim.dynamics.idm import idm_acceleration
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.state import (
    LAST_AGENT_KIND,
    NUM_STATE,
    VX,
    LightStatus,
    Trajectory,
    rear_poses,
)

STEPS = 16
STEP = 0.5  # s
STEP_US = 500_000
HORIZON = STEPS * STEP  # s
RADIUS = 40.0  # m, objects with their centre nearer than this to the ego's are seen
_EGO_TOKEN = "ego_token"


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
        self._candidates: set[int] = set()
        self.route_plan: RoutePlan | None = None
        self.path: Path | None = None
        self.target_velocity = target_velocity

    def reset(self, scene: SceneInfo) -> None:
        """Look up the route; the path is built at the first plan.

        Raises:
            PlannerError: The route is too short or unknown to the map.
        """
        self._scene = scene
        self._blocks = route_blocks(scene.map, scene.route, scene.token)
        self._candidates = candidate_edges(scene.map, self._blocks)
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
        if scene is None:
            raise PlannerError("idm: plan() was called before reset()")
        ego = observation.ego
        path = self.path or self._make_path(scene, observation)
        centers, motion = np.empty((STEPS + 1, 3)), np.empty((STEPS + 1, 2))
        centers[0] = ego.center
        start = path.project(centers[0, 0], centers[0, 1])
        motion[0] = start, ego.values[VX]
        occupants = self._occupants(observation, path, start, float(ego.values[VX]))
        sides = np.full((STEPS, len(occupants.speeds)), UNKNOWN)
        size = (scene.vehicle.length, scene.vehicle.width)
        model = (self.target_velocity, *self._limits)
        step = 0
        while True:
            step, lead = _roll_on(step, path, occupants, size, model, centers, motion, sides)
            if lead < 0:
                break
            reach = _look_ahead(path, motion[step, 0], self.target_velocity)
            sides[step, lead] = _exact_side(reach, centers[step], size, occupants, lead)
        centers[0] = interpolate(path, start)
        return centers, motion[:, 1]

    def _make_path(self, scene: SceneInfo, observation: Observation) -> Path:
        """Choose lanes and target velocity, once per scenario."""
        ego = observation.ego
        self.route_plan = plan_route(scene.map, self._blocks, ego.center, scene.vehicle)
        self.path = build_path(scene.map, self.route_plan.edges)
        limit = float(scene.map.speed_limits[self.route_plan.edges[0]])
        if np.isnan(limit) or limit == 0.0:
            # nuPlan: the value of the scenario before, where an instance is used again (I9); here a
            # scenario never depends on those before it
            limit = self._fallback_velocity
        self.target_velocity = max(limit, ego.speed)  # nuPlan: frozen at the first edge (I2)
        if self.target_velocity <= 0.0:
            raise PlannerError(
                f"idm: the speed limit at the start of scenario {scene.token!r} is {limit} m/s",
                hint="speed limits must be positive, or absent",
            )
        return self.path

    def _occupants(
        self, observation: Observation, path: Path, progress: float, speed: float
    ) -> Occupants:
        """Objects and red lights that can come into the corridor during the roll-out."""
        assert self._scene is not None
        vehicle, tracks = self._scene.vehicle, observation.history.tracks
        center = observation.ego.center
        poses, sizes = tracks.poses[-1], tracks.sizes[-1]
        distance = np.hypot(poses[:, 0] - center[0], poses[:, 1] - center[1])
        near = np.flatnonzero(tracks.valid[-1] & (distance < RADIUS))
        # nuPlan: whatever has a part of "ego_token" for a token is overlooked (I8)
        near = near[[tracks.tokens[i] not in _EGO_TOKEN for i in near.tolist()]]
        boxes = boxes_to_corners(poses[near], sizes[near])
        radii = 0.5 * np.hypot(sizes[near, 0], sizes[near, 1])
        is_agent = tracks.kinds[near] <= LAST_AGENT_KIND
        velocities = tracks.velocities[-1, near]
        agent_speeds = np.where(is_agent, np.hypot(velocities[:, 0], velocities[:, 1]), 0.0)
        reds = self._red_lights(observation)
        circles = np.concatenate(
            [np.column_stack([poses[near, :2], radii]), *(_circle(ring)[None] for ring in reds)]
        )
        reach = 0.5 * float(np.hypot(vehicle.length, vehicle.width))
        travel = HORIZON * (max(abs(speed), self.target_velocity) + 1.0)
        high = progress + travel + HORIZON * self.target_velocity
        kept = near_path(
            path, progress - abs(speed) - 1.0, high, circles, center[0], center[1], reach
        )
        rings = [boxes[i] if i < len(near) else reds[i - len(near)] for i in kept.tolist()]
        nothing = np.zeros(len(reds))
        return Occupants(
            np.concatenate(rings) if rings else np.zeros((0, 2)),
            np.cumsum([0, *(len(ring) for ring in rings)]),
            circles[kept],
            np.concatenate([poses[near, 2], nothing])[kept],
            np.concatenate([agent_speeds, nothing])[kept],
        )

    def _red_lights(self, observation: Observation) -> list[FloatArray]:
        """Shells (V, 2) of the connectors of the route whose light is red [m]."""
        assert self._scene is not None
        edges = self._scene.map.edges
        return [
            edges.rings(edges.index[name])[0]
            for name, status in observation.traffic_lights.items()
            if status == LightStatus.RED and edges.index.get(name, -1) in self._candidates
        ]


def _circle(ring: FloatArray) -> FloatArray:
    middle = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    radius = np.hypot(ring[:, 0] - middle[0], ring[:, 1] - middle[1]).max()
    return np.array([middle[0], middle[1], radius])


@kernel
def _look_ahead(path: Path, progress: float, target: float) -> FloatArray:
    """(K, 2) the stretch of path that the ego would cover at its target velocity [m]."""
    end = path.progress[-1]
    low = min(max(progress, 0.0), end)
    return sub_path(path, low, min(max(progress + abs(target) * HORIZON, 0.0), end))


@kernel
def _roll_on(
    first: int,
    path: Path,
    occupants: Occupants,
    size: tuple[float, float],
    model: tuple[float, float, float, float, float],
    centers: FloatArray,
    motion: FloatArray,
    sides: IntArray,
) -> tuple[int, int]:
    """Fill the rows behind `first` until the end, or until an OPEN occupant would be the lead.

    Args:
        first: Row that is known.
        path: The path.
        occupants: What may stand in the way.
        size: Length and width of the ego [m].
        model: Target velocity [m/s] and the remaining parameters of `idm_acceleration`.
        centers: (17, 3) box centres x [m], y [m], heading [rad].
        motion: (17, 2) progress [m] and speed [m/s].
        sides: (16, M) side of every occupant at every step, decided as far as needed.

    Returns:
        The row and the occupant to decide, or -1 for the occupant at the end.
    """
    target, min_gap, headway, accel_max, decel_max = model
    footprint = np.empty((4, 2))
    for step in range(first, STEPS):
        x, y, heading = centers[step, 0], centers[step, 1], centers[step, 2]
        progress, speed = motion[step, 0], motion[step, 1]
        box_corners(x, y, heading, size[0], size[1], footprint)
        line = _look_ahead(path, progress, target)
        find_sides(line, 0.5 * size[1], footprint, occupants, sides[step])
        lead, gap = find_lead(footprint, occupants, sides[step])
        lead_speed = 0.0
        if lead < 0:
            gap = path.progress[-1] - progress - 0.5 * size[0]
        elif sides[step, lead] == OPEN:
            return step, lead
        else:
            turn = wrap_angle(occupants.headings[lead] - heading)
            lead_speed = occupants.speeds[lead] * np.cos(turn)
        accel = idm_acceleration(
            speed, gap, lead_speed, target, min_gap, headway, accel_max, decel_max
        )
        motion[step + 1, 0] = progress + STEP * speed
        motion[step + 1, 1] = max(0.0, speed + STEP * min(max(accel, -decel_max), accel_max))
        x, y, heading = interpolate(path, motion[step + 1, 0])
        centers[step + 1, 0], centers[step + 1, 1], centers[step + 1, 2] = x, y, heading
    return STEPS, -1


def _exact_side(
    line: FloatArray,
    center: FloatArray,
    size: tuple[float, float],
    occupants: Occupants,
    index: int,
) -> int:
    """The side of an OPEN occupant, by the polygon nuPlan uses."""
    buffer = shapely.LineString(line).buffer(0.5 * size[1], cap_style="square")
    corridor = buffer.union(shapely.Polygon(boxes_to_corners(center, np.array(size))))
    ring = occupants.xy[occupants.ptr[index] : occupants.ptr[index + 1]]
    return HIT if corridor.intersects(shapely.Polygon(ring)) else CLEAR
