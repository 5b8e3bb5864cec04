"""Where PLUTO's driven candidates are, what they hit, and what they nearly hit.

planner-pluto.md §5.3 to §5.5. Array axes: P candidates, T = 41 times.
"""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.geometry.rings import (
    EXTERIOR,
    INTERIOR,
    convex_intersect,
    locate_in_ring,
    segments_intersect,
)
from shiftsim.planners.learned.pluto.world import World, bounds_meet
from shiftsim.planners.pdm.scorer import BEHIND, bearing
from shiftsim.planners.proposals.areas import Areas, locate
from shiftsim.world.layers import Polygons, meets_convex
from shiftsim.world.state import HEADING, VX, VY, X, Y

STOPPED = 5e-2  # m/s, of the ego and of objects in a collision
TTC_STOPPED = 5e-3  # m/s
TTC_STEPS = (2, 4, 6, 8)  # how far ahead a pose is projected
MULTIPLE, OFF_ROAD, ONCOMING = 0, 1, 2  # flags
ALL_CORNERS, WHOLE = 0b1111, 0b11111  # corners on some area; all of them on one
NEVER = np.inf


@kernel
def judge_places(
    areas: Areas,
    near: IntArray,
    limits: FloatArray,
    corners: FloatArray,
    states: FloatArray,
    flags: BoolArray,
    speed_limits: FloatArray,
) -> None:
    """On which areas every pose of every candidate is (§5.3).

    Args:
        areas: All areas of the map.
        near: Those that count.
        limits: (M,) speed limits of all areas [m/s].
        corners: (P, T, 4, 2) corners of the ego [m].
        states: (P, T, 11) driven states.
        flags: (P, T, 3) receives whether the ego is on several lanes, off the road, off the route.
        speed_limits: (P, T) receives the largest limit at the rear axle, 0 off the road [m/s].
    """
    slabs = (areas.polygons.xy, areas.rings, areas.slab_grid, areas.edge_ptr, areas.edge_ends)
    bounds, poly_ptr = areas.polygons.bounds, areas.polygons.poly_ptr
    highest = 0.0
    for area in near:
        highest = max(highest, limits[area])
    guess = -1  # the area that held the whole ego last is tried first
    for row in range(states.shape[0]):
        for step in range(states.shape[1]):
            box = corners[row, step]
            x, y = states[row, step, X], states[row, step, Y]
            num_touched, held, is_on_route, limit = 0, 0, False, 0.0
            for entry in range(-1, len(near)):
                area = guess if entry < 0 else near[entry]
                if area < 0 or (entry >= 0 and area == guess):
                    continue
                is_known = is_on_route and limit >= highest
                if (held == WHOLE and is_known) or not bounds_meet(bounds[area], box):
                    continue
                first, last = poly_ptr[area], poly_ptr[area + 1]
                if not is_known and _holds(slabs, bounds[area], first, last, x, y):
                    limit = max(limit, limits[area])
                    is_on_route = is_on_route or areas.on_route[area]
                if held == WHOLE:
                    continue
                within = _corners_within(slabs, bounds[area], first, last, box)
                if within == ALL_CORNERS:
                    held, guess = WHOLE, area
                elif within > 0:
                    held |= within
                    num_touched += 1
            flags[row, step, MULTIPLE] = num_touched > 1 and held != WHOLE
            flags[row, step, OFF_ROAD] = held != WHOLE and held != ALL_CORNERS
            flags[row, step, ONCOMING] = not is_on_route
            speed_limits[row, step] = limit


@kernel
def _corners_within(
    slabs: tuple[FloatArray, IntArray, FloatArray, IntArray, IntArray],
    bounds: FloatArray,
    first: int,
    last: int,
    box: FloatArray,
) -> int:
    """Which corners of a box (4, 2) the rings `first` … `last` - 1 hold, a bit for each."""
    within = 0
    for corner in range(4):
        if _holds(slabs, bounds, first, last, box[corner, 0], box[corner, 1]):
            within |= 1 << corner
    return within


@kernel
def _holds(
    slabs: tuple[FloatArray, IntArray, FloatArray, IntArray, IntArray],
    bounds: FloatArray,
    first: int,
    last: int,
    x: float,
    y: float,
) -> bool:
    """Whether the rings `first` … `last` - 1 hold a point in their interior."""
    return (
        bounds[0] <= x <= bounds[2]
        and bounds[1] <= y <= bounds[3]
        and locate(slabs, first, last, x, y) == INTERIOR
    )


@kernel
def near_objects(corners: FloatArray, states: FloatArray, world: World) -> IntArray:
    """Objects that can touch any ego box (P, T, 4, 2), or its projection, at any time."""
    low_x = low_y = np.inf
    high_x = high_y = -np.inf
    for row in range(corners.shape[0]):
        for step in range(corners.shape[1]):
            reach = 0.1 * TTC_STEPS[-1] * abs(states[row, step, VX])
            for corner in range(4):
                x, y = corners[row, step, corner, 0], corners[row, step, corner, 1]
                low_x, high_x = min(low_x, x - reach), max(high_x, x + reach)
                low_y, high_y = min(low_y, y - reach), max(high_y, y + reach)
    out = np.empty(len(world.radii), np.int64)
    count = 0
    for index in range(len(out)):
        radius, is_near = world.radii[index] + 1e-6, False
        for step in range(len(world.centers)):
            x, y = world.centers[step, index]
            if low_x - radius <= x <= high_x + radius and low_y - radius <= y <= high_y + radius:
                is_near = True
                break
        if is_near:
            out[count] = index
            count += 1
    return out[:count]


