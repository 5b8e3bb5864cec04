"""The oracle: drives what was recorded."""

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

    def reset(self, scene: SceneInfo) -> None:
        """Take the recording of the new scenario."""
        self._scenario, self._previous = scene.expert, None

    def plan(self, observation: Observation) -> Trajectory:
        """The recorded state of this iteration and up to 16 later ones, 10 rows apart.

        Rows behind the end of the recording are left out. When none is left, the previous plan is
        repeated (the devkit fails there), as long as there is one.

        Raises:
            PlannerError: The recording ends less than 10 rows behind the first iteration.
        """
        scenario = self._scenario
        if scenario is None:
            raise PlannerError("log-future: plan() was called before reset()")
        row = int(scenario.iteration_rows[observation.iteration])
        # nuPlan rule 431: on from the first row with that time stamp
        first = int(np.searchsorted(scenario.time_us, scenario.time_us[row]))
        rows = np.arange(first, first + POSES * ROWS_BETWEEN + 1, ROWS_BETWEEN)
        rows[0] = row
        rows = rows[rows < len(scenario.time_us)]
        times = scenario.time_us[rows].copy()
        if len(times) > 1:
            self._previous = Trajectory(times, scenario.ego[rows].copy())
        if self._previous is None:
            raise PlannerError(
                f"log-future: scenario {scenario.token!r} has no recorded state 0.5 s after "
                f"iteration {observation.iteration}",
                hint="keep at least 0.5 s of log behind the first iteration when converting",
            )
        return self._previous
