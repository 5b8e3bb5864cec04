"""What PDM-Closed sees, and where it will be: boxes moved along their axes, red lights (§5)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry import boxes_to_corners, convex_intersect, wrap_angles
from shiftsim.planners.pdm_areas import index_ranks
from shiftsim.planners.pdm_parameters import DT, STEPS, PdmParameters
from shiftsim.state import LAST_AGENT_KIND, AgentKind, Tracks

LIGHT = -1  # kind of a red light
LIGHT_TOKEN = "red_light_"
NUM_FORECASTS = STEPS // 2 + 1  # nuPlan: every other time index has its own map (§11 Q4)


class Occupants(NamedTuple):
    """Polygons around the ego at the present, and how they move. M polygons.

    Attributes:
        xy: (V, 2) vertices of all rings, not closed [m].
        ptr: (M + 1,) first vertex of each ring.
        circles: (M, 3) x, y, radius of a circle around each ring [m].
        motion: (M, 2) displacement per second [m/s].
        headings: (M,) of the box; 0 for a red light [rad].
        speeds: (M,) 0 for static objects and red lights [m/s].
        kinds: (M,) AgentKind codes, or LIGHT.
        ignored: (M,) whether the ego has touched it before.
    """

    xy: FloatArray
    ptr: IntArray
    circles: FloatArray
    motion: FloatArray
    headings: FloatArray
    speeds: FloatArray
    kinds: IntArray
    ignored: BoolArray


def select_tracks(
    tracks: Tracks, x: float, y: float, collided: set[str], params: PdmParameters
) -> IntArray:
    """Tracks of the last row that are seen from the ego centre, in nuPlan's order (§5.1, §5.3)."""
    poses = tracks.poses[-1]
    distance = np.hypot(poses[:, 0] - x, poses[:, 1] - y)
    seen = tracks.valid[-1] & ~(distance > params.map_radius)
    if collided:
        seen &= np.array([token not in collided for token in tracks.tokens], np.bool_)
    near = np.flatnonzero(seen)
    kinds = tracks.kinds[near]
    near = near[np.argsort(kinds, kind="stable")]
    kinds = tracks.kinds[near]
    groups = (
        (kinds > LAST_AGENT_KIND, params.max_static),
        (kinds == AgentKind.VEHICLE, params.max_vehicles),
        (kinds == AgentKind.PEDESTRIAN, params.max_pedestrians),
        (kinds == AgentKind.BICYCLE, params.max_bicycles),
    )
    parts = []
    for members, most in groups:
        group = near[members]
        # nuPlan: NumPy's default sort, which is not stable (pdm-closed.md §12)
        parts.append(group[np.argsort(distance[group])[:most]])
    return np.concatenate(parts)


def make_occupants(tracks: Tracks, chosen: IntArray, lights: Sequence[FloatArray]) -> Occupants:
    """Occupants from tracks of the last row and rings (V, 2) of red connectors; none ignored."""
    poses, sizes, kinds = tracks.poses[-1, chosen], tracks.sizes[-1, chosen], tracks.kinds[chosen]
    velocities = tracks.velocities[-1, chosen]
    speeds = np.hypot(velocities[:, 0], velocities[:, 1])
    speeds = np.where(kinds <= LAST_AGENT_KIND, speeds, 0.0)
    # nuPlan: boxes move along their own axis with the full speed (pdm-closed.md §11 Q9)
    course = np.arctan2(velocities[:, 1], velocities[:, 0])
    is_forward = np.abs(wrap_angles(poses[:, 2] - course)) < np.pi / 2.0
    heading = np.where(is_forward, poses[:, 2], poses[:, 2] + np.pi)
    motion = speeds[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1)
    radii = 0.5 * np.hypot(sizes[:, 0], sizes[:, 1])
    boxes = boxes_to_corners(poses, sizes).reshape(-1, 2)
    nothing = np.zeros(len(lights))
    lengths = np.concatenate([[0], np.full(len(chosen), 4), [len(ring) for ring in lights]])
    return Occupants(
        np.concatenate([boxes, *lights]),
        np.cumsum(lengths.astype(np.int64)),
        np.concatenate([np.column_stack([poses[:, :2], radii]), *map(_circle, lights)]),
        np.concatenate([motion, np.zeros((len(lights), 2))]),
        np.concatenate([poses[:, 2], nothing]),
        np.concatenate([speeds, nothing]),
        np.concatenate([kinds, np.full(len(lights), LIGHT)]),
        np.zeros(len(chosen) + len(lights), np.bool_),
    )


