"""Rollouts: a row per sample on the way from a worker to a file, and Parquet files of many of them.

What the scenario holds already is not kept again: recorded tracks (unless the traffic reacts),
lights, route and expert come back from the store when a rollout is read, and noise from its key.
Plans, which no score depends on, are rounded (`pack_plans`).

A worker sends the rows of a rollout as bytes, which wait in the journal; when the run ends they go
into files `part-*.parquet`. Most of the time of writing a small Parquet file goes into headers, and
clusters dislike many small files: so rollouts share row groups, and a `Place` says which rows are
whose. The first columns name the task, for readers that know nothing of places.
"""

import math
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.store.schema import EGO_COLUMNS
from shiftsim.data.store.tables import TableWriter
from shiftsim.errors import DataError
from shiftsim.files import draft
from shiftsim.sim.log import SimulationLog, pack_plans, unpack_plans
from shiftsim.sim.noise import sample_noise
from shiftsim.world.ranges import RUN, require
from shiftsim.world.scenario import Scenario

_COMMAND_COLUMNS = ("command_accel_mps2", "command_steering_rate_radps")
_NOISE_COLUMNS = ("noise_accel_mps2", "noise_steering_rate_radps")


def _list_of(kind: pa.DataType) -> pa.DataType:
    return pa.list_(pa.field("item", kind, nullable=False))


def _schema(columns: dict[str, pa.DataType]) -> pa.Schema:
    return pa.schema(
        [pa.field(name, kind, nullable=name in _NOISE_COLUMNS) for name, kind in columns.items()]
    )


STATES = _schema(
    {
        "time_us": pa.int64(),
        **dict.fromkeys((*EGO_COLUMNS, *_COMMAND_COLUMNS, *_NOISE_COLUMNS), pa.float64()),
        "planning_seconds": pa.float32(),
        "degraded": pa.bool_(),
        "plan_steps": _list_of(pa.int32()),
    }
)
_BEFORE = {  # columns of older versions that were another type, or had another name
    "planning_seconds": ("planning_seconds", pa.float64()),
    "plan_steps": ("plan_poses", _list_of(pa.float64())),
}
TRACKS = _schema(
    {
        "track_valid": _list_of(pa.bool_()),
        **dict.fromkeys(("track_poses", "track_velocities", "track_sizes"), _list_of(pa.float64())),
    }
)
_FIELDS = {field.name: field for field in STATES}
FOLDER = "rollouts"
_PART = re.compile(r"part-\d+\.parquet")
_MAX_FILE = 1024, 256 << 20  # rollouts, bytes in memory
_MAX_GROUP = 16, 16 << 20
# states hardly compress and are never searched: what costs more time brings next to nothing, but
# bytes in planes
_WRITE_OPTIONS: dict[str, Any] = {
    "compression": "zstd",
    "compression_level": 1,
    "use_dictionary": ["planner", "noise", "token"],
    "use_byte_stream_split": [*EGO_COLUMNS, *_COMMAND_COLUMNS, "plan_steps.list.element"],
    "write_statistics": False,
}
_NAME = pa.dictionary(pa.int32(), pa.string())
_KEY = _schema(
    {"planner": _NAME, "noise": _NAME, "seed": pa.int64(), "token": _NAME, "iteration": pa.int64()}
)


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


class Place(NamedTuple):
    """Where a rollout is."""

    file: Path  # the Parquet file
    row: int  # its first row there
    rows: int  # number of its rows


def rollout_rows(
    log: SimulationLog, *, with_tracks: bool, with_noise: bool = True
) -> pa.RecordBatch:
    """Columns of `STATES`, and of `TRACKS` where tracks are not the recorded ones.

    Noise that `complete_rollout` can make again from the task is left out: null.
    """
    columns = [pa.array(log.time_us)]
    for values in (log.ego, log.commands):
        columns += map(pa.array, np.ascontiguousarray(values.T))
    empty = [pa.nulls(len(log.time_us), pa.float64())] * len(_NOISE_COLUMNS)
    columns += map(pa.array, np.ascontiguousarray(log.noise.T)) if with_noise else empty
    columns += [pa.array(log.planning_seconds.astype(np.float32)), pa.array(log.degraded)]
    columns.append(_packed(log.plans, log.ego))
    if not with_tracks:
        return pa.RecordBatch.from_arrays(columns, schema=STATES)
    tracks = log.tracks
    columns += map(_lists, (tracks.valid, tracks.poses, tracks.velocities, tracks.sizes))
    return pa.RecordBatch.from_arrays(columns, schema=pa.schema([*STATES, *TRACKS]))


