"""Columns of a stored rollout: a row per sample, with what its scenario does not hold already.

Recorded tracks (unless the traffic reacts), lights, route and expert come back from the store when
a rollout is read, and noise from its key. Plans, which no score depends on, are rounded
(`pack_plans`). Tracks that react are coded as in a store, all boxes of a rollout in the lists of
its first row, by track, then by sample: so they take half the room.
"""

from collections.abc import Iterable, Mapping

import numpy as np
import pyarrow as pa

from shiftsim.data.store.boxes import restored, second_differences
from shiftsim.data.store.schema import CODED, EGO_COLUMNS, MOTION
from shiftsim.sim.log import SimulationLog, pack_plans, unpack_plans

COMMAND_COLUMNS = ("command_accel_mps2", "command_steering_rate_radps")
NOISE_COLUMNS = ("noise_accel_mps2", "noise_steering_rate_radps")


def _list_of(kind: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("item", kind, nullable=False))


def _schema(columns: dict[str, pa.DataType]) -> pa.Schema:
    return pa.schema(
        [pa.field(name, kind, nullable=name in NOISE_COLUMNS) for name, kind in columns.items()]
    )


STATES = _schema(
    {
        "time_us": pa.int64(),
        **dict.fromkeys((*EGO_COLUMNS, *COMMAND_COLUMNS, *NOISE_COLUMNS), pa.float64()),
        "planning_seconds": pa.float32(),
        "degraded": pa.bool_(),
        "plan_steps": _list_of(pa.int32()),
    }
)
_CODES = [f"track_{name}{CODED}" for name in MOTION]
_SIZES = ["track_length_m", "track_width_m"]
TRACKS = _schema(
    {
        "track_valid": _list_of(pa.bool_()),
        **dict.fromkeys(_CODES, _list_of(pa.int64())),
        **dict.fromkeys(_SIZES, _list_of(pa.float64())),
    }
)
# numbers per track in the columns of older versions
_WIDTHS = {"track_poses": 3, "track_velocities": 2, "track_sizes": 2}
_BEFORE = {  # what older versions had instead of a column
    "planning_seconds": {"planning_seconds": pa.float64()},
    "plan_steps": {"plan_poses": _list_of(pa.float64())},
    **dict.fromkeys(_CODES + _SIZES, dict.fromkeys(_WIDTHS, _list_of(pa.float64()))),
}
# what fills few bytes when the first bytes of all numbers come first, then the second ones, …
IN_PLANES = (
    *(*EGO_COLUMNS, *COMMAND_COLUMNS, "planning_seconds"),
    *(f"{name}.list.element" for name in ("plan_steps", *_CODES, *_SIZES)),
)


def rollout_rows(
    log: SimulationLog, *, with_tracks: bool, with_noise: bool = True
) -> pa.RecordBatch:
    """Columns of `STATES`, and of `TRACKS` where tracks are not the recorded ones.

    Noise that `complete_rollout` can make again from the task is left out: null.
    """
    columns = [pa.array(log.time_us)]
    for values in (log.ego, log.commands):
        columns += map(pa.array, np.ascontiguousarray(values.T))
    empty = [pa.nulls(len(log.time_us), pa.float64())] * len(NOISE_COLUMNS)
    columns += map(pa.array, np.ascontiguousarray(log.noise.T)) if with_noise else empty
    columns += [pa.array(log.planning_seconds.astype(np.float32)), pa.array(log.degraded)]
    columns.append(_packed(log.plans, log.ego))
    if not with_tracks:
        return pa.RecordBatch.from_arrays(columns, schema=STATES)
    tracks = log.tracks
    columns += track_columns(tracks.valid, (tracks.poses, tracks.velocities, tracks.sizes))
    return pa.RecordBatch.from_arrays(columns, schema=pa.schema([*STATES, *TRACKS]))


def _packed(plans: np.ndarray, ego: np.ndarray) -> pa.Array:
    """(K, P, 3) poses as a column `plan_steps`."""
    lengths, steps = pack_plans(plans, ego)
    return _lists(np.append(0, np.cumsum(lengths)), steps, STATES.field("plan_steps").type)


def _lists(offsets: np.ndarray, items: np.ndarray, kind: pa.DataType) -> pa.Array:
    return pa.ListArray.from_arrays(pa.array(offsets.astype(np.int32)), pa.array(items), type=kind)


def stored_plans(rows: pa.RecordBatch) -> np.ndarray:
    """(K, P, 3) poses of the plans of a stored rollout, rounded.

    Raises:
        ValueError: They are damaged.
    """
    column = rows["plan_steps"]
    lengths = np.diff(column.offsets.to_numpy()).astype(np.int64)
    return unpack_plans(lengths, column.flatten().to_numpy(), stack(rows, EGO_COLUMNS))


