"""Paths of reactive agents, and where agents start, against plain versions."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from strategies import seeds
from worlds import standing_tracks, straight_road

from shiftsim.geometry.boxes import boxes_to_corners, wrap_angles
from shiftsim.geometry.polylines import vertex_headings
from shiftsim.kernels import readonly
from shiftsim.sim.traffic.idm.model import make_fleet, place_agents
from shiftsim.sim.traffic.idm.paths import (
    append_baseline,
    choose_successor,
    cut_path,
    finish_path,
    first_after,
    pose_on_path,
)
from shiftsim.sim.traffic.idm.scene import (
    HEADING,
    PROGRESS,
    IdmParameters,
    lane_graph,
    make_scene,
    with_longer_paths,
)
from shiftsim.sim.traffic.idm.step import DONE, LONGER_PATHS, advance
from shiftsim.sim.traffic.idm.yielding import make_yielding
from shiftsim.sim.traffic.lanes import GREEN, RED
from shiftsim.world.events import OFF
from shiftsim.world.lanes import Start
from shiftsim.world.layers import make_lists, make_polygons, make_polylines
from shiftsim.world.state import NUM_STATE, AgentKind

ROAD = straight_road()


def chain(rng, count=9):
    """Lanes behind one another on a bent line; some have repeated vertices."""
    heading = rng.uniform(-3.0, 3.0) + np.cumsum(rng.normal(0.0, 0.3, 4 * count + 1))
    steps = rng.uniform(0.5, 4.0, (len(heading), 1))
    line = 4e5 + np.cumsum(steps * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    parts = [line[4 * i : 4 * i + 5] for i in range(count)]
    parts = [np.repeat(part, rng.choice([1, 1, 1, 2], 5), axis=0) for part in parts]
    return graph_of(parts, [[i + 1] for i in range(count - 1)] + [[]])


def graph_of(lines, after):
    """Lanes of 12 m/s without lights and stop lines."""
    count = len(lines)
    road = SimpleNamespace(
        edges=lines,
        baselines=make_polylines(lines),
        outgoing=make_lists(after),
        speed_limits=readonly(np.full(count, 12.0)),
        has_traffic_lights=readonly(np.zeros(count, np.bool_)),
        stop_lines=make_lists([[]] * count),
        stop_polygons=SimpleNamespace(polygons=make_polygons([])),
    )
    return lane_graph(road)


def slow_path(poses):
    """(K, 4) poses without those that repeat the next one, and without the last; progress."""
    lengths = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    progress = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    kept = lengths > 1e-8
    return np.column_stack([poses[:-1][kept, :2], np.unwrap(poses[:-1, 2][kept]), progress[kept]])


def slow_pose(path, progress):
    return np.array([np.interp(progress, path[:, PROGRESS], path[:, i]) for i in range(3)])


def raw_poses(graph, lane):
    line = graph.baselines.at(lane)
    step = np.diff(line, axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])
    np.testing.assert_array_equal(vertex_headings(line)[:-1], heading)
    return np.column_stack([line, np.append(heading, heading[-1])])


def same_path(found, expected):
    np.testing.assert_allclose(found[:, [0, 1, 3]], expected[:, [0, 1, 3]], rtol=0.0, atol=1e-6)
    turn = wrap_angles(found[:, HEADING] - expected[:, HEADING])
    np.testing.assert_allclose(turn, 0.0, rtol=0.0, atol=1e-6)
    assert (np.abs(np.diff(found[:, HEADING])) <= np.pi + 1e-9).all()


@given(seeds)
def test_paths_of_a_lane_are_read_between_their_vertices(seed):
    rng = np.random.default_rng(seed)
    graph, path = chain(rng, 2), np.full((40, 4), np.nan)
    raw = append_baseline(graph.baselines, 0, path, 0)
    raw = append_baseline(graph.baselines, 1, path, raw)
    size = finish_path(path, raw)
    expected = slow_path(np.concatenate([raw_poses(graph, lane) for lane in (0, 1)]))
    same_path(path[:size], expected)
    end = expected[-1, PROGRESS]
    for progress in (0.0, end, *expected[1:-1, PROGRESS], *rng.uniform(0.0, end, 5)):
        after = int(np.searchsorted(path[:size, PROGRESS], progress, side="right"))
        assert first_after(path, size, progress) == after
        x, y, heading = pose_on_path(path, size, progress)
        wanted = slow_pose(path[:size], progress)
        np.testing.assert_allclose([x, y], wanted[:2], rtol=0.0, atol=1e-6)
        assert -np.pi <= heading <= np.pi
        assert np.abs(wrap_angles(np.array([heading - wanted[2]])))[0] < 1e-6


@given(seeds)
def test_a_piece_of_a_path_has_its_ends_and_the_vertices_between(seed):
    rng = np.random.default_rng(seed)
    graph, path, line = chain(rng, 2), np.zeros((40, 4)), np.empty((42, 2))
    size = finish_path(path, append_baseline(graph.baselines, 0, path, 0))
    at, end = path[:size, PROGRESS], path[size - 1, PROGRESS]
    for low, high in ((-9.0, 0.0), (end, end + 9.0), (-5.0, end + 5.0), (end - 1.0, end + 1.0)):
        check = cut_path(path, size, low, high, line)
        if high <= 0.0 or low >= end:  # two vertices are left
            wanted = path[:2, :2] if high <= 0.0 else path[size - 2 : size, :2]
        else:
            inside = path[:size, :2][(at > max(low, 0.0)) & (at < min(high, end))]
            ends = [slow_pose(path[:size], np.clip(s, 0.0, end))[:2] for s in (low, high)]
            wanted = np.array([ends[0], *inside, ends[1]])
        np.testing.assert_allclose(line[:check], wanted, rtol=0.0, atol=1e-6)
    for low in rng.uniform(0.0, end, 4):
        high = rng.uniform(low, end)
        inside = path[:size, :2][(at > low) & (at < high)]
        ends = [slow_pose(path[:size], s)[:2] for s in (low, high)]
        count = cut_path(path, size, low, high, line)
        wanted = np.array([ends[0], *inside, ends[1]])
        np.testing.assert_allclose(line[:count], wanted, rtol=0.0, atol=1e-6)


@given(seeds)
def test_routes_go_on_until_paths_are_long_enough(seed):
    rng = np.random.default_rng(seed)
    graph = chain(rng)
    length = graph.baselines.length(0)
    progress = float(rng.choice([0.0, 0.4 * length, length, length + 3.0]))
    path, route, wanted = slow_path(raw_poses(graph, 0)), [0], 12.0 + 12.0 * 1.5
    road = SimpleNamespace(baselines=graph.baselines, speed_limits=graph.speed_limits)
    start = Start(0, progress, np.zeros(3))
    fleet = make_fleet(road, [start], np.array([[4.0, 2.0]]), np.array([3.0]), 10.0)
    yielding = make_yielding(ROAD, OFF, np.zeros(1, np.bool_), 0, 1)
    parameters, agents = IdmParameters(min_path_length=12.0), np.array([0])
    scene = make_scene(parameters, graph, fleet, agents, agents[:0], yielding)
    same_path(fleet.path[0, : fleet.path_size[0]], path)

    ego = np.zeros(NUM_STATE)
    ego[:2] = fleet.pose[0, :2] + 60.0  # far beside it
    tracks = standing_tracks(1, np.zeros((1, 3)), [AgentKind.VEHICLE])
    row = tracks.map_arrays(lambda array: array[0]).arrays
    end, needed = advance(scene, row, ego, 0.1)
    while end == LONGER_PATHS:  # then it goes on where there is more room
        scene = with_longer_paths(scene, needed)
        end, needed = advance(scene, row, ego, 0.1)

    while path[-1, PROGRESS] - progress < wanted and route[-1] < 8:
        at = np.clip(progress, 0.0, path[-1, PROGRESS])
        ahead = path[path[:, PROGRESS] > at, :3]
        front = np.array([slow_pose(path, at), *ahead]) if len(ahead) else path[-2:, :3]
        route.append(route[-1] + 1)
        path, progress = slow_path(np.concatenate([front, raw_poses(graph, route[-1])])), 0.0
    fleet = scene.fleet
    assert end == DONE
    same_path(fleet.path[0, : fleet.path_size[0]], path)
    assert fleet.route[0, : fleet.route_size[0]].tolist() == route[-5:]
    assert fleet.progress[0] == pytest.approx(progress + 0.3, abs=1e-12)
    x, y, heading = slow_pose(path, progress + 0.3)
    np.testing.assert_allclose(row.poses[0, :2], [x, y], rtol=0.0, atol=1e-6)
    assert np.abs(wrap_angles(row.poses[0, 2:] - heading))[0] < 1e-6
    along = fleet.speed[0] * np.array([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose(row.velocities[0], along, rtol=0.0, atol=1e-6)


BENDS = (0.3, 0.1, 0.1, -0.2)  # rad within 10 m of the lanes 1 … 4, which all begin straight on


@pytest.mark.parametrize(
    ("has_lights", "lights", "chosen"),
    [
        ({}, {}, 2),  # the first of the straightest
        ({}, {2: RED}, 3),
        ({}, {2: GREEN}, 2),
        ({}, {2: RED + GREEN}, 3),
        ({2}, {}, 3),
        ({2}, {2: GREEN}, 2),
        ({2}, {2: RED + GREEN}, 2),
        ({2, 3}, {}, 4),
        ({2, 3, 4}, {4: RED}, 1),
        ({1, 2, 3, 4}, {}, -1),
    ],
)
def test_the_straightest_lane_that_is_open_is_next(has_lights, lights, chosen):
    way = np.linspace(0.0, 1.0, 9)[:, None]
    lines = [np.array([[-9.0, 0.0], [0.0, 0.0]])]
    lines += [10.0 * np.column_stack([way, bend * way**2]) for bend in BENDS]
    lit = readonly(np.isin(np.arange(5), list(has_lights)))
    graph = graph_of(lines, [[1, 2, 3, 4], [], [], [], []])._replace(has_lights=lit)
    for lane, flags in lights.items():
        graph.lights[lane] = flags
    assert choose_successor(graph, 0) == chosen


@pytest.mark.parametrize(
    ("places", "placed"),
    [
        ([(40.0, 0.6)], [40.0]),
        ([(40.0, 0.6), (42.0, 0.0)], [40.0, None]),
        ([(40.0, 0.0), (42.0, 0.0), (60.0, 0.0), (62.0, 0.0)], [40.0, None, 60.0, None]),
        ([(40.0, 0.0), (42.0, 0.0), (46.2, 0.0)], [40.0, None, 46.2]),
        ([(60.0, 20.0), (60.0, 0.0), (61.0, 0.0)], [None, 60.0, None]),
        ([(60.0, 0.0), (11.0, 0.0)], [60.0, None]),  # where the ego is
        ([(60.0, 0.0), (60.0, 3.5), (90.0, 3.4), (91.0, 0.0)], [60.0, 60.0, 90.0, 91.0]),
    ],
)
def test_vehicles_start_where_nobody_is(places, placed):
    poses = np.column_stack([np.array(places), np.zeros(len(places))])
    ego = boxes_to_corners(np.array([[10.0, 0.0, 0.0]]), np.array([5.0, 2.0]))
    starts = place_agents(ROAD, poses, np.tile([4.0, 2.0], (len(places), 1)), ego)
    assert [None if start is None else start.pose[0] for start in starts] == placed


def test_agents_without_a_limit_take_that_of_the_one_before():
    lines = [np.column_stack([np.arange(n), np.zeros(n)]) for n in (5, 9, 5, 5)]
    road = SimpleNamespace(
        baselines=make_polylines(lines),
        speed_limits=np.array([np.nan, 8.0, 0.0, np.nan]),
    )
    starts = [Start(lane, 1.5 + lane, np.zeros(3)) for lane in range(4)]
    fleet = make_fleet(road, starts, np.full((4, 2), 2.0), np.arange(4.0), 11.0)
    assert fleet.target.tolist() == [11.0, 8.0, 8.0, 8.0]
    assert fleet.path.shape == (4, 9, 4)
    assert fleet.path_size.tolist() == [4, 8, 4, 4]
    assert fleet.pose[:, 0].tolist() == [1.5, 2.5, 3.0, 3.0]  # at most at the end of the path
    assert fleet.route[:, 0].tolist() == [0, 1, 2, 3]
    assert fleet.alive.all()
    assert fleet.speed.tolist() == [0.0, 1.0, 2.0, 3.0]
