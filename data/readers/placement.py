"""Do recorded vehicles lie on a map, and which shift would put them there?"""

from typing import NamedTuple

import numpy as np
from scipy import signal

from shiftsim.geometry.polylines import project_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.world.layers import Polygons, Polylines, containing
from shiftsim.world.map import VectorMap

_MAX_POINTS = 2000  # moving vehicles looked at
_MAX_CELLS = 1_000_000  # of the raster that finds a better placement


class Placement(NamedTuple):
    """How well moving vehicles and drivable area lie on each other."""

    num_points: int  # places that were looked at
    num_drivable: int  # how many of them are on drivable area
    shift: FloatArray  # (2,) what to add to the points for the best fit [m]
    best_share: float  # share of the points on drivable area then, as far as a raster tells


def place_on_map(road: VectorMap, points: FloatArray, enough: float) -> Placement:
    """Compare moving vehicles with the drivable area, and look for a better place if need be.

    `points` (n, 2) are their box centres in the frame of the map [m]; where the share `enough` is
    on drivable area, no better place is looked for.
    """
    points = np.ascontiguousarray(points[:: max(1, len(points) // _MAX_POINTS)])
    number = int(are_drivable(road, points).sum())
    share = number / max(1, len(points))
    if share >= enough or not len(points):
        return Placement(len(points), number, np.zeros(2), share)
    shift, best = _best_shift(road, points)
    return Placement(len(points), number, shift, best)


def extent_of(road: VectorMap) -> tuple[FloatArray, FloatArray]:
    """(2,) lowest and (2,) highest x, y of the lanes and connectors of a map [m]."""
    bounds = road.edges.polygons.bounds
    return bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)


def are_drivable(road: VectorMap, points: FloatArray) -> BoolArray:
    """(n,) whether points (n, 2) are on a lane, a connector or another drivable polygon."""
    on_edge = containing_polygons(road.edges.polygons, points, 1)[:, 0] >= 0
    on_area = containing_polygons(road.drivable_areas.polygons, points, 1)[:, 0] >= 0
    return np.logical_or(on_edge, on_area)


def _best_shift(road: VectorMap, points: FloatArray) -> tuple[FloatArray, float]:
    """The shift of the points that puts most of them on drivable area, by correlating rasters."""
    if not len(road.edges):
        return np.zeros(2), 0.0
    low, high = extent_of(road)
    points_low, points_high = points.min(axis=0), points.max(axis=0)
    extent = (high - low) + np.minimum(points_high - points_low, high - low)
    cell = max(1.0, float(np.sqrt(np.prod(extent) / _MAX_CELLS)))
    num_map = np.ceil((high - low) / cell).astype(np.int64) + 1
    index = np.floor((points - points_low) / cell).astype(np.int64)
    inside = index[(index < num_map).all(axis=1)]
    grid = np.indices(num_map.tolist()).reshape(2, -1).T
    centers = low + (grid + 0.5) * cell
    area = are_drivable(road, np.ascontiguousarray(centers)).reshape(num_map)
    counts = np.zeros(num_map)
    np.add.at(counts, tuple(inside.T), 1.0)
    match = np.rint(signal.correlate(area.astype(np.float64), counts, method="fft"))
    ties = np.argwhere(match == match.max()) - (num_map - 1)
    shifts = low + ties * cell - points_low
    best = shifts[np.argmin(np.abs(shifts).sum(axis=1))]
    return best, float(match.max() / len(points))


@kernel
def containing_polygons(polygons: Polygons, points: FloatArray, limit: int) -> IntArray:
    """(n, limit) the first polygons that hold each point (n, 2); -1 where there are no more."""
    out = np.full((len(points), limit), -1)
    for index in range(len(points)):
        containing(polygons, points[index, 0], points[index, 1], out[index])
    return out


@kernel
def direction_at(lines: Polylines, line: int, x: float, y: float) -> tuple[float, float]:
    """Components dx, dy [m] of the segment of a polyline that is nearest to a point."""
    first, last = lines.ptr[line], lines.ptr[line + 1]
    along = project_on_polyline(lines.xy, lines.arc, first, last, x, y)
    segment = int(np.searchsorted(lines.arc[first:last], along, side="right")) - 1
    at = first + min(max(segment, 0), last - first - 2)
    return lines.xy[at + 1, 0] - lines.xy[at, 0], lines.xy[at + 1, 1] - lines.xy[at, 1]