def _packed(plans: np.ndarray, ego: np.ndarray) -> pa.Array:
    """(K, P, 3) poses as a column `plan_steps`."""
    lengths, steps = pack_plans(plans, ego)
    offsets = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    kind = STATES.field("plan_steps").type
    return pa.ListArray.from_arrays(pa.array(offsets), pa.array(steps), type=kind)


def stored_plans(rows: pa.RecordBatch) -> np.ndarray:
    """(K, P, 3) poses of the plans of a stored rollout, rounded.

    Raises:
        ValueError: They are damaged.
    """
    column = rows["plan_steps"]
    lengths = np.diff(column.offsets.to_numpy()).astype(np.int64)
    return unpack_plans(lengths, column.flatten().to_numpy(), _stack(rows, EGO_COLUMNS))


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


def _lists(values: np.ndarray) -> pa.Array:
    """(K, …) as K lists of equal length."""
    kind = TRACKS.field("track_valid" if values.dtype == np.bool_ else "track_poses").type
    offsets = _offsets(len(values), math.prod(values.shape[1:]))
    return pa.ListArray.from_arrays(offsets, pa.array(values.ravel()), type=kind)


@lru_cache(16)
def _offsets(count: int, size: int) -> pa.Array:
    # rollouts have the same length again and again
    return pa.array(np.arange(count + 1, dtype=np.int32) * size)


def _from_lists(column: pa.Array, shape: tuple[int, ...], where: str) -> np.ndarray:
    flat = column.flatten().to_numpy(zero_copy_only=False)
    try:
        return np.array(flat.reshape(len(column), *shape))
    except ValueError as error:
        what = f"{where}: {len(flat)} numbers in {len(column)} rows of shape {shape}"
        raise DataError(what, hint="make the run again") from error


def complete_rollout(rows: pa.RecordBatch, scenario: Scenario, task: Task) -> SimulationLog:
    """The stored rollout of a task, completed by its noise and what its scenario holds already.

    The rows have columns of `STATES`, and of `TRACKS` where they are not those of the log.

    Raises:
        DataError: The scenario is not the one that was driven.
    """
    time_us = rows["time_us"].to_numpy()
    samples = scenario.iteration_rows[:-1]
    if scenario.script is not None and scenario.script.finish is not None:
        samples = samples[: len(time_us)]  # it may have ended before its time
    if not np.array_equal(time_us, scenario.time_us[samples]):
        raise DataError(
            f"scenario {scenario.token!r} in the store is not the one that was driven",
            hint="use the store that the manifest names",
        )
    ego = _stack(rows, EGO_COLUMNS)
    where = f"the rollout of scenario {scenario.token!r}"
    require(RUN, "state", ego, f"{where}: an ego")
    try:
        plans = stored_plans(rows)
    except ValueError as error:
        raise DataError(f"{where}: damaged plans: {error}", hint="make the run again") from error
    if rows[_NOISE_COLUMNS[0]].null_count:
        noise = sample_noise(task.noise, seed=task.seed, token=task.token, num_steps=len(rows))
    else:
        noise = _stack(rows, _NOISE_COLUMNS)
    tracks = scenario.tracks.rows(samples)
    if "track_valid" in rows.schema.names:
        shapes = {"valid": (), "poses": (3,), "velocities": (2,), "sizes": (2,)}
        stored: dict[str, Any] = {
            name: _from_lists(rows[f"track_{name}"], (tracks.num_tracks, *shape), where)
            for name, shape in shapes.items()
        }
        tracks = replace(tracks, **stored)
    return SimulationLog(
        token=scenario.token,
        time_us=scenario.time_us[samples],
        ego=ego,
        tracks=tracks,
        traffic_lights=scenario.traffic_lights.rows(samples),
        expert_time_us=scenario.iteration_times,
        expert_ego=scenario.expert,
        route=scenario.route,
        commands=_stack(rows, _COMMAND_COLUMNS),
        noise=noise,
        plans=plans,
        planning_seconds=rows["planning_seconds"].to_numpy().astype(np.float64),
        degraded=np.array(rows["degraded"].to_numpy(zero_copy_only=False)),
    )


