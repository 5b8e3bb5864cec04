"""Closed loops of the learned planners: every recorded step is made again on its own.

The planner sees the recorded ego history, and the tracks and lights of the scene's own log.
"""

import hashlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np

from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.sim.planner import HISTORY_SAMPLES, Observation, observe_log, past_rows, scene_info
from shiftsim.verify.files import Source, Tolerances
from shiftsim.verify.scenes import Scenes
from shiftsim.world import state

POSITION, HEADING = 2e-3, 2e-4  # m, rad: plans of closed loops
STATE = 1e-8  # m, rad, m/s, …: logged and simulated ego states

# As in state.STATE_COLUMNS, in the words of the files.
FILE_COLUMNS = (*state.STATE_COLUMNS[:9], "angular_velocity", "angular_acceleration")
PLAN_COLUMNS = 7  # of a state, in stored plans: pose, velocity, acceleration
PLANS = ("trajectory", "trajectory_time_us")  # arrays with a row for every plan
KNOWN_ERRORS = (  # of official planners, which ours answer with a fallback
    "ValueError: zero-size array to reduction operation maximum which has no identity",
)


class Loop:
    """One closed-loop file, and its iteration that is compared just now."""

    number = 0  # of the iteration
    row: Source  # of the arrays of the whole loop
    stored: Source  # what is stored of it alone
    seen: Observation  # what the planner saw
    features: Any  # what its network read
    output: Any  # what its network said of them
    plan: Any  # what it made of that

    def __init__(self, file: Source, planner: Any, scenes: Scenes) -> None:
        self.file, self.scenario = file, scenes[str(file["meta/scene"])]
        self.planner, self.name = planner, planner.name  # the planner after this iteration
        self.variant = str(file["meta/variant"])  # of its weights
        # recorded ego states, columns of `state.STATE_COLUMNS`: all, and those up to iteration 0
        self.ego = file.take("ego/current", -1, state.NUM_STATE)
        self.past = file.take("ego/initial_history", HISTORY_SAMPLES, state.NUM_STATE)
        planner.reset(scene_info(self.scenario, planner=planner))

    @property
    def where(self) -> str:
        """The case, for the report."""
        return f"{self.file.name} iteration {self.number}"

    def compare(self, quantity: str, ours: object, theirs: object, atol: float = 0.0) -> None:
        """Compare one quantity of this iteration."""
        report = self.file.report
        report.compare(f"{self.name} {quantity}", self.where, ours, theirs, atol=atol)

    def match(self, ours: Mapping[str, object], atol: Tolerances = 0.0, part: str = "") -> None:
        """Compare with the arrays of the same names that are stored of this iteration alone."""
        self.stored.below(part).match(self.where, ours, atol, quantity=self.name)

    def compare_plan(self, motion: float) -> None:
        """Compare the plan with the recorded one; `motion` is the tolerance behind the poses."""
        theirs, ours = self.row["trajectory"], self.plan.states[:, :PLAN_COLUMNS]
        self.compare("plan time [us]", self.plan.time_us, self.row["trajectory_time_us"])
        self.compare("plan [m]", ours[:, :2], theirs[:, :2], POSITION)
        self.compare("plan [rad]", ours[:, 2], theirs[:, 2], HEADING)
        self.compare("plan motion", ours[:, 3:], theirs[:, 3:], motion)

    def step(self, number: int) -> None:
        """Go to an iteration: make everything again that the planner makes there."""
        ego = np.concatenate([self.past, self.ego[1 : number + 1]])[-HISTORY_SAMPLES:]
        self.number, self.stored = number, self.file.below(f"it{number:02d}/")
        self.row = self.file.below("out/").at(number)
        self.seen = observe_log(self.scenario, number, ego=ego)
        self.features = self.planner.features(self.seen)
        (self.output,) = self.planner.infer([self.features])
        self.plan = self.planner.decode(self.output, self.seen)

    def compare_driven(self) -> None:
        """Compare the next ego state with what the recorded plan leads to."""
        command, after = np.empty(2), np.empty(state.NUM_STATE)
        times = self.file["ego/current_time_us"][self.number :][:2].tolist()
        if "command" in self.row:
            command[:] = self.row["command"]
            command_and_step(*times, self.ego[self.number], command, 0.0, 0.0, after)
        else:
            plan, plan_us = self.row["trajectory"], self.row["trajectory_time_us"]
            states = np.zeros((len(plan), state.NUM_STATE))
            states[:, :PLAN_COLUMNS] = plan
            step = (*times, self.ego[self.number], plan_us, states, 0.0, 0.0, after, command)
            raise_for_status(track_and_step(*step), times[0], plan_us)
        self.compare("driven ego", after, self.ego[self.number + 1], STATE)


def verify_loop(
    make: Callable[[str], Any],
    compare: Callable[[Loop], None],
    recorded: Sequence[str],
    file: Source,
    scenes: Scenes,
) -> None:
    """Make every step of a closed loop again, and `compare` it.

    `make` makes the planner from the name of its weights; every plan has a row in the `recorded`
    arrays.
    """
    loop = Loop(file, _planner(make, f"deterministic:{file['meta/variant']}").fork(), scenes)
    _compare_scene(loop, scenes)
    counts = [len(file[f"out/{name}"]) for name in recorded]
    loop.compare("plans", counts, counts[:1] * len(counts))
    where, _, error = str(file["meta/error"]).partition(": ")
    if error not in ("", *KNOWN_ERRORS):
        file.report.skip(f"{file.name}: the official failure {error!r}")
    loop.compare("failure", f"iteration {counts[0]}" if counts[0] < len(loop.ego) else "", where)
    for number in range(len(loop.ego)):
        loop.step(number)
        # where the official planner failed, ours says that its answer is a fallback
        loop.compare("failure", bool(loop.planner.degraded), number == counts[0])
        if number < counts[0]:
            compare(loop)
            if number + 1 < len(loop.ego):
                loop.compare_driven()


def _compare_scene(loop: Loop, scenes: Scenes) -> None:
    """Compare what the file says about its scene, and which files that was made from."""
    scenario, rows, meta = loop.scenario, past_rows(loop.scenario, 0), loop.file.below("meta/")
    sources = scenes.sources(str(meta["scene"]))
    content = [path.read_bytes() for path in sources]
    sums = [hashlib.md5(data, usedforsecurity=False).hexdigest() for data in content]
    made = {  # of which a file has some
        "db_md5": sums[0],
        "map_md5": sums[1],
        "source_files": [path.relative_to(scenes.folder).as_posix() for path in sources],
        "source_crc32": [zlib.crc32(data) for data in content],
    }
    facts = {
        "token": scenario.token,
        "scenario_type": scenario.scenario_type,
        "map_name": scenario.map.name,
        "route_roadblock_ids": list(scenario.route),
        "state_columns": list(FILE_COLUMNS),
        **{name: value for name, value in made.items() if name in meta},
    }
    meta.match(loop.file.name, facts, quantity=f"{loop.name} scene")
    logged = {
        "initial_history": scenario.ego[rows],
        "initial_history_time_us": scenario.time_us[rows],
        "current_time_us": scenario.iteration_times[: len(loop.ego)],
    }
    loop.file.below("ego/").match(loop.file.name, logged, STATE, quantity=loop.name)
    loop.compare("logged ego", scenario.ego[rows[-1]], loop.ego[0], STATE)


@cache
def _planner(make: Callable[[str], Any], weights: str) -> Any:
    return make(weights)
