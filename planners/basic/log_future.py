"""The oracle: drives what was recorded."""

from collections.abc import Sequence

import numpy as np

from shiftsim.errors import PlannerError
from shiftsim.kernels import FloatArray, IntArray, kernel
from shiftsim.sim.dynamics.lqr import TRACKED
from shiftsim.sim.execute import Course, execute
from shiftsim.sim.plan_check import GOOD, plain
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import NUM_STATE, Trajectory

POSES = 16
ROWS_BETWEEN = 10  # 0.5 s of a 20 Hz log; nuPlan rule 393: it counts rows, not time


class LogFuture:
    """Plans the recorded states of the coming 8 s, whatever the simulated ego does."""

    name = "log-future"
    sees_recording = True
    _scenario: Scenario | None = None
    _previous: Trajectory | None = None
    _first: Sequence[int] = ()  # row of the plan's first state, by iteration

    def reset(self, scene: SceneInfo) -> None:
        """Take the recording of the new scenario."""
        self._scenario, self._previous = scene.expert, None
        if scene.expert is not None:
            # nuPlan rule 431: on from the first row with that time stamp
            times = scene.expert.time_us
            self._first = np.searchsorted(times, scene.expert.iteration_times).tolist()

    def plan(self, observation: Observation) -> Trajectory:
        """The recorded state of this iteration and up to 16 later ones, 10 rows apart.

        Rows behind the end of the recording are left out. When none is left, the previous plan is
        repeated (the devkit fails there), as long as there is one.

        Raises:
            PlannerError: The recording ends less than 10 rows behind the first iteration.
        """
        return self._plan(observation.iteration)

    def drive_on(self, course: Course) -> int:
        """Take the steps of a course that have a plan; the first iteration that was not taken."""
        scenario = self._scenario
        if scenario is None:
            return course.first
        rows = np.array(self._first), plain(scenario.iteration_rows)
        plan = np.empty(POSES + 1, np.int64), np.empty((POSES + 1, NUM_STATE))
        recorded = plain(scenario.time_us), plain(scenario.ego)
        driven = int(_drive_on(course, *recorded, *rows, *plan))
        if course.first < driven < course.stop:
            self._plan(driven - 1)  # may be the previous one of all that follow
        return driven

    def _plan(self, iteration: int) -> Trajectory:
        scenario = self._scenario
        if scenario is None:
            raise PlannerError("log-future: plan() was called before reset()")
        first = self._first[iteration]
        rows = slice(first, first + POSES * ROWS_BETWEEN + 1, ROWS_BETWEEN)
        times = scenario.time_us[rows].copy()
        if len(times) > 1:
            states = scenario.ego[rows].copy()
            states[0] = scenario.ego[scenario.iteration_rows[iteration]]
            self._previous = Trajectory(times, states)
        if self._previous is None:
            raise PlannerError(
                f"log-future: scenario {scenario.token!r} has no recorded state 0.5 s after "
                f"iteration {iteration}",
                hint="keep at least 0.5 s of log behind the first iteration when converting",
            )
        return self._previous


@kernel
def _drive_on(
    course: Course,
    time_us: IntArray,  # (R,) time stamps of the recording [us]
    recorded: FloatArray,  # (R, 11) its ego states
    first: IntArray,  # (T,) row of a plan's first time stamp, by iteration
    present: IntArray,  # (T,) row of its first state
    plan_us: IntArray,  # (17,) and
    states: FloatArray,  # (17, 11) room for a plan
) -> int:
    """Plan and execute until the end, or until there is no plan or none that can be executed."""
    for iteration in range(course.first, course.stop):
        count = min(len(plan_us), -((first[iteration] - len(time_us)) // ROWS_BETWEEN))
        if count < 2:
            return iteration
        for i in range(count):
            row = first[iteration] + i * ROWS_BETWEEN
            plan_us[i] = time_us[row]
            for column in range(NUM_STATE):
                states[i, column] = recorded[row if i else present[iteration], column]
        row = course.start + iteration
        code, status = execute(
            plan_us[:count],
            states[:count],
            0,
            course.time_us[row],
            course.time_us[row + 1],
            row,
            iteration,
            iteration + 1 < course.stop,
            course.ego,
            course.noise,
            course.commands,
            course.kept,
        )
        if code != GOOD or status != TRACKED:
            return iteration
    return course.stop
