"""What a driver would plan in a scene that was changed, asked of planners that are no networks."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.planners.basic import ConstantVelocity
from shiftsim.planners.idm import Idm
from shiftsim.train.checks import CHECKS, check
from shiftsim.world.state import AgentKind, LightStatus, TrafficLights

OBSTACLE, LEAD, GREEN, BACK = CHECKS


def queue():
    """The ego stands 8 m behind a vehicle."""
    scenario = cruise_scenario(speed=0.0)
    rows = len(scenario.time_us)
    tracks = standing_tracks(rows, np.array([[25.0, 0.0, 0.0]]), [AgentKind.VEHICLE])
    return replace(scenario, tracks=tracks)


def red():
    """The ego stands 4 m before a red light."""
    scenario = cruise_scenario(speed=0.0, start=(192.0, 0.0, 0.0))
    status = np.full((len(scenario.time_us), 1), LightStatus.RED, np.int8)
    return replace(scenario, traffic_lights=TrafficLights(("21",), status))


def found(planner, scenario):
    return {row["check"]: row for row in check(planner, [scenario])}


@pytest.mark.parametrize(
    ("scenario", "name"), [(cruise_scenario(), OBSTACLE), (queue(), LEAD), (red(), GREEN)]
)
def test_who_follows_the_rules_passes_and_who_sees_nothing_does_not(scenario, name):
    careful, blind = found(Idm(), scenario), found(ConstantVelocity(), scenario)
    assert careful[name]["cases"] == blind[name]["cases"] == 8
    assert careful[name]["passed"] == 1.0
    assert blind[name]["passed"] == 0.0
    others = set(CHECKS) - {name, BACK}
    assert all(careful[other]["cases"] == 0 for other in others)
    assert all(np.isnan(careful[other]["passed"]) for other in others)


def test_who_follows_the_lane_comes_back_to_it_and_who_goes_straight_on_does_not():
    scenario = cruise_scenario(iterations=61)
    assert found(Idm(), scenario)[BACK] == {"check": BACK, "cases": 4, "passed": 1.0}
    assert found(ConstantVelocity(), scenario)[BACK]["passed"] == 0.0
