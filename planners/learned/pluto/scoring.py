"""Scores of PLUTO's proposals on their driven states, and the emergency brake.

Array axes: P proposals, T = 41 states of each.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import boxes_touch, circle_around, meets_bounds
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned.pluto.reference import Drivable
from shiftsim.planners.learned.pluto.world import World
from shiftsim.planners.proposals.comfort import ComfortBounds, comfort
from shiftsim.planners.proposals.contacts import (
    NEVER,
    TTC_STOPPED,
    Obstacles,
    first_faults,
    is_at_fault,
    near_others,
)
from shiftsim.planners.proposals.places import (
    OFF_ROAD,
    OFF_ROUTE,
    ProposalStates,
    ego_box,
    find_places,
)
from shiftsim.planners.proposals.tracker import DT, drive_proposals, fit_speed, reference_at
from shiftsim.sim.dynamics.bicycle import step_bicycle
from shiftsim.sim.dynamics.lqr import NUPLAN, LqrParameters, command, fit_curvature, is_stopping
from shiftsim.world.layers import Polygons, make_polylines, meets_convex, project_on_line
from shiftsim.world.state import HEADING, NUM_STATE, STEERING_RATE, VX, VY, VehicleParameters, X, Y

LEARNED_WEIGHT = 0.3
PROGRESS_WEIGHT, TTC_WEIGHT, SPEED_WEIGHT, COMFORT_WEIGHT = 5.0, 5.0, 2.0, 2.0
UNCOMFORTABLE = TOO_FAST = 0.5  # factors
SPEED_SCORE_MIN = 0.5
MAX_OVERSPEED = 2.23  # m/s, on average
DIRECTION_LIMITS = (4.0, 12.0)  # m on oncoming lanes
MAX_REVERSE = 5  # frames
ALREADY_OFF = 3  # first frames; when all proposals leave the road there, it does not count
MIN_PROGRESS = 0.1  # m
TTC_STEPS = (2, 4, 6, 8)  # how far ahead a pose is projected
MAX_SPEED = 8.0  # m/s, a faster ego does not brake
GENTLE, HARD = 2.4, 4.05  # m/s^2, that decide whether and how to brake
REACTION = 0.5  # s
MIN_TIME = 3.0  # s, an infraction before that always brakes
SOFT_ACCEL, HARD_ACCEL = -4.0, -4.5  # m/s^2


class Scores(NamedTuple):
    """Scores of P proposals."""

    total: FloatArray  # (P,) what decides
    rule: FloatArray  # (P,) the rule-based part
    factors: FloatArray  # (3, P) no collision, drivable area, driving direction
    terms: FloatArray  # (4, P) progress, speed limit, comfort, time to collision
    progress: FloatArray  # (P,) along the reference line [m]
    fault_times: FloatArray  # (P,) of the first at-fault collision, inf if none [s]
    driven: FloatArray  # (P, 41, 11) states as driven by the tracker
    flags: BoolArray  # (P, 41, 3) several lanes, off the road, off the route
    speed_limits: FloatArray  # (P, 41) [m/s]


class Place(NamedTuple):
    """The map as the scorer sees it."""

    drivable: Drivable  # drivable areas of the step
    lanes: Polygons  # areas of lanes and connectors
    baseline: FloatArray  # (K, 2) line along which progress is measured [m]


def score(
    poses: FloatArray,
    learned: FloatArray,
    ego: FloatArray,
    world: World,
    place: Place,
    vehicle: VehicleParameters,
) -> Scores:
    """Drive proposals (P, 81, 3) and score them; `learned` (P,) are their scores by the network."""
    driven = drive_proposals(poses, ego, vehicle).states
    drivable, obstacles = place.drivable, world.obstacles
    size, areas = ego_box(vehicle), drivable.areas
    at = find_places(driven, size, areas, drivable.selected, drivable.limits, by_center=False)
    near = near_others(at, obstacles, driven.shape[1], DT * TTC_STEPS[-1])
    red = run_lights(at.corners, place.lanes, world.lights)
    clear, fault_times = collisions(at, obstacles, near, red)
    ttc = times_to_collision(at, obstacles, near)
    factors = np.stack([clear, on_road(at.flags[..., OFF_ROAD]), direction(driven, at.flags)])
    progress = travel(driven, place.baseline)
    comfortable = comfort(driven, ComfortBounds()).score
    terms = np.stack([np.empty(len(ttc)), speed_score(driven, at.speed_limits), comfortable, ttc])
    terms[0], rule = aggregate(factors, terms, progress)
    total = rule + LEARNED_WEIGHT * learned
    return Scores(
        total, rule, factors, terms, progress, fault_times, driven, at.flags, at.speed_limits
    )


def on_road(off_road: BoolArray) -> FloatArray:
    """(P,) factor of the drivable area, from flags (P, T)."""
    # nuPlan rule 243: an ego that is off the road already may stay there
    if off_road[:, :ALREADY_OFF].any(axis=1).all():
        return np.ones(len(off_road))
    return np.where(off_road.any(axis=1), 0.0, 1.0)


def direction(driven: FloatArray, flags: BoolArray) -> FloatArray:
    """(P,) factor of the driving direction."""
    steps = np.hypot(np.diff(driven[..., X], axis=1), np.diff(driven[..., Y], axis=1))
    off_route = np.where(flags[:, 1:, OFF_ROUTE], steps, 0.0).sum(axis=1)
    low, high = DIRECTION_LIMITS
    factor = np.where(off_route < low, 1.0, np.where(off_route < high, 0.5, 0.0))
    reverse = (driven[..., VX] < 0.0).sum(axis=1) > MAX_REVERSE
    return np.where(reverse, 0.0, factor)


def speed_score(driven: FloatArray, limits: FloatArray) -> FloatArray:
    """(P,) in [0, 1]."""
    over = np.maximum(np.hypot(driven[..., VX], driven[..., VY]) - limits, 0.0)
    return np.maximum(1.0 - over.sum(axis=1) / (MAX_OVERSPEED * limits.shape[1]), 0.0)


def travel(driven: FloatArray, baseline: FloatArray) -> FloatArray:
    """(P,) progress along a line (K, 2) [m]."""
    line = make_polylines([baseline])
    ends = driven[:, [0, -1], :2].reshape(-1, 2).tolist()
    along = np.array([project_on_line(line, 0, x, y) for x, y in ends]).reshape(-1, 2)
    return np.maximum(along[:, 1] - along[:, 0], 0.0)


def aggregate(
    factors: FloatArray, terms: FloatArray, progress: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The progress scores (P,) in [0, 1], and the rule-based scores (P,).

    Of factors (3, P) and terms (4, P) of `Scores`, of which the first row is not read.
    """
    product = factors.prod(axis=0)
    product = product * np.where(terms[2] == 0.0, UNCOMFORTABLE, 1.0)
    product = product * np.where(terms[1] < SPEED_SCORE_MIN, TOO_FAST, 1.0)
    first = normalise(progress, product)
    weighted = PROGRESS_WEIGHT * first + TTC_WEIGHT * terms[3]
    weighted += SPEED_WEIGHT * terms[1] + COMFORT_WEIGHT * terms[2]
    weights = PROGRESS_WEIGHT + TTC_WEIGHT + SPEED_WEIGHT + COMFORT_WEIGHT
    return first, product * (weighted / weights)


