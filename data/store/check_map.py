"""Lanes that overlap, egos off the map, routes with holes: what makes tasks fail later."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.world.layers import Polygons, containing, nearest
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA, center_poses

_MAX_OFF = 3.0  # m, how far the ego may be beside lanes and drivable area
_MAX_OFF_SHARE = 0.1  # of the iterations
_REACH = 1000.0  # m, in which the nearest lane is looked for
_MIN_OVERLAP = 0.5  # m^2, of two lanes; less is hardly ever met
_REPAIR_LANES = "convert the map again, or repair the polygons of these lanes"


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong."""

    where: str  # file, map or scenario
    what: str  # what is wrong there: value and limit
    is_error: bool = True  # whether results cannot be trusted; else it is only unusual
    remedy: str = ""  # what to do
    kind: str = ""  # short name of what was checked
    recording: str = ""  # the recording that it belongs to


class MapCheck:
    """One map, and what it does to scenarios on it."""

    def __init__(self, road: VectorMap) -> None:
        self.road = road
        self._capacity = max(2, road.edges.most_at_a_point)

    @cached_property
    def overlaps(self) -> dict[tuple[int, int], tuple[float, FloatArray]]:
        """Area [m^2] and a point (2,) of the overlap of two lanes, by their numbers."""
        road = self.road
        shapes = np.array([road.edges.shape(lane) for lane in range(road.num_lanes)], object)
        first, second = shapely.STRtree(shapes).query(shapes, predicate="intersects")
        is_valid = shapely.is_valid(shapes)
        chosen = (first < second) & is_valid[first] & is_valid[second]
        first, second = first[chosen], second[chosen]
        shared = shapely.intersection(shapes[first], shapes[second])
        area = shapely.area(shared)
        return {
            (int(first[i]), int(second[i])): (
                float(area[i]),
                shapely.get_coordinates(shapely.point_on_surface(shared[i]))[0],
            )
            for i in np.flatnonzero(area > _MIN_OVERLAP).tolist()
        }

    def of_map(self) -> Iterator[Problem]:
        """Lanes that overlap anywhere."""
        if self.overlaps:
            (a, b), (area, point) = max(self.overlaps.items(), key=lambda item: item[1][0])
            ids = self.road.edges.ids
            yield Problem(
                f"map {self.road.name}",
                f"{len(self.overlaps)} pairs of lanes overlap by more than {_MIN_OVERLAP:g} m²,"
                f" most {ids[a]!r} and {ids[b]!r}, by {area:.1f} m² at ({point[0]:.1f},"
                f" {point[1]:.1f}); a rollout that comes there fails",
                is_error=False,
                remedy=_REPAIR_LANES,
                kind="lanes overlap",
            )

    def of_scenario(self, scene: Scenario, recording: str) -> Iterator[Problem]:
        """What the map says of a scenario."""
        for found in (self._overlap(scene), self._place(scene), self._route(scene)):
            yield from (replace(problem, recording=recording) for problem in found)

    def _overlap(self, scene: Scenario) -> Iterator[Problem]:
        road = self.road
        centers = center_poses(scene.expert[:, :3])
        sizes = np.broadcast_to([PACIFICA.length, PACIFICA.width], (len(centers), 2))
        corners = boxes_to_corners(centers, np.ascontiguousarray(sizes))
        points = np.concatenate([centers[:, None, :2], corners], axis=1).reshape(-1, 2)
        out = np.full((len(points), 2), -1, np.int64)
        _lanes_at(road.edges.polygons, road.num_lanes, points, self._capacity, out)
        several = np.flatnonzero(out[:, 1] >= 0)
        ids = road.edges.ids
        if len(several):
            x, y = points[several[0]]
            pair = " and ".join(repr(ids[lane]) for lane in out[several[0]].tolist())
            at = several[0] // 5
            when = _seconds(scene)[at]
            fate = "will fail" if at == 0 else "fail if its lane is looked for there"
            yield Problem(
                f"scenario {scene.token}",
                f"lanes {pair} overlap at ({x:.2f}, {y:.2f}), where the ego is at {when:.1f} s; it"
                f" cannot be assigned to one, so its tasks {fate}",
                remedy=_REPAIR_LANES,
                kind="lanes overlap",
            )
            return
        blocks = {road.blocks.index[name] for name in scene.route if name in road.blocks.index}
        for (a, b), (area, point) in self.overlaps.items():
            if road.block_of[a] in blocks or road.block_of[b] in blocks:
                yield Problem(
                    f"scenario {scene.token}",
                    f"lanes {ids[a]!r} and {ids[b]!r} on the route overlap by {area:.1f} m² at"
                    f" ({point[0]:.2f}, {point[1]:.2f}), at most {_MIN_OVERLAP:g} m²; tasks that"
                    " come there will fail",
                    remedy=_REPAIR_LANES,
                    kind="lanes overlap",
                )
                return

    def _place(self, scene: Scenario) -> Iterator[Problem]:
        road = self.road
        centers = np.ascontiguousarray(center_poses(scene.expert[:, :3])[:, :2])
        if not np.isfinite(centers).all():
            return
        off = np.empty(len(centers))
        _distances(road.edges.polygons, road.drivable_areas.polygons, centers, off)
        beside = off > _MAX_OFF
        if beside.any():
            first = int(np.flatnonzero(beside)[0])
            far = off.max()
            shown = f"{far:.1f} m" if np.isfinite(far) else f"more than {_REACH:g} m"
            yield Problem(
                f"scenario {scene.token}",
                f"the ego is up to {shown} beside lanes and drivable area, from"
                f" {_seconds(scene)[first]:.1f} s on, in {beside.mean():.0%} of the iterations,"
                f" at most {_MAX_OFF:g} m in {_MAX_OFF_SHARE:.0%}",
                is_error=bool(beside.mean() > _MAX_OFF_SHARE),
                remedy="check that map and recording have one origin, or leave the scenario out",
                kind="off the map",
            )

    def _route(self, scene: Scenario) -> Iterator[Problem]:
        road = self.road
        blocks = [road.blocks.index.get(name, -1) for name in scene.route]
        for place, (one, other) in enumerate(pairwise(blocks)):
            if min(one, other) >= 0 and other not in road.block_outgoing.at(one):
                yield Problem(
                    f"scenario {scene.token}",
                    f"roadblock {place + 2} of {len(blocks)} of the route,"
                    f" {scene.route[place + 1]!r}, does not follow {scene.route[place]!r}",
                    remedy="correct the route in shiftsim inspect",
                    kind="route",
                )
                return


def _seconds(scene: Scenario) -> FloatArray:
    """(T,) time of the iterations since the first [s]."""
    seconds: FloatArray = (scene.iteration_times - scene.iteration_times[0]) / 1e6
    return seconds


@kernel
def _lanes_at(
    polygons: Polygons, num_lanes: int, points: FloatArray, capacity: int, out: IntArray
) -> None:
    """Write the first two lanes that hold each point (n, 2) into `out` (n, 2), filled with -1."""
    row = np.empty(capacity, np.int64)
    for index in range(len(points)):
        found = containing(polygons, points[index, 0], points[index, 1], row)
        for place in range(min(found, 2)):
            if row[place] < num_lanes:
                out[index, place] = row[place]


@kernel
def _distances(edges: Polygons, areas: Polygons, points: FloatArray, out: FloatArray) -> None:
    """Write the distance of each point (n, 2) to the nearest lane or area [m], inf where far."""
    for index in range(len(points)):
        x, y = points[index, 0], points[index, 1]
        _, to_edge = nearest(edges, x, y, _REACH)
        best = to_edge
        if best > 0.0:
            _, to_area = nearest(areas, x, y, _REACH)
            best = min(best, to_area)
        out[index] = best
