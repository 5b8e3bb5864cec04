"""The classes of nuPlan's interface mean what ours mean."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import rear_states

from shiftsim.compat.nuplan.bridge.planner import (
    ego_state,
    observed_tracks,
    traffic_lights,
    vehicle_parameters,
)
from shiftsim.geometry.boxes import box_corners
from shiftsim.sim.dynamics.perfect import interpolate
from shiftsim.world.state import (
    NUM_STATE,
    PACIFICA,
    STEERING,
    AgentKind,
    LightStatus,
    Tracks,
    TrafficLights,
    center_accelerations,
    center_poses,
    center_velocities,
)

from nuplan.common.actor_state.agent import Agent  # isort: skip  # the names exist now
from nuplan.common.actor_state.car_footprint import CarFootprint  # isort: skip
from nuplan.common.actor_state.ego_state import EgoState  # isort: skip
from nuplan.common.actor_state.oriented_box import (  # isort: skip
    OrientedBox,
    OrientedBoxPointType,
    in_collision,
)
from nuplan.common.actor_state.state_representation import (  # isort: skip
    StateSE2,
    StateVector2D,
    TimeDuration,
    TimePoint,
)
from nuplan.common.actor_state.static_object import StaticObject  # isort: skip
from nuplan.common.actor_state.tracked_objects_types import TrackedObjectType  # isort: skip
from nuplan.common.geometry.convert import (  # isort: skip
    absolute_to_relative_poses,
    relative_to_absolute_poses,
)
from nuplan.common.geometry.transform import (  # isort: skip
    rotate_angle,
    transform,
    translate_longitudinally,
)
from nuplan.planning.simulation.observation.observation_type import (  # isort: skip
    DetectionsTracks,
)
from nuplan.planning.simulation.trajectory.interpolated_trajectory import (  # isort: skip
    InterpolatedTrajectory,
)
from nuplan.planning.simulation.trajectory.predicted_trajectory import (  # isort: skip
    PredictedTrajectory,
)
from nuplan.planning.simulation.trajectory.trajectory_sampling import (  # isort: skip
    TrajectorySampling,
)

CAR = vehicle_parameters(PACIFICA)
START_US = 1_600_000_000_000_000
numbers = st.floats(-20.0, 20.0)
rows = st.lists(st.lists(numbers, min_size=NUM_STATE, max_size=NUM_STATE), min_size=2, max_size=6)


@given(rows, st.lists(st.integers(1, 400_000), min_size=5, max_size=5), st.floats(0.0, 1.0))
def test_a_trajectory_interpolates_as_the_simulation_does(values, gaps, fraction):
    states = np.array(values)
    times = START_US + np.cumsum([0, *gaps])[: len(states)]
    plan = InterpolatedTrajectory(
        [ego_state(time, row, CAR) for time, row in zip(times, states, strict=True)]
    )
    at = int(times[0] + fraction * (times[-1] - times[0]))
    wanted = np.zeros(NUM_STATE)
    assert interpolate(times, states, at, wanted)
    found = np.array([*plan.get_state_at_time(TimePoint(at))])
    assert found[0] == at
    np.testing.assert_allclose(found[1:], wanted[: STEERING + 1], rtol=0, atol=1e-9)
    assert plan.get_state_at_time(TimePoint(at)).dynamic_car_state.angular_velocity == 0.0


def test_a_trajectory_ends_where_its_states_do():
    states = [ego_state(START_US + i * 100_000, np.zeros(NUM_STATE), CAR) for i in range(3)]
    plan = InterpolatedTrajectory(states)
    assert plan.duration_us == 200_000
    assert plan.is_in_range(START_US + 200_000)
    with pytest.raises(AssertionError, match="trajectory"):
        plan.get_state_at_time(TimePoint(START_US + 200_001))
    with pytest.raises(ValueError, match="states"):
        InterpolatedTrajectory(states[:1])


@given(st.lists(numbers, min_size=NUM_STATE, max_size=NUM_STATE))
def test_the_centre_of_the_ego_is_ours(values):
    row = np.array(values)
    state = ego_state(START_US, row, CAR)
    motion = state.dynamic_car_state
    close = {"rtol": 0, "atol": 1e-9}
    np.testing.assert_allclose([*state.center], center_poses(row[:3]), **close)
    np.testing.assert_allclose(motion.center_velocity_2d.array, center_velocities(row), **close)
    accel = motion.center_acceleration_2d.array
    np.testing.assert_allclose(accel, center_accelerations(row), **close)
    assert motion.speed == pytest.approx(np.hypot(*row[3:5]))


@given(st.lists(numbers, min_size=NUM_STATE, max_size=NUM_STATE))
def test_a_state_from_the_centre_is_ours_at_the_rear_axle(values):
    row = np.array(values)
    state = EgoState.build_from_center(
        StateSE2(*row[:3]),
        StateVector2D(*row[3:5]),
        StateVector2D(*row[5:7]),
        row[7],
        TimePoint(START_US),
        CAR,
        angular_vel=row[9],
        angular_accel=row[10],
    )
    np.testing.assert_allclose([*state][1:8], rear_states(row)[:7], rtol=0, atol=1e-9)


@given(numbers, numbers, numbers)
def test_corners_of_a_box_are_ours(x, y, heading):
    box = OrientedBox(StateSE2(x, y, heading), 4.5, 2.0, 1.5)
    wanted = np.zeros((4, 2))
    box_corners(x, y, heading, 4.5, 2.0, wanted)
    np.testing.assert_allclose([[*p] for p in box.all_corners()], wanted, rtol=0, atol=1e-12)
    assert box.geometry.area == pytest.approx(9.0)


def test_a_footprint_is_the_same_from_its_centre_of_gravity():
    wanted = CarFootprint.build_from_rear_axle(StateSE2(1.0, 2.0, 0.5), CAR)
    cog = translate_longitudinally(wanted.rear_axle, CAR.cog_position_from_rear_axle)
    found = CarFootprint.build_from_cog(cog_pose=cog, vehicle_parameters=CAR)
    np.testing.assert_allclose([*found.center], [*wanted.center], rtol=0, atol=1e-12)
    front = found.get_point_of_interest(OrientedBoxPointType.FRONT_BUMPER)
    assert front == found.corner(OrientedBoxPointType.FRONT_BUMPER)


def test_boxes_that_touch_collide():
    box, other, far = (OrientedBox(StateSE2(x, 0.0, 0.0), 4.0, 2.0, 1.5) for x in (0.0, 4.0, 4.1))
    assert in_collision(box, other)
    assert not in_collision(box, far)


@given(st.lists(st.tuples(numbers, numbers, st.floats(-3.0, 3.0)), min_size=1, max_size=5))
def test_poses_survive_the_way_into_a_frame_and_back(poses):
    states = [StateSE2(*pose) for pose in poses]
    relative = absolute_to_relative_poses(states)
    back = relative_to_absolute_poses(states[0], relative)
    np.testing.assert_allclose([[*s] for s in back], poses, rtol=0, atol=1e-9)


def test_a_rotation_is_that_of_a_row_vector():
    turned = rotate_angle(StateSE2(1.0, 0.0, 0.0), np.pi / 2)
    np.testing.assert_allclose([*turned], [0.0, -1.0, np.pi / 2], rtol=0, atol=1e-12)
    moved = transform(StateSE2(1.0, 2.0, 0.3), StateSE2(5.0, 6.0, 0.0).as_matrix())
    np.testing.assert_allclose([*moved], [6.0, 8.0, 0.3], rtol=0, atol=1e-12)


def test_poses_are_equal_within_a_millimetre():
    assert StateSE2(1.0, 2.0, 0.5) == StateSE2(1.0009, 2.0, 0.50009)
    assert StateSE2(1.0, 2.0, 0.5) != StateSE2(1.0021, 2.0, 0.5)


def test_seconds_are_a_quotient_in_durations_and_a_product_in_moments():
    assert TimeDuration.from_us(100_000).time_s == 0.1
    assert TimePoint(100_000).time_s == 0.09999999999999999
    assert TimePoint(5).diff(TimePoint(7)).time_us == -2
    assert isinstance(TimePoint(7) - TimePoint(5), TimePoint)
    with pytest.raises(AssertionError):
        TimePoint(5) - TimePoint(7)


@pytest.mark.parametrize(
    ("given_values", "wanted"),
    [
        ({"num_poses": 8, "time_horizon": 4}, (8, 4.0, 0.5)),
        ({"num_poses": 8, "interval_length": 0.5}, (8, 4.0, 0.5)),
        ({"time_horizon": 8, "interval_length": 0.1}, (80, 8.0, 0.1)),
    ],
)
def test_the_third_value_of_a_sampling_follows_from_two(given_values, wanted):
    sampling = TrajectorySampling(**given_values)
    found = (sampling.num_poses, sampling.time_horizon, sampling.interval_length)
    assert found == pytest.approx(wanted)
    assert sampling.step_time == sampling.interval_length


@pytest.mark.parametrize(
    "values",
    [{}, {"num_poses": 8}, {"time_horizon": 1.0, "interval_length": 0.3}, {"num_poses": 7.5}],
)
def test_a_sampling_that_does_not_add_up_is_refused(values):
    with pytest.raises(ValueError, match=r"num_poses|time_horizon"):
        TrajectorySampling(**values)


def _tracks():
    kinds = [AgentKind.BARRIER, AgentKind.PEDESTRIAN, AgentKind.VEHICLE, AgentKind.VEHICLE]
    poses = np.arange(12.0).reshape(1, 4, 3)
    velocities = np.array([[[np.nan, np.nan], [1.0, 0.5], [2.0, 0.0], [3.0, 0.0]]])
    valid = np.array([[True, True, True, False]])
    sizes = np.tile([4.0, 2.0], (1, 4, 1))
    return Tracks(valid, poses, velocities, sizes, np.array(kinds), ("a", "b", "c", "d"))


def test_objects_come_sorted_by_type_and_absent_ones_not_at_all():
    observed = observed_tracks(START_US, _tracks())
    assert (type(observed), observed.detection_type()) == (DetectionsTracks, "DetectionsTracks")
    seen = observed.tracked_objects
    assert [item.track_token for item in seen] == ["c", "b", "a"]
    vehicle, pedestrian, barrier = seen
    assert isinstance(vehicle, Agent)
    assert isinstance(barrier, StaticObject)
    assert not isinstance(barrier, Agent)
    assert [*pedestrian.center] == [3.0, 4.0, 5.0]
    assert (pedestrian.box.length, pedestrian.box.width) == (4.0, 2.0)
    assert (pedestrian.velocity.x, pedestrian.velocity.y) == (1.0, 0.5)
    assert pedestrian.metadata.timestamp_us == START_US
    assert (vehicle.predictions, vehicle.past_trajectory, vehicle.previous_state) == (
        [],
        None,
        None,
    )
    assert np.isnan(vehicle.angular_velocity)
    assert len(seen.get_agents()) == 2
    assert seen.get_static_objects() == [barrier]
    bicycles = seen.get_tracked_objects_of_type(tracked_object_type=TrackedObjectType.BICYCLE)
    assert bicycles == []
    assert seen.get_tracked_objects_of_types(
        [TrackedObjectType.BARRIER, TrackedObjectType.VEHICLE]
    ) == [barrier, vehicle]


def test_predictions_must_add_up_to_one():
    agent = next(iter(observed_tracks(START_US, _tracks()).tracked_objects))
    with pytest.raises(ValueError, match="probabilit"):
        agent.predictions = [PredictedTrajectory(0.4, [None])]
    agent.predictions = [PredictedTrajectory(0.4, [None]), PredictedTrajectory(0.6, [None])]
    assert len(agent.predictions) == 2


def test_lights_have_integers_for_ids_where_they_can():
    status = np.array([[int(LightStatus.RED), int(LightStatus.ABSENT), int(LightStatus.GREEN)]])
    lights = TrafficLights(("7", "8", "x9"), status.astype(np.int8))
    found = traffic_lights(START_US, lights)
    assert [(light.lane_connector_id, light.status.name) for light in found] == [
        (7, "RED"),
        ("x9", "GREEN"),
    ]
