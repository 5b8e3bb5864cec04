"""Route correction: where it looks for the start, and that repeating it changes nothing."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import seeds
from worlds import bent_points, mapped, straight_road

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.errors import PlannerError
from shiftsim.geometry.boxes import boxes_to_corners, wrap_angles
from shiftsim.geometry.polylines import vertex_headings
from shiftsim.planners.routes.correction import (
    RouteCorrector,
    Start,
    correct_route,
    find_start,
    known_blocks,
)
from shiftsim.world.build import BlockSpec, build_map
from shiftsim.world.layers import square_around

BENT = mapped(straight_road(), bent_points)


def names(road, blocks):
    return [road.blocks.ids[block] for block in blocks]


def start_of(road, route, pose, area):
    start = find_start(road, known_blocks(road, route, "token", "test"), np.array(pose), area)
    return road.blocks.ids[start.block], names(road, start.others)


def test_the_wider_the_search_the_more_blocks_may_be_the_start():
    road = straight_road()
    pose = (201.0, 0.0, 0.0)
    assert start_of(road, ["1"], pose, square_around(201.0, 0.0, 0.5)) == ("2", ["2"])
    # the right lane of every block lies below the pose, the left one is too far
    assert start_of(road, ["1"], pose, square_around(201.0, 0.0, 2.5)) == ("1", ["1"])
    footprint = boxes_to_corners(np.array([202.5, 0.0, 0.0]), np.array([5.2, 2.3]))
    assert start_of(road, ["2"], pose, footprint) == ("2", ["2"])


@pytest.mark.parametrize(("x", "found"), [(215.0, ["3", "2"]), (10.0, ["1", "2"])])
def test_off_the_road_the_nearest_block_of_either_kind_is_taken(x, found):
    road = straight_road()
    start, candidates = start_of(road, ["1"], (x, 30.0, 0.0), square_around(x, 30.0, 1.0))
    assert candidates == found
    assert start == ("2" if x > 200.0 else "1")


@given(seeds)
def test_the_start_is_the_nearest_block_that_fits_best_on_the_route(seed):
    road, rng = BENT, np.random.default_rng(seed)
    x, turn = rng.uniform(-5.0, 425.0), rng.choice([0.0, 0.7, 0.85, 3.0]) * rng.choice([1.0, -1.0])
    (px, py), heading = bent_points(np.array([x, rng.uniform(-6.0, 9.0)])), 2.0 + x / 150.0 + turn
    route = rng.permutation(3)[: rng.integers(1, 4)].tolist()
    area = square_around(px, py, float(rng.choice([0.5, 2.5, 12.0])))
    shapes = [road.blocks.shape(block) for block in range(3)]
    near = [block for block in range(3) if shapes[block].intersects(shapely.Polygon(area))]
    if not near:
        away = [shape.distance(shapely.Point(px, py)) for shape in shapes]
        near = [int(np.argmin(away[:2])), 2]
    fitting, every = [], []
    for block in near:
        rows = []
        for lane in road.block_edges.at(block).tolist():
            line = road.baselines.at(lane)
            apart = np.hypot(*(line - [px, py]).T)
            error = wrap_angles(vertex_headings(line)[apart.argmin()] - np.array([heading]))[0]
            rows.append((apart.min(), block))
            if abs(error) < np.pi / 4 and apart.min() < 3.0:
                fitting.append(rows[-1])
        every.append(min(rows))
    on_route = [row for row in fitting if row[1] in route]
    chosen = on_route or fitting or every
    start = find_start(road, route, np.array([px, py, heading]), area)
    assert start == Start(min(chosen, key=lambda row: row[0])[1], [block for _, block in chosen])


def test_a_route_that_misses_its_start_and_a_link_is_completed():
    road = straight_road()
    corrector = RouteCorrector(road, known_blocks(road, ["3"], "token", "test"), 1.0)
    assert names(road, corrector.at(np.array([100.0, 0.0, 0.0]))) == ["1", "2", "3"]
    gap = RouteCorrector(road, known_blocks(road, ["1", "3"], "token", "test"), 1.0)
    assert names(road, gap.at(np.array([100.0, 0.0, 0.0]))) == ["1", "2", "3"]


def test_repeated_ids_of_a_route_count_once():
    road = straight_road()
    assert known_blocks(road, ["1", "2", "1", "3"], "token", "test") == [0, 2, 1]


@pytest.mark.parametrize(("route", "text"), [([], "is empty"), (["1", "x"], "no roadblock 'x'")])
def test_a_bad_route_is_an_error_that_names_planner_and_scenario(route, text):
    with pytest.raises(PlannerError, match=text) as caught:
        known_blocks(straight_road(), route, "a1b2", "plantf")
    assert "plantf" in str(caught.value)
    assert "a1b2" in str(caught.value)


def test_a_map_without_roads_is_an_error():
    road = build_map("nowhere", edges=[], blocks=[])
    with pytest.raises(PlannerError, match="map 'nowhere' has no roadblocks"):
        find_start(road, [], np.zeros(3), square_around(0.0, 0.0, 1.0))


@pytest.mark.parametrize(("overlap", "kept"), [(0.9, ["1", "8", "9"]), (1.1, ["1", "8"])])
def test_a_route_ends_before_a_connector_that_overlaps_one_before_it(overlap, kept):
    """Areas of roadblocks do not count, nor does up to a square metre."""
    shapes = {"1": (0, 0, 9, 9), "8": (0, 0, 4, 2), "9": (4 - overlap, 1, 8, 5)}
    blocks = [BlockSpec(name, name > "1", shapely.box(*box)) for name, box in shapes.items()]
    road = build_map("loop", edges=[], blocks=blocks)
    route = known_blocks(road, list(shapes), "token", "test")
    assert names(road, correct_route(road, route, Start(route[0], []))) == kept


@pytest.fixture(scope="module")
def city():
    return bench_scene(0, 0)


@pytest.mark.thorough
@settings(max_examples=40)
@given(st.data())
def test_what_is_kept_is_what_a_new_correction_gives(city, data):
    road, ego = city.map, city.expert
    dropped = data.draw(st.integers(0, 3))
    blocks = known_blocks(road, city.route, city.token, "test")[dropped:]
    corrector = RouteCorrector(road, blocks, 2.5)
    for _ in range(4):
        pose = ego[data.draw(st.integers(0, len(ego) - 1)), :3].copy()
        pose += [data.draw(st.floats(-9, 9)), data.draw(st.floats(-9, 9)), 0.0]
        pose[2] += data.draw(st.sampled_from([0.0, 1.5, 3.0]))
        start = find_start(road, blocks, pose, square_around(pose[0], pose[1], 2.5))
        assert corrector.at(pose) == tuple(correct_route(road, blocks, start))
