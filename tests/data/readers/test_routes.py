"""Routes of recorded egos, on a road of three blocks: 200 m, a connector of 20 m, 200 m."""

from types import SimpleNamespace

import numpy as np
import pytest
from worlds import straight_road

from shiftsim.data.readers.routes import _path_between, find_route, starts_on_lane
from shiftsim.data.readers.windows import ConversionConfig
from shiftsim.world.layers import make_lists

ROAD, CONFIG = straight_road(), ConversionConfig()


def poses_at(*x, y=0.0):
    return np.array([[place, y, 0.0] for place in x])


@pytest.mark.parametrize(
    ("x", "num_driven"),
    [
        (np.arange(150.0, 290.0, 1.0), 3),
        (np.arange(150.0, 290.0, 90.0), 3),  # 150 m and 240 m: the connector between is found
        ([250.0, 251.0], 1),
        ([150.0, 150.0, 150.0], 1),
    ],
)
def test_a_route_has_every_block_once_in_order(x, num_driven):
    route = find_route(ROAD, poses_at(*x), CONFIG)
    first = 2 if x[0] > 220.0 else 0
    assert route.ids[:num_driven] == ("1", "2", "3")[first : first + num_driven]
    assert (route.num_driven, route.is_linked) == (num_driven, True)


def test_the_way_ahead_is_appended():
    route = find_route(ROAD, poses_at(150.0, 160.0), CONFIG)
    assert (route.ids, route.num_driven) == (("1", "2", "3"), 1)


def test_driving_against_the_lanes_leaves_a_route_that_is_not_linked():
    route = find_route(ROAD, poses_at(250.0, 150.0), CONFIG)
    assert (route.ids[:2], route.num_driven, route.is_linked) == (("3", "1"), 2, False)


def test_gaps_of_up_to_three_blocks_are_closed_on_the_shortest_way():
    road = SimpleNamespace(block_outgoing=make_lists([[6, 1], [2], [3], [4], [5], [], [0, 7], []]))
    assert _path_between(road, 0, 1) == []
    assert _path_between(road, 0, 3) == [1, 2]
    assert _path_between(road, 0, 4) == [1, 2, 3]
    assert _path_between(road, 0, 5) == []
    assert _path_between(road, 0, 7) == [6]


def test_off_the_road_there_is_no_route():
    assert find_route(ROAD, poses_at(150.0, 160.0, y=30.0), CONFIG) is None


@pytest.mark.parametrize(
    ("pose", "starts"),
    [
        ((100.0, 5.25 + 0.9 * CONFIG.max_lane_distance, 0.0), True),
        ((100.0, 5.25 + 1.1 * CONFIG.max_lane_distance, 0.0), False),
        ((-0.9 * CONFIG.max_lane_distance, 0.0, 0.0), True),
        ((-1.1 * CONFIG.max_lane_distance, 0.0, 0.0), False),
        ((420.0 + 0.9 * CONFIG.max_lane_distance, 0.0, 0.0), True),
        ((100.0, 0.0, 0.9 * CONFIG.max_lane_angle), True),
        ((100.0, 0.0, -1.1 * CONFIG.max_lane_angle), False),
    ],
)
def test_an_ego_starts_on_a_lane_that_is_near_and_leads_its_way(pose, starts):
    assert starts_on_lane(ROAD, np.array(pose), CONFIG) == starts
