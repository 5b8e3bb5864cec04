"""Scores of PDM-Closed's proposals, on their driven states.

Array axes: P proposals, T = 41 time indices, N others.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import AHEAD, BEHIND, bearing
from shiftsim.geometry.polylines import Path, project
from shiftsim.geometry.rings import SLACK, convex_intersect
from shiftsim.planners.pdm.parameters import PdmParameters
from shiftsim.planners.proposals.areas import Areas
from shiftsim.planners.proposals.comfort import comfort
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Others,
    is_at_fault,
    project_box,
)
from shiftsim.planners.proposals.places import OFF_ROAD, OFF_ROUTE, EgoBox, Places, find_places
from shiftsim.planners.proposals.tracker import DT
from shiftsim.world.layers import Polygons, in_any
from shiftsim.world.state import HEADING, VX, VY, X, Y

TTC_STEPS = (0, 3, 6, 9)  # how far ahead a pose is projected
AHEAD_SECONDS = DT * TTC_STEPS[-1]
_NO_LIMITS = np.zeros(0)  # m/s
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
    states: FloatArray, place: Place, others: Others, size: EgoBox, params: PdmParameters
) -> Scores:
    """Score P proposals by their driven states (P, T, 11)."""
    at = find_places(states, size, place.areas, place.selected, _NO_LIMITS, by_center=True)
    found = Findings(*np.empty((len(Findings._fields), len(states))))
    lines = place.intersections, place.centerline
    _judge(at, others, *lines, size, params.direction_limits, found)
    factor = found.no_collision * found.drivable * found.direction
    progress = normalise(found.raw_progress, factor)
    comfortable = comfort(states, params.comfort).score
    total = factor * weigh(progress, found.ttc, comfortable, params)
    return Scores(
        total=total, progress=progress, comfort=comfortable, flags=at.flags, **found._asdict()
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
    at: Places,
    others: Others,
    intersections: Polygons,
    centerline: Path,
    size: EgoBox,
    direction_limits: tuple[float, float],
    made: Findings,
) -> None:
    """Fill in the findings."""
    box, motion = np.empty((4, 2)), np.empty((at.states.shape[1], 3))
    _find_contacts(at, others, intersections, size, box, motion, made)
    _follow_route(at, centerline, direction_limits, made)


@lean_kernel
def _find_contacts(
    at: Places,
    others: Others,
    intersections: Polygons,
    size: EgoBox,
    box: FloatArray,  # (4, 2) scratch
    motion: FloatArray,  # (T, 3) scratch
    made: Findings,
) -> None:
    """Fill in the contacts; each of the others counts until its first one, of either kind."""
    num_steps, num_others = at.states.shape[1], len(others.radii)
    last, radius = (num_steps - 1 + TTC_STEPS[-1]) // 2, 0.5 * np.hypot(size.length, size.width)
    for proposal in range(len(made.no_collision)):
        made.no_collision[proposal] = 1.0
        made.collision_index[proposal] = made.ttc_index[proposal] = NEVER
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for step in range(num_steps):
            state, center = at.states[proposal, step], at.centers[proposal, step]
            speed = abs(state[VX]) if state[VY] == 0.0 else np.hypot(state[VX], state[VY])
            motion[step, 0] = speed
            reach = radius + AHEAD_SECONDS * speed
            low_x, high_x = min(low_x, center[0] - reach), max(high_x, center[0] + reach)
            low_y, high_y = min(low_y, center[1] - reach), max(high_y, center[1] + reach)
        has_courses = False
        for index in range(num_others):
            if others.ignored[index]:
                continue
            # boxes of others move in straight lines
            first, end, slack = others.centers[0, index], others.centers[last, index], SLACK
            slack += others.radii[index]
            if (
                max(first[0], end[0]) + slack < low_x
                or min(first[0], end[0]) - slack > high_x
                or max(first[1], end[1]) + slack < low_y
                or min(first[1], end[1]) - slack > high_y
            ):
                continue
            if not has_courses:
                has_courses = True
                for step in range(num_steps):
                    heading = at.states[proposal, step, HEADING]
                    motion[step, 1], motion[step, 2] = np.cos(heading), np.sin(heading)
            _meet(at, others, intersections, proposal, index, size, motion, box, made)
        made.ttc[proposal] = 1.0 if made.ttc_index[proposal] == NEVER else 0.0


@lean_kernel
def _is_beside(
    center: FloatArray, motion: FloatArray, travel: float, size: EgoBox, box: FloatArray
) -> bool:
    """Whether a box (4, 2) clearly lies on one side of the ego, whose centre is moved ahead.

    `motion` (3,) as for `_meet`; most boxes that are near do.
    """
    least = left = np.inf
    most = right = -np.inf
    for corner in range(4):
        dx, dy = box[corner, 0] - center[0], box[corner, 1] - center[1]
        along, across = motion[1] * dx + motion[2] * dy - travel, motion[1] * dy - motion[2] * dx
        least, most = min(least, along), max(most, along)
        left, right = min(left, across), max(right, across)
    half_length, half_width = 0.5 * size.length + SLACK, 0.5 * size.width + SLACK
    return least > half_length or most < -half_length or left > half_width or right < -half_width


@lean_kernel
def _meet(
    at: Places,
    others: Others,
    intersections: Polygons,
    proposal: int,
    index: int,
    size: EgoBox,
    motion: FloatArray,  # (T, 3) speed [m/s], cosine and sine of the heading
    box: FloatArray,  # (4, 2) scratch
    made: Findings,
) -> None:
    """Note the first contacts of a proposal with one of the others."""
    is_decided = is_forgiven = False
    touching = 0.5 * np.hypot(size.length, size.width) + others.radii[index] + SLACK
    for step in range(len(motion)):
        if is_decided and (is_forgiven or step > made.ttc_index[proposal]):
            return
        speed, center = motion[step, 0], at.centers[proposal, step]
        reach = touching + AHEAD_SECONDS * speed + (AHEAD_SECONDS + DT) * others.speeds[0, index]
        dx = others.centers[step // 2, index, 0] - center[0]
        dy = others.centers[step // 2, index, 1] - center[1]
        if dx * dx + dy * dy > reach * reach:
            continue
        state, off_lane = at.states[proposal, step], at.off_lane[proposal, step]
        for ahead in TTC_STEPS:
            row, travel = (step + ahead) // 2, 0.1 * ahead * speed
            dx = others.centers[row, index, 0] - (center[0] + travel * motion[step, 1])
            dy = others.centers[row, index, 1] - (center[1] + travel * motion[step, 2])
            if dx * dx + dy * dy > touching * touching:
                continue
            is_now = ahead == 0 and not is_decided
            is_soon = not is_forgiven and not speed < TTC_STOPPED
            if not is_now and not is_soon:
                continue
            other = others.boxes[row, index]
            if _is_beside(center, motion[step], travel, size, other):
                continue
            project_box(at.corners[proposal, step], state, travel, box)
            if not convex_intersect(box, other):
                continue
            if is_now:
                # nuPlan rule 195: what is not at fault when it is first touched is not looked at
                # again
                is_decided = True
                if is_at_fault(state, box, off_lane, others, row, index):
                    worth = 0.0 if others.is_agent[index] else 0.5
                    made.no_collision[proposal] = min(made.no_collision[proposal], worth)
                    made.collision_index[proposal] = min(made.collision_index[proposal], step)
            if is_soon:
                middle = others.centroids[row, index]
                angle = bearing(state, middle[0], middle[1])
                counts = angle < AHEAD
                if not counts and not angle > BEHIND:
                    counts = off_lane or in_any(intersections, state[X], state[Y])
                is_forgiven = True  # or nothing later matters
                if counts:
                    made.ttc_index[proposal] = min(made.ttc_index[proposal], step)


@lean_kernel
def _follow_route(
    at: Places, centerline: Path, limits: tuple[float, float], made: Findings
) -> None:
    """Fill in where proposals go; `limits` [m] as in `PdmParameters`."""
    centers, last = at.centers, at.centers.shape[1] - 1
    start, end = (0.0, 0.0, 0), (0.0, 0.0, 0)
    for row in range(len(centers)):
        x, y = centers[row, 0, 0], centers[row, 0, 1]
        if row == 0 or x != centers[row - 1, 0, 0] or y != centers[row - 1, 0, 1]:  # rarely
            start = project(centerline, x, y, start[2])
        guess = start[2] if row == 0 else end[2]
        end = project(centerline, centers[row, last, 0], centers[row, last, 1], guess)
        made.raw_progress[row] = max(0.0, end[0] - start[0])
        longest = stretch = 0.0
        is_on_road = True
        for step in range(last + 1):
            is_on_road = is_on_road and not at.flags[row, step, OFF_ROAD]
            if not at.flags[row, step, OFF_ROUTE]:
                stretch = 0.0
            elif step > 0:
                dx = centers[row, step, 0] - centers[row, step - 1, 0]
                dy = centers[row, step, 1] - centers[row, step - 1, 1]
                stretch += np.hypot(dx, dy)
            longest = max(longest, stretch)
        made.drivable[row] = 1.0 if is_on_road else 0.0
        made.direction[row] = 1.0 if longest < limits[0] else (0.5 if longest < limits[1] else 0.0)
