"""All metrics of one 15 s rollout among 100 agents, and of the golden worlds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from json_worlds import read_world

from shiftsim.metrics import compute_metrics, evaluate
from shiftsim.metrics import measure as measure_rollout
from shiftsim.sim.log import SimulationLog
from shiftsim.world.map import VectorMap
from shiftsim.world.state import Tracks

GOLDEN = Path(__file__).resolve().parents[2] / "tests" / "golden" / "metric_worlds"
TARGET = 5e-3  # s, all metrics of one 15 s rollout


def crowded(num_agents: int) -> tuple[SimulationLog, VectorMap]:
    """A 15 s rollout on a golden map with agents that drive along within 50 m of the ego."""
    log, road = read_world(json.loads((GOLDEN / "metric_world_18.json").read_text()))
    rows = np.concatenate([np.arange(109), np.arange(108, 67, -1)])
    ego = log.ego[rows]
    count = len(ego)
    rng = np.random.default_rng(0)
    shift = rng.uniform(-50.0, 50.0, (num_agents, 2))
    poses = np.repeat(ego[:, None, :3], num_agents, axis=1)
    poses[..., :2] += np.where(np.abs(shift) < 8.0, shift + 12.0, shift)
    tracks = Tracks(
        np.ones((count, num_agents), np.bool_),
        poses,
        np.full((count, num_agents, 2), 4.0),
        np.broadcast_to([4.5, 2.0], (count, num_agents, 2)).copy(),
        np.zeros(num_agents, np.int64),
        tuple(str(index) for index in range(num_agents)),
    )
    time_us = log.time_us[0] + 100_000 * np.arange(count + 1)
    return (
        replace(
            log,
            time_us=time_us[:-1],
            ego=ego,
            tracks=tracks,
            expert_time_us=time_us,
            expert_ego=np.concatenate([ego, ego[-1:]]),
        ),
        road,
    )


def test_all_metrics_with_100_agents(measure) -> None:
    log, road = crowded(100)
    measure(compute_metrics, log, road, calls=1, target=TARGET)


def test_measuring_with_100_agents(measure) -> None:
    log, road = crowded(100)
    measure(measure_rollout, log, road, calls=1)


def test_judging_one_profile(measure) -> None:
    measured = measure_rollout(*crowded(100))
    measure(evaluate, measured, "deepplan", calls=10)
