"""Whom an agent follows: whoever is nearest in the corridor ahead, which its path makes.

The corridor is the path ahead, buffered by half the width of the agent with flat ends. Kernels that
are called for each pair take rings, not the scene: every call counts references to all arrays.
"""

import numpy as np

from shiftsim.geometry.corridor import line_distance
from shiftsim.geometry.rings import ring_bounds
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.gaps import ring_gap
from shiftsim.sim.traffic.idm.scene import Ahead, Footprint, Footprints, LaneGraph

FREE = -1  # instead of a footprint: nobody is ahead
# corridors lie within this many half widths of their line: round joins are segmented, shallow
# vertices left out
_OUTER = 1.02
_TOUCH = 1e-3  # m, gaps below this are looked at closely
_TIE = 1.0 + 1e-9  # gaps are looked for a little beyond the best, to see equal ones


@kernel
def find_lead(
    footprints: Footprints, agent: int, ignored: int, ahead: Ahead
) -> tuple[int, float, float]:
    """The footprint in the corridor ahead of an agent that `comes_first`; not the `ignored` one.

    Returns:
        Its index, or FREE; the gap between the footprints, and the middle of its bounds in y [m].
    """
    bounds, apart = footprints.bounds, footprints.apart
    reach = _OUTER * ahead.corridor.half_width
    low_x, low_y, high_x, high_y = ring_bounds(ahead.corridor.xy)
    best, lead, lead_y = np.inf, FREE, np.inf
    for other in range(len(bounds)):
        is_near = (
            footprints.present[other]
            & (bounds[other, 0] <= high_x + reach)
            & (bounds[other, 1] <= high_y + reach)
            & (bounds[other, 2] >= low_x - reach)
            & (bounds[other, 3] >= low_y - reach)
        )
        apart_x = max(bounds[agent, 0] - bounds[other, 2], bounds[other, 0] - bounds[agent, 2])
        apart_y = max(bounds[agent, 1] - bounds[other, 3], bounds[other, 1] - bounds[agent, 3])
        is_near &= other != agent and other != ignored
        apart[other] = max(apart_x, apart_y) if is_near else np.inf
    while True:  # the nearest first, so that few are looked at closely
        other = int(apart.argmin())
        if apart[other] == np.inf or apart[other] > best:
            return lead, best, lead_y
        apart[other] = np.inf
        footprint = footprint_at(footprints, other)
        if in_corridor(footprint, bounds[other], ahead):
            gap, own = max(best * _TIE, _TOUCH), footprint_at(footprints, agent)
            if len(footprint.curve):
                gap = _gap_to(own, footprint.curve, gap)
            gap = _gap_to(own, footprint.box, gap)
            middle_y = 0.5 * (bounds[other, 1] + bounds[other, 3])
            is_tied = gap == best and (gap > 0.0 or middle_y == lead_y) and other < lead
            if is_tied or comes_first(gap, middle_y, best, lead_y):
                best, lead, lead_y = gap, other, middle_y


@kernel
def comes_first(gap: float, y: float, best: float, best_y: float) -> bool:
    """Whether what is at a gap and has the middle of its bounds at y precedes the best so far."""
    # nuPlan rule 131: of what is touched, the spatial index answers with the lowest in y
    return gap < best or (gap == 0.0 and best == 0.0 and y < best_y)


@kernel
def stop_line_ahead(
    graph: LaneGraph, edge: int, own: Footprint, ahead: Ahead, best: float, best_y: float
) -> tuple[bool, float, float]:
    """Whether a stop line of an edge, in the corridor of an agent, precedes the best so far.

    With it, the gap to the best one now, and the middle of its bounds in y [m].
    """
    stops, stop_lines, is_first = graph.stops, graph.stop_lines, False
    for entry in range(stop_lines.ptr[edge], stop_lines.ptr[edge + 1]):
        shell = stops.poly_ptr[stop_lines.items[entry]]
        ring = stops.xy[stops.ring_ptr[shell] : stops.ring_ptr[shell + 1]]
        bounds = ring_bounds(ring)
        if _touches_corridor(ahead, ring, bounds):
            gap = _gap_to(own, ring, max(best, _TOUCH))
            middle_y = 0.5 * (bounds[1] + bounds[3])
            if comes_first(gap, middle_y, best, best_y):
                is_first, best, best_y = True, gap, middle_y
    return is_first, best, best_y


@kernel
def footprint_at(footprints: Footprints, index: int) -> Footprint:
    """One of the footprints."""
    # replayed tracks have no row of curves, and size 0
    row, size = min(index, len(footprints.curve) - 1), footprints.curve_size[index]
    return Footprint(footprints.box[index], footprints.curve[row, :size])


@kernel
def in_corridor(footprint: Footprint, bounds: FloatArray, ahead: Ahead) -> bool:
    """Whether a footprint of the given bounds (4,) meets a corridor."""
    box, curve = footprint
    limits = bounds[0], bounds[1], bounds[2], bounds[3]
    return _touches_corridor(ahead, box, limits) or (
        len(curve) > 0 and _touches_corridor(ahead, curve, limits)
    )


@kernel
def _touches_corridor(
    ahead: Ahead, ring: FloatArray, bounds: tuple[float, float, float, float]
) -> bool:
    """Whether a ring (V, 2) with the given bounds meets a corridor."""
    corridor, outline, size = ahead
    distance = line_distance(corridor, ring, bounds, 0.0, _OUTER * corridor.half_width)
    if distance == 0.0 or distance == np.inf:
        return distance == 0.0
    if size[0] < 0:
        size[0] = buffer_curve(corridor.xy, corridor.half_width, outline)
    return ring_gap(ring, outline[: size[0]], _TOUCH) == 0.0


@kernel
def _gap_to(own: Footprint, ring: FloatArray, limit: float) -> float:
    """Distance from an agent's footprint to a ring, at most `limit` [m]."""
    gap = ring_gap(own.curve, ring, limit) if len(own.curve) else limit
    return ring_gap(own.box, ring, gap) if gap > 0.0 else gap
