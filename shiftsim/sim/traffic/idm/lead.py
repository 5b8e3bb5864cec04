"""Whom an agent follows: whoever is nearest in the corridor ahead, which its path makes.

The corridor is the path ahead, buffered by half the width of the agent with flat ends.
"""

import numpy as np

from shiftsim.geometry.corridor import Corridor, line_distance
from shiftsim.geometry.polylines import RUN, bound_runs
from shiftsim.geometry.rings import ring_bounds
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.gaps import ring_gap
from shiftsim.sim.traffic.idm.paths import cut_path
from shiftsim.sim.traffic.idm.scene import PROGRESS, Footprints, Scene, Scratch

FREE = -1  # instead of a footprint: nobody is ahead
# corridors lie within this many half widths of their line: round joins are segmented, shallow
# vertices left out
_OUTER = 1.02
_TOUCH = 1e-3  # m, gaps below this are looked at closely
_TIE = 1.0 + 1e-9  # gaps are looked for a little beyond the best, to see equal ones


@kernel
def corridor_ahead(
    path: FloatArray, size: int, progress: float, half_width: float, scratch: Scratch
) -> Corridor:
    """The corridor along a path (K, 4), of which `size` vertices count, from a progress on."""
    points = cut_path(path, size, progress, path[size - 1, PROGRESS], scratch.line)
    line, runs = scratch.line[:points], scratch.runs[: (points - 2) // RUN + 1]
    bound_runs(line, runs)
    scratch.outline_size[0] = -1
    return Corridor(line, runs, 0, points, half_width)


@kernel
def find_lead(
    footprints: Footprints, agent: int, ignored: int, corridor: Corridor, scratch: Scratch
) -> tuple[int, float, float]:
    """The footprint in the corridor ahead of an agent that `comes_first`; not the `ignored` one.

    Returns:
        Its index, or FREE; the gap between the footprints, and the middle of its bounds in y [m].
    """
    bounds, apart = footprints.bounds, footprints.apart
    reach, own = _OUTER * corridor.half_width, bounds[agent]
    low_x, low_y, high_x, high_y = ring_bounds(corridor.xy)
    best, lead, lead_y = np.inf, FREE, np.inf
    for other in range(len(bounds)):
        is_near = (
            footprints.present[other]
            & (bounds[other, 0] <= high_x + reach)
            & (bounds[other, 1] <= high_y + reach)
            & (bounds[other, 2] >= low_x - reach)
            & (bounds[other, 3] >= low_y - reach)
        )
        apart_x = max(own[0] - bounds[other, 2], bounds[other, 0] - own[2])
        apart_y = max(own[1] - bounds[other, 3], bounds[other, 1] - own[3])
        is_near &= other != agent and other != ignored
        apart[other] = max(apart_x, apart_y) if is_near else np.inf
    while True:  # the nearest first, so that few are looked at closely
        other = int(apart.argmin())
        if apart[other] == np.inf or apart[other] > best:
            return lead, best, lead_y
        apart[other] = np.inf
        if in_corridor(footprints, other, corridor, scratch):
            gap = max(best * _TIE, _TOUCH)
            if other < len(footprints.curve) and footprints.curve_size[other]:
                curve = footprints.curve[other, : footprints.curve_size[other]]
                gap = _gap_to(footprints, agent, curve, gap)
            gap = _gap_to(footprints, agent, footprints.box[other], gap)
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
    scene: Scene, agent: int, edge: int, corridor: Corridor, best: float, best_y: float
) -> tuple[bool, float, float]:
    """Whether a stop line of an edge, in the corridor of an agent, precedes the best so far.

    With it, the gap to the best one now, and the middle of its bounds in y [m].
    """
    stops, stop_lines, is_first = scene.graph.stops, scene.graph.stop_lines, False
    for entry in range(stop_lines.ptr[edge], stop_lines.ptr[edge + 1]):
        shell = stops.poly_ptr[stop_lines.items[entry]]
        ring = stops.xy[stops.ring_ptr[shell] : stops.ring_ptr[shell + 1]]
        bounds = ring_bounds(ring)
        if _touches_corridor(corridor, ring, bounds, scene.scratch):
            gap = _gap_to(scene.footprints, agent, ring, max(best, _TOUCH))
            middle_y = 0.5 * (bounds[1] + bounds[3])
            if comes_first(gap, middle_y, best, best_y):
                is_first, best, best_y = True, gap, middle_y
    return is_first, best, best_y


@kernel
def in_corridor(footprints: Footprints, other: int, corridor: Corridor, scratch: Scratch) -> bool:
    """Whether a footprint meets a corridor."""
    low_x, low_y = footprints.bounds[other, 0], footprints.bounds[other, 1]
    bounds = low_x, low_y, footprints.bounds[other, 2], footprints.bounds[other, 3]
    if _touches_corridor(corridor, footprints.box[other], bounds, scratch):
        return True
    if other >= len(footprints.curve) or footprints.curve_size[other] == 0:
        return False
    curve = footprints.curve[other, : footprints.curve_size[other]]
    return _touches_corridor(corridor, curve, bounds, scratch)


@kernel
def _touches_corridor(
    corridor: Corridor,
    ring: FloatArray,
    bounds: tuple[float, float, float, float],
    scratch: Scratch,
) -> bool:
    """Whether a ring (V, 2) with the given bounds meets a corridor."""
    distance = line_distance(corridor, ring, bounds, 0.0, _OUTER * corridor.half_width)
    if distance == 0.0 or distance == np.inf:
        return distance == 0.0
    if scratch.outline_size[0] < 0:
        scratch.outline_size[0] = buffer_curve(corridor.xy, corridor.half_width, scratch.outline)
    return ring_gap(ring, scratch.outline[: scratch.outline_size[0]], _TOUCH) == 0.0


@kernel
def _gap_to(footprints: Footprints, agent: int, ring: FloatArray, limit: float) -> float:
    """Distance from an agent's footprint to a ring, at most `limit` [m]."""
    gap = limit
    if footprints.curve_size[agent]:
        gap = ring_gap(footprints.curve[agent, : footprints.curve_size[agent]], ring, gap)
    if gap > 0.0:
        gap = ring_gap(footprints.box[agent], ring, gap)
    return gap
