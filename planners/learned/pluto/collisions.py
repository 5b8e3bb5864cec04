"""What PLUTO's driven proposals hit, and what they nearly hit. Array axes: P proposals, T = 41."""

import numpy as np

from shiftsim.geometry.boxes import circle_around, meets_bounds
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Obstacles,
    first_faults,
    hits,
    is_at_fault,
    project_box,
)
from shiftsim.planners.proposals.places import ProposalStates
from shiftsim.planners.proposals.tracker import DT
from shiftsim.world.layers import Polygons, meets_convex
from shiftsim.world.state import VX

TTC_STEPS = (2, 4, 6, 8)  # how far ahead a pose is projected


def collisions(
    places: ProposalStates, others: Obstacles, near: IntArray, first_red: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """At-fault collisions with those of `others` that are `near`, red lights (P,) included.

    (P,) factors 0, 0.5 or 1, and times of the first collisions, inf if none [s].
    """
    rows = np.arange(places.states.shape[1])
    rows[0] = -1
    # nuPlan rule 251: a contact without fault is looked at again
    scores, first = first_faults(places, others, near, rows, False)
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
def times_to_collision(places: ProposalStates, others: Obstacles, near: IntArray) -> FloatArray:
    """(P,) 0 or 1: whether the ego, moved ahead along its heading, stays clear.

    Arguments as for `collisions`.
    """
    scores, box, last = np.ones(len(places.states)), np.empty((4, 2)), places.states.shape[1] - 1
    for proposal in range(len(scores)):
        for step in range(1, last + 1):
            state = places.states[proposal, step]
            if state[VX] < TTC_STOPPED:
                continue
            for number in range(len(TTC_STEPS)):
                ahead = TTC_STEPS[number]
                if step + ahead > last:
                    continue
                travel = 0.1 * ahead * state[VX]
                project_box(places.corners[proposal, step], state, travel, box)
                circle = circle_around(box)
                # nuPlan rule 242: the number of the projection stands in for the time of the ego,
                # of its place and of the object, but not of the moved box
                then = places.states[proposal, number]
                off_lane = places.off_lane[proposal, number]
                for index in near:
                    if hits(others, step, index, box, circle):
                        speed, center = (
                            others.speeds[number, index],
                            others.centroids[number, index],
                        )
                        other = others.boxes[number, index]
                        if is_at_fault(then, box, off_lane, speed, center, other):
                            scores[proposal] = 0.0
            if scores[proposal] == 0.0:
                break
    return scores
