"""Kernels of the Diffusion Planner's features: lanes and agents around the ego, in its frame."""

from typing import NamedTuple

import numpy as np

from shiftsim.geometry.rings import segments_intersect
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned.map_features import resample
from shiftsim.world.layers import Polygons, Polylines, distance_to, meets_convex

POINTS = 20  # of a lane
AGENTS, SAMPLES, AGENT_COLUMNS = 32, 21, 11
OBJECTS, OBJECT_COLUMNS = 5, 10
GREEN, RED, UNKNOWN = 0, 2, 3  # one-hot positions of a light
LANE_COLUMNS = 12
VEHICLE, PEDESTRIAN, BICYCLE, CONE, BARRIER, SIGN, GENERIC = range(7)  # state.AgentKind


class LaneLines(NamedTuple):
    """Every edge of a map as the network reads it, in the map frame. E edges."""

    # (E, POINTS, 8) x, y, step to the next point (0 at the last), offset to the left and to the
    # right boundary [m]
    rows: FloatArray
    bounds: FloatArray  # (E, 4) min x, min y, max x, max y of the centre lines [m]
    limits: FloatArray  # (E,) speed limits [m/s], NaN where the map has none
    blocks: IntArray  # (E,) block of each edge, -1 where unknown


def resample_lanes(lines: Polylines, left: Polylines, right: Polylines) -> FloatArray:
    """Centre lines and boundaries at equally spaced arc lengths, as rows of `LaneLines`.

    A boundary that runs the other way is turned round; one that is missing or of one point is taken
    for the centre line.
    """
    rows = np.zeros((len(lines.ptr) - 1, POINTS, 8))
    center, side = np.empty((len(rows), POINTS, 2)), np.empty((len(rows), POINTS, 2))
    resample(lines, lines, center)
    rows[..., :2] = center
    rows[:, :-1, 2:4] = np.diff(center, axis=1)
    for column, boundary in ((4, left), (6, right)):
        resample(boundary, lines, side)
        apart = np.hypot(*np.moveaxis(side[:, [0, -1]] - center[:, :1], -1, 0))
        turned = apart[:, 1] < apart[:, 0]
        side[turned] = side[turned, ::-1]
        rows[..., column : column + 2] = side - center
    return rows


def line_bounds(lines: Polylines) -> FloatArray:
    """(M, 4) min x, min y, max x, max y of each line; of an empty one nothing is within [m]."""
    out = np.tile([np.inf, np.inf, -np.inf, -np.inf], (len(lines.ptr) - 1, 1))
    line_of = np.repeat(np.arange(len(out)), np.diff(lines.ptr))
    np.minimum.at(out[:, :2], line_of, lines.xy)
    np.maximum.at(out[:, 2:], line_of, lines.xy)
    return out


@kernel
def lanes_in_square(
    areas: Polygons, lines: Polylines, bounds: FloatArray, num_lanes: int, square: FloatArray
) -> IntArray:
    """Lanes whose area, and connectors whose centre line shares a point with a square, ascending.

    `areas`, `lines` and their `bounds` are of all edges; `square` has the corners (4, 2), counter-
    clockwise from the upper right one [m].
    """
    low, high = square[2], square[0]
    out = np.empty(len(bounds), np.int64)
    found = 0
    for edge in range(len(bounds)):
        box = areas.bounds[edge] if edge < num_lanes else bounds[edge]
        if box[0] > high[0] or box[2] < low[0] or box[1] > high[1] or box[3] < low[1]:
            continue
        # nuPlan rule 334: the layer of lane connectors that is asked holds lines, not areas
        if edge < num_lanes:
            meets = meets_convex(areas, edge, square)
        else:
            meets = _line_meets(lines, edge, square)
        if meets:
            out[found] = edge
            found += 1
    return out[:found].copy()


@kernel
def _line_meets(lines: Polylines, line: int, square: FloatArray) -> bool:
    """Whether a line shares a point with an axis-parallel square (see `lanes_in_square`)."""
    low, high = square[2], square[0]
    start, stop = lines.ptr[line], lines.ptr[line + 1]
    for vertex in range(start, stop):
        x, y = lines.xy[vertex, 0], lines.xy[vertex, 1]
        if low[0] <= x <= high[0] and low[1] <= y <= high[1]:
            return True
    for vertex in range(start + 1, stop):
        for corner in range(4):
            if segments_intersect(
                lines.xy[vertex - 1], lines.xy[vertex], square[corner - 1], square[corner]
            ):
                return True
    return False


