"""Scores of PDM-Closed's proposals, on their driven states.

Array axes: P proposals, T = 41 time indices, N others.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import AHEAD, BEHIND, bearing
from shiftsim.geometry.polylines import Path, project
from shiftsim.geometry.rings import SLACK, convex_intersect
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import Areas, ScanlineIndex
from shiftsim.planners.proposals.comfort import (
    Comfort,
    ComfortBounds,
    Filters,
    empty_comfort,
    feel,
    make_filters,
)
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Obstacles,
    is_at_fault,
    project_box,
)
from shiftsim.planners.proposals.places import (
    OFF_ROAD,
    OFF_ROUTE,
    EgoBox,
    ProposalStates,
    empty_places,
    find,
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


class Findings(NamedTuple):
    """What P proposals hit and where they go, as in `Scores`."""

    no_collision: FloatArray
    drivable: FloatArray
    direction: FloatArray
    ttc: FloatArray
    raw_progress: FloatArray
    collision_index: FloatArray
    ttc_index: FloatArray


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
    at, felt, near = empty_places(states), empty_comfort(states), np.empty_like(place.selected)
    found = Findings(*np.empty((len(Findings._fields), len(states))))
    areas, bounds = place.areas, (params.direction_limits, params.comfort)
    _judge(
        *(areas.slabs, areas.on_route, place.selected, near, place.intersections),
        *(place.centerline, others, size, make_filters(), bounds, at, felt, found),
    )
    factor = found.no_collision * found.drivable * found.direction
    progress = normalise(found.raw_progress, factor)
    total = factor * weigh(progress, found.ttc, felt.score, params)
    return Scores(
        total=total, progress=progress, comfort=felt.score, flags=at.flags, **found._asdict()
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
def _judge(
    slabs: ScanlineIndex,
    on_route: BoolArray,
    selected: IntArray,
    near: IntArray,  # scratch for some of them
    intersections: Polygons,
    centerline: Path,
    others: Obstacles,
    size: EgoBox,
    filters: Filters,
    bounds: tuple[tuple[float, float], ComfortBounds],  # of the direction, of comfort
    at: ProposalStates,
    felt: Comfort,
    found: Findings,
) -> None:
    """Fill in the places, the comfort test and the findings."""
    find(slabs, on_route, selected, np.empty(0), True, size, near, at)
    states, corners, centers, flags, off_lane, _ = at
    no_collision, drivable, direction, ttc, raw_progress, collision_index, ttc_index = found
    _follow_route(centers, flags, centerline, bounds[0], raw_progress, drivable, direction)
    feel(states, filters, bounds[1], felt)
    num_steps, (boxes, others_at, centroids, speeds, radii, is_agent, ignored) = (
        len(states[0]),
        others,
    )
    box, motion = np.empty((4, 2)), np.empty((num_steps, 3))  # speed, cosine, sine
    last, radius = (num_steps - 1 + TTC_STEPS[-1]) // 2, 0.5 * np.hypot(size.length, size.width)
    for proposal in range(len(states)):
        worth, fault, violation = 1.0, NEVER, NEVER
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for step in range(num_steps):
            vx, vy = states[proposal, step, VX], states[proposal, step, VY]
            motion[step, 0] = abs(vx) if vy == 0.0 else np.hypot(vx, vy)
            x, y = centers[proposal, step, 0], centers[proposal, step, 1]
            reach = radius + AHEAD_SECONDS * motion[step, 0]
            low_x, high_x = min(low_x, x - reach), max(high_x, x + reach)
            low_y, high_y = min(low_y, y - reach), max(high_y, y + reach)
        has_courses = False
        for index in range(len(radii)):
            # boxes of others move in straight lines
            x, y, slack = others_at[0, index, 0], others_at[0, index, 1], radii[index] + SLACK
            to_x, to_y = others_at[last, index, 0], others_at[last, index, 1]
            if (
                ignored[index]
                or max(x, to_x) + slack < low_x
                or min(x, to_x) - slack > high_x
                or max(y, to_y) + slack < low_y
                or min(y, to_y) - slack > high_y
            ):
                continue
            for step in range(0 if has_courses else num_steps):
                heading = states[proposal, step, HEADING]
                motion[step, 1], motion[step, 2] = np.cos(heading), np.sin(heading)
            has_courses = True
            # each of the others counts until its first contact, of either kind
            step, ttc_step = _meet(
                states[proposal],
                corners[proposal],
                centers[proposal],
                off_lane[proposal],
                motion,
                size,
                index,
                boxes,
                others_at,
                centroids,
                speeds,
                radii,
                intersections,
                violation,
                box,
            )
            violation = min(violation, ttc_step)
            if step < NEVER:
                fault, worth = min(fault, step), min(worth, 0.0 if is_agent[index] else 0.5)
        no_collision[proposal], ttc[proposal] = worth, 1.0 if violation == NEVER else 0.0
        collision_index[proposal], ttc_index[proposal] = fault, violation


@kernel
def _meet(
    states: FloatArray,  # (T, 11) of a proposal
    corners: FloatArray,  # (T, 4, 2)
    centers: FloatArray,  # (T, 2)
    off_lane: BoolArray,  # (T,)
    motion: FloatArray,  # (T, 3) speed [m/s], cosine and sine of the heading
    size: EgoBox,
    index: int,  # of one of the others
    boxes: FloatArray,  # of the others, as in `Obstacles`
    others_at: FloatArray,
    centroids: FloatArray,
    speeds: FloatArray,
    radii: FloatArray,
    intersections: Polygons,
    limit: float,  # time index after which violations do not matter
    box: FloatArray,  # (4, 2) scratch
) -> tuple[float, float]:
    """Time indices of an at-fault collision and of a violation, inf if none."""
    is_decided, fault, violation = False, NEVER, NEVER
    is_forgiven = False
    half_length, half_width = 0.5 * size.length, 0.5 * size.width
    touching = np.hypot(half_length, half_width) + radii[index] + SLACK
    for step in range(len(motion)):
        if is_decided and (is_forgiven or step > limit):
            break
        speed, cos, sin = motion[step, 0], motion[step, 1], motion[step, 2]
        x, y, state = centers[step, 0], centers[step, 1], states[step]
        reach = touching + AHEAD_SECONDS * speed + (AHEAD_SECONDS + DT) * speeds[0, index]
        dx, dy = others_at[step // 2, index, 0] - x, others_at[step // 2, index, 1] - y
        if dx * dx + dy * dy > reach * reach:
            continue
        for ahead in TTC_STEPS:
            row, travel = (step + ahead) // 2, 0.1 * ahead * speed
            dx = others_at[row, index, 0] - (x + travel * cos)
            dy = others_at[row, index, 1] - (y + travel * sin)
            is_now = ahead == 0 and not is_decided
            is_soon = not is_forgiven and not speed < TTC_STOPPED
            if dx * dx + dy * dy > touching * touching or not (is_now or is_soon):
                continue
            # most boxes that are near clearly lie on one side of the ego
            other = boxes[row, index]
            least = left = np.inf
            most = right = -np.inf
            for corner in range(4):
                dx, dy = other[corner, 0] - x, other[corner, 1] - y
                along, across = cos * dx + sin * dy - travel, cos * dy - sin * dx
                least, most = min(least, along), max(most, along)
                left, right = min(left, across), max(right, across)
            if max(least, -most) > half_length + SLACK or max(left, -right) > half_width + SLACK:
                continue
            project_box(corners[step], state, travel, box)
            if not convex_intersect(box, other):
                continue
            middle = centroids[row, index]
            if is_now:
                # nuPlan rule 195: what is not at fault when it is first touched is not looked at
                # again
                is_decided = True
                if is_at_fault(state, box, off_lane[step], speeds[row, index], middle, other):
                    fault = float(step)
            if is_soon:
                is_forgiven = True  # or nothing later matters
                angle = bearing(state, middle[0], middle[1])
                counts = angle < AHEAD
                if not counts and not angle > BEHIND:
                    counts = off_lane[step] or in_any(intersections, state[X], state[Y])
                if counts:
                    violation = float(step)
    return fault, violation


@kernel
def _follow_route(
    centers: FloatArray,
    flags: BoolArray,
    centerline: Path,
    limits: tuple[float, float],
    progress: FloatArray,
    drivable: FloatArray,
    direction: FloatArray,
) -> None:
    """Fill in where proposals go; `limits` [m] as in `PdmParameters`."""
    last, guess, start, end = centers.shape[1] - 1, 0, 0.0, 0.0
    for row in range(len(centers)):
        x, y = centers[row, 0, 0], centers[row, 0, 1]
        is_same = row > 0 and x == centers[row - 1, 0, 0] and y == centers[row - 1, 0, 1]
        for step in range(last if is_same else 0, last + 1, last):
            end, _, guess = project(centerline, centers[row, step, 0], centers[row, step, 1], guess)
            if step == 0:
                start = end
        progress[row] = max(0.0, end - start)
        longest = stretch = 0.0
        is_on_road = True
        for step in range(last + 1):
            is_on_road = is_on_road and not flags[row, step, OFF_ROAD]
            if not flags[row, step, OFF_ROUTE]:
                stretch = 0.0
            elif step > 0:
                dx = centers[row, step, 0] - centers[row, step - 1, 0]
                dy = centers[row, step, 1] - centers[row, step - 1, 1]
                stretch += np.hypot(dx, dy)
            longest = max(longest, stretch)
        drivable[row] = 1.0 if is_on_road else 0.0
        direction[row] = 1.0 if longest < limits[0] else (0.5 if longest < limits[1] else 0.0)
