"""What PDM-Closed sees, and where it will be: boxes moved along their axes, red lights."""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.boxes import box_corners, wrap_angle
from shiftsim.geometry.rings import centroid
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import index_ranks
from shiftsim.planners.proposals.contacts import Obstacles, touches_boxes
from shiftsim.planners.proposals.places import EgoBox, ego_corners
from shiftsim.planners.proposals.tracker import STEPS
from shiftsim.planners.routes.lead import RedLights
from shiftsim.world.state import HEADING, LAST_AGENT_KIND, TrackArrays, Tracks, X, Y

LIGHT_TOKEN = "red_light_"
NUM_FORECASTS = STEPS // 2 + 1  # nuPlan rule 188: every other time index has a map of its own


class Forecast(NamedTuple):
    """Tracks around the ego on every forecast map, and red lights. B boxes, M = B + lights."""

    others: Obstacles  # the boxes on 41 maps; what the ego has touched before is ignored
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
    poses, kinds = tracks.poses[-1], tracks.kinds
    distance = np.hypot(poses[:, 0] - x, poses[:, 1] - y)
    near = np.flatnonzero(tracks.valid[-1] & ~(distance > params.map_radius))
    if collided:
        near = near[[tracks.tokens[i] not in collided for i in near.tolist()]]
    near = near[np.argsort(kinds[near], kind="stable")]
    groups = [near[kinds[near] > LAST_AGENT_KIND]]
    groups += [near[kinds[near] == kind] for kind in range(LAST_AGENT_KIND + 1)]
    most = params.max_static, params.max_vehicles, params.max_pedestrians, params.max_bicycles
    # nuPlan rule 189: NumPy's default sort, which is not stable
    return np.concatenate(
        [
            group[np.argsort(distance[group])[:first]]
            for group, first in zip(groups, most, strict=True)
        ]
    )


def make_forecast(tracks: Tracks, chosen: IntArray, lights: RedLights) -> Forecast:
    """From tracks of the last row and red lights; none ignored."""
    count = len(chosen)
    shape = (NUM_FORECASTS, count)
    ignored = np.zeros(count + len(lights.bounds), np.bool_)
    others = Obstacles(
        boxes=np.empty((*shape, 4, 2)),
        centers=np.empty((*shape, 2)),
        centroids=np.empty((*shape, 2)),
        speeds=np.empty(shape),
        radii=np.empty(count),
        is_agent=np.empty(count, np.bool_),
        ignored=ignored[:count],
    )
    moves, headings = np.empty(count, np.bool_), np.empty(count)
    known = lights.xy, lights.ptr, lights.bounds
    forecast = Forecast(others, moves, headings, ignored, *known)
    now = tracks.map_arrays(lambda array: array[-1].copy()).arrays
    _forecast(chosen, tracks.kinds.copy(), now, forecast)
    return forecast


@kernel
def _forecast(chosen: IntArray, kinds: IntArray, now: TrackArrays, out: Forecast) -> None:
    """Fill in the boxes of all forecast maps."""
    _, poses, velocities, sizes = now
    boxes, centers, centroids = out.others.boxes, out.others.centers, out.others.centroids
    speeds, radii, is_agent = out.others.speeds, out.others.radii, out.others.is_agent
    headings, moves, box, ring = out.headings, out.moves, np.empty((4, 2)), np.empty((4, 2))
    for index in range(len(chosen)):
        track = chosen[index]
        x, y, heading = poses[track, 0], poses[track, 1], poses[track, 2]
        length, width = sizes[track, 0], sizes[track, 1]
        vx, vy = velocities[track, 0], velocities[track, 1]
        is_agent[index] = kinds[track] <= LAST_AGENT_KIND
        speed = np.hypot(vx, vy) if is_agent[index] else 0.0
        # nuPlan rule 186: boxes move along their own axis with the full speed
        is_forward = abs(wrap_angle(heading - np.arctan2(vy, vx))) < np.pi / 2.0
        course = heading if is_forward else heading + np.pi
        step_x, step_y = speed * np.cos(course), speed * np.sin(course)
        headings[index] = heading
        radii[index] = 0.5 * np.hypot(length, width)
        moves[index] = step_x != 0.0 or step_y != 0.0
        box_corners(x, y, heading, length, width, box)
        for forecast in range(NUM_FORECASTS):
            seconds = 0.1 * (2 * forecast)
            speeds[forecast, index] = speed
            centers[forecast, index, 0] = x + seconds * step_x
            centers[forecast, index, 1] = y + seconds * step_y
            for corner in range(4):
                ring[corner, 0] = box[corner, 0] + seconds * step_x
                ring[corner, 1] = box[corner, 1] + seconds * step_y
                boxes[forecast, index, corner, 0] = ring[corner, 0]
                boxes[forecast, index, corner, 1] = ring[corner, 1]
            # nuPlan rule 187: bearings and progress are those of the ring's centroid
            if forecast == 0 or moves[index]:
                middle_x, middle_y = centroid(ring)
            centroids[forecast, index, 0] = middle_x
            centroids[forecast, index, 1] = middle_y


def touched(forecast: Forecast, ego: FloatArray, size: EgoBox) -> list[int]:
    """What to ignore from now on: what touches an ego (11,), in nuPlan's order.

    A red light counts only once the ego is entirely on its connector.
    """
    boxes, bounds, footprint = forecast.others.boxes[0], forecast.light_bounds, np.empty((4, 2))
    ego_corners(ego[X], ego[Y], ego[HEADING], size, footprint)
    found = np.flatnonzero(touches_boxes(footprint, boxes)).tolist()
    low, high = footprint.min(axis=0), footprint.max(axis=0)
    holds = (bounds[:, :2] <= low).all(axis=1) & (bounds[:, 2:] >= high).all(axis=1)
    for index in (len(boxes) + np.flatnonzero(holds)).tolist():
        if shapely.Polygon(footprint).within(shapely.Polygon(ring_of(forecast, index))):
            found.append(index)
    if len(found) > 1:
        found.sort(key=forecast_ranks(forecast, 0).__getitem__)
    return found


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
