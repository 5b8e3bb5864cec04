"""Proposals of PDM-Closed step by step: who leads, how it is followed, where poses are read."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import seeds
from worlds import standing_tracks

from shiftsim.geometry.boxes import boxes_to_corners
from shiftsim.geometry.corridor import CLEAR, HIT
from shiftsim.geometry.polylines import make_path
from shiftsim.planners.pdm.corridor import Corridors, Paths, fill_corridor
from shiftsim.planners.pdm.forecast import forecast_ranks, make_forecast, touched
from shiftsim.planners.pdm.parameters import FollowingModel
from shiftsim.planners.pdm.rollout import Scene, _nearest, follow, read_pose, roll_out
from shiftsim.planners.proposals.places import EgoBox
from shiftsim.planners.routes.lead import red_lights
from shiftsim.world.state import NUM_STATE, VX, AgentKind, X

PATH = make_path(np.column_stack([np.linspace(0.0, 60.0, 61), np.zeros(61), np.zeros(61)]))


def seen(poses, velocities=None, *, rings=()):
    """Vehicles of 4.5 m x 2 m, and the outlines of red connectors."""
    tracks = standing_tracks(1, np.array(poses, np.float64), [AgentKind.VEHICLE] * len(poses))
    if velocities is not None:
        tracks.velocities[0] = velocities
    lights = red_lights(list(range(len(rings))), [np.asarray(ring) for ring in rings])
    return make_forecast(tracks, np.arange(len(poses)), lights)


@pytest.mark.parametrize(
    ("progress", "pose"),
    [
        (-3.0, (1e-5, 0.0, 0.0)),  # a little behind the first vertex
        (0.25, (0.25, 0.0, 0.0)),
        (59.5, (59.5, 0.0, 0.0)),
        (99.0, (60.0, 0.0, 0.0)),
        (np.nan, (0.0, 0.0, 0.0)),
    ],
)
def test_poses_are_read_on_the_path(progress, pose):
    assert read_pose(PATH, progress) == pytest.approx(pose, abs=1e-12)


def test_headings_of_poses_are_wrapped():
    turn = make_path(np.array([[0.0, 0.0, 3.0], [1.0, 0.0, 3.2], [2.0, 0.0, 3.4]]))
    assert read_pose(turn, 1.5)[2] == pytest.approx(3.3 - 2.0 * np.pi)


@settings(max_examples=25)
@given(
    st.floats(0.0, 20.0), st.floats(0.0, 40.0), st.floats(-5.0, 20.0), st.sampled_from([0.0, 2.5])
)
def test_a_lead_is_followed_by_the_formula(speed, gap, lead_speed, rear):
    model = FollowingModel(2.0, 1.2, 1.4, 2.8, 8.0)
    wanted = 2.0 + 1.2 * speed + speed * (speed - lead_speed) / (2.0 * np.sqrt(1.4 * 2.8))
    accel = 1.4 * (1.0 - (speed / 11.0) ** 8 - (wanted / max(gap, 2.0)) ** 2)
    expected = 7.0 + 0.1 * speed, speed + 0.1 * np.clip(accel, -2.8, 1.4)
    found = follow(7.0, speed, (7.0 + gap + rear, lead_speed, rear), 11.0, model)
    assert found == pytest.approx(expected, abs=1e-9)


@given(seeds)
def test_the_nearest_of_all_ahead_leads(seed):
    rng = np.random.default_rng(seed)
    poses = rng.uniform([-30.0, -30.0, -3.0], [30.0, 30.0, 3.0], (6, 3))
    shapes = boxes_to_corners(
        rng.uniform([-40, -40, -3], [40, 40, 3], (3, 3)), np.array([9.0, 3.0])
    )
    forecast = seen(poses, rng.uniform(-5.0, 5.0, (6, 2)), rings=shapes)
    footprint = boxes_to_corners(rng.uniform([-9, -9, -3], [9, 9, 3]), np.array([5.0, 2.0]))
    for row in rng.integers(0, 41, 6).tolist():
        along, hits = rng.uniform(0.0, 10.0, 9), rng.permutation(9)[: rng.integers(1, 10)]
        ahead = hits[along[hits] > 3.0]
        if not len(ahead):
            continue
        rings = [*forecast.others.boxes[row], *shapes]
        away = shapely.distance(shapely.Polygon(footprint), [*map(shapely.Polygon, rings)])
        ranks = forecast_ranks(forecast, row)
        found = _nearest(hits, along, 3.0, footprint, forecast, row, ranks)
        least = away[ahead].min()
        tied = [index for index in ahead if away[index] == least]
        assert found == (min(tied, key=ranks.__getitem__), pytest.approx(least, abs=1e-9))


@pytest.mark.parametrize(
    ("pose", "velocity", "rows"),
    [
        ((20.0, 0.0, 0.0), (0.0, 0.0), range(1, 21)),
        ((20.0, 2.2, 0.0), (0.0, 0.0), ()),  # beside it: half widths are 1 m and 1.15 m
        ((20.0, -2.1, 0.0), (0.0, 0.0), range(1, 21)),
        ((5.0, 0.0, 0.0), (0.0, 0.0), ()),  # before its start at 10 m, square ends included
        ((7.0, 0.0, 0.0), (0.0, 0.0), range(1, 21)),
        ((45.0, 0.0, 0.0), (0.0, 0.0), range(1, 21)),
        ((47.0, 0.0, 0.0), (0.0, 0.0), ()),
        ((20.0, 12.0, -np.pi / 2), (0.0, -5.0), range(9, 16)),  # crosses at 1 m a row
        ((30.0, -30.0, np.pi / 2), (0.0, 5.0), ()),  # comes too late
    ],
)
def test_a_corridor_holds_what_is_on_it_when_it_is(pose, velocity, rows):
    forecast = seen([(30.0, 30.0, 0.0), pose], [(0.0, 0.0), velocity])
    corridors = Corridors(
        np.array([[10.0, 42.0]]), 1.15, np.full((1, 41, 2), CLEAR), np.zeros((1, 41, 2))
    )
    for first, last in ((1, 11), (11, 21)):
        fill_corridor(PATH, corridors, forecast, 0, first, last)
    assert (corridors.occupancy[0, :, 0] == CLEAR).all()
    assert np.flatnonzero(corridors.occupancy[0, :, 1] == HIT).tolist() == list(rows)
    np.testing.assert_allclose(corridors.progress[0, list(rows), 1], pose[0], atol=1e-9)


@pytest.mark.parametrize(("x", "hit"), [(20.0, True), (46.0, False)])
def test_a_red_light_on_a_corridor_stays(x, hit):
    ring = boxes_to_corners(np.array([x, 0.0, 0.0]), np.array([4.0, 3.0]))
    forecast = seen([(30.0, 30.0, 0.0)], rings=[ring + 500.0, ring])
    corridors = Corridors(
        np.array([[10.0, 42.0]]), 1.15, np.full((1, 41, 3), CLEAR), np.zeros((1, 41, 3))
    )
    fill_corridor(PATH, corridors, forecast, 0, 1, 21)
    assert (corridors.occupancy[0, 1:21, 2] == HIT).tolist() == [hit] * 20
    assert (corridors.occupancy[0, :, :2] == CLEAR).all()
    np.testing.assert_allclose(corridors.progress[0, 1:21, 2], x * hit, atol=1e-9)


@pytest.mark.parametrize(
    ("x", "y", "found"),
    [
        (0.0, 0.0, [0]),
        (100.0, 0.0, []),
        (50.0, 0.0, [2]),  # entirely on the second connector
        (49.0, 0.0, []),
        (50.0, 0.6, []),
        (3.0, 0.0, [0]),
        (3.3, 0.0, []),
    ],
)
def test_what_the_ego_touches_is_found_and_a_light_once_it_is_on_its_connector(x, y, found):
    ring = boxes_to_corners(np.array([51.0, 0.0, 0.0]), np.array([4.5, 3.0]))
    forecast = seen([(0.0, 0.0, 0.0)], rings=[ring + 500.0, ring])
    ego = np.zeros(NUM_STATE)
    ego[:2] = x, y
    assert touched(forecast, ego, EgoBox(4.0, 2.0, 1.0)) == found


@pytest.mark.parametrize(
    ("seconds", "x", "is_lead"),
    [((), 45.0, True), ((), 47.0, False), ((5.0,), 33.0, True), ((5.0,), 35.0, False)],
)
def test_leads_are_looked_for_as_far_as_the_fastest_gets_in_eight_seconds(seconds, x, is_lead):
    """32 m at 4 m/s from 10 m on, or 20 m, and 1.15 m more; then come rears of vehicles."""
    model, ego = FollowingModel(2.0, 1.2, 1.4, 2.8, 8.0), np.zeros(NUM_STATE)
    ego[[X, VX]] = 10.0, 4.0
    paths = Paths(*(array[None] for array in PATH))
    scene = Scene(paths, seen([(x, 0.0, 0.0)]), EgoBox(4.0, 2.3, 2.0), model)
    leads = roll_out(scene, ego, np.array([2.0, 4.0]), *seconds).leads
    # a lead is as far ahead of the rear axle as of the front 4 m on; without one the path ends
    expected = x - 2.25 - 4.0 if is_lead else 60.0
    assert leads[0, :, 2, 0] == pytest.approx(np.full(2, expected), abs=1e-9)
