"""Whom an agent follows: whoever is nearest in the corridor ahead, which its path makes."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.polylines import RUN, bound_runs, runs_of
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.courtesy import ignores_ego_ahead
from shiftsim.sim.traffic.idm.paths import look_ahead
from shiftsim.sim.traffic.idm.scene import PROGRESS, Footprints, Scene, Scratch
from shiftsim.sim.traffic.idm.shapes import (
    MEETING,
    OUTER,
    UNSURE,
    last_near_run,
    ring_gap,
    touches_corridor,
)
from shiftsim.sim.traffic.lights import RED

FREE, OFF_PATH = -1, -2  # instead of a footprint: nobody ahead; outside of the own corridor
_TIE, _TINY = 1e-12, 1e-300  # gaps are looked for a little beyond the best, to see ties
_MARGIN = 1.1  # corridors lie within this many half widths of their line


class Corridor(NamedTuple):
    """The path ahead of an agent, which is buffered by half its width with flat ends."""

    line: FloatArray  # (K, 2) vertices, those before the agent included [m]
    runs: FloatArray  # (R, 4) bounds of its runs of segments [m]
    first: int  # the vertex at which the agent is
    half_width: float  # of the buffer [m]


@kernel
def find_lead(scene: Scene, agent: int) -> tuple[int, float]:
    """The nearest footprint in the corridor ahead of an agent, the first one on ties, and the gap.

    Returns:
        Its index, the number of footprints for a stop line, FREE or OFF_PATH; the gap between the
        footprints [m].
    """
    fleet, footprints, scratch = scene.fleet, scene.footprints, scene.scratch
    look_ahead(fleet, agent)
    size = fleet.path_size[agent]
    line, runs = fleet.line[agent, :size], fleet.runs[agent, : runs_of(size)]
    corridor = Corridor(line, runs, fleet.first[agent], 0.5 * fleet.size[agent, 1])
    path_end = fleet.path[agent, size - 1, PROGRESS]
    if not fleet.progress[agent] < path_end and not _in_corridor(
        footprints, agent, corridor, scratch
    ):
        return OFF_PATH, 0.0  # nuPlan rule 128
    hidden, ahead = FREE, len(scene.agents) + 1
    if footprints.present[ahead] and _in_corridor(footprints, ahead, corridor, scratch):
        hidden = ahead if ignores_ego_ahead(scene, agent) else FREE
    found = _list_near(footprints, agent, corridor, scratch)
    best, lead = np.inf, FREE
    for _ in range(found):
        nearest = 0
        for index in range(1, found):
            apart, least = scratch.apart[index], scratch.apart[nearest]
            if apart < least or (apart == least and scratch.near[index] < scratch.near[nearest]):
                nearest = index
        if scratch.apart[nearest] > best:
            break
        scratch.apart[nearest] = np.inf
        other = scratch.near[nearest]
        if other == hidden or (best == 0.0 and other > lead):
            continue
        is_first = lead == FREE  # then what is ahead is the cheaper question
        if is_first and not _in_corridor(footprints, other, corridor, scratch):
            continue
        gap = _gap(footprints, agent, other, best * (1.0 + _TIE) + _TINY)
        closer = gap < best or (gap == best and other < lead)
        if is_first or (closer and _in_corridor(footprints, other, corridor, scratch)):
            best, lead = gap, other
    gap = _stop_gap(scene, agent, corridor, best)
    return (len(footprints.present), gap) if gap < best else (lead, best)


@kernel
def _stop_gap(scene: Scene, agent: int, corridor: Corridor, limit: float) -> float:
    """Distance from an agent's footprint to the red stop lines of its route, at most `limit`."""
    fleet, graph, scratch = scene.fleet, scene.graph, scene.scratch
    stops, stop_lines = graph.stops, graph.stop_lines
    best = limit
    for segment in range(fleet.route_size[agent]):
        edge = fleet.route[agent, segment]
        if not graph.lights[edge] & RED:
            continue
        for entry in range(stop_lines.ptr[edge], stop_lines.ptr[edge + 1]):
            stop = stop_lines.items[entry]
            shell = stops.poly_ptr[stop]
            ring = stops.xy[stops.ring_ptr[shell] : stops.ring_ptr[shell + 1]]
            if _meets(corridor, ring, stops.bounds[stop], scratch):
                best = _ring_gap(scene.footprints, agent, ring, best)
    return best


