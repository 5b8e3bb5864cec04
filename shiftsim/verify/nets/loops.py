"""Closed loops of the learned planners: every recorded step is made again on its own.

The planner sees the recorded ego history, and the tracks and lights of the scene's own log.
"""

import hashlib
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.planners.learned.base import LearnedPlanner
from shiftsim.sim.dynamics.bicycle import command_and_step
from shiftsim.sim.dynamics.lqr import raise_for_status, track_and_step
from shiftsim.sim.loop import HISTORY_SAMPLES
from shiftsim.sim.planner import History, Observation
from shiftsim.verify.files import Source, read_arrays
from shiftsim.verify.observing import scene_info
from shiftsim.verify.report import Report
from shiftsim.verify.scenes import Scenes
from shiftsim.world import state
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Command, Trajectory

POSITION, HEADING = 2e-3, 2e-4  # m, rad: plans of closed loops
STATE = 1e-8  # m, rad, m/s, …: logged and simulated ego states

# As in state.STATE_COLUMNS, in the words of the files.
FILE_COLUMNS = (*state.STATE_COLUMNS[:9], "angular_velocity", "angular_acceleration")
PLAN_COLUMNS = 7  # of a state, in stored plans: pose, velocity, acceleration
KNOWN_ERRORS = (  # of official planners, which ours answer with a fallback
    "ValueError: zero-size array to reduction operation maximum which has no identity",
)


class Loop:
    """One closed-loop file. N recorded iterations.

    Attributes:
        file: Its arrays.
        planner: Name of the planner.
        scenario: The scene.
        variant: Variant of the weights.
        error: How the official planner failed after the last iteration; empty when it did not.
        time_us: (N,) time stamps of the iterations [us].
        ego: (N, 11) ego states, columns of `state.STATE_COLUMNS`.
        past: (22, 11) ego states up to iteration 0.
        past_us: (22,) their time stamps [us].
    """

    def __init__(self, file: Source, planner: str, scenario: Scenario) -> None:
        self.file, self.planner, self.scenario = file, planner, scenario
        self.variant, self.error = str(file["meta/variant"]), str(file["meta/error"])
        self.time_us: IntArray = file.take("ego/current_time_us", -1)
        self.ego: FloatArray = file.take("ego/current", len(self.time_us), state.NUM_STATE)
        self.past_us: IntArray = file.take("ego/initial_history_time_us", -1)
        self.past: FloatArray = file.take("ego/initial_history", len(self.past_us), state.NUM_STATE)

    def compare(
        self, quantity: str, where: str, ours: object, theirs: object, atol: float = 0.0
    ) -> None:
        """Compare one quantity of this loop."""
        at = f"{self.file.name} {where}".strip()
        self.file.report.compare(f"{self.planner} {quantity}", at, ours, theirs, atol=atol)

    def observation(self, iteration: int) -> Observation:
        """What the planner saw at a recorded iteration."""
        scenario = self.scenario
        ego = np.concatenate([self.past, self.ego[1 : iteration + 1]])[-HISTORY_SAMPLES:]
        rows = _history_rows(scenario, iteration)[-len(ego) :]
        history = History(scenario.time_us[rows], ego, scenario.tracks.rows(rows))
        lights = scenario.traffic_lights.rows(rows[-1:])
        return Observation(iteration, int(scenario.time_us[rows[-1]]), history, lights)

    def compare_scene(self, scenes: Scenes) -> None:
        """Compare what the file says about its scene, and which files that was made from."""
        scenario, rows = self.scenario, _history_rows(self.scenario, 0)
        sources = scenes.sources(str(self.file["meta/scene"]))
        content = [path.read_bytes() for path in sources]
        sums = [hashlib.md5(data, usedforsecurity=False).hexdigest() for data in content]
        made = {
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
            **{name: value for name, value in made.items() if f"meta/{name}" in self.file},
        }
        named = {f"meta/{name}": value for name, value in facts.items()}
        self.file.match(self.file.name, named, quantity=self.planner)
        times = scenario.iteration_times[: len(self.time_us)]
        self.compare("time [us]", "history", scenario.time_us[rows], self.past_us)
        self.compare("time [us]", "iterations", times, self.time_us)
        self.compare("logged ego", "history", scenario.ego[rows], self.past, STATE)
        self.compare("logged ego", "iteration 0", scenario.ego[rows[-1]], self.ego[0], STATE)

    def compare_driven(self, plans: list[Trajectory | Command]) -> None:
        """Compare the recorded ego states with what the recorded plans lead to."""
        command, after = np.empty(2), np.empty(state.NUM_STATE)
        for number, plan in enumerate(plans[: len(self.ego) - 1]):
            now_us, next_us = int(self.time_us[number]), int(self.time_us[number + 1])
            step = (now_us, next_us, self.ego[number])
            if isinstance(plan, Command):
                command[:] = plan.acceleration, plan.steering_rate
                command_and_step(*step, command, 0.0, 0.0, after)
            else:
                status = track_and_step(*step, plan.time_us, plan.states, 0.0, 0.0, after, command)
                raise_for_status(status, now_us, plan.time_us)
            where = f"after iteration {number}"
            self.compare("driven ego", where, after, self.ego[number + 1], STATE)


