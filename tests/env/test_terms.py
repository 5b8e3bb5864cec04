"""The terms of the rewards, against slow versions, and the rewards on whole episodes."""

from dataclasses import replace

import episodes
import numpy as np
import pytest
import shapely
from episodes import replay
from worlds import cruise_scenario, standing_tracks, straight_road

from shiftsim.env.driving import DrivingEnv
from shiftsim.env.episode import Episode, nuplan, regular, survival
from shiftsim.env.terms import Terms
from shiftsim.metrics.comfort import comfort_signals, within_bounds
from shiftsim.metrics.result import NUPLAN
from shiftsim.sim.log import Setting
from shiftsim.world.layers import make_layer
from shiftsim.world.state import AgentKind, Command, center_poses, speeds

ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`
GOOD = Terms(0.01, 1.0, 1.0, 1.0, 1.0, 1.0, False, False, 0.5)


def totals(scenario):
    """What the recording earns by reward, and its infractions."""
    total, account = episodes.totals(scenario)
    return total, account.off_road + account.collisions


def driven(commands, **options):
    """Terms of an episode driven by commands."""
    episode = Episode(cruise_scenario(**options), Setting(), np.zeros(2, np.float32))
    terms = []
    for acceleration, rate in commands:
        episode.advance(Command(acceleration, rate))
        terms.append(episode.terms)
    return episode, terms


def test_the_recording_earns_a_hundred():
    total, bad = totals(cruise_scenario(speed=8.0))
    assert bad == []
    np.testing.assert_allclose(total["regular"], 100.0 * 149 / 150, rtol=1e-9)
    # (5 x 149/150 + 149 x 11 / 150) / 16 of 100
    np.testing.assert_allclose(total["nuplan"], 100.0 * 149 / 150, rtol=1e-9)
    np.testing.assert_allclose(total["survival"], 100.0 * 149 / 150, rtol=1e-9)
    assert total["score"] > 0.99


def test_who_stands_earns_nothing():
    total, bad = totals(cruise_scenario(speed=0.0))
    assert (total["regular"], bad) == (0.0, [])
    env = DrivingEnv(
        store=type("One", (), {"tokens": ["x"], "read": lambda self, t: cruise_scenario()})()
    )
    env.reset()
    rewards = [env.step(np.array([-1.0, 0.0]))[1] for _ in range(100)]
    assert env.episode.log.ego[100, 3] < 0.05
    assert sum(rewards[60:]) < 1e-2


def test_who_goes_back_earns_no_way_twice():
    places = 10.0 + np.concatenate(
        [np.linspace(0, 40, 60), np.linspace(40, 20, 30), np.linspace(20, 60, 60)]
    )
    straight = cruise_scenario(speed=4.0)  # 60 m in all
    episode = Episode(straight, Setting(), np.zeros(2, np.float32))
    gained = []
    for row in range(149):
        episode.log.ego[row] = 0.0
        episode.log.ego[row, [0, 3]] = places[row + 1], 0.0  # so it stands there after the step
        episode.advance(Command(0.0, 0.0))
        gained.append(episode.terms.progress)
    assert set(gained[59:88]) == {0.0}
    np.testing.assert_allclose(sum(gained), 1.0, rtol=1e-9)


@pytest.mark.parametrize("offset", [-0.5, -0.3, 0.2, 0.5])
def test_a_small_offset_is_free(offset):
    scenario = cruise_scenario(start=(10.0, offset, 0.0))
    assert {episode.terms.lane for episode in replay(scenario)} == {1.0}


def test_the_lane_term_follows_its_formula():
    scenario = cruise_scenario(start=(10.0, 1.2, 0.0), iterations=11)
    expected = 1.0 - 0.5 * (1.2 - 0.5) / (1.2 + 0.55 - 0.5 + 1e-6)
    for episode in replay(scenario):
        np.testing.assert_allclose(episode.terms.lane, expected, rtol=1e-12)


def test_connectors_are_free_of_the_lane_term():
    scenario = cruise_scenario(start=(202.0, 1.2, 0.0), speed=1.0, iterations=11)
    assert {episode.terms.lane for episode in replay(scenario)} == {1.0}


def test_speed_above_the_limit_costs_in_proportion():
    road = straight_road(speed_limit=9.0)
    for speed, term in ((8.9, 1.0), (10.0, 1 - 1 / 2.23), (12.0, 0.0)):
        scenario = cruise_scenario(speed=speed, road=road, iterations=11)
        for episode in replay(scenario):
            np.testing.assert_allclose(episode.terms.speed, term, rtol=1e-12)
    free = cruise_scenario(speed=30.0, road=straight_road(speed_limit=None), iterations=11)
    assert {episode.terms.speed for episode in replay(free)} == {1.0}


def test_off_route_counts_only_while_the_recording_is_on_it():
    scenario = cruise_scenario(iterations=31)
    for route, expected in ((("1", "2", "3"), 0.0), (("9",), 1.0)):
        episode = Episode(replace(scenario, route=route), Setting(), np.zeros(2, np.float32))
        episode.log.ego[0, 1] = 30.0  # in the fields
        episode.advance(Command(0.0, 0.0))
        assert episode.terms.on_route == expected
        assert episode.terms.off_road


def test_corners_off_the_road_are_those_that_shapely_finds():
    road = straight_road()
    allowed = shapely.union_all(
        [road.blocks.shape(0), road.blocks.shape(1), road.intersections.shape(0)]
    )
    seen = set()
    for offset in np.linspace(-3.0, 6.0, 37) + 0.01:
        scenario = cruise_scenario(start=(190.0, offset, 0.1), iterations=31, road=road)
        for episode in replay(scenario):
            pose = center_poses(episode.log.ego[episode.iteration, :3])
            box = shapely.box(-2.588, -1.1485, 2.588, 1.1485)
            box = shapely.affinity.rotate(box, pose[2], (0, 0), use_radians=True)
            box = shapely.affinity.translate(box, *pose[:2])
            corners = shapely.points(shapely.get_coordinates(box.exterior)[:4])
            expected = not shapely.contains(allowed, corners).all()
            assert episode.terms.off_road == expected
            seen.add(expected)
    assert seen == {True, False}


def test_connectors_are_road_only_where_there_is_an_intersection():
    road = straight_road()
    for intersections, expected in ((road.intersections, False), (make_layer([], []), True)):
        scenario = cruise_scenario(
            start=(203.0, 0.0, 0.0),
            iterations=11,
            road=replace(road, intersections=intersections),
        )
        assert {episode.terms.off_road for episode in replay(scenario)} == {expected}


def parked(x, y=0.0, kind=AgentKind.VEHICLE):
    return standing_tracks(ROWS, np.array([[x, y, 0.0]]), [kind])


def approaching():
    """A car that comes up from behind and drives through the ego."""
    tracks = parked(0.0)
    tracks.poses[:, 0, 0] = np.linspace(-40.0, 60.0, ROWS)
    return tracks


def test_a_collision_counts_once_and_only_while_the_ego_moves():
    hits = [e.terms.collision for e in replay(cruise_scenario(tracks=parked(40.0)))]
    # at 8 m/s the front, 4.049 m ahead of 10 m, is at 37.75 m after 2.96 s
    assert np.flatnonzero(hits).tolist() == [29]
    standing = cruise_scenario(speed=0.0, tracks=approaching())
    episodes = list(replay(standing))
    assert episodes[-1].state.touched.all()
    assert not any(e.terms.collision for e in replay(standing))
    inside = cruise_scenario(tracks=parked(12.0))  # touched before the ego could do anything
    assert not any(e.terms.collision for e in replay(inside))


def test_time_to_collision_looks_less_than_a_second_ahead_and_is_not_forgotten():
    terms = [e.terms.ttc for e in replay(cruise_scenario(tracks=parked(40.0)))]
    first = terms.index(0.5)
    # contact within 0.8 s, at 8 m/s 6.4 m: 37.75 - 14.049 - 6.4 = 17.3 m are driven before
    assert first + 1 == int(np.ceil(17.301 / 0.8))
    assert set(terms[first:]) == {0.5}
    beside = cruise_scenario(tracks=parked(40.0, 3.5))
    assert {e.terms.ttc for e in replay(beside)} == {1.0}


def test_time_to_collision_counts_who_comes_from_behind():
    tracks = approaching()
    tracks.velocities[:] = 100.0 / (ROWS - 1) * 20.0, 0.0  # 3.8 m/s
    terms = [e.terms for e in replay(cruise_scenario(speed=0.01, tracks=tracks))]
    first = [t.ttc for t in terms].index(0.5)
    assert not any(t.collision for t in terms[: first + 5])


def test_comfort_is_the_share_of_checks_that_hold_so_far(rng):
    commands = np.column_stack([rng.normal(0, 8.0, 149), rng.normal(0, 0.6, 149)])
    commands[:40] = 0.0
    episode, terms = driven(commands)
    log, seen = episode.log, set()
    for count in range(4, 150):
        signals = comfort_signals(log.time_us[:count], log.ego[:count])
        expected = sum(within_bounds(signals, NUPLAN)) / 6
        assert terms[count - 2].comfort == expected
        seen.add(expected)
    assert [t.comfort for t in terms[:2]] == [1.0, 1.0]
    assert len(seen) > 2


def test_rewards_are_made_of_their_terms():
    class Seen:
        infraction = ""
        terms = Terms(0.01, 0.9, 0.8, 1.0, 0.5, 0.5, False, False, 0.5)

    np.testing.assert_allclose(regular(Seen), 100 * 0.01 * 0.9 * 0.8 * 0.5 * 0.5, rtol=1e-12)
    np.testing.assert_allclose(
        nuplan(Seen), 100 * 0.9 * (5 * 0.01 + 4 * 0.8 / 150) / 16, rtol=1e-12
    )
    factor = 0.9 * 0.8 * 0.5 * 0.5
    np.testing.assert_allclose(survival(Seen), 100 * (0.4 * 0.01 * factor + 0.6 / 150), rtol=1e-12)
    Seen.infraction = "collision"
    assert [reward(Seen) for reward in (regular, nuplan, survival)] == [0.0, 0.0, 0.0]


def test_speeds_are_those_of_the_rear_axle():
    episode, terms = driven([(2.0, 0.0)] * 100, road=straight_road(speed_limit=9.0))
    over = speeds(episode.log.ego[1:101]) - 9.0
    expected = np.clip(1.0 - over / 2.23, 0.0, 1.0)
    np.testing.assert_allclose([t.speed for t in terms], expected, rtol=0, atol=1e-12)
