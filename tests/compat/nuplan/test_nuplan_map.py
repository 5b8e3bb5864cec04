"""The map interface gives what the map holds, in nuPlan's way."""

import numpy as np
import pytest
import shapely
from worlds import straight_road

from shiftsim.compat.nuplan.bridge.map import _KINDS, BridgeMap
from shiftsim.errors import MapError
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.layers import make_polylines

from nuplan.common.actor_state.state_representation import (  # isort: skip  # the names exist now
    Point2D,
    StateSE2,
)
from nuplan.common.maps.maps_datatypes import (  # isort: skip
    LaneConnectorType,
    SemanticMapLayer,
    StopLineType,
)


@pytest.fixture
def road():
    return BridgeMap(straight_road())


def _ids(objects):
    return [item.id for item in objects]


def test_objects_are_made_once(road):
    lane = road.get_map_object("11", SemanticMapLayer.LANE)
    assert road.get_map_object("11", SemanticMapLayer.LANE) is lane
    (connector,) = lane.outgoing_edges
    assert connector.incoming_edges == [lane]
    assert connector.incoming_edges[0] is lane
    assert connector.outgoing_edges[0].incoming_edges[0] is connector


def test_an_id_is_found_in_its_own_layer_only(road):
    assert road.get_map_object("21", SemanticMapLayer.LANE) is None
    assert road.get_map_object("21", SemanticMapLayer.LANE_CONNECTOR).id == "21"
    assert road.get_map_object("2", SemanticMapLayer.ROADBLOCK) is None
    assert road._get_roadblock_connector("2").id == "2"
    with pytest.raises(ValueError, match="BASELINE_PATHS"):
        road.get_map_object("1", SemanticMapLayer.BASELINE_PATHS)
    with pytest.raises(ValueError, match="DRIVABLE_AREA has no objects"):
        road.get_map_object("90", SemanticMapLayer.DRIVABLE_AREA)


@pytest.mark.parametrize(
    ("layer", "object_id", "name"),
    [
        ("LANE", "11", "NuPlanLane"),
        ("LANE_CONNECTOR", "21", "NuPlanLaneConnector"),
        ("ROADBLOCK", "1", "NuPlanRoadBlock"),
        ("ROADBLOCK_CONNECTOR", "2", "NuPlanRoadBlockConnector"),
        ("INTERSECTION", "9", "NuPlanIntersection"),
    ],
)
def test_planners_tell_objects_by_the_names_of_their_classes(road, layer, object_id, name):
    found = road.get_map_object(object_id, SemanticMapLayer[layer])
    assert type(found).__name__ == name


def test_lines_stop_lines_and_areas_have_the_names_of_nuplan_too(road):
    lane = road.get_map_object("11", SemanticMapLayer.LANE)
    assert type(lane.baseline_path).__name__ == "NuPlanPolylineMapObject"
    kinds = {name: kind.__name__ for name, kind in _KINDS.values()}
    assert kinds["stop_polygons"] == "NuPlanStopLine"
    assert kinds["crosswalks"] == kinds["car_parks"] == "NuPlanPolygonMapObject"


def test_lanes_know_their_roadblock_and_neighbours(road):
    left, right = (road.get_map_object(name, SemanticMapLayer.LANE) for name in ("10", "11"))
    assert right.adjacent_edges == (left, None)
    assert left.adjacent_edges == (None, right)
    assert left.is_left_of(right)
    assert right.is_right_of(left)
    assert left.is_adjacent_to(right)
    assert right.is_adjacent_to(left)
    assert not right.is_adjacent_to(right)
    assert left.is_same_roadblock(right)
    assert right.parent.interior_edges == [left, right]
    assert right.get_roadblock_id() == right.parent.id == "1"
    assert _ids(right.parent.outgoing_edges) == ["2"]
    assert _ids(right.parent.outgoing_edges[0].outgoing_edges) == ["3"]
    assert right.parent.outgoing_edges[0].intersection.id == "9"
    assert right.parent.intersection is None
    assert right.speed_limit_mps == 15.0
    assert (left.index, right.index) == (0, 1)
    assert right.stop_lines == []
    assert not right.has_traffic_lights()


def test_a_missing_speed_limit_is_none():
    road = BridgeMap(straight_road(speed_limit=None))
    assert road.get_map_object("11", SemanticMapLayer.LANE).speed_limit_mps is None


def test_points_find_the_objects_that_hold_them(road):
    point = Point2D(210.0, 0.5)
    assert _ids(road.get_all_map_objects(point, SemanticMapLayer.LANE_CONNECTOR)) == ["21"]
    assert road.get_one_map_object(point, SemanticMapLayer.INTERSECTION).id == "9"
    assert road.get_one_map_object(point, SemanticMapLayer.LANE) is None
    assert road.is_in_layer(point, SemanticMapLayer.DRIVABLE_AREA)
    assert not road.is_in_layer(Point2D(210.0, 9.0), SemanticMapLayer.DRIVABLE_AREA)
    # nuPlan: the layer of connectors that this query reads holds lines
    assert not road.is_in_layer(point, SemanticMapLayer.LANE_CONNECTOR)
    assert road.get_map_object("21", SemanticMapLayer.LANE_CONNECTOR).contains_point(point)


def test_proximity_is_a_square_and_means_lines_for_connectors(road):
    layers = [SemanticMapLayer.LANE, SemanticMapLayer.LANE_CONNECTOR, SemanticMapLayer.ROADBLOCK]
    near = road.get_proximal_map_objects(StateSE2(190.0, -8.0, 1.0), 11.0, layers)
    assert _ids(near[SemanticMapLayer.LANE]) == ["10", "11"]
    assert _ids(near[SemanticMapLayer.LANE_CONNECTOR]) == ["21"]  # the line of 20 is at y = 3.5
    assert _ids(near[SemanticMapLayer.ROADBLOCK]) == ["1"]
    assert near[SemanticMapLayer.CROSSWALK] == []  # was not asked for
    with pytest.raises(AssertionError, match="DRIVABLE_AREA"):
        road.get_proximal_map_objects(Point2D(0.0, 0.0), 5.0, [SemanticMapLayer.DRIVABLE_AREA])