class Step(NamedTuple):
    """One iteration of a loop, made again.

    Attributes:
        loop: The loop.
        number: The iteration.
        stored: What is stored of it alone.
        seen: What the planner saw.
        planner: The planner after this step.
        features: What its network read.
        output: What its network said of them.
        plan: What it made of that.
    """

    loop: Loop
    number: int
    stored: Source
    seen: Observation
    planner: Any
    features: Any
    output: Any
    plan: Any

    @property
    def where(self) -> str:
        """The case, for the report."""
        return f"{self.loop.file.name} iteration {self.number}"

    def recorded(self, name: str) -> Any:
        """The row for this iteration of an array of the whole loop."""
        return self.loop.file[f"out/{name}"][self.number]

    def compare(self, quantity: str, ours: object, theirs: object, atol: float = 0.0) -> None:
        """Compare one quantity of this iteration."""
        self.loop.compare(quantity, f"iteration {self.number}", ours, theirs, atol)

    def match(self, ours: Mapping[str, object], atol: float | Mapping[str, float] = 0.0) -> None:
        """Compare with the stored arrays of the same names."""
        self.stored.match(self.where, ours, atol, quantity=self.loop.planner)

    def compare_plan(self, motion: float) -> None:
        """Compare the plan with the recorded one; `motion` is the tolerance behind the poses."""
        theirs, ours = self.recorded("trajectory"), self.plan.states[:, :PLAN_COLUMNS]
        self.compare("plan time [us]", self.plan.time_us, self.recorded("trajectory_time_us"))
        self.compare("plan [m]", ours[:, :2], theirs[:, :2], POSITION)
        self.compare("plan [rad]", ours[:, 2], theirs[:, 2], HEADING)
        self.compare("plan motion", ours[:, 3:], theirs[:, 3:], motion)


def verify_loop(
    path: Path,
    report: Report,
    scenes: Scenes,
    make: Callable[[str], LearnedPlanner[Any, Any]],
    compare: Callable[[Step], None],
    recorded: Sequence[str] = (),
) -> None:
    """Make every step of a closed loop again and compare.

    Args:
        path: The file.
        report: Receives the comparisons.
        scenes: The scenes.
        make: Makes the planner from the name of its weights.
        compare: Compares one step.
        recorded: Names of arrays with a row for every plan, beside the plans.
    """
    file = read_arrays(path, report)
    if (scene := str(file["meta/scene"])) not in scenes:
        report.skip(f"{path.name}: scene {scene}, which is not at hand")
        return
    planner: Any = _planner(make, f"deterministic:{file['meta/variant']}").fork()
    loop = Loop(file, planner.name, scenes[scene])
    loop.compare_scene(scenes)
    planner.reset(scene_info(loop.scenario))
    plans = _recorded_plans(file)
    failed = f"iteration {len(plans)}" if len(plans) < len(loop.ego) else ""
    for name in recorded:
        loop.compare("recorded plans", name, len(file[f"out/{name}"]), len(plans))
    where, _, error = loop.error.partition(": ")
    loop.compare("failure", "", where, failed)
    if error not in ("", *KNOWN_ERRORS):
        report.skip(f"{path.name}: the official failure {error!r}")
    for number in range(len(loop.ego)):
        seen = loop.observation(number)
        features = planner.features(seen)
        (output,) = planner.infer([features])
        plan = planner.decode(output, seen)
        stored = file.below(f"it{number:02d}/")
        step = Step(loop, number, stored, seen, planner, features, output, plan)
        # where the official planner failed, ours says that its answer is a fallback
        step.compare("failure", bool(planner.degraded), number == len(plans))
        if number < len(plans):
            compare(step)
    loop.compare_driven(plans)
    file.finish()


@cache
def _planner(make: Callable[[str], Any], weights: str) -> Any:
    return make(weights)


def _recorded_plans(file: Source) -> list[Trajectory | Command]:
    if "out/command" in file:
        return [Command(*row) for row in file["out/command"].tolist()]
    plans: list[Trajectory | Command] = []
    for poses, times in zip(file["out/trajectory"], file["out/trajectory_time_us"], strict=True):
        states = np.zeros((len(times), state.NUM_STATE))
        states[:, :PLAN_COLUMNS] = poses
        plans.append(Trajectory(times, states))
    return plans


def _history_rows(scenario: Scenario, iteration: int) -> IntArray:
    row = int(scenario.iteration_rows[iteration])
    rows = np.arange(row - (HISTORY_SAMPLES - 1) * scenario.row_step, row + 1, scenario.row_step)
    return rows[rows >= 0]