@kernel
def collisions(
    states: FloatArray,
    corners: FloatArray,
    flags: BoolArray,
    world: World,
    near: IntArray,
    edges: Polygons,
    scores: FloatArray,
    fault_times: FloatArray,
) -> None:
    """At-fault collisions (§5.4).

    Args:
        states: (P, T, 11) driven states.
        corners: (P, T, 4, 2) corners of the ego [m].
        flags: (P, T, 3) of `judge_places`.
        world: What is around.
        near: Objects that count.
        edges: Areas of lanes and connectors.
        scores: (P,) receives the factors 0, 0.5 or 1.
        fault_times: (P,) receives the times of the first at-fault collisions, inf if none [s].
    """
    listed = np.empty(len(world.touched), np.bool_)
    for row in range(states.shape[0]):
        scores[row], fault_times[row] = 1.0, NEVER
        for index in near:
            listed[index] = world.touched[index]
        for step in range(1, states.shape[1]):
            box, state = corners[row, step], states[row, step]
            # nuPlan: a red light counts also where the ego stands in it already
            if fault_times[row] > 0.1 * step and _runs_light(edges, world.lights, box):
                scores[row], fault_times[row] = 0.0, 0.1 * step
            x, y, radius = _circle_of(box)
            astray = flags[row, step, MULTIPLE] or flags[row, step, OFF_ROAD]
            for index in near:
                if listed[index] or _is_apart(world, step, index, x, y, radius):
                    continue
                ring = world.boxes[step, index]
                if not convex_intersect(box, ring):
                    continue
                speed, center = world.speeds[step, index], world.centers[step, index]
                if is_at_fault(state, box, ring, center, speed, astray):
                    scores[row] = min(scores[row], 0.0 if world.is_agent[index] else 0.5)
                    fault_times[row] = min(fault_times[row], 0.1 * step)
                    listed[index] = True


@kernel
def _runs_light(edges: Polygons, lights: IntArray, box: FloatArray) -> bool:
    for edge in lights:
        if bounds_meet(edges.bounds[edge], box) and meets_convex(edges, edge, box):
            return True
    return False


@kernel
def _circle_of(box: FloatArray) -> tuple[float, float, float]:
    """Centre and radius of a circle around a box (4, 2), a little larger than it [m]."""
    x, y = 0.5 * (box[0, 0] + box[2, 0]), 0.5 * (box[0, 1] + box[2, 1])
    return x, y, np.hypot(box[0, 0] - x, box[0, 1] - y) + 1e-6


@kernel
def _is_apart(world: World, step: int, index: int, x: float, y: float, radius: float) -> bool:
    """Whether the circles around an object and around the ego do not meet."""
    dx, dy = world.centers[step, index, 0] - x, world.centers[step, index, 1] - y
    reach = radius + world.radii[index]
    return dx * dx + dy * dy > reach * reach


@kernel
def is_at_fault(
    state: FloatArray,
    box: FloatArray,
    ring: FloatArray,
    center: FloatArray,
    speed: float,
    astray: bool,
) -> bool:
    """Whether the ego causes a collision.

    Args:
        state: (11,) ego state.
        box: (4, 2) its corners, the front edge between the first and the last [m].
        ring: (4, 2) corners of the object [m].
        center: (2,) centre of the object [m].
        speed: Of the object [m/s].
        astray: Whether the ego is on several lanes or off the road.
    """
    if np.hypot(state[VX], state[VY]) <= STOPPED:
        return False
    if speed <= STOPPED:
        return True
    if bearing(state, center[0], center[1]) > BEHIND:
        return False
    return astray or _front_touches(box, ring)


@kernel
def _front_touches(corners: FloatArray, ring: FloatArray) -> bool:
    """Whether the front edge of a box (4, 2) touches the area of a convex ring (4, 2)."""
    if locate_in_ring(ring, corners[0, 0], corners[0, 1]) != EXTERIOR:
        return True
    for index in range(4):
        if segments_intersect(corners[0], corners[3], ring[index - 1], ring[index]):
            return True
    return False


@kernel
def times_to_collision(
    states: FloatArray,
    corners: FloatArray,
    flags: BoolArray,
    world: World,
    near: IntArray,
    scores: FloatArray,
) -> None:
    """Whether the ego, moved ahead along its heading, stays clear (§5.5); scores (P,) 0 or 1.

    Arguments as for `collisions`.
    """
    box, last = np.empty((4, 2)), states.shape[1] - 1
    for row in range(states.shape[0]):
        scores[row] = 1.0
        for step in range(1, last + 1):
            state = states[row, step]
            if state[VX] < TTC_STOPPED:
                continue
            cos, sin = np.cos(state[HEADING]), np.sin(state[HEADING])
            for number in range(len(TTC_STEPS)):
                ahead = TTC_STEPS[number]
                if step + ahead > last:
                    continue
                travel = 0.1 * ahead * state[VX]
                for corner in range(4):
                    box[corner, 0] = corners[row, step, corner, 0] + travel * cos
                    box[corner, 1] = corners[row, step, corner, 1] + travel * sin
                x, y, radius = _circle_of(box)
                # nuPlan: the number of the projection stands in for the time of the ego, of its
                # place and of the object, but not of the moved box (planner-pluto.md §5.5)
                then = states[row, number]
                astray = flags[row, number, MULTIPLE] or flags[row, number, OFF_ROAD]
                for index in near:
                    if world.touched[index] or _is_apart(world, step, index, x, y, radius):
                        continue
                    if not convex_intersect(box, world.boxes[step, index]):
                        continue
                    ring = world.boxes[number, index]
                    speed, center = world.speeds[number, index], world.centers[number, index]
                    if is_at_fault(then, box, ring, center, speed, astray):
                        scores[row] = 0.0
            if scores[row] == 0.0:
                break
