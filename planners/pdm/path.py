"""The paths PDM-Closed drives along: poses by progress, projection, and offset copies.

Vertices are grouped in short runs with bounding boxes, so that a projection looks at a few segments
instead of all of them (pdm-closed.md §4.3).
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, lean_kernel
from shiftsim.geometry.rings import point_segment_distance

MIN_PROGRESS = 1e-5  # m, nuPlan: keeps clear of a duplicate vertex at the very start
RUN = 8  # segments per bounding box
_SLACK = 1e-6  # m, more than rounding can change a distance by


class PdmPath(NamedTuple):
    """A polyline with headings. K vertices, duplicates allowed.

    Attributes:
        xy: (K, 2) vertices [m].
        heading: (K,) unwrapped heading at each of them [rad].
        progress: (K,) arc length at each of them [m].
        runs: (R, 4) bounds of segments 8 r … 8 r + 7: min x, min y, max x, max y [m].
    """

    xy: FloatArray
    heading: FloatArray
    progress: FloatArray
    runs: FloatArray


def make_path(poses: FloatArray) -> PdmPath:
    """A path through poses (K, 3) x [m], y [m], heading [rad]; K >= 2."""
    xy = np.ascontiguousarray(poses[:, :2])
    steps = np.hypot(*np.diff(xy, axis=0).T)
    progress = np.concatenate([[0.0], np.cumsum(steps)])
    low = np.minimum(xy[:-1], xy[1:])
    high = np.maximum(xy[:-1], xy[1:])
    starts = np.arange(0, len(low), RUN)
    runs = np.hstack([np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)])
    return PdmPath(xy, np.unwrap(poses[:, 2]), progress, runs)


def offset_poses(poses: FloatArray, offset: float) -> FloatArray:
    """Poses (K, 3) moved sideways, to the left where `offset` is positive [m]."""
    out = poses.copy()
    out[:, 0] += offset * np.cos(poses[:, 2] + np.pi / 2.0)
    out[:, 1] += offset * np.sin(poses[:, 2] + np.pi / 2.0)
    return out


@lean_kernel
def interpolate(path: PdmPath, progress: float, out: FloatArray) -> None:
    """Write the pose (3,) at a progress, clamped to the path, into `out`; zeros for NaN."""
    if progress != progress:
        # nuPlan: a speed limit of 0 makes progress undefined (pdm-closed.md §11 Q6)
        out[0], out[1], out[2] = 0.0, 0.0, 0.0
        return
    last = len(path.progress) - 1
    s = min(max(progress, MIN_PROGRESS), path.progress[last])
    upper = min(max(int(np.searchsorted(path.progress, s)), 1), last)
    lower = upper - 1
    ahead = s - path.progress[lower]
    span = path.progress[upper] - path.progress[lower]
    out[0] = (path.xy[upper, 0] - path.xy[lower, 0]) / span * ahead + path.xy[lower, 0]
    out[1] = (path.xy[upper, 1] - path.xy[lower, 1]) / span * ahead + path.xy[lower, 1]
    turn = (path.heading[upper] - path.heading[lower]) / span * ahead + path.heading[lower]
    out[2] = np.arctan2(np.sin(turn), np.cos(turn))


@lean_kernel
def project(path: PdmPath, x: float, y: float, guess: int) -> tuple[float, float, int]:
    """The point of the path nearest to (x, y); the first one on ties.

    Args:
        path: The path.
        x: Point [m].
        y: Point [m].
        guess: Run of segments that is probably nearest, such as the result of the last call.

    Returns:
        Its progress [m], its distance [m] and its run of segments.
    """
    num_runs = len(path.runs)
    guess = min(max(guess, 0), num_runs - 1)
    bound = _project_on_run(path, guess, x, y)[0] + _SLACK
    best, found, run_found = np.inf, 0.0, guess
    for run in range(num_runs):
        limit = min(bound, best + _SLACK)
        dx = max(path.runs[run, 0] - x, 0.0, x - path.runs[run, 2])
        dy = max(path.runs[run, 1] - y, 0.0, y - path.runs[run, 3])
        if dx * dx + dy * dy > limit * limit:
            continue
        distance, progress = _project_on_run(path, run, x, y)
        if distance < best:
            best, found, run_found = distance, progress, run
    return found, best, run_found


@lean_kernel
def _project_on_run(path: PdmPath, run: int, x: float, y: float) -> tuple[float, float]:
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


@lean_kernel
def window(path: PdmPath, low: float, high: float) -> tuple[int, int]:
    """First vertex, and one past the last one, with a progress in [low, high], both clamped."""
    end = path.progress[-1]
    first = int(np.searchsorted(path.progress, min(max(low, 0.0), end)))
    last = int(np.searchsorted(path.progress, min(max(high, 0.0), end), side="right"))
    return first, max(first, last)
