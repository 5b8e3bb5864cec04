"""A rollout does not depend on what the process, its planner or its traffic did before."""

import os
import subprocess
import sys
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from worlds import cruise_scenario, standing_tracks

from shiftsim.metrics import compute_metrics
from shiftsim.planners.registry import load_planner
from shiftsim.sim.loop import simulate
from shiftsim.sim.traffic import make_traffic
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import AgentKind

KINDS = [AgentKind.VEHICLE] * 3 + [AgentKind.PEDESTRIAN, AgentKind.BICYCLE, AgentKind.BARRIER]
ROWS = 60 + 2 * 40 + 1 + 160
DIGEST = """
import hashlib, sys
sys.path.insert(0, {folder!r})
from test_history_free import arrays, make_scenario
from shiftsim.planners.registry import load_planner
from shiftsim.sim.traffic import make_traffic

digest = hashlib.sha256()
for seed in (3, 4):
    made = arrays(make_scenario(seed), load_planner("pdm-closed"), make_traffic("reactive"))
    for values in made:
        digest.update(values.tobytes())
print(digest.hexdigest())
"""


def make_scenario(seed: int) -> Scenario:
    """Six objects around the road; how many vehicles end up on it, differs."""
    rng = np.random.default_rng(seed)
    poses = np.column_stack(
        [rng.uniform(20, 90, 6), rng.uniform(-2, 6, 6), rng.uniform(-0.5, 0.5, 6)]
    )
    tracks = standing_tracks(ROWS, poses, KINDS)
    tracks.velocities[:, :5] = rng.uniform(-1, 6, (5, 2))
    return cruise_scenario(iterations=41, tracks=tracks)


def arrays(scenario, planner, traffic) -> list[np.ndarray]:
    log = simulate(scenario, planner, traffic=traffic)
    result = np.array(repr(compute_metrics(log, scenario.map).rows))
    return [log.ego, log.commands, log.plans, log.tracks.valid, log.tracks.poses, result]


@pytest.mark.slow
@pytest.mark.parametrize("traffic", ["reactive", "constant-velocity"])
@pytest.mark.parametrize("planner", ["pdm-closed", "idm"])
def test_results_are_the_same_in_any_order_and_with_used_models(planner, traffic) -> None:
    scenarios = [make_scenario(seed) for seed in range(3)]
    alone = [arrays(s, load_planner(planner), make_traffic(traffic)) for s in scenarios]
    used_planner, used_traffic = load_planner(planner), make_traffic(traffic)

    for order in permutations(range(3)):
        for index in order:
            again = arrays(scenarios[index], used_planner, used_traffic)
            for first, second in zip(alone[index], again, strict=True):
                np.testing.assert_array_equal(first, second)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="MALLOC_PERTURB_ belongs to glibc")
@pytest.mark.thorough
def test_results_do_not_depend_on_what_memory_held_before() -> None:
    # glibc fills what it hands out with this byte, so that reading it before writing shows
    code = DIGEST.format(folder=str(Path(__file__).parent))
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    seen = {
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"MALLOC_PERTURB_": byte, "PYTHONPATH": path},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for byte in ("0", "85", "254")
    }

    assert len(seen) == 1
