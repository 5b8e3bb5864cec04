"""Where driven proposals are: boxes of the ego, and the drivable areas that hold them.

Array axes: P proposals, T time indices.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.rings import ring_bounds
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.proposals.areas import Areas, held_points
from shiftsim.world.state import VehicleParameters, X, Y

MULTIPLE, OFF_ROAD, OFF_ROUTE = 0, 1, 2  # flags of a pose
_ALL_CORNERS, _MIDDLE = 0b1111, 0b10000  # bits of the points of a pose


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
    limits: FloatArray,  # (M,) speed limits of all areas [m/s]
    *,
    by_center: bool,  # whether the ego is on the route where its centre is, not its rear axle
) -> ProposalStates:
    """ProposalStates of driven states (P, T, 11)."""
    shape = states.shape[:2]
    places = ProposalStates(
        states,
        np.empty((*shape, 4, 2)),
        np.empty((*shape, 2)),
        np.empty((*shape, 3), np.bool_),
        np.empty(shape, np.bool_),
        np.empty(shape),
    )
    _locate(areas, selected, limits, by_center, size, places)
    return places


@kernel
def ego_corners(pose: FloatArray, size: EgoBox, out: FloatArray) -> tuple[float, float]:
    """Write the corners (4, 2) of the ego at a rear axle x, y, heading; the centre of its box."""
    x = pose[0] + size.rear_axle_to_center * np.cos(pose[2])
    y = pose[1] + size.rear_axle_to_center * np.sin(pose[2])
    box_corners(x, y, pose[2], size.length, size.width, out)
    return x, y


@kernel
def _locate(
    areas: Areas,
    selected: IntArray,
    limits: FloatArray,
    by_center: bool,
    size: EgoBox,
    places: ProposalStates,  # the states are there
) -> None:
    """Fill in boxes, flags and speed limits."""
    polygons, bounds, run_ptr, runs = (
        areas.polygons,
        areas.polygons.bounds,
        areas.run_ptr,
        areas.runs,
    )
    points = np.empty((5, 2))  # corners of the ego, and what decides whether it is on the route
    for row in range(places.states.shape[0]):
        for step in range(places.states.shape[1]):
            x, y = ego_corners(places.states[row, step], size, places.corners[row, step])
            places.centers[row, step, 0], places.centers[row, step, 1] = x, y
    low_x, low_y, high_x, high_y = ring_bounds(places.corners.reshape(-1, 2))
    near, num_near, highest, latest = np.empty_like(selected), 0, 0.0, -1
    for area in selected:
        if (
            bounds[area, 0] <= high_x
            and bounds[area, 1] <= high_y
            and bounds[area, 2] >= low_x
            and bounds[area, 3] >= low_y
        ):
            near[num_near] = area
            num_near, highest = num_near + 1, max(highest, limits[area])
    for row in range(places.states.shape[0]):
        for step in range(places.states.shape[1]):
            box = places.corners[row, step]
            low_x, low_y, high_x, high_y = ring_bounds(box)
            for corner in range(4):
                points[corner, 0], points[corner, 1] = box[corner, 0], box[corner, 1]
            points[4, 0], points[4, 1] = places.states[row, step, X], places.states[row, step, Y]
            if by_center:
                points[4, 0] = places.centers[row, step, 0]
                points[4, 1] = places.centers[row, step, 1]
            num_touched, held, is_whole, is_on_route, limit = 0, 0, False, False, 0.0
            for entry in range(-1, num_near):
                # the area that held the whole ego last probably holds it again
                area = latest if entry < 0 else near[entry]
                if area < 0 or (entry >= 0 and area == latest):
                    continue
                is_known = is_on_route and limit >= highest
                if is_whole and is_known:
                    break
                if (
                    bounds[area, 0] > high_x
                    or bounds[area, 1] > high_y
                    or bounds[area, 2] < low_x
                    or bounds[area, 3] < low_y
                ):
                    continue
                if num_touched > 1 and held == _ALL_CORNERS and is_known:
                    # only an area that holds the whole ego changes anything
                    if low_x < bounds[area, 0] or low_y < bounds[area, 1]:
                        continue
                    if high_x > bounds[area, 2] or high_y > bounds[area, 3]:
                        continue
                within = held_points(polygons, run_ptr, runs, area, points)
                if within & _MIDDLE:
                    limit, is_on_route = (
                        max(limit, limits[area]),
                        is_on_route or areas.on_route[area],
                    )
                within &= _ALL_CORNERS
                if within == _ALL_CORNERS:
                    is_whole, latest = True, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            flags = places.flags[row, step]
            flags[MULTIPLE] = num_touched > 1 and not is_whole
            flags[OFF_ROAD] = held != _ALL_CORNERS and not is_whole
            flags[OFF_ROUTE] = not is_on_route
            places.off_lane[row, step] = flags[MULTIPLE] or flags[OFF_ROAD]
            places.speed_limits[row, step] = limit
