"""Paths of reactive agents: built from baselines, extended along the lane graph, interpolated.

An agent's footprint is its box and the buffer of the piece of its path just ahead.

A path is an array of vertices (K, 4): x [m], y [m], heading [rad], progress [m]. Headings are
unwrapped along the path and wrapped when a pose is read.
"""

import numpy as np

from shiftsim.geometry.boxes import box_corners, wrap_angle
from shiftsim.geometry.polylines import interpolate, vertex_heading
from shiftsim.geometry.rings import ring_bounds
from shiftsim.kernels import FloatArray, kernel
from shiftsim.sim.traffic.idm.buffer import buffer_curve
from shiftsim.sim.traffic.idm.scene import (
    HEADING,
    MAX_ROUTE,
    PROGRESS,
    Fleet,
    Footprints,
    IdmParameters,
    LaneGraph,
)
from shiftsim.sim.traffic.lanes import GREEN, RED
from shiftsim.world.lanes import initial_curvature
from shiftsim.world.layers import Polylines

_SAME_PROGRESS = 1e-8  # m, vertices closer than this count as one (numpy's isclose to zero)


@kernel
def append_baseline(baselines: Polylines, edge: int, path: FloatArray, size: int) -> int:
    """Append the vertices of a baseline to a raw path; returns the new number of vertices."""
    start, stop = baselines.ptr[edge], baselines.ptr[edge + 1]
    for vertex in range(start, stop):
        path[size, 0] = baselines.xy[vertex, 0]
        path[size, 1] = baselines.xy[vertex, 1]
        path[size, HEADING] = vertex_heading(baselines.xy, vertex, stop)
        size += 1
    return size


@kernel
def finish_path(path: FloatArray, size: int) -> int:
    """Fill in progress, drop repeated vertices and the last one, unwrap the headings.

    The first `size` vertices of `path` (K, 4) count. Returns how many are left, at its start.
    """
    progress = 0.0
    num_left = 0
    for vertex in range(size - 1):  # nuPlan rule 122: the last vertex is always lost
        x, y = path[vertex, 0], path[vertex, 1]
        heading = path[vertex, HEADING]
        dx, dy = path[vertex + 1, 0] - x, path[vertex + 1, 1] - y
        following = progress + np.sqrt(dx * dx + dy * dy)
        if abs(following - progress) > _SAME_PROGRESS:
            if num_left:
                before = path[num_left - 1, HEADING]
                heading = before + wrap_angle(heading - before)
            path[num_left, 0] = x
            path[num_left, 1] = y
            path[num_left, HEADING] = heading
            path[num_left, PROGRESS] = progress
            num_left += 1
        progress = following
    return num_left


@kernel
def clamp_progress(path: FloatArray, size: int, progress: float) -> float:
    """Progress limited to the path [m]."""
    return max(path[0, PROGRESS], min(progress, path[size - 1, PROGRESS]))


@kernel
def first_after(path: FloatArray, size: int, progress: float) -> int:
    """First vertex of a path whose progress exceeds `progress`; `size` if there is none."""
    low, high = 0, size
    while low < high:
        middle = (low + high) // 2
        if path[middle, PROGRESS] > progress:
            high = middle
        else:
            low = middle + 1
    return low


@kernel
def pose_on_path(path: FloatArray, size: int, progress: float) -> tuple[float, float, float]:
    """Pose x [m], y [m], heading [rad] at a progress within the path; heading wrapped."""
    index = min(max(first_after(path, size, progress), 1), size - 1)
    start = path[index - 1, PROGRESS]
    span, along = path[index, PROGRESS] - start, progress - start
    heading = interpolate(path[index - 1, HEADING], path[index, HEADING], span, along)
    x, y = _point_before(path, index, progress)
    return x, y, wrap_angle(heading)


@kernel
def _point_before(path: FloatArray, index: int, progress: float) -> tuple[float, float]:
    """Point x, y [m] at a progress on the segment that ends at a vertex."""
    start = path[index - 1, PROGRESS]
    span, along = path[index, PROGRESS] - start, progress - start
    x = interpolate(path[index - 1, 0], path[index, 0], span, along)
    return x, interpolate(path[index - 1, 1], path[index, 1], span, along)


@kernel
def choose_successor(graph: LaneGraph, edge: int) -> int:
    """The open outgoing edge that starts straightest, the first one on ties; -1 if none is open."""
    best, chosen = np.inf, -1
    for entry in range(graph.outgoing.ptr[edge], graph.outgoing.ptr[edge + 1]):
        following = graph.outgoing.items[entry]
        # nuPlan rule 126: with lights only green is open, without any listed state but red
        lights, has_lights = graph.lights[following], graph.has_lights[following]
        is_open = lights & GREEN != 0 if has_lights else lights & RED == 0
        curvature = initial_curvature(graph.baselines, following)
        if is_open and curvature < best:
            best, chosen = curvature, following
    return chosen


