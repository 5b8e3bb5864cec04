"""Where driven proposals are: boxes of the ego, and the drivable areas that hold them.

Array axes: P proposals, T time indices.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.geometry.boxes import box_corners, meets_bounds
from shiftsim.geometry.rings import INTERIOR
from shiftsim.planners.proposals.areas import Areas, Slabs, locate, near_areas
from shiftsim.world.state import HEADING, VehicleParameters, X, Y

MULTIPLE, OFF_ROAD, OFF_ROUTE = 0, 1, 2  # flags of a pose
_ALL_CORNERS, _WHOLE = 0b1111, 0b11111  # corners on some area; all of them on one


class EgoBox(NamedTuple):
    """The ego's box: length, width, and distance from the rear axle to its centre [m]."""

    length: float
    width: float
    rear_axle_to_center: float


class Places(NamedTuple):
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
    limits: FloatArray,  # (M,) speed limits of all areas [m/s]
    *,
    by_center: bool,  # whether the ego is on the route where its centre is, not its rear axle
) -> Places:
    """Places of driven states (P, T, 11)."""
    shape = states.shape[:2]
    corners, centers = np.empty((*shape, 4, 2)), np.empty((*shape, 2))
    _place_ego(states, size, corners, centers)
    flags, speed_limits = np.empty((*shape, 3), np.bool_), np.empty(shape)
    points = centers if by_center else np.ascontiguousarray(states[..., :2])
    near = near_areas(areas, selected, corners)
    _find(areas.slabs, areas.on_route, near, limits, corners, points, flags, speed_limits)
    off_lane = flags[..., MULTIPLE] | flags[..., OFF_ROAD]
    return Places(states, corners, centers, flags, off_lane, speed_limits)


@lean_kernel
def _place_ego(states: FloatArray, size: EgoBox, corners: FloatArray, centers: FloatArray) -> None:
    """Write corners and centres of driven states."""
    for row in range(states.shape[0]):
        for step in range(states.shape[1]):
            heading = states[row, step, HEADING]
            x = states[row, step, X] + size.rear_axle_to_center * np.cos(heading)
            y = states[row, step, Y] + size.rear_axle_to_center * np.sin(heading)
            centers[row, step, 0], centers[row, step, 1] = x, y
            box_corners(x, y, heading, size.length, size.width, corners[row, step])


@kernel
def _find(
    slabs: Slabs,
    on_route: BoolArray,
    near: IntArray,
    limits: FloatArray,
    corners: FloatArray,
    points: FloatArray,
    flags: BoolArray,
    speed_limits: FloatArray,
) -> None:
    """Fill in flags and speed limits, from the areas near and the points (P, T, 2) of the ego."""
    highest = 0.0
    for area in near:
        highest = max(highest, limits[area])
    guess = -1  # the area that held the whole ego last is tried first
    for row in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            box = corners[row, step]
            x, y = points[row, step, 0], points[row, step, 1]
            num_touched, held, is_on_route, limit = 0, 0, False, 0.0
            for entry in range(-1, len(near)):
                area = guess if entry < 0 else near[entry]
                if area < 0 or (entry >= 0 and area == guess):
                    continue
                is_known = is_on_route and limit >= highest
                if held == _WHOLE and is_known:
                    break
                if not meets_bounds(box, slabs.bounds[area]):
                    continue
                if not is_known and locate(slabs, area, x, y) == INTERIOR:
                    limit = max(limit, limits[area])
                    is_on_route = is_on_route or on_route[area]
                if held == _WHOLE:
                    continue
                only_whole = num_touched > 1 and held == _ALL_CORNERS  # may change anything
                within = _corners_within(slabs, area, box, only_whole)
                if within == _ALL_CORNERS:
                    held, guess = _WHOLE, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            flags[row, step, MULTIPLE] = num_touched > 1 and held != _WHOLE
            flags[row, step, OFF_ROAD] = held != _WHOLE and held != _ALL_CORNERS
            flags[row, step, OFF_ROUTE] = not is_on_route
            speed_limits[row, step] = limit


@lean_kernel
def _corners_within(slabs: Slabs, area: int, box: FloatArray, only_all: bool) -> int:
    """Which corners of a box (4, 2) an area holds, a bit for each.

    With `only_all` the search ends at the first corner that it does not hold.
    """
    within = 0
    for corner in range(4):
        if locate(slabs, area, box[corner, 0], box[corner, 1]) == INTERIOR:
            within |= 1 << corner
        elif only_all:
            return 0
    return within
