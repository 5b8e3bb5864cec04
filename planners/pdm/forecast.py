"""What PDM-Closed sees, and where it will be: boxes moved along their axes, red lights."""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.arrays import BoolArray, FloatArray, IntArray, lean_kernel
from shiftsim.geometry.boxes import box_corners, wrap_angle
from shiftsim.geometry.rings import centroid
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import index_ranks
from shiftsim.planners.proposals.contacts import Others, touches_boxes
from shiftsim.planners.proposals.tracker import STEPS
from shiftsim.planners.routes.lights import RedLights
from shiftsim.world.state import LAST_AGENT_KIND, AgentKind, Tracks

LIGHT_TOKEN = "red_light_"
NUM_FORECASTS = STEPS // 2 + 1  # nuPlan rule 188: every other time index has a map of its own


class Forecast(NamedTuple):
    """Tracks around the ego on every forecast map, and red lights. B boxes, M = B + lights."""

    others: Others  # the boxes on 41 maps; what the ego has touched before is ignored
    moves: BoolArray  # (B,) whether a box changes from map to map
    headings: FloatArray  # (B,) of the box [rad]
    # (M,) whether the ego has touched it before; the first B are those of `others`
    ignored: BoolArray
    light_xy: FloatArray  # (V, 2) vertices of the red connectors, not closed [m]
    light_ptr: IntArray  # (lights + 1,) first vertex of each
    light_bounds: FloatArray  # (lights, 4) min x, min y, max x, max y of each [m]


def select_tracks(
    tracks: Tracks, x: float, y: float, collided: set[str], params: PdmParameters
) -> IntArray:
    """Tracks of the last row that are seen from the ego centre, in nuPlan's order."""
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
        # nuPlan rule 189: NumPy's default sort, which is not stable
        parts.append(group[np.argsort(distance[group])[:most]])
    return np.concatenate(parts)


def make_forecast(tracks: Tracks, chosen: IntArray, lights: RedLights) -> Forecast:
    """From tracks of the last row and red lights; none ignored."""
    count = len(chosen)
    shape = (NUM_FORECASTS, count)
    ignored = np.zeros(count + len(lights.bounds), np.bool_)
    is_agent = tracks.kinds[chosen] <= LAST_AGENT_KIND
    others = Others(
        boxes=np.empty((*shape, 4, 2)),
        centers=np.empty((*shape, 2)),
        centroids=np.empty((*shape, 2)),
        speeds=np.empty(shape),
        radii=np.empty(count),
        is_agent=is_agent,
        ignored=ignored[:count],
    )
    poses = tracks.poses[-1, chosen]
    made = Forecast(
        others,
        np.empty(count, np.bool_),
        np.ascontiguousarray(poses[:, 2]),
        ignored,
        lights.xy,
        lights.ptr,
        lights.bounds,
    )
    _forecast(poses, tracks.velocities[-1, chosen], tracks.sizes[-1, chosen], made)
    return made


@lean_kernel
def _forecast(poses: FloatArray, velocities: FloatArray, sizes: FloatArray, out: Forecast) -> None:
    """Fill in the boxes of all forecast maps."""
    others = out.others
    for index in range(len(poses)):
        heading, vx, vy = poses[index, 2], velocities[index, 0], velocities[index, 1]
        speed = np.hypot(vx, vy) if others.is_agent[index] else 0.0
        # nuPlan rule 186: boxes move along their own axis with the full speed
        is_forward = abs(wrap_angle(heading - np.arctan2(vy, vx))) < np.pi / 2.0
        course = heading if is_forward else heading + np.pi
        step_x, step_y = speed * np.cos(course), speed * np.sin(course)
        others.radii[index] = 0.5 * np.hypot(sizes[index, 0], sizes[index, 1])
        out.moves[index] = step_x != 0.0 or step_y != 0.0
        x, y, box = poses[index, 0], poses[index, 1], others.boxes[0, index]
        box_corners(x, y, heading, sizes[index, 0], sizes[index, 1], box)
        for forecast in range(NUM_FORECASTS):
            seconds = 0.1 * (2 * forecast)
            others.speeds[forecast, index] = speed
            others.centers[forecast, index, 0] = x + seconds * step_x
            others.centers[forecast, index, 1] = y + seconds * step_y
            ring = others.boxes[forecast, index]
            for corner in range(4):
                ring[corner, 0] = box[corner, 0] + seconds * step_x
                ring[corner, 1] = box[corner, 1] + seconds * step_y
            # nuPlan rule 187: bearings and progress are those of the ring's centroid
            if forecast == 0 or out.moves[index]:
                middle = centroid(ring)
            others.centroids[forecast, index, 0] = middle[0]
            others.centroids[forecast, index, 1] = middle[1]


def touched(forecast: Forecast, footprint: FloatArray) -> list[int]:
    """What to ignore from now on: what touches the ego (4, 2), in nuPlan's order.

    A red light counts only once the ego is entirely on its connector.
    """
    boxes = forecast.others.boxes[0]
    chosen = np.flatnonzero(touches_boxes(footprint, boxes)).tolist()
    low, high, bounds = footprint.min(axis=0), footprint.max(axis=0), forecast.light_bounds
    around = (bounds[:, :2] <= low).all(axis=1) & (bounds[:, 2:] >= high).all(axis=1)
    for index in (np.flatnonzero(around) + len(boxes)).tolist():
        if shapely.Polygon(footprint).within(shapely.Polygon(ring_of(forecast, index))):
            chosen.append(index)
    if len(chosen) > 1:
        ranks = forecast_ranks(forecast, 0)
        chosen.sort(key=lambda i: int(ranks[i]))
    return chosen


def ring_of(forecast: Forecast, index: int, row: int = 0) -> FloatArray:
    """(V, 2) ring of one of the boxes or lights on a forecast map [m]."""
    boxes = forecast.others.boxes[row]
    if index < len(boxes):
        return boxes[index]
    light = index - len(boxes)
    return forecast.light_xy[forecast.light_ptr[light] : forecast.light_ptr[light + 1]]


def forecast_ranks(forecast: Forecast, row: int) -> IntArray:
    """(M,) place of each box and light among the results of nuPlan's index of a forecast map."""
    boxes = forecast.others.boxes[row]
    bounds = np.hstack([boxes.min(axis=1), boxes.max(axis=1)])
    return index_ranks(np.concatenate([bounds, forecast.light_bounds]))
