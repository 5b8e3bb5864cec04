"""Compile the kernels of a simulation beside other work.

On a fresh install the kernels are compiled once, in about half a minute. `warm_up` starts one
process per share of them, on a small scene that is part of the package; whoever needs the kernels
later finds them in the disk cache.
"""

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from subprocess import DEVNULL

import numpy as np

from shiftsim.files import PACKAGE, fresh_python
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.metric_worlds import read_world
from shiftsim.verify.worlds import make_scenario, make_tracks
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import PACIFICA

WORLD = PACKAGE / "verify" / "reference" / "metric_worlds" / "metric_world_21.json"


@contextmanager
def warm_up(*shares: str) -> Iterator[None]:
    """Compile shares (all, if none is named) beside the block, and wait for the rest after it.

    A share that fails is left to whoever runs into its cause.
    """
    command = "import sys; from shiftsim.warmup import SHARES; SHARES[sys.argv[1]]()"
    start = partial(subprocess.Popen, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL)
    starts = [fresh_python(command, share) for share in shares or SHARES]
    processes = [start(words, env=environment) for words, environment in starts]
    try:
        yield
        for process in processes:
            process.wait()
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _routes() -> None:
    """Metrics that find the ego on the map."""
    from shiftsim.metrics import collision, drivable_area
    from shiftsim.metrics.lane_change import lane_changes
    from shiftsim.metrics.route import corner_routes, driven_route

    log, road = _rollout()
    ego = collision.flat_ego(log.ego, PACIFICA)
    route, corners = driven_route(road, ego.centers), corner_routes(road, ego.corners)
    lane_changes(road, corners)
    drivable_area.measure(road, ego.corners, route, corners)


def _contacts() -> None:
    """The other metrics."""
    from shiftsim.metrics import collision, progress, speed_limit
    from shiftsim.metrics.comfort import comfort_signals
    from shiftsim.metrics.route import empty_lists
    from shiftsim.metrics.time_to_collision import time_to_collision

    log, road = _rollout()
    ego = collision.flat_ego(log.ego, PACIFICA)
    tracks, is_common = collision.flat_tracks(log.tracks), np.ones(len(log.ego), np.bool_)
    contacts = collision.first_contacts(ego, tracks)
    time_to_collision(ego, tracks, contacts, (), is_common, road, log.tracks)
    comfort_signals(log.time_us, log.ego)
    progress.measure(road, ego.centers, ego.centers)
    off_lane = empty_lists(road, len(log.ego))
    speed_limit.overspeed(road, off_lane, ego.speeds)
    progress.lane_progress(road, off_lane, ego.centers)


def _planners() -> None:
    """Dynamics, and a planner that follows the route."""
    from shiftsim.planners.registry import load_planner
    from shiftsim.sim.loop import simulate

    for planner in ("constant-velocity", "idm"):
        simulate(scene(), load_planner(planner))


SHARES = {"routes": _routes, "contacts": _contacts, "planners": _planners}


def _rollout() -> tuple[SimulationLog, VectorMap]:
    """A drive past a car and a pedestrian, and its map."""
    log, road = read_world(json.loads(WORLD.read_text("utf-8")))
    values = np.ones((len(log.time_us), 2, 7))
    values[..., :3] = log.ego[:, None, :3] + [[12.0, 0.0, 0.0], [30.0, 0.0, 0.0]]
    values[..., 5:] = 2.0
    tracks = make_tracks(values.shape[:2], ..., values, ("vehicle", "pedestrian"), ("a", "b"))
    return replace(log, tracks=tracks), road


def scene() -> Scenario:
    """A scenario of a dozen iterations: a small map with a route, a car, a pedestrian."""
    log, road = _rollout()
    out = make_scenario(log.token, road, log.time_us, log.ego, log.tracks)
    return replace(out, iteration_rows=np.arange(12, dtype=np.int64), route=("R1", "RC1", "R2"))
