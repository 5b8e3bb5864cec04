"""The arrays that PLUTO's network reads, of one scene and of a batch."""

from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np

from shiftsim.kernels import FloatArray
from shiftsim.planners.learned.features import AgentFeatures, stack_scenes
from shiftsim.planners.learned.map_features import RoadFeatures
from shiftsim.planners.learned.pluto.reference import LineFeatures
from shiftsim.planners.learned.pluto.world import StaticObjects
from shiftsim.world.state import AX, STEERING, VX, YAW_RATE

Array = np.ndarray


# fields of `network.Inputs` without the axis of the batch; arrays of float32, int64 and bool
SceneInputs = namedtuple(
    "SceneInputs",
    "position heading velocity shape valid category current_state points vectors orientations "
    "centers kind on_route light has_limit limit point_valid object_pose object_shape "
    "object_category object_valid line_points line_vectors line_orientations line_valid",
)


def scene_inputs(
    ego: FloatArray,
    agents: AgentFeatures,
    road: RoadFeatures,
    static: StaticObjects,
    lines: LineFeatures,
) -> SceneInputs:
    """What the network reads of one scene."""
    return SceneInputs(
        *agents[1:],
        current_state(ego),
        *(road.points, road.vectors[:, 0], road.orientations[:, 0], road.centers),
        *(road.kind, road.on_route.astype(np.int64), road.light, road.has_limit, road.limit),
        road.valid,
        *(_in_ego_frame(static.poses, ego), static.sizes[:, ::-1].astype(np.float32)),
        *(static.categories, np.ones(len(static.poses), np.bool_)),
        *lines,
    )


def current_state(ego: FloatArray) -> Array:
    """(7,) float32: pose in its own frame, speed, acceleration, steering angle, yaw rate."""
    own = [0.0, 0.0, 0.0, ego[VX], ego[AX], ego[STEERING], ego[YAW_RATE]]
    return np.array(own, np.float32)


def _in_ego_frame(poses: FloatArray, ego: FloatArray) -> Array:
    """(S, 3) float32; headings are not wrapped."""
    cos, sin = np.cos(ego[2]), np.sin(ego[2])
    local = poses - ego[:3]
    out = np.empty(local.shape, np.float32)
    out[:, 0] = local[:, 0] * cos + local[:, 1] * sin
    out[:, 1] = local[:, 1] * cos - local[:, 0] * sin
    out[:, 2] = local[:, 2]
    return out


def stack(scenes: Sequence[SceneInputs], device: str) -> list[Any]:
    """Values of `network.Inputs`; scenes with fewer rows are filled up with zeros."""
    parts = ("category", "kind", "object_category", "line_valid")
    return [
        *stack_scenes(scenes, device),
        [[len(getattr(scene, name)) for scene in scenes] for name in parts],
    ]
