"""What PDM-Closed sees, and where it will be: boxes moved along their axes, red lights (§5)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.frames import wrap_angle
from shiftsim.geometry.rings import convex_intersect
from shiftsim.planners.pdm.parameters import STEPS, PdmParameters
from shiftsim.planners.proposals.areas import index_ranks
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, Tracks

LIGHT_TOKEN = "red_light_"
NUM_FORECASTS = STEPS // 2 + 1  # nuPlan: every other time index has its own map (§11 Q4)


class Occupants(NamedTuple):
    """Boxes around the ego on every forecast map, and red lights. B boxes, M = B + lights.

    Attributes:
        boxes: (41, B, 4, 2) corners [m].
        centers: (41, B, 2) centres of the boxes [m].
        radii: (B,) half diagonals [m].
        moves: (B,) whether a box changes from map to map.
        headings: (B,) of the box [rad].
        speeds: (B,) 0 for static objects [m/s].
        kinds: (B,) AgentKind codes.
        ignored: (M,) whether the ego has touched it before.
        light_xy: (V, 2) vertices of the red connectors, not closed [m].
        light_ptr: (lights + 1,) first vertex of each.
    """

    boxes: FloatArray
    centers: FloatArray
    radii: FloatArray
    moves: BoolArray
    headings: FloatArray
    speeds: FloatArray
    kinds: IntArray
    ignored: BoolArray
    light_xy: FloatArray
    light_ptr: IntArray


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
    near = near[np.argsort(tracks.kinds[near], kind="stable")]
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
    kinds = tracks.kinds[chosen]
    count = len(chosen)
    made = Occupants(
        np.empty((NUM_FORECASTS, count, 4, 2)),
        np.empty((NUM_FORECASTS, count, 2)),
        np.empty(count),
        np.empty(count, np.bool_),
        np.empty(count),
        np.empty(count),
        kinds,
        np.zeros(count + len(lights), np.bool_),
        np.concatenate([np.zeros((0, 2)), *lights]),
        np.cumsum([0, *(len(ring) for ring in lights)]),
    )
    _forecast(
        tracks.poses[-1, chosen], tracks.velocities[-1, chosen], tracks.sizes[-1, chosen], made
    )
    return made


@lean_kernel
def _forecast(poses: FloatArray, velocities: FloatArray, sizes: FloatArray, out: Occupants) -> None:
    """Fill in the boxes of all forecast maps."""
    for index in range(len(poses)):
        heading, vx, vy = poses[index, 2], velocities[index, 0], velocities[index, 1]
        speed = np.hypot(vx, vy) if out.kinds[index] <= LAST_AGENT_KIND else 0.0
        # nuPlan: boxes move along their own axis with the full speed (pdm-closed.md §11 Q9)
        is_forward = abs(wrap_angle(heading - np.arctan2(vy, vx))) < np.pi / 2.0
        course = heading if is_forward else heading + np.pi
        step_x, step_y = speed * np.cos(course), speed * np.sin(course)
        out.radii[index] = 0.5 * np.hypot(sizes[index, 0], sizes[index, 1])
        out.moves[index] = step_x != 0.0 or step_y != 0.0
        out.headings[index], out.speeds[index] = heading, speed
        x, y, box = poses[index, 0], poses[index, 1], out.boxes[0, index]
        box_corners(x, y, heading, sizes[index, 0], sizes[index, 1], box)
        for forecast in range(NUM_FORECASTS):
            seconds = 0.1 * (2 * forecast)
            out.centers[forecast, index, 0] = x + seconds * step_x
            out.centers[forecast, index, 1] = y + seconds * step_y
            for corner in range(4):
                out.boxes[forecast, index, corner, 0] = box[corner, 0] + seconds * step_x
                out.boxes[forecast, index, corner, 1] = box[corner, 1] + seconds * step_y


def touched(occupants: Occupants, footprint: FloatArray) -> list[int]:
    """Occupants to ignore from now on: those that touch the ego (4, 2), in nuPlan's order (§5.5).

    A red light counts only once the ego is entirely on its connector.
    """
    chosen = np.flatnonzero(touches_boxes(footprint, occupants.boxes[0])).tolist()
    count = len(occupants.kinds)
    lights = range(count, len(occupants.ignored))
    if lights:
        ego = shapely.Polygon(footprint)
        chosen += [i for i in lights if ego.within(shapely.Polygon(ring_of(occupants, i)))]
    if len(chosen) > 1:
        ranks = forecast_ranks(occupants, 0)
        chosen.sort(key=lambda i: int(ranks[i]))
    return chosen


@kernel
def touches_boxes(footprint: FloatArray, boxes: FloatArray) -> BoolArray:
    """(B,) whether a box (4, 2) touches each of others (B, 4, 2)."""
    out = np.zeros(len(boxes), np.bool_)
    for index in range(len(boxes)):
        dx = boxes[index, 0, 0] + boxes[index, 2, 0] - footprint[0, 0] - footprint[2, 0]
        dy = boxes[index, 0, 1] + boxes[index, 2, 1] - footprint[0, 1] - footprint[2, 1]
        reach = _diagonal(footprint) + _diagonal(boxes[index])
        if dx * dx + dy * dy <= 1.001 * reach * reach:
            out[index] = convex_intersect(boxes[index], footprint)
    return out


@lean_kernel
def _diagonal(box: FloatArray) -> float:
    return np.hypot(box[0, 0] - box[2, 0], box[0, 1] - box[2, 1])


def ring_of(occupants: Occupants, index: int, forecast: int = 0) -> FloatArray:
    """(V, 2) ring of one occupant on a forecast map [m]."""
    count = len(occupants.kinds)
    if index < count:
        return occupants.boxes[forecast, index]
    light = index - count
    return occupants.light_xy[occupants.light_ptr[light] : occupants.light_ptr[light + 1]]


def forecast_ranks(occupants: Occupants, forecast: int) -> IntArray:
    """(M,) place of each occupant among the results of nuPlan's index of one forecast map."""
    boxes = occupants.boxes[forecast]
    bounds = np.hstack([boxes.min(axis=1), boxes.max(axis=1)])
    if len(occupants.light_ptr) > 1:
        starts, xy = occupants.light_ptr[:-1], occupants.light_xy
        lights = np.hstack([np.minimum.reduceat(xy, starts), np.maximum.reduceat(xy, starts)])
        bounds = np.concatenate([bounds, lights])
    return index_ranks(bounds)


@lean_kernel
def centroid(ring: FloatArray) -> tuple[float, float]:
    """Centroid of the area of a ring (V, 2) [m].

    nuPlan: triangles from the first vertex, coordinates not reduced first, so that far from the
    origin the last bits are those of its geometry library (pdm-closed.md §11 Q23).
    """
    area = x = y = 0.0
    ox, oy = ring[0, 0], ring[0, 1]
    for index in range(len(ring)):
        after = index + 1 if index + 1 < len(ring) else 0
        ax, ay, bx, by = ring[index, 0], ring[index, 1], ring[after, 0], ring[after, 1]
        double = (ax - ox) * (by - oy) - (bx - ox) * (ay - oy)
        x += double * (ox + ax + bx)
        y += double * (oy + ay + by)
        area += double
    return x / 3.0 / area, y / 3.0 / area
