"""Compile kernels before they are needed.

On a fresh install every kernel is compiled once. `warm_up` does so beside other work, a process
per group of shares, on a small scene that is part of the package; `beside_run` does it for a run
that has a core to spare; `fill` makes runs of all planners, in two processes, and leaves nothing to
compile for a run. Who needs kernels later finds them on disk.
"""

import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from subprocess import DEVNULL, PIPE
from time import perf_counter
from typing import Any

import numpy as np

from shiftsim.arrays import kept
from shiftsim.errors import ShiftsimError
from shiftsim.files import PACKAGE, fresh_python, kernel_folders
from shiftsim.planners.table import PLANNERS
from shiftsim.runs.config import default_workers
from shiftsim.sim.log import SimulationLog
from shiftsim.verify.worlds import read_world
from shiftsim.world.map import VectorMap
from shiftsim.world.scenario import Scenario, scenario_of_rows
from shiftsim.world.state import PACIFICA, AgentKind, tracks_of_boxes

WORLD = PACKAGE / "verify" / "reference" / "metric_worlds" / "metric_world_21.json"


@contextmanager
def warm_up(*groups: Sequence[str]) -> Iterator[None]:
    """Compile groups of shares, a process for each, beside the block, and wait for the rest.

    A share that fails is left to whoever runs into its cause.
    """
    command = "import sys; from shiftsim.warmup import SHARES\nfor s in sys.argv[1:]: SHARES[s]()"
    start = partial(subprocess.Popen, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL)
    starts = [fresh_python(command, *shares) for shares in groups]
    processes = [start(words, env=environment) for words, environment in starts]
    try:
        yield
        for process in processes:
            process.wait()
    finally:
        for process in processes:
            process.kill()
            process.wait()


def beside_run(traffic: str) -> AbstractContextManager[None]:
    """Compile what a run needs last while its first task compiles what it needs first.

    Nothing happens where that is kept already.
    """
    folder = kept.fingerprint(PACKAGE / "metrics" / "time_to_collision.py")
    if any((place / folder).is_dir() for place in kernel_folders()):
        return nullcontext()
    # the first task does the routes itself, except after the agents, which take longest
    return warm_up(["contacts", "agents", "routes"] if traffic == "reactive" else ["contacts"])


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


def _agents() -> None:
    """Reactive traffic."""
    from shiftsim.sim.traffic.idm.model import IdmTraffic

    scenario, traffic = scene(), IdmTraffic()
    tracks = scenario.tracks.rows(scenario.iteration_rows)
    traffic.start(scenario, tracks, 0)
    traffic.step(0, scenario.ego[0], tracks, 1)


SHARES = {"routes": _routes, "contacts": _contacts, "planners": _planners, "agents": _agents}


def _rollout() -> tuple[SimulationLog, VectorMap]:
    """A drive past a car and a pedestrian, and its map."""
    log, road = read_world(json.loads(WORLD.read_text("utf-8")))
    values = np.ones((len(log.time_us), 2, 7))
    values[..., :3] = log.ego[:, None, :3] + [[12.0, 0.0, 0.0], [30.0, 0.0, 0.0]]
    values[..., 5:] = 2.0
    tracks = tracks_of_boxes(values, (AgentKind.VEHICLE, AgentKind.PEDESTRIAN), ("a", "b"))
    return replace(log, tracks=tracks), road


def scene() -> Scenario:
    """A scenario of a dozen iterations: a small map with a route, a car, a pedestrian."""
    log, road = _rollout()
    out = scenario_of_rows(log.token, road, log.time_us, log.ego, log.tracks)
    return replace(out, iteration_rows=np.arange(12, dtype=np.int64), route=("R1", "RC1", "R2"))


@dataclass(frozen=True)
class Filled:
    """What `fill` left on disk."""

    folders: tuple[str, ...]  # where the kernels are
    files: int  # kernels, one for each combination of types
    bytes: int  # their size
    compiled: int  # of the files, those that were not there before
    processes: int  # side by side
    seconds: float  # from start to end [s]

    def line(self) -> str:
        """As text."""
        return (
            f"kernels: {self.files} ({self.bytes / 1e6:.1f} MB) in {' and '.join(self.folders)}, "
            f"{self.compiled} of them compiled in {self.seconds:.0f} s by "
            f"{'1 process' if self.processes == 1 else f'{self.processes} processes'}"
        )


