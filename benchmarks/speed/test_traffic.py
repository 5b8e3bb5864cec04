"""Reactive traffic in a city of 5200 lanes: the median of all steps of a rollout, and the rollout.

Run with `pytest benchmarks/speed/test_traffic.py -s`. Targets on one core are below.
"""

from time import process_time

import numpy as np
import pytest

from shiftsim.benchmarks.speed.city import bench_scene
from shiftsim.sim.traffic.idm.model import IdmTraffic
from shiftsim.sim.traffic.learned.model import LearnedTraffic

TARGET = 80e-6  # s, median of a step with 100 agents
ROLLOUT_TARGET = 60e-3  # s, start and steps with 300 agents
MOST_EXPONENT = 1.05  # of the cost over the number of agents
LEARNED_TARGET = 1e-3  # s, median of a step with 50 agents that learned traffic moves
ROLLOUTS = 5


def drive(scenario, rollouts):
    """Times of the start of each rollout, and of all steps, the first rollout included [s]."""
    traffic, starts, steps = IdmTraffic(), [], []
    for _ in range(rollouts + 1):
        tracks = scenario.tracks.rows(scenario.iteration_rows)
        began = process_time()
        traffic.start(scenario, tracks, 0)
        starts.append(process_time() - began)
        for iteration in range(scenario.num_iterations - 2):
            began = process_time()
            traffic.step(iteration, scenario.expert[iteration], tracks, iteration + 1)
            steps.append(process_time() - began)
    assert np.isfinite(tracks.poses[0]).any()
    return starts, steps


@pytest.mark.parametrize("lights", [False, True])
@pytest.mark.parametrize("agents", [100, 300])
def test_reactive_rollout(agents, lights, size, calibration_seconds, note):
    rollouts = size(ROLLOUTS)
    starts, steps = drive(bench_scene(agents, 0, lights=lights), rollouts)
    first = len(steps) // (rollouts + 1)  # the first rollout is not warm
    median, most = np.median(steps[first:]), np.max(steps[first:])
    print(
        f"\nreactive, {agents} agents: start {1e3 * np.median(starts[1:]):.1f} ms, "
        f"step median {1e6 * median:.0f} µs, longest {1e6 * most:.0f} µs, "
        f"{median / calibration_seconds:.2f} of the calibration",
        end="",
    )
    whole = np.median(starts[1:]) + np.sum(steps[first:]) / rollouts
    found, target = (median, TARGET) if agents == 100 else (whole, ROLLOUT_TARGET)
    verdict = "met" if found <= target else "NOT MET"
    print(f", rollout {1e3 * whole:.1f} ms, target {1e3 * target:g} ms {verdict}", end="")
    note(start=np.median(starts[1:]), step=median)


def test_cost_over_the_number_of_agents(size, note):
    """How the cost of a reactive rollout grows from 10 to 300 agents: a fitted exponent."""
    counts, costs = [10, 30, 100, 300], []
    for count in counts:
        starts, steps = drive(bench_scene(count, 0), size(2))
        first = len(steps) // len(starts)
        costs.append(min(starts[1:]) + np.sum(steps[first:]) / (len(starts) - 1))
    exponent = np.polyfit(np.log(counts), np.log(costs), 1)[0]
    verdict = "met" if exponent <= MOST_EXPONENT else "NOT MET"
    shown = ", ".join(f"{1e3 * cost:.1f}" for cost in costs)
    print(f"\nreactive, {counts} agents: {shown} ms, exponent {exponent:.2f}", end="")
    print(f", at most {MOST_EXPONENT:g} {verdict}", end="")
    note(**{f"agents_{count}": cost for count, cost in zip(counts, costs, strict=True)})


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
