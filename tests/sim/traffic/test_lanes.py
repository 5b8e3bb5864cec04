"""Which lanes agents follow, and lights along them, against shapely."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds
from worlds import cruise_scenario

from shiftsim.geometry.boxes import wrap_angles
from shiftsim.sim.traffic.lanes import (
    CANDIDATES,
    GREEN,
    NO_LANE,
    RED,
    Lanes,
    choose_lane,
    heading_at,
    light_flags,
    next_lane,
)
from shiftsim.world.layers import make_lists, make_polygons, make_polylines
from shiftsim.world.state import TrafficLights


def some_lanes(rng, count=7):
    """Lanes of 4 m around bent lines near the origin, each leading to up to three others."""
    lines = []
    for _ in range(count):
        vertices = int(rng.integers(2, 9))
        heading = rng.uniform(-3.0, 3.0) + np.cumsum(rng.normal(0.0, 0.3, vertices))
        steps = rng.uniform(0.4, 6.0) * np.column_stack([np.cos(heading), np.sin(heading)])
        line = np.cumsum(steps, axis=0)
        lines.append(line - line.mean(axis=0) + rng.uniform(-4.0, 4.0, 2))
    after = [rng.choice(count, rng.integers(0, 4), replace=False).tolist() for _ in range(count)]
    areas = [shapely.LineString(line).buffer(2.0, cap_style="flat").convex_hull for line in lines]
    rings = [[np.array(area.exterior.coords)] for area in areas]
    limits, red = np.full(count, 10.0), np.zeros(count, np.bool_)
    lanes = Lanes(make_polygons(rings), make_polylines(lines), make_lists(after), limits, red)
    return lanes, [shapely.LineString(line) for line in lines], areas, after


def slow_heading(line, along):
    """Direction from half a metre before a place to half a metre behind it, on the line."""
    low = min(max(along - 0.5, 0.0), max(line.length - 1.0, 0.0))
    a, b = (np.array(line.interpolate(min(at, line.length)).coords[0]) for at in (low, low + 1.0))
    return np.arctan2(*(b - a)[::-1])


def turn_between(a, b):
    return float(np.abs(wrap_angles(np.array([a - b])))[0])


@given(seeds)
def test_the_lane_that_fits_best_is_followed(seed):
    rng = np.random.default_rng(seed)
    lanes, lines, areas, after = some_lanes(rng)
    found = np.empty(CANDIDATES, np.int64)
    for _ in range(5):
        (x, y), place = rng.uniform(-6.0, 6.0, 2), int(rng.integers(len(lines)))
        point = shapely.Point(x, y)
        heading = slow_heading(lines[place], lines[place].project(point)) + rng.normal(0.0, 0.4)
        followed = int(rng.integers(-1, len(lines)))
        best, least = NO_LANE, np.inf
        for lane, line in enumerate(lines):
            turn = turn_between(heading, slow_heading(line, line.project(point)))
            aside = line.distance(point)
            if areas[lane].contains(point) and turn <= 1.0 and aside <= 3.0:
                is_new = followed >= 0 and lane != followed and lane not in after[followed]
                cost = turn + 0.15 * aside + 0.4 * is_new
                if cost < least:
                    best, least = lane, cost
        assert choose_lane(lanes, x, y, heading, followed, found) == best


@given(seeds)
def test_at_a_fork_the_lane_that_ends_straightest_is_next(seed):
    lanes, lines, _, after = some_lanes(np.random.default_rng(seed))
    for lane, line in enumerate(lines):
        for along in (-1.0, 0.3, 0.5 * line.length, line.length):
            turn = turn_between(heading_at(lanes.baselines, lane, along), slow_heading(line, along))
            assert turn < 1e-9
        end = slow_heading(line, line.length)
        bends = [turn_between(slow_heading(lines[i], lines[i].length), end) for i in after[lane]]
        expected = after[lane][int(np.argmin(bends))] if bends else NO_LANE
        assert next_lane(lanes, lane) == expected


@pytest.mark.parametrize(
    ("names", "codes", "flags"),
    [
        (("21",), (0,), GREEN),
        (("21",), (1,), 0),  # yellow
        (("21",), (2,), RED),
        (("21", "21"), (2, 0), RED + GREEN),
        (("21", "21"), (2, 2), RED),
        (("none", "21"), (0, 2), RED),
    ],
)
def test_lights_of_an_edge_are_added_up(names, codes, flags):
    scenario = cruise_scenario(iterations=4)
    status = np.full((len(scenario.time_us), len(names)), 3, np.int8)
    status[scenario.iteration_rows[2]] = codes
    edges, found = light_flags(replace(scenario, traffic_lights=TrafficLights(names, status)))
    assert edges.tolist() == [scenario.map.edges.index["21"]]
    assert found.tolist() == [[0], [0], [flags], [0]]


def test_lights_are_listed_in_the_order_of_their_edges():
    scenario = cruise_scenario(iterations=2)
    status = np.tile(np.array([2, 0], np.int8), (len(scenario.time_us), 1))
    edges, found = light_flags(
        replace(scenario, traffic_lights=TrafficLights(("21", "20"), status))
    )
    index = scenario.map.edges.index
    order = np.argsort([index["21"], index["20"]])
    assert edges.tolist() == sorted([index["21"], index["20"]])
    assert found.tolist() == 2 * [np.array([RED, GREEN])[order].tolist()]
