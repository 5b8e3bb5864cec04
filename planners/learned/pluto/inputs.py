"""The arrays that PLUTO's network reads, of one scene and of a batch."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.learned.features import AgentFeatures, stack_scenes
from shiftsim.planners.learned.map_features import RoadFeatures
from shiftsim.planners.learned.pluto.reference import LineFeatures
from shiftsim.planners.learned.pluto.world import StaticObjects
from shiftsim.world.state import AX, STEERING, VX, YAW_RATE

Array = np.ndarray


class SceneInputs(NamedTuple):
    """Fields of `network.Inputs` without the axis of the batch; float32, int64 and bool."""

    position: Array
    heading: Array
    velocity: Array
    shape: Array
    valid: Array
    category: Array
    current_state: Array
    points: Array
    vectors: Array
    orientations: Array
    centers: Array
    kind: Array
    on_route: Array
    light: Array
    has_limit: Array
    limit: Array
    point_valid: Array
    object_pose: Array
    object_shape: Array
    object_category: Array
    object_valid: Array
    line_points: Array
    line_vectors: Array
    line_orientations: Array
    line_valid: Array


def scene_inputs(
    ego: FloatArray,
    agents: AgentFeatures,
    road: RoadFeatures,
    static: StaticObjects,
    lines: LineFeatures,
) -> SceneInputs:
    """What the network reads.

    Args:
        ego: (11,) ego state.
        agents: The ego and the agents.
        road: Lanes, connectors and crosswalks.
        static: Static objects.
        lines: Reference lines.
    """
    return SceneInputs(
        position=agents.position,
        heading=agents.heading,
        velocity=agents.velocity,
        shape=agents.shape,
        valid=agents.valid,
        category=agents.category,
        current_state=current_state(ego),
        points=road.points,
        vectors=road.vectors[:, 0],
        orientations=road.orientations[:, 0],
        centers=road.centers,
        kind=road.kind,
        on_route=road.on_route.astype(np.int64),
        light=road.light,
        has_limit=road.has_limit,
        limit=road.limit,
        point_valid=road.valid,
        object_pose=_in_ego_frame(static.poses, ego),
        object_shape=static.sizes[:, ::-1].astype(np.float32),
        object_category=static.categories,
        object_valid=np.ones(len(static.poses), np.bool_),
        line_points=lines.position,
        line_vectors=lines.vector,
        line_orientations=lines.orientation,
        line_valid=lines.valid_mask,
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
