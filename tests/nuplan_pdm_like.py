"""A planner that imports what PDM-Closed's public sources import, and calls it."""

import numpy as np
import shapely
from nuplan.common.actor_state.agent import Agent
from nuplan.common.actor_state.car_footprint import CarFootprint
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.scene_object import SceneObject
from nuplan.common.actor_state.state_representation import (
    Point2D,
    StateSE2,
    StateVector2D,
    TimeDuration,
    TimePoint,
)
from nuplan.common.actor_state.tracked_objects import TrackedObject
from nuplan.common.actor_state.tracked_objects_types import AGENT_TYPES, TrackedObjectType
from nuplan.common.actor_state.vehicle_parameters import VehicleParameters, get_pacifica_parameters
from nuplan.common.geometry.compute import principal_value
from nuplan.common.geometry.convert import relative_to_absolute_poses
from nuplan.common.geometry.transform import transform
from nuplan.common.maps.abstract_map import AbstractMap
from nuplan.common.maps.abstract_map_objects import (
    LaneGraphEdgeMapObject,
    RoadBlockGraphEdgeMapObject,
)
from nuplan.common.maps.maps_datatypes import (
    SemanticMapLayer,
    TrafficLightStatusData,
    TrafficLightStatusType,
)
from nuplan.common.maps.nuplan_map.utils import get_distance_between_map_object_and_point
from nuplan.planning.metrics.utils.collision_utils import CollisionType
from nuplan.planning.simulation.observation.idm.utils import (
    create_path_from_se2,
    is_agent_ahead,
    is_agent_behind,
    is_track_stopped,
    path_to_linestring,
)
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks, Observation
from nuplan.planning.simulation.occupancy_map.abstract_occupancy_map import Geometry
from nuplan.planning.simulation.occupancy_map.strtree_occupancy_map import (
    STRTreeOccupancyMapFactory,
)
from nuplan.planning.simulation.planner.abstract_planner import (
    AbstractPlanner,
    PlannerInitialization,
    PlannerInput,
)
from nuplan.planning.simulation.planner.utils.breadth_first_search import BreadthFirstSearch
from nuplan.planning.simulation.simulation_time_controller.simulation_iteration import (
    SimulationIteration,
)
from nuplan.planning.simulation.trajectory.abstract_trajectory import AbstractTrajectory
from nuplan.planning.simulation.trajectory.interpolated_trajectory import InterpolatedTrajectory
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling

ASKED = (Agent, CarFootprint, SceneObject, Point2D, TimeDuration, TrackedObject, AGENT_TYPES)
ASKED += (TrackedObjectType, VehicleParameters, principal_value, relative_to_absolute_poses)
ASKED += (transform, AbstractMap, LaneGraphEdgeMapObject, RoadBlockGraphEdgeMapObject)
ASKED += (TrafficLightStatusData, TrafficLightStatusType, CollisionType, is_agent_behind)
ASKED += (Observation, Geometry, SimulationIteration, AbstractTrajectory)


class PdmLike(AbstractPlanner):
    """Follows the centre line of the route, and stops for what is ahead on it."""

    def __init__(self, speed: float = 6.0):
        self._sampling = TrajectorySampling(num_poses=40, interval_length=0.1)
        self._speed = speed

    def name(self):
        return type(self).__name__

    def observation_type(self):
        return DetectionsTracks

    def initialize(self, initialization: PlannerInitialization):
        road = initialization.map_api
        self._blocks = [
            road.get_map_object(name, SemanticMapLayer.ROADBLOCK)
            or road.get_map_object(name, SemanticMapLayer.ROADBLOCK_CONNECTOR)
            for name in initialization.route_roadblock_ids
        ]
        kinds = {block.__class__.__name__ for block in self._blocks}
        assert kinds <= {"NuPlanRoadBlock", "NuPlanRoadBlockConnector"}, kinds

    def compute_planner_trajectory(self, current_input: PlannerInput):
        ego, seen = current_input.history.current_state
        path = self._path(ego)
        line = path_to_linestring(path.get_sampled_path())
        tracks = [item for item in seen.tracked_objects if is_agent_ahead(ego.center, item.center)]
        found = STRTreeOccupancyMapFactory.get_from_boxes(tracks)
        found.insert("ego", ego.car_footprint.geometry)
        found = found.intersects(line.buffer(1.0))
        room = np.inf
        if found.size > 1 and found.contains("ego"):
            name, _, room = found.get_nearest_entry_to("ego")
            leader = next(item for item in tracks if item.track_token == name)
            room += 0.0 if is_track_stopped(leader) else leader.velocity.magnitude()
        speed = min(self._speed, max(0.5 * (room - 4.0), 0.0))
        first = line.project(shapely.Point(*ego.rear_axle.point))
        last = path.get_end_progress()
        states = [ego]
        for step in range(1, self._sampling.num_poses + 1):
            pose = path.get_state_at_progress(min(first + 0.1 * step * speed, last))
            states.append(
                EgoState.build_from_rear_axle(
                    StateSE2(pose.x, pose.y, pose.heading),
                    StateVector2D(speed, 0.0),
                    StateVector2D(0.0, 0.0),
                    0.0,
                    ego.time_point + TimePoint(100_000 * step),
                    get_pacifica_parameters(),
                )
            )
        return InterpolatedTrajectory(states)

    def _path(self, ego):
        edges = [edge for block in self._blocks for edge in block.interior_edges]

        def distance(edge):
            return get_distance_between_map_object_and_point(ego.rear_axle, edge)

        start = min(edges, key=distance)
        index = next(i for i, b in enumerate(self._blocks) if b.id == start.get_roadblock_id())
        ahead = self._blocks[index:]
        search = BreadthFirstSearch(start, [edge.id for edge in edges])
        lanes, _ = search.search(ahead[-1], len(ahead))
        return create_path_from_se2([p for lane in lanes for p in lane.baseline_path.discrete_path])
