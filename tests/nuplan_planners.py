"""Planners written against nuPlan's interface alone, and one twin against shiftsim's."""

import numpy as np
from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.oriented_box import OrientedBox, in_collision
from nuplan.common.actor_state.state_representation import StateSE2, StateVector2D, TimePoint
from nuplan.common.actor_state.tracked_objects_types import TrackedObjectType
from nuplan.common.geometry.compute import longitudinal_distance
from nuplan.common.geometry.transform import translate_longitudinally
from nuplan.common.maps.abstract_map import SemanticMapLayer
from nuplan.common.maps.maps_datatypes import TrafficLightStatusType
from nuplan.planning.simulation.controller.motion_model.kinematic_bicycle import (
    KinematicBicycleModel,
)
from nuplan.planning.simulation.observation.observation_type import DetectionsTracks, Sensors
from nuplan.planning.simulation.planner.abstract_planner import AbstractPlanner
from nuplan.planning.simulation.trajectory.abstract_trajectory import AbstractTrajectory
from nuplan.planning.simulation.trajectory.interpolated_trajectory import InterpolatedTrajectory
from nuplan.planning.simulation.trajectory.trajectory_sampling import TrajectorySampling


class Named(AbstractPlanner):
    """What the planners below share."""

    def name(self):
        return type(self).__name__

    def initialize(self, initialization):
        self._initialization = initialization

    def observation_type(self):
        return DetectionsTracks


def moved_to(state, pose, speed, time_us):
    """A state of the same car elsewhere."""
    return EgoState.build_from_rear_axle(
        rear_axle_pose=pose,
        rear_axle_velocity_2d=StateVector2D(speed, 0.0),
        rear_axle_acceleration_2d=StateVector2D(0.0, 0.0),
        tire_steering_angle=0.0,
        time_point=TimePoint(time_us),
        vehicle_parameters=state.car_footprint.vehicle_parameters,
    )


class Coast(Named):
    """States and a trajectory only: heading and speed are kept."""

    def __init__(self, horizon: float = 8.0):
        self._sampling = TrajectorySampling(time_horizon=horizon, interval_length=0.1)

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        speed = ego.dynamic_car_state.speed
        states = []
        for step in range(self._sampling.num_poses + 1):
            pose = translate_longitudinally(ego.rear_axle, speed * 0.1 * step)
            states.append(moved_to(ego, pose, speed, ego.time_us + 100_000 * step))
        return InterpolatedTrajectory(states)


class Late(Coast):
    """Leaves out the present state."""

    def compute_planner_trajectory(self, current_input):
        plan = super().compute_planner_trajectory(current_input)
        return InterpolatedTrajectory(plan.get_sampled_trajectory()[1:])


class Roll(Named):
    """The motion model, as nuPlan's own simple planner uses it: 40 steps of 0.25 s."""

    def __init__(self, max_velocity: float = 5.0):
        self._max_velocity = max_velocity

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        car = ego.car_footprint.vehicle_parameters
        model = KinematicBicycleModel(car)
        velocity = ego.dynamic_car_state.rear_axle_velocity_2d
        states = [self._state(ego, velocity, 0.0)]
        for _ in range(40):
            state = states[-1]
            over = state.dynamic_car_state.speed - self._max_velocity
            if over > 0.0:
                velocity = state.dynamic_car_state.rear_axle_velocity_2d
                state = self._state(state, velocity, -over)
            step = TimePoint(250_000)
            states.append(model.propagate_state(state, state.dynamic_car_state, step))
        return InterpolatedTrajectory(states)

    @staticmethod
    def _state(state, velocity, accel):
        return EgoState.build_from_rear_axle(
            rear_axle_pose=state.rear_axle,
            rear_axle_velocity_2d=velocity,
            rear_axle_acceleration_2d=StateVector2D(accel, 0.0),
            tire_steering_angle=0.0,
            time_point=state.time_point,
            vehicle_parameters=state.car_footprint.vehicle_parameters,
        )


