"""Angles, oriented boxes, polygons and polylines as kernels over plain arrays.

Conventions: a box is (x, y, heading, length, width) with its centre pose; its corners run
front-left, rear-left, rear-right, front-right. A ring is a closed or open sequence of vertices
(the closing edge is implied). Coordinates may be UTM: differences are always taken first.
"""

import numpy as np

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel, lean_kernel
from shiftsim.predicates import orientation

INTERIOR, BOUNDARY, EXTERIOR = 1, 0, -1


@lean_kernel
def wrap_angle(angle: float) -> float:
    """An angle wrapped to [-pi, pi) as nuPlan does: ((angle + pi) mod 2 pi) - pi [rad]."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def wrap_angles(angles: FloatArray) -> FloatArray:
    """Angles of any shape wrapped to [-pi, pi) [rad]."""
    wrapped: FloatArray = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped


def to_frame(poses: FloatArray, origin: FloatArray) -> FloatArray:
    """Poses (..., 3) of the map frame expressed in the frame of the pose `origin` (3,)."""
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = poses[..., 0] - origin[0], poses[..., 1] - origin[1]
    return np.stack(
        [cos * dx + sin * dy, -sin * dx + cos * dy, wrap_angles(poses[..., 2] - origin[2])], -1
    )


def from_frame(poses: FloatArray, origin: FloatArray) -> FloatArray:
    """Poses (..., 3) in the frame of the pose `origin` (3,) expressed in the map frame."""
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    x, y = poses[..., 0], poses[..., 1]
    return np.stack(
        [
            origin[0] + cos * x - sin * y,
            origin[1] + sin * x + cos * y,
            wrap_angles(poses[..., 2] + origin[2]),
        ],
        -1,
    )


@lean_kernel
def box_corners(x: float, y: float, heading: float, length: float, width: float, out: FloatArray):  # type: ignore[no-untyped-def]
    """Write the corners of a box into `out` (4, 2): front-left, rear-left, rear-right, front-right.

    nuPlan: the lateral axis is evaluated literally at heading + pi/2 (nuplan-simulation.md §3).
    """
    lon_x, lon_y = np.cos(heading), np.sin(heading)
    lat_x, lat_y = np.cos(heading + np.pi / 2.0), np.sin(heading + np.pi / 2.0)
    for index in range(4):
        lon = 0.5 * length if index == 0 or index == 3 else -0.5 * length
        lat = 0.5 * width if index < 2 else -0.5 * width
        # nuPlan: the offset is summed first, which decides the last bit
        out[index, 0] = x + (lat * lat_x + lon * lon_x)
        out[index, 1] = y + (lat * lat_y + lon * lon_y)


@lean_kernel
def _separated_by_edges(a: FloatArray, b: FloatArray) -> bool:
    count = len(a)
    for index in range(count):
        ax, ay = a[index, 0], a[index, 1]
        after = index + 1 if index + 1 < count else 0
        bx, by = a[after, 0], a[after, 1]
        if ax == bx and ay == by:
            continue
        outside = True
        for vertex in range(len(b)):
            if orientation(ax, ay, bx, by, b[vertex, 0], b[vertex, 1]) >= 0:
                outside = False
                break
        if outside:
            return True
    return False


@lean_kernel
def convex_intersect(a: FloatArray, b: FloatArray) -> bool:
    """Whether two convex rings (V, 2), counter-clockwise, share a point; touching counts.

    A separating line, if there is one, can be taken along an edge of either ring. Rings must have
    a positive area.
    """
    return not (_separated_by_edges(a, b) or _separated_by_edges(b, a))


@lean_kernel
def segments_intersect(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    """Whether the closed segments a-b and c-d, points (2,) each, share a point."""
    if (
        max(a[0], b[0]) < min(c[0], d[0])
        or max(c[0], d[0]) < min(a[0], b[0])
        or max(a[1], b[1]) < min(c[1], d[1])
        or max(c[1], d[1]) < min(a[1], b[1])
    ):
        return False
    o1 = orientation(a[0], a[1], b[0], b[1], c[0], c[1])
    o2 = orientation(a[0], a[1], b[0], b[1], d[0], d[1])
    if o1 * o2 > 0:
        return False
    o3 = orientation(c[0], c[1], d[0], d[1], a[0], a[1])
    o4 = orientation(c[0], c[1], d[0], d[1], b[0], b[1])
    return o3 * o4 <= 0


@lean_kernel
def locate_in_ring(ring: FloatArray, x: float, y: float) -> int:
    """Where a point lies relative to one ring (V, 2): INTERIOR, BOUNDARY or EXTERIOR."""
    parity, on_edge = ray_crossings(ring, len(ring) - 1, 0, len(ring), x, y)
    if on_edge:
        return BOUNDARY
    return INTERIOR if parity else EXTERIOR


@lean_kernel
def ray_crossings(
    xy: FloatArray, before: int, start: int, stop: int, x: float, y: float
) -> tuple[bool, bool]:
    """Whether a ray from (x, y) to +x crosses a chain an odd number of times, or starts on it.

    Args:
        xy: (V, 2) vertices [m].
        before: Vertex the chain starts at; for a whole ring its last one.
        start: Second vertex of the chain.
        stop: One past its last vertex.
        x: Point [m].
        y: Point [m].
    """
    parity = False
    px, py = xy[before, 0], xy[before, 1]
    for index in range(start, stop):
        qx, qy = xy[index, 0], xy[index, 1]
        if qx == x and qy == y:
            return False, True
        if py == y and qy == y:
            if min(px, qx) <= x <= max(px, qx):
                return False, True
        elif (py > y) != (qy > y) and (px >= x or qx >= x):
            if px > x and qx > x:
                parity = not parity
            else:
                side = orientation(px, py, qx, qy, x, y)
                if side == 0:
                    return False, True
                if (side > 0) == (qy > py):
                    parity = not parity
        px, py = qx, qy
    return parity, False


@lean_kernel
def locate_in_polygon(
    xy: FloatArray, ring_ptr: IntArray, first: int, last: int, x: float, y: float
) -> int:
    """Where a point lies relative to a polygon with holes: INTERIOR, BOUNDARY or EXTERIOR.

    Args:
        xy: (V, 2) vertices of all rings [m].
        ring_ptr: Ring r has the vertices ring_ptr[r] … ring_ptr[r + 1] - 1.
        first: First ring of the polygon (its shell; the others are holes).
        last: One past its last ring.
        x: Point [m].
        y: Point [m].
    """
    inside = False
    for ring in range(first, last):
        start, stop = ring_ptr[ring], ring_ptr[ring + 1]
        parity, on_edge = ray_crossings(xy, stop - 1, start, stop, x, y)
        if on_edge:
            return BOUNDARY
        if parity:
            inside = not inside
    return INTERIOR if inside else EXTERIOR


@lean_kernel
def point_segment_distance(x: float, y: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance from a point to the closed segment a-b [m]."""
    dx, dy = bx - ax, by - ay
    square = dx * dx + dy * dy
    if square == 0.0:
        return np.hypot(x - ax, y - ay)
    along = ((x - ax) * dx + (y - ay) * dy) / square
    if along <= 0.0:
        return np.hypot(x - ax, y - ay)
    if along >= 1.0:
        return np.hypot(x - bx, y - by)
    return abs((ay - y) * dx - (ax - x) * dy) / np.sqrt(square)


