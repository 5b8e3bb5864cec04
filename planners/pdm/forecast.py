"""What PDM-Closed sees, and where it will be: boxes moved along their axes, red lights."""

from typing import NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.boxes import box_corners, circle_around, wrap_angle
from shiftsim.geometry.rings import centroid, ring_bounds
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import index_ranks
from shiftsim.planners.proposals.contacts import Obstacles, touches_box
from shiftsim.planners.proposals.places import EgoBox
from shiftsim.planners.proposals.tracker import STEPS
from shiftsim.planners.routes.lights import RedLights
from shiftsim.world.state import HEADING, LAST_AGENT_KIND, Tracks, X, Y

LIGHT_TOKEN = "red_light_"
_TIED = -1
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
    light_runs: FloatArray  # (R, 4) likewise of runs of edges, as in `RedLights`
    light_run_ptr: IntArray  # (lights + 1,) first run of each


def select_tracks(
    tracks: Tracks, x: float, y: float, collided: set[str], params: PdmParameters
) -> IntArray:
    """Tracks of the last row that are seen from the ego centre, in nuPlan's order."""
    seen, poses, kinds = tracks.valid[-1].copy(), tracks.poses[-1].copy(), tracks.kinds.copy()
    if collided:
        seen &= np.array([token not in collided for token in tracks.tokens], np.bool_)
    most = params.max_static, params.max_vehicles, params.max_pedestrians, params.max_bicycles
    chosen, distance = np.empty(len(seen), np.int64), np.empty(len(seen))
    count = _select(seen, poses, kinds, x, y, params.map_radius, most, distance, chosen)
    if count != _TIED:
        return chosen[:count]
    distance = np.hypot(poses[:, 0] - x, poses[:, 1] - y)
    near = np.flatnonzero(seen & ~(distance > params.map_radius))
    near = near[np.argsort(kinds[near], kind="stable")]
    groups = [near[kinds[near] > LAST_AGENT_KIND]]
    groups += [near[kinds[near] == kind] for kind in range(LAST_AGENT_KIND + 1)]
    # nuPlan rule 189: NumPy's default sort, which is not stable
    return np.concatenate(
        [
            group[np.argsort(distance[group])[:first]]
            for group, first in zip(groups, most, strict=True)
        ]
    )


@kernel
def _select(
    seen: BoolArray,
    poses: FloatArray,
    kinds: IntArray,
    x: float,
    y: float,
    radius: float,
    most: tuple[int, int, int, int],
    distances: FloatArray,  # (N,) scratch
    chosen: IntArray,  # (N,) receives them
) -> int:
    """Select tracks, static ones first; how many, or _TIED where two are equally far."""
    count = 0
    for group in range(len(most)):
        begin = count
        for index in range(len(seen)):
            of = 0 if kinds[index] > LAST_AGENT_KIND else kinds[index] + 1
            if of != group or not seen[index]:
                continue
            distance = np.hypot(poses[index, 0] - x, poses[index, 1] - y)
            if distance > radius:
                continue
            place = count
            while place > begin and distances[place - 1] > distance:
                distances[place], chosen[place] = distances[place - 1], chosen[place - 1]
                place -= 1
            if place > begin and distances[place - 1] == distance:
                return _TIED
            distances[place], chosen[place] = distance, index
            count += 1
        count = min(count, begin + most[group])
    return count


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
    made = Forecast(
        others,
        np.empty(count, np.bool_),
        np.empty(count),
        ignored,
        lights.xy,
        lights.ptr,
        lights.bounds,
        lights.runs,
        lights.run_ptr,
    )
    now = (array[-1].copy() for array in (tracks.poses, tracks.velocities, tracks.sizes))
    _forecast(chosen, tracks.kinds.copy(), *now, made)
    return made


@kernel
def _forecast(
    chosen: IntArray,
    kinds: IntArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
    out: Forecast,
) -> None:
    """Fill in the boxes of all forecast maps."""
    others = out.others
    for index in range(len(chosen)):
        track = chosen[index]
        x, y, heading = poses[track, 0], poses[track, 1], poses[track, 2]
        length, width = sizes[track, 0], sizes[track, 1]
        vx, vy = velocities[track, 0], velocities[track, 1]
        others.is_agent[index] = kinds[track] <= LAST_AGENT_KIND
        speed = np.hypot(vx, vy) if others.is_agent[index] else 0.0
        # nuPlan rule 186: boxes move along their own axis with the full speed
        is_forward = abs(wrap_angle(heading - np.arctan2(vy, vx))) < np.pi / 2.0
        course = heading if is_forward else heading + np.pi
        step_x, step_y = speed * np.cos(course), speed * np.sin(course)
        out.headings[index] = heading
        others.radii[index] = 0.5 * np.hypot(length, width)
        out.moves[index] = step_x != 0.0 or step_y != 0.0
        box = others.boxes[0, index]
        box_corners(x, y, heading, length, width, box)
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


def touched(forecast: Forecast, ego: FloatArray, size: EgoBox) -> list[int]:
    """What to ignore from now on: what touches an ego (11,), in nuPlan's order.

    A red light counts only once the ego is entirely on its connector.
    """
    boxes, found = forecast.others.boxes, np.empty(len(forecast.ignored), np.int64)
    footprint = np.empty((4, 2))
    count = _touched(ego, size, boxes, forecast.light_bounds, footprint, found)
    chosen = [
        index
        for index in found[:count].tolist()
        if index < boxes.shape[1]
        or shapely.Polygon(footprint).within(shapely.Polygon(ring_of(forecast, index)))
    ]
    if len(chosen) > 1:
        ranks = forecast_ranks(forecast, 0)
        chosen.sort(key=lambda i: int(ranks[i]))
    return chosen


@kernel
def _touched(
    ego: FloatArray,
    size: EgoBox,
    boxes: FloatArray,
    light_bounds: FloatArray,
    footprint: FloatArray,  # (4, 2) receives the ego's
    found: IntArray,  # (M,) receives them
) -> int:
    """Find boxes that touch the ego, and lights whose bounds hold it; how many."""
    heading, count = ego[HEADING], 0
    x = ego[X] + size.rear_axle_to_center * np.cos(heading)
    y = ego[Y] + size.rear_axle_to_center * np.sin(heading)
    box_corners(x, y, heading, size.length, size.width, footprint)
    circle = circle_around(footprint)
    for index in range(boxes.shape[1]):
        if touches_box(footprint, circle, boxes[0, index]):
            found[count] = index
            count += 1
    low_x, low_y, high_x, high_y = ring_bounds(footprint)
    for light in range(len(light_bounds)):
        bounds = light_bounds[light]
        if (
            bounds[0] <= low_x
            and bounds[1] <= low_y
            and bounds[2] >= high_x
            and bounds[3] >= high_y
        ):
            found[count] = boxes.shape[1] + light
            count += 1
    return count


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
