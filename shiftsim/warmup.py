"""Compile the kernels of a simulation beside other work.

On a fresh install the kernels are compiled once, in about half a minute. `warm_up` starts one
process per share of them, on a small scene that is part of the package; whoever needs the kernels
later finds them in the disk cache.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from shiftsim.log import SimulationLog
from shiftsim.map import VectorMap
from shiftsim.scenario import Scenario
from shiftsim.state import AgentKind, Tracks, TrafficLights

WORLD = Path(__file__).parent / "reference" / "metric_worlds" / "metric_world_21.json"
SHARES = ("metrics", "planners")
_ROUTE = ("R1", "RC1", "R2")


@contextmanager
def warm_up() -> Iterator[None]:
    """Compile in the background for as long as the block lasts, and wait for the rest after it.

    A share that fails is left to whoever runs into its cause.
    """
    command = "import sys; from shiftsim.warmup import compile_share; compile_share(sys.argv[1])"
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", command, share],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for share in SHARES
    ]
    try:
        yield
        for process in processes:
            process.wait()
    finally:
        for process in processes:
            process.kill()
            process.wait()


def compile_share(share: str) -> None:
    """Compile one of `SHARES` by using its kernels once."""
    log, road = _scene()
    if share == "metrics":
        from shiftsim.metrics import compute_metrics

        compute_metrics(log, road)
        return
    from shiftsim.planners import load_planner
    from shiftsim.simulation import simulate

    for planner in ("constant-velocity", "idm"):
        simulate(_scenario(log, road), load_planner(planner, {}))


def _scene() -> tuple[SimulationLog, VectorMap]:
    from shiftsim.verify.metric_worlds import read_world

    log, road = read_world(json.loads(WORLD.read_text("utf-8")))
    count = len(log.time_us)
    poses = np.repeat(log.ego[:, None, :3], 2, axis=1)
    poses[:, :, 0] += [12.0, 30.0]
    tracks = Tracks(
        np.ones((count, 2), np.bool_),
        poses,
        np.ones((count, 2, 2)),
        np.full((count, 2, 2), 2.0),
        np.array([AgentKind.VEHICLE, AgentKind.PEDESTRIAN], np.int64),
        ("a", "b"),
    )
    return replace(log, tracks=tracks), road


def _scenario(log: SimulationLog, road: VectorMap) -> Scenario:
    return Scenario(
        token=log.token,
        scenario_type="unknown",
        log_name="warm-up",
        city=road.name,
        map=road,
        time_us=log.time_us,
        ego=log.ego,
        tracks=log.tracks,
        traffic_lights=TrafficLights.empty(len(log.time_us)),
        iteration_rows=np.arange(12, dtype=np.int64),
        row_step=1,
        route=_ROUTE,
        mission_goal=None,
        mapping=(1.0, 0.0, 1.0),
    )
