"""How hard an edit is to avoid, found by driving."""

import numpy as np
import pytest
from stores import write_toy_store
from worlds import cruise_scenario

from shiftsim.data import open_store
from shiftsim.data.store.reading import ScenarioStore
from shiftsim.edits.sampling import GRADES, HARDEST, KINDS, sample_edits
from shiftsim.planners.basic import LogFuture
from shiftsim.runs.avoidable import Braking, grade, hits, is_avoidable
from shiftsim.runs.edited import EditedStore, make_edits
from shiftsim.sim.loop import simulate
from shiftsim.world.state import VX, X

SPEED = 10.0  # m/s


@pytest.fixture(scope="module")
def recorded():
    return cruise_scenario(speed=SPEED)


def parked(scenario, ahead):
    return scenario.edited(spawn={"at": {"ahead_m": ahead}, "behavior": "stopped"})


def free_gap(ahead):
    return ahead - 2.3 - 5.176 / 2.0  # between front and rear bumper [m]


def test_braking_stops_where_an_even_deceleration_does(recorded):
    log = simulate(parked(recorded, 150.0), Braking(recorded, 2.0))
    driven = log.ego[-1, X] - log.ego[0, X]
    # half a second of reaction, then v^2 / 2a; tracker and motion model are late by some 0.2 s
    assert driven == pytest.approx(0.5 * SPEED + SPEED**2 / 4.0 + 0.2 * SPEED, abs=1.0)
    assert log.ego[-1, VX] == pytest.approx(0.0, abs=0.05)
    steady = log.ego[15:40, VX]
    assert np.diff(steady).mean() / 0.1 == pytest.approx(-2.0, abs=0.1)


def test_without_braking_it_drives_what_was_recorded(recorded):
    ours, theirs = (simulate(recorded, p) for p in (Braking(recorded, 0.0), LogFuture()))
    assert ours.ego[:, :3] == pytest.approx(theirs.ego[:, :3], abs=0.05)


@pytest.mark.parametrize(("needed", "name"), [(0.7, "easy"), (1.5, "medium"), (3.0, "hard")])
def test_the_grade_is_the_braking_that_is_needed(recorded, needed, name):
    ahead = 2.3 + 5.176 / 2.0 + 0.5 * SPEED + SPEED**2 / (2.0 * needed) + 2.0
    assert grade(parked(recorded, ahead)) == name
    assert is_avoidable(parked(recorded, ahead))


def test_what_nobody_can_avoid_or_nobody_meets_has_no_grade(recorded):
    close = parked(recorded, 9.0)  # 4 m before the front, at 10 m/s
    assert hits(close, Braking(recorded, HARDEST)) == {"edited.vehicle0"}
    assert grade(close) == ""
    assert not is_avoidable(close)
    beside = recorded.edited(spawn={"at": {"ahead_m": 40.0, "left_m": 3.5}, "behavior": "stopped"})
    assert grade(beside) == ""
    assert is_avoidable(beside)


def test_a_pedestrian_is_noticed_when_it_sets_off(recorded):
    walk = {"from": {"ahead_m": 60, "left_m": -4}, "to": {"ahead_m": 60, "left_m": 4}}
    walk |= {"ego_within_m": 25.0, "speed_mps": 1.6}
    edited = recorded.edited(walk=walk)
    log = simulate(edited, Braking(edited, 3.0))
    braking = int(np.flatnonzero(log.ego[:, VX] < SPEED - 0.2)[0])
    walks = np.hypot(*log.tracks.velocities[:, 0].T) > 0.1
    assert int(np.flatnonzero(walks)[0]) + 5 <= braking <= int(np.flatnonzero(walks)[0]) + 9
    assert hits(edited, Braking(edited, 0.0)) == {"edited.pedestrian0"}
    assert not hits(edited, Braking(edited, HARDEST))


def test_what_the_recorded_driver_hits_anyway_is_not_in_the_way(tmp_path):
    scenario = ScenarioStore(write_toy_store(tmp_path / "toy", iterations=120)).read("0001cafe")
    assert hits(scenario, Braking(scenario, 0.0))  # a parked car of the recording
    aside = scenario.edited(spawn={"at": {"ahead_m": 20.0, "left_m": 6.0}, "behavior": "stopped"})
    assert grade(aside) == ""


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_sampled_edits_of_the_demo_are_valid_free_and_avoidable(kind):
    store = open_store("demo")
    tables = list(sample_edits(kind, 30, 7, store.tokens, store.read, grade))
    edited = EditedStore(store, make_edits({"edit": tables}, "sampled"))
    assert len(edited.tokens) == 30
    for token in edited.tokens:
        scenario = edited.read(token)
        assert scenario.scenario_type.rpartition("_")[2] in GRADES
        assert is_avoidable(scenario)
