"""Rollouts on disk: a Parquet file each, with a row per sample.

What the scenario holds already is not stored again: recorded tracks (unless the traffic reacts),
lights, route and expert come back from the store when a rollout is read.
"""

import math
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.schema import EGO_COLUMNS
from shiftsim.errors import DataError
from shiftsim.log import SimulationLog
from shiftsim.scenario import Scenario
from shiftsim.state import Tracks

_COMMAND_COLUMNS = ("command_accel_mps2", "command_steering_rate_radps")
_NOISE_COLUMNS = ("noise_accel_mps2", "noise_steering_rate_radps")
# states hardly compress and are never searched: what costs time brings nothing
_WRITE_OPTIONS: dict[str, Any] = {
    "compression": "snappy",
    "use_dictionary": ["planner", "noise", "token"],
    "write_statistics": False,
}
_KEY = pa.dictionary(pa.int32(), pa.string())


def _list_of(kind: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("item", kind, nullable=False))


def _without_nulls(columns: dict[str, pa.DataType]) -> pa.Schema:
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in columns.items()])


_COLUMNS = {
    "planner": _KEY,
    "noise": _KEY,
    "seed": pa.int64(),
    "token": _KEY,
    "iteration": pa.int64(),
    "time_us": pa.int64(),
    **dict.fromkeys((*EGO_COLUMNS, *_COMMAND_COLUMNS, *_NOISE_COLUMNS), pa.float64()),
    "planning_seconds": pa.float64(),
    "degraded": pa.bool_(),
    "plan_poses": _list_of(pa.float64()),
}
_TRACK_COLUMNS = {
    "track_valid": _list_of(pa.bool_()),
    **dict.fromkeys(("track_poses", "track_velocities", "track_sizes"), _list_of(pa.float64())),
}
_SCHEMA, _TRACKS_SCHEMA = _without_nulls(_COLUMNS), _without_nulls(_COLUMNS | _TRACK_COLUMNS)


class Task(NamedTuple):
    """One rollout to be made; also its key in every table, and the order of their rows.

    Attributes:
        planner: Planner name as in tables.
        noise: Noise name.
        seed: Seed of the noise; 0 without noise.
        token: Scenario.
    """

    planner: str
    noise: str
    seed: int
    token: str


def describe(task: Task) -> str:
    """A task in words."""
    seed = "" if task.noise == "none" else f" seed {task.seed}"
    return f"{task.planner} {task.noise}{seed} {task.token}"


def encode_rollout(task: Task, log: SimulationLog, *, with_tracks: bool) -> bytes:
    """One rollout as the bytes of its file."""
    sink = pa.BufferOutputStream()
    table = rollout_table(task, log, with_tracks=with_tracks)
    pq.write_table(table, sink, **_WRITE_OPTIONS)
    data: bytes = sink.getvalue().to_pybytes()
    return data


def rollout_table(task: Task, log: SimulationLog, *, with_tracks: bool) -> pa.Table:
    """One rollout as a table with a row per sample, K rows."""
    count = len(log.time_us)
    arrays = [*_repeated(task, count), _numbers(count), pa.array(log.time_us)]
    for values in (log.ego, log.commands, log.noise):
        arrays += map(pa.array, np.ascontiguousarray(values.T))
    arrays += [pa.array(log.planning_seconds), pa.array(log.degraded), _lists(log.plans)]
    if with_tracks:
        tracks = log.tracks
        arrays += map(_lists, (tracks.valid, tracks.poses, tracks.velocities, tracks.sizes))
    return pa.Table.from_arrays(arrays, schema=_TRACKS_SCHEMA if with_tracks else _SCHEMA)


def _repeated(task: Task, count: int) -> list[pa.Array]:
    """The key in every row."""
    return [
        pa.DictionaryArray.from_arrays(_zeros(count), pa.array([value]))
        if isinstance(value, str)
        else pa.array(np.full(count, value, np.int64))
        for value in task
    ]


def _lists(values: np.ndarray) -> pa.Array:
    """(K, …) as K lists of equal length."""
    kind = _TRACK_COLUMNS["track_valid" if values.dtype == np.bool_ else "track_poses"]
    offsets = _offsets(len(values), math.prod(values.shape[1:]))
    return pa.ListArray.from_arrays(offsets, pa.array(values.ravel()), type=kind)


# rollouts have the same length again and again


@lru_cache(16)
def _numbers(count: int) -> pa.Array:
    return pa.array(np.arange(count, dtype=np.int64))


@lru_cache(16)
def _zeros(count: int) -> pa.Array:
    return pa.array(np.zeros(count, np.int32))


@lru_cache(16)
def _offsets(count: int, size: int) -> pa.Array:
    return pa.array(np.arange(count + 1, dtype=np.int32) * size)


def _from_lists(column: pa.ChunkedArray, shape: tuple[int, ...]) -> np.ndarray:
    flat = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return np.array(flat.reshape(len(column), *shape))


def complete_rollout(table: pa.Table, scenario: Scenario) -> SimulationLog:
    """A stored rollout, completed by what its scenario holds already.

    Raises:
        DataError: The scenario is not the one that was driven.
    """
    samples = scenario.iteration_rows[:-1]
    time_us = table["time_us"].to_numpy()
    if not np.array_equal(time_us, scenario.time_us[samples]):
        raise DataError(
            f"scenario {scenario.token!r} in the store is not the one that was driven",
            hint="use the store that the manifest names",
        )
    tracks = scenario.tracks.rows(samples)
    if "track_valid" in table.column_names:
        tracks = _stored_tracks(table, tracks)
    return SimulationLog(
        token=scenario.token,
        time_us=scenario.time_us[samples],
        ego=_stack(table, EGO_COLUMNS),
        tracks=tracks,
        traffic_lights=scenario.traffic_lights.rows(samples),
        expert_time_us=scenario.iteration_times,
        expert_ego=scenario.expert,
        route=scenario.route,
        commands=_stack(table, _COMMAND_COLUMNS),
        noise=_stack(table, _NOISE_COLUMNS),
        plans=_from_lists(table["plan_poses"], (-1, 3)),
        planning_seconds=np.array(table["planning_seconds"].to_numpy()),
        degraded=np.array(table["degraded"].to_numpy()),
    )


def _stack(table: pa.Table, names: Iterable[str]) -> np.ndarray:
    return np.stack([table[name].to_numpy() for name in names], axis=1)


def _stored_tracks(table: pa.Table, recorded: Tracks) -> Tracks:
    count = recorded.num_tracks
    return Tracks(
        _from_lists(table["track_valid"], (count,)),
        _from_lists(table["track_poses"], (count, 3)),
        _from_lists(table["track_velocities"], (count, 2)),
        _from_lists(table["track_sizes"], (count, 2)),
        recorded.kinds,
        recorded.tokens,
    )
