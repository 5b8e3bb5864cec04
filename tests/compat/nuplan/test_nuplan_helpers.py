"""Helper modules of the devkit that planners import: small cases worked out by hand."""

import numpy as np
import places
import pytest
import shapely

from shiftsim.compat import nuplan

if not nuplan.install():
    pytest.skip("nuPlan's devkit is installed", allow_module_level=True)

from nuplan.common.actor_state.ego_state import EgoState
from nuplan.common.actor_state.state_representation import (
    ProgressStateSE2,
    StateSE2,
    StateVector2D,
    TimePoint,
)
from nuplan.common.actor_state.vehicle_parameters import get_pacifica_parameters
from nuplan.common.maps.maps_datatypes import SemanticMapLayer
from nuplan.common.maps.nuplan_map.utils import (
    get_distance_between_map_object_and_point,
)
from nuplan.planning.metrics.utils import state_extractors
from nuplan.planning.metrics.utils.collision_utils import CollisionType
from nuplan.planning.simulation.observation.idm import utils as idm
from nuplan.planning.simulation.occupancy_map.strtree_occupancy_map import (
    STRTreeOccupancyMapFactory,
)
from nuplan.planning.simulation.path.interpolated_path import InterpolatedPath
from nuplan.planning.simulation.planner.ml_planner import transform_utils
from nuplan.planning.simulation.planner.utils.breadth_first_search import (
    BreadthFirstSearch,
)
from nuplan.planning.training.preprocessing.features.trajectory_utils import (
    convert_absolute_to_relative_poses,
)
from worlds import straight_road

from shiftsim.compat.nuplan.bridge.map import BridgeMap

FIELD_CASE = places.REPOSITORY.parent / "shared/reference/field_cases/c1_class_name"


def _history(accel=2.0, count=22):
    """States 0.1 s apart, the last at 5 s and x = 0 with 10 m/s, driving along x."""
    times = 0.1 * np.arange(1 - count, 1)
    return [
        EgoState.build_from_rear_axle(
            StateSE2(10.0 * t + 0.5 * accel * t**2, 0.0, 0.0),
            StateVector2D(10.0 + accel * t, 0.0),
            StateVector2D(accel, 0.0),
            0.0,
            TimePoint(round(5_000_000 + 1e6 * t)),
            get_pacifica_parameters(),
        )
        for t in times.tolist()
    ]


def test_the_nearest_geometry_is_found_and_parts_of_its_id_are_left_out():
    boxes = [shapely.box(x, 0.0, x + 1.0, 1.0) for x in (0.0, 3.0, 9.0)]
    found = STRTreeOccupancyMapFactory.get_from_geometry(boxes, ["ego", "a", "b"])
    name, geometry, distance = found.get_nearest_entry_to("ego")
    assert (name, distance) == ("a", 2.0)
    assert geometry is boxes[1]
    found.insert("go", shapely.box(1.5, 0.0, 2.0, 1.0))  # nuPlan rule 610
    assert found.get_nearest_entry_to("ego")[0] == "a"
    assert found.intersects(shapely.LineString([(2.0, 0.5), (5.0, 0.5)])).size == 2
    tree, names = found._build_strtree()  # public planners look for loops of routes with it
    assert [names[index] for index in tree.query(shapely.box(9.5, 0.0, 9.6, 1.0))] == ["b"]
    found.remove(["a", "go"])
    assert (len(found), found.size, found.is_empty()) == (2, 2, False)
    assert not found.contains("a")


def test_angles_to_agents_decide_what_is_ahead_and_behind():
    ego = StateSE2(0.0, 0.0, np.pi / 2)
    assert idm.is_agent_ahead(ego, StateSE2(1.0, 2.0, 0.0))  # 26.6 deg
    assert not idm.is_agent_ahead(ego, StateSE2(2.0, 1.0, 0.0))
    assert idm.is_agent_behind(ego, StateSE2(1.0, -2.0, 0.0))
    assert not idm.is_agent_behind(ego, StateSE2(2.0, -1.0, 0.0))


def test_a_path_is_linear_between_poses_and_counts_repeated_ones_once():
    poses = [StateSE2(x, 0.0, heading) for x, heading in ((0, 0), (4, 0.4), (4, 0.4), (8, 0.8))]
    path = idm.create_path_from_se2([*poses, StateSE2(9.0, 0.0, 0.8)])
    assert (path.get_start_progress(), path.get_end_progress()) == (0.0, 8.0)  # nuPlan rule 611
    pose = path.get_state_at_progress(2.0)
    np.testing.assert_allclose([*pose], [2.0, 2.0, 0.0, 0.2], rtol=0, atol=1e-12)
    with pytest.raises(AssertionError, match="not on the path"):
        path.get_state_at_progress(8.1)
    turn = InterpolatedPath([ProgressStateSE2(0, 0, 0, 3.0), ProgressStateSE2(1, 1, 0, -3.0)])
    assert abs(turn.get_state_at_progress(0.5).heading) == pytest.approx(np.pi)