@lean_kernel
def polygon_distance(
    xy: FloatArray, ring_ptr: IntArray, first: int, last: int, x: float, y: float
) -> float:
    """Distance from a point to a polygon with holes (see `locate_in_polygon`), 0 inside [m]."""
    if locate_in_polygon(xy, ring_ptr, first, last, x, y) != EXTERIOR:
        return 0.0
    best = np.inf
    for ring in range(first, last):
        start, stop = ring_ptr[ring], ring_ptr[ring + 1]
        before = stop - 1
        for index in range(start, stop):
            best = min(
                best,
                point_segment_distance(
                    x, y, xy[before, 0], xy[before, 1], xy[index, 0], xy[index, 1]
                ),
            )
            before = index
    return best


@lean_kernel
def boundary_distance_below(
    xy: FloatArray, start: int, stop: int, x: float, y: float, limit: float
) -> float:
    """Distance from a point to the edges of a ring, or `limit` where that is not below it [m].

    Args:
        xy: (V, 2) vertices of all rings [m].
        start: First vertex of the ring.
        stop: One past its last vertex.
        x: Point [m].
        y: Point [m].
        limit: Distance of interest [m]; edges beyond it cost a comparison each.
    """
    best = limit
    ax, ay = xy[stop - 1, 0] - x, xy[stop - 1, 1] - y
    for index in range(start, stop):
        bx, by = xy[index, 0] - x, xy[index, 1] - y
        if (
            min(ax, bx) < best
            and max(ax, bx) > -best
            and min(ay, by) < best
            and max(ay, by) > -best
        ):
            best = min(best, point_segment_distance(0.0, 0.0, ax, ay, bx, by))
        ax, ay = bx, by
    return best


@lean_kernel
def ring_distance(a: FloatArray, b: FloatArray) -> float:
    """Distance between two convex rings (V, 2), counter-clockwise; 0 when they share a point."""
    if convex_intersect(a, b):
        return 0.0
    best = np.inf
    for swap in range(2):
        first, second = (a, b) if swap == 0 else (b, a)
        before = len(second) - 1
        for edge in range(len(second)):
            for vertex in range(len(first)):
                best = min(
                    best,
                    point_segment_distance(
                        first[vertex, 0],
                        first[vertex, 1],
                        second[before, 0],
                        second[before, 1],
                        second[edge, 0],
                        second[edge, 1],
                    ),
                )
            before = edge
    return best


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


def boxes_to_corners(poses: FloatArray, sizes: FloatArray) -> FloatArray:
    """Corners (..., 4, 2) of boxes given by poses (..., 3) and sizes (..., 2) length, width [m]."""
    heading = poses[..., 2]
    lon = np.stack([np.cos(heading), np.sin(heading)], -1)
    lat = np.stack([np.cos(heading + np.pi / 2.0), np.sin(heading + np.pi / 2.0)], -1)
    half_length = 0.5 * sizes[..., 0, None, None] * np.array([1.0, -1.0, -1.0, 1.0])[:, None]
    half_width = 0.5 * sizes[..., 1, None, None] * np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    corners: FloatArray = poses[..., None, :2] + (
        half_width * lat[..., None, :] + half_length * lon[..., None, :]
    )
    return corners


def boxes_intersect(
    poses_a: FloatArray, sizes_a: FloatArray, poses_b: FloatArray, sizes_b: FloatArray
) -> BoolArray:
    """(N,) whether box i of one list shares a point with box i of the other; touching counts."""
    return _pairs_intersect(boxes_to_corners(poses_a, sizes_a), boxes_to_corners(poses_b, sizes_b))


@kernel
def _pairs_intersect(a: FloatArray, b: FloatArray) -> BoolArray:
    out = np.empty(len(a), np.bool_)
    for index in range(len(a)):
        out[index] = convex_intersect(a[index], b[index])
    return out
