"""From a collision back to where it could be avoided."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import cruise_scenario

from shiftsim.errors import ConfigError
from shiftsim.metrics import compute_metrics
from shiftsim.planners.registry import load_planner
from shiftsim.runs.avoidable import REACTION_US
from shiftsim.sim.loop import simulate
from shiftsim.view.fork import find_fork
from shiftsim.view.scene import ShownRollout

SPEED, AHEAD = 10.0, 60.0  # m/s, m from rear axle to the centre of a parked vehicle
COLLISION = "no_ego_at_fault_collisions"
MANIFEST = {
    "determining": {
        "controller": "lqr",
        "traffic": "nonreactive",
        "planners": {
            name: {"planner": name, "arguments": {}} for name in ("constant-velocity", "idm")
        },
    }
}


@pytest.fixture(scope="module")
def blocked():
    spawn = {"at": {"ahead_m": AHEAD}, "behavior": "stopped"}
    return cruise_scenario(speed=SPEED).edited(spawn=spawn)


@pytest.fixture(scope="module")
def crashed(blocked):
    """A rollout with noise that meets the parked vehicle."""
    log = simulate(blocked, load_planner("constant-velocity"), noise="ou-low", seed=2)
    row = next(row for row in compute_metrics(log, blocked).rows if row.metric == COLLISION)
    hit = {"first_violation_iteration": row.violation.iteration} if row.violation else {}
    metrics = [{"metric": COLLISION, "score": row.score, **hit}]
    return ShownRollout("constant-velocity", "ou-low", 2, log, 0.0, metrics)


def test_the_last_chance_is_as_far_before_as_braking_or_steering_needs(blocked, crashed):
    hit = crashed.metrics[0]["first_violation_iteration"]
    fork = find_fork(blocked, crashed, MANIFEST)

    assert 0 < fork.start < hit
    # braking evenly at 4 m/s^2 needs v^2 / 8 after half a second; PDM-Closed may do with less
    gap = crashed.log.ego[hit, 0] - crashed.log.ego[fork.start, 0]
    speed = crashed.log.ego[fork.start, 3]
    assert gap <= speed * REACTION_US * 1e-6 + speed**2 / 8.0 + 5.0
    names = [branch.name for branch in fork.branches]
    assert names == ["braking", "constant-velocity", "idm", "pdm-closed"]
    hits = {branch.name: branch.hit for branch in fork.branches}
    assert hits["braking"] is None or hits["pdm-closed"] is None


def test_a_planner_that_changes_nothing_repeats_the_collision(blocked, crashed):
    fork = find_fork(blocked, crashed, MANIFEST)
    branch = next(one for one in fork.branches if one.name == "constant-velocity")

    assert branch.hit.iteration == crashed.metrics[0]["first_violation_iteration"]
    driven = crashed.log.ego[fork.start : branch.hit.iteration + 1, :3]
    np.testing.assert_allclose(branch.poses, driven, rtol=0, atol=1e-9)


def test_without_a_collision_there_is_no_fork(blocked, crashed):
    free = replace(crashed, metrics=[{"metric": COLLISION, "first_violation_iteration": None}])
    assert find_fork(blocked, free, MANIFEST) is None


def test_a_controller_without_commands_is_refused(blocked, crashed):
    manifest = {"determining": MANIFEST["determining"] | {"controller": "perfect"}}
    with pytest.raises(ConfigError, match="repeats commands"):
        find_fork(blocked, crashed, manifest)
