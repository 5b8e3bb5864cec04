"""Scores of PDM-Closed's proposals, on their driven states.

Array axes: P proposals, T = 41 time indices, N others.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry.boxes import AHEAD, BEHIND, bearing, circle_around
from shiftsim.geometry.polylines import Path, project
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import Areas
from shiftsim.planners.proposals.comfort import comfort
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Others,
    first_faults,
    hits,
    near_others,
    project_box,
)
from shiftsim.planners.proposals.places import OFF_ROAD, OFF_ROUTE, EgoBox, Places, find_places
from shiftsim.planners.proposals.tracker import DT
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.state import VX, VY, X, Y

TTC_STEPS = (0, 3, 6, 9)  # how far ahead a pose is projected
MIN_PROGRESS = 0.1  # m, of the best proposal; below it progress is not compared


class Scores(NamedTuple):
    """Scores of P proposals."""

    total: FloatArray  # (P,) the score
    no_collision: FloatArray  # (P,) factor: 0, 0.5 or 1
    drivable: FloatArray  # (P,) factor: 0 or 1
    direction: FloatArray  # (P,) factor: 0, 0.5 or 1
    progress: FloatArray  # (P,) in [0, 1]
    ttc: FloatArray  # (P,) 0 or 1
    comfort: FloatArray  # (P,) 0 or 1
    raw_progress: FloatArray  # (P,) along the centerline, before factors [m]
    collision_index: FloatArray  # (P,) first time index of an at-fault collision, inf if none
    ttc_index: FloatArray  # (P,) first time index of a violation, inf if none
    flags: BoolArray  # (P, T, 3) whether the ego is on several lanes, off the road, off the route


class Place(NamedTuple):
    """The map as the scorer sees it."""

    areas: Areas  # lanes, connectors and car parks
    selected: IntArray  # those of this step
    intersections: Polygons  # areas where what is beside the ego counts as well
    centerline: Path  # progress is measured along it


def score(
    states: FloatArray, place: Place, others: Others, size: EgoBox, params: PdmParameters
) -> Scores:
    """Score P proposals by their driven states (P, T, 11)."""
    no_limits = np.zeros(len(place.areas.lane))
    at = find_places(states, size, place.areas, place.selected, no_limits, by_center=True)
    rows = np.arange(states.shape[1]) // 2
    seen = (rows[-1] * 2 + TTC_STEPS[-1]) // 2 + 1  # forecast maps that are looked at
    near = near_others(at, others, seen, DT * TTC_STEPS[-1])
    # nuPlan rule 195: what is not at fault when it is first touched is not looked at again
    no_collision, collision_index = first_faults(at, others, near, rows, True)
    ttc_index = _first_violations(at, others, near, place.intersections)
    raw, off_route = _travel(at, place.centerline)
    low, high = params.direction_limits
    direction = np.where(off_route < low, 1.0, np.where(off_route < high, 0.5, 0.0))
    drivable = np.where(at.flags[..., OFF_ROAD].any(axis=1), 0.0, 1.0)
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
        flags=at.flags,
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
    places: Places, others: Others, near: IntArray, intersections: Polygons
) -> FloatArray:
    """First time indices (P,) at which the time to collision is too short, inf if none."""
    first = np.full(len(places.states), NEVER)
    box, forgiven = np.empty((4, 2)), np.empty(len(near), np.bool_)
    for proposal in range(len(first)):
        for entry in range(len(near)):
            forgiven[entry] = False
        for step in range(places.states.shape[1]):
            state, off_lane = places.states[proposal, step], places.off_lane[proposal, step]
            speed = np.hypot(state[VX], state[VY])
            if speed < TTC_STOPPED:
                continue
            for ahead in TTC_STEPS:
                project_box(places.corners[proposal, step], state, 0.1 * ahead * speed, box)
                row, circle = (step + ahead) // 2, circle_around(box)
                for entry in range(len(near)):
                    index = near[entry]
                    if forgiven[entry] or not hits(others, row, index, box, circle):
                        continue
                    middle = others.centroids[row, index]
                    angle = bearing(state, middle[0], middle[1])
                    counts = angle < AHEAD
                    if not counts and not angle > BEHIND:
                        counts = off_lane or in_any(intersections, state[X], state[Y])
                    if counts:
                        first[proposal] = min(first[proposal], float(step))
                    else:
                        forgiven[entry] = True
            if first[proposal] < NEVER:
                break
    return first


@kernel
def _travel(places: Places, centerline: Path) -> tuple[FloatArray, FloatArray]:
    """Progress along the centerline and longest way off the route, both (P,) [m]."""
    centers, last = places.centers, places.centers.shape[1] - 1
    progress, off_route = np.empty(len(centers)), np.empty(len(centers))
    start = (0.0, 0.0, 0)
    for row in range(len(centers)):
        x, y = centers[row, 0, 0], centers[row, 0, 1]
        if row == 0 or x != centers[row - 1, 0, 0] or y != centers[row - 1, 0, 1]:  # rarely
            start = project(centerline, x, y, start[2])
        end = project(centerline, centers[row, last, 0], centers[row, last, 1], start[2])
        progress[row] = max(0.0, end[0] - start[0])
        longest = stretch = 0.0
        for step in range(last + 1):
            if not places.flags[row, step, OFF_ROUTE]:
                stretch = 0.0
            elif step > 0:
                dx = centers[row, step, 0] - centers[row, step - 1, 0]
                dy = centers[row, step, 1] - centers[row, step - 1, 1]
                stretch += np.hypot(dx, dy)
            longest = max(longest, stretch)
        off_route[row] = longest
    return progress, off_route
