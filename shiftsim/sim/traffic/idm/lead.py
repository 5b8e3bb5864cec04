"""Whom an agent follows: whoever is nearest in the corridor ahead, which its path makes.

The corridor is the path ahead, buffered by half the width of the agent with flat ends.
"""

import numpy as np

from shiftsim.geometry.rings import ring_segment_distance
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.gaps import bound_ring, ring_gap
from shiftsim.sim.traffic.idm.paths import cut_path
from shiftsim.sim.traffic.idm.scene import PROGRESS, Footprints, Scene, Scratch
from shiftsim.sim.traffic.idm.yielding import ignores_ego_ahead
from shiftsim.sim.traffic.lanes import RED

FREE, OFF_PATH = -1, -2  # instead of a footprint: nobody ahead; outside of the own corridor
_OUTER = 1.02  # corridors lie within this many half widths of their line
_TOUCH = 1e-3  # m, gaps below this are looked at closely


@kernel
def find_lead(scene: Scene, agent: int) -> tuple[int, float]:
    """The nearest footprint in the corridor ahead of an agent, the first one on ties, and the gap.

    Returns:
        Its index, the number of footprints for a stop line, FREE or OFF_PATH; the gap between the
        footprints [m].
    """
    fleet, footprints, scratch = scene.fleet, scene.footprints, scene.scratch
    path, size, progress = fleet.path[agent], fleet.path_size[agent], fleet.progress[agent]
    path_end, half_width = path[size - 1, PROGRESS], 0.5 * fleet.size[agent, 1]
    line = scratch.line[: cut_path(path, size, progress, path_end, scratch.line)]
    scratch.outline_size[0] = -1
    if not progress < path_end and not _in_corridor(footprints, agent, line, half_width, scratch):
        return OFF_PATH, 0.0  # nuPlan rule 128
    ignored, ahead = FREE, len(scene.agents) + 1
    if (
        footprints.present[ahead]
        and _in_corridor(footprints, ahead, line, half_width, scratch)
        and ignores_ego_ahead(scene, agent)
    ):
        ignored = ahead
    reach, area = _OUTER * half_width, np.array([np.inf, np.inf, -np.inf, -np.inf])
    bound_ring(line, area)
    best, lead, own = np.inf, FREE, footprints.bounds[agent]
    for other in range(len(footprints.present)):
        bounds = footprints.bounds[other]
        is_near = (
            footprints.present[other]
            & (bounds[0] <= area[2] + reach)
            & (bounds[1] <= area[3] + reach)
            & (bounds[2] >= area[0] - reach)
            & (bounds[3] >= area[1] - reach)
        )
        if not is_near or other == agent or other == ignored:
            continue
        apart_x = max(own[0] - bounds[2], bounds[0] - own[2])
        apart_y = max(own[1] - bounds[3], bounds[1] - own[3])
        if max(apart_x, apart_y) < best and _in_corridor(
            footprints, other, line, half_width, scratch
        ):
            gap = best
            if other < len(footprints.curve) and footprints.curve_size[other]:
                curve = footprints.curve[other, : footprints.curve_size[other]]
                gap = _gap_to(footprints, agent, curve, gap)
            gap = _gap_to(footprints, agent, footprints.box[other], gap)
            if gap < best:
                best, lead = gap, other
    graph = scene.graph
    for segment in range(fleet.route_size[agent]):
        edge = fleet.route[agent, segment]
        if not graph.lights[edge] & RED:
            continue
        for entry in range(graph.stop_lines.ptr[edge], graph.stop_lines.ptr[edge + 1]):
            stop = graph.stop_lines.items[entry]
            shell = graph.stops.poly_ptr[stop]
            ring = graph.stops.xy[graph.stops.ring_ptr[shell] : graph.stops.ring_ptr[shell + 1]]
            if _touches_corridor(line, half_width, ring, graph.stops.bounds[stop], scratch):
                gap = _gap_to(footprints, agent, ring, best)
                if gap < best:
                    best, lead = gap, len(footprints.present)
    return lead, best


@kernel
def _in_corridor(
    footprints: Footprints, other: int, line: FloatArray, half_width: float, scratch: Scratch
) -> bool:
    """Whether a footprint meets the corridor of a line."""
    bounds = footprints.bounds[other]
    if _touches_corridor(line, half_width, footprints.box[other], bounds, scratch):
        return True
    if other >= len(footprints.curve) or footprints.curve_size[other] == 0:
        return False
    curve = footprints.curve[other, : footprints.curve_size[other]]
    return _touches_corridor(line, half_width, curve, bounds, scratch)


@kernel
def _touches_corridor(
    line: FloatArray, half_width: float, ring: FloatArray, bounds: FloatArray, scratch: Scratch
) -> bool:
    """Whether a ring with the given bounds (4,) meets the corridor of a line (K, 2)."""
    # a buffer lies within 2 % of its distance: round joins are segmented, shallow vertices left out
    reach, nearest, starts_outside = _OUTER * half_width, np.inf, False
    for vertex in range(1, len(line)):
        a, b = line[vertex - 1], line[vertex]
        if (
            min(a[0], b[0]) <= bounds[2] + reach
            and max(a[0], b[0]) >= bounds[0] - reach
            and min(a[1], b[1]) <= bounds[3] + reach
            and max(a[1], b[1]) >= bounds[1] - reach
        ):
            gap = ring_segment_distance(ring, a, b, reach, starts_outside)
            if gap == 0.0:
                return True
            nearest, starts_outside = min(nearest, gap), True
    if nearest == np.inf:
        return False
    if scratch.outline_size[0] < 0:
        scratch.outline_size[0] = buffer_curve(line, half_width, scratch.outline)
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
