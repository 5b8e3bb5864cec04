"""Where driven proposals are: boxes of the ego, and the drivable areas that hold them.

Array axes: P proposals, T time indices.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import box_corners
from shiftsim.geometry.polylines import RUN
from shiftsim.geometry.rings import ray_crosses, ring_bounds
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.proposals.areas import Areas
from shiftsim.world.state import HEADING, VehicleParameters, X, Y

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
def ego_corners(
    x: float, y: float, heading: float, size: EgoBox, out: FloatArray
) -> tuple[float, float]:
    """Write the corners (4, 2) of the ego at a rear-axle pose; the centre of its box."""
    center_x = x + size.rear_axle_to_center * np.cos(heading)
    center_y = y + size.rear_axle_to_center * np.sin(heading)
    box_corners(center_x, center_y, heading, size.length, size.width, out)
    return center_x, center_y


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
    polygons, run_ptr, runs, on_route = areas.polygons, areas.run_ptr, areas.runs, areas.on_route
    xy, ring_ptr, poly_ptr = polygons.xy, polygons.ring_ptr, polygons.poly_ptr
    bounds = polygons.bounds
    states, corners, centers, flags = places.states, places.corners, places.centers, places.flags
    off_lane, speed_limits = places.off_lane, places.speed_limits
    points = np.empty((5, 2))  # corners of the ego, and what decides whether it is on the route
    for row in range(states.shape[0]):
        for step in range(states.shape[1]):
            x, y, heading = states[row, step, X], states[row, step, Y], states[row, step, HEADING]
            x, y = ego_corners(x, y, heading, size, points)
            centers[row, step, 0], centers[row, step, 1] = x, y
            for corner in range(4):
                corners[row, step, corner, 0] = points[corner, 0]
                corners[row, step, corner, 1] = points[corner, 1]
    low_x, low_y, high_x, high_y = ring_bounds(corners.reshape(-1, 2))
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
    for row in range(states.shape[0]):
        for step in range(states.shape[1]):
            low_x = low_y = np.inf
            high_x = high_y = -np.inf
            for corner in range(4):
                x, y = corners[row, step, corner, 0], corners[row, step, corner, 1]
                points[corner, 0], points[corner, 1] = x, y
                low_x, high_x = min(low_x, x), max(high_x, x)
                low_y, high_y = min(low_y, y), max(high_y, y)
            points[4, 0], points[4, 1] = states[row, step, X], states[row, step, Y]
            if by_center:
                points[4, 0], points[4, 1] = centers[row, step, 0], centers[row, step, 1]
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
                within = on_boundary = 0
                for ring in range(poly_ptr[area], poly_ptr[area + 1]):
                    first, end = ring_ptr[ring], ring_ptr[ring + 1]
                    for run in range(run_ptr[ring], run_ptr[ring + 1]):
                        if high_y < runs[run, 0] or low_y > runs[run, 1] or low_x > runs[run, 2]:
                            continue  # most often: no ray from a point to +x meets the run
                        start = first + RUN * (run - run_ptr[ring])
                        before = start - 1 if start > first else end - 1
                        stop = min(start + RUN, end)
                        for point in range(5):
                            x, y = points[point, 0], points[point, 1]
                            if y < runs[run, 0] or y > runs[run, 1] or x > runs[run, 2]:
                                continue
                            px, py = xy[before, 0], xy[before, 1]
                            for vertex in range(start, stop):
                                qx, qy = xy[vertex, 0], xy[vertex, 1]
                                if not (min(py, qy) > y or max(py, qy) < y or max(px, qx) < x):
                                    is_odd, on_edge = ray_crosses(px, py, qx, qy, x, y)
                                    if on_edge:
                                        on_boundary |= 1 << point
                                    elif is_odd:
                                        within ^= 1 << point
                                px, py = qx, qy
                within &= ~on_boundary
                if within & _MIDDLE:
                    limit = max(limit, limits[area])
                    is_on_route = is_on_route or on_route[area]
                within &= _ALL_CORNERS
                if within == _ALL_CORNERS:
                    is_whole, latest = True, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            is_on_several = num_touched > 1 and not is_whole
            is_off_road = held != _ALL_CORNERS and not is_whole
            flags[row, step, MULTIPLE], flags[row, step, OFF_ROAD] = is_on_several, is_off_road
            flags[row, step, OFF_ROUTE] = not is_on_route
            off_lane[row, step] = is_on_several or is_off_road
            speed_limits[row, step] = limit
