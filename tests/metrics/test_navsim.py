"""PDMS and EPDMS in small worlds made by hand; tests/parity compares them with NAVSIM's."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from worlds import cruise_scenario, standing_tracks

from shiftsim.errors import ConfigError, DataError
from shiftsim.metrics import navsim
from shiftsim.metrics.navsim import frame_world, recorded_surroundings, sample_plans, score
from shiftsim.world.state import AgentKind, LightStatus, Tracks, TrafficLights

TIMES = 0.5 * np.arange(1, 9)  # s
ROWS = 60 + 2 * 150 + 1 + 160


def ahead(*speeds: float) -> np.ndarray:
    """(P, 8, 3) plans straight ahead at steady speeds."""
    plans = np.zeros((len(speeds), 8, 3))
    plans[..., 0] = np.outer(speeds, TIMES)
    return plans


def test_the_total_is_multipliers_times_a_weighted_mean():
    """8 m/s for 4 s are 32 m; PDM-Closed speeds up to the limit of 15 m/s."""
    world = frame_world(cruise_scenario(), 20)
    scores = score(world, ahead(8.0))
    assert scores.progress_m.tolist() == pytest.approx([32.0], abs=1e-6)
    progress = 32.0 / world.reference.progress_m[0]
    assert 0.5 < progress < 1.0
    assert scores.ego_progress.tolist() == pytest.approx([progress])
    assert scores.score.tolist() == pytest.approx([(5.0 * progress + 5.0 + 2.0 + 2.0) / 14.0])
    first = score(frame_world(cruise_scenario(), 20, "v1"), ahead(8.0))
    assert first.score.tolist() == pytest.approx([(5.0 * progress + 5.0 + 2.0) / 12.0])
    assert (first.lane_keeping, scores.comfort) == (None, None)


def test_what_the_driver_failed_too_does_not_count():
    """The recorded ego leaves the road with its right side, on which y = -1.75 m is the edge."""
    world = frame_world(cruise_scenario(start=(10.0, -1.0, 0.0)), 20)
    assert world.human.drivable_area_compliance.tolist() == [0.0]
    raw, full = (score(world, ahead(8.0), human_filter=flag) for flag in (False, True))
    assert (raw.drivable_area_compliance.tolist(), raw.score.tolist()) == ([0.0], [0.0])
    assert (full.drivable_area_compliance.tolist(), full.lane_keeping.tolist()) == ([1.0], [1.0])
    # PDM-Closed is off the road as well, so progress is not compared with anything
    assert full.score.tolist() == [1.0]


def test_a_red_connector_may_not_be_touched():
    """The connectors begin at 200 m; the front of the ego is at 166 m + 4.049 m in the frame."""
    scenario = cruise_scenario(start=(150.0, 0.0, 0.0))
    lights = TrafficLights(("21",), np.full((ROWS, 1), LightStatus.RED, np.int8))
    world = frame_world(replace(scenario, traffic_lights=lights), 20)
    # 29.951 m to go: 8 m/s for 4 s are 32 m
    scores = score(world, ahead(6.0, 8.0), human_filter=False)
    assert scores.traffic_light_compliance.tolist() == [1.0, 0.0]
    green = score(frame_world(scenario, 20), ahead(6.0, 8.0), human_filter=False)
    assert green.traffic_light_compliance.tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("aside", "kept"), [(0.45, 1.0), (0.55, 0.0)])
def test_half_a_metre_beside_the_centerline_is_not_its_lane(aside, kept):
    world = frame_world(cruise_scenario(start=(10.0, aside, 0.0)), 20)
    scores = score(world, ahead(8.0), human_filter=False)
    assert scores.lane_keeping.tolist() == [kept]


def test_twenty_steps_in_a_row_leave_the_lane():
    line = shapely.LineString([(0.0, 0.0), (100.0, 0.0)])

    def leaves(*steps: int) -> bool:
        y = np.where(np.isin(np.arange(41), steps), 0.6, 0.5)
        return navsim._leaves_line(shapely.points(np.arange(41.0), y), line)

    assert not leaves(*range(10, 29))
    assert leaves(*range(10, 30))
    assert not leaves(*range(5, 20), *range(21, 40))
    assert leaves(*range(21, 41))


def test_the_way_off_the_route_is_summed_over_a_second():
    centers = np.zeros((1, 41, 2))
    centers[0, :, 0] = 0.25 * np.arange(41)

    def most(wrong_way) -> float:
        return float(navsim.way_off_route(centers, wrong_way).max())

    for steps, way in ((range(1, 8), 1.75), (range(1, 9), 2.0), (range(1, 41), 2.75)):
        assert most(np.isin(np.arange(41), steps)[None]) == way
    # two metres, but never more than 1.75 m within 11 states
    assert most(np.isin(np.arange(41), [*range(1, 8), 12])[None]) == 1.75
    # in the first second as far as it has gone
    assert navsim.way_off_route(centers[:, :5], np.ones((1, 5), np.bool_)).max() == 1.0


def test_boxes_are_interpolated_between_the_frames_that_have_them():
    """One is missing in frame 1 and from frame 3 on, one is there in frame 3 alone."""
    tracks = standing_tracks(9, np.zeros((2, 3)), [AgentKind.VEHICLE, AgentKind.BARRIER])
    tracks.valid[:] = False
    tracks.valid[[0, 2], 0] = tracks.valid[3, 1] = True
    tracks.poses[2, 0] = 10.0, 0.0, -np.pi / 2.0
    tracks.velocities[0, 0] = 3.0, 4.0
    around = recorded_surroundings(tracks, 41)
    centers = around.others.centers
    way = np.column_stack([np.arange(11.0), np.zeros(11)])
    np.testing.assert_allclose(centers[:11, 0], way, rtol=0, atol=1e-12)
    assert np.isinf(centers[11:, 0]).all()
    assert (centers[:, 1] == 0.0).all()
    assert around.others.speeds[:, 0].tolist() == [5.0] * 41
    assert around.others.speeds[0, 1] == 0.0
    # the box is turned by 45 degrees in the middle
    front = around.others.boxes[5, 0, [0, 3]].mean(axis=0)
    np.testing.assert_allclose(front, [5.0 + 2.25 / 2**0.5, -2.25 / 2**0.5], atol=1e-12)
    middle = around.others.boxes[:11, 0].mean(axis=1)
    np.testing.assert_allclose(around.others.centroids[:11, 0], middle, atol=1e-12)
    assert around.reaches[0] == np.inf
    assert around.reaches[1] == 0.0


def test_boxes_turn_the_short_way():
    """From 3 rad to -3 rad in 1 s it turns left; halfway the box points backwards."""
    tracks = standing_tracks(3, np.array([[0.0, 0.0, 3.0]]), [AgentKind.VEHICLE])
    tracks.valid[1] = False
    tracks.poses[2, 0, 2] = -3.0
    front = recorded_surroundings(tracks, 41).others.boxes[5, 0, [0, 3]].mean(axis=0)
    np.testing.assert_allclose(front, [-2.25, 0.0], rtol=0, atol=1e-12)


def parked(x: float, kind: AgentKind = AgentKind.VEHICLE) -> Tracks:
    return standing_tracks(ROWS, np.array([[x, 0.0, 0.0]]), [kind])


def test_collisions_and_short_times_to_them_are_found_where_boxes_are():
    """From 26 m on, 8 m/s; the front is 4.049 m ahead, the rear of the box at 57.75 m."""
    for kind, factor in ((AgentKind.VEHICLE, 0.0), (AgentKind.BARRIER, 0.5)):
        world = frame_world(cruise_scenario(tracks=parked(60.0, kind)), 20)
        scores = score(world, ahead(8.0, 4.0), human_filter=False)
        assert scores.no_at_fault_collisions.tolist() == [factor, 1.0]
        assert scores.time_to_collision_within_bound.tolist() == [0.0, 1.0]
        # 27.701 m at 8 m/s are 3.46 s, and 0.9 s before
        assert (scores.collision_index[0], scores.ttc_index[0]) == (35.0, 26.0)


def test_traffic_that_crosses_is_hit_when_it_is_there():
    """At 10 m/s from 30 m to the right, its side 22.951 m ahead of the front of the ego.

    At 8 m/s the ego is there after 2.87 s; at 2.9 s the box is 1 m to the right, 4.5 m long.
    """
    tracks = parked(26.0 + 4.049 + 22.951 + 1.0)
    tracks.poses[:, 0, 1] = 0.5 * (np.arange(ROWS) - 100.0) - 30.0
    tracks.poses[:, 0, 2] = np.pi / 2.0
    tracks.velocities[:, 0, 1] = 10.0
    scores = score(frame_world(cruise_scenario(tracks=tracks), 20), ahead(8.0, 5.0))
    assert scores.collision_index.tolist() == [29.0, np.inf]


def test_the_second_version_leaves_out_what_touches_the_ego_at_first():
    scenario = cruise_scenario(tracks=parked(31.0))
    first, second = (
        score(frame_world(scenario, 20, version), ahead(8.0), human_filter=False)
        for version in ("v1", "v2")
    )
    assert first.no_at_fault_collisions.tolist() == [0.0]
    assert second.no_at_fault_collisions.tolist() == [1.0]


def test_the_second_version_looks_at_projections_within_four_seconds():
    """32 m + 4.049 m from 26 m on are 62.05 m; 0.9 s later it is 69.25 m."""
    scenario = cruise_scenario(tracks=parked(68.0 + 2.25))
    first, second = (
        score(frame_world(scenario, 20, version), ahead(8.0), human_filter=False)
        for version in ("v1", "v2")
    )
    assert np.isfinite(first.ttc_index).tolist() == [True]
    assert second.ttc_index.tolist() == [np.inf]


def test_plans_of_two_frames_may_not_differ_much():
    scenario = cruise_scenario()
    before, now = (frame_world(scenario, iteration) for iteration in (15, 20))
    previous = score(before, ahead(8.0, 8.0))
    assert previous.two_frame_extended_comfort is None
    scores = score(now, ahead(8.0, 3.0), previous=previous)
    assert scores.two_frame_extended_comfort.tolist() == [1.0, 0.0]
    alone = score(now, ahead(8.0, 3.0))
    gain = scores.score - alone.score
    assert gain[0] == pytest.approx((alone.score[0] * 14.0 + 2.0) / 16.0 - alone.score[0])
    for plans, world in ((ahead(8.0), now), (ahead(8.0, 8.0), before)):
        with pytest.raises(ValueError, match="extended comfort compares"):
            score(world, plans, previous=previous)


def test_what_is_no_plan_is_refused():
    world = frame_world(cruise_scenario(), 20)
    for plans in (np.zeros((8, 3)), np.zeros((1, 0, 3)), np.full((1, 8, 3), np.nan)):
        with pytest.raises(ValueError, match="plans must be finite"):
            score(world, plans)


@pytest.mark.parametrize(("version", "future"), [("v1", 100), ("v2", 80)])
def test_a_frame_needs_recording_around_it(version, future):
    """Rows are 0.05 s apart: 30 before it, and as many after it as the version reads."""
    enough = cruise_scenario(iterations=2, history_rows=30, future_rows=future)
    frame_world(enough, 0, version)
    frame_world(enough, 1, version)
    short = cruise_scenario(iterations=2, history_rows=29, future_rows=future - 1)
    for iteration in (0, 1):
        with pytest.raises(DataError, match="too little recording"):
            frame_world(short, iteration, version)
    with pytest.raises(ConfigError, match="version 'v3' unknown"):
        frame_world(enough, 0, "v3")


def test_comfort_looks_back_to_before_the_frame():
    """The ego is at 26 m; it drove 8 m/s, and is shown from 1.5 s to 0.2 s before."""
    past = frame_world(cruise_scenario(), 20).past
    np.testing.assert_allclose(past[:, 0], 26.0 - 0.8 * np.arange(15, 1, -1), rtol=0, atol=1e-9)


def test_plans_are_straight_between_their_poses():
    """At 2 m/s for 0.5 s, at 6 m/s for 0.5 s, and held; times end a microsecond early."""
    poses = np.zeros((1, 3, 3))
    poses[0, :, 0] = 0.0, 1.0, 4.0
    found = sample_plans(poses, np.array([0, 500_000, 1_000_000]), 0)
    x = [*np.arange(0.0, 1.0, 0.2), *np.arange(1.0, 4.0, 0.6), *[4.0] * 31]
    np.testing.assert_allclose(found[0, :, 0], x, rtol=0, atol=1e-5)


def test_a_short_plan_is_held_at_its_end():
    world = frame_world(cruise_scenario(), 20)
    short, long = ahead(4.0)[:, :4], ahead(4.0)
    long[:, 4:] = long[:, 3:4]
    states = [score(world, plans).states for plans in (short, long)]
    np.testing.assert_allclose(states[0], states[1], rtol=0, atol=1e-9)
