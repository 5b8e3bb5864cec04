"""The map: topology by index, flaws counted, wrong input refused."""

import dataclasses
import pickle

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from strategies import seeds
from worlds import straight_road

from shiftsim.errors import ConfigError, MapError
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import NONE


def lane(name, block="1", **changes):
    spec = EdgeSpec(
        id=name,
        is_connector=False,
        polygon=shapely.box(0, 0, 10, 3),
        baseline=np.array([[0, 1.5], [10, 1.5]]),
        block_id=block,
    )
    return dataclasses.replace(spec, **changes)


BLOCK = BlockSpec(id="1", is_connector=False, polygon=shapely.box(0, 0, 10, 3))


def test_lanes_come_before_connectors_and_links_are_indices():
    road = straight_road()
    assert road.edges.ids == ("10", "11", "30", "31", "20", "21")
    assert road.num_lanes == 4
    connector = road.edge("21")
    assert road.is_connector(connector)
    assert [road.edges.ids[i] for i in road.outgoing.at(road.edge("11"))] == ["21"]
    assert [road.edges.ids[i] for i in road.incoming.at(connector)] == ["11"]
    assert road.left_lane[road.edge("11")] == road.edge("10")
    assert road.right_lane[road.edge("11")] == NONE


def test_blocks_list_their_edges_in_order():
    road = straight_road()
    block = road.blocks.index["2"]
    assert [road.edges.ids[i] for i in road.block_edges.at(block)] == ["20", "21"]
    assert road.blocks.ids[road.block_of[road.edge("30")]] == "3"


def test_lanes_are_found_by_point_at_utm_coordinates():
    road = straight_road(offset=(664_430.0, 3_998_750.0))
    assert road.lanes_at(664_440.0, 3_998_750.0) == [road.edge("11")]
    assert road.connectors_at(664_640.0, 3_998_753.0) == [road.edge("20")]
    assert road.lanes_at(664_440.0, 3_998_751.75) == []  # on the border: in neither


def test_progress_is_the_arc_length_of_the_projection():
    road = straight_road()
    assert road.progress_on(road.edge("11"), 12.25, 1.0) == pytest.approx(12.25, abs=1e-12)


def test_a_missing_speed_limit_is_not_a_number():
    road = build_map("m", edges=[lane("5"), lane("6", speed_limit=10.0)], blocks=[BLOCK])
    assert np.isnan(road.speed_limits[0])
    assert road.speed_limits[1] == 10.0


def test_unknown_references_are_left_out_and_counted():
    edges = [lane("5", outgoing=["77", "78"], block="99", stop_lines=["3"])]
    road = build_map("m", edges=edges, blocks=[BLOCK])
    assert len(road.outgoing.at(0)) == 0
    assert road.block_of[0] == NONE
    assert road.flaws == {
        "edge names an unknown roadblock": 1,
        "edge names an unknown edge": 2,
        "edge names an unknown stop line": 1,
    }


def test_an_id_that_occurs_twice_is_refused():
    with pytest.raises(MapError, match="'5'"):
        build_map("m", edges=[lane("5"), lane("5")], blocks=[BLOCK])


def test_a_baseline_of_one_vertex_is_refused():
    with pytest.raises(MapError, match="baseline of '5'"):
        build_map("m", edges=[lane("5", baseline=np.zeros((1, 2)))], blocks=[BLOCK])


def test_an_unknown_edge_is_named():
    with pytest.raises(MapError, match="'4711'"):
        straight_road().edge("4711")


def scattered(seed: int, count: int) -> list[AreaSpec]:
    """Triangles and squares of a few metres, some of them overlapping."""
    rng = np.random.default_rng(seed)
    out = []
    for number in range(count):
        x, y = rng.uniform(-60, 60, 2)
        angles = np.sort(rng.uniform(0, 2 * np.pi, 3)) + np.array([0.0, 0.5, 1.0])
        radius = rng.uniform(0.5, 15.0)
        corners = np.c_[x + radius * np.cos(angles), y + radius * np.sin(angles)]
        area = shapely.box(x, y, x + 4, y + 2) if rng.random() < 0.4 else shapely.Polygon(corners)
        out.append(AreaSpec(str(number), area.convex_hull))
    return out


@given(seed=seeds, count=st.integers(1, 40), x=st.floats(-90, 90), y=st.floats(-90, 90))
def test_the_nearest_object_is_that_of_a_search_of_all(seed, count, x, y):
    areas = scattered(seed, count)
    road = build_map("m", edges=[lane("5")], blocks=[BLOCK], crosswalks=areas)

    distances = [area.polygon.distance(shapely.Point(x, y)) for area in areas]

    found = road.nearest(x, y, layer="crosswalks")
    assert distances[found] == pytest.approx(min(distances), abs=1e-9)
    if min(distances) == 0.0:
        assert found == distances.index(0.0)


@given(seed=seeds, count=st.integers(0, 40), x=st.floats(-90, 90), y=st.floats(-90, 90))
def test_objects_within_an_area_are_those_of_a_search_of_all(seed, count, x, y):
    areas = scattered(seed, count)
    road = build_map("m", edges=[lane("5")], blocks=[BLOCK], walkways=areas)
    bounds = (x - 20.0, y - 5.0, x + 20.0, y + 5.0)
    tilted = shapely.Polygon([(x - 20, y), (x, y - 9), (x + 25, y + 3)])

    for area, shape in ((bounds, shapely.box(*bounds)), (tilted, tilted)):
        expected = [i for i, other in enumerate(areas) if other.polygon.intersects(shape)]
        assert road.within(area, layer="walkways").tolist() == expected


def test_lanes_are_what_is_searched_unless_a_layer_is_named():
    road = straight_road(offset=(664_430.0, 3_998_750.0))
    assert road.nearest(664_440.0, 3_998_740.0) == road.edge("11")
    assert road.edge("20") in road.within((664_630.0, 3_998_752.0, 664_650.0, 3_998_754.0))
    with pytest.raises(ConfigError, match="map layer 'crosswalk' unknown"):
        road.nearest(0.0, 0.0, layer="crosswalk")
    with pytest.raises(MapError, match="no polygons"):
        road.nearest(0.0, 0.0, layer="walkways")


def test_a_map_that_was_searched_can_be_sent_to_another_process():
    road = straight_road()
    found = road.nearest(5.0, 0.0)

    again = pickle.loads(pickle.dumps(road))

    assert again.nearest(5.0, 0.0) == found
