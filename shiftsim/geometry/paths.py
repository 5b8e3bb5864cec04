"""Paths to drive along: poses by progress, and projection.

Vertices are grouped in short runs with bounding boxes, so that a search along a path looks at a few
segments instead of all of them.
"""

from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, lean_kernel
from shiftsim.geometry.polylines import arc_lengths, interpolate
from shiftsim.geometry.rings import point_segment_distance

RUN = 8  # segments per bounding box
_SLACK = 1e-6  # m, more than rounding can change a distance by


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


@lean_kernel
def bound_runs(xy: FloatArray, runs: FloatArray) -> None:
    """Write the bounds of the runs of a polyline (K, 2) into `runs` (R, 4)."""
    for run in range(len(runs)):
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for index in range(run * RUN, min((run + 1) * RUN + 1, len(xy))):
            low_x, high_x = min(low_x, xy[index, 0]), max(high_x, xy[index, 0])
            low_y, high_y = min(low_y, xy[index, 1]), max(high_y, xy[index, 1])
        runs[run, 0], runs[run, 1], runs[run, 2], runs[run, 3] = low_x, low_y, high_x, high_y


@lean_kernel
def is_run_within(runs: FloatArray, run: int, x: float, y: float, limit: float) -> bool:
    """Whether the bounds of a run come within `limit` [m] of a point."""
    dx = max(runs[run, 0] - x, 0.0, x - runs[run, 2])
    dy = max(runs[run, 1] - y, 0.0, y - runs[run, 3])
    return not dx * dx + dy * dy > limit * limit


@lean_kernel
def pose_at(path: Path, progress: float) -> tuple[float, float, float]:
    """Pose x [m], y [m], heading [rad] at a progress, clamped to the path; heading not wrapped."""
    last = len(path.progress) - 1
    s = min(max(progress, path.progress[0]), path.progress[last])
    upper = min(max(int(np.searchsorted(path.progress, s)), 1), last)
    lower = upper - 1
    ahead = s - path.progress[lower]
    span = path.progress[upper] - path.progress[lower]
    return (
        interpolate(path.xy[lower, 0], path.xy[upper, 0], span, ahead),
        interpolate(path.xy[lower, 1], path.xy[upper, 1], span, ahead),
        interpolate(path.heading[lower], path.heading[upper], span, ahead),
    )


@lean_kernel
def project(path: Path, x: float, y: float, guess: int) -> tuple[float, float, int]:
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
        if not is_run_within(path.runs, run, x, y, min(bound, best + _SLACK)):
            continue
        distance, progress = _project_on_run(path, run, x, y)
        if distance < best:
            best, found, run_found = distance, progress, run
    return found, best, run_found


@lean_kernel
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


@lean_kernel
def window(path: Path, low: float, high: float) -> tuple[int, int]:
    """First vertex, and one past the last one, with a progress in [low, high], both clamped."""
    end = path.progress[-1]
    first = int(np.searchsorted(path.progress, min(max(low, 0.0), end)))
    last = int(np.searchsorted(path.progress, min(max(high, 0.0), end), side="right"))
    return first, max(first, last)
