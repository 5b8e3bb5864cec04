"""Paths along the lanes of a route: nuPlan's interpolated path, and stretches of it."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, kernel
from shiftsim.geometry.paths import Path, make_path, pose_at
from shiftsim.geometry.polylines import arc_lengths, project_on_polyline, vertex_headings
from shiftsim.world.map import VectorMap

SAME_POINT = 1e-8  # m, vertices closer than this are one


class LanePath(NamedTuple):
    """The path along some lanes."""

    # (V, 2) all vertices of the lanes' baselines, on which the ego is projected [m]
    line: FloatArray
    line_arc: FloatArray  # (V,) arc length at each of them [m]
    driven: Path  # what poses are read from: without repeated vertices

    @property
    def end(self) -> float:
        """Progress at the last vertex [m]."""
        return float(self.driven.progress[-1])

    def project(self, x: float, y: float) -> float:
        """Progress of the point of the path nearest to (x, y) [m]."""
        return float(project_on_polyline(self.line, self.line_arc, 0, len(self.line), x, y))


def centerline(road: VectorMap, lanes: Iterable[int]) -> FloatArray:
    """Poses (K, 3) along the baselines of lanes x [m], y [m], heading [rad]."""
    lines = [road.baselines.at(lane) for lane in lanes]
    return np.concatenate([np.column_stack([xy, vertex_headings(xy)]) for xy in lines])


def lane_path(road: VectorMap, lanes: Iterable[int]) -> LanePath:
    """The path along the baselines of some lanes."""
    poses = centerline(road, lanes)
    line = np.ascontiguousarray(poses[:, :2])
    arc = arc_lengths(line, np.array([0, len(line)]))
    # nuPlan rule 153: of two equal vertices the second stays, and the last of all is always lost
    kept = np.flatnonzero(np.diff(arc) > SAME_POINT)
    return LanePath(line, arc, make_path(poses[kept], arc[kept]))


@kernel
def sub_path(path: Path, low: float, high: float) -> FloatArray:
    """Poses (K', 3) of a path between two progresses, the interpolated ends included.

    Headings are not wrapped. At the ends of the path its two first, or last, vertices are left.
    """
    # loops instead of slice assignments, which take numba seconds to compile
    count = len(path.progress)
    first = int(np.searchsorted(path.progress, low, side="right"))
    last = int(np.searchsorted(path.progress, high, side="left"))  # one past the last vertex
    margin = 1
    if first == count or last == 0:
        margin, first, last = 0, 0 if last == 0 else count - 2, 2 if last == 0 else count
    out = np.empty((max(last - first, 0) + 2 * margin, 3))
    for vertex in range(first, last):
        row = out[vertex - first + margin]
        row[0], row[1], row[2] = path.xy[vertex, 0], path.xy[vertex, 1], path.heading[vertex]
    if margin > 0:
        out[0, 0], out[0, 1], out[0, 2] = pose_at(path, low)
        end = len(out) - 1
        out[end, 0], out[end, 1], out[end, 2] = pose_at(path, high)
    return out
