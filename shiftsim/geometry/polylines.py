"""Polylines: arc length, headings, nearest vertices, projection, points by distance."""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray, lean_kernel
from shiftsim.geometry.rings import point_segment_distance


@lean_kernel
def project_on_polyline(
    xy: FloatArray, arc: FloatArray, start: int, stop: int, x: float, y: float
) -> float:
    """Arc length of the point of a polyline nearest to (x, y); the first one on ties [m].

    Args:
        xy: (V, 2) vertices of many polylines [m].
        arc: (V,) arc length at each vertex, from the start of its own polyline [m].
        start: First vertex of the polyline.
        stop: One past its last vertex.
        x: Point [m].
        y: Point [m].
    """
    best = np.inf
    found = 0.0
    for index in range(start, stop - 1):
        ax, ay = xy[index, 0], xy[index, 1]
        dx, dy = xy[index + 1, 0] - ax, xy[index + 1, 1] - ay
        square = dx * dx + dy * dy
        along = 0.0
        if square > 0.0:
            along = min(max(((x - ax) * dx + (y - ay) * dy) / square, 0.0), 1.0)
        distance = point_segment_distance(x, y, ax, ay, ax + dx, ay + dy)
        if distance < best:
            best = distance
            found = arc[index] + along * np.sqrt(square)
    return found


@lean_kernel
def point_on_polyline(
    xy: FloatArray, arc: FloatArray, start: int, stop: int, distance: float
) -> tuple[float, float]:
    """Point of a polyline at an arc length, clamped to its ends (arguments as above) [m]."""
    if distance <= 0.0:
        return xy[start, 0], xy[start, 1]
    if distance >= arc[stop - 1]:
        return xy[stop - 1, 0], xy[stop - 1, 1]
    index = start + int(np.searchsorted(arc[start:stop], distance, side="right")) - 1
    index = min(max(index, start), stop - 2)
    span = arc[index + 1] - arc[index]
    along = (distance - arc[index]) / span if span > 0.0 else 0.0
    return (
        xy[index, 0] + along * (xy[index + 1, 0] - xy[index, 0]),
        xy[index, 1] + along * (xy[index + 1, 1] - xy[index, 1]),
    )


@lean_kernel
def interpolate(start: float, end: float, span: float, ahead: float) -> float:
    """Value `ahead` of the start on the way from `start` to `end`, which is `span` long."""
    # nuPlan rule 4: the slope comes first, so that the end may be missed by the last bit
    return (end - start) / span * ahead + start


@lean_kernel
def vertex_heading(xy: FloatArray, index: int, stop: int) -> float:
    """Direction from a vertex to the next one; the last, `stop` - 1, repeats that before [rad]."""
    at = min(index, stop - 2)
    return np.arctan2(xy[at + 1, 1] - xy[at, 1], xy[at + 1, 0] - xy[at, 0])


def vertex_headings(xy: FloatArray) -> FloatArray:
    """(K,) direction from each vertex (K, 2) to the next; the last repeats that before [rad]."""
    step = np.diff(xy, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.append(heading, heading[-1])


@lean_kernel
def nearest_vertex(
    xy: FloatArray, start: int, stop: int, stride: int, x: float, y: float
) -> tuple[int, float]:
    """The vertex nearest to a point and its distance [m]; the first one on ties.

    Args:
        xy: (V, 2) vertices of many polylines [m].
        start: First vertex of the polyline.
        stop: One past its last vertex.
        stride: Only every so manieth vertex is looked at.
        x: Point [m].
        y: Point [m].
    """
    best, found = np.inf, start
    for index in range(start, stop, stride):
        distance = np.hypot(xy[index, 0] - x, xy[index, 1] - y)
        if distance < best:
            best, found = distance, index
    return found, best


def arc_lengths(xy: FloatArray, ptr: IntArray) -> FloatArray:
    """(V,) arc length at each vertex from the start of its own polyline [m].

    Args:
        xy: (V, 2) vertices of all polylines [m].
        ptr: Polyline i has the vertices ptr[i] … ptr[i + 1] - 1.
    """
    out = np.zeros(len(xy))
    for start, stop in zip(ptr[:-1].tolist(), ptr[1:].tolist(), strict=True):
        if stop > start + 1:
            steps = np.diff(xy[start:stop], axis=0)
            out[start + 1 : stop] = np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))
    return out