def normalise(progress: FloatArray, product: FloatArray) -> FloatArray:
    """(P,) progress in [0, 1] from metres and the product of all factors."""
    valid = progress * product
    most = float(valid.max())
    if most > MIN_PROGRESS:
        return np.where(progress < MIN_PROGRESS, 0.0, valid / most)
    return product


def nearest_line(lines: list[FloatArray], rear: FloatArray) -> FloatArray:
    """(K, 2) of the reference line that starts nearest to the rear axle; the first on ties."""
    distances = [np.hypot(line[0, 0] - rear[0], line[0, 1] - rear[1]) for line in lines]
    return np.ascontiguousarray(lines[int(np.argmin(distances))][:, :2])


def collisions(
    places: ProposalStates, obstacles: Obstacles, near: IntArray, first_red: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """At-fault collisions with those of `obstacles` that are `near`, red lights (P,) included.

    (P,) factors 0, 0.5 or 1, and times of the first collisions, inf if none [s].
    """
    rows = np.arange(places.states.shape[1])
    rows[0] = -1
    # nuPlan rule 251: a contact without fault is looked at again
    scores, first = first_faults(places, obstacles, near, rows, False)
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
def times_to_collision(places: ProposalStates, obstacles: Obstacles, near: IntArray) -> FloatArray:
    """(P,) 0 or 1: whether the ego, moved ahead along its heading, stays clear of `near` ones."""
    scores, box, last = np.ones(len(places.states)), np.empty((4, 2)), places.states.shape[1] - 1
    corners, centers = places.corners, obstacles.centers
    for proposal in range(len(scores)):
        for step in range(1, last + 1):
            state = places.states[proposal, step]
            if state[VX] < TTC_STOPPED:
                continue
            cos, sin = np.cos(state[HEADING]), np.sin(state[HEADING])
            for number in range(len(TTC_STEPS)):
                ahead = TTC_STEPS[number]
                if step + ahead > last:
                    continue
                travel = 0.1 * ahead * state[VX]
                for corner in range(4):
                    box[corner, 0] = corners[proposal, step, corner, 0] + travel * cos
                    box[corner, 1] = corners[proposal, step, corner, 1] + travel * sin
                x, y, radius = circle_around(box)
                # nuPlan rule 242: the number of the projection stands in for the time of the ego,
                # of its place and of the object, but not of the moved box
                then = places.states[proposal, number]
                off_lane = places.off_lane[proposal, number]
                for index in near:
                    dx, dy = centers[step, index, 0] - x, centers[step, index, 1] - y
                    reach = radius + obstacles.radii[index]
                    if dx * dx + dy * dy > reach * reach:
                        continue
                    if boxes_touch(box, obstacles.boxes[step, index]):
                        speed, center = (
                            obstacles.speeds[number, index],
                            obstacles.centroids[number, index],
                        )
                        other = obstacles.boxes[number, index]
                        if is_at_fault(then, box, off_lane, speed, center, other):
                            scores[proposal] = 0.0
            if scores[proposal] == 0.0:
                break
    return scores


def must_brake(speed: float, fault_time: float) -> bool:
    """Whether an infraction at a time [s] makes an ego of a speed [m/s] brake."""
    return fault_time <= max(speed / GENTLE + REACTION, MIN_TIME) and speed <= MAX_SPEED


def brake(
    proposal: FloatArray, ego: FloatArray, fault_time: float, vehicle: VehicleParameters
) -> FloatArray:
    """(81, 11) states, 0.1 s apart, along a proposal (81, 3) with a fault at `fault_time` [s]."""
    out = np.empty((len(proposal), NUM_STATE))
    out[0] = ego
    soft = fault_time > float(np.hypot(ego[VX], ego[VY])) / HARD + REACTION
    tracker = NUPLAN._replace(wheel_base=vehicle.wheel_base)
    _roll_out(np.ascontiguousarray(proposal), soft, tracker, DT, out)
    # nuPlan rule 240: the plan is made without the rates of steering and yaw
    out[:, STEERING_RATE:] = 0.0
    return out


@kernel
def _roll_out(
    poses: FloatArray, soft: bool, params: LqrParameters, dt: float, states: FloatArray
) -> None:
    """Drive along poses (81, 3) to a standstill; `states` (81, 11) starts with the ego's."""
    count = len(poses) - 1
    speeds, curvatures, ahead = np.empty(count), np.empty(count), np.empty(params.horizon)
    fit_speed(poses, dt, params.jerk_penalty, speeds)
    fit_curvature(poses, speeds, dt, params.curvature_rate_penalty, curvatures)
    for step in range(count):
        state = states[step]
        reference = reference_at(state, poses, step, 0.0, curvatures, ahead)
        accel, rate = command(state, reference, params)
        if soft or is_stopping(state[VX], 0.0, params):
            accel = max(accel, SOFT_ACCEL)
        else:
            accel = HARD_ACCEL
        step_bicycle(state, accel, rate, params.wheel_base, dt, states[step + 1])
