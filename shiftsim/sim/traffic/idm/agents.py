"""Who becomes a reactive agent, and where it starts.

Vehicles of the first frame are put on the baseline of the lane or connector they are in; those for
which there is none, or no space, are not simulated.
"""

import numpy as np

from shiftsim.errors import TrafficError
from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.rings import convex_intersect
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.traffic.idm.paths import (
    append_baseline,
    clamp_progress,
    finish_path,
    pose_on_path,
)
from shiftsim.sim.traffic.idm.scene import MAX_ROUTE, Fleet
from shiftsim.world.lanes import Start, find_starts
from shiftsim.world.map import VectorMap

_MIN_VERTICES = 3  # of a baseline: a path of fewer than two cannot be driven, and one is lost


def place_agents(
    map: VectorMap, poses: FloatArray, sizes: FloatArray, taken: FloatArray
) -> list[Start | None]:
    """Starts of vehicles, in order; None for those that cannot be simulated.

    A start whose box touches one of `taken` (M, 4, 2), such as the ego's, or that of an earlier
    agent, is dropped. Vehicles are given by logged centres (N, 3) and sizes (N, 2).

    Raises:
        TrafficError: A vehicle starts on a baseline too short to be a path.
    """
    starts = find_starts(map, poses)
    places = [pose if s is None else s.pose for pose, s in zip(poses, starts, strict=True)]
    corners = boxes_to_corners(np.reshape(places, (-1, 3)), sizes)
    occupied, count = np.concatenate([taken, corners]), np.int64(len(taken))
    out: list[Start | None] = []
    for start, box in zip(starts, corners, strict=True):
        if start is not None and touches_any(box, occupied, count):
            start = None
        if start is not None and len(map.baselines.at(start.edge)) < _MIN_VERTICES:
            raise TrafficError(
                f"map {map.name}: the baseline of {map.edges.ids[start.edge]}, on which a "
                f"vehicle starts, has fewer than {_MIN_VERTICES} vertices",
                hint="nuPlan fails here as well; leave the scenario out, or use other traffic",
            )
        if start is not None:
            occupied[count] = box
            count += 1
        out.append(start)
    return out


@kernel
def touches_any(box: FloatArray, boxes: FloatArray, count: int) -> bool:
    """Whether a box (4, 2) touches one of the first `count` of others (M, 4, 2)."""
    for index in range(count):
        if convex_intersect(box, boxes[index]):
            return True
    return False


def make_fleet(
    map: VectorMap,
    starts: list[Start],
    sizes: FloatArray,  # (A, 2) length, width [m]
    speeds: FloatArray,  # (A,) speed along the path [m/s]
    default_target: float,  # speed on a free road where no speed limit is known yet [m/s]
) -> Fleet:
    """Agents at their starts."""
    count = len(starts)
    longest = max([len(map.baselines.at(start.edge)) for start in starts], default=2)
    fleet = Fleet(
        alive=np.ones(count, np.bool_),
        size=np.ascontiguousarray(sizes, np.float64),
        progress=np.array([start.progress for start in starts], np.float64),
        speed=np.array(speeds, np.float64),
        target=np.zeros(count),
        pose=np.zeros((count, 3)),
        route=np.zeros((count, MAX_ROUTE), np.int64),
        route_size=np.ones(count, np.int64),
        path=np.zeros((count, longest, 4)),
        path_size=np.zeros(count, np.int64),
    )
    target = default_target
    for agent, start in enumerate(starts):
        limit = float(map.speed_limits[start.edge])
        # nuPlan rule 121: an agent without a limit inherits that of the agent before it
        target = limit if np.isfinite(limit) and limit != 0.0 else target
        fleet.target[agent] = target
        fleet.route[agent, 0] = start.edge
        path = fleet.path[agent]
        size = finish_path(path, append_baseline(map.baselines, start.edge, path, 0))
        fleet.path_size[agent] = size
        fleet.pose[agent] = pose_on_path(path, size, clamp_progress(path, size, start.progress))
    return fleet
