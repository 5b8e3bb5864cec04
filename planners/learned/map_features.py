"""Lanes, connectors and crosswalks around the ego as resampled polylines.

Everything that does not depend on the ego is made once per map, in the map frame: 21 points on the
centre line and on either side of every object. A step then selects, moves and turns.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import shapely

from shiftsim.geometry.polylines import point_on_polyline
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.planners.learned.features import frame_of
from shiftsim.world.layers import Polylines, meeting, square_around
from shiftsim.world.map import NONE, VectorMap
from shiftsim.world.state import LightStatus, TrafficLights

POINTS = 20  # per polyline; their vectors lead to the next one
_MIDDLE = 10  # point that stands for the whole object
LANE, CONNECTOR, CROSSWALK = 0, 1, 2


class RoadObjects(NamedTuple):
    """Lanes, then connectors, then crosswalks of a map, each in the order of its layer."""

    lines: FloatArray  # (M, 3, 21, 2) centre, left and right polyline in the map frame [m]
    steps: FloatArray  # (M, 3, 20, 2) from each point to the next one [m]
    angles: FloatArray  # (M, 3, 20) orientation of the steps [rad]
    kind: IntArray  # (M,) LANE, CONNECTOR or CROSSWALK
    block: IntArray  # (M,) block of the object, or NONE
    limit: FloatArray  # (M,) speed limit [m/s], NaN where there is none


class RoadFeatures(NamedTuple):
    """Objects around the ego in its frame, float32 and ready for a network. M objects."""

    objects: IntArray  # (M,) row of each in `RoadObjects`; below the number of edges it is the edge
    points: np.ndarray  # (M, 3, 20, 2) points of centre, left and right [m]
    vectors: np.ndarray  # (M, 3, 20, 2) to the next point [m]
    orientations: np.ndarray  # (M, 3, 20) of the vectors, not wrapped [rad]
    centers: np.ndarray  # (M, 3) pose of the middle of the centre line
    valid: BoolArray  # (M, 20) whether a point of the centre line is near enough
    kind: IntArray  # (M,) LANE, CONNECTOR or CROSSWALK
    on_route: BoolArray  # (M,)
    light: IntArray  # (M,) LightStatus, UNKNOWN where there is no light
    has_limit: BoolArray  # (M,)
    limit: np.ndarray  # (M,) speed limit [m/s], 0 where there is none


def _make_road_objects(road: VectorMap) -> RoadObjects:
    num_edges, num_crosswalks = len(road.edges), len(road.crosswalks)
    lines = np.empty((num_edges + num_crosswalks, 3, POINTS + 1, 2))
    for side, polylines in enumerate((road.baselines, road.left_boundaries, road.right_boundaries)):
        # a map without boundaries gets its centre lines in their place
        resample(polylines, road.baselines, lines[:num_edges, side])
    along = np.linspace(0.0, 1.0, POINTS + 1)[:, None]
    for index in range(num_crosswalks):
        corners = oriented_rectangle(road.crosswalks.rings(index)[0])
        right = corners[3] + along * (corners[0] - corners[3])
        left = corners[2] + along * (corners[1] - corners[2])
        lines[num_edges + index] = (left + right) / 2.0, left, right
    steps = np.diff(lines, axis=2)
    kind = np.append(np.arange(num_edges) >= road.num_lanes, np.full(num_crosswalks, CROSSWALK))
    block = np.append(road.block_of, np.full(num_crosswalks, NONE))
    limit = np.append(road.speed_limits, np.full(num_crosswalks, np.nan))
    angles = np.arctan2(steps[..., 1], steps[..., 0])
    return RoadObjects(lines, steps, angles, kind, block, limit)


road_objects = lru_cache(256)(_make_road_objects)  # training goes from town to town


@kernel
def resample(lines: Polylines, fallback: Polylines, out: FloatArray) -> None:
    """Write points at equal distances along every polyline into `out` (M, K, 2).

    A polyline of less than two vertices is replaced by its fallback; one without any gives zeros.
    """
    for line in range(len(out)):
        if lines.ptr[line + 1] - lines.ptr[line] >= 2:
            _resample_line(lines, line, out[line])
        else:
            _resample_line(fallback, line, out[line])


@kernel
def _resample_line(lines: Polylines, line: int, out: FloatArray) -> None:
    start, stop = lines.ptr[line], lines.ptr[line + 1]
    out[:] = 0.0
    if stop > start:
        for point in range(len(out)):
            at = lines.arc[stop - 1] * point / (len(out) - 1)
            x, y = point_on_polyline(lines.xy, lines.arc, start, stop, at)
            out[point, 0], out[point, 1] = x, y


def oriented_rectangle(ring: FloatArray) -> FloatArray:
    """(4, 2) corners of the smallest rectangle around a ring (V, 2), one side along its hull [m].

    The first side lies along the hull's edge. Every edge of a rectangle does equally well, so that
    the last bit of an area decides which corner comes first (nuPlan rule 305): sides are compared
    in the order of the hull, clockwise from its lowest vertex, and measured from the origin of the
    map.
    """
    hull = _clockwise_hull(ring)
    edges = np.roll(hull, -1, axis=0) - hull
    along = edges / np.sqrt(edges[:, 0] ** 2 + edges[:, 1] ** 2)[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    boxes = np.empty((len(hull), 4))
    for column, axes in enumerate((along, across)):
        offsets = axes[:, None, 0] * hull[:, 0] + axes[:, None, 1] * hull[:, 1]
        boxes[:, column], boxes[:, column + 2] = offsets.min(axis=1), offsets.max(axis=1)
    best = int(np.argmin((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])))
    low_u, low_v, high_u, high_v = boxes[best]
    u = np.array([low_u, high_u, high_u, low_u])[:, None]
    v = np.array([low_v, low_v, high_v, high_v])[:, None]
    return along[best] * u + across[best] * v


def _clockwise_hull(ring: FloatArray) -> FloatArray:
    """Vertices of the convex hull, clockwise from the lowest one, or from the left one of two."""
    hull = shapely.convex_hull(shapely.linestrings(ring))
    if hull.geom_type != "Polygon":  # no area: a pavement of a millimetre
        hull = shapely.buffer(hull, 1e-3, quad_segs=1)
    xy = np.asarray(hull.exterior.coords)[:-1]
    xy = xy[::-1] if hull.exterior.is_ccw else xy
    return np.roll(xy, -int(np.lexsort((xy[:, 0], xy[:, 1]))[0]), axis=0)


class LightLookup:
    """Traffic lights by edge, `edges` with a light; the ids of one scenario are looked up once."""

    def __init__(
        self,
        road: VectorMap,
        default: LightStatus = LightStatus.UNKNOWN,  # of edges for which no light is listed
        ranked: tuple[LightStatus, ...] | None = None,
    ) -> None:
        """Take the map of the scenario.

        nuPlan rule 429: of several states of an edge the last one listed counts, or, where states
        are `ranked`, the last one in this order; others than these then count as not listed.
        """
        self._road, self._default, self._ranked = road, int(default), ranked
        self._ids: tuple[str, ...] | None = None
        self._columns = self.edges = np.zeros(0, np.int64)
        self._status = np.full(len(road.edges), self._default)

    def at(self, lights: TrafficLights) -> IntArray:
        """(E,) status by edge of one row of lights; not to be kept.

        Ids that the map does not have are left out.
        """
        if lights.connector_ids is not self._ids:
            index = self._road.edges.index
            pairs = [(c, index[i]) for c, i in enumerate(lights.connector_ids) if i in index]
            found = np.array(pairs, np.int64).reshape(-1, 2)
            self._columns, self.edges = found[:, 0].copy(), found[:, 1].copy()
            self._ids = lights.connector_ids
            self._status[:] = self._default
        codes = lights.status[0, self._columns]
        self._status[self.edges] = self._default
        if self._ranked is None:
            listed = codes != LightStatus.ABSENT
            self._status[self.edges[listed]] = codes[listed]  # NumPy keeps the last one
        else:
            for status in self._ranked:
                self._status[self.edges[codes == status]] = status
        return self._status


def road_features(
    road: VectorMap,
    ego: FloatArray,
    center: FloatArray,
    radius: float,
    lights: IntArray,
    on_route: BoolArray,
) -> RoadFeatures:
    """Objects whose area touches a square around `center`, and with a point near it.

    `radius` is half the side of the square [m], the rear axle `ego` (3,) the frame of the features,
    `lights` (E,) are of `LightLookup`, `on_route` (B,) blocks. In the order of `RoadObjects`.
    """
    known, areas = road_objects(road), (road.edges.polygons, road.crosswalks.polygons)
    around = square_around(float(center[0]), float(center[1]), radius), radius
    chosen, points, vectors, orientations, valid = _select(known[:3], areas, around, frame_of(ego))
    kind, block, limit = (values[chosen] for values in known[3:])
    light = np.append(lights, int(LightStatus.UNKNOWN))[np.minimum(chosen, len(lights))]
    routed = (block != NONE) & on_route[block] if len(on_route) else np.zeros(len(chosen), np.bool_)
    has_limit = ~np.isnan(limit)
    limit = np.where(has_limit, limit, 0.0).astype(np.float32)
    centers = np.concatenate([points[:, 0, _MIDDLE], orientations[:, 0, _MIDDLE, None]], axis=1)
    lines = points, vectors, orientations, centers, valid
    return RoadFeatures(chosen, *lines, kind, routed, light, has_limit, limit)


@kernel
def _select(known: Any, areas: Any, around: Any, frame: Any) -> Any:
    """Objects of a map around the ego, their lines in its frame, and what is near of them."""
    (lines, steps, angles), (edges, crosswalks), (square, radius) = known, areas, around
    near = np.concatenate((meeting(edges, square), len(edges.bounds) + meeting(crosswalks, square)))
    points, vectors = np.empty((2, len(near), 3, POINTS, 2), np.float32)
    orientations = np.empty((len(near), 3, POINTS), np.float32)
    valid, found = np.empty((len(near), POINTS), np.bool_), 0
    x0, y0, heading, cos, sin = frame
    for row in near:
        for side in range(2, -1, -1):
            for point in range(POINTS):
                at = found, side, point
                x, y = lines[row, side, point, 0] - x0, lines[row, side, point, 1] - y0
                ahead, left = cos * x + sin * y, cos * y - sin * x
                points[at][0], points[at][1] = ahead, left
                valid[found, point] = abs(ahead) < radius and abs(left) < radius  # of the centre
                x, y = steps[row, side, point, 0], steps[row, side, point, 1]
                vectors[at][0], vectors[at][1] = cos * x + sin * y, cos * y - sin * x
                orientations[at] = angles[row, side, point] - heading
        near[found] = row
        found += valid[found].any()
    return near[:found], points[:found], vectors[:found], orientations[:found], valid[:found]