@kernel
def extend_route(fleet: Fleet, agent: int, graph: LaneGraph, parameters: IdmParameters) -> int:
    """Lengthen the path of an agent until it is long enough or no edge is open.

    Returns:
        0, or how many vertices a path needs where they do not fit; to be called again then.
    """
    path = fleet.path[agent]
    while needs_longer_path(fleet, agent, parameters):
        size = fleet.path_size[agent]
        chosen = choose_successor(graph, fleet.route[agent, fleet.route_size[agent] - 1])
        if chosen < 0:
            return 0
        ptr = graph.baselines.ptr
        needed = size + 1 + ptr[chosen + 1] - ptr[chosen]
        if needed > len(path):
            return needed
        raw = _drop_driven(path, size, clamp_progress(path, size, fleet.progress[agent]))
        raw = append_baseline(graph.baselines, chosen, path, raw)
        fleet.path_size[agent] = finish_path(path, raw)
        fleet.progress[agent] = 0.0
        route, last = fleet.route[agent], fleet.route_size[agent]
        if last == MAX_ROUTE:  # the oldest edge is dropped
            route[:-1] = route[1:].copy()
            last -= 1
        route[last] = chosen
        fleet.route_size[agent] = last + 1
    return 0


@kernel
def needs_longer_path(fleet: Fleet, agent: int, parameters: IdmParameters) -> bool:
    """Whether the path of an agent is too short for its speed."""
    path_end = fleet.path[agent, fleet.path_size[agent] - 1, PROGRESS]
    wanted = parameters.min_path_length + fleet.target[agent] * parameters.headway
    return path_end - fleet.progress[agent] < wanted


@kernel
def _drop_driven(path: FloatArray, size: int, progress: float) -> int:
    """Move what is ahead of `progress` to the front of a path; returns how many vertices."""
    after = first_after(path, size, progress)
    if after == size:
        # nuPlan rule 127: at its very end a path is left with its last two vertices
        for column in range(3):
            path[0, column] = path[size - 2, column]
            path[1, column] = path[size - 1, column]
        return 2
    x, y, heading = pose_on_path(path, size, progress)
    front = path[after - 1, HEADING]
    path[0, 0], path[0, 1], path[0, HEADING] = x, y, front + wrap_angle(heading - front)
    num_left = 1
    for vertex in range(after, size):
        for column in range(3):
            path[num_left, column] = path[vertex, column]
        num_left += 1
    return num_left


@kernel
def set_box(
    footprints: Footprints,
    index: int,
    x: float,
    y: float,
    heading: float,
    length: float,
    width: float,
) -> None:
    """Put something where its box is, without a path ahead."""
    box, bounds = footprints.box[index], footprints.bounds
    box_corners(x, y, heading, length, width, box)
    footprints.present[index] = True
    bounds[index, 0], bounds[index, 1], bounds[index, 2], bounds[index, 3] = ring_bounds(box)


@kernel
def add_curve(line: FloatArray, distance: float, curve: FloatArray, bounds: FloatArray) -> int:
    """Write the buffer of a line (K, 2) and add it to bounds (4,); returns its size."""
    size = buffer_curve(line, distance, curve)
    low_x, low_y, high_x, high_y = ring_bounds(curve[:size])
    bounds[0], bounds[1] = min(bounds[0], low_x), min(bounds[1], low_y)
    bounds[2], bounds[3] = max(bounds[2], high_x), max(bounds[3], high_y)
    return size


@kernel
def cut_path(path: FloatArray, size: int, start: float, stop: float, line: FloatArray) -> int:
    """Write a path between two progresses, clamped to it, into `line` (K, 2); returns its size."""
    first, last = clamp_progress(path, size, start), clamp_progress(path, size, stop)
    after = first_after(path, size, first)
    if after == size or not path[0, PROGRESS] < last:
        # nuPlan rule 127: at an end of the path two vertices are left
        head = size - 2 if after == size else 0
        for vertex in range(2):
            line[vertex, 0] = path[head + vertex, 0]
            line[vertex, 1] = path[head + vertex, 1]
        return 2
    line[0, 0], line[0, 1] = _point_before(path, after, first)
    count = 1
    while after < size and path[after, PROGRESS] < last:
        line[count, 0], line[count, 1] = path[after, 0], path[after, 1]
        count += 1
        after += 1
    after = min(max(first_after(path, size, last), 1), size - 1)
    line[count, 0], line[count, 1] = _point_before(path, after, last)
    return count + 1
