"""Lane pieces that are worked out by hand, and the maps made of them."""

import numpy as np
import pytest
from map_checks import check_map

from shiftsim.data.maps.build import build_lane_map
from shiftsim.data.maps.segments import LanePiece, MapSource
from shiftsim.errors import MapError

WIDTH = 3.5


def piece(name, start, end, *successors, **settings):
    """A straight piece of 3.5 m between two points of its centre line."""
    center = np.array([start, end], np.float64)
    along = (center[1] - center[0]) / np.hypot(*(center[1] - center[0]))
    left = center + 0.5 * WIDTH * np.array([-along[1], along[0]])
    return LanePiece(name, left, 2 * center - left, successors=successors, **settings)


def build(*pieces, **areas):
    found = build_lane_map(MapSource("x", pieces, **areas))
    checks, _ = check_map(found.road, set())
    assert [name for name, passed in checks.items() if not passed] == []
    return found


def pieces_of(found):
    return {piece_ids(found, i): i for i in found.road.edges.ids}


def piece_ids(found, edge):
    return tuple(part.piece.id for part in found.segments[edge])


def test_lanes_beside_each_other_are_a_roadblock_from_the_left():
    found = build(
        piece("a", (0, 0), (50, 0), left_neighbor="b"),
        piece("b", (0, WIDTH), (50, WIDTH), left_neighbor="c", right_neighbor="a"),
        piece("c", (50, 2 * WIDTH), (0, 2 * WIDTH), left_neighbor="b", right_neighbor=None),
    )
    road = found.road
    ids = pieces_of(found)
    a, b, c = (road.edge(ids[(name,)]) for name in "abc")
    assert (road.num_roadblocks, len(road.edges)) == (2, 3)
    assert road.block_of[a] == road.block_of[b] != road.block_of[c]  # c is oncoming
    assert (road.lane_index[b], road.lane_index[a]) == (0, 1)
    assert (road.left_lane[a], road.right_lane[b], road.left_lane[b]) == (b, a, -1)
    np.testing.assert_allclose(road.baselines.at(a)[[0, -1]], [[0, 0], [50, 0]], atol=1e-9)


def test_pieces_that_follow_one_to_one_are_one_lane():
    found = build(piece("a", (0, 0), (20, 0), "b"), piece("b", (20, 0), (50, 0)))
    assert found.road.num_lanes == len(found.road.edges) == 1
    assert piece_ids(found, found.road.edges.ids[0]) == ("a", "b")
    assert found.road.baselines.length(0) == pytest.approx(50)


def test_a_neighbour_that_only_one_of_two_names_is_none():
    found = build(
        piece("a", (0, 0), (50, 0), left_neighbor="b"), piece("b", (0, WIDTH), (50, WIDTH))
    )
    assert found.road.num_roadblocks == 2


def test_neighbours_in_a_circle_are_cut_and_counted():
    around = {"left_neighbor": "b", "right_neighbor": "b"}
    found = build(
        piece("a", (0, 0), (50, 0), **around),
        piece("b", (0, WIDTH), (50, WIDTH), left_neighbor="a", right_neighbor="a"),
    )
    assert found.warnings == {"lanes that are beside each other in a circle, cut": 1}
    assert (found.road.num_roadblocks, found.road.num_lanes) == (1, 2)


def test_a_flagged_piece_joins_two_lanes_and_unknown_successors_are_counted():
    found = build(
        piece("a", (0, 0), (40, 0), "x", "nowhere"),
        piece("x", (40, 0), (60, 0), "b", is_connector=True, speed_limit=8.0, light="red one"),
        piece("b", (60, 0), (90, 0)),
    )
    road = found.road
    assert (road.num_lanes, len(road.edges), len(road.blocks), len(road.intersections)) == (
        (2, 3, 3, 1)
    )  # fmt: skip
    assert (road.speed_limits[2], road.has_traffic_lights[2]) == (8.0, True)
    assert np.isnan(road.speed_limits[:2]).all()
    assert found.lights == {road.edges.ids[2]: "red one"}
    assert road.intersection_kinds.tolist() == [1]
    assert found.warnings == {"successor that is not in the map, left out": 1}


def test_the_light_of_a_lane_governs_the_connectors_that_leave_it():
    found = build(
        piece("a", (0, 0), (40, 0), "x", light="l"),
        piece("x", (40, 0), (60, 0), "b", is_connector=True),
        piece("b", (60, 0), (90, 0)),
    )
    assert list(found.lights.values()) == ["l"]


def test_a_connector_at_the_rim_begins_and_ends_with_a_lane_of_a_metre():
    found = build(piece("x", (0, 0), (20, 0), is_connector=True))
    road = found.road
    lengths = [road.baselines.length(edge) for edge in range(3)]
    np.testing.assert_allclose(lengths, [1.0, 1.0, 18.0], atol=1e-9)
    assert road.incoming.at(2).tolist() == [0]
    assert road.outgoing.at(2).tolist() == [1]


def test_a_fork_that_is_not_flagged_becomes_connectors():
    found = build(
        piece("a", (0, 0), (40, 0), "l", "r"),
        piece("l", (40, 0), (60, 6), "b"),
        piece("r", (40, 0), (60, -6), "c"),
        piece("b", (60, 6), (90, 15)),
        piece("c", (60, -6), (90, -15)),
    )
    road = found.road
    assert (road.num_lanes, len(road.edges)) == (3, 5)
    assert road.num_roadblocks == 3
    assert len(road.intersections) == 1
    assert road.intersection_kinds.tolist() == [0]


def test_lanes_that_cannot_be_merged_are_joined_by_a_short_connector():
    found = build(
        piece("a", (0, 0), (40, 0), "c"),
        piece("c", (40, 0), (80, 0), right_neighbor="d"),
        piece("d", (40, -WIDTH), (80, -WIDTH), left_neighbor="c"),
    )
    road = found.road
    assert (road.num_lanes, len(road.edges)) == (3, 4)
    assert road.baselines.length(3) == pytest.approx(3.0)  # nuPlan rule 504
    assert road.intersection_kinds.tolist() == [5]


def test_a_link_over_a_gap_is_left_out():
    found = build(piece("a", (0, 0), (40, 0), "b"), piece("b", (45, 0), (80, 0)))
    assert found.warnings == {"lane link over a gap of more than 2 m, left out": 1}


def test_without_drivable_areas_what_the_lanes_cover_is_drivable():
    found = build(piece("a", (0, 0), (40, 0), "b"), piece("b", (40.2, 0), (80, 0)))
    areas = found.road.drivable_areas
    assert sum(areas.shape(i).area for i in range(len(areas))) >= 80 * WIDTH - 1


def test_a_map_without_lanes_is_refused():
    with pytest.raises(MapError, match="map 'x' has no lane") as error:
        build_lane_map(MapSource("x", []))
    assert error.value.hint


def test_paved_areas_wider_than_a_map_are_refused_before_they_are_tiled(monkeypatch):
    monkeypatch.setattr(
        "shiftsim.data.maps.build.drivable_tiles", lambda areas: pytest.fail("tiled")
    )
    lane, wide = piece("a", (0, 0), (9, 0)), piece("b", (0, 0), (1e6, 0)).polygon
    with pytest.raises(MapError, match="'extent': 1000000 is beyond"):
        build_lane_map(MapSource("x", [lane], paved=[wide]))


def test_two_lanes_of_one_id_are_refused():
    with pytest.raises(MapError, match="lane 'a': its id occurs twice"):
        build_lane_map(MapSource("x", [piece("a", (0, 0), (9, 0)), piece("a", (9, 0), (20, 0))]))
