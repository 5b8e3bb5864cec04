"""Whom an agent follows: the nearest obstacle in the corridor ahead (§10.2)."""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.footprints import Obstacles, Scratch, remaining_path
from shiftsim.sim.traffic.idm.grid import list_near
from shiftsim.sim.traffic.idm.paths import PROGRESS, Fleet, Roads
from shiftsim.sim.traffic.idm.shapes import (
    MEETING,
    PIECE,
    UNSURE,
    bound_pieces,
    last_near_piece,
    ring_gap,
    touches_corridor,
)
from shiftsim.world.layers import Polygons
from shiftsim.world.state import LightStatus

FREE, LOST = -1, -2  # instead of an obstacle: nobody ahead; outside of the own corridor
_RED = int(LightStatus.RED)
_TIE, _TINY = 1e-12, 1e-300  # gaps are looked for a little beyond the best, to see ties


@lean_kernel
def find_lead(
    fleet: Fleet,
    agent: int,
    obstacles: Obstacles,
    count: int,
    roads: Roads,
    stops: Polygons,
    status: IntArray,
    scratch: Scratch,
) -> tuple[int, float]:
    """The nearest obstacle in the corridor ahead of an agent, the first one on ties, and the gap.

    Returns:
        Its index, `count` for a stop line, FREE or LOST; the gap between the footprints [m].
    """
    half_width = 0.5 * fleet.size[agent, 1]
    size = remaining_path(fleet, agent, scratch.line)
    bound_pieces(scratch.line, size, scratch.pieces)
    path_end = fleet.path[agent, fleet.path_size[agent] - 1, PROGRESS]
    if not fleet.progress[agent] < path_end and not _in_corridor(
        obstacles, agent, half_width, size, scratch
    ):
        return LOST, 0.0  # §12 Q13
    found = list_near(obstacles, agent, half_width, size, scratch)
    best, lead = np.inf, FREE
    for _ in range(found):
        nearest = 0
        for index in range(1, found):
            apart, least = scratch.apart[index], scratch.apart[nearest]
            if apart < least or (apart == least and scratch.hits[index] < scratch.hits[nearest]):
                nearest = index
        if scratch.apart[nearest] > best:
            break
        scratch.apart[nearest] = np.inf
        other = scratch.hits[nearest]
        if best == 0.0 and other > lead:
            continue
        gap = _gap(obstacles, agent, other, best * (1.0 + _TIE) + _TINY)
        closer = gap < best or (gap == best and other < lead)
        if closer and _in_corridor(obstacles, other, half_width, size, scratch):
            best, lead = gap, other
    for segment in range(fleet.route_size[agent]):
        edge = fleet.route[agent, segment]
        if status[edge] != _RED:
            continue
        for entry in range(roads.stop_lines.ptr[edge], roads.stop_lines.ptr[edge + 1]):
            corners = _copy_stop(stops, roads.stop_lines.items[entry], scratch)
            if _meets(half_width, scratch.stop, corners, scratch.stop_bounds, size, scratch):
                gap = _ring_gap(obstacles, agent, scratch.stop, corners, best)
                if gap < best:
                    best, lead = gap, count
    return lead, best


@lean_kernel
def _in_corridor(
    obstacles: Obstacles, other: int, half_width: float, size: int, scratch: Scratch
) -> bool:
    """Whether an obstacle meets the corridor along the first `size` vertices of `scratch.line`."""
    bounds, box = obstacles.bounds[other], obstacles.box[other]
    if _meets(half_width, box, len(box), bounds, size, scratch):
        return True
    if other >= len(obstacles.curve) or obstacles.curve_size[other] == 0:
        return False
    curve, curve_size = obstacles.curve[other], obstacles.curve_size[other]
    return _meets(half_width, curve, curve_size, bounds, size, scratch)


@lean_kernel
def _meets(
    half_width: float,
    ring: FloatArray,
    ring_size: int,
    bounds: FloatArray,
    size: int,
    scratch: Scratch,
) -> bool:
    """Whether a ring meets the corridor along the first `size` vertices of `scratch.line`."""
    line, pieces = scratch.line, scratch.pieces
    found = touches_corridor(line, size, pieces, half_width, ring, ring_size, bounds)
    if found != UNSURE:
        return found == MEETING
    # of the exact corridor only what comes up to the ring is needed, and a piece to spare
    near = min((last_near_piece(pieces, size, half_width, bounds) + 2) * PIECE + 1, size)
    outline = buffer_curve(line, near, half_width, scratch.keep, scratch.corridor)
    return ring_gap(ring, ring_size, scratch.corridor, outline, 1e-3) == 0.0


@lean_kernel
def _gap(obstacles: Obstacles, agent: int, other: int, limit: float) -> float:
    """Distance between the footprints of an agent and an obstacle, at most `limit` [m]."""
    best = limit
    if other < len(obstacles.curve) and obstacles.curve_size[other]:
        curve, curve_size = obstacles.curve[other], obstacles.curve_size[other]
        best = _ring_gap(obstacles, agent, curve, curve_size, best)
    if best > 0.0:
        box = obstacles.box[other]
        best = _ring_gap(obstacles, agent, box, len(box), best)
    return best


@lean_kernel
def _ring_gap(
    obstacles: Obstacles, agent: int, ring: FloatArray, ring_size: int, limit: float
) -> float:
    """Distance from an agent's footprint to a ring, at most `limit` [m]."""
    best = limit
    if obstacles.curve_size[agent]:
        size = obstacles.curve_size[agent]
        best = ring_gap(obstacles.curve[agent], size, ring, ring_size, best)
    if best > 0.0:
        box = obstacles.box[agent]
        best = ring_gap(box, len(box), ring, ring_size, best)
    return best


@lean_kernel
def _copy_stop(stops: Polygons, stop: int, scratch: Scratch) -> int:
    """Copy the outline of a stop polygon; maps are read-only, which to a kernel is another type."""
    ring = stops.poly_ptr[stop]
    first, last = stops.ring_ptr[ring], stops.ring_ptr[ring + 1]
    for vertex in range(first, last):
        scratch.stop[vertex - first, 0] = stops.xy[vertex, 0]
        scratch.stop[vertex - first, 1] = stops.xy[vertex, 1]
    for column in range(4):
        scratch.stop_bounds[column] = stops.bounds[stop, column]
    return last - first
