"""Scores of PDM-Closed's proposals, on their driven states.

Array axes: P proposals, T = 41 time indices, N others.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import AHEAD, BEHIND, bearing, circle_around
from shiftsim.geometry.paths import Path, project
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import (
    MULTIPLE,
    OFF_ROAD,
    OFF_ROUTE,
    Areas,
    find_places,
    near_areas,
)
from shiftsim.planners.proposals.comfort import comfort
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    EgoBox,
    Others,
    first_faults,
    hits,
    near_others,
    place_ego,
    project_box,
)
from shiftsim.planners.proposals.tracker import DT
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.state import VX, VY, X, Y

TTC_STEPS = (0, 3, 6, 9)  # how far ahead a pose is projected
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
        flags: (P, T, 3) whether the ego is on several lanes, off the road, off the route.
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
    flags: BoolArray


class Place(NamedTuple):
    """The map as the scorer sees it.

    Attributes:
        areas: Lanes, connectors and car parks.
        selected: Those of this step.
        intersections: Areas where what is beside the ego counts as well.
        centerline: Progress is measured along it.
    """

    areas: Areas
    selected: IntArray
    intersections: Polygons
    centerline: Path


def score(
    states: FloatArray, place: Place, others: Others, size: EgoBox, params: PdmParameters
) -> Scores:
    """Score P proposals by their driven states (P, T, 11)."""
    count, steps = states.shape[:2]
    corners, centers = np.empty((count, steps, 4, 2)), np.empty((count, steps, 2))
    place_ego(states, size, corners, centers)
    flags, limits = np.empty((count, steps, 3), np.bool_), np.zeros(len(place.areas.edge))
    lanes = near_areas(place.areas, place.selected, corners)
    find_places(place.areas, lanes, limits, corners, centers, flags, np.empty((count, steps)))
    off_lane = flags[..., MULTIPLE] | flags[..., OFF_ROAD]
    rows = np.arange(steps) // 2
    seen = (steps - 1 + TTC_STEPS[-1]) // 2 + 1  # forecast maps that are looked at
    near = near_others(states, corners, others, seen, DT * TTC_STEPS[-1])
    no_collision, collision_index = np.empty(count), np.empty(count)
    # nuPlan rule 195: what is not at fault when it is first touched is not looked at again
    first_faults(states, corners, off_lane, others, near, rows, True, no_collision, collision_index)
    ttc_index = np.empty(count)
    _first_violations(states, corners, off_lane, others, near, place.intersections, ttc_index)
    raw, off_route = np.empty(count), np.empty(count)
    _travel(centers, flags[..., OFF_ROUTE].copy(), place.centerline, raw, off_route)
    low, high = params.direction_limits
    direction = np.where(off_route < low, 1.0, np.where(off_route < high, 0.5, 0.0))
    drivable = np.where(flags[..., OFF_ROAD].any(axis=1), 0.0, 1.0)
    factor = no_collision * drivable * direction
    progress = normalise(raw, factor)
    ttc = np.where(np.isfinite(ttc_index), 0.0, 1.0)
    comfortable = np.where(comfort(states, params.comfort).is_within.all(axis=1), 1.0, 0.0)
    return Scores(
        total=factor * weigh(progress, ttc, comfortable, params),
        no_collision=no_collision,
        drivable=drivable,
        direction=direction,
        progress=progress,
        ttc=ttc,
        comfort=comfortable,
        raw_progress=raw,
        collision_index=collision_index,
        ttc_index=ttc_index,
        flags=flags,
    )


def weigh(
    progress: FloatArray, ttc: FloatArray, comfortable: FloatArray, params: PdmParameters
) -> FloatArray:
    """(P,) weighted mean of what is not a factor."""
    weights = (params.progress_weight, params.ttc_weight, params.comfort_weight)
    mean: FloatArray = weights[0] * progress + weights[1] * ttc + weights[2] * comfortable
    return mean / sum(weights)


def normalise(raw: FloatArray, factor: FloatArray) -> FloatArray:
    """(P,) progress in [0, 1] from metres and the product of the factors."""
    # nuPlan rule 196: a factor shortens the progress first and scales the score again
    valid = raw * factor
    most = float(valid.max())
    if most > MIN_PROGRESS:
        return valid / most
    return np.where(factor > 0.0, 1.0, 0.0)


@kernel
def _first_violations(
    states: FloatArray,
    corners: FloatArray,
    off_lane: BoolArray,
    others: Others,
    near: IntArray,
    intersections: Polygons,
    first: FloatArray,
) -> None:
    """First time indices (P,) at which the time to collision is too short, inf if none."""
    box = np.empty((4, 2))
    forgiven = np.empty(len(near), np.bool_)
    for proposal in range(states.shape[0]):
        first[proposal] = NEVER
        for entry in range(len(near)):
            forgiven[entry] = False
        for step in range(states.shape[1]):
            state = states[proposal, step]
            speed = np.hypot(state[VX], state[VY])
            if speed < TTC_STOPPED:
                continue
            for ahead in TTC_STEPS:
                project_box(corners[proposal, step], state, 0.1 * ahead * speed, box)
                row, circle = (step + ahead) // 2, circle_around(box)
                for entry in range(len(near)):
                    index = near[entry]
                    if forgiven[entry] or not hits(others, row, index, box, circle):
                        continue
                    middle = others.centroids[row, index]
                    angle = bearing(state, middle[0], middle[1])
                    if angle < AHEAD or (
                        not angle > BEHIND
                        and (off_lane[proposal, step] or in_any(intersections, state[X], state[Y]))
                    ):
                        first[proposal] = min(first[proposal], float(step))
                    else:
                        forgiven[entry] = True
            if first[proposal] < NEVER:
                break


@lean_kernel
def _travel(
    centers: FloatArray,
    oncoming: BoolArray,
    centerline: Path,
    progress: FloatArray,
    off_route: FloatArray,
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
        off_route[row] = longest