def _stack(rows: pa.RecordBatch, names: Iterable[str]) -> np.ndarray:
    return np.stack([rows[name].to_numpy() for name in names], axis=1)


def num_rows(file: Path) -> int:
    """Rows of a file, of all its rollouts together.

    Raises:
        DataError: It cannot be read.
    """
    return int(_opened(file).metadata.num_rows)


def _opened(file: Path) -> pq.ParquetFile:
    try:
        return pq.ParquetFile(file)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _unreadable(file, error) from error


def _unreadable(file: Path, error: Exception) -> DataError:
    return DataError(f"{str(file)!r} cannot be read: {error}", hint="make the run again")


class RolloutReader:
    """Reads rollouts; keeps the row group of the last one, as its neighbours are read next."""

    def __init__(self) -> None:
        self._file: pq.ParquetFile | None = None
        self._path = Path()
        self._starts = np.zeros(1, np.int64)  # first row of every row group, and the end
        self._group = -1
        self._rows = pa.table({})

    def read(self, place: Place) -> pa.RecordBatch:
        """The rows of a rollout, all columns.

        Raises:
            DataError: The file cannot be read, or does not hold them.
        """
        if self._file is None or self._path != place.file:
            self._file, self._path, self._group = _opened(place.file), place.file, -1
            columns = {column.name: column.type for column in self._file.schema_arrow}
            for column in [*STATES, *(c for c in TRACKS if c.name in columns)]:
                name, kind = _BEFORE.get(column.name, ("", None))
                is_old = name in columns and columns[name] == kind
                if not is_old and columns.get(column.name) != column.type:
                    what = f"column {column.name!r} is missing or not {column.type}"
                    raise _unreadable(place.file, TypeError(what))
            found = self._file.metadata
            lengths = [found.row_group(i).num_rows for i in range(found.num_row_groups)]
            self._starts = np.cumsum([0, *lengths])
        group = int(np.searchsorted(self._starts, place.row, side="right")) - 1
        if not 0 <= group < len(self._starts) - 1:
            raise _unreadable(place.file, IndexError(f"it has no row {place.row}"))
        if group != self._group:
            try:
                self._rows = self._file.read_row_group(group, use_threads=False)
            except (OSError, pa.ArrowException) as error:
                raise _unreadable(place.file, error) from error
            self._group = group
        first = place.row - int(self._starts[group])
        rows = self._rows.slice(first, place.rows).combine_chunks()
        if len(rows) != place.rows:
            raise _unreadable(place.file, IndexError(f"rows {place.row} and after are cut off"))
        try:
            return _as_today(rows.to_batches()[0])
        except ValueError as error:
            raise _unreadable(place.file, error) from error


def _as_today(rows: pa.RecordBatch) -> pa.RecordBatch:
    """A rollout as this version stores it, whichever has written it."""
    if "plan_poses" in rows.schema.names:
        plans = rows["plan_poses"].flatten().to_numpy().reshape(len(rows), -1, 3)
        seconds = rows["planning_seconds"].cast(pa.float32())
        steps = _packed(plans, _stack(rows, EGO_COLUMNS))
        for name, column in zip(_BEFORE, (seconds, steps), strict=True):
            place = rows.schema.get_field_index(_BEFORE[name][0])
            rows = rows.set_column(place, STATES.field(name), column)
        schema = pa.schema([_FIELDS.get(field.name, field) for field in rows.schema])
        rows = pa.RecordBatch.from_arrays(rows.columns, schema=schema)
    return rows