def track_columns(valid: np.ndarray, numbers: Iterable[np.ndarray]) -> list[pa.Array]:
    """The columns of `TRACKS`, of (K, N) and the (K, N, …) poses, velocities and sizes."""
    there = valid.T
    samples, count = np.arange(len(valid) + 1), int(np.count_nonzero(valid))
    kinds = [field.type for field in TRACKS]
    columns = [_lists(samples * valid.shape[1], valid.ravel(), kinds[0])]
    boxes = [of[there] for values in numbers for of in values.T]  # by track, then by sample
    for at, (kind, values) in enumerate(zip(kinds[1:], boxes, strict=True)):
        stored = second_differences(values).view(np.int64) if at < len(_CODES) else values
        columns.append(_lists(np.where(samples, count, 0), stored, kind))
    return columns


def stored_tracks(rows: pa.RecordBatch) -> dict[str, np.ndarray]:
    """Fields `valid`, `poses`, `velocities` and `sizes` of the tracks of a stored rollout.

    Raises:
        ValueError: They are damaged.
    """
    flat = rows["track_valid"].flatten().to_numpy(zero_copy_only=False)
    valid = np.array(flat.reshape(len(rows), len(flat) // max(len(rows), 1)))
    there = valid.T
    boxes = np.full((len(_CODES + _SIZES), *there.shape), np.nan)
    for of, name in zip(boxes, _CODES + _SIZES, strict=True):
        numbers = rows[name].flatten().to_numpy()
        if len(numbers) != np.count_nonzero(valid):
            raise ValueError(f"{name!r} has {len(numbers)} of {np.count_nonzero(valid)} numbers")
        of[there] = restored(numbers.view(np.uint64)) if name in _CODES else numbers
    poses, velocities, sizes = (np.ascontiguousarray(part.T) for part in np.split(boxes, [3, 5]))
    return {"valid": valid, "poses": poses, "velocities": velocities, "sizes": sizes}


def encode_rows(rows: pa.RecordBatch) -> bytes:
    """The rows of a rollout as bytes; tracks are compressed, what is small without them is not."""
    sink = pa.BufferOutputStream()
    compression = "lz4" if "track_valid" in rows.schema.names else None
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_stream(sink, rows.schema, options=options) as stream:
        stream.write_batch(rows)
    encoded: bytes = sink.getvalue().to_pybytes()
    return encoded


def decode_rows(data: bytes) -> pa.RecordBatch:
    """What `encode_rows` was given."""
    return pa.ipc.open_stream(data).read_next_batch()


def stack(rows: pa.RecordBatch, names: Iterable[str]) -> np.ndarray:
    """(K, C) numbers of C columns."""
    return np.stack([rows[name].to_numpy() for name in names], axis=1)


def check_columns(found: Mapping[str, pa.DataType]) -> None:
    """Check that these are the columns of stored rollouts, of this or an older version.

    Raises:
        TypeError: One is missing or has another type.
    """
    for column in [*STATES, *(TRACKS if "track_valid" in found else ())]:
        before = _BEFORE.get(column.name, {}).items()
        is_old = before and before <= found.items()
        if not is_old and found.get(column.name) != column.type:
            raise TypeError(f"column {column.name!r} is missing or not {column.type}")


def as_today(rows: pa.RecordBatch) -> pa.RecordBatch:
    """A rollout as this version stores it, whichever has written it.

    Raises:
        ValueError: It is damaged.
    """
    old = {name: rows[name] for name in rows.schema.names}
    columns: dict[str, pa.Array] = {}
    if "plan_poses" in old:
        plans = old["plan_poses"].flatten().to_numpy().reshape(len(rows), -1, 3)
        columns["plan_steps"] = _packed(plans, stack(rows, EGO_COLUMNS))
        columns["planning_seconds"] = old["planning_seconds"].cast(pa.float32())
    if "track_poses" in old:
        flat = old["track_valid"].flatten().to_numpy(zero_copy_only=False)
        valid = flat.reshape(len(rows), -1)
        numbers = (
            old[name].flatten().to_numpy().reshape(*valid.shape, width)
            for name, width in _WIDTHS.items()
        )
        columns.update(zip(TRACKS.names, track_columns(valid, numbers), strict=True))
    if not columns:
        return rows
    key = list(rows.schema)[: rows.schema.get_field_index("time_us")]
    fields = [*key, *STATES, *(TRACKS if "track_valid" in old else ())]
    arrays = [columns.get(field.name, old.get(field.name)) for field in fields]
    return pa.RecordBatch.from_arrays(arrays, schema=pa.schema(fields))