@kernel
def _list_near(footprints: Footprints, agent: int, corridor: Corridor, scratch: Scratch) -> int:
    """List footprints whose bounds come near the corridor, in `scratch.near`; returns how many.

    `scratch.apart` gets lower bounds of their gaps to the agent.
    """
    bounds, runs, margin = footprints.bounds, corridor.runs, _MARGIN * corridor.half_width
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    begin = corridor.first // RUN
    for run in range(begin, len(runs)):
        low_x, low_y = min(low_x, runs[run, 0]), min(low_y, runs[run, 1])
        high_x, high_y = max(high_x, runs[run, 2]), max(high_y, runs[run, 3])
    low_x, low_y, high_x, high_y = low_x - margin, low_y - margin, high_x + margin, high_y + margin
    found = 0
    for other in range(len(bounds)):
        # one branch: which of the five fails cannot be foreseen
        is_near = (
            footprints.present[other]
            & (bounds[other, 0] <= high_x)
            & (bounds[other, 1] <= high_y)
            & (bounds[other, 2] >= low_x)
            & (bounds[other, 3] >= low_y)
        )
        if is_near and other != agent and last_near_run(runs, begin, margin, bounds[other]) >= 0:
            apart_x = max(bounds[agent, 0] - bounds[other, 2], bounds[other, 0] - bounds[agent, 2])
            apart_y = max(bounds[agent, 1] - bounds[other, 3], bounds[other, 1] - bounds[agent, 3])
            scratch.near[found] = other
            scratch.apart[found] = max(apart_x, apart_y)
            found += 1
    return found


@kernel
def _in_corridor(footprints: Footprints, other: int, corridor: Corridor, scratch: Scratch) -> bool:
    """Whether a footprint meets a corridor."""
    bounds = footprints.bounds[other]
    if _meets(corridor, footprints.box[other], bounds, scratch):
        return True
    if other >= len(footprints.curve) or footprints.curve_size[other] == 0:
        return False
    curve = footprints.curve[other, : footprints.curve_size[other]]
    return _meets(corridor, curve, bounds, scratch)


@kernel
def _meets(corridor: Corridor, ring: FloatArray, bounds: FloatArray, scratch: Scratch) -> bool:
    """Whether a ring with the given bounds (4,) meets a corridor."""
    first, half_width = corridor.first, corridor.half_width
    found = touches_corridor(corridor.line, corridor.runs, first, half_width, ring, bounds)
    if found != UNSURE:
        return found == MEETING
    # of the exact corridor only what comes up to the ring is needed, and a run to spare
    line = corridor.line[first:]
    runs = scratch.runs[: runs_of(len(line))]
    bound_runs(line, runs)
    last = max(last_near_run(runs, 0, half_width * OUTER, bounds), 0)
    near = min((last + 2) * RUN + 1, len(line))
    outline = buffer_curve(line[:near], half_width, scratch.keep, scratch.outline)
    return ring_gap(ring, scratch.outline[:outline], 1e-3) == 0.0


@kernel
def _gap(footprints: Footprints, agent: int, other: int, limit: float) -> float:
    """Distance between the footprint of an agent and another one, at most `limit` [m]."""
    best = limit
    if other < len(footprints.curve) and footprints.curve_size[other]:
        curve = footprints.curve[other, : footprints.curve_size[other]]
        best = _ring_gap(footprints, agent, curve, best)
    if best > 0.0:
        best = _ring_gap(footprints, agent, footprints.box[other], best)
    return best


@kernel
def _ring_gap(footprints: Footprints, agent: int, ring: FloatArray, limit: float) -> float:
    """Distance from an agent's footprint to a ring, at most `limit` [m]."""
    best = limit
    if footprints.curve_size[agent]:
        best = ring_gap(footprints.curve[agent, : footprints.curve_size[agent]], ring, best)
    if best > 0.0:
        best = ring_gap(footprints.box[agent], ring, best)
    return best
