"""Scores of PDM-Closed's proposals, on their driven states.

Array axes: P proposals, T = 41 time indices, N others.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import AHEAD, BEHIND, bearing_cosine, boxes_touch
from shiftsim.geometry.polylines import Path, project
from shiftsim.geometry.rings import SLACK
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import Areas
from shiftsim.planners.proposals.comfort import comfort
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Obstacles,
    first_faults,
    near_others,
)
from shiftsim.planners.proposals.places import (
    OFF_ROAD,
    OFF_ROUTE,
    EgoBox,
    ProposalStates,
    find_places,
)
from shiftsim.planners.proposals.tracker import DT
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.state import HEADING, VX, VY, X, Y

TTC_STEPS = (0, 3, 6, 9)  # how far ahead a pose is projected
AHEAD_SECONDS = DT * TTC_STEPS[-1]
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
    states: FloatArray, place: Place, others: Obstacles, size: EgoBox, params: PdmParameters
) -> Scores:
    """Score P proposals by their driven states (P, T, 11)."""
    areas, count = place.areas, states.shape[1]
    no_limits = np.zeros(len(areas.lane))
    places = find_places(states, size, areas, place.selected, no_limits, by_center=True)
    rows = np.arange(count + TTC_STEPS[-1]) // 2
    reaches = (AHEAD_SECONDS + DT) * others.speeds[0]
    known = others, rows, reaches
    no_collision, collision_index, ttc_index = meet(places, *known, size, place.intersections)
    raw_progress, direction = _follow_route(places, place.centerline, params.direction_limits)
    drivable = np.where(places.flags[..., OFF_ROAD].any(axis=1), 0.0, 1.0)
    factor = no_collision * drivable * direction
    progress = normalise(raw_progress, factor)
    ttc = np.where(ttc_index < NEVER, 0.0, 1.0)
    comfortable = comfort(states, params.comfort).score
    return Scores(
        total=factor * weighted_mean(progress, ttc, comfortable, params),
        no_collision=no_collision,
        drivable=drivable,
        direction=direction,
        progress=progress,
        ttc=ttc,
        comfort=comfortable,
        raw_progress=raw_progress,
        collision_index=collision_index,
        ttc_index=ttc_index,
        flags=places.flags,
    )


def meet(
    places: ProposalStates,
    others: Obstacles,
    rows: IntArray,  # row of time of each time index
    reaches: FloatArray,  # (N,) how far each of the others gets within the projection [m]
    size: EgoBox,
    intersections: Polygons,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(P,) factors of at-fault collisions, their first time indices, those of a violated TTC."""
    near, count = near_others(places, others, rows[-1] + 1, AHEAD_SECONDS), places.states.shape[1]
    # nuPlan rule 195: what is not at fault when it is first touched is not looked at again
    faults = first_faults(places, others, near, rows[:count], True)
    return *faults, first_violations(places, others, near, rows, reaches, size, intersections)


def weighted_mean(
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
def first_violations(
    places: ProposalStates,
    others: Obstacles,
    near: IntArray,
    rows: IntArray,
    reaches: FloatArray,
    size: EgoBox,
    intersections: Polygons,
) -> FloatArray:
    """(P,) first time indices at which a proposal comes too near to one of the others, inf if none.

    Each of these counts until its first contact with the ego or its projection. As many indices are
    tested as have all projections in `rows`; what is not described is as of `meet`.
    """
    states, centers = places.states, places.centers
    corners, off_lane = places.corners, places.off_lane
    others_at, boxes, centroids = others.centers, others.boxes, others.centroids
    radii, box = others.radii, np.empty((4, 2))
    radius = 0.5 * np.hypot(size.length, size.width) + SLACK
    out = np.full(len(states), NEVER)
    is_over = np.empty(len(radii), np.bool_)
    for proposal in range(len(states)):
        is_over[:] = False
        for step in range(len(rows) - TTC_STEPS[-1]):
            speed = np.hypot(states[proposal, step, VX], states[proposal, step, VY])
            if speed < TTC_STOPPED or out[proposal] < step:
                continue
            x, y = centers[proposal, step, 0], centers[proposal, step, 1]
            heading = states[proposal, step, HEADING]
            cos, sin = np.cos(heading), np.sin(heading)
            margin = radius + AHEAD_SECONDS * speed
            for index in near:
                reach, row = margin + radii[index] + reaches[index], rows[step]
                dx, dy = others_at[row, index, 0] - x, others_at[row, index, 1] - y
                if dx * dx + dy * dy > reach * reach or is_over[index]:
                    continue
                touching = radius + radii[index]
                for ahead in TTC_STEPS:
                    row, travel = rows[step + ahead], 0.1 * ahead * speed
                    dx = others_at[row, index, 0] - (x + travel * cos)
                    dy = others_at[row, index, 1] - (y + travel * sin)
                    if dx * dx + dy * dy > touching * touching or is_over[index]:
                        continue
                    for corner in range(4):
                        box[corner, 0] = corners[proposal, step, corner, 0] + travel * cos
                        box[corner, 1] = corners[proposal, step, corner, 1] + travel * sin
                    if not boxes_touch(box, boxes[row, index]):
                        continue
                    is_over[index] = True
                    rear_x, rear_y = states[proposal, step, X], states[proposal, step, Y]
                    dx = centroids[row, index, 0] - rear_x
                    dy = centroids[row, index, 1] - rear_y
                    angle = np.arccos(bearing_cosine(cos, sin, dx, dy))
                    counts = angle < AHEAD
                    if not counts and not angle > BEHIND:
                        counts = off_lane[proposal, step] or in_any(intersections, rear_x, rear_y)
                    if counts:
                        out[proposal] = step
    return out


@kernel
def _follow_route(
    places: ProposalStates, centerline: Path, limits: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """(P,) progress [m] and factors of the direction; `limits` [m] as in `PdmParameters`."""
    centers, flags = places.centers, places.flags
    progress, direction = np.empty(len(centers)), np.empty(len(centers))
    last, guess = centers.shape[1] - 1, 0
    for row in range(len(centers)):
        start, _, guess = project(centerline, centers[row, 0, 0], centers[row, 0, 1], guess)
        end, _, guess = project(centerline, centers[row, last, 0], centers[row, last, 1], guess)
        progress[row] = max(0.0, end - start)
        longest = off_route = 0.0
        for step in range(last + 1):
            if not flags[row, step, OFF_ROUTE]:
                off_route = 0.0
            elif step > 0:
                dx = centers[row, step, 0] - centers[row, step - 1, 0]
                dy = centers[row, step, 1] - centers[row, step - 1, 1]
                off_route += np.hypot(dx, dy)
            longest = max(longest, off_route)
        direction[row] = 1.0 if longest < limits[0] else (0.5 if longest < limits[1] else 0.0)
    return progress, direction
