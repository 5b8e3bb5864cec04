"""Lanes as nuPlan sees them: the one a vehicle is in, poses on it, and how it begins to turn."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from shiftsim.geometry.polylines import point_on_polyline
from shiftsim.kernels import FloatArray, kernel
from shiftsim.world.layers import Polylines
from shiftsim.world.map import VectorMap

_HEADING_SPACING = 0.5  # m ahead, between the two points that give a heading, nuPlan
_CURVATURE_SPACING = 2.0  # m between the three points of the estimate, nuPlan
_STRAIGHT = 1e-6  # m^4, 16 times the squared area below which three points count as aligned


@dataclass(frozen=True, slots=True)
class Start:
    """Where a vehicle is put on the lane graph."""

    edge: int  # lane or connector
    progress: float  # arc length on its baseline [m]
    pose: FloatArray  # (3,) nearest pose on the baseline: x [m], y [m], heading [rad]


def find_start(map: VectorMap, pose: FloatArray) -> Start | None:
    """The edge a vehicle follows from its pose (3,), or None where it is off the map.

    A lane is preferred to a connector, and among several the one whose heading differs least.
    """
    return find_starts(map, pose[None])[0]


def find_starts(map: VectorMap, poses: FloatArray) -> list[Start | None]:
    """As `find_start`, of vehicles at poses (N, 3)."""
    edges: list[list[int]] = []
    for x, y in poses[:, :2].tolist():
        edges.append(map.lanes_at(x, y))
        if not edges[-1] and len(map.intersections.containing(x, y)):
            edges[-1] = map.connectors_at(x, y)
    used = sorted({edge for choice in edges for edge in choice})
    lines = dict(zip(used, (shapely.LineString(map.baselines.at(e)) for e in used), strict=True))
    beside = np.array([lines[edge] for choice in edges for edge in choice], object)
    owners = [index for index, choice in enumerate(edges) for _ in choice]
    points = shapely.points(poses[np.array(owners, np.int64), :2])
    progress = shapely.line_locate_point(beside, points)
    starts = iter(zip(progress.tolist(), poses_at(beside, progress), strict=True))
    return [
        _nearest([Start(edge, *next(starts)) for edge in choice], pose) if choice else None
        for choice, pose in zip(edges, poses, strict=True)
    ]


def nearest_heading(map: VectorMap, edges: list[int], pose: FloatArray) -> Start:
    """The edge whose heading beside a pose (3,) is nearest to that of the pose."""
    return _nearest([start_on(map, edge, float(pose[0]), float(pose[1])) for edge in edges], pose)


def _nearest(starts: list[Start], pose: FloatArray) -> Start:
    # nuPlan rule 120: the difference of headings is not wrapped
    return min(starts, key=lambda start: abs(start.pose[2] - pose[2]))


def start_on(map: VectorMap, edge: int, x: float, y: float) -> Start:
    """Where a point is put on an edge."""
    line = shapely.LineString(map.baselines.at(edge))
    progress, pose = pose_on_line(line, x, y)
    return Start(edge, progress, pose)


def pose_on_line(line: shapely.LineString, x: float, y: float) -> tuple[float, FloatArray]:
    """Arc length of the projection of a point on a line [m], and the pose (3,) there."""
    progress = shapely.line_locate_point(line, [shapely.Point(x, y)])
    return float(progress[0]), poses_at(line, progress)[0]


def poses_at(lines: Any, progress: FloatArray) -> FloatArray:
    """(N, 3) poses at arc lengths (N,) of lines; the heading is that to a point ahead."""
    lines = np.broadcast_to(np.asarray(lines, object), progress.shape)
    here, ahead = (
        shapely.get_coordinates(shapely.line_interpolate_point(lines, progress + offset))
        for offset in (0.0, _HEADING_SPACING)
    )
    step = ahead - here
    ends = (here == ahead).all(axis=1)
    if ends.any():  # at the very end of the line: from a point behind
        behind = shapely.line_interpolate_point(lines[ends], progress[ends] - _HEADING_SPACING)
        step[ends] = here[ends] - shapely.get_coordinates(behind)
    return np.column_stack([here, np.arctan2(step[:, 1], step[:, 0])])


def poses_on_edge(map: VectorMap, edge: int, progress: FloatArray) -> FloatArray:
    """(N, 3) poses at arc lengths (N,) of the baseline of an edge, as `pose_on_line` has them."""
    span = slice(map.baselines.ptr[edge], map.baselines.ptr[edge + 1])
    xy, arc = map.baselines.xy[span], map.baselines.arc[span]
    both = np.clip(progress, 0.0, arc[-1]) + np.array([[0.0], [_HEADING_SPACING]])
    # at the very end the heading is that from a point behind
    both[1] = np.where(both[0] < arc[-1], both[1], both[0] - _HEADING_SPACING)
    here, other = np.stack([np.interp(both, arc, xy[:, column]) for column in (0, 1)], axis=-1)
    step = np.where((both[1] > both[0])[:, None], other - here, here - other)
    return np.column_stack([here, np.arctan2(step[:, 1], step[:, 0])])


@kernel
def initial_curvature(baselines: Polylines, edge: int) -> float:
    """Absolute curvature of a baseline at its start, of the circle through three points [1/m]."""
    start, stop = baselines.ptr[edge], baselines.ptr[edge + 1]
    length = baselines.arc[stop - 1]
    second, third = _CURVATURE_SPACING, 2.0 * _CURVATURE_SPACING
    if length < 2.0 * _CURVATURE_SPACING:
        second, third = length / 2.0, length
    ax, ay = point_on_polyline(baselines.xy, baselines.arc, start, stop, 0.0)
    bx, by = point_on_polyline(baselines.xy, baselines.arc, start, stop, second)
    cx, cy = point_on_polyline(baselines.xy, baselines.arc, start, stop, third)
    a = np.hypot(ax - bx, ay - by)
    b = np.hypot(bx - cx, by - cy)
    c = np.hypot(cx - ax, cy - ay)
    square = (a + (b + c)) * (c - (a - b)) * (c + (a - b)) * (a + (b - c))
    if square < _STRAIGHT:
        return 0.0
    return np.sqrt(square) / (a * b * c)
