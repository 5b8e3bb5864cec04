"""Polylines: arc length, headings, projection; paths with headings.

The vertices of a path are grouped in short runs with bounding boxes, so that a search along it
looks at a few segments instead of all of them.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from shiftsim.geometry.rings import SLACK, point_segment_distance
from shiftsim.kernels import FloatArray, IntArray, kernel

RUN = 8  # segments per bounding box
_STRIDE = 4  # vertices between those that are looked at for a first bound


@kernel
def project_on_polyline(
    xy: FloatArray, arc: FloatArray, start: int, stop: int, x: float, y: float
) -> float:
    """Arc length of the point of a polyline nearest to (x, y); the first one on ties [m].

    It has the vertices `start` … `stop` - 1 of `xy` (V, 2), with arc lengths `arc` (V,) [m].
    """
    # no point of the line is nearer than the nearest of all, so any vertex gives a bound
    square = np.inf
    for index in range(start, stop, _STRIDE):
        dx, dy = xy[index, 0] - x, xy[index, 1] - y
        square = min(square, dx * dx + dy * dy)
    reach = (np.sqrt(square) + SLACK) * (np.sqrt(square) + SLACK)
    best = np.inf
    found = 0.0
    for index in range(start, stop - 1):
        ax, ay = xy[index, 0], xy[index, 1]
        bx, by = xy[index + 1, 0], xy[index + 1, 1]
        apart_x = max(min(ax, bx) - x, 0.0, x - max(ax, bx))
        apart_y = max(min(ay, by) - y, 0.0, y - max(ay, by))
        if apart_x * apart_x + apart_y * apart_y > reach:
            continue  # most often, and without a root
        dx, dy = bx - ax, by - ay
        square = dx * dx + dy * dy
        along = 0.0
        if square > 0.0:
            along = min(max(((x - ax) * dx + (y - ay) * dy) / square, 0.0), 1.0)
        distance = point_segment_distance(x, y, ax, ay, ax + dx, ay + dy)
        if distance < best:
            best = distance
            reach = min(reach, (best + SLACK) * (best + SLACK))
            found = arc[index] + along * np.sqrt(square)
    return found


@kernel
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


@kernel
def interpolate(start: float, end: float, span: float, ahead: float) -> float:
    """Value `ahead` of the start on the way from `start` to `end`, which is `span` long."""
    # nuPlan rule 4: the slope comes first, so that the end may be missed by the last bit
    return (end - start) / span * ahead + start


@kernel
def vertex_heading(xy: FloatArray, index: int, stop: int) -> float:
    """Direction from a vertex to the next one; the last, `stop` - 1, repeats that before [rad]."""
    at = min(index, stop - 2)
    return np.arctan2(xy[at + 1, 1] - xy[at, 1], xy[at + 1, 0] - xy[at, 0])


def vertex_headings(xy: FloatArray) -> FloatArray:
    """(K,) direction from each vertex (K, 2) to the next; the last repeats that before [rad]."""
    step = np.diff(xy, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    return np.append(heading, heading[-1])


def arc_lengths(xy: FloatArray, ptr: IntArray) -> FloatArray:
    """(V,) arc length at each vertex from the start of its own polyline, as in `Polylines` [m]."""
    dx, dy = np.diff(xy, axis=0).T
    out = np.zeros(len(xy))
    np.sqrt(dx * dx + dy * dy, out=out[1:])  # as nuPlan and GEOS do; hypot may round otherwise
    for start, stop in pairwise(ptr.tolist()):
        out[start:stop][:1] = 0.0
        np.cumsum(out[start:stop], out=out[start:stop])
    return out


class Path(NamedTuple):
    """A polyline with headings. K vertices, duplicates allowed."""

    xy: FloatArray  # (K, 2) vertices [m]
    heading: FloatArray  # (K,) unwrapped heading at each of them [rad]
    progress: FloatArray  # (K,) arc length at each of them [m]
    runs: FloatArray  # (R, 4) bounds of segments 8 r … 8 r + 7: min x, min y, max x, max y [m]


def make_path(poses: FloatArray, progress: FloatArray | None = None) -> Path:
    """A path through poses (K, 3), K >= 2; progress (K,) is their arc length unless given [m]."""
    xy = np.ascontiguousarray(poses[:, :2])
    if progress is None:
        progress = arc_lengths(xy, np.array([0, len(xy)]))
    runs = np.empty(((len(xy) - 2) // RUN + 1, 4))
    bound_runs(xy, runs)
    return Path(xy, np.unwrap(poses[:, 2]), progress, runs)


@kernel
def bound_runs(xy: FloatArray, runs: FloatArray) -> None:
    """Write the bounds of the runs of a polyline (K, 2) into `runs` (R, 4)."""
    for run in range(len(runs)):
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for index in range(run * RUN, min((run + 1) * RUN + 1, len(xy))):
            low_x, high_x = min(low_x, xy[index, 0]), max(high_x, xy[index, 0])
            low_y, high_y = min(low_y, xy[index, 1]), max(high_y, xy[index, 1])
        runs[run, 0], runs[run, 1], runs[run, 2], runs[run, 3] = low_x, low_y, high_x, high_y


@kernel
def pose_at(path: Path, progress: float) -> tuple[float, float, float]:
    """Pose x [m], y [m], heading [rad] at a progress, clamped to the path; heading not wrapped."""
    last = len(path.progress) - 1
    s = min(max(progress, path.progress[0]), path.progress[last])
    upper = min(max(int(np.searchsorted(path.progress, s)), 1), last)
    lower = upper - 1
    ahead, span = s - path.progress[lower], path.progress[upper] - path.progress[lower]
    return (
        interpolate(path.xy[lower, 0], path.xy[upper, 0], span, ahead),
        interpolate(path.xy[lower, 1], path.xy[upper, 1], span, ahead),
        interpolate(path.heading[lower], path.heading[upper], span, ahead),
    )


@kernel
def project(path: Path, x: float, y: float, guess: int) -> tuple[float, float, int]:
    """The point of the path nearest to (x, y), the first one on ties: progress, distance [m], run.

    `guess` is the run that is probably nearest, such as the one of the last call.
    """
    num_runs = len(path.runs)
    guess = min(max(guess, 0), num_runs - 1)
    least, along = _project_on_run(path, guess, x, y)
    bound = least + SLACK
    best, found, run_found = np.inf, 0.0, guess
    for run in range(num_runs):
        distance, progress = least, along
        if run != guess:
            dx = max(path.runs[run, 0] - x, 0.0, x - path.runs[run, 2])
            dy = max(path.runs[run, 1] - y, 0.0, y - path.runs[run, 3])
            reach = min(bound, best + SLACK)
            if dx * dx + dy * dy > reach * reach:
                continue
            distance, progress = _project_on_run(path, run, x, y)
        if distance < best:
            best, found, run_found = distance, progress, run
    return found, best, run_found


@kernel
def _project_on_run(path: Path, run: int, x: float, y: float) -> tuple[float, float]:
    best, found = np.inf, 0.0
    for index in range(run * RUN, min((run + 1) * RUN, len(path.xy) - 1)):
        ax, ay = path.xy[index, 0], path.xy[index, 1]
        bx, by = path.xy[index + 1, 0], path.xy[index + 1, 1]
        distance = point_segment_distance(x, y, ax, ay, bx, by)
        if distance < best:
            dx, dy = bx - ax, by - ay
            square = dx * dx + dy * dy
            along = 0.0
            if square > 0.0:
                along = min(max(((x - ax) * dx + (y - ay) * dy) / square, 0.0), 1.0)
            best, found = distance, path.progress[index] + along * np.sqrt(square)
    return best, found


@kernel
def window(path: Path, low: float, high: float) -> tuple[int, int]:
    """First vertex, and one past the last one, with a progress in [low, high], both clamped."""
    end = path.progress[-1]
    first = int(np.searchsorted(path.progress, min(max(low, 0.0), end)))
    last = int(np.searchsorted(path.progress, min(max(high, 0.0), end), side="right"))
    return first, max(first, last)


@kernel
def write_frenet(
    poses: FloatArray,  # (K, 3) vertices and their headings
    ahead: FloatArray,  # (K, 2) unit vectors along the headings
    arc: FloatArray,  # (K,) arc length at each of them, strictly increasing [m]
    points: FloatArray,  # (P, 2) [m]
    out: FloatArray,  # (P, 3) written: arc length, offset to the left [m], heading [rad]
) -> None:
    """Where points lie along and beside a line, the nearest place where several would do.

    Between two vertices the heading turns with the blend of their unit vectors, so that a point
    within the radius of a bend has one place only. Beyond its ends the line goes straight on.
    """
    last = len(arc) - 1
    for point in range(len(points)):
        least, before = np.inf, 0.0
        for vertex in range(last + 1):
            dx, dy = points[point, 0] - poses[vertex, 0], points[point, 1] - poses[vertex, 1]
            tx, ty = ahead[vertex, 0], ahead[vertex, 1]
            along, across = dx * tx + dy * ty, dy * tx - dx * ty
            if (vertex == 0 and along < 0.0) or (vertex == last and along > 0.0):
                distance = np.hypot(dx, dy)
                if distance < least:
                    least = distance
                    out[point, 0], out[point, 1] = arc[vertex] + along, across
                    out[point, 2] = poses[vertex, 2]
            if vertex > 0 and along <= 0.0 <= before:
                found = _foot(poses, ahead, vertex, points[point, 0], points[point, 1])
                if abs(found[1]) < least:
                    least = abs(found[1])
                    out[point, 0] = arc[vertex - 1] + found[0] * (arc[vertex] - arc[vertex - 1])
                    out[point, 1], out[point, 2] = found[1], found[2]
            before = along


@kernel
def _foot(
    poses: FloatArray, ahead: FloatArray, vertex: int, x: float, y: float
) -> tuple[float, float, float]:
    """Where the step to a vertex has a point right beside it: share of it, offset, heading."""
    ax, ay = poses[vertex - 1, 0], poses[vertex - 1, 1]
    tx, ty = ahead[vertex - 1, 0], ahead[vertex - 1, 1]
    ex, ey = poses[vertex, 0] - ax, poses[vertex, 1] - ay
    ux, uy = ahead[vertex, 0] - tx, ahead[vertex, 1] - ty
    qx, qy = x - ax, y - ay
    # (q - w e) (t + w u) = 0 for the share w: a w^2 + b w + c = 0, falling from c >= 0
    a, b, c = -(ex * ux + ey * uy), qx * ux + qy * uy - ex * tx - ey * ty, qx * tx + qy * ty
    root = np.sqrt(max(b * b - 4.0 * a * c, 0.0))
    share = min(max(2.0 * c / (root - b), 0.0), 1.0) if root > b else 0.0
    nx, ny = tx + share * ux, ty + share * uy
    size = np.hypot(nx, ny)
    across = ((qy - share * ey) * nx - (qx - share * ex) * ny) / size
    return share, across, np.arctan2(ny, nx)
