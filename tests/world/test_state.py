"""Tracks and scenarios that are made of plain arrays."""

import numpy as np
from worlds import straight_road

from shiftsim.world.scenario import scenario_of_rows
from shiftsim.world.state import NUM_STATE, AgentKind, Tracks, tracks_of_boxes

KINDS = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN)


def test_boxes_without_a_place_are_absent_tracks():
    boxes = np.arange(28.0).reshape(2, 2, 7)
    boxes[1, 0] = np.nan
    tracks = tracks_of_boxes(boxes, KINDS, ["a", "b"])
    assert tracks.valid.tolist() == [[True, True], [False, True]]
    assert tracks.poses[0].tolist() == [[0.0, 1.0, 2.0], [7.0, 8.0, 9.0]]
    assert tracks.velocities[0].tolist() == [[3.0, 4.0], [10.0, 11.0]]
    assert tracks.sizes[1, 1].tolist() == [26.0, 27.0]
    assert np.isnan(tracks.sizes[1, 0]).all()
    assert (tracks.kinds.tolist(), tracks.tokens) == ([0, 1], ("a", "b"))
    assert all(array.flags.c_contiguous for array in (tracks.poses, tracks.sizes))


def test_every_row_is_an_iteration_of_a_scenario_of_rows():
    ego = np.zeros((4, NUM_STATE))
    time_us = np.array([0, 100_000, 200_000, 300_000])
    scenario = scenario_of_rows("a", straight_road(), time_us, ego, Tracks.empty(4))
    assert scenario.iteration_times.tolist() == time_us.tolist()
    assert (scenario.row_step, scenario.route, scenario.mission_goal) == (1, (), None)
    assert [scenario.traffic_lights.listed(row) for row in range(4)] == [[]] * 4
