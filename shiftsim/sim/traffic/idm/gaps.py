"""Gaps and contacts between the outlines of road users.

An outline is one or two rings: a box, and the buffer of a piece of path (`buffer`), whose ring may
cross itself inside. Their union is meant; touching counts as contact. Bounds make the search short,
and exact predicates decide whether two edges meet.
"""

import numpy as np

from shiftsim.geometry.rings import orientation, point_segment_distance, ring_bounds, segments_meet
from shiftsim.kernels import FloatArray, kernel

_ROUNDING = 1.0 + 1e-9  # factor on a square below which bounds of distances are equal


@kernel
def winds_around(ring: FloatArray, x: float, y: float) -> bool:
    """Whether a ring (V, 2) winds around a point, or has it on an edge."""
    winding = 0
    px, py = ring[-1, 0], ring[-1, 1]
    for vertex in range(len(ring)):
        qx, qy = ring[vertex, 0], ring[vertex, 1]
        if min(py, qy) <= y <= max(py, qy):
            side = orientation(px, py, qx, qy, x, y)
            if side == 0 and min(px, qx) <= x <= max(px, qx):
                return True
            if py <= y < qy and side > 0:
                winding += 1
            elif qy <= y < py and side < 0:
                winding -= 1
        px, py = qx, qy
    return winding != 0


@kernel
def ring_gap(a: FloatArray, b: FloatArray, limit: float) -> float:
    """Distance between what two rings (V, 2) enclose, at most `limit`; 0 where they meet [m]."""
    low_x, low_y, high_x, high_y = ring_bounds(b)
    # two vertices that are close to one another give a bound, which makes the search short
    x, y, _ = _nearest_vertex(b, a[0, 0], a[0, 1])
    x, y, _ = _nearest_vertex(a, x, y)
    x, y, _ = _nearest_vertex(b, x, y)
    _, _, square = _nearest_vertex(a, x, y)
    best = min(limit, np.sqrt(square) * (1.0 + 1e-12))
    px, py = a[-1, 0], a[-1, 1]
    for edge in range(len(a)):
        qx, qy = a[edge, 0], a[edge, 1]
        x0, x1, y0, y1 = min(px, qx), max(px, qx), min(py, qy), max(py, qy)
        dx, dy = max(low_x - x1, x0 - high_x, 0.0), max(low_y - y1, y0 - high_y, 0.0)
        if dx * dx + dy * dy <= best * best * _ROUNDING:
            rx, ry = b[-1, 0], b[-1, 1]
            for vertex in range(len(b)):
                sx, sy = b[vertex, 0], b[vertex, 1]
                dx = max(min(rx, sx) - x1, x0 - max(rx, sx), 0.0)
                dy = max(min(ry, sy) - y1, y0 - max(ry, sy), 0.0)
                if dx * dx + dy * dy <= best * best * _ROUNDING:
                    if segments_meet(px, py, qx, qy, rx, ry, sx, sy):
                        return 0.0
                    best = min(best, point_segment_distance(qx, qy, rx, ry, sx, sy))
                    best = min(best, point_segment_distance(sx, sy, px, py, qx, qy))
                rx, ry = sx, sy
        px, py = qx, qy
    if winds_around(b, a[0, 0], a[0, 1]) or winds_around(a, b[0, 0], b[0, 1]):
        return 0.0
    return best


@kernel
def _nearest_vertex(ring: FloatArray, x: float, y: float) -> tuple[float, float, float]:
    """The vertex of a ring (V, 2) nearest to a point: x, y [m], and the squared distance [m^2]."""
    square, nearest = np.inf, 0
    for vertex in range(len(ring)):
        dx, dy = ring[vertex, 0] - x, ring[vertex, 1] - y
        apart = dx * dx + dy * dy
        if apart < square:
            square, nearest = apart, vertex
    return ring[nearest, 0], ring[nearest, 1], square
