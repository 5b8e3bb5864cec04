"""Where driven proposals are: boxes of the ego, and the drivable areas that hold them.

Array axes: P proposals, T time indices.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, lean_kernel
from shiftsim.geometry.boxes import box_corners
from shiftsim.planners.proposals.areas import Areas, Slabs, held_points, near_areas
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
    near = near_areas(areas.slabs.bounds, selected, corners)
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


@lean_kernel
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
    bounds, highest = slabs.bounds, 0.0
    for area in near:
        highest = max(highest, limits[area])
    guess = -1  # the area that held the whole ego last is tried first
    for row in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            box = corners[row, step]
            point = points[row, step : step + 1]
            low_x = min(box[0, 0], box[1, 0], box[2, 0], box[3, 0])
            low_y = min(box[0, 1], box[1, 1], box[2, 1], box[3, 1])
            high_x = max(box[0, 0], box[1, 0], box[2, 0], box[3, 0])
            high_y = max(box[0, 1], box[1, 1], box[2, 1], box[3, 1])
            num_touched, held, is_on_route, limit = 0, 0, False, 0.0
            for entry in range(-1, len(near)):
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
                if not is_known and held_points(slabs, area, point)[0] != 0:
                    limit = max(limit, limits[area])
                    is_on_route = is_on_route or on_route[area]
                if held == _WHOLE or (
                    num_touched > 1
                    and held == _ALL_CORNERS  # only an area that holds the box changes anything
                    and not (
                        bounds[area, 0] <= low_x
                        and bounds[area, 2] >= high_x
                        and bounds[area, 1] <= low_y
                        and bounds[area, 3] >= high_y
                    )
                ):
                    continue
                within = held_points(slabs, area, box)[0]
                if within == _ALL_CORNERS:
                    held, guess = _WHOLE, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            flags[row, step, MULTIPLE] = num_touched > 1 and held != _WHOLE
            flags[row, step, OFF_ROAD] = held != _WHOLE and held != _ALL_CORNERS
            flags[row, step, OFF_ROUTE] = not is_on_route
            speed_limits[row, step] = limit
