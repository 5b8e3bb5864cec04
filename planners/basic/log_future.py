"""The oracle: drives what was recorded."""

from collections.abc import Sequence

import numpy as np

from shiftsim.errors import PlannerError
from shiftsim.sim.planner import Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Trajectory

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
        scenario, iteration = self._scenario, observation.iteration
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