class FollowRoute(Named):
    """The map: lanes of the route's roadblocks one after the other, at the speed limit."""

    def initialize(self, initialization):
        self._road = initialization.map_api
        self._route = initialization.route_roadblock_ids
        self.lanes = []

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        lane = self._lane_of(ego.rear_axle)
        if not self.lanes or lane.id != self.lanes[-1]:
            self.lanes.append(lane.id)
        path, limit = self._path_from(lane)
        line = lane.baseline_path
        start = line.get_nearest_arc_length_from_position(ego.rear_axle)
        states = []
        for step in range(41):
            pose = self._pose(path, start + limit * 0.1 * step)
            states.append(moved_to(ego, pose, limit, ego.time_us + 100_000 * step))
        return InterpolatedTrajectory(states)

    def _lane_of(self, pose):
        layers = [SemanticMapLayer.LANE, SemanticMapLayer.LANE_CONNECTOR]
        for layer in layers:
            for lane in self._road.get_all_map_objects(pose, layer):
                if lane.get_roadblock_id() in self._route:
                    return lane
        near = self._road.get_proximal_map_objects(pose, 10.0, layers)
        return next(lane for layer in layers for lane in near[layer])

    def _path_from(self, lane):
        poses, limit = list(lane.baseline_path.discrete_path), lane.speed_limit_mps
        while following := [edge for edge in lane.outgoing_edges if edge.parent.id in self._route]:
            lane = following[0]
            poses += lane.baseline_path.discrete_path
        return poses, limit

    @staticmethod
    def _pose(path, arc):
        x, y = np.array([pose.x for pose in path]), np.array([pose.y for pose in path])
        along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        heading = np.unwrap([pose.heading for pose in path])
        at = (np.interp(arc, along, values) for values in (x, y, heading))
        return StateSE2(*at)


class FollowLeader(Named):
    """History, tracks and lights: keeps a gap to what is ahead, and stops where a light is red."""

    def compute_planner_trajectory(self, current_input):
        egos = current_input.history.ego_states
        ego, seen = current_input.history.current_state
        now = ego.dynamic_car_state.rear_axle_velocity_2d.x
        before = egos[-2].dynamic_car_state.rear_axle_velocity_2d.x
        wish = now + 0.5 * (now - before) + 0.1
        for gap in [*self._gaps(ego, seen), *self._red(ego, current_input.traffic_light_data)]:
            wish = min(wish, max(0.0, 0.4 * (gap - 4.0)))
        states = []
        for step in range(41):
            pose = translate_longitudinally(ego.rear_axle, wish * 0.1 * step)
            states.append(moved_to(ego, pose, wish, ego.time_us + 100_000 * step))
        return InterpolatedTrajectory(states)

    @staticmethod
    def _gaps(ego, seen):
        vehicles = seen.tracked_objects.get_tracked_objects_of_type(TrackedObjectType.VEHICLE)
        swept = translate_longitudinally(ego.center, 30.0)
        lane = OrientedBox(swept, 60.0, ego.car_footprint.width, 2.0)
        for vehicle in vehicles:
            if in_collision(lane, vehicle.box):
                yield longitudinal_distance(ego.center, vehicle.center)

    def _red(self, ego, lights):
        road = self._initialization.map_api
        for light in lights:
            connector = road.get_map_object(
                str(light.lane_connector_id), SemanticMapLayer.LANE_CONNECTOR
            )
            if light.status == TrafficLightStatusType.RED and connector is not None:
                gap = longitudinal_distance(ego.center, connector.baseline_path.discrete_path[0])
                if gap > 0.0:
                    yield gap


class Recorder(Coast):
    """Keeps what it is given."""

    def __init__(self):
        super().__init__()
        self.inputs, self.buffers = [], []

    def compute_planner_trajectory(self, current_input):
        self.inputs.append(current_input)
        history = current_input.history
        self.buffers.append((history.ego_states, history.observations))
        return super().compute_planner_trajectory(current_input)


class Circle(AbstractTrajectory):
    """A trajectory that is not made of states: a circle to the left at constant speed."""

    def __init__(self, ego, radius):
        self._ego, self._radius = ego, radius

    @property
    def start_time(self):
        return self._ego.time_point

    @property
    def end_time(self):
        return self._ego.time_point + TimePoint(4_000_000)

    def get_state_at_time(self, time_point):
        ego, speed = self._ego, self._ego.dynamic_car_state.speed
        turned = speed * time_point.diff(ego.time_point).time_s / self._radius
        heading = ego.rear_axle.heading
        x = ego.rear_axle.x + self._radius * (np.sin(heading + turned) - np.sin(heading))
        y = ego.rear_axle.y - self._radius * (np.cos(heading + turned) - np.cos(heading))
        return moved_to(ego, StateSE2(x, y, heading + turned), speed, time_point.time_us)

    def get_state_at_times(self, time_points):
        return [self.get_state_at_time(moment) for moment in time_points]

    def get_sampled_trajectory(self):
        return self.get_state_at_times([self.start_time, self.end_time])


class DriveInCircles(Named):
    """Its plans are of a class of its own."""

    def compute_planner_trajectory(self, current_input):
        ego, _ = current_input.history.current_state
        return Circle(ego, 40.0)


class Oracle(Coast):
    requires_scenario = True


class WantsImages(Coast):
    def observation_type(self):
        return Sensors


class ReturnsAList(Coast):
    def compute_planner_trajectory(self, current_input):
        return super().compute_planner_trajectory(current_input).get_sampled_trajectory()


class Unfinished(Named):
    pass
