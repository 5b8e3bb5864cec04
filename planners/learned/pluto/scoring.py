"""Scores of PLUTO's proposals, on their driven states."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.polylines import arc_lengths, project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, kernel
from shiftsim.planners.learned.pluto.collisions import (
    TTC_STEPS,
    collisions,
    run_lights,
    times_to_collision,
)
from shiftsim.planners.learned.pluto.reference import Drivable
from shiftsim.planners.learned.pluto.world import World
from shiftsim.planners.proposals.comfort import ComfortBounds, comfort
from shiftsim.planners.proposals.contacts import near_others
from shiftsim.planners.proposals.places import OFF_ROAD, OFF_ROUTE, ego_box, find_places
from shiftsim.planners.proposals.tracker import DT, drive_proposals
from shiftsim.world.layers import Polygons
from shiftsim.world.state import VX, VY, VehicleParameters, X, Y

LEARNED_WEIGHT = 0.3
PROGRESS_WEIGHT, TTC_WEIGHT, SPEED_WEIGHT, COMFORT_WEIGHT = 5.0, 5.0, 2.0, 2.0
UNCOMFORTABLE = TOO_FAST = 0.5  # factors
SPEED_SCORE_MIN = 0.5
MAX_OVERSPEED = 2.23  # m/s, on average
DIRECTION_LIMITS = (4.0, 12.0)  # m on oncoming lanes
MAX_REVERSE = 5  # frames
ALREADY_OFF = 3  # first frames; when all proposals leave the road there, it does not count
MIN_PROGRESS = 0.1  # m


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
    drivable, others = place.drivable, world.others
    size, areas = ego_box(vehicle), drivable.areas
    at = find_places(driven, size, areas, drivable.selected, drivable.limits, by_center=False)
    near = near_others(at, others, driven.shape[1], DT * TTC_STEPS[-1])
    red = run_lights(at.corners, place.lanes, world.lights)
    clear, fault_times = collisions(at, others, near, red)
    ttc = times_to_collision(at, others, near)
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
    arc = arc_lengths(baseline, np.array([0, len(baseline)]))
    out = np.empty(len(driven))
    _project_ends(driven, baseline, arc, out)
    return out


@kernel
def _project_ends(
    driven: FloatArray, baseline: FloatArray, arc: FloatArray, out: FloatArray
) -> None:
    count, last = len(baseline), driven.shape[1] - 1
    for row in range(len(driven)):
        start = project_on_polyline(baseline, arc, 0, count, driven[row, 0, X], driven[row, 0, Y])
        end = project_on_polyline(
            baseline, arc, 0, count, driven[row, last, X], driven[row, last, Y]
        )
        out[row] = max(0.0, end - start)


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
