"""Snapshots of rollouts: where others go on from, byte for byte."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest

import shiftsim
from shiftsim.errors import DataError
from shiftsim.planners.basic import ConstantVelocity as ConstantVelocityPlanner
from shiftsim.sim.loop import Rollout, drive
from shiftsim.sim.traffic.mixed import ConstantVelocity
from shiftsim.world.state import Command

TRAFFIC = ("nonreactive", "reactive", "constant-velocity", "learned")
DRIFTS = (
    {"perception": "high+miss-high+dropout-high"},
    {"localization": "high"},
    {"latency": 300},
    {"perception": "mid", "localization": "mid", "latency": 200},
)
PARTS = ("ego", "commands", "noise", "degraded")


@pytest.fixture(scope="module")
def scenario():
    return shiftsim.open_store("demo")["01f13e"]


def run_to(rollout, iteration):
    while rollout.iteration < iteration:
        rollout.advance(rollout.planner.plan(rollout.observe()))
    return rollout


def assert_same(log, other):
    for name in PARTS:
        assert getattr(log, name).tobytes() == getattr(other, name).tobytes(), name
    for name in ("valid", "poses", "velocities", "sizes"):
        ours, theirs = getattr(log.tracks, name), getattr(other.tracks, name)
        assert ours.tobytes() == theirs.tobytes(), name


@pytest.mark.parametrize("traffic", TRAFFIC)
@pytest.mark.parametrize("iteration", [0, 40, 147])
def test_a_rollout_goes_on_from_a_snapshot_with_the_same_bytes(scenario, traffic, iteration):
    setting = {"traffic": traffic, "noise": "ou-high", "seed": 3}
    rollout = Rollout(scenario, shiftsim.load_planner("idm"), **setting)
    snapshot = pickle.loads(pickle.dumps(run_to(rollout, iteration).snapshot()))
    whole = drive(rollout)
    other = Rollout(scenario, shiftsim.load_planner("idm"), snapshot.setting)
    other.resume(snapshot)
    assert_same(drive(other), whole)


def test_a_snapshot_stays_while_its_rollout_goes_on(scenario):
    rollout = run_to(Rollout(scenario, shiftsim.load_planner("idm")), 9)
    snapshot, other = rollout.snapshot(), rollout.snapshot()
    before = pickle.dumps(snapshot)
    assert {snapshot, other, copy.deepcopy(snapshot), pickle.loads(before)} == {snapshot}
    run_to(rollout, 20)
    assert pickle.dumps(snapshot) == before
    assert snapshot.iteration == 9
    assert snapshot != rollout.snapshot()
    assert repr(snapshot) == f"<Snapshot of {scenario.token} at iteration 9>"


def test_a_snapshot_is_small_also_at_the_end(scenario):
    rollout = run_to(Rollout(scenario, shiftsim.load_planner("idm"), traffic="reactive"), 148)
    assert len(pickle.dumps(rollout.snapshot())) <= 20_000


def test_models_of_ones_own_stand_in_it_by_name(scenario):
    rollout = Rollout(scenario, shiftsim.load_planner("idm"), traffic=ConstantVelocity())
    assert rollout.snapshot().setting.traffic == "ConstantVelocity"


def test_what_does_not_fit_is_refused(scenario):
    rollout = Rollout(scenario, shiftsim.load_planner("constant-velocity"))
    drive(rollout)
    with pytest.raises(DataError, match="has ended"):
        rollout.snapshot()
    store = shiftsim.open_store("demo")
    other = Rollout(store.read(store.tokens[0]), shiftsim.load_planner("idm"))
    assert other.scenario.token != scenario.token
    fresh = Rollout(scenario, shiftsim.load_planner("idm"))
    with pytest.raises(DataError, match="is none of scenario"):
        fresh.resume(other.snapshot())


def test_views_show_the_noise_of_the_whole_rollout(scenario):
    rollout = Rollout(scenario, shiftsim.load_planner("idm"), noise="ou-high", seed=2)
    assert np.abs(rollout.log().noise).max() > 0.0


@pytest.mark.parametrize("traffic", ["nonreactive", "reactive"])
@pytest.mark.parametrize("drift", DRIFTS)
@pytest.mark.parametrize("iteration", [0, 40])
def test_what_is_seen_and_plans_under_way_go_on_with_the_same_bytes(
    scenario, traffic, drift, iteration
):
    setting = {"traffic": traffic, "noise": "ou-low", "seed": 3, **drift}
    rollout = Rollout(scenario, shiftsim.load_planner("idm"), **setting)
    snapshot = pickle.loads(pickle.dumps(run_to(rollout, iteration).snapshot()))
    assert {snapshot, rollout.snapshot()} == {snapshot}
    fork = rollout.fork()
    fork.drive_by(shiftsim.load_planner("idm"))
    other = Rollout(scenario, shiftsim.load_planner("idm"), snapshot.setting)
    other.resume(snapshot)
    whole = drive(rollout)
    for one in (fork, other):
        log = drive(one)
        assert_same(log, whole)
        if whole.seen is not None:
            assert log.seen.ego.tobytes() == whole.seen.ego.tobytes()
            assert log.seen.tracks.poses.tobytes() == whole.seen.tracks.poses.tobytes()


def test_plans_under_way_are_part_of_a_snapshot(scenario):
    rollout = run_to(Rollout(scenario, ConstantVelocityPlanner(), latency=200), 5)
    snapshot = rollout.snapshot()
    assert len(snapshot.plans) == 2
    assert snapshot != replace(snapshot, plans=snapshot.plans[::-1])
    sent = replace(snapshot, plans=(Command(1.0, 0.0), Command(0.0, 0.1)))
    assert sent != replace(snapshot, plans=(Command(1.0, 0.0), Command(0.0, 0.2)))
    assert sent == pickle.loads(pickle.dumps(sent))
    with pytest.raises(DataError, match="has 0 plans under way"):
        Rollout(scenario, ConstantVelocityPlanner(), latency=200).resume(
            rollout.log().snapshot(5, rollout.setting)
        )


def test_a_fork_observes_the_truth_until_a_planner_drives_it(scenario):
    rollout = run_to(Rollout(scenario, ConstantVelocityPlanner(), localization="high"), 5)
    fork = rollout.fork()
    assert fork.observe().ego.x == fork.log().ego[5, 0] != rollout.observe().ego.x
    fork.drive_by(ConstantVelocityPlanner())
    assert fork.observe().ego.x == rollout.observe().ego.x
