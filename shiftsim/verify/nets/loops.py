"""Closed loops of the learned planners: driven again by the recorded plans, each made again.

A rollout of ours is moved by what is recorded; the planner sees it, and what it says is compared.
"""

import hashlib
import zlib
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from shiftsim.sim.loop import Rollout
from shiftsim.sim.planner import past_rows
from shiftsim.verify.files import Source
from shiftsim.verify.scenes import Scenes
from shiftsim.verify.tables import Table, read_tables
from shiftsim.world import state

TABLES = read_tables(__file__)
STATE = 1e-8  # m, rad, m/s, …: logged and simulated ego states

# As in state.STATE_COLUMNS, in the words of the files.
FILE_COLUMNS = (*state.STATE_COLUMNS[:9], "angular_velocity", "angular_acceleration")
PLAN_COLUMNS = 7  # of a state, in stored plans: pose, velocity, acceleration
# how one official planner fails where it has no reference line; ours falls back there
FAILURE = "ValueError: zero-size array to reduction operation maximum which has no identity"


class Loop:
    """One closed-loop file, and its iteration that is compared just now."""

    def __init__(self, file: Source, planner: Any, scenes: Scenes) -> None:
        self.file, self.scenario = file, scenes[str(file["meta/scene"])]
        self.planner, self.name = planner, planner.name  # the planner after this iteration
        self.road, self.tracks = self.scenario.map, self.scenario.tracks
        self.variant = str(file["meta/variant"])  # of its weights
        self.rollout = Rollout(self.scenario, planner)
        self.step(0)

    def step(self, number: int) -> None:
        """Look at an iteration, which must be that of the rollout."""
        self.where = f"{self.file.name} iteration {number}"
        self.stored = self.file.below(f"it{number:02d}/")  # what is stored of it alone
        self.row = self.file.below("out/").at(number)  # of the arrays of the whole loop
        self.seen = self.rollout.observe()  # what the planner saw

    def plan(self) -> None:
        """Make again what the planner makes of what it saw."""
        self.features = self.planner.features(self.seen)
        (self.output,) = self.planner.infer([self.features])
        self.answer = self.planner.decode(self.output, self.seen)

    def advance(self) -> None:
        """Go to the next iteration by the recorded plan."""
        if "command" in self.row:
            self.rollout.advance(state.Command(*self.row["command"].tolist()))
        else:
            plan, time_us = self.row["trajectory"], self.row["trajectory_time_us"]
            states = np.zeros((len(plan), state.NUM_STATE))
            states[:, :PLAN_COLUMNS] = plan
            self.rollout.advance(state.Trajectory(time_us, states))

    def compare(self, quantity: str, ours: object, theirs: object, atol: float = 0.0) -> None:
        """Compare one quantity of this iteration."""
        report = self.file.report
        report.compare(f"{self.name} {quantity}", self.where, ours, theirs, atol=atol)

    def match(self, table: Table, theirs: Source, called: str = "", /, **names: Any) -> None:
        """Compare by a table, which finds what this object has."""
        called = f"{self.name} {called}".strip()
        table.match(theirs, self.where, called, **{**vars(self), **names})


def verify_loop(
    make: Callable[[str], Any], compare: Callable[[Loop], None], file: Source, scenes: Scenes
) -> None:
    """Make every step of a closed loop again, and `compare` it.

    `make` makes the planner from the name of its weights.
    """
    loop = Loop(file, _planner(make, f"deterministic:{file['meta/variant']}"), scenes)
    egos, plans = file["ego/current"], file.below("out/")
    counts = [len(array) for array in plans.values.values()]  # every array has a row for every plan
    loop.compare("plans", counts, counts[:1] * len(counts))
    if counts[0] == 0:
        plans.note("no plan was made", *plans)
    _compare_scene(loop, scenes, len(egos))
    failure = f"iteration {counts[0]}: {FAILURE}" if counts[0] < len(egos) else ""
    loop.compare("failure", failure, str(file["meta/error"]))
    for number, ego in enumerate(egos):
        loop.step(number)
        loop.compare("driven ego", loop.seen.history.ego[-1], ego, STATE)
        loop.plan()
        # where the official planner failed, ours says that its answer is a fallback
        loop.compare("fallback", bool(loop.planner.degraded), number == counts[0])
        if number < counts[0]:
            compare(loop)
            loop.advance()


def _compare_scene(loop: Loop, scenes: Scenes, count: int) -> None:
    """Compare what the file says about its scene, and which files that was made from."""
    rows, paths = past_rows(loop.scenario, 0), scenes.sources(str(loop.file["meta/scene"]))
    content, meta = [path.read_bytes() for path in paths], loop.file.below("meta/")
    names = {
        "md5": [hashlib.md5(data, usedforsecurity=False).hexdigest() for data in content],
        "crc32": [zlib.crc32(data) for data in content],
        "paths": [path.relative_to(scenes.folder).as_posix() for path in paths],
        "columns": FILE_COLUMNS,
        "ego": loop.scenario.ego[rows],
        "past_us": loop.scenario.time_us[rows],
        "time_us": loop.scenario.iteration_times[:count],
    }
    loop.match(TABLES["scene"], meta, "scene", **names)
    loop.match(TABLES["sources"], meta, "scene", **names)
    loop.match(TABLES["ego"], loop.file.below("ego/"), **names)


_planner = cache(lambda make, weights: make(weights))  # its network serves all files
