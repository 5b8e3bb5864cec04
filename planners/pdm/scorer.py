"""Scores of PDM-Closed's proposals, on their driven states (pdm-closed.md §8).

Array axes: P proposals, T = 41 time indices, M occupants.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.rings import EXTERIOR, convex_intersect, locate_in_ring, segments_intersect
from shiftsim.planners.pdm.forecast import Occupants, centroid
from shiftsim.planners.pdm.parameters import (
    EGO_STOPPED,
    TRACK_STOPPED,
    TTC_STOPPED,
    PdmParameters,
)
from shiftsim.planners.pdm.path import PdmPath, project
from shiftsim.planners.proposals.areas import Areas, cover_poses, near_areas, on_multiple_lanes
from shiftsim.planners.proposals.comfort import Filters, comfort
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.state import HEADING, LAST_AGENT_KIND, VX, VY, VehicleParameters, X, Y

TTC_STEPS = (0, 3, 6, 9)  # how far ahead a pose is projected
BEHIND, AHEAD = np.deg2rad(150.0), np.deg2rad(30.0)  # rad, bearings from the rear axle
NEVER = np.inf
MIN_PROGRESS = 0.1  # m, of the best proposal; below it progress is not compared


class Scores(NamedTuple):
    """Scores of P proposals.

    Attributes:
        total: (P,) the score.
        no_collision: (P,) factor: 0, 0.5 or 1.
        drivable: (P,) factor: 0 or 1.
        direction: (P,) factor: 0, 0.5 or 1.
        progress: (P,) in [0, 1].
        ttc: (P,) 0 or 1.
        comfort: (P,) 0 or 1.
        raw_progress: (P,) along the centerline, before factors [m].
        collision_index: (P,) first time index of an at-fault collision, inf if none.
        ttc_index: (P,) first time index of a violation, inf if none.
        off_road: (P, T) whether a corner is on no drivable area.
        oncoming: (P, T) whether the centre is on no lane of the route.
    """

    total: FloatArray
    no_collision: FloatArray
    drivable: FloatArray
    direction: FloatArray
    progress: FloatArray
    ttc: FloatArray
    comfort: FloatArray
    raw_progress: FloatArray
    collision_index: FloatArray
    ttc_index: FloatArray
    off_road: BoolArray
    oncoming: BoolArray


class Road(NamedTuple):
    """The map as the scorer sees it.

    Attributes:
        areas: Lanes, connectors and car parks.
        admitted: Those of this step.
        intersections: Areas where what is beside the ego counts as well.
        centerline: Progress is measured along it.
    """

    areas: Areas
    admitted: IntArray
    intersections: Polygons
    centerline: PdmPath


def score(
    states: FloatArray,
    road: Road,
    occupants: Occupants,
    vehicle: VehicleParameters,
    params: PdmParameters,
    filters: Filters,
) -> Scores:
    """Score P proposals by their driven states (P, T, 11)."""
    count, steps = states.shape[:2]
    corners, centers = np.empty((count, steps, 4, 2)), np.empty((count, steps, 2))
    size = (vehicle.length, vehicle.width, vehicle.rear_axle_to_center)
    place_ego(states, size, corners, centers)
    lanes = near_areas(road.areas, road.admitted, corners)
    off_road, oncoming = np.empty((count, steps), np.bool_), np.empty((count, steps), np.bool_)
    cover_poses(road.areas, lanes, corners, centers, off_road, oncoming)
    near = _near(states, centers, occupants, size)
    no_collision, collision_index = np.empty(count), np.empty(count)
    place = (road.areas, lanes, off_road)
    _collisions(states, corners, *place, occupants, near, no_collision, collision_index)
    ttc, ttc_index = np.empty(count), np.empty(count)
    _times_to_collision(
        states, corners, *place, occupants, near, road.intersections, ttc, ttc_index
    )
    raw, stray = np.empty(count), np.empty(count)
    _travel(centers, oncoming, road.centerline, raw, stray)
    signals, bounded = np.empty((count, 6, steps)), np.empty((count, 6), np.bool_)
    comfort(states, filters, params.comfort, signals, bounded)
    low, high = params.direction_limits
    direction = np.where(stray < low, 1.0, np.where(stray < high, 0.5, 0.0))
    drivable = np.where(off_road.any(axis=1), 0.0, 1.0)
    factor = no_collision * drivable * direction
    progress = normalise(raw, factor)
    comfortable = np.where(bounded.all(axis=1), 1.0, 0.0)
    return Scores(
        factor * weigh(progress, ttc, comfortable, params),
        no_collision,
        drivable,
        direction,
        progress,
        ttc,
        comfortable,
        raw,
        collision_index,
        ttc_index,
        off_road,
        oncoming,
    )


def weigh(
    progress: FloatArray, ttc: FloatArray, comfortable: FloatArray, params: PdmParameters
) -> FloatArray:
    """(P,) weighted mean of what is not a factor."""
    weights = (params.progress_weight, params.ttc_weight, params.comfort_weight)
    mean: FloatArray = weights[0] * progress + weights[1] * ttc + weights[2] * comfortable
    return mean / sum(weights)


def normalise(raw: FloatArray, factor: FloatArray) -> FloatArray:
    """(P,) progress in [0, 1] from metres and the product of the factors (§8.5)."""
    # nuPlan: a factor shortens the progress first and scales the score again (§11 Q12)
    valid = raw * factor
    most = float(valid.max())
    if most > MIN_PROGRESS:
        return valid / most
    return np.where(factor > 0.0, 1.0, 0.0)


@lean_kernel
def place_ego(
    states: FloatArray, size: tuple[float, float, float], corners: FloatArray, centers: FloatArray
) -> None:
    """Write corners (P, T, 4, 2) and centres (P, T, 2) of driven states (P, T, 11) [m].

    `size` is length, width, rear axle to centre.
    """
    for row in range(states.shape[0]):
        for step in range(states.shape[1]):
            heading = states[row, step, HEADING]
            x = states[row, step, X] + size[2] * np.cos(heading)
            y = states[row, step, Y] + size[2] * np.sin(heading)
            centers[row, step, 0], centers[row, step, 1] = x, y
            box_corners(x, y, heading, size[0], size[1], corners[row, step])


@lean_kernel
def bearing(state: FloatArray, x: float, y: float) -> float:
    """Angle between the heading and the direction from the rear axle to a point, in [0, pi].

    nuPlan: the cosine is not clamped, so an object exactly ahead or behind may have the bearing
    NaN, and every comparison with it is false (pdm-closed.md §11 Q23).
    """
    dx, dy = x - state[X], y - state[Y]
    distance = np.sqrt(dx * dx + dy * dy)
    along = np.cos(state[HEADING]) * (dx / distance) + np.sin(state[HEADING]) * (dy / distance)
    return np.arccos(along)


@kernel
def _near(
    states: FloatArray, centers: FloatArray, occupants: Occupants, size: tuple[float, float, float]
) -> IntArray:
    """Boxes that can touch any ego box, or its projection, at any time index."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for row in range(centers.shape[0]):
        for step in range(centers.shape[1]):
            reach = 0.5 * (size[0] + size[1])
            reach += 0.1 * TTC_STEPS[-1] * np.hypot(states[row, step, VX], states[row, step, VY])
            x, y = centers[row, step, 0], centers[row, step, 1]
            low_x, high_x = min(low_x, x - reach), max(high_x, x + reach)
            low_y, high_y = min(low_y, y - reach), max(high_y, y + reach)
    last = (centers.shape[1] - 1 + TTC_STEPS[-1]) // 2
    out = np.empty(len(occupants.radii), np.int64)
    count = 0
    for index in range(len(out)):
        start, end = occupants.centers[0, index], occupants.centers[last, index]
        radius = occupants.radii[index]
        if (
            not occupants.ignored[index]
            and min(start[0], end[0]) - radius <= high_x
            and max(start[0], end[0]) + radius >= low_x
            and min(start[1], end[1]) - radius <= high_y
            and max(start[1], end[1]) + radius >= low_y
        ):
            out[count] = index
            count += 1
    return out[:count]