def test_distances_are_those_of_shapely(road, rng):
    points = [Point2D(*xy) for xy in rng.uniform((-50, -50), (450, 50), (60, 2))]
    source = road.source
    lanes = [source.edges.shape(i) for i in range(source.num_lanes)]
    lines = [shapely.LineString(source.baselines.at(i)) for i in range(len(source.edges))]
    for layer, shapes in (
        (SemanticMapLayer.LANE, lanes),
        (SemanticMapLayer.LANE_CONNECTOR, lines[4:]),
        (SemanticMapLayer.BASELINE_PATHS, lines),
    ):
        wanted = [
            min(shape.distance(shapely.Point(point.x, point.y)) for shape in shapes)
            for point in points
        ]
        found = road.get_distances_matrix_to_nearest_map_object(points, layer)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9)
    assert road.get_distance_to_nearest_map_object(points[0], SemanticMapLayer.CROSSWALK) == (
        None,
        None,
    )


def _bent():
    """A connector that turns left by an arc of 20 m, with lights and two stop lines."""
    angle = np.linspace(0.0, np.pi / 2, 200)
    arc = np.c_[20.0 * np.sin(angle), 20.0 - 20.0 * np.cos(angle)]
    area = shapely.LineString(arc).buffer(2.0)
    connector = EdgeSpec(
        "7",
        True,
        area,
        arc,
        "5",
        has_traffic_lights=True,
        stop_lines=["30", "31"],
        turn_type=1,
    )
    return build_map(
        "bend",
        edges=[connector],
        blocks=[BlockSpec("5", True, area)],
        stop_polygons=[
            AreaSpec("30", shapely.box(0, -2, 1, 2), 2),
            AreaSpec("31", shapely.box(5, -2, 6, 3), 3),
        ],
    )


def test_a_baseline_has_poses_arc_lengths_and_curvature():
    road = BridgeMap(_bent())
    line = road.get_map_object("7", SemanticMapLayer.LANE_CONNECTOR).baseline_path
    path = line.discrete_path
    assert len(path) == 200
    assert path[-1].heading == path[-2].heading == pytest.approx(np.pi / 2, abs=0.01)
    assert line.length == pytest.approx(10.0 * np.pi, abs=1e-3)
    middle = Point2D(20.0 * np.sin(0.5), 20.0 - 20.0 * np.cos(0.5))
    assert line.get_nearest_arc_length_from_position(middle) == pytest.approx(10.0, abs=1e-3)
    pose = line.get_nearest_pose_from_position(middle)
    assert pose.heading == pytest.approx(0.5 + 0.25 / 20.0, abs=1e-3)
    assert line.get_nearest_curvature_from_position(middle) == pytest.approx(0.05, abs=1e-4)
    assert line.get_curvature_at_arc_length(0.0) == pytest.approx(0.05, abs=1e-4)
    # at the end the heading is that of the last half metre
    end = line.get_nearest_pose_from_position(Point2D(25.0, 30.0))
    assert (end.x, end.y) == pytest.approx((20.0, 20.0))
    assert end.heading == pytest.approx(np.pi / 2 - 0.25 / 20.0, abs=1e-3)


def test_a_connector_knows_its_turn_lights_and_stop_lines():
    road = BridgeMap(_bent())
    connector = road.get_map_object("7", SemanticMapLayer.LANE_CONNECTOR)
    assert connector.turn_type == LaneConnectorType.LEFT
    assert connector.has_traffic_lights()
    assert _ids(connector.stop_lines) == ["30", "31"]
    assert connector.stop_lines[0].stop_line_type == StopLineType.TRAFFIC_LIGHT
    assert road.is_in_layer(Point2D(5.5, 0.0), SemanticMapLayer.TURN_STOP)
    assert not road.is_in_layer(Point2D(0.5, 0.0), SemanticMapLayer.TURN_STOP)
    assert road.is_in_layer(Point2D(0.5, 0.0), SemanticMapLayer.STOP_LINE)


def test_what_a_map_lacks_is_said(road):
    connector = BridgeMap(_bent()).get_map_object("7", SemanticMapLayer.LANE_CONNECTOR)
    with pytest.raises(MapError, match="'7' has no left boundary"):
        _ = connector.left_boundary
    lane = road.get_map_object("11", SemanticMapLayer.LANE)
    assert lane.left_boundary.length == 200.0
    with pytest.raises(NotImplementedError, match=r"NuPlanLane\.parallel_edges"):
        _ = lane.parallel_edges
    with pytest.raises(NotImplementedError, match="raster"):
        road.get_raster_map([SemanticMapLayer.DRIVABLE_AREA])


def test_progress_along_a_baseline_is_that_of_the_simulator(rng):
    lane = BridgeMap(_bent()).object("edges", 0)
    for x, y in rng.uniform(-5.0, 25.0, (50, 2)):
        found = lane.baseline_path.get_nearest_arc_length_from_position(Point2D(x, y))
        assert found == pytest.approx(lane._map.source.progress_on(0, x, y), abs=1e-9)


def test_a_line_without_curvature_is_straight(road):
    lane = road.get_map_object("11", SemanticMapLayer.LANE)
    assert lane.baseline_path.get_curvature_at_arc_length(50.0) == 0.0
    assert make_polylines([lane.baseline_path._xy]).length(0) == lane.baseline_path.length
