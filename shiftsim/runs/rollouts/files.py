"""Rollouts on disk: a row per sample, and rows of many rollouts in Parquet files.

Rows have what the scenario does not hold already. Recorded tracks (unless the traffic reacts),
lights, route and expert come back from the store when a rollout is read, and noise from its key.
All is stored to the last bit but plans, on which no score depends: they are rounded.

A worker sends the rows of a rollout as bytes, which wait in the journal; when the run ends they go
into files `part-*.parquet`. Most of the time of writing a small Parquet file goes into headers,
rollouts of one scenario have much in common, and clusters dislike many small files: so rollouts
share row groups, and a `RolloutLocation` says which rows are whose. The first columns name the
task, for readers that know nothing of locations.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from shiftsim.data.store.schema import BOX, EGO_COLUMNS, list_of
from shiftsim.data.store.tables import write_blocks
from shiftsim.errors import DataError
from shiftsim.runs.rollouts import Task, damaged
from shiftsim.sim.log import NUM_KEPT, Seen, SimulationLog, as_recorded
from shiftsim.sim.noise import sample_noise
from shiftsim.sim.perception import noise_of
from shiftsim.world.ranges import RUN, require
from shiftsim.world.scenario import Scenario
from shiftsim.world.state import Tracks

COMMAND_COLUMNS = ("command_accel_mps2", "command_steering_rate_radps")
NOISE_COLUMNS = ("noise_accel_mps2", "noise_steering_rate_radps")
_PLAN_COLUMNS = ("plan_dx_m", "plan_dy_m", "plan_dheading_rad")
_PER_UNIT = 2048  # plans are rounded to this part of a metre and radian


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
        **dict.fromkeys(_PLAN_COLUMNS, list_of(pa.float32())),
    }
)
TRACKS = _schema(
    {
        "track_tokens": list_of(pa.string()),
        **dict.fromkeys((f"track_{name}" for name in BOX), list_of(pa.float64())),
    }
)
SEEN = _schema(  # what the planner saw; NaN and empty where that was the truth
    {
        **dict.fromkeys(("seen_x_m", "seen_y_m", "seen_heading_rad"), pa.float64()),
        "seen_track_tokens": list_of(pa.string()),
        **dict.fromkeys((f"seen_track_{name}" for name in BOX[:2]), list_of(pa.float64())),
        **dict.fromkeys((f"seen_track_{name}" for name in BOX[2:]), list_of(pa.float32())),
    }
)

KINDS = "track_kinds"  # beside `TRACKS` where there are other tracks than in the scenario


def rollout_rows(
    log: SimulationLog,
    *,
    with_tracks: bool,
    with_noise: bool = True,
    with_kinds: bool = False,
    with_seen: bool = False,
) -> pa.RecordBatch:
    """Columns of `STATES`, and of `TRACKS` and `SEEN` where asked; without noise it is null."""
    columns = [pa.array(log.time_us)]
    for values in (log.ego, log.commands):
        columns += map(pa.array, np.ascontiguousarray(values.T))
    empty = [pa.nulls(len(log.time_us), pa.float64())] * len(NOISE_COLUMNS)
    columns += map(pa.array, np.ascontiguousarray(log.noise.T)) if with_noise else empty
    columns += [pa.array(log.planning_seconds.astype(np.float32)), pa.array(log.degraded)]
    # poses behind the first that is unknown are left out
    known = np.logical_and.accumulate(~np.isnan(log.plans[..., 0]), axis=1)
    offsets = np.rint((log.plans - log.ego[:, None, :3])[known] * _PER_UNIT) / _PER_UNIT
    columns += [_lists(known.sum(axis=1), of) for of in offsets.T.astype(np.float32)]
    schema = [*STATES, *(TRACKS if with_tracks else ()), *(SEEN if with_seen else ())]
    columns += _box_columns(log.tracks) if with_tracks else []
    if with_seen:
        count, types = len(log.time_us), SEEN.types[3:]
        seen = log.seen or Seen(np.full((count, 3), np.nan), Tracks.empty(count))
        columns += map(pa.array, np.ascontiguousarray(seen.ego.T))
        columns += map(pa.Array.cast, _box_columns(seen.tracks), types)
    if with_kinds:
        codes = pa.array(log.tracks.kinds[np.nonzero(log.tracks.valid)[1]], pa.int8())
        columns.append(_lists(log.tracks.valid.sum(axis=1), codes))
        schema.append(pa.field(KINDS, list_of(pa.int8()), nullable=False))
    return pa.RecordBatch.from_arrays(columns, schema=pa.schema(schema))


def _box_columns(tracks: Tracks) -> list[pa.Array]:
    """Columns of `TRACKS`."""
    row, track = np.nonzero(tracks.valid)
    lengths = tracks.valid.sum(axis=1)
    columns = [_lists(lengths, pa.array(tracks.tokens, pa.string()).take(pa.array(track)))]
    for values in tracks.arrays[1:]:
        columns += [_lists(lengths, of) for of in values[row, track].T]
    return columns


def _lists(lengths: np.ndarray, items: np.ndarray | pa.Array) -> pa.Array:
    offsets = pa.array(np.append(0, np.cumsum(lengths)).astype(np.int32))
    values = items if isinstance(items, pa.Array) else pa.array(np.ascontiguousarray(items))
    return pa.ListArray.from_arrays(offsets, values, type=list_of(values.type))


def complete_rollout(
    rows: pa.RecordBatch, scenario: Scenario, task: Task, *, is_partial: bool = False
) -> SimulationLog:
    """The stored rollout of a task, completed by its noise and scenario; or a DataError."""
    time_us = rows["time_us"].to_numpy()
    if is_partial:
        scenario = replace(scenario, iteration_rows=scenario.iteration_rows[: len(time_us) + 1])
    log, may_end = as_recorded(scenario), scenario.script and scenario.script.termination
    samples = slice(len(time_us) if may_end else None)  # it may have ended before its time
    if not np.array_equal(time_us, log.time_us[samples]):
        what = f"scenario {scenario.token!r} in the store is not the one that was driven"
        raise DataError(what, hint="use the store that the manifest names")
    ego = stack(rows, EGO_COLUMNS)
    where = f"the rollout of scenario {scenario.token!r}"
    require(RUN, "state", ego, f"{where}: an ego")
    tracks = log.tracks.rows(samples)
    try:
        plans = stored_plans(rows)
        if KINDS in rows.schema.names:
            names = (rows[name].flatten().to_pylist() for name in (TRACKS.names[0], KINDS))
            kinds = dict(zip(*names, strict=True))  # in order of appearance
            codes = np.array([*kinds.values()], np.int64)
            tracks = replace(tracks, tokens=tuple(kinds), kinds=codes)
        if "track_tokens" in rows.schema.names:
            stored: dict[str, Any] = stored_tracks(rows, tracks.tokens)
            tracks = replace(tracks, **stored)
        seen = _stored_seen(rows, scenario.tracks)
    except ValueError as error:
        raise DataError(f"{where} is damaged: {error}", hint="make the run again") from error
    if rows[NOISE_COLUMNS[0]].null_count:
        key: dict[str, Any] = {"seed": task.seed, "token": task.token, "num_steps": len(rows)}
        noise = sample_noise(noise_of(task.noise), **key)
    else:
        noise = stack(rows, NOISE_COLUMNS)
    return replace(
        log,
        time_us=log.time_us[samples],
        ego=ego,
        tracks=tracks,
        traffic_lights=log.traffic_lights.rows(samples),
        commands=stack(rows, COMMAND_COLUMNS),
        noise=noise,
        plans=plans,
        planning_seconds=rows["planning_seconds"].to_numpy().astype(np.float64),
        degraded=np.array(rows["degraded"].to_numpy(zero_copy_only=False)),
        seen=seen,
    )


def _stored_seen(rows: pa.RecordBatch, true: Tracks) -> Seen | None:
    """What was seen in a stored rollout, None where it was the truth; a ValueError if damaged."""
    if SEEN.names[0] not in rows.schema.names:
        return None
    ego = stack(rows, SEEN.names[:3])
    if np.isnan(ego).all():
        return None
    tokens = tuple(rows["seen_track_tokens"].flatten().unique().to_pylist())
    kinds = dict(zip(true.tokens, true.kinds.tolist(), strict=True))
    # a track that was lost has another token
    codes = [kinds[name if name in kinds else name.rpartition("~")[0]] for name in tokens]
    boxes: dict[str, Any] = stored_tracks(rows, tokens, "seen_track_")
    return Seen(ego, Tracks(**boxes, kinds=np.array(codes, np.int64), tokens=tokens))


def _cells(column: pa.Array, lengths: np.ndarray, name: str) -> pa.Array:
    """The items of lists that have these lengths (K,), else a ValueError."""
    if not np.array_equal(np.diff(column.offsets.to_numpy()), lengths):
        raise ValueError(f"the lists of {name!r} are too short or too long")
    return column.flatten()


def stored_plans(rows: pa.RecordBatch) -> np.ndarray:
    """(K, P, 3) poses of the plans of a rollout, to 1/4096 m and rad, or a ValueError."""
    lengths = np.diff(rows[_PLAN_COLUMNS[0]].offsets.to_numpy())
    if (lengths > NUM_KEPT).any():
        raise ValueError(f"a plan of {lengths.max()} poses")
    known = np.arange(NUM_KEPT) < lengths[:, None]
    offsets = np.full((*known.shape, 3), np.nan)
    for axis, name in enumerate(_PLAN_COLUMNS):
        offsets[known, axis] = _cells(rows[name], lengths, name).to_numpy()
    return stack(rows, EGO_COLUMNS[:3])[:, None] + offsets


def stored_tracks(
    rows: pa.RecordBatch, tokens: Sequence[str], prefix: str = "track_"
) -> dict[str, np.ndarray]:
    """Fields `valid`, `poses`, `velocities`, `sizes` of N stored tracks, or a ValueError."""
    names = rows[f"{prefix}tokens"]
    lengths = np.diff(names.offsets.to_numpy())
    found = pc.index_in(names.flatten(), pa.array(tokens, pa.string()))
    if found.null_count:
        raise ValueError("it has tracks that the scenario has not")
    row, track = np.repeat(np.arange(len(rows)), lengths), found.to_numpy()
    valid = np.zeros((len(rows), len(tokens)), np.bool_)
    valid[row, track] = True
    if np.count_nonzero(valid) != len(row):
        raise ValueError("it has a track twice in a row")
    columns = [f"{prefix}{name}" for name in BOX]
    boxes = np.stack([_cells(rows[name], lengths, name).to_numpy() for name in columns], axis=1)
    out = {"valid": valid}
    for name, part in zip(
        ("poses", "velocities", "sizes"), np.split(boxes, [3, 5], axis=1), strict=True
    ):
        out[name] = np.full((*valid.shape, part.shape[1]), np.nan)
        out[name][row, track] = part
    return out


def encode_rows(rows: pa.RecordBatch) -> bytes:
    """The rows of a rollout as bytes, an Arrow stream."""
    sink = pa.BufferOutputStream()
    options = pa.ipc.IpcWriteOptions(compression="lz4", use_threads=False)
    with pa.ipc.new_stream(sink, rows.schema, options=options) as stream:
        stream.write_batch(rows)
    return sink.getvalue().to_pybytes()


def decode_rows(data: bytes) -> pa.RecordBatch:
    """What `encode_rows` was given."""
    return pa.ipc.open_stream(data).read_next_batch()


def stack(rows: pa.RecordBatch, names: Iterable[str]) -> np.ndarray:
    """(K, C) numbers of C columns."""
    return np.stack([rows[name].to_numpy() for name in names], axis=1)


FOLDER = "rollouts"
_PART = re.compile(r"part-(\d+)\.parquet")
_GROUP, _FILE = 16, 1024  # rollouts of a row group and of a file
KEY = {"planner": pa.string(), "noise": pa.string(), "seed": pa.int64(), "token": pa.string()}
_KEY = _schema(KEY | {"iteration": pa.int64()})


class RolloutLocation(NamedTuple):
    """Where a rollout is."""

    file: Path  # the Parquet file
    row: int  # its first row there
    rows: int  # number of its rows


class RolloutReader:
    """Reads rollouts; keeps the row group of the last one, as its neighbours are read next."""

    def __init__(self) -> None:
        self._file: pq.ParquetFile | None = None
        self._path = Path()
        self._rows = pa.table({})  # of a row group
        self._first = 0  # its first row

    def read(self, location: RolloutLocation) -> pa.RecordBatch:
        """The rows of a rollout, all columns, or a DataError."""
        try:
            if self._file is None or self._path != location.file:
                self._open(location.file)
            if not 0 <= location.row - self._first < len(self._rows):
                self._read_group(location.row)
            first = location.row - self._first
            rows = self._rows.slice(first, location.rows).combine_chunks()
            if len(rows) != location.rows:
                raise IndexError(f"rows {location.row} and after are cut off")
            batch = rows.to_batches()[0]
            noise = {batch[name].null_count for name in NOISE_COLUMNS}
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                nulls = column.null_count
                if pa.types.is_list(column.type):
                    nulls += column.flatten().null_count
                if nulls and not (name in NOISE_COLUMNS and noise == {len(batch)}):
                    raise ValueError(f"column {name!r} holds {nulls} nulls")
            return batch
        except (OSError, ValueError, TypeError, IndexError, pa.ArrowException) as error:
            raise damaged(location.file, str(error)) from error

    def _open(self, path: Path) -> None:
        self._file, self._rows = pq.ParquetFile(path), pa.table({})
        self._path = path
        found = self._file.schema_arrow
        there = (table for table in (TRACKS, SEEN) if table.names[0] in found.names)
        for column in chain(STATES, *there):
            at = found.get_field_index(column.name)
            if at < 0 or not found.field(at).type.equals(column.type):
                raise TypeError(f"column {column.name!r} is missing or not {column.type}")

    def _read_group(self, row: int) -> None:
        """Read the row group that holds a row."""
        assert self._file is not None
        about = self._file.metadata
        ends = np.cumsum([about.row_group(i).num_rows for i in range(about.num_row_groups)])
        group = int(np.searchsorted(ends, row, "right"))
        if row < 0 or group == len(ends):
            raise IndexError(f"it has no row {row}")
        self._rows = self._file.read_row_group(group, use_threads=False)
        self._first = int(ends[group]) - len(self._rows)


def write_rollouts(
    folder: Path, rollouts: Iterable[tuple[Task, pa.RecordBatch]]
) -> dict[Task, RolloutLocation]:
    """Write rollouts, of the same columns, into new files of a folder, and say where they are."""
    rollouts, locations = iter(rollouts), dict[Task, RolloutLocation]()
    for first in rollouts:
        path, of_file = new_file(folder), chain([first], islice(rollouts, _FILE - 1))
        write_blocks(path, _row_groups(path, of_file, locations))
    return locations


def _row_groups(
    path: Path,
    rollouts: Iterator[tuple[Task, pa.RecordBatch]],
    locations: dict[Task, RolloutLocation],
) -> Iterator[pa.Table]:
    """The rollouts of a file, some of them per table; their locations are filled in."""
    row = 0
    while group := list(islice(rollouts, _GROUP)):
        for task, rows in group:
            locations[task] = RolloutLocation(path, row, len(rows))
            row += len(rows)
        columns = [name for name in group[0][1].schema.names if name not in _KEY.names]
        batches = [rows.select(columns) for _, rows in group]
        table = pa.Table.from_batches(batches).combine_chunks()
        owner = pa.array(np.repeat(np.arange(len(group)), [*map(len, batches)]))
        keys = [
            pa.array([getattr(task, name) for task, _ in group], kind).take(owner)
            for name, kind in KEY.items()
        ]
        keys.append(pa.array(np.concatenate([np.arange(len(batch)) for batch in batches])))
        schema = pa.schema([*_KEY, *table.schema])
        yield pa.Table.from_arrays([*keys, *table.columns], schema=schema)


def part_file(folder: Path, name: str) -> Path:
    """The file of rollouts in a folder that a table or a journal names, or a DataError."""
    if not _PART.fullmatch(name):
        raise DataError(f"{str(folder)!r}: {name!r} is no file of rollouts", "make the run again")
    return folder / name


def new_file(folder: Path) -> Path:
    """A file of rollouts that a folder does not have, numbered after all that it has."""
    taken = [int(found[1]) for path in folder.iterdir() if (found := _PART.fullmatch(path.name))]
    return folder / f"part-{1 + max(taken, default=-1):05d}.parquet"
