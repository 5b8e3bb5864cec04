"""What learned traffic sees, and how it moves, against plain versions."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given
from strategies import seeds
from worlds import bent_points, mapped, straight_road

from shiftsim.geometry.boxes import wrap_angles
from shiftsim.sim.traffic.lanes import NO_LANE, lanes_of
from shiftsim.sim.traffic.learned.features import (
    AHEAD,
    NUM_FEATURES,
    REACH,
    Motion,
    move_agents,
    observe_agents,
)
from shiftsim.sim.traffic.learned.model import SHAPES, Weights, controls
from shiftsim.world.state import AgentKind

ROAD = mapped(straight_road(12.0), bent_points)


def lane_line(*names):
    """The centre line along some lanes."""
    lines = [ROAD.baselines.at(ROAD.edges.index[name]) for name in names]
    return shapely.LineString(np.concatenate(lines))


# by edge, the way along it and those behind it; lights are on the connectors 20 and 21
LINES = {
    f"{n}{side}": lane_line(*(f"{i}{side}" for i in range(n, 4)))
    for n in (1, 2, 3)
    for side in (0, 1)
}


def some_motion(rng, count=9):
    """Agents around x0 of the road, many on a lane and near its direction; the last may be away."""
    x0 = rng.choice([5.0, 150.0, 190.0, 380.0, 410.0])
    along = x0 + rng.uniform(-8.0, 45.0, count)
    beside = rng.choice([0.0, 3.5, 8.0], count) + rng.uniform(-1.0, 1.0, count)
    speeds = rng.choice([0.0, 0.29, 0.31, 5.0, 12.0], count)
    heading = 2.0 + along / 150.0 + rng.normal(0.0, 0.2, count)
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    return Motion(
        present=rng.random(count) < 0.85,
        poses=np.column_stack(
            [bent_points(np.column_stack([along, beside])), wrap_angles(heading)]
        ),
        speeds=speeds,
        accelerations=rng.normal(0.0, 2.0, count),
        turns=rng.normal(0.0, 0.2, count),
        velocities=speeds[:, None] * ahead + rng.normal(0.0, 0.1, (count, 2)),
        sizes=rng.uniform(0.5, 5.0, (count, 2)),
        kinds=rng.choice([0, 0, 0, 1, 2, 4], count),
    )


def in_frame(vector, heading):
    """A vector as seen along a heading: ahead, left."""
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([cos * vector[0] + sin * vector[1], cos * vector[1] - sin * vector[0]])


def path_of(line, here):
    """(P, 3) x, y, distance along the path from 2 m behind the agent on, as far as lanes lead."""
    start = line.project(shapely.Point(here))
    ways = [way for way in (-2.0, *AHEAD) if start + way <= line.length]
    return np.array([[*line.interpolate(max(start + way, 0.0)).coords[0], way] for way in ways])


def along_path(path, point, reach):
    """Distance along a path to a point beside it; inf where it is not beside it."""
    for a, b in pairwise(path):
        step, away = b[:2] - a[:2], point - a[:2]
        length = np.hypot(*step)
        if length and 0.0 <= away @ step <= length**2:
            if abs(away[0] * step[1] - away[1] * step[0]) <= reach * length:
                return a[2] + away @ step / length**2 * (b[2] - a[2])
    return np.inf


def slow_features(motion, agent, edge, red):
    """Features of an agent that follows an edge, or none."""
    x, y, heading = motion.poses[agent]
    kind, speed, (length, width) = motion.kinds[agent], motion.speeds[agent], motion.sizes[agent]
    own = [speed / 10.0, motion.accelerations[agent] / 3.0, motion.turns[agent]]
    own += [length / 5.0, width / 2.0, *(kind == code for code in (0, 1, 2)), speed < 0.3]
    path, on_lane = np.zeros((0, 3)), [0.0] * 5
    if edge is not None:
        path, start = path_of(LINES[edge], (x, y)), LINES[edge].project(shapely.Point(x, y))
    if len(path) > 1:
        step, away = path[1, :2] - path[0, :2], np.array([x, y]) - path[0, :2]
        aside = (step[0] * away[1] - step[1] * away[0]) / max(np.hypot(*step), 1e-6)
        light = lane_line(edge).length - start if red and edge[0] == "1" else np.inf
        light = light if light < path[-1, 2] else np.inf
        on_lane = [1.0, 1.2, aside, 1.0 - min(light, REACH) / REACH, light < np.inf]
    ahead = np.column_stack([AHEAD / 20.0, np.zeros(8)])
    for place, point in enumerate(path[1:, :2]):
        ahead[place] = in_frame(point - [x, y], heading) / [20.0, 5.0]
    seen = []
    for other in np.flatnonzero(motion.present).tolist():
        away = motion.poses[other, :2] - [x, y]
        if other == agent or np.hypot(*away) >= REACH:
            continue
        reach, local = 0.5 * (width + motion.sizes[other, 1]) + 0.3, in_frame(away, heading)
        along = local[0] if abs(local[1]) <= reach else np.inf
        if len(path) > 1:
            along = along_path(path, motion.poses[other, :2], reach)
        gap = along - 0.5 * (length + motion.sizes[other, 0]) if along > 0.0 else np.inf
        seen.append((np.hypot(*away), gap, other, local))
    leader = [0.0] * 5
    if seen and (nearest := min(seen, key=lambda row: row[1]))[1] < REACH:
        gap, lead = nearest[1], in_frame(motion.velocities[nearest[2]], heading)[0]
        leader = [1.0, 1.0 - gap / REACH, (speed - lead) / 5.0, lead / 10.0]
        leader += [2.0 / max(gap + 1.0, 0.5)]
    others = np.zeros((5, 7))
    for place, (_, _, other, local) in enumerate(sorted(seen, key=lambda row: row[0])[:5]):
        moving = (in_frame(motion.velocities[other], heading) - [speed, 0.0]) / 5.0
        size, walks = motion.sizes[other, 0] / 5.0, motion.kinds[other] == AgentKind.PEDESTRIAN
        others[place] = 1.0, *(local / 10.0), *moving, size, walks
    return np.concatenate([own, on_lane, ahead.ravel(), leader, others.ravel()])


@given(seeds)
def test_features_are_those_of_a_slow_version(seed):
    rng = np.random.default_rng(seed)
    motion, red, lanes = some_motion(rng), bool(rng.integers(2)), lanes_of(ROAD)
    lanes.is_red[[ROAD.edges.index[name] for name in ("20", "21")]] = red
    agents = np.flatnonzero(motion.kinds <= 2)
    followed, out = np.full(len(agents), NO_LANE), np.full((len(agents), NUM_FEATURES), 7.0)
    observe_agents(lanes, motion, agents, followed, out)
    for agent, edge, row in zip(agents.tolist(), followed.tolist(), out, strict=True):
        if not motion.present[agent]:
            assert not row.any()
            continue
        assert edge == NO_LANE or motion.kinds[agent] != AgentKind.PEDESTRIAN
        name = None if edge == NO_LANE else ROAD.edges.ids[edge]
        np.testing.assert_allclose(row, slow_features(motion, agent, name, red), atol=1e-6)


def pair(x, y, heading, *, kinds=(1, 1), present=(True, True)):
    """An agent at the origin, 0.6 m x 0.8 m, and another one of 3 m x 4 m: too near within 3 m."""
    return Motion(
        np.array(present),
        np.array([[0.0, 0.0, 0.3], [x, y, heading]]),
        np.array([2.0, 0.0]),
        np.zeros(2),
        np.zeros(2),
        np.zeros((2, 2)),
        np.array([[0.6, 0.8], [3.0, 4.0]]),
        np.array(kinds),
    )


@pytest.mark.parametrize(
    ("motion", "stops"),
    [
        (pair(4.0, 0.0, 1.0), False),  # exactly 3 m away after the step
        (pair(3.999, 0.0, 1.0), True),
        (pair(3.0, 3.0, 9.0), False),
        (pair(1.0, 2.8, 7.0), True),
        (pair(-2.0, 0.0, 1.0), False),  # too near, but it goes away
        (pair(0.5, 0.0, 1.0), False),  # as near on the other side
        (pair(0.51, 0.0, 1.0), True),
        (pair(3.0, 0.0, 1.0, kinds=(1, 0)), False),
        (pair(3.0, 0.0, 1.0, kinds=(0, 1)), False),
        (pair(3.0, 0.0, 1.0, present=(True, False)), False),
    ],
)
def test_who_walks_stops_before_a_pedestrian_that_it_comes_too_near_to(motion, stops):
    """It goes 1 m along +x: 2 m/s for 0.5 s, after a turn by -0.6 rad."""
    moved = np.full((1, 4), 7.0)
    move_agents(motion, np.array([0]), np.array([[0.0, -1.2]]), 0.5, moved)
    expected = [0.0, 0.0, -0.3, 0.0] if stops else [1.0, 0.0, -0.3, 2.0]
    np.testing.assert_allclose(moved[0], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("accel", "turn", "expected"),  # way and speed
    [
        (2.0, 0.0, (1.25, 3.0)),
        (-9.0, 0.0, (0.5, 0.0)),  # nobody goes backwards
        (0.0, 6.0, (1.0, 2.0)),
    ],
)
def test_agents_move_by_the_mean_of_both_speeds_along_the_middle_of_their_turn(
    accel, turn, expected
):
    moved = np.empty((2, 4))
    motion = pair(9.0, 9.0, 0.0)
    move_agents(motion, np.array([1, 0]), np.array([[0.0, 0.0], [accel, turn]]), 0.5, moved)
    (way, speed), beside = expected, 0.3 + 0.25 * turn
    place = [way * np.cos(beside), way * np.sin(beside)]
    heading = wrap_angles(np.array([0.3 + 0.5 * turn]))[0]
    np.testing.assert_allclose(moved[1], [*place, heading, speed], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(moved[0], [9.0, 9.0, 0.0, 0.0], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("bias", "speed", "expected"),
    [
        ((1.0, 0.5), 4.0, (2.0, 0.6)),  # 2 m/s^2, and 0.3 rad/m at 4 m/s
        ((-4.1, 1.1), 2.0, (-8.0, 0.6)),
        ((2.1, -1.1), 2.0, (4.0, -0.6)),
        ((0.0, 1.0), 0.0, (0.0, 0.0)),
    ],
)
def test_controls_are_scaled_and_limited(bias, speed, expected):
    arrays = {name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}
    weights = Weights(**(arrays | {"last_bias": np.array(bias, np.float32)}))
    found = controls(weights, np.zeros((1, NUM_FEATURES)), np.array([speed]))
    np.testing.assert_allclose(found, [expected], rtol=0.0, atol=1e-6)


def test_controls_are_those_of_two_hidden_layers(rng):
    arrays = {name: rng.normal(0.0, 0.05, shape) for name, shape in SHAPES.items()}
    weights = Weights(**{name: array.astype(np.float32) for name, array in arrays.items()})
    seen, speeds = rng.normal(size=(5, NUM_FEATURES)), rng.uniform(0.0, 9.0, 5)
    hidden = np.clip(seen @ arrays["first"] + arrays["first_bias"], 0.0, None)
    hidden = np.clip(hidden @ arrays["second"] + arrays["second_bias"], 0.0, None)
    out = (hidden @ arrays["last"] + arrays["last_bias"]) * [2.0, 0.3]
    expected = out * np.column_stack([np.ones(5), speeds])
    np.testing.assert_allclose(controls(weights, seen, speeds), expected, rtol=0.0, atol=1e-4)
