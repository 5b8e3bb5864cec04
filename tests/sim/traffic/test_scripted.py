"""Pedestrians of edited scenarios: when they set off, and where they are then."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.errors import TrafficError
from shiftsim.sim.traffic import LogReplay
from shiftsim.sim.traffic.mixed import Scripted, share_walked
from shiftsim.world.events import CROSSING_SIZE, Crossing, RolloutEvents, ScriptedPedestrian
from shiftsim.world.state import AgentKind, center_poses

NUM_ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`


@pytest.mark.parametrize(
    ("iteration", "active", "count", "share"),
    [
        (10, 10, 150, 0.0),
        (9, 10, 150, 0.0),
        (40, 10, 400, 30 / 160),
        (40, 10, 100, 30 / 100),
        (170, 10, 400, 1.0),
        (300, 10, 400, 1.0),
        (169, 10, 400, 159 / 160),
    ],
)
def test_the_later_one_sets_off_the_slower_it_walks(iteration, active, count, share):
    assert share_walked(iteration, active, count) == pytest.approx(share, abs=1e-12)


def walked(speed=8.0, start=10.0, **events):
    """Tracks of a rollout in which the ego drives from x = `start` on along y = 0."""
    tracks = standing_tracks(NUM_ROWS, np.zeros((1, 3)), [AgentKind.PEDESTRIAN])
    tracks.valid[:] = False
    script = RolloutEvents("base", "edit", "digest", (), (), np.zeros(1, np.int64), **events)
    scenario = replace(
        cruise_scenario(speed=speed, tracks=tracks, start=(start, 0.0, 0.0)), script=script
    )
    rolled, traffic = scenario.tracks.rows(scenario.iteration_rows), Scripted(LogReplay())
    traffic.start(scenario, rolled, 0)
    for iteration in range(scenario.num_iterations - 1):
        traffic.step(iteration, scenario.expert[iteration], rolled, iteration + 1)
    return rolled, center_poses(scenario.expert[:, :3])


def crossing_at(x, iteration=0):
    return Crossing("p", np.array([x, -3.0, 0.5]), np.array([x, 5.0]), iteration, 0)


@pytest.mark.parametrize("x", [90.0, 130.0])
def test_a_pedestrian_sets_off_where_the_ego_is_within_fifty_metres_along_its_lane(x):
    rolled, centers = walked(crossings=(crossing_at(x),))
    first = 1 + int(np.flatnonzero(x - centers[:, 0] <= 50.0)[0])  # it is seen one step later
    assert np.flatnonzero(rolled.valid[:, 0]).tolist() == list(range(first, 151))
    share = (np.arange(first, 151) - first) / min(first + 150, 151)
    expected = np.column_stack([np.full(len(share), x), -3.0 + 8.0 * share, 0.5 + 0.0 * share])
    np.testing.assert_allclose(rolled.poses[first:, 0], expected, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(rolled.velocities[first:], 0.0)
    np.testing.assert_array_equal(rolled.sizes[first:, 0], np.tile(CROSSING_SIZE, (151 - first, 1)))


@pytest.mark.parametrize(("beyond", "comes"), [(20.0, True), (51.0, False), (48.5, True)])
def test_how_far_a_pedestrian_is_beyond_the_end_of_the_lane_counts(beyond, comes):
    """The ego stands 1 m before the end of its lane of 200 m."""
    rolled, _ = walked(speed=0.0, start=199.0 - 1.461, crossings=(crossing_at(200.0 + beyond),))
    distance = 1.0 + np.hypot(beyond, 3.0)
    assert bool(rolled.valid[:, 0].any()) == comes == (distance <= 50.0 + 1e-9)


def test_a_pedestrian_sets_off_at_its_iteration_wherever_the_ego_is():
    rolled, _ = walked(speed=0.0, crossings=(crossing_at(190.0, iteration=20),))
    # it is there before it walks
    share = np.maximum(np.arange(1, 151) - 20, 0) / 151
    np.testing.assert_allclose(rolled.poses[1:, 0, 1], -3.0 + 8.0 * share, rtol=0.0, atol=1e-9)


def test_off_the_lanes_no_pedestrian_can_look_for_the_ego():
    with pytest.raises(TrafficError, match="on no lane at iteration 0"):
        walked(start=-50.0, crossings=(crossing_at(90.0),))


@pytest.mark.parametrize("visible", [True, False])
def test_a_scripted_pedestrian_waits_for_the_ego_and_walks_once(visible):
    start = np.array([60.0, -4.0, np.pi / 2])
    pedestrian = ScriptedPedestrian(
        track=0,
        start=start,
        end=np.array([60.0, 4.0]),
        size=np.array([0.7, 0.6]),
        speed=1.6,
        ego_within=20.0,
        visible=visible,
    )
    rolled, centers = walked(pedestrians=(pedestrian,))
    near = np.hypot(*(centers[:, :2] - start[:2]).T) <= 20.0
    first = int(np.flatnonzero(near)[0])
    gone = np.clip(0.1 * (np.arange(1, 151) - first) * 1.6, 0.0, 8.0)
    there = rolled.valid[1:, 0]
    assert there.tolist() == [visible or row > first for row in range(1, 151)]
    np.testing.assert_allclose(rolled.poses[1:, 0, 1][there], (gone - 4.0)[there], atol=1e-9)
    speeds = np.where((np.arange(1, 151) > first) & (gone < 8.0), 1.6, 0.0)
    np.testing.assert_allclose(rolled.velocities[1:, 0, 1][there], speeds[there], atol=1e-9)
    np.testing.assert_array_equal(rolled.sizes[1:, 0][there], np.tile([0.7, 0.6], (sum(there), 1)))
