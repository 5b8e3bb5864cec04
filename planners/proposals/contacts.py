"""What driven proposals collide with, and whose fault it is.

Array axes: P proposals, T time indices, R rows of time at which the others are known, N others.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import (
    ACTIVE_FRONT,
    ACTIVE_LATERAL,
    STOPPED_TRACK,
    boxes_touch,
    circle_around,
    contact_type,
)
from shiftsim.geometry.rings import SLACK
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.proposals.places import ProposalStates
from shiftsim.world.state import VX, VY

TTC_STOPPED = 5e-3  # m/s, of the ego
NEVER = np.inf


class Obstacles(NamedTuple):
    """Boxes of all that a proposal can hit."""

    boxes: FloatArray  # (R, N, 4, 2) corners [m]
    centers: FloatArray  # (R, N, 2) centres [m]
    centroids: FloatArray  # (R, N, 2) points that bearings are taken to [m]
    speeds: FloatArray  # (R, N) 0 for static objects [m/s]
    radii: FloatArray  # (N,) half diagonals [m]
    is_agent: BoolArray  # (N,) whether it is no static object
    ignored: BoolArray  # (N,) whether contacts with it do not count


@kernel
def touches_boxes(footprint: FloatArray, boxes: FloatArray) -> BoolArray:
    """(B,) whether a box (4, 2) touches each of others (B, 4, 2)."""
    out = np.empty(len(boxes), np.bool_)
    for index in range(len(boxes)):
        out[index] = boxes_touch(footprint, boxes[index])
    return out


@kernel
def near_others(places: ProposalStates, others: Obstacles, rows: int, horizon: float) -> IntArray:
    """Those that can touch an ego box, or its projection over `horizon` [s], in the first rows."""
    states, corners = places.states, places.corners
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for row in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            reach = horizon * np.hypot(states[row, step, VX], states[row, step, VY])
            for corner in range(4):
                x, y = corners[row, step, corner, 0], corners[row, step, corner, 1]
                low_x, high_x = min(low_x, x - reach), max(high_x, x + reach)
                low_y, high_y = min(low_y, y - reach), max(high_y, y + reach)
    out = np.empty(len(others.radii), np.int64)
    count = 0
    for index in range(len(out)):
        if others.ignored[index]:
            continue
        radius, is_near = others.radii[index] + 1e-6, False
        for row in range(rows):
            x, y = others.centers[row, index, 0], others.centers[row, index, 1]
            if low_x - radius <= x <= high_x + radius and low_y - radius <= y <= high_y + radius:
                is_near = True
                break
        if is_near:
            out[count] = index
            count += 1
    return out[:count]


@kernel
def is_at_fault(
    state: FloatArray,
    box: FloatArray,
    is_off_lane: bool,
    speed: float,
    centroid: FloatArray,
    other: FloatArray,
) -> bool:
    """Whether the ego causes a collision with a box (4, 2) of a speed [m/s] and a centroid (2,).

    `state` (11,) and `box` (4, 2) are the ego's; `is_off_lane`: on several lanes or off the road.
    """
    x, y = centroid[0], centroid[1]
    kind = contact_type(state, np.hypot(state[VX], state[VY]), box, x, y, speed, other)
    return kind == STOPPED_TRACK or kind == ACTIVE_FRONT or (kind == ACTIVE_LATERAL and is_off_lane)


@kernel
def first_faults(
    places: ProposalStates, others: Obstacles, near: IntArray, rows: IntArray, first_only: bool
) -> tuple[FloatArray, FloatArray]:
    """At-fault collisions with those of the others that are near.

    `rows` (T,) is the row of time of each time index, -1 where it is not looked at. With
    `first_only` a contact without fault is the last one that counts of an obstacle.

    Returns:
        (P,) factors 0, 0.5 or 1, and time indices of the first collisions, inf if none.
    """
    scores, first = np.ones(len(places.states)), np.full(len(places.states), NEVER)
    radius = circle_around(places.corners[0, 0])[2]
    centers, others_at = places.centers, others.centers
    for proposal in range(len(scores)):
        for index in near:
            reach = radius + others.radii[index] + SLACK
            for step in range(len(rows)):
                row = rows[step]
                dx = others_at[row, index, 0] - centers[proposal, step, 0]
                dy = others_at[row, index, 1] - centers[proposal, step, 1]
                if row < 0 or dx * dx + dy * dy > reach * reach:
                    continue  # most often, and without a slice
                box, other = places.corners[proposal, step], others.boxes[row, index]
                if not boxes_touch(box, other):
                    continue
                state, off_lane = places.states[proposal, step], places.off_lane[proposal, step]
                speed, center = others.speeds[row, index], others.centroids[row, index]
                at_fault = is_at_fault(state, box, off_lane, speed, center, other)
                if at_fault:
                    factor = 0.0 if others.is_agent[index] else 0.5
                    scores[proposal] = min(scores[proposal], factor)
                    first[proposal] = min(first[proposal], float(step))
                if at_fault or first_only:
                    break
    return scores, first
