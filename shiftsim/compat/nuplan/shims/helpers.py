"""Helpers of nuPlan's devkit that planners import beside the planner interface."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import shapely

from shiftsim.compat.nuplan.shims.ego import EgoState
from shiftsim.compat.nuplan.shims.geometry import (
    Point2D,
    ProgressStateSE2,
    StateSE2,
    derived,
)
from shiftsim.compat.nuplan.shims.objects import Agent, SceneObject
from shiftsim.compat.nuplan.shims.planning import TrajectorySampling
from shiftsim.compat.nuplan.shims.transforms import (
    AngularInterpolator,
)

Geometry: TypeAlias = shapely.Polygon | shapely.LineString

# nuplan.planning.simulation.occupancy_map


class OccupancyMap:
    """Geometries by id."""

    def __init__(self, geom_map: dict[str, Geometry]) -> None:
        self._geom_map = geom_map

    size = derived(lambda self: len(self._geom_map), "How many there are.")

    def __len__(self) -> int:
        return len(self._geom_map)

    def is_empty(self) -> bool:
        """Whether there is none."""
        return not self._geom_map

    def contains(self, geometry_id: str) -> bool:
        """Whether there is one of that id."""
        return geometry_id in self._geom_map

    def get(self, geometry_id: str) -> Geometry:
        """The geometry of an id."""
        return self._geom_map[geometry_id]

    def insert(self, geometry_id: str, geometry: Geometry) -> None:
        """Add one, or replace it."""
        self._geom_map[geometry_id] = geometry

    set = insert

    def remove(self, geometry_ids: list[str]) -> None:
        """Remove some; all must be there."""
        for name in geometry_ids:
            assert name in self._geom_map, f"the occupancy map has no geometry {name!r}"
            del self._geom_map[name]

    def get_all_ids(self) -> list[str]:
        """All ids."""
        return list(self._geom_map)

    def get_all_geometries(self) -> list[Geometry]:
        """All geometries."""
        return list(self._geom_map.values())

    def get_nearest_entry_to(self, geometry_id: str) -> tuple[str, Geometry, float]:
        """Id, geometry and distance [m] of what is nearest to one of the geometries."""
        assert self.contains(geometry_id), f"the occupancy map has no geometry {geometry_id!r}"
        # nuPlan rule 610: what it leaves out is every id that is a part of the given one
        names = [name for name in self._geom_map if name not in geometry_id]
        geometry = self.get(geometry_id)
        nearest = names[shapely.STRtree([self.get(name) for name in names]).nearest(geometry)]
        return nearest, self.get(nearest), float(geometry.distance(self.get(nearest)))

    def intersects(self, geometry: Geometry) -> "OccupancyMap":
        """The part of the map that shares a point with a geometry."""
        names = self.get_all_ids()
        found = shapely.STRtree(self.get_all_geometries()).query(geometry, predicate="intersects")
        return type(self)({names[index]: self.get(names[index]) for index in found.tolist()})


class STRTreeOccupancyMap(OccupancyMap):
    """The same."""


class STRTreeOccupancyMapFactory:
    """Makes occupancy maps."""

    @staticmethod
    def get_from_boxes(scene_objects: list[SceneObject]) -> OccupancyMap:
        """The boxes of objects, by the tokens of their tracks; objects without one are left out."""
        boxes = ((item.track_token, item.box.geometry) for item in scene_objects)
        return STRTreeOccupancyMap({token: box for token, box in boxes if token is not None})

    @staticmethod
    def get_from_geometry(
        geometries: list[Geometry], geometry_ids: list[str] | None = None
    ) -> OccupancyMap:
        """Geometries by the ids given, or by their numbers."""
        names = range(len(geometries)) if geometry_ids is None else geometry_ids
        pairs = zip(names, geometries, strict=False)
        return STRTreeOccupancyMap({str(name): geometry for name, geometry in pairs})


# nuplan.planning.simulation.path


class AbstractPath(ABC):
    """Poses over the distance along a path [m]."""

    @abstractmethod
    def get_start_progress(self) -> float:
        """Where it starts [m]."""

    @abstractmethod
    def get_end_progress(self) -> float:
        """Where it ends [m]."""

    @abstractmethod
    def get_state_at_progress(self, progress: float) -> ProgressStateSE2:
        """The pose at a distance."""

    @abstractmethod
    def get_state_at_progresses(self, progresses: list[float]) -> list[ProgressStateSE2]:
        """The poses at distances."""

    @abstractmethod
    def get_sampled_path(self) -> list[ProgressStateSE2]:
        """The poses it is made of."""


class InterpolatedPath(AbstractPath):
    """Linear between poses."""

    def __init__(self, path: list[ProgressStateSE2]) -> None:
        assert len(path) > 1, "a path needs at least two poses"
        self._path = path
        self._progress = [pose.progress for pose in path]
        self._headings = AngularInterpolator(self._progress, [pose.heading for pose in path])

    def get_start_progress(self) -> float:
        """Where it starts [m]."""
        return self._path[0].progress

    def get_end_progress(self) -> float:
        """Where it ends [m]."""
        return self._path[-1].progress

    def get_state_at_progress(self, progress: float) -> ProgressStateSE2:
        """The pose at a distance within the path."""
        return self.get_state_at_progresses([progress])[0]

    def get_state_at_progresses(self, progresses: list[float]) -> list[ProgressStateSE2]:
        """The poses at distances within the path."""
        first, last = self.get_start_progress(), self.get_end_progress()
        inside = first <= min(progresses) and max(progresses) <= last
        assert inside, f"{progresses} m are not on the path, {first} … {last} m"
        x, y = (
            np.interp(progresses, self._progress, [getattr(pose, axis) for pose in self._path])
            for axis in "xy"
        )
        rows = np.c_[progresses, x, y, self._headings.interpolate(progresses)]
        return [ProgressStateSE2(*row) for row in rows.tolist()]

    def get_sampled_path(self) -> list[ProgressStateSE2]:
        """The poses it is made of."""
        return self._path


def calculate_progress(path: Sequence[Point2D]) -> list[float]:
    """Distances along a path, 0 at its first point [m]."""
    steps = np.linalg.norm(np.diff([(point.x, point.y) for point in path], axis=0), axis=1)
    found: list[float] = np.cumsum(np.r_[0.0, steps]).tolist()
    return found


def convert_se2_path_to_progress_path(path: Sequence[StateSE2]) -> list[ProgressStateSE2]:
    """Poses with their distances along the path."""
    pairs = zip(calculate_progress(path), path, strict=True)
    return [ProgressStateSE2(progress, *pose.serialize()) for progress, pose in pairs]


# nuplan.planning.simulation.observation.idm.utils


def get_agent_relative_angle(ego_state: StateSE2, agent_state: StateSE2) -> float:
    """Angle between the heading of a pose and the direction of another one, 0 … pi [rad]."""
    way = np.array((agent_state.x - ego_state.x, agent_state.y - ego_state.y))
    ahead = np.array((np.cos(ego_state.heading), np.sin(ego_state.heading)))
    return float(np.arccos(ahead @ (way / np.linalg.norm(way))))


def is_agent_ahead(ego_state: StateSE2, agent_state: StateSE2, angle_tolerance: float = 30) -> bool:
    """Whether a pose lies ahead of another, within an angle [deg]."""
    return get_agent_relative_angle(ego_state, agent_state) < np.deg2rad(angle_tolerance)


def is_agent_behind(
    ego_state: StateSE2, agent_state: StateSE2, angle_tolerance: float = 150
) -> bool:
    """Whether a pose lies behind another, beyond an angle [deg]."""
    return get_agent_relative_angle(ego_state, agent_state) > np.deg2rad(angle_tolerance)


def is_track_stopped(tracked_object: Any, stopped_speed_threshhold: float = 5e-2) -> bool:
    """Whether an object stands: its speed is at most the threshold [m/s], or it is no agent."""
    if not isinstance(tracked_object, Agent):
        return True
    return tracked_object.velocity.magnitude() <= stopped_speed_threshhold


def path_to_linestring(path: Sequence[Point2D]) -> shapely.LineString:
    """The line through points or poses."""
    return shapely.LineString([(point.x, point.y) for point in path])


def ego_path_to_se2(path: Sequence[EgoState]) -> list[StateSE2]:
    """Poses of the centres of ego states."""
    return [state.center for state in path]


def ego_path_to_linestring(path: Sequence[EgoState]) -> shapely.LineString:
    """The line through the centres of ego states."""
    return path_to_linestring(ego_path_to_se2(path))


def create_path_from_se2(states: list[StateSE2]) -> InterpolatedPath:
    """The path through poses, of which repeated ones count once."""
    path = convert_se2_path_to_progress_path(states)
    # nuPlan rule 611: the last pose is always left out
    steps = np.diff([pose.progress for pose in path])
    return InterpolatedPath(
        [pose for pose, step in zip(path, steps, strict=False) if not np.isclose(step, 0.0)]
    )


def create_path_from_ego_state(states: list[EgoState]) -> InterpolatedPath:
    """`create_path_from_se2` of the centres of ego states."""
    return create_path_from_se2(ego_path_to_se2(states))


# nuplan.planning.simulation.planner.utils.breadth_first_search


class BreadthFirstSearch:
    """Searches lane by lane for a roadblock, among lanes of given ids."""

    def __init__(self, start_edge: Any, candidate_lane_edge_ids: list[str]) -> None:
        self._start, self._candidates = start_edge, set(candidate_lane_edge_ids)

    def search(self, target_roadblock: Any, target_depth: int) -> tuple[list[Any], bool]:
        """Edges that lead to a roadblock, which is number `target_depth` of them, and True.

        Where there are none: the way to the edge that was found last, and False.
        """
        parents: list[dict[str, Any]] = [{}, {self._start.id: None}]  # by depth, the start has 1
        edge, depth, level = self._start, 1, [self._start]
        for here in range(1, target_depth + 1):
            parents.append({})
            following = []
            for current in level:
                is_there = current.get_roadblock_id() == target_roadblock.id
                if is_there and here == target_depth:
                    return self._way(current, here, parents), True
                for after in current.outgoing_edges:
                    if after.id in self._candidates:
                        following.append(after)
                        parents[here + 1][after.id] = current
                        edge, depth = after, here + 1
            level = following
        return self._way(edge, depth, parents), False

    @staticmethod
    def _way(edge: Any, depth: int, parents: list[dict[str, Any]]) -> list[Any]:
        way = [edge]
        while (edge := parents[depth][edge.id]) is not None:
            way.append(edge)
            depth -= 1
        return way[::-1]


# nuplan.common.maps.nuplan_map.utils


def get_distance_between_map_object_and_point(point: Point2D, map_object: Any) -> float:
    """Distance of a point from the area of an object, 0 inside [m]."""
    return float(shapely.Point(point.x, point.y).distance(map_object.polygon))


# nuplan.planning.training

FeaturesType: TypeAlias = dict[str, Any]
TargetsType: TypeAlias = dict[str, Any]
ScenarioListType: TypeAlias = list[Any]


class AbstractModelFeature(ABC):  # noqa: B024  # a mere base
    """What a network reads or writes."""


class AbstractFeatureBuilder(ABC):  # noqa: B024  # a mere base
    """Makes features."""


class AbstractTargetBuilder(ABC):  # noqa: B024  # a mere base
    """Makes what a network is to learn."""


class EgoTrajectoryTargetBuilder(AbstractTargetBuilder):
    """Names the trajectory of the ego as the target; shiftsim has no scenarios to train on."""

    def __init__(self, future_trajectory_sampling: TrajectorySampling) -> None:
        self._sampling = future_trajectory_sampling

    @classmethod
    def get_feature_unique_name(cls) -> str:
        """Name of the target."""
        return "trajectory"
