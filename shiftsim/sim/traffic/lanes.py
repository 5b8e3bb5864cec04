"""Lanes that agents follow on their own, the next one where lanes fork, and lights along them."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.boxes import wrap_angle
from shiftsim.geometry.polylines import point_on_polyline, project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.world.layers import Lists, Polygons, Polylines, containing
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import LightStatus

NO_LANE = -1
GREEN, RED = 1, 2  # lights of an edge, added up where several are listed
CANDIDATES = 16  # lanes that may hold a point
_TURN, _ASIDE = 1.0, 3.0  # rad and m from a lane beyond which an agent does not follow it
_KEPT = 0.4  # rad that another lane must fit better to take the place of the one followed
_METRE = 0.15  # rad that a metre beside the centre line counts as, when lanes are chosen


class Lanes(NamedTuple):
    """What agents read of a map. E edges."""

    polygons: Polygons  # areas of the edges
    baselines: Polylines  # their centre lines
    outgoing: Lists  # edges an edge leads to
    speed_limits: FloatArray  # (E,) [m/s], NaN where the map has none
    is_red: BoolArray  # (E,) whether a red light is listed for the edge in the present step


def lanes_of(road: VectorMap) -> Lanes:
    """What agents read of a map; no light is red yet."""
    nothing = np.zeros(len(road.edges), np.bool_)
    return Lanes(road.edges.polygons, road.baselines, road.outgoing, road.speed_limits, nothing)


@kernel
def heading_at(lines: Polylines, line: int, along: float) -> float:
    """Direction of a line at an arc length [rad]."""
    start, stop = lines.ptr[line], lines.ptr[line + 1]
    length = lines.arc[stop - 1]
    low = min(max(along - 0.5, 0.0), max(length - 1.0, 0.0))
    ax, ay = point_on_polyline(lines.xy, lines.arc, start, stop, low)
    bx, by = point_on_polyline(lines.xy, lines.arc, start, stop, low + 1.0)
    return np.arctan2(by - ay, bx - ax)


@kernel
def _misfit(lines: Polylines, line: int, x: float, y: float, heading: float) -> float:
    """How badly a lane fits a pose: turn [rad], and metres aside counted as such; inf if not."""
    start, stop = lines.ptr[line], lines.ptr[line + 1]
    along = project_on_polyline(lines.xy, lines.arc, start, stop, x, y)
    px, py = point_on_polyline(lines.xy, lines.arc, start, stop, along)
    turn = abs(wrap_angle(heading - heading_at(lines, line, along)))
    aside = np.hypot(x - px, y - py)
    if turn > _TURN or aside > _ASIDE:
        return np.inf
    return turn + _METRE * aside


@kernel
def choose_lane(
    lanes: Lanes, x: float, y: float, heading: float, followed: int, found: IntArray
) -> int:
    """The edge that a pose fits best, or NO_LANE; the one followed and those behind it first."""
    best, least = NO_LANE, np.inf
    count = min(containing(lanes.polygons, x, y, found), len(found))
    for place in range(count):
        cost = _misfit(lanes.baselines, found[place], x, y, heading)
        if followed >= 0 and found[place] != followed:
            cost += _KEPT
            for entry in range(lanes.outgoing.ptr[followed], lanes.outgoing.ptr[followed + 1]):
                if lanes.outgoing.items[entry] == found[place]:
                    cost -= _KEPT
        if cost < least:
            best, least = found[place], cost
    return best


@kernel
def next_lane(lanes: Lanes, edge: int) -> int:
    """The edge behind another one that bends least, or NO_LANE."""
    lines, best, least = lanes.baselines, NO_LANE, np.inf
    end = heading_at(lines, edge, lines.arc[lines.ptr[edge + 1] - 1])
    for entry in range(lanes.outgoing.ptr[edge], lanes.outgoing.ptr[edge + 1]):
        after = lanes.outgoing.items[entry]
        length = lines.arc[lines.ptr[after + 1] - 1]
        bend = abs(wrap_angle(heading_at(lines, after, length) - end))
        if bend < least:
            best, least = after, bend
    return best


def light_flags(scenario: Scenario) -> tuple[IntArray, IntArray]:
    """(L,) edges with a light, and (T, L) which lights are listed at each iteration."""
    lights, index = scenario.traffic_lights, scenario.map.edges.index
    status = lights.status[scenario.iteration_rows]
    flags = GREEN * (status == LightStatus.GREEN) + RED * (status == LightStatus.RED)
    known = [i for i, name in enumerate(lights.connector_ids) if name in index]
    named = np.array([index[lights.connector_ids[i]] for i in known], np.int64)
    edges, place = np.unique(named, return_inverse=True)
    out = np.zeros((len(edges), len(status)), np.int64)
    # nuPlan rule 429: whoever asks for green finds green, whoever asks for red finds red
    np.bitwise_or.at(out, place, flags[:, known].T)
    return edges, np.ascontiguousarray(out.T)
