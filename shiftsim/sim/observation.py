"""What a planner sees: before the first step, and at an iteration of a recording.

The closed loop shows a planner the rollout so far (`loop`); what is tried, checked or learned on
recorded states alone is shown them by `observe_log`, in the same shape.
"""

import numpy as np

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.sim.planner import History, Observation, SceneInfo
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

# nuPlan rule 10: 2.1 s and the present, not 2.0 s
HISTORY_SAMPLES = 22


def scene_info(scenario: Scenario, seed: int = 0) -> SceneInfo:
    """What a planner is told before the first step; `seed` is that of the task."""
    return SceneInfo(
        map=scenario.map,
        route=scenario.route,
        goal=scenario.mission_goal,
        dt=float(np.diff(scenario.iteration_times).mean() * 1e-6),
        token=scenario.token,
        expert=scenario,
        seed=seed,
    )


def past_rows(scenario: Scenario, iteration: int, samples: int = HISTORY_SAMPLES) -> IntArray:
    """(H,) rows of the log that an iteration looks back on, itself last; those it has."""
    row, step = int(scenario.iteration_rows[iteration]), scenario.row_step
    rows = np.arange(row - (samples - 1) * step, row + 1, step)
    return rows[rows >= 0]


def observe_log(
    scenario: Scenario,
    iteration: int,
    *,
    ego: FloatArray | None = None,
    tracks: Tracks | None = None,
    samples: int = HISTORY_SAMPLES,
) -> Observation:
    """What a planner would see where the ego is as recorded, or in given states.

    Args:
        scenario: The scenario.
        iteration: Its iteration.
        ego: (H, 11) ego states of the samples, or (11,) of a single one; the recorded ones if None.
        tracks: Tracks over the H samples; the recorded ones if None.
        samples: How many samples to look back on, the present included; 1 is the present alone. A
            recording that begins later gives fewer: H of them.
    """
    rows = past_rows(scenario, iteration, samples)
    now = int(scenario.iteration_rows[iteration])
    history = History(
        scenario.time_us[rows],
        scenario.ego[rows] if ego is None else np.atleast_2d(ego),
        scenario.tracks.rows(rows) if tracks is None else tracks,
    )
    lights = scenario.traffic_lights.rows(slice(now, now + 1))
    return Observation(iteration, int(scenario.time_us[now]), history, lights)