def test_the_search_finds_lanes_to_a_roadblock_at_its_depth():
    road = BridgeMap(straight_road())
    start = road.get_map_object("11", SemanticMapLayer.LANE)
    last = road.get_map_object("3", SemanticMapLayer.ROADBLOCK)
    names = [
        edge.id
        for layer in ("LANE", "LANE_CONNECTOR")
        for edge in road.objects(SemanticMapLayer[layer])
    ]
    way, is_found = BreadthFirstSearch(start, names).search(last, 3)
    assert is_found
    assert [edge.get_roadblock_id() for edge in way] == ["1", "2", "3"]
    assert not BreadthFirstSearch(start, names).search(last, 2)[1]
    way, is_found = BreadthFirstSearch(start, ["21"]).search(last, 3)
    assert ([edge.id for edge in way], is_found) == (["11", "21"], False)
    assert get_distance_between_map_object_and_point(StateSE2(-3.0, 0.0, 0.0), start) == 3.0


def test_predicted_poses_become_states_with_velocities_of_the_whole_way():
    history = _history(accel=0.0)
    poses = np.c_[np.arange(1.0, 81.0), np.zeros(80), np.zeros(80)]  # 10 m/s
    states = transform_utils.transform_predictions_to_states(poses, history, 8.0, 0.1)
    assert states[0] is history[-1]
    assert len(states) == 81
    rows = [(s.rear_axle.x, s.dynamic_car_state.rear_axle_velocity_2d.x, s.time_us) for s in states]
    x, speed, times = np.array(rows).T
    np.testing.assert_allclose(x, np.arange(81.0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(speed, 10.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.diff(times), 100_000, rtol=0, atol=1)


def test_lateral_velocities_of_predictions_are_positive_to_the_right():  # nuPlan rule 612
    poses = [StateSE2(0.1 * k, 0.2 * k, 0.0) for k in range(1, 11)]
    times = [5.0 + 0.1 * k for k in range(1, 11)]
    velocity, _ = transform_utils._get_velocity_and_acceleration(poses, _history(), times)
    np.testing.assert_allclose(velocity[5], [1.0, -2.0], rtol=0, atol=1e-9)


def test_signals_of_a_steady_acceleration_are_steady():
    states = _history(accel=2.0)
    times = state_extractors.extract_ego_time_point(states) / 1e6
    speed = state_extractors.extract_ego_velocity(states)
    rate = state_extractors.approximate_derivatives(speed, times)
    np.testing.assert_allclose(rate, 2.0, rtol=0, atol=1e-9)
    accel = state_extractors.extract_ego_acceleration(states, "x")
    np.testing.assert_allclose(accel, 2.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(state_extractors.extract_ego_jerk(states, "magnitude"), 0, atol=1e-8)
    np.testing.assert_allclose(state_extractors.extract_ego_yaw_rate(states), 0, atol=1e-8)
    with pytest.raises(ValueError, match="needs more than 2 samples"):
        state_extractors.approximate_derivatives(speed[:2], times[:2])


def test_relative_poses_are_in_the_frame_of_the_origin():
    found = convert_absolute_to_relative_poses(
        StateSE2(1.0, 2.0, np.pi / 2), [StateSE2(1.0, 5.0, np.pi / 2), StateSE2(0.0, 2.0, np.pi)]
    )
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, [[3, 0, 0], [0, 1, np.pi / 2]], rtol=0, atol=1e-6)


def test_kinds_of_collisions_are_numbered_as_in_nuplan():
    assert [kind.name.partition("_COLL")[0] for kind in CollisionType] == [
        "STOPPED_EGO",
        "STOPPED_TRACK",
        "ACTIVE_FRONT",
        "ACTIVE_REAR",
        "ACTIVE_LATERAL",
    ]


@pytest.mark.learned
def test_poses_as_tensors_are_moved_as_poses_are():
    import torch
    from nuplan.common.geometry import torch_geometry

    origin = torch.tensor([1.0, 2.0, np.pi / 2], dtype=torch.float64)
    poses = torch.tensor([[1.0, 5.0, np.pi / 2], [0.0, 2.0, np.pi]], dtype=torch.float64)
    moved = torch_geometry.global_state_se2_tensor_to_local(poses, origin)
    np.testing.assert_allclose(moved, [[3, 0, 0], [0, 1, np.pi / 2]], rtol=0, atol=1e-12)
    points = torch_geometry.coordinates_to_local_frame(poses[:, :2], origin)
    np.testing.assert_allclose(points, moved[:, :2], rtol=0, atol=1e-12)
    there = torch.tensor([[True, False]])
    both = torch_geometry.vector_set_coordinates_to_local_frame(poses[None, :, :2], there, origin)
    np.testing.assert_allclose(both, [[[3, 0], [0, 0]]], rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="need a precision"):
        torch_geometry.coordinates_to_local_frame(poses[:, :2].float(), origin)


@pytest.mark.skipif(not FIELD_CASE.exists(), reason="the reference folder is not there")
@pytest.mark.learned
@pytest.mark.parametrize(
    "name",
    "ClassName Pdm PdmIdm MlTransform GameFormer MapUtils TorchGeo Wrapper".split(),
)
def test_the_planners_of_the_field_case_drive(name, monkeypatch, capsys):
    from worlds import cruise_scenario

    from shiftsim.planners.registry import load_planner
    from shiftsim.sim.loop import simulate

    (file,) = FIELD_CASE.glob("*.py")
    planner = load_planner(f"nuplan:{file}:{name}")
    assert simulate(cruise_scenario(iterations=5), planner).ego.shape == (4, 11)
