"""What PLUTO's driven proposals hit, and what they nearly hit. Array axes: P proposals, T = 41."""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry.boxes import circle_around, meets_bounds
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Others,
    first_faults,
    hits,
    is_at_fault,
    project_box,
)
from shiftsim.planners.proposals.tracker import DT
from shiftsim.world.layers import Polygons, meets_convex
from shiftsim.world.state import VX

TTC_STEPS = (2, 4, 6, 8)  # how far ahead a pose is projected


def collisions(
    states: FloatArray,
    corners: FloatArray,
    off_lane: BoolArray,
    others: Others,
    near: IntArray,
    first_red: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """At-fault collisions, red lights included.

    Args:
        states: (P, T, 11) driven states.
        corners: (P, T, 4, 2) corners of the ego [m].
        off_lane: (P, T) whether the ego is on several lanes or off the road.
        others: What is around.
        near: Those of them that count.
        first_red: (P,) time indices of `run_lights`.

    Returns:
        (P,) factors 0, 0.5 or 1, and times of the first collisions, inf if none [s].
    """
    scores, first = np.empty(len(states)), np.empty(len(states))
    rows = np.arange(states.shape[1])
    rows[0] = -1
    first_faults(states, corners, off_lane, others, near, rows, False, scores, first)
    # a red light after another fault does not count
    is_red = (first_red < NEVER) & (first_red <= first)
    return np.where(is_red, 0.0, scores), DT * np.minimum(first, first_red)


@kernel
def run_lights(corners: FloatArray, lanes: Polygons, lights: IntArray) -> FloatArray:
    """(P,) first time indices at which the ego (P, T, 4, 2) is on a red connector, inf if never."""
    first = np.full(len(corners), NEVER)
    for proposal in range(corners.shape[0]):
        # nuPlan rule 241: a red light counts also where the ego stands in it already
        for step in range(1, corners.shape[1]):
            box = corners[proposal, step]
            for lane in lights:
                if first[proposal] > step and meets_bounds(box, lanes.bounds[lane]):
                    if meets_convex(lanes, lane, box):
                        first[proposal] = step
    return first


@kernel
def times_to_collision(
    states: FloatArray,
    corners: FloatArray,
    off_lane: BoolArray,
    others: Others,
    near: IntArray,
    scores: FloatArray,
) -> None:
    """Whether the ego, moved ahead along its heading, stays clear: scores (P,) 0 or 1.

    Arguments as for `collisions`.
    """
    box, last = np.empty((4, 2)), states.shape[1] - 1
    for proposal in range(states.shape[0]):
        scores[proposal] = 1.0
        for step in range(1, last + 1):
            state = states[proposal, step]
            if state[VX] < TTC_STOPPED:
                continue
            for number in range(len(TTC_STEPS)):
                ahead = TTC_STEPS[number]
                if step + ahead > last:
                    continue
                project_box(corners[proposal, step], state, 0.1 * ahead * state[VX], box)
                circle = circle_around(box)
                # nuPlan rule 242: the number of the projection stands in for the time of the ego,
                # of its place and of the object, but not of the moved box
                then, is_off = states[proposal, number], off_lane[proposal, number]
                for index in near:
                    if hits(others, step, index, box, circle):
                        if is_at_fault(then, box, is_off, others, number, index):
                            scores[proposal] = 0.0
            if scores[proposal] == 0.0:
                break
