from dataclasses import replace

import numpy as np
import pytest
from plans import recorded_inputs
from worlds import cruise_scenario

from shiftsim.errors import ConfigError, DataError, PlannerError
from shiftsim.planners.contract import check_planner
from shiftsim.planners.registry import load_planner
from shiftsim.sim.planner import observe_log, scene_info
from shiftsim.world.state import AX, VX, VY, Command

T0 = 1_600_000_000_000_000 + 60 * 50_000  # iteration 0 of the toy scenario [us]


def plan_at(name, scenario, iteration=0, ego=None, arguments=None):
    planner = load_planner(name, arguments)
    planner.reset(scene_info(scenario, planner=planner))
    state = scenario.expert[iteration] if ego is None else ego
    return planner.plan(observe_log(scenario, iteration, ego=state, samples=1))


def test_constant_velocity_is_20_m_further_after_two_seconds_at_10_m_per_s():
    plan = plan_at("constant-velocity", cruise_scenario(speed=10.0))
    np.testing.assert_allclose(plan.states[20, :3], [30.0, 0.0, 0.0], rtol=0, atol=1e-12)
    assert plan.relative
    assert plan.time_us[20] == 2_000_000


def test_log_future_takes_every_tenth_row_from_the_present_one():
    scenario = cruise_scenario()
    plan = plan_at("log-future", scenario, 5)
    np.testing.assert_array_equal(plan.time_us, scenario.time_us[70:231:10])
    np.testing.assert_array_equal(plan.states, scenario.ego[70:231:10])


def test_log_future_leaves_out_what_was_not_recorded():
    scenario = cruise_scenario(iterations=11, future_rows=34)
    assert len(plan_at("log-future", scenario, 10).time_us) == 4


def test_log_future_repeats_its_last_plan_where_the_recording_ends():
    scenario = cruise_scenario(iterations=11, future_rows=4)
    planner = load_planner("log-future")
    planner.reset(scene_info(scenario, planner=planner))
    last = [
        planner.plan(observe_log(scenario, i, ego=scenario.expert[i], samples=1)) for i in range(10)
    ]
    assert len(last[7].time_us) == 2  # iteration 7 is row 74, the last row is 84
    assert last[9] is last[7]
    planner.reset(scene_info(scenario, planner=planner))
    with pytest.raises(PlannerError, match=r"no recorded state 0\.5 s after iteration 9"):
        planner.plan(observe_log(scenario, 9, ego=scenario.expert[9], samples=1))


def test_simple_keeps_a_speed_below_its_limit():
    plan = plan_at("simple", cruise_scenario(speed=4.0))
    assert len(plan.time_us) == 41
    np.testing.assert_allclose(plan.states[:, 0], 10.0 + np.arange(41), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(plan.states[:, VX], 4.0)


def test_simple_loses_a_quarter_of_its_excess_speed_per_step():
    plan = plan_at("simple", cruise_scenario(speed=9.0))
    np.testing.assert_allclose(plan.states[:4, VX], [9.0, 8.0, 7.25, 6.6875], rtol=0, atol=1e-12)
    np.testing.assert_allclose(plan.states[:3, AX], [0.0, -4.0, -3.0], rtol=0, atol=1e-12)


def test_simple_counts_sideways_speed_once_and_forgets_acceleration_and_steering():
    ego = cruise_scenario().expert[0].copy()
    ego[VX], ego[VY], ego[AX], ego[7] = 4.0, 3.5, 1.0, 0.2
    plan = plan_at("simple", cruise_scenario(), ego=ego)
    assert plan.states[0, VY] == 3.5
    assert plan.states[0, AX] == 0.0
    assert plan.states[1, AX] == pytest.approx(5.0 - np.hypot(4.0, 3.5))
    assert (plan.states[:, 7] == 0.0).all()
    assert (plan.states[1:, VY] == 0.0).all()


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "scripts.csv"
    rows = ["scene,planner,time_us,x,y,heading,vx"]
    rows += [f"toy,scripted_a,{T0 + 100_000 * i},{i},0.0,0.0,10" for i in range(200)]
    rows += [f"toy,b,{T0 + 100_000 * i},{-i},0.0,0.0,10" for i in range(5)]
    path.write_text("\n".join(rows))
    return path


def test_scripted_starts_at_the_last_sample_that_is_not_after_the_present(script):
    scenario = cruise_scenario()
    late = scenario.time_us.copy()
    late[60:] += 300  # iteration 7 is 0.3 ms after sample 7
    plan = plan_at(
        "scripted", replace(scenario, time_us=late), 7, None, {"file": script, "name": "a"}
    )
    assert plan.time_us[0] == T0 + 700_000
    np.testing.assert_array_equal(plan.states[:, 0], np.arange(7, 88))
    assert (plan.states[:, VX] == 10).all()


def test_scripted_names_are_found_with_and_without_their_prefix_and_by_token(script):
    text = script.read_text().replace("toy,b", "0123456789abcdef,b")
    script.write_text(text)
    for name in ("a", "scripted_a", "b"):
        assert plan_at("scripted", cruise_scenario(), 0, None, {"file": script, "name": name})


@pytest.mark.parametrize(
    ("edit", "name", "error", "message"),
    [
        (lambda t: t, "c", ConfigError, "no script 'c' for scenario"),
        (lambda t: t, "", ConfigError, "no single script"),
        (lambda t: t.replace("heading", "yaw"), "a", DataError, "column 'heading' is missing"),
        (lambda t: t.replace("a,", "a,7", 1), "a", PlannerError, "sequence starts at"),
        (lambda t: t.replace(",0.0,0.0,10", ",nan,0.0,10"), "a", DataError, "column 'y' has"),
        (lambda t: t + "\n" + t.splitlines()[1], "a", DataError, "a time occurs twice"),
    ],
)
def test_a_script_that_cannot_be_driven_says_why(script, edit, name, error, message):
    text = edit(script.read_text())
    if message.startswith("sequence"):
        text = "\n".join(
            line for line in text.splitlines() if f",{T0}," not in line and ",7" not in line
        )
    script.write_text(text)
    with pytest.raises(error, match=message):
        plan_at("scripted", cruise_scenario(), 0, None, {"file": script, "name": name})


def test_a_script_in_no_known_format_is_named(tmp_path):
    (tmp_path / "x.parquet").write_text("not parquet")
    with pytest.raises(DataError, match=r"x\.parquet: not a readable"):
        load_planner("scripted", {"file": tmp_path / "x.parquet"})


@pytest.mark.parametrize("name", ["constant-velocity", "log-future", "simple", "idm"])
def test_our_own_planners_obey_the_contract(name):
    findings = check_planner(load_planner(name), cruise_scenario())
    assert [f.check for f in findings] == ["run time"], findings


class Coast:
    def reset(self, scene): ...

    def plan(self, observation):
        return Command(0.0, 0.0)


def test_a_planner_that_returns_commands_obeys_the_contract():
    findings = check_planner(Coast, cruise_scenario())
    assert [f.check for f in findings] == ["run time"]


def test_inputs_of_the_contract_check_cannot_be_written():
    scene, observations = recorded_inputs(cruise_scenario())
    assert len(observations[0].history.time_us) == 22
    with pytest.raises(ValueError, match="read-only"):
        observations[3].history.ego[0, 0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        scene.goal[0] = 1.0
