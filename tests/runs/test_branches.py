"""Branches: plans driven from a snapshot, as without one, and what they are worth."""

import pickle

import numpy as np
import pytest

import shiftsim
from shiftsim.errors import ConfigError, DataError
from shiftsim.planners.basic import ConstantVelocity
from shiftsim.sim.loop import Rollout
from shiftsim.world.state import NUM_STATE, Trajectory

STEPS, AT = 40, 30


@pytest.fixture(scope="module")
def scenario():
    return shiftsim.open_store("demo")["01f13e"]


def rollout_at(scenario, iteration, **setting):
    rollout = Rollout(scenario, shiftsim.load_planner("idm"), **setting)
    while rollout.iteration < iteration:
        rollout.advance(rollout.planner.plan(rollout.observe()))
    return rollout


def plans_at(speed, turns, count=80, spacing=0.1):
    """(K, H, 3) arcs at a speed, with yaw rates."""
    times = spacing * np.arange(1, count + 1)
    heading = np.outer(turns, times)
    step = speed * spacing
    x, y = np.cumsum(step * np.cos(heading), axis=1), np.cumsum(step * np.sin(heading), axis=1)
    return np.stack([x, y, heading], axis=-1)


def absolute(plan, rollout, spacing=0.1):
    """The same as a trajectory in log time."""
    from shiftsim.geometry.boxes import from_frame

    observation = rollout.observe()
    ego = observation.history.ego[-1]
    states = np.zeros((len(plan) + 1, NUM_STATE))
    states[0, :3], states[1:, :3] = ego[:3], from_frame(plan, ego[:3])
    steps = np.rint(1e6 * spacing * np.arange(len(plan) + 1)).astype(np.int64)
    return Trajectory(observation.time_us + steps, states)


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive", "constant-velocity", "learned"])
def test_a_branch_is_what_a_rollout_drives_without_a_snapshot(scenario, traffic):
    setting = {"traffic": traffic, "noise": "ou-high", "seed": 1}
    rollout = rollout_at(scenario, AT, **setting)
    plans = plans_at(6.0, [-0.05, 0.0, 0.05])
    found = shiftsim.branch(rollout.snapshot(), plans, STEPS)
    assert found.errors.tolist() == [""] * 3
    for plan, states in zip(plans, found.states, strict=True):
        alone = rollout_at(scenario, AT, **setting)
        fixed = absolute(plan, alone)
        for _ in range(STEPS):
            alone.advance(fixed)
        driven = alone.log().ego[AT : AT + STEPS + 1]
        assert states.tobytes() == driven.tobytes()


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
@pytest.mark.parametrize("latency", [200, 500])
def test_plans_of_a_branch_arrive_late_as_others(scenario, traffic, latency):
    setting = {"traffic": traffic, "latency": latency, "perception": "high"}
    rollout = rollout_at(scenario, AT, **setting)
    plans = plans_at(6.0, [-0.05, 0.05])
    found = shiftsim.branch(rollout.snapshot(), plans, STEPS)
    soon = shiftsim.branch(rollout_at(scenario, AT, traffic=traffic).snapshot(), plans, STEPS)
    assert not np.array_equal(found.states, soon.states)
    for plan, states in zip(plans, found.states, strict=True):
        alone = rollout_at(scenario, AT, **setting)
        fixed = absolute(plan, alone)
        for _ in range(STEPS):
            alone.advance(fixed)
        assert states.tobytes() == alone.log().ego[AT : AT + STEPS + 1].tobytes()
    at_once = latency // 100
    assert np.array_equal(found.states[0, : at_once + 1], found.states[1, : at_once + 1])


def test_errors_of_the_pose_move_no_plan_of_a_branch(scenario):
    states = []
    for localization in ("none", "high"):
        start = rollout_at(scenario, 0, localization=localization).snapshot()
        states.append(shiftsim.branch(start, plans_at(6.0, [0.05]), STEPS).states)
    assert states[0].tobytes() == states[1].tobytes()