def _circle(ring: FloatArray) -> FloatArray:
    middle = 0.5 * (ring.min(axis=0) + ring.max(axis=0))
    radius = np.hypot(ring[:, 0] - middle[0], ring[:, 1] - middle[1]).max()
    return np.array([[middle[0], middle[1], radius]])


def touched(occupants: Occupants, footprint: FloatArray) -> list[int]:
    """Occupants to ignore from now on: those that touch the ego (4, 2), in nuPlan's order (§5.5).

    A red light counts only once the ego is entirely on its connector.
    """
    found = np.empty(len(occupants.kinds), np.int64)
    chosen = found[: _touching(occupants, footprint, found)].tolist()
    lights = np.flatnonzero(occupants.kinds == LIGHT).tolist()
    if lights:
        ego = shapely.Polygon(footprint)
        chosen += [i for i in lights if ego.within(shapely.Polygon(ring_of(occupants, i)))]
    if len(chosen) > 1:
        ranks = forecast_ranks(occupants, 0)
        chosen.sort(key=lambda i: int(ranks[i]))
    return chosen


@kernel
def _touching(occupants: Occupants, footprint: FloatArray, out: IntArray) -> int:
    count = 0
    for index in range(len(occupants.kinds)):
        if occupants.kinds[index] == LIGHT:
            continue
        dx = occupants.circles[index, 0] - footprint[0, 0]
        dy = occupants.circles[index, 1] - footprint[0, 1]
        across = np.hypot(footprint[0, 0] - footprint[2, 0], footprint[0, 1] - footprint[2, 1])
        if np.hypot(dx, dy) > 1.001 * (occupants.circles[index, 2] + across):
            continue
        if convex_intersect(
            occupants.xy[occupants.ptr[index] : occupants.ptr[index + 1]], footprint
        ):
            out[count] = index
            count += 1
    return count


def ring_of(occupants: Occupants, index: int, forecast: int = 0) -> FloatArray:
    """(V, 2) ring of one occupant on a forecast map [m]."""
    ring = occupants.xy[occupants.ptr[index] : occupants.ptr[index + 1]]
    return ring + 2.0 * DT * forecast * occupants.motion[index]


def forecast_ranks(occupants: Occupants, forecast: int) -> IntArray:
    """(M,) place of each occupant among the results of nuPlan's index of one forecast map."""
    starts = occupants.ptr[:-1]
    shift = 2.0 * DT * forecast * occupants.motion
    low = np.minimum.reduceat(occupants.xy, starts) + shift
    high = np.maximum.reduceat(occupants.xy, starts) + shift
    return index_ranks(np.hstack([low, high]))


@kernel
def place_ring(occupants: Occupants, index: int, forecast: int, out: FloatArray) -> int:
    """Write the ring of one occupant on a forecast map into `out`; the number of its vertices."""
    start, stop = occupants.ptr[index], occupants.ptr[index + 1]
    seconds = 0.1 * (2 * forecast)
    for vertex in range(start, stop):
        out[vertex - start, 0] = occupants.xy[vertex, 0] + seconds * occupants.motion[index, 0]
        out[vertex - start, 1] = occupants.xy[vertex, 1] + seconds * occupants.motion[index, 1]
    return stop - start


@kernel
def centroid(ring: FloatArray) -> tuple[float, float]:
    """Centroid of the area of a ring (V, 2) [m].

    nuPlan: triangles from the first vertex, coordinates not reduced first, so that far from the
    origin the last bits are those of its geometry library (pdm-closed.md §11 Q23).
    """
    area = x = y = 0.0
    ox, oy = ring[0]
    for index in range(len(ring)):
        ax, ay = ring[index]
        bx, by = ring[index + 1] if index + 1 < len(ring) else ring[0]
        double = (ax - ox) * (by - oy) - (bx - ox) * (ay - oy)
        x += double * (ox + ax + bx)
        y += double * (oy + ay + by)
        area += double
    return x / 3.0 / area, y / 3.0 / area


@kernel
def widest(occupants: Occupants) -> int:
    """Most vertices of any ring, at least 4."""
    most = 4
    for index in range(len(occupants.kinds)):
        most = max(most, occupants.ptr[index + 1] - occupants.ptr[index])
    return most
