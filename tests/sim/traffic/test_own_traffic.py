"""Traffic models of one's own, and mixtures of policies."""

import sys
from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.errors import ConfigError
from shiftsim.sim.traffic import LogReplay, Traffic, make_traffic
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.sim.traffic.mixed import ConstantVelocity, Mixed
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind, Tracks

VEHICLE, PEDESTRIAN = AgentKind.VEHICLE, AgentKind.PEDESTRIAN
BICYCLE, CONE = AgentKind.BICYCLE, AgentKind.TRAFFIC_CONE
KINDS = [VEHICLE, VEHICLE, PEDESTRIAN, BICYCLE, CONE]
POSES = [(40.0, 0.0, 0.0), (80.0, 3.5, 0.0), (60.0, 8.0, 1.0), (30.0, 3.5, 0.2), (120.0, 1.0, 0.0)]
ROWS = 60 + 2 * 150 + 1 + 160  # of a cruise scenario


@pytest.fixture
def scenario() -> Scenario:
    """Two vehicles, a pedestrian, a bicycle and a cone; agents are recorded standing, at 2 m/s."""
    tracks = standing_tracks(ROWS, np.array(POSES), KINDS)
    tracks.velocities[:, :4] = 2.0, 0.5
    return cruise_scenario(tracks=tracks)


def drive(scenario: Scenario, model: Traffic, steps: int = 40) -> Tracks:
    tracks = scenario.tracks.rows(scenario.iteration_rows)
    model.start(scenario, tracks, 0)
    for iteration in range(steps):
        model.step(iteration, scenario.expert[iteration], tracks, iteration + 1)
    return tracks


def test_constant_velocity_moves_agents_straight_on(scenario: Scenario) -> None:
    velocities = scenario.tracks.velocities.copy()
    velocities[scenario.iteration_rows[1] :, :4] = 9.0  # of the recording, which no longer counts
    sizes = scenario.tracks.sizes.copy()
    sizes[scenario.iteration_rows[1] :, :4] = 9.0  # nor do these
    changed = replace(scenario.tracks, velocities=velocities, sizes=sizes)
    scenario = replace(scenario, tracks=changed)

    tracks = drive(scenario, make_traffic("constant-velocity"))

    np.testing.assert_array_equal(tracks.sizes[40, :4], np.tile([4.5, 2.0], (4, 1)))

    # 4 s at (2, 0.5) m/s
    np.testing.assert_allclose(tracks.poses[40, :4], np.add(POSES[:4], [8.0, 2.0, 0.0]))
    np.testing.assert_array_equal(tracks.poses[40, 4], POSES[4])
    np.testing.assert_array_equal(tracks.velocities[40, 0], [2.0, 0.5])


def test_constant_velocity_keeps_who_leaves_and_takes_in_who_comes(scenario: Scenario) -> None:
    rows = scenario.iteration_rows
    valid = scenario.tracks.valid.copy()
    valid[rows[10] :, 0] = False
    valid[: rows[10], 1] = False
    scenario = replace(scenario, tracks=replace(scenario.tracks, valid=valid))

    tracks = drive(scenario, ConstantVelocity())

    assert tracks.valid[:41, 0].all()
    assert tracks.poses[40, 0, 0] == pytest.approx(POSES[0][0] + 8.0)
    assert not tracks.valid[:10, 1].any()
    assert tracks.poses[40, 1, 0] == pytest.approx(POSES[1][0] + 6.0)


def test_every_track_follows_the_first_policy_that_claims_it(scenario: Scenario) -> None:
    model = Mixed(
        (lambda tracks: np.array(tracks.tokens) == tracks.tokens[1], LogReplay()),
        ([PEDESTRIAN, VEHICLE], ConstantVelocity()),
    )

    moved = drive(scenario, model).poses[40, :, 0] - np.array(POSES)[:, 0]

    np.testing.assert_allclose(moved, [8.0, 0.0, 8.0, 0.0, 0.0])


def test_a_mixture_without_policies_is_the_recording(scenario: Scenario) -> None:
    tracks = drive(scenario, Mixed())

    np.testing.assert_array_equal(tracks.poses, scenario.tracks.poses[scenario.iteration_rows])


def test_idm_for_all_and_idm_for_all_tracks_are_the_same(scenario: Scenario) -> None:
    alone, mixed = drive(scenario, IdmTraffic()), drive(scenario, Mixed((KINDS, IdmTraffic())))

    for name in ("valid", "poses", "velocities", "sizes"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(mixed, name))


def test_idm_agents_react_to_what_other_policies_move(scenario: Scenario) -> None:
    class Block:
        """A bicycle that is put in front of the first vehicle."""

        def start(self, scenario, tracks, row, own) -> None:
            self.own = own

        def step(self, iteration, ego, tracks, row) -> None:
            tracks.poses[row, self.own] = 50.0, 0.0, 0.0

    free = drive(scenario, Mixed(([VEHICLE], IdmTraffic())))
    blocked = drive(scenario, Mixed(([BICYCLE], Block()), ([VEHICLE], IdmTraffic())))

    assert blocked.valid[:41, 3].all()
    assert blocked.poses[40, 0, 0] < 50.0 - 4.5
    assert free.poses[40, 0, 0] > blocked.poses[40, 0, 0] + 1.0


def test_a_rule_that_is_no_mask_is_named(scenario: Scenario) -> None:
    with pytest.raises(ConfigError, match="rule for LogReplay returned an array of shape"):
        drive(scenario, Mixed((lambda tracks: [True], LogReplay())))


def test_kinds_are_no_texts() -> None:
    kinds: Any = ["car"]
    with pytest.raises(ConfigError, match="tracks of LogReplay are of no kind: 'car'"):
        Mixed((kinds, LogReplay()))


def test_wrong_names_say_what_there_is() -> None:
    with pytest.raises(ConfigError, match="traffic 'idm' unknown") as caught:
        make_traffic("idm")
    assert "constant-velocity" in str(caught.value.hint)
    with pytest.raises(ConfigError, match="'pathlib:Path' has no method 'start'"):
        make_traffic("pathlib:Path")


class OnDevice(LogReplay):
    """Traffic that says where its network is."""

    def __init__(self, device="nowhere"):
        self.device = device


def test_a_model_with_a_parameter_for_it_is_given_the_device(monkeypatch) -> None:
    module = ModuleType("my_network")
    module.OnDevice, module.LogReplay = OnDevice, LogReplay
    monkeypatch.setitem(sys.modules, "my_network", module)
    assert make_traffic("my_network:OnDevice", "cuda").device == "cuda"
    assert make_traffic("my_network:OnDevice").device == "nowhere"
    assert isinstance(make_traffic("my_network:LogReplay", "cuda"), LogReplay)