class PartWriter:
    """Writes rollouts into new files of a folder; a file is there when it is whole."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._number = next_number(folder)
        self._writer: TableWriter | None = None
        self._partial = folder  # what it writes to
        self._pending: list[tuple[Task, pa.RecordBatch]] = []
        self._count = self._rows = self._bytes = 0  # in the file under way
        self._pending_bytes = 0

    def add(self, task: Task, rows: pa.RecordBatch) -> Place:
        """Write the rows of a rollout, or keep them until their row group is full.

        They have columns of `STATES`, and of `TRACKS` in all rollouts or in none.

        Returns:
            Where it will be.
        """
        place = Place(self._path, self._rows, len(rows))
        self._pending.append((task, rows))
        size = rows.get_total_buffer_size()
        self._count += 1
        self._rows += len(rows)
        self._bytes += size
        self._pending_bytes += size
        if self._count >= _MAX_FILE[0] or self._bytes >= _MAX_FILE[1]:
            self.close()
        elif len(self._pending) >= _MAX_GROUP[0] or self._pending_bytes >= _MAX_GROUP[1]:
            self._write_group()
        return place

    @property
    def _path(self) -> Path:
        return self.folder / part_name(self._number)

    def _write_group(self) -> None:
        rows = pa.Table.from_batches([batch for _, batch in self._pending]).combine_chunks()
        schema = pa.schema([*_KEY, *rows.schema])
        if self._writer is None:
            self._partial = draft(self._path)
            self._writer = TableWriter(self._partial, schema, **_WRITE_OPTIONS)
        group = pa.Table.from_arrays([*_keys(self._pending), *rows.columns], schema=schema)
        self._writer.write_table(group, row_group_size=len(group))
        self._pending.clear()
        self._pending_bytes = 0

    def close(self) -> None:
        """Finish the file that is under way; the next rollout begins another one."""
        if self._pending:
            self._write_group()
        if self._writer is not None:
            self._writer.close()
            self._partial.replace(self._path)
            self._writer = None
            self._number += 1
        self._count = self._rows = self._bytes = 0

    def discard(self) -> None:
        """Remove what is not finished."""
        self._pending.clear()
        if self._writer is not None:
            with suppress(OSError):
                self._writer.close()
            self._writer = None
            with suppress(OSError):  # a draft is in nobody's way
                self._partial.unlink(missing_ok=True)


def _keys(rollouts: list[tuple[Task, pa.RecordBatch]]) -> list[pa.Array]:
    """The columns of `_KEY`."""
    tasks = [task for task, _ in rollouts]
    lengths = [len(rows) for _, rows in rollouts]
    owner = np.repeat(np.arange(len(tasks), dtype=np.int32), lengths)
    columns: list[pa.Array] = []
    for name in Task._fields:
        values = [getattr(task, name) for task in tasks]
        if name == "seed":
            columns.append(pa.array(np.array(values, np.int64)[owner]))
            continue
        distinct = sorted(set(values))
        codes = np.array([distinct.index(value) for value in values], np.int32)
        columns.append(pa.DictionaryArray.from_arrays(codes[owner], pa.array(distinct)))
    iterations = np.concatenate([np.arange(length, dtype=np.int64) for length in lengths])
    return [*columns, pa.array(iterations)]


def without_key(rows: pa.RecordBatch) -> pa.RecordBatch:
    """A rollout as it was given to `PartWriter.add`."""
    return rows.select(rows.schema.names[len(_KEY) :])


def part_name(number: int) -> str:
    """Name of a file of rollouts."""
    return f"part-{number:05d}.parquet"


def part_file(folder: Path, name: str) -> Path:
    """The file of rollouts in a folder that a table or a journal names.

    Raises:
        DataError: It cannot be the name of one.
    """
    if not _PART.fullmatch(name):
        raise DataError(
            f"{str(folder)!r}: {name!r} is no file of rollouts", hint="make the run again"
        )
    return folder / name


def next_number(folder: Path) -> int:
    """The first number for which, and for all after it, a folder has no file yet."""
    taken = [path.stem.removeprefix("part-") for path in folder.glob("part-*.parquet")]
    return 1 + max((int(number) for number in taken if number.isdigit()), default=-1)