@pytest.mark.parametrize(
    ("traffic", "follow", "drift"),
    [
        ("nonreactive", 8, {}),
        ("reactive", 8, {}),
        ("nonreactive", 2, {"latency": 300}),
        ("reactive", 8, {"latency": 300, "perception": "high"}),
    ],
)
def test_a_planner_goes_on_after_the_plan(scenario, traffic, follow, drift):
    rollout = rollout_at(scenario, AT, traffic=traffic, **drift)
    plans = plans_at(6.0, [0.0, 0.02], count=10)
    found = shiftsim.branch(rollout.snapshot(), plans, STEPS, follow=follow, planner="pdm-closed")
    for plan, states in zip(plans, found.states, strict=True):
        alone = rollout_at(scenario, AT, traffic=traffic, **drift)
        fixed = absolute(plan, alone)
        for _ in range(follow):
            alone.advance(fixed)
        alone.drive_by(shiftsim.load_planner("pdm-closed"))
        for _ in range(STEPS - follow):
            alone.advance(alone.planner.plan(alone.observe()))
        assert states.tobytes() == alone.log().ego[AT : AT + STEPS + 1].tobytes()


def test_batches_are_what_one_snapshot_gives(scenario):
    store = shiftsim.open_store("demo")
    snapshots = [rollout_at(scenario, at, traffic="reactive").snapshot() for at in (5, 20)]
    plans = np.stack([plans_at(5.0, [0.0, 0.1]), plans_at(8.0, [0.0, -0.1])])
    sent = [pickle.loads(pickle.dumps(one)) for one in snapshots]
    with pytest.raises(DataError, match="without its scenario"):
        shiftsim.branch(sent, plans, STEPS)
    found = shiftsim.branch(sent, plans, STEPS, store=store)
    assert found.states.shape == (2, 2, STEPS + 1, NUM_STATE)
    for number, one in enumerate(snapshots):
        alone = shiftsim.branch(one, plans[number], STEPS)
        np.testing.assert_array_equal(found.states[number], alone.states)
        for name, values in alone.parts.items():
            np.testing.assert_array_equal(found.parts[name][number], values)
        for name, values in alone.first.items():
            np.testing.assert_array_equal(found.first[name][number], values)


def test_who_leaves_the_road_is_told_when(scenario):
    rollout = rollout_at(scenario, 0)
    found = shiftsim.branch(rollout.snapshot(), plans_at(8.0, [0.0, 0.3]), STEPS)
    assert found.parts["drivable_area_compliance"].tolist()[1] == 0.0
    step = found.first["drivable_area_compliance"][1]
    assert 0 < step < STEPS
    short = shiftsim.branch(rollout.snapshot(), plans_at(8.0, [0.3]), int(step) - 1)
    assert short.parts["drivable_area_compliance"].tolist() == [1.0]
    assert set(found.first) < set(found.parts)
    assert repr(found) == f"<Branches: (2,), {STEPS} steps each>"


def test_what_cannot_be_driven_is_refused(scenario):
    snapshot = rollout_at(scenario, 3).snapshot()
    plans = plans_at(5.0, [0.0], count=20)
    with pytest.raises(ConfigError, match="too short for 40 steps"):
        shiftsim.branch(snapshot, plans, STEPS)
    with pytest.raises(ConfigError, match="must be finite"):
        shiftsim.branch(snapshot, plans[0], 10)
    with pytest.raises(DataError, match="has 145 left"):
        shiftsim.branch(snapshot, plans_at(5.0, [0.0], count=200), 180)
    with pytest.raises(ConfigError, match="2 snapshots"):
        shiftsim.branch([snapshot, snapshot], plans[None], 10)
    perfect = Rollout(scenario, ConstantVelocity(), controller="perfect").snapshot()
    with pytest.raises(ConfigError, match="controller 'lqr'"):
        shiftsim.branch(perfect, plans, 10)
