"""Rollouts on disk: the task that names one, and the log of it that comes back from its rows.

`columns` says what a row holds, `files` how many rollouts share files.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from shiftsim.data.store.schema import EGO_COLUMNS
from shiftsim.errors import DataError
from shiftsim.runs.rollouts import columns
from shiftsim.runs.rollouts.columns import stack
from shiftsim.sim.log import SimulationLog
from shiftsim.sim.noise import sample_noise
from shiftsim.world.ranges import RUN, require
from shiftsim.world.scenario import Scenario


class Task(NamedTuple):
    """One rollout to be made; also its key in every table, and the order of their rows."""

    planner: str  # planner name as in tables
    noise: str  # noise name
    seed: int  # seed of the noise; 0 without noise
    token: str  # scenario


def describe(task: Task) -> str:
    """A task in words."""
    seed = "" if task.noise == "none" else f" seed {task.seed}"
    return f"{task.planner} {task.noise}{seed} {task.token}"


def complete_rollout(
    rows: pa.RecordBatch, scenario: Scenario, task: Task, *, is_partial: bool = False
) -> SimulationLog:
    """The stored rollout of a task, completed by its noise and what its scenario holds already.

    The rows have columns of `STATES`, and of `TRACKS` where they are not those of the log. Where
    they may end before the scenario, the expert ends with them.

    Raises:
        DataError: The scenario is not the one that was driven, or the rows are damaged.
    """
    time_us = rows["time_us"].to_numpy()
    if is_partial:
        shown = scenario.iteration_rows[: len(time_us) + 1]
        scenario = replace(scenario, iteration_rows=shown)
    samples = scenario.iteration_rows[:-1]
    if scenario.script is not None and scenario.script.termination is not None:
        samples = samples[: len(time_us)]  # it may have ended before its time
    if not np.array_equal(time_us, scenario.time_us[samples]):
        raise DataError(
            f"scenario {scenario.token!r} in the store is not the one that was driven",
            hint="use the store that the manifest names",
        )
    ego = stack(rows, EGO_COLUMNS)
    where = f"the rollout of scenario {scenario.token!r}"
    require(RUN, "state", ego, f"{where}: an ego")
    tracks = scenario.tracks.rows(samples)
    try:
        plans = columns.stored_plans(rows)
        if columns.KINDS in rows.schema.names:
            kinds = columns.stored_kinds(rows)
            codes = np.array([*kinds.values()], np.int64)
            tracks = replace(tracks, tokens=tuple(kinds), kinds=codes)
        if "track_tokens" in rows.schema.names:
            stored: dict[str, Any] = columns.stored_tracks(rows, tracks.tokens)
            tracks = replace(tracks, **stored)
    except ValueError as error:
        raise DataError(f"{where} is damaged: {error}", hint="make the run again") from error
    if rows[columns.NOISE_COLUMNS[0]].null_count:
        noise = sample_noise(task.noise, seed=task.seed, token=task.token, num_steps=len(rows))
    else:
        noise = stack(rows, columns.NOISE_COLUMNS)
    return SimulationLog(
        token=scenario.token,
        time_us=scenario.time_us[samples],
        ego=ego,
        tracks=tracks,
        traffic_lights=scenario.traffic_lights.rows(samples),
        expert_time_us=scenario.iteration_times,
        expert_ego=scenario.expert,
        route=scenario.route,
        commands=stack(rows, columns.COMMAND_COLUMNS),
        noise=noise,
        plans=plans,
        planning_seconds=rows["planning_seconds"].to_numpy().astype(np.float64),
        degraded=np.array(rows["degraded"].to_numpy(zero_copy_only=False)),
    )
