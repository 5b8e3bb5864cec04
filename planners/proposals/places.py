"""Where driven proposals are: boxes of the ego, and the drivable areas that hold them.

Array axes: P proposals, T time indices.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import box_corners
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.proposals.areas import Areas, ScanlineIndex, held_points
from shiftsim.world.state import HEADING, VehicleParameters, X, Y

MULTIPLE, OFF_ROAD, OFF_ROUTE = 0, 1, 2  # flags of a pose
_ALL_CORNERS, _WHOLE = 0b1111, 0b11111  # corners on some area; all of them on one
_MIDDLE = 0b10000  # the point that decides whether the ego is on the route


class EgoBox(NamedTuple):
    """The ego's box: length, width, and distance from the rear axle to its centre [m]."""

    length: float
    width: float
    rear_axle_to_center: float


class ProposalStates(NamedTuple):
    """Driven proposals and where they are."""

    states: FloatArray  # (P, T, 11) driven states
    corners: FloatArray  # (P, T, 4, 2) corners of the ego [m]
    centers: FloatArray  # (P, T, 2) its centres [m]
    flags: BoolArray  # (P, T, 3) whether it is on several lanes, off the road, off the route
    off_lane: BoolArray  # (P, T) whether it is on several lanes or off the road
    speed_limits: FloatArray  # (P, T) largest limit where it is, 0 off the road [m/s]


def ego_box(vehicle: VehicleParameters) -> EgoBox:
    """The box of a vehicle."""
    return EgoBox(vehicle.length, vehicle.width, vehicle.rear_axle_to_center)


def find_places(
    states: FloatArray,
    size: EgoBox,
    areas: Areas,  # all areas of the map
    selected: IntArray,  # those of this step
    limits: FloatArray,  # (M,) speed limits of all areas, or none of them [m/s]
    *,
    by_center: bool,  # whether the ego is on the route where its centre is, not its rear axle
) -> ProposalStates:
    """ProposalStates of driven states (P, T, 11)."""
    at, near = empty_places(states), np.empty_like(selected)
    find(areas.slabs, areas.on_route, selected, limits, by_center, size, near, at)
    return at


def empty_places(states: FloatArray) -> ProposalStates:
    """Driven states (P, T, 11) and arrays for their places."""
    shape = states.shape[:2]
    return ProposalStates(
        states,
        np.empty((*shape, 4, 2)),
        np.empty((*shape, 2)),
        np.empty((*shape, 3), np.bool_),
        np.empty(shape, np.bool_),
        np.empty(shape),
    )


@kernel
def find(
    slabs: ScanlineIndex,
    on_route: BoolArray,
    selected: IntArray,
    limits: FloatArray,
    by_center: bool,
    size: EgoBox,
    near: IntArray,  # (M,) scratch
    at: ProposalStates,  # the states are there
) -> None:
    """Fill in the places."""
    bounds, flags = slabs.bounds, at.flags
    num_near, highest = _place_ego(at, size, bounds, selected, near), 0.0
    has_limits = len(limits) > 0
    for entry in range(num_near if has_limits else 0):
        highest = max(highest, limits[near[entry]])
    points = np.empty((5, 2))  # corners of the ego, and what decides whether it is on the route
    guess = -1  # the area that held the whole ego last is tried first
    for row in range(len(flags)):
        for step in range(flags.shape[1]):
            box = at.corners[row, step]
            for corner in range(4):
                points[corner, 0], points[corner, 1] = box[corner, 0], box[corner, 1]
            if by_center:
                points[4, 0], points[4, 1] = at.centers[row, step, 0], at.centers[row, step, 1]
            else:
                points[4, 0], points[4, 1] = at.states[row, step, X], at.states[row, step, Y]
            low_x = min(box[0, 0], box[1, 0], box[2, 0], box[3, 0])
            low_y = min(box[0, 1], box[1, 1], box[2, 1], box[3, 1])
            high_x = max(box[0, 0], box[1, 0], box[2, 0], box[3, 0])
            high_y = max(box[0, 1], box[1, 1], box[2, 1], box[3, 1])
            num_touched, held, is_on_route, limit = 0, 0, False, 0.0
            for entry in range(-1, num_near):
                area = guess if entry < 0 else near[entry]
                if area < 0 or (entry >= 0 and area == guess):
                    continue
                is_known = is_on_route and limit >= highest
                if held == _WHOLE and is_known:
                    break
                if not (
                    low_x <= bounds[area, 2]
                    and high_x >= bounds[area, 0]
                    and low_y <= bounds[area, 3]
                    and high_y >= bounds[area, 1]
                ):
                    continue
                is_settled = held == _WHOLE or (
                    num_touched > 1
                    and held == _ALL_CORNERS  # only an area that holds the box changes anything
                    and not (
                        bounds[area, 0] <= low_x
                        and bounds[area, 2] >= high_x
                        and bounds[area, 1] <= low_y
                        and bounds[area, 3] >= high_y
                    )
                )
                if is_settled and is_known:
                    continue
                first, stop = 4 if is_settled else 0, 4 if is_known else 5
                within = held_points(slabs, area, points, first, stop)[0]
                if within & _MIDDLE != 0:
                    limit = max(limit, limits[area]) if has_limits else limit
                    is_on_route = is_on_route or on_route[area]
                within &= _ALL_CORNERS
                if within == _ALL_CORNERS:
                    held, guess = _WHOLE, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            flags[row, step, MULTIPLE] = num_touched > 1 and held != _WHOLE
            flags[row, step, OFF_ROAD] = held != _WHOLE and held != _ALL_CORNERS
            flags[row, step, OFF_ROUTE] = not is_on_route
            at.off_lane[row, step] = flags[row, step, MULTIPLE] or flags[row, step, OFF_ROAD]
            at.speed_limits[row, step] = limit


@kernel
def _place_ego(
    at: ProposalStates, size: EgoBox, bounds: FloatArray, selected: IntArray, near: IntArray
) -> int:
    """Write corners and centres, and which of the selected areas may be met; how many they are."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for row in range(at.states.shape[0]):
        for step in range(at.states.shape[1]):
            heading = at.states[row, step, HEADING]
            x = at.states[row, step, X] + size.rear_axle_to_center * np.cos(heading)
            y = at.states[row, step, Y] + size.rear_axle_to_center * np.sin(heading)
            at.centers[row, step, 0], at.centers[row, step, 1] = x, y
            corners = at.corners[row, step]
            box_corners(x, y, heading, size.length, size.width, corners)
            for corner in range(4):
                low_x, high_x = min(low_x, corners[corner, 0]), max(high_x, corners[corner, 0])
                low_y, high_y = min(low_y, corners[corner, 1]), max(high_y, corners[corner, 1])
    count = 0
    for area in selected:
        if (
            bounds[area, 0] <= high_x
            and bounds[area, 2] >= low_x
            and bounds[area, 1] <= high_y
            and bounds[area, 3] >= low_y
        ):
            near[count] = area
            count += 1
    return count
