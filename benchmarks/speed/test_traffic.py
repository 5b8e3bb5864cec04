"""Reactive traffic in a city of 5200 lanes: the median of all steps of a rollout, and the rollout.

Run with `pytest benchmarks/speed/test_traffic.py -s`. Targets on one core: 400 µs with 100 agents,
1 ms with 50 that learned traffic moves.
"""

from time import process_time

import numpy as np
import pytest

from shiftsim.data.demo.city import bench_scene
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.sim.traffic.learned.model import LearnedTraffic

TARGET = 400e-6  # s, median of a step with 100 agents
LEARNED_TARGET = 1e-3  # s, median of a step with 50 agents
ROLLOUTS = 5


@pytest.mark.parametrize("agents", [100, 500])
def test_reactive_rollout(agents, size, calibration_seconds, note):
    scenario = bench_scene(agents, 0)
    traffic = IdmTraffic()

    starts, steps = [], []
    rollouts = size(ROLLOUTS)
    for _ in range(rollouts + 1):
        tracks = scenario.tracks.rows(scenario.iteration_rows)
        began = process_time()
        traffic.start(scenario, tracks, 0)
        starts.append(process_time() - began)
        for iteration in range(scenario.num_iterations - 2):
            began = process_time()
            traffic.step(iteration, scenario.expert[iteration], tracks, iteration + 1)
            steps.append(process_time() - began)

    first = len(steps) // (rollouts + 1)  # the first rollout is not warm
    median, most = np.median(steps[first:]), np.max(steps[first:])
    print(
        f"\nreactive, {agents} agents: start {1e3 * np.median(starts[1:]):.1f} ms, "
        f"step median {1e6 * median:.0f} µs, longest {1e6 * most:.0f} µs, "
        f"{median / calibration_seconds:.2f} of the calibration",
        end="",
    )
    if agents == 100:
        print(f", target {1e6 * TARGET:g} µs {'met' if median <= TARGET else 'NOT MET'}", end="")
    note(start=np.median(starts[1:]), step=median)
    assert np.isfinite(tracks.poses[0]).any()


def test_learned_step(size, note):
    scenario, traffic, steps = bench_scene(50, 0), LearnedTraffic(), []
    for _ in range(size(ROLLOUTS) + 1):
        tracks = scenario.tracks.rows(scenario.iteration_rows)
        traffic.start(scenario, tracks, 0)
        for iteration in range(scenario.num_iterations - 2):
            began = process_time()
            traffic.step(iteration, scenario.expert[iteration], tracks, iteration + 1)
            steps.append(process_time() - began)
    median = np.median(steps[len(steps) // 2 :])
    verdict = "met" if median <= LEARNED_TARGET else "NOT MET"
    print(
        f"\nlearned, 50 agents: step median {1e6 * median:.0f} µs, target 1000 µs {verdict}", end=""
    )
    note(step=median)
    assert np.isfinite(tracks.poses[-2]).any()