@lean_kernel
def _front_touches(corners: FloatArray, ring: FloatArray) -> bool:
    """Whether the front bumper of a box (4, 2) touches the area of a convex ring (4, 2)."""
    if locate_in_ring(ring, corners[0, 0], corners[0, 1]) != EXTERIOR:
        return True
    for index in range(4):
        if segments_intersect(corners[0], corners[3], ring[index - 1], ring[index]):
            return True
    return False


@kernel
def _collisions(
    states: FloatArray,
    corners: FloatArray,
    areas: Areas,
    lanes: IntArray,
    off_road: BoolArray,
    occupants: Occupants,
    near: IntArray,
    scores: FloatArray,
    first: FloatArray,
) -> None:
    """At-fault collisions (§8.2): factors and first time indices (P,), into the last two."""
    boxes, centers, radii = occupants.boxes, occupants.centers, occupants.radii
    kinds, speeds = occupants.kinds, occupants.speeds
    forgiven = np.empty(len(near), np.bool_)
    for row in range(states.shape[0]):
        scores[row], first[row] = 1.0, NEVER
        for entry in range(len(near)):
            forgiven[entry] = False
        for step in range(states.shape[1]):
            box, state, forecast = corners[row, step], states[row, step], step // 2
            x, y, radius = _circle_of(box)
            for entry in range(len(near)):
                index = near[entry]
                dx, dy = centers[forecast, index, 0] - x, centers[forecast, index, 1] - y
                reach = radius + radii[index]
                if forgiven[entry] or dx * dx + dy * dy > reach * reach:
                    continue
                ring = boxes[forecast, index]
                if not convex_intersect(box, ring):
                    continue
                is_agent = kinds[index] <= LAST_AGENT_KIND
                is_stopped = not is_agent or speeds[index] <= TRACK_STOPPED
                is_off = off_road[row, step]
                if _is_at_fault(state, box, ring, is_stopped, is_off, areas, lanes):
                    scores[row] = min(scores[row], 0.0 if is_agent else 0.5)
                    first[row] = min(first[row], float(step))
                else:
                    forgiven[entry] = True