def fill(advance: Callable[[int, int, str], None] = lambda done, total, note: None) -> Filled:
    """Compile all that runs need, and see where it is.

    Raises:
        ShiftsimError: A run failed.
    """
    began, number = perf_counter(), min(2, default_workers())
    files = dict[str, bool]()
    with tempfile.TemporaryDirectory(prefix="shiftsim-kernels-") as folder:
        rounds = [[*map(_share, SHARES), ("store", folder, "{}")], [*_runs(folder)]]
        total, done = sum(map(len, rounds)), 0
        for jobs in rounds:
            for name, found in _side_by_side(jobs, number):
                files |= {path: made or files.get(path, False) for path, made in found.items()}
                done += 1
                advance(done, total, name)
    return Filled(
        folders=tuple(sorted({str(Path(path).parent.parent) for path in files})),
        files=len(files),
        bytes=sum(Path(path).stat().st_size for path in files),
        compiled=sum(files.values()),
        processes=number,
        seconds=perf_counter() - began,
    )


def _share(name: str) -> tuple[str, str, str]:
    return name, "", "{}"


def _runs(folder: str) -> Iterator[tuple[str, str, str]]:
    """Runs that together use every kernel of a run: name, folder, settings; the longest first."""
    has_torch = find_spec("torch") is not None
    learned = [name for name, entry in PLANNERS.items() if entry.kind == "learned"]
    rules = [name for name in PLANNERS if name not in ("scripted", "pdm-closed", *learned)]
    wanted: list[tuple[Sequence[str], str, str]] = [
        (["constant-velocity"], "reactive", "lqr"),
        (["pdm-closed"], "nonreactive", "lqr"),
        (rules, "nonreactive", "lqr"),
        *(([name], "nonreactive", "lqr") for name in learned if has_torch),
        (["constant-velocity"], "constant-velocity", "perfect"),
        (["constant-velocity"], "learned", "lqr"),
    ]
    for planners, traffic, controller in wanted:
        if traffic == "learned" and not has_torch:
            continue
        drawn = {
            name: {"checkpoint": "deterministic:drive"} for name in planners if name in learned
        }
        settings = {"traffic": traffic, "controller": controller, "planner_args": drawn}
        name = f"{', '.join(planners)} in {traffic} traffic"
        yield name, folder, json.dumps({"planners": list(planners), **settings})


def _side_by_side(
    jobs: Sequence[tuple[str, str, str]], number: int
) -> Iterator[tuple[str, dict[str, bool]]]:
    """Do jobs, so many at a time: the name of each that is done, and the files that it used."""
    command = "import sys; from shiftsim.warmup import do; do(*sys.argv[1:])"
    waiting, running = list(jobs), dict[str, subprocess.Popen[str]]()
    try:
        while waiting or running:
            while waiting and len(running) < number:
                job = waiting.pop(0)
                words, environment = fresh_python(command, *job)
                running[job[0]] = subprocess.Popen(
                    words, env=environment, stdin=DEVNULL, stdout=PIPE, stderr=PIPE, text=True
                )
            for name, process in [*running.items()]:
                try:
                    out, said = process.communicate(timeout=0.1)
                except subprocess.TimeoutExpired:
                    continue
                if process.returncode:
                    why = (said.strip().splitlines() or ["no message"])[-1]
                    raise ShiftsimError(
                        f"compiling the kernels of {name}: {why}", hint="see shiftsim doctor"
                    )
                del running[name]
                yield name, json.loads(out.splitlines()[-1])
    finally:
        for process in running.values():
            process.kill()
            process.wait()


def do(name: str, folder: str, settings: str) -> None:
    """One job of `fill`; prints which files of kernels it used, and whether it made them."""
    values: dict[str, Any] = json.loads(settings)
    if values:
        from shiftsim.api import run

        values |= {"store": f"{folder}/demo", "split": "demo-mini", "limit": 6, "workers": 1}
        with tempfile.TemporaryDirectory(prefix="run-", dir=folder) as out:
            run(values.pop("planners"), noise=["ou-high"], out=f"{out}/run", **values)
    elif name == "store":
        from shiftsim.data.demo.store import demo_store

        demo_store(Path(folder, "demo"))
    else:
        SHARES[name]()
    print(json.dumps({str(path): made for path, made in kept.used.items()}))
