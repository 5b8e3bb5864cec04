"""What a planner saw at one recorded iteration, rebuilt from the log and a recorded ego state."""

import numpy as np

from shiftsim.arrays import FloatArray
from shiftsim.sim.planner import History, Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks


def scene_info(scenario: Scenario) -> SceneInfo:
    """What the planner is told before the first step."""
    return SceneInfo(
        map=scenario.map,
        route=scenario.route,
        goal=scenario.mission_goal,
        dt=0.1,
        token=scenario.token,
        expert=scenario,
    )


def observe(
    scenario: Scenario, iteration: int, ego: FloatArray, tracks: Tracks | None = None
) -> Observation:
    """The present alone; the rule-based planners look at nothing else.

    Args:
        scenario: The scenario.
        iteration: Its iteration.
        ego: (11,) ego state.
        tracks: One row of tracks; None for those of the log.
    """
    row = int(scenario.iteration_rows[iteration])
    span = slice(row, row + 1)
    seen = scenario.tracks.rows(span) if tracks is None else tracks
    history = History(scenario.time_us[span], np.atleast_2d(ego), seen)
    return Observation(
        iteration, int(scenario.time_us[row]), history, scenario.traffic_lights.rows(span)
    )