@kernel
def nearest_lanes(
    near: IntArray, areas: Polygons, lines: Polylines, x: float, y: float, most: int
) -> IntArray:
    """The nearest edges of a list, at most `most`.

    Sorted by the distance to the nearest vertex of the centre line (nuPlan rule 335); among equals,
    which are common where a lane and its connectors meet, by the distance to the area, then as
    listed.
    """
    keys = np.empty(len(near))
    for index, edge in enumerate(near):
        least = np.inf
        for vertex in range(lines.ptr[edge], lines.ptr[edge + 1]):
            dx, dy = lines.xy[vertex, 0] - x, lines.xy[vertex, 1] - y
            least = min(least, dx * dx + dy * dy)
        keys[index] = np.sqrt(least)
    order = np.argsort(keys, kind="mergesort")
    distances = np.empty(len(near))
    first = 0
    while first < len(order) and first < most:
        stop = first + 1
        while stop < len(order) and keys[order[stop]] == keys[order[first]]:
            stop += 1
        if stop > first + 1:
            for index in range(first, stop):
                distances[index] = distance_to(areas, near[order[index]], x, y)
            ranks = np.argsort(distances[first:stop], kind="mergesort")
            order[first:stop] = order[first:stop][ranks]
        first = stop
    return near[order[:most]]


@kernel
def fill_lanes(
    lanes: LaneLines,
    edges: IntArray,
    lights: IntArray,
    anchor: FloatArray,
    out: tuple[FloatArray, FloatArray, BoolArray],
) -> None:
    """Write lanes in the ego frame; `lights` has the one-hot position of the light of each.

    `out`: float32 rows (L, POINTS, 12), limits (L, 1) and whether known (L, 1), zero before.
    """
    rows, limits, known = out
    cos, sin = np.cos(anchor[2]), np.sin(anchor[2])
    for index in range(min(len(edges), len(rows))):
        edge = edges[index]
        for point in range(POINTS):
            given, row = lanes.rows[edge, point], rows[index, point]
            for pair in range(4):
                x, y = given[2 * pair], given[2 * pair + 1]
                if pair == 0:
                    x, y = x - anchor[0], y - anchor[1]
                row[2 * pair] = cos * x + sin * y
                row[2 * pair + 1] = cos * y - sin * x
            row[8 + lights[index]] = 1.0
        if not np.isnan(lanes.limits[edge]):
            limits[index, 0] = lanes.limits[edge]
            known[index, 0] = True


@kernel
def fill_agents(
    tracks: IntArray,
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
    kinds: IntArray,
    anchor: FloatArray,
    out: FloatArray,
) -> None:
    """Write histories of tracks present now into `out`, float32 (32, 21, 11), in the ego frame.

    A missing sample takes the values of the next later one (nuPlan rule 337); so do those before
    the oldest sample of a short history. Arrays of the tracks are (T, N, ...) and `kinds` (N,).
    """
    cos, sin = np.cos(anchor[2]), np.sin(anchor[2])
    for index, track in enumerate(tracks):
        known = len(valid) - 1
        for back in range(SAMPLES):
            sample = len(valid) - 1 - back
            if sample >= 0 and valid[sample, track]:
                known = sample
            row = out[index, SAMPLES - 1 - back]
            x, y = poses[known, track, 0] - anchor[0], poses[known, track, 1] - anchor[1]
            turn = poses[known, track, 2] - anchor[2]
            row[0], row[1] = cos * x + sin * y, cos * y - sin * x
            row[2], row[3] = np.cos(turn), np.sin(turn)
            x, y = velocities[known, track, 0], velocities[known, track, 1]
            row[4], row[5] = cos * x + sin * y, cos * y - sin * x
            row[6], row[7] = sizes[known, track, 1], sizes[known, track, 0]
            row[8 + kinds[track]] = 1.0
