"""CaRL: a policy trained by reinforcement learning on a raster of the surroundings.

It answers with a command for the motion model, not with a trajectory. Several checkpoints
make an ensemble, which does the mean of what they would do.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.planners.learned.carl import view
from shiftsim.planners.learned.carl.raster import Raster
from shiftsim.planners.learned.carl.roads import MAX_SPEED, Roads, level, make_roads
from shiftsim.planners.learned.checkpoint import load_network, resolve_device, split_ensemble
from shiftsim.planners.learned.map_features import LightLookup
from shiftsim.planners.routes.correction import correct_route, find_start
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world import state
from shiftsim.world.map import PerMap, VectorMap

MAX_STEERING = 0.83775804096  # rad, 48 degrees: the target of a full steering action
MAX_ACCELERATION, MAX_BRAKING = 2.4, 3.2  # m/s^2
DT = 0.1  # s
REVERSE_GAIN = 0.75  # of the present acceleration, where braking would reverse the ego

Action = NDArray[np.float32]

_roads_of = PerMap(make_roads)


class CarlFeatures(NamedTuple):
    """What the network reads."""

    pictures: Raster  # (9, 256, 256), drawn over at the next step
    # (10,) last action, then velocity [m/s] and acceleration [m/s^2] of the centre, steering angle
    # [rad] and rate [rad/s], yaw rate [rad/s] and acceleration [rad/s^2]
    measurements: NDArray[np.float32]


class Carl(LearnedPlanner[CarlFeatures, Action]):
    """The nuPlan version of CaRL."""

    name = "carl"
    _scene: SceneInfo | None = None

    def __init__(self, checkpoint: str = "", *, device: str = "cpu") -> None:
        """Load the networks, of several checkpoints as `split_ensemble` has them."""
        parts = split_ensemble(checkpoint, self.name)
        self.networks = [load_network(part, self.name, device=device) for part in parts]
        self.device = resolve_device(device)

    def reset(self, scene: SceneInfo) -> None:
        """Prepare the map and forget the last action; the route is corrected at the first step."""
        self._scene = scene
        self._roads = _roads_of(scene.map)
        self._on_route: BoolArray | None = None
        self._pictures = np.zeros((len(view.CHANNELS), view.SIZE, view.SIZE), np.uint8)
        self.last_action = np.zeros(2, np.float32)
        self._lights = LightLookup(scene.map, state.LightStatus.ABSENT)
        self._route_flaw = self._blindness = self.degraded = ""
        self.route: list[int] = []
        self.found: IntArray = np.zeros(0, np.int64)

    def features(self, observation: Observation) -> CarlFeatures:
        """Draw the raster and measure the ego; the arrays are reused at the next step."""
        scene = self._scene
        if scene is None:
            raise PlannerError(f"{self.name}: plan() was called before reset()")
        ego, tracks = observation.history.ego[-1].copy(), observation.history.tracks
        on_route = self._on_route
        if on_route is None:
            on_route = self._start(scene, ego, state.center_poses(ego[:3], scene.vehicle))
        status = self._lights.at(observation.lights)
        roads, pictures = self._roads, self._pictures
        pictures.fill(0)
        self.found = draw(pictures, roads, ego, tracks, -1, on_route, status)
        self._blindness = self._why_blind(scene.map, status)
        return CarlFeatures(pictures, measure(ego, self.last_action))

    def infer(self, scenes: Sequence[CarlFeatures]) -> list[Action]:
        """Actions (2,) in [-1, 1]: acceleration and steering."""
        import torch

        parts = (np.stack(part) for part in zip(*scenes, strict=True))
        pictures, measured = (torch.from_numpy(part).to(self.device) for part in parts)
        with torch.inference_mode():
            each = [network(pictures, measured).action for network in self.networks]
            return list(torch.stack(each).mean(dim=0).cpu().numpy())

    def decode(self, output: Action, observation: Observation) -> state.Command:
        """The command, for the motion model without a tracker."""
        self.last_action = output
        self.degraded = self._route_flaw or self._blindness
        return command_of(output, observation.history.ego[-1])

    def _start(self, scene: SceneInfo, ego: FloatArray, center: FloatArray) -> BoolArray:
        """Correct the route, once per scenario; (B,) the blocks on it."""
        road, known = scene.map, scene.route_blocks
        if not known:
            self._route_flaw = "the map has no block of the route"
        elif len(known) < len(set(scene.route)):
            self._route_flaw = "the route has blocks that the map does not have"
        if known:
            size = np.array([scene.vehicle.length, scene.vehicle.width])
            start = find_start(road, known, ego[:3], boxes_to_corners(center, size))
            self.route = correct_route(road, known, start)
        self._on_route = np.zeros(len(road.blocks), np.bool_)
        self._on_route[self.route] = True
        return self._on_route

    def _why_blind(self, road: VectorMap, status: IntArray) -> str:
        """Why the official code would have failed at the raster; empty where it would not."""
        if not len(self.found):
            return "no road within the raster"
        # nuPlan rule 360: the official code fails at an unknown status; here it is not drawn
        listed = self._lights.edges
        unknown = listed[(status[listed] == state.LightStatus.UNKNOWN) & (listed >= road.num_lanes)]
        if len(unknown) and np.isin(road.block_of[unknown], self.found).any():
            return "a light in the raster has an unknown status"
        return ""


def draw(
    pictures: Raster,  # (9, 256, 256) zeros, written
    roads: Roads,
    ego: FloatArray,  # (11,) the present state
    tracks: state.Tracks,
    row: int,  # of the tracks that is the present
    on_route: BoolArray,  # (B,) blocks of the route
    status: IntArray,  # (E,) LightStatus by edge
) -> IntArray:
    """Draw the raster around an ego; the areas that are in it."""
    center, velocity = state.center_poses(ego[:3]), state.center_velocities(ego)
    frame = view.picture_frame(center)
    found: IntArray = view.find_areas(roads, frame)
    view.draw_roads(pictures, roads, frame, found, on_route, status)
    present = np.flatnonzero(tracks.valid[row])
    columns = (tracks.poses, tracks.sizes, tracks.velocities)
    poses, sizes, velocities = (column[row][present] for column in columns)
    boxes = view.Boxes(poses, sizes, velocities, tracks.kinds[present])
    view.draw_objects(pictures, frame, boxes)
    value = level(float(np.hypot(velocity[0], velocity[1])), MAX_SPEED)
    box = (*center.tolist(), state.PACIFICA.length, state.PACIFICA.width)
    view.draw_box(pictures[view.EGO], frame, *box, value)
    return found


def measure(ego: FloatArray, last_action: Action) -> Action:
    """The measurements (10,) of `CarlFeatures`."""
    velocity, acceleration = state.center_velocities(ego), state.center_accelerations(ego)
    turning = ego[state.STEERING : state.YAW_ACCEL + 1]
    return np.concatenate([last_action, velocity, acceleration, turning], dtype=np.float32)


def command_of(action: Action, ego: FloatArray) -> state.Command:
    """What an action (2,) in [-1, 1], acceleration and steering, asks of the motion model."""
    throttle, steering = float(action[0]), float(action[1])
    steering_rate = (steering * MAX_STEERING - float(ego[state.STEERING])) / DT
    acceleration = throttle * (MAX_ACCELERATION if throttle >= 0.0 else MAX_BRAKING)
    if float(ego[state.VX]) + DT * acceleration < 0.0:
        # nuPlan rule 361: it comes to a stop, rather than that it drives backwards
        acceleration = -float(ego[state.VX]) - REVERSE_GAIN * float(ego[state.AX])
    return state.Command(min(max(acceleration, -MAX_BRAKING), MAX_ACCELERATION), steering_rate)
