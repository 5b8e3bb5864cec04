"""Rollouts as columns with a row per sample, and as the bytes that a worker hands over.

What the scenario holds already is not kept again: recorded tracks (unless the traffic reacts),
lights, route and expert come back from the store when a rollout is read. The files they end in are
those of `rollout_files`.
"""

import math
import struct
from collections.abc import Iterable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from shiftsim.data.store.schema import EGO_COLUMNS
from shiftsim.errors import DataError
from shiftsim.sim.log import SimulationLog
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

_COMMAND_COLUMNS = ("command_accel_mps2", "command_steering_rate_radps")
_NOISE_COLUMNS = ("noise_accel_mps2", "noise_steering_rate_radps")


def _list_of(kind: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("item", kind, nullable=False))


def _without_nulls(columns: dict[str, pa.DataType]) -> pa.Schema:
    return pa.schema([pa.field(name, kind, nullable=False) for name, kind in columns.items()])


STATES = _without_nulls(
    {
        "time_us": pa.int64(),
        **dict.fromkeys((*EGO_COLUMNS, *_COMMAND_COLUMNS, *_NOISE_COLUMNS), pa.float64()),
        "planning_seconds": pa.float64(),
        "degraded": pa.bool_(),
        "plan_poses": _list_of(pa.float64()),
    }
)
TRACKS = _without_nulls(
    {
        "track_valid": _list_of(pa.bool_()),
        **dict.fromkeys(("track_poses", "track_velocities", "track_sizes"), _list_of(pa.float64())),
    }
)
_BOTH = pa.schema([*STATES, *TRACKS])
_CODEC = pa.Codec("lz4_raw")
_LENGTH = struct.Struct("<q")


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


def encode_rollout(log: SimulationLog, *, with_tracks: bool) -> bytes:
    """One rollout as bytes; with the states of tracks where those are not the recorded ones."""
    batches = [pa.RecordBatch.from_arrays(_states(log), schema=STATES)]
    if with_tracks:
        batches.append(pa.RecordBatch.from_arrays(_tracks(log.tracks), schema=TRACKS))
    return encode_batches(batches)


def encode_batches(batches: Iterable[pa.RecordBatch]) -> bytes:
    """The columns of a rollout as they are in memory, compressed.

    Columns of `STATES` are one message of Arrow IPC, those of `TRACKS`, if there are any, another
    one: so the bytes say by themselves what they hold. In front is the length of the messages.
    """
    messages = b"".join(batch.serialize() for batch in batches)
    compressed: bytes = _CODEC.compress(messages, asbytes=True)
    return _LENGTH.pack(len(messages)) + compressed


def decode_rollout(data: bytes) -> pa.RecordBatch:
    """What `encode_rollout` was given, a row per sample: columns of `STATES`, then of `TRACKS`."""
    (length,) = _LENGTH.unpack_from(data)
    source = pa.BufferReader(_CODEC.decompress(memoryview(data)[_LENGTH.size :], length))
    states = pa.ipc.read_record_batch(pa.ipc.read_message(source), STATES)
    if source.tell() == length:
        return states
    tracks = pa.ipc.read_record_batch(pa.ipc.read_message(source), TRACKS)
    return pa.RecordBatch.from_arrays([*states.columns, *tracks.columns], schema=_BOTH)


def _states(log: SimulationLog) -> list[pa.Array]:
    arrays = [pa.array(log.time_us)]
    for values in (log.ego, log.commands, log.noise):
        arrays += map(pa.array, np.ascontiguousarray(values.T))
    return [*arrays, pa.array(log.planning_seconds), pa.array(log.degraded), _lists(log.plans)]


def _tracks(tracks: Tracks) -> list[pa.Array]:
    return [_lists(x) for x in (tracks.valid, tracks.poses, tracks.velocities, tracks.sizes)]


def _lists(values: np.ndarray) -> pa.Array:
    """(K, …) as K lists of equal length."""
    kind = TRACKS.field("track_valid" if values.dtype == np.bool_ else "track_poses").type
    offsets = _offsets(len(values), math.prod(values.shape[1:]))
    return pa.ListArray.from_arrays(offsets, pa.array(values.ravel()), type=kind)


@lru_cache(16)
def _offsets(count: int, size: int) -> pa.Array:
    # rollouts have the same length again and again
    return pa.array(np.arange(count + 1, dtype=np.int32) * size)


def _from_lists(column: pa.Array, shape: tuple[int, ...]) -> np.ndarray:
    flat = column.flatten().to_numpy(zero_copy_only=False)
    return np.array(flat.reshape(len(column), *shape))


def complete_rollout(rows: pa.RecordBatch, scenario: Scenario) -> SimulationLog:
    """A stored rollout, completed by what its scenario holds already.

    Args:
        rows: Columns of `STATES`, and of `TRACKS` where they are not those of the log; others do
            not matter.
        scenario: The scenario that was driven.

    Raises:
        DataError: The scenario is not the one that was driven.
    """
    samples = scenario.iteration_rows[:-1]
    time_us = rows["time_us"].to_numpy()
    if not np.array_equal(time_us, scenario.time_us[samples]):
        raise DataError(
            f"scenario {scenario.token!r} in the store is not the one that was driven",
            hint="use the store that the manifest names",
        )
    tracks = scenario.tracks.rows(samples)
    if "track_valid" in rows.schema.names:
        tracks = _stored_tracks(rows, tracks)
    return SimulationLog(
        token=scenario.token,
        time_us=scenario.time_us[samples],
        ego=_stack(rows, EGO_COLUMNS),
        tracks=tracks,
        traffic_lights=scenario.traffic_lights.rows(samples),
        expert_time_us=scenario.iteration_times,
        expert_ego=scenario.expert,
        route=scenario.route,
        commands=_stack(rows, _COMMAND_COLUMNS),
        noise=_stack(rows, _NOISE_COLUMNS),
        plans=_from_lists(rows["plan_poses"], (-1, 3)),
        planning_seconds=np.array(rows["planning_seconds"].to_numpy()),
        degraded=np.array(rows["degraded"].to_numpy(zero_copy_only=False)),
    )


def _stack(rows: pa.RecordBatch, names: Iterable[str]) -> np.ndarray:
    return np.stack([rows[name].to_numpy() for name in names], axis=1)


def _stored_tracks(rows: pa.RecordBatch, recorded: Tracks) -> Tracks:
    count = recorded.num_tracks
    return Tracks(
        _from_lists(rows["track_valid"], (count,)),
        _from_lists(rows["track_poses"], (count, 3)),
        _from_lists(rows["track_velocities"], (count, 2)),
        _from_lists(rows["track_sizes"], (count, 2)),
        recorded.kinds,
        recorded.tokens,
    )
