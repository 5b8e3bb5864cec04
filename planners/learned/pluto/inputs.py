"""The arrays that PLUTO's network reads, of one scene and of a batch."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.planners.learned.features import AgentFeatures
from shiftsim.planners.learned.map_features import RoadFeatures
from shiftsim.planners.learned.pluto.reference import LineFeatures
from shiftsim.planners.learned.pluto.world import StaticObjects
from shiftsim.world.state import AX, STEERING, VX, YAW_RATE

Array = np.ndarray


class Inputs(NamedTuple):
    """B scenes, A rows of agents of which the first is the ego, M polygons, K points.

    Arrays of one scene, without the axis B, or tensors of a batch; float32, int64 and bool.

    Attributes:
        position: (B, A, 21, 2) in the ego frame [m].
        heading: (B, A, 21) [rad].
        velocity: (B, A, 21, 2) [m/s].
        shape: (B, A, 21, 2) width, length [m].
        valid: (B, A, 21)
        category: (B, A) indices of kinds.
        current_state: (B, >= 6) x, y, heading, speed, acceleration, steering angle.
        points: (B, M, 3, K, 2) centre line, left and right boundary [m].
        vectors: (B, M, K, 2) along the centre line, to the next point [m].
        orientations: (B, M, K) of these vectors [rad].
        centers: (B, M, 3) pose that stands for the polygon.
        kind: (B, M) 0 lane, 1 connector, 2 crosswalk.
        on_route: (B, M) 1 where the polygon is on the route.
        light: (B, M) 0 green, 1 yellow, 2 red, 3 unknown.
        has_limit: (B, M)
        limit: (B, M) speed limit [m/s].
        point_valid: (B, M, K)
        object_pose: (B, S, 3) static objects x [m], y [m], heading [rad].
        object_shape: (B, S, 2) width, length [m].
        object_category: (B, S)
        object_valid: (B, S)
        line_points: (B, R, 120, 2) reference lines [m].
        line_vectors: (B, R, 120, 2) to the next point [m].
        line_orientations: (B, R, 120) [rad].
        line_valid: (B, R, 120)
        counts: How many agents, polygons, static objects and lines each scene has, the rest is
            padding; None where nothing is.
    """

    position: Any
    heading: Any
    velocity: Any
    shape: Any
    valid: Any
    category: Any
    current_state: Any
    points: Any
    vectors: Any
    orientations: Any
    centers: Any
    kind: Any
    on_route: Any
    light: Any
    has_limit: Any
    limit: Any
    point_valid: Any
    object_pose: Any
    object_shape: Any
    object_category: Any
    object_valid: Any
    line_points: Any
    line_vectors: Any
    line_orientations: Any
    line_valid: Any
    counts: Sequence[Sequence[int]] | None = None


def scene_inputs(
    ego: FloatArray,
    agents: AgentFeatures,
    road: RoadFeatures,
    static: StaticObjects,
    lines: LineFeatures,
) -> Inputs:
    """What the network reads.

    Args:
        ego: (11,) ego state.
        agents: The ego and the agents.
        road: Lanes, connectors and crosswalks.
        static: Static objects.
        lines: Reference lines.
    """
    return Inputs(
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


def stack(scenes: Sequence[Inputs], device: str) -> Inputs:
    """A batch; scenes with fewer rows are filled up with zeros."""
    import torch

    out: list[Any] = []
    for arrays in list(zip(*scenes, strict=True))[:-1]:
        batch = np.zeros((len(arrays), *np.max([a.shape for a in arrays], axis=0)), arrays[0].dtype)
        for row, array in zip(batch, arrays, strict=True):
            row[tuple(slice(size) for size in array.shape)] = array
        out.append(torch.from_numpy(batch).to(device))
    parts = ("category", "kind", "object_category", "line_valid")
    counts = [[len(getattr(scene, name)) for scene in scenes] for name in parts]
    return Inputs._make([*out, counts])
