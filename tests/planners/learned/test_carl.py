"""CaRL's picture and commands on small worlds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import cruise_scenario, standing_tracks, straight_road, with_velocities

from shiftsim.errors import CheckpointError, PlannerError
from shiftsim.planners.learned.carl import view as carl_view
from shiftsim.planners.learned.carl.planner import Carl, command_of
from shiftsim.sim.loop import Rollout, simulate, simulate_together
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.state import AgentKind, Command, LightStatus, TrafficLights

pytest.importorskip("torch")
pytestmark = pytest.mark.learned

NUM_ROWS = 60 + 2 * 150 + 1 + 160  # of `cruise_scenario`
VEHICLE, PEDESTRIAN, BICYCLE, CONE = (
    *(AgentKind.VEHICLE, AgentKind.PEDESTRIAN),
    *(AgentKind.BICYCLE, AgentKind.TRAFFIC_CONE),
)
EGO_ROW, EGO_COLUMN = 128, 100  # centre of the ego


@pytest.fixture(scope="module")
def planner():
    return Carl("deterministic:drive")


def look(planner, scenario, lights=None, ego=None):
    """The picture of the first iteration, and the measurements."""
    planner.reset(scene_info(scenario))
    seen = observe_log(scenario, 0, ego=scenario.expert[0] if ego is None else ego, samples=1)
    seen = seen if lights is None else replace(seen, lights=lights)
    features = planner.features(seen)
    return features.pictures.copy(), features.measurements, seen


def scenario_with(poses, kinds, **options):
    tracks = standing_tracks(NUM_ROWS, np.array(poses, float).reshape(-1, 3), kinds)
    return cruise_scenario(tracks=tracks, **options)


def lights_of(**status):
    names = tuple(name.removeprefix("c") for name in status)
    return TrafficLights(names, np.array([list(status.values())], np.int8))


def test_the_road_lies_ahead_and_what_is_left_has_the_higher_rows(planner):
    picture, _, _ = look(planner, cruise_scenario(start=(100.0, 0.0, 0.0)))
    road = picture[carl_view.DRIVABLE]
    # the right lane's middle is the ego's: the road reaches 1.75 m right and 5.25 m left of it
    rows = np.flatnonzero(road[:, 200])
    assert (rows[0], rows[-1]) == (EGO_ROW - 4, EGO_ROW + 10)  # cut
    assert (road[EGO_ROW] == 255).all()
    assert set(np.unique(picture[carl_view.BOUNDARIES]).tolist()) == {0, 255}
    assert not picture[4].any()


def test_the_ego_is_drawn_about_its_centre_with_its_speed(planner):
    picture, _, _ = look(planner, cruise_scenario(speed=15.0))
    ego = picture[carl_view.EGO]
    assert ego[EGO_ROW, EGO_COLUMN] == int(127.5 * 0.5 + 127.5)
    rows, columns = np.nonzero(ego)
    assert (columns.min(), columns.max()) == (94, 105)  # 5.176 m long
    assert (rows.min(), rows.max()) == (125, 130)  # 2.297 m wide


def test_objects_have_the_channel_and_value_of_their_kind(planner):
    poses = [[30.0, 10.0, 0.0], [30.0, 20.0, 0.0], [30.0, 30.0, 0.0], [30.0, 40.0, 0.0]]
    scenario = scenario_with(poses, [VEHICLE, BICYCLE, PEDESTRIAN, CONE], speed=0.0)
    # more than the highest speed of a pedestrian
    scenario = with_velocities(scenario, 2, (3.0, 4.0))
    picture, _, _ = look(planner, scenario, ego=scenario.expert[0])
    column = EGO_COLUMN + round(2 * (30.0 - 10.0 - 1.461))
    values = [
        (channel, int(picture[channel, EGO_ROW + 2 * offset, column]))
        for channel, offset in ((6, 10), (6, 20), (7, 30), (7, 40))
    ]
    assert values == [(6, 127), (6, 127), (7, 255), (7, 127)]


def test_an_object_counts_when_its_centre_is_in_the_picture(planner):
    middle = 10.0 + 1.461 + carl_view.AHEAD
    for distance, seen in ((63.9, True), (64.1, False)):
        picture, _, _ = look(planner, scenario_with([[middle + distance, 0.0, 0.0]], [VEHICLE]))
        assert picture[carl_view.VEHICLES].any() == seen


def test_static_objects_are_drawn_over_pedestrians(planner):
    poses = [[30.0, 10.0, 0.0], [30.0, 10.0, 0.0]]
    scenario = scenario_with(poses, [CONE, PEDESTRIAN])
    scenario = with_velocities(scenario, 1, (4.0, 0.0))
    picture, _, _ = look(planner, scenario)
    assert set(np.unique(picture[carl_view.PEDESTRIANS]).tolist()) == {0, 127}


def test_limits_are_drawn_on_centre_lines_and_a_missing_one_is_the_highest(planner):
    for limit, value in ((15.0, int(127.5 * 0.5 + 127.5)), (None, 255), (0.0, 127)):
        picture, _, _ = look(planner, cruise_scenario(road=straight_road(speed_limit=limit)))
        assert set(np.unique(picture[carl_view.LIMITS]).tolist()) == {0, value}


@pytest.mark.parametrize(("status", "value"), [("GREEN", 80), ("YELLOW", 170), ("RED", 255)])
def test_lights_are_drawn_on_their_connector(planner, status, value):
    lights = lights_of(c20=LightStatus[status], c21=LightStatus.ABSENT)
    picture, _, seen = look(planner, cruise_scenario(start=(180.0, 0.0, 0.0)), lights)
    rows, columns = np.nonzero(picture[carl_view.LIGHTS])
    assert set(picture[carl_view.LIGHTS][rows, columns].tolist()) == {value}
    assert set(rows.tolist()) == {EGO_ROW + 7}  # the left lane's connector, 20 m long
    assert len(columns) == 41
    planner.plan(seen)
    assert planner.degraded == ""


def test_a_light_of_unknown_status_is_not_drawn_and_the_step_counts_as_degraded(planner):
    near, far = cruise_scenario(start=(180.0, 0.0, 0.0)), cruise_scenario()
    for scenario, text in ((near, "a light in the raster has an unknown status"), (far, "")):
        picture, _, seen = look(planner, scenario, lights_of(c20=LightStatus.UNKNOWN))
        assert not picture[carl_view.LIGHTS].any()
        planner.plan(seen)
        assert planner.degraded == text


def test_lights_of_connectors_that_the_map_lacks_are_left_out(planner):
    picture, _, _ = look(planner, cruise_scenario(), lights_of(c999=LightStatus.RED))
    assert not picture[carl_view.LIGHTS].any()


def test_the_route_has_a_channel_of_its_own(planner):
    scenario = replace(cruise_scenario(start=(150.0, 0.0, 0.0)), route=("1",))
    picture, _, _ = look(planner, scenario)
    ends = np.flatnonzero(picture[carl_view.ROUTE][EGO_ROW])
    assert ends[-1] == int(EGO_COLUMN + 2 * (200.0 - 151.461))
    assert picture[carl_view.DRIVABLE][EGO_ROW, -1] == 255


@pytest.mark.parametrize("route", [(), ("x",), ("1", "x")])
def test_a_route_that_the_map_lacks_is_left_out_and_counts_as_degraded(planner, route):
    scenario = replace(cruise_scenario(), route=route)
    log = simulate(replace(scenario, iteration_rows=scenario.iteration_rows[:4]), planner)
    assert log.degraded.all()
    assert np.isfinite(log.ego).all()
    with pytest.raises(PlannerError, match="fell back at iteration 0"):
        simulate(scenario, planner, strict=True)


def test_off_the_map_the_planner_goes_on_and_says_so(planner):
    picture, _, seen = look(planner, cruise_scenario(start=(10.0, 500.0, 0.0)))
    assert not picture[: carl_view.VEHICLES].any()
    command = planner.plan(seen)
    assert np.isfinite([command.acceleration, command.steering_rate]).all()
    assert planner.degraded == "no road within the raster"


def test_the_ego_is_measured_at_its_centre_after_the_last_action(planner):
    ego = np.array([10.0, 0.0, 0.0, 8.0, 0.0, 1.0, 0.0, 0.1, 0.2, 0.3, 0.4])
    scenario = cruise_scenario()
    _, measured, seen = look(planner, scenario, ego=ego)
    shift = 1.461
    expected = [0, 0, 8.0, shift * 0.3, 1.0 + shift * 0.3**2 + shift * 0.4, 0, 0.1, 0.2, 0.3, 0.4]
    np.testing.assert_allclose(measured, expected, rtol=1e-6)
    (action,) = planner.infer([planner.features(seen)])
    planner.decode(action, seen)
    np.testing.assert_array_equal(planner.features(seen).measurements[:2], action)
    planner.reset(scene_info(scenario))
    np.testing.assert_array_equal(planner.features(seen).measurements[:2], 0.0)


def test_an_action_asks_for_an_angle_within_one_step_and_a_bounded_acceleration():
    ego = np.zeros(11)
    ego[3], ego[7] = 10.0, 0.1
    assert command_of(np.array([1.0, 0.5], np.float32), ego) == Command(
        2.4, (0.5 * 0.83775804096 - 0.1) / 0.1
    )
    assert command_of(np.array([-1.0, 0.0], np.float32), ego).acceleration == -3.2
    ego[3], ego[5] = 0.1, -0.4  # full braking would end in reverse
    command = command_of(np.array([-1.0, 0.0], np.float32), ego)
    assert command.acceleration == pytest.approx(-0.1 + 0.75 * 0.4)


@settings(max_examples=10)
@given(st.floats(-3.1, 3.1), st.integers(-2000, 2000), st.integers(-2000, 2000))
def test_moving_the_whole_world_does_not_change_the_picture(planner, heading, dx, dy):
    # odd positions, so that no vertex comes to lie on the border of a pixel
    poses = np.array([[31.23, 7.31, 0.41], [42.17, -9.77, 2.2]])
    pictures = []
    for offset in ((0.0, 0.0), (float(dx), float(dy))):
        moved = poses + np.array([*offset, 0.0])
        start = (17.137 + offset[0], 0.291 + offset[1], heading)
        road = straight_road(offset=offset)
        picture, _, _ = look(planner, scenario_with(moved, [VEHICLE, CONE], road=road, start=start))
        pictures.append(picture)
    assert (pictures[0] != pictures[1]).sum() <= 2


def test_turning_ego_and_objects_turns_nothing_in_the_picture(planner):
    first, _, _ = look(planner, scenario_with([[31.23, 7.31, 0.41]], [VEHICLE]))
    scenario = scenario_with([[-7.31, 31.23, 0.41 + np.pi / 2]], [VEHICLE])
    ego = scenario.expert[0].copy()
    ego[:3] = 0.0, 10.0, np.pi / 2
    second, _, _ = look(planner, scenario, ego=ego)
    for channel in (carl_view.VEHICLES, carl_view.EGO):
        np.testing.assert_array_equal(first[channel], second[channel])
        assert first[channel].any()


@pytest.mark.parametrize("count", [0, 500])
def test_any_number_of_agents_is_driven_with(planner, count, rng):
    poses = np.column_stack([rng.uniform(-20, 90, (count, 2)), rng.uniform(-3, 3, count)])
    kinds = [AgentKind(int(kind)) for kind in rng.integers(0, 7, count)]
    scenario = scenario_with(poses, kinds)
    log = simulate(replace(scenario, iteration_rows=scenario.iteration_rows[:5]), planner)
    assert not log.degraded.any()
    assert np.isfinite(log.commands[:-1]).all()


def test_nothing_is_left_over_from_another_scenario(planner):
    crowded = scenario_with([[30.0, 0.0, 0.0]] * 5, [VEHICLE] * 5, start=(180.0, 0.0, 0.0))
    fresh, measured, _ = look(Carl("deterministic:drive"), cruise_scenario())
    _, _, seen = look(planner, crowded, lights_of(c20=LightStatus.RED))
    planner.plan(seen)
    again, measured_again, _ = look(planner, cruise_scenario())
    np.testing.assert_array_equal(fresh, again)
    np.testing.assert_array_equal(measured, measured_again)


def test_a_plan_before_a_scenario_is_an_error():
    with pytest.raises(PlannerError, match="before reset"):
        Carl("deterministic:base").plan(
            observe_log(cruise_scenario(), 0, ego=np.zeros(11), samples=1)
        )


def some_scenes(rng, count):
    for index in range(count):
        poses = np.column_stack([rng.uniform(-20, 90, (9, 2)), rng.uniform(-3, 3, 9)])
        kinds = [AgentKind(int(kind)) for kind in rng.integers(0, 7, 9)]
        scene = scenario_with(poses, kinds, start=(20.0 * index, 0.1 * index, 0.0))
        rows = scene.iteration_rows[:6]
        yield replace(scene, token=f"{index:016x}", iteration_rows=rows)


def test_scenes_in_one_batch_are_driven_as_alone(planner, rng):
    scenes = list(some_scenes(rng, 6))
    alone = [simulate(scene, planner) for scene in scenes]
    together = simulate_together([Rollout(scene, planner.fork()) for scene in scenes])
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_allclose(other.commands, one.commands, atol=2e-5)
        np.testing.assert_allclose(other.ego, one.ego, atol=2e-5)


def test_actions_of_a_batch_are_those_of_its_scenes(planner, rng):
    features = []
    for scene in some_scenes(rng, 9):
        fork = planner.fork()
        fork.reset(scene_info(scene))
        features.append(fork.features(observe_log(scene, 0, ego=scene.expert[0], samples=1)))
    together = planner.infer(features)
    for one, action in zip(features, together, strict=True):
        np.testing.assert_allclose(action, planner.infer([one])[0], atol=2e-5)


def test_an_ensemble_does_the_mean_of_its_members(tmp_path):
    import torch

    members = [Carl(f"deterministic:{variant}") for variant in ("base", "drive")]
    paths = []
    for number, member in enumerate(members):
        folder = tmp_path / f"policy{number}"
        folder.mkdir()
        paths.append(str(folder / "model_best.pth"))
        torch.save(member.networks[0].state_dict(), paths[-1])
    scenario = cruise_scenario()
    actions = []
    for planner in (*members, Carl(",".join(paths)), Carl(str(tmp_path))):
        planner.reset(scene_info(scenario))
        actions += planner.infer(
            [planner.features(observe_log(scenario, 0, ego=scenario.expert[0], samples=1))]
        )
    np.testing.assert_allclose(actions[2], (actions[0] + actions[1]) / 2, atol=1e-6)
    np.testing.assert_array_equal(actions[2], actions[3])


def test_a_checkpoint_that_is_missing_names_where_it_was_looked_for():
    with pytest.raises(CheckpointError, match="'nowhere'"):
        Carl("nowhere")
