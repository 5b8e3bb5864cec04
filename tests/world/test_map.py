"""The map: topology by index, flaws counted, wrong input refused."""

import dataclasses

import numpy as np
import pytest
import shapely
from worlds import straight_road

from shiftsim.errors import MapError
from shiftsim.world.map import NONE, BlockSpec, EdgeSpec, build_map


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
