"""Reactive traffic: who is simulated, who is followed, and what must not matter."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st
from worlds import cruise_scenario, standing_tracks, straight_road

from shiftsim.errors import TrafficError
from shiftsim.sim.traffic.idm.lead import comes_first
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.sim.traffic.idm.scene import IdmParameters
from shiftsim.world.build import AreaSpec, BlockSpec, EdgeSpec, build_map
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, Tracks, TrafficLights

VEHICLE, BICYCLE = AgentKind.VEHICLE, AgentKind.BICYCLE
PEDESTRIAN, CONE = AgentKind.PEDESTRIAN, AgentKind.TRAFFIC_CONE
TURNED = [VEHICLE, VEHICLE, VEHICLE, PEDESTRIAN, CONE]
SIDES = {"left": 1.75, "middle": 0.0, "right": -1.75}  # of a lane, m
ROWS = 60 + 2 * 150 + 1 + 160  # of a cruise scenario


def scene(
    poses: list[tuple[float, float, float]],
    kinds: list[AgentKind],
    *,
    speed: float = 0.0,
    offset: tuple[float, float] = (0.0, 0.0),
) -> Scenario:
    """The ego at x = 10 m, and tracks that all report the same speed along +x."""
    where = np.array(poses, np.float64).reshape(-1, 3)
    where[:, :2] += offset
    tracks = standing_tracks(ROWS, where, kinds)
    tracks.velocities[..., 0] += speed
    return cruise_scenario(
        speed=0.0,
        tracks=tracks,
        road=straight_road(offset=offset),
        start=(10.0 + offset[0], offset[1], 0.0),
    )


def drive(scenario: Scenario, steps: int = 149, traffic: IdmTraffic | None = None) -> Tracks:
    tracks = scenario.tracks.rows(scenario.iteration_rows)
    model = traffic or IdmTraffic()
    model.start(scenario, tracks, 0)
    for iteration in range(steps):
        model.step(iteration, scenario.expert[iteration], tracks, iteration + 1)
    return tracks


def test_vehicles_are_put_on_the_middle_of_their_lane() -> None:
    tracks = drive(scene([(40.0, 0.6, 0.1)], [VEHICLE], speed=3.0), steps=0)

    np.testing.assert_allclose(tracks.poses[0, 0], [40.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(tracks.velocities[0, 0], [3.0, 0.0], atol=1e-12)


def test_first_step_moves_by_the_old_speed() -> None:
    tracks = drive(scene([(40.0, 0.0, 0.0)], [VEHICLE], speed=3.0), steps=1)

    # free road: accelerates by 1 (1 - (3 / 15)^4 - (s* / gap)^2), with gap and s* by hand
    gap = 199.0 - 40.0 - 4.5 / 2
    desired = 1.0 + 1.5 * 3.0 + 3.0 * 3.0 / (2.0 * np.sqrt(2.0))
    accel = 1.0 - 0.2**4 - (desired / gap) ** 2
    assert tracks.poses[1, 0, 0] == pytest.approx(40.3, abs=1e-6)
    assert tracks.velocities[1, 0, 0] == pytest.approx(3.0 + 0.1 * accel, abs=1e-6)


def test_many_steps_at_once_are_those_one_by_one() -> None:
    scenario = scene([(40.0, 0.0, 0.0), (75.0, 0.0, 0.0)], [VEHICLE, CONE], speed=5.0)
    alone, together = drive(scenario, 60), scenario.tracks.rows(scenario.iteration_rows)
    model = IdmTraffic()
    model.start(scenario, together, 0)
    for first, last in ((0, 1), (1, 20), (20, 60)):
        model.step_many(first, scenario.expert[first:last], together, first + 1)

    np.testing.assert_array_equal(together.poses[:61], alone.poses[:61])
    np.testing.assert_array_equal(together.velocities[:61], alone.velocities[:61])


def test_follower_stops_behind_a_cone() -> None:
    tracks = drive(scene([(40.0, 0.0, 0.0), (75.0, 0.0, 0.0)], [VEHICLE, CONE], speed=5.0))

    gap = (75.0 - 2.25) - (tracks.poses[149, 0, 0] + 2.25)
    assert tracks.velocities[149, 0, 0] < 0.2
    assert 0.5 < gap < 3.0


def test_ego_is_an_obstacle() -> None:
    scenario = scene([(40.0, 0.0, 0.0)], [VEHICLE], speed=5.0)
    blocked = replace(scenario, ego=scenario.ego + np.eye(11)[0] * 60.0)

    free, behind = drive(scenario, steps=80), drive(blocked, steps=80)

    assert free.poses[80, 0, 0] > 85.0
    assert behind.poses[80, 0, 0] < 67.0


def test_bicycles_late_vehicles_and_those_off_the_road_vanish() -> None:
    scenario = scene(
        [(40.0, 0.0, 0.0), (60.0, 9.0, 0.0), (80.0, 0.0, 0.0), (100.0, 0.0, 0.0)],
        [VEHICLE, VEHICLE, VEHICLE, BICYCLE],
    )
    valid = scenario.tracks.valid.copy()
    valid[: scenario.iteration_rows[5], 2] = False
    scenario = replace(scenario, tracks=replace(scenario.tracks, valid=valid))

    tracks = drive(scenario, steps=20)

    assert tracks.valid[:21, 0].all()
    assert not tracks.valid[:, 1:].any()
    assert np.isnan(tracks.poses[:, 1:]).all()


def test_vehicle_without_room_on_its_lane_is_not_simulated() -> None:
    tracks = drive(scene([(40.0, 0.0, 0.0), (42.0, 0.3, 0.0)], [VEHICLE, VEHICLE]), steps=1)

    assert tracks.valid[0].tolist() == [True, False]


def test_vehicle_that_overlaps_a_long_object_is_not_simulated() -> None:
    scenario = scene([(40.0, 0.0, 0.0), (50.0, 0.0, 0.0)], [VEHICLE, CONE])
    sizes = scenario.tracks.sizes * np.array([[1.0, 1.0], [4.0, 1.0]])
    scenario = replace(scenario, tracks=replace(scenario.tracks, sizes=sizes))

    assert drive(scenario, steps=1).valid[0].tolist() == [False, True]


@pytest.mark.parametrize(("first", "last", "is_placed"), [(0, 9, False), (1, ROWS, True)])
def test_what_stands_there_at_the_start_takes_the_place(
    first: int, last: int, is_placed: bool
) -> None:
    scenario = scene([(40.0, 0.0, 0.0), (41.0, 0.0, 0.0)], [VEHICLE, CONE])
    valid = scenario.tracks.valid.copy()
    valid[:, 1] = False
    valid[scenario.iteration_rows[0] + first : scenario.iteration_rows[0] + last, 1] = True
    scenario = replace(scenario, tracks=replace(scenario.tracks, valid=valid))

    assert drive(scenario, steps=0).valid[0, 0] == is_placed


@pytest.mark.parametrize(("gone", "stops"), [(1, True), (2, False)])
def test_a_cone_is_in_the_way_while_it_is_there(gone: int, stops: bool) -> None:
    poses = [(40.0, 0.0, 0.0), (75.0, 9.0, 0.0), (75.0, 0.0, 0.0)]
    scenario = scene(poses, [VEHICLE, CONE, CONE], speed=5.0)
    valid = scenario.tracks.valid.copy()
    valid[scenario.iteration_rows[20] :, gone] = False
    scenario = replace(scenario, tracks=replace(scenario.tracks, valid=valid))

    assert (drive(scenario).poses[100, 0, 0] < 72.0) == stops


def test_agents_beyond_the_radius_are_removed_for_good() -> None:
    scenario = scene([(105.0, 0.0, 0.0)], [VEHICLE], speed=15.0)

    tracks = drive(scenario, steps=40)

    last = int(np.flatnonzero(tracks.valid[:, 0])[-1])
    assert 0 < last < 40
    assert tracks.poses[last, 0, 0] > 105.0


@pytest.mark.parametrize("codes", [(2, 0), (0, 2)])
def test_a_light_that_is_red_and_green_at_once_is_both(codes: tuple[int, int]) -> None:
    base = scene([(150.0, 0.0, 0.0)], [VEHICLE], speed=5.0)
    road = base.map
    lit = replace(road, has_traffic_lights=np.ones(len(road.edges), np.bool_))

    def end(road: VectorMap, *codes: int) -> float:
        lights = TrafficLights(("21",) * len(codes), np.full((ROWS, len(codes)), codes, np.int8))
        changed, far = replace(base, map=road, traffic_lights=lights), IdmParameters(radius=1e3)
        return float(drive(changed, steps=150, traffic=IdmTraffic(far)).poses[-1, 0, 0])

    assert end(lit, *codes) == end(lit, 0) > 200.0  # enters where green is asked for
    assert end(road, *codes) == end(road, 2) < 200.0  # and not where red is


def test_parameters_change_the_driving() -> None:
    scenario = scene([(40.0, 0.0, 0.0)], [VEHICLE], speed=5.0)

    calm = drive(scenario, steps=50, traffic=IdmTraffic(IdmParameters(accel_max=0.3)))

    assert calm.velocities[50, 0, 0] < drive(scenario, steps=50).velocities[50, 0, 0]


def test_start_forgets_the_rollout_before() -> None:
    scenario = scene([(40.0, 0.0, 0.0)], [VEHICLE], speed=5.0)
    traffic = IdmTraffic()

    first, second = drive(scenario, traffic=traffic), drive(scenario, traffic=traffic)

    np.testing.assert_array_equal(first.poses, second.poses)


def test_a_scene_without_vehicles_runs() -> None:
    tracks = drive(scene([(40.0, 0.0, 0.0)], [CONE]), steps=3)

    assert tracks.valid.all()


CROWD = [(40.0, 0.2, 0.0), (60.0, 3.3, 0.0), (90.0, -0.2, 0.0), (75.0, 2.4, 0.5), (95.0, 5.0, 1.0)]
CROWD_KINDS = [VEHICLE, VEHICLE, VEHICLE, PEDESTRIAN, CONE]


@given(st.sampled_from([(664_430.0, 3_998_750.0), (-1234.5, 77.25), (0.0, 1e5)]))
def test_translation_of_the_world_moves_the_agents_along(offset: tuple[float, float]) -> None:
    here = drive(scene(CROWD, CROWD_KINDS, speed=4.0))
    there = drive(scene(CROWD, CROWD_KINDS, speed=4.0, offset=offset))

    np.testing.assert_array_equal(here.valid, there.valid)
    np.testing.assert_allclose(there.poses - np.array([*offset, 0.0]), here.poses, atol=1e-6)


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Points (..., 2) turned around the origin."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def turned_road(angle: float, *, spacing: float = 1.0) -> VectorMap:
    """One lane of 300 m in the direction `angle`; no two lanes overlap, so no heading decides."""
    x = np.arange(0.0, 300.0 + spacing / 2, spacing)
    sides = {name: turned(np.c_[x, np.full_like(x, y)], angle) for name, y in SIDES.items()}
    area = shapely.Polygon(np.concatenate([sides["left"], sides["right"][::-1]]))
    lane = EdgeSpec(
        id="1",
        is_connector=False,
        polygon=area,
        baseline=sides["middle"],
        block_id="9",
        incoming=[],
        outgoing=[],
        left=sides["left"],
        right=sides["right"],
        speed_limit=15.0,
        lane_index=0,
        left_lane=None,
        right_lane=None,
        intersection_id=None,
    )
    block = BlockSpec(id="9", is_connector=False, polygon=area, incoming=[], outgoing=[])
    areas = [AreaSpec("90", area)]
    return build_map("turned", edges=[lane], blocks=[block], intersections=[], drivable_areas=areas)


def turned_scene(angle: float) -> Scenario:
    """Three vehicles, a pedestrian beside them and a cone ahead, in the direction `angle`."""
    poses = np.array([(40.0, 0.2, 0.0), (60.0, 0.1, 0.0), (90.0, -0.2, 0.0), (75.0, 2.4, 0.5)])
    poses = np.concatenate([poses, [(140.0, 0.3, 1.0)]])
    tracks = standing_tracks(ROWS, np.c_[turned(poses[:, :2], angle), poses[:, 2] + angle], TURNED)
    tracks.velocities[:] += 4.0 * np.array([np.cos(angle), np.sin(angle)])
    start = (10.0 * np.cos(angle), 10.0 * np.sin(angle), angle)
    return cruise_scenario(speed=0.0, tracks=tracks, road=turned_road(angle), start=start)


@pytest.mark.parametrize("angle", [0.3, 1.5, -2.2])
def test_turning_the_world_turns_the_agents(angle: float) -> None:
    here, there = drive(turned_scene(0.0)), drive(turned_scene(angle))

    np.testing.assert_array_equal(here.valid, there.valid)
    moved = turned(here.poses[..., :2], angle)
    np.testing.assert_allclose(there.poses[..., :2], moved, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*there.velocities.T), np.hypot(*here.velocities.T))


def test_start_on_a_baseline_too_short_for_a_path_fails_the_scenario() -> None:
    scenario = scene([(40.0, 0.0, 0.0)], [VEHICLE])
    scenario = replace(scenario, map=turned_road(0.0, spacing=300.0))

    with pytest.raises(TrafficError, match="baseline of 1"):
        drive(scenario, steps=1)


def test_agent_outside_of_its_own_corridor_fails_the_scenario() -> None:
    scenario = scene([(250.0, 0.0, 0.0)], [VEHICLE])
    scenario = replace(scenario, map=turned_road(0.0, spacing=100.0))
    scenario = replace(scenario, ego=scenario.ego + np.eye(11)[0] * 200.0)

    with pytest.raises(TrafficError, match="outside of its own path at iteration 1"):
        drive(scenario, steps=1)


@given(st.permutations([3, 4, 5, 6]))
def test_order_of_replayed_objects_does_not_matter(order: list[int]) -> None:
    poses = [*CROWD, (110.0, 1.0, 0.0), (112.0, -1.5, 0.4)]
    kinds = [*CROWD_KINDS, PEDESTRIAN, AgentKind.BARRIER]
    shuffled = [0, 1, 2, *order]

    usual = drive(scene(poses, kinds, speed=4.0))
    other = drive(scene([poses[i] for i in shuffled], [kinds[i] for i in shuffled], speed=4.0))

    np.testing.assert_array_equal(usual.poses[:, :3], other.poses[:, :3])


@pytest.mark.parametrize(("side", "lead_speed"), [(1.5, 5.0), (-1.5, 0.0)])
def test_of_ego_and_pedestrian_the_lower_one_leads(side: float, lead_speed: float) -> None:
    """Both come to touch a slow agent in its second step, the ego at 5 m/s."""
    base = scene([(40.0, 0.0, 0.0), (143.9, side, 0.0)], [VEHICLE, PEDESTRIAN], speed=0.5)
    first, second = base.iteration_rows[1:3]
    poses, ego = base.tracks.poses.copy(), base.ego.copy()
    poses[second:, 1, 0] -= 100.0
    ego[first:, [0, 1, 3]] = 40.0 - 1.461, -side, 5.0

    tracks = drive(replace(base, ego=ego, tracks=replace(base.tracks, poses=poses)), steps=2)

    before, after = tracks.velocities[1:3, 0, 0]
    closing = before * (before - lead_speed) / (2.0 * np.sqrt(2.0))
    accel = 1.0 - (before / 15.0) ** 4 - (1.0 + 1.5 * before + closing) ** 2
    assert after == pytest.approx(before + 0.1 * max(accel, -2.0), abs=1e-6)


def test_of_two_that_an_agent_touches_the_lower_one_in_y_leads() -> None:
    """nuPlan rule 131; whole scenes are compared by tests/parity."""
    assert comes_first(0.0, 3.0, 0.0, 4.0)
    assert not comes_first(0.0, 4.0, 0.0, 3.0)
    assert comes_first(1.0, 4.0, 2.0, 3.0)  # elsewhere the nearer one leads
    assert not comes_first(1.0, 3.0, 1.0, 4.0)  # the first one on ties