@lean_kernel
def _circle_of(box: FloatArray) -> tuple[float, float, float]:
    """Centre and radius of a circle around a box (4, 2), a little larger than it [m]."""
    x, y = 0.5 * (box[0, 0] + box[2, 0]), 0.5 * (box[0, 1] + box[2, 1])
    return x, y, np.hypot(box[0, 0] - x, box[0, 1] - y) + 1e-6


@lean_kernel
def _is_at_fault(
    state: FloatArray,
    box: FloatArray,
    ring: FloatArray,
    is_stopped: bool,
    is_off: bool,
    areas: Areas,
    lanes: IntArray,
) -> bool:
    """Whether the ego causes a collision; `is_stopped` is the other, `is_off` the ego's place."""
    if np.hypot(state[VX], state[VY]) <= EGO_STOPPED:
        return False
    if is_stopped:
        return True
    x, y = centroid(ring)
    if bearing(state, x, y) > BEHIND:
        return False
    return _front_touches(box, ring) or is_off or on_multiple_lanes(areas, lanes, box)


@kernel
def _times_to_collision(
    states: FloatArray,
    corners: FloatArray,
    areas: Areas,
    lanes: IntArray,
    off_road: BoolArray,
    occupants: Occupants,
    near: IntArray,
    intersections: Polygons,
    scores: FloatArray,
    first: FloatArray,
) -> None:
    """Time to collision (§8.6): scores and first time indices (P,), into the last two."""
    boxes, centers, radii = occupants.boxes, occupants.centers, occupants.radii
    box = np.empty((4, 2))
    forgiven = np.empty(len(near), np.bool_)
    for row in range(states.shape[0]):
        scores[row], first[row] = 1.0, NEVER
        for entry in range(len(near)):
            forgiven[entry] = False
        for step in range(states.shape[1]):
            state = states[row, step]
            speed = np.hypot(state[VX], state[VY])
            if speed < TTC_STOPPED:
                continue
            cos, sin = np.cos(state[HEADING]), np.sin(state[HEADING])
            here = corners[row, step]
            for ahead in TTC_STEPS:
                travel = 0.1 * ahead * speed
                for corner in range(4):
                    box[corner, 0] = here[corner, 0] + travel * cos
                    box[corner, 1] = here[corner, 1] + travel * sin
                forecast = (step + ahead) // 2
                x, y, radius = _circle_of(box)
                for entry in range(len(near)):
                    index = near[entry]
                    dx, dy = centers[forecast, index, 0] - x, centers[forecast, index, 1] - y
                    reach = radius + radii[index]
                    if forgiven[entry] or dx * dx + dy * dy > reach * reach:
                        continue
                    ring = boxes[forecast, index]
                    if not convex_intersect(box, ring):
                        continue
                    centroid_x, centroid_y = centroid(ring)
                    angle = bearing(state, centroid_x, centroid_y)
                    if angle < AHEAD or (
                        not angle > BEHIND
                        and (
                            off_road[row, step]
                            or in_any(intersections, state[X], state[Y])
                            or on_multiple_lanes(areas, lanes, here)
                        )
                    ):
                        scores[row] = 0.0
                        first[row] = min(first[row], float(step))
                    else:
                        forgiven[entry] = True
            if scores[row] == 0.0:
                break


@lean_kernel
def _travel(
    centers: FloatArray,
    oncoming: BoolArray,
    centerline: PdmPath,
    progress: FloatArray,
    stray: FloatArray,
) -> None:
    """Progress along the centerline (§8.5) and longest way off the route (§8.3), both (P,) [m]."""
    last = centers.shape[1] - 1
    for row in range(len(centers)):
        start = project(centerline, centers[row, 0, 0], centers[row, 0, 1], 0)
        end = project(centerline, centers[row, last, 0], centers[row, last, 1], start[2])
        progress[row] = max(0.0, end[0] - start[0])
        longest = stretch = 0.0
        for step in range(last + 1):
            if not oncoming[row, step]:
                stretch = 0.0
            elif step > 0:
                dx = centers[row, step, 0] - centers[row, step - 1, 0]
                dy = centers[row, step, 1] - centers[row, step - 1, 1]
                stretch += np.hypot(dx, dy)
            longest = max(longest, stretch)
        stray[row] = longest
