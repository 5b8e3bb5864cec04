"""A recording as Parquet files, a row per track and time; and the part that a window needs."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pyarrow as pa

from shiftsim.data.recording import EgoTrace, Recording, Window, visible_columns
from shiftsim.data.store import schema, tables
from shiftsim.data.store.tables import require_ranges
from shiftsim.errors import DataError
from shiftsim.kernels import BoolArray, FloatArray, IntArray, kernel
from shiftsim.world.state import NUM_STATE, LightStatus, Tracks, TrafficLights

# which of some tracks are wanted, in order, from when they are there, their kinds and tokens
_Choice: TypeAlias = Callable[[BoolArray, IntArray, Sequence[str]], IntArray]


def write_recording(folder: Path, recording: Recording) -> None:
    """Write frames, lights and tracks of a recording; a DataError where numbers do not fit."""
    count, tracks = len(recording.time_us), recording.tracks
    shape = (count, len(tracks.tokens))
    path = folder / tables.TRACKS
    _require(tracks.valid.shape == shape and tracks.kinds.shape == shape[1:], path)
    for values, width in zip(tracks.arrays[1:], (3, 2, 2), strict=True):
        _require(values.shape == (*shape, width), path)
    lights = recording.lights
    _require(lights.status.shape == (count, len(lights.connector_ids)), folder / tables.LIGHTS)
    blocks_of = {
        tables.FRAMES: [frames_table(recording.time_us)],
        tables.LIGHTS: list(_parts(count, partial(lights_table, lights))),
        tables.TRACKS: list(_parts(count, partial(tracks_table, tracks))),
    }
    for name, blocks in blocks_of.items():
        for block in blocks:
            require_ranges(block, str(folder / name))
    if (np.diff(recording.time_us) < 0).any():  # they may repeat, nuPlan rule 431
        what = f"{folder / tables.FRAMES}: column 'time_us' does not increase"
        raise DataError(what, tables.REPAIR)
    blocks_of[tables.FRAMES] = _split(blocks_of[tables.FRAMES][0])
    for name, blocks in blocks_of.items():
        tables.write_blocks(folder / name, blocks)


def write_ego(folder: Path, ego: EgoTrace) -> None:
    """Write the states of one ego; a DataError where a number is outside of its range."""
    path = tables.ego_file(folder, ego.name)
    _require(ego.states.ndim == 2 and ego.states.shape[1] == NUM_STATE, path)
    table = ego_table(ego.states, ego.first_row)
    require_ranges(table, str(path))
    tables.write_blocks(path, _split(table))


def _require(fits: object, path: Path) -> None:
    if not fits:
        raise DataError(f"{path}: the arrays do not fit together", tables.REPAIR)


def _split(table: pa.Table) -> list[pa.Table]:
    starts = range(0, max(len(table), 1), schema.FRAME_BLOCK)
    return [table.slice(start, schema.FRAME_BLOCK) for start in starts]


def _parts(count: int, make: Callable[[slice], pa.Table]) -> Iterator[pa.Table]:
    """Tables of a recording of so many rows, of about `BLOCK_ROWS` rows each."""
    num_blocks = max(1, round(count / schema.BLOCK_ROWS))
    size = max(1, -(-count // num_blocks))
    return (make(slice(at * size, (at + 1) * size)) for at in range(num_blocks))


def frames_table(time_us: IntArray) -> pa.Table:
    """Rows of `schema.FRAMES`."""
    return _table(schema.FRAMES, np.arange(len(time_us)), time_us)


def ego_table(states: FloatArray, first_row: int) -> pa.Table:
    """Rows of `schema.EGO`."""
    rows = np.arange(first_row, first_row + len(states))
    return _table(schema.EGO, rows, *np.ascontiguousarray(states.T))


def lights_table(lights: TrafficLights, rows: slice) -> pa.Table:
    """Rows of `schema.LIGHTS` for the lights that some rows list, light by light."""
    status = lights.status[rows]
    light, row = np.nonzero(status.T != LightStatus.ABSENT)
    connectors = pa.array(lights.connector_ids, pa.string()).take(pa.array(light))
    return _table(schema.LIGHTS, row + rows.start, light, connectors, status[row, light])


def tracks_table(tracks: Tracks, rows: slice) -> pa.Table:
    """Rows of `schema.TRACKS`, track by track: neighbours in time compress well."""
    part = tracks.rows(rows)
    track, row = np.nonzero(part.valid.T)
    tokens = pa.array(tracks.tokens, pa.string()).take(pa.array(track))
    numbers = [
        values[row, track, axis] for values in part.arrays[1:] for axis in range(values.shape[-1])
    ]
    kinds = tracks.kinds[track]
    return _table(schema.TRACKS, row + rows.start, track, tokens, kinds, *numbers)


def _table(described: pa.Schema, *columns: np.ndarray | pa.Array) -> pa.Table:
    """A table of some columns; numbers that its types cannot hold are errors of their range."""
    arrays = [
        values if isinstance(values, pa.Array) else pa.array(_as_type(values, field.type))
        for field, values in zip(described, columns, strict=True)
    ]
    return pa.Table.from_arrays(arrays, schema=described)


def _as_type(values: np.ndarray, kind: pa.DataType) -> np.ndarray:
    wanted = pa.nulls(0, kind).to_numpy(zero_copy_only=False).dtype
    limits = np.iinfo(wanted) if wanted.kind == "i" else None
    return (np.clip(values, limits.min, limits.max) if limits else values).astype(wanted)


class StoredRecording:
    """Open files of one recording; its rows are read when asked for."""

    def __init__(self, folder: Path, log_name: str, city: str) -> None:
        """Open the files; a DataError where one is missing or damaged."""
        self.log_name, self.city = log_name, city
        self.frames = tables.Table(folder / tables.FRAMES, schema.FRAMES)
        self.lights = tables.Table(folder / tables.LIGHTS, schema.LIGHTS)
        self.tracks = tables.Table(folder / tables.TRACKS, schema.TRACKS)

    @property
    def num_rows(self) -> int:
        """Number of rows in time."""
        return self.frames.num_rows

    def read(self, first: int, last: int) -> Recording:
        """The rows first … last - 1 as a recording of its own, or a DataError."""
        return self._read(first, last, lambda valid, *_: np.flatnonzero(valid.any(axis=0)), False)

    def read_window(self, window: Window, *, validate: bool) -> Recording:
        """The rows of a window, and the tracks that it shows, or a DataError."""
        choose = partial(visible_columns, without=window.ego)
        return self._read(window.first_row, window.last_row, choose, validate)

    def _read(self, first: int, last: int, choose: _Choice, validate: bool) -> Recording:
        frames = _rows(self.frames, first, last, validate)
        time_us = tables.column(frames, "time_us")
        if validate and (np.diff(time_us) < 0).any():
            what = f"{self.frames.path}: column 'time_us' does not increase"
            raise DataError(what, tables.REPAIR)
        lights = self._lights(first, last, validate)
        tracks = self._tracks(first, last, choose, validate)
        return Recording(self.log_name, self.city, time_us, tracks, lights)

    def _lights(self, first: int, last: int, validate: bool) -> TrafficLights:
        found = self.lights.read(self.lights.blocks(first, last), validate=validate)
        if not len(found):
            return TrafficLights.empty(last - first)
        at, each = _rows_of(found, "light", first, last)
        listed = (at >= 0).any(axis=0)
        at, names = at[:, listed], _texts(found["connector"], each[listed])
        status = np.where(at >= 0, tables.column(found, "status")[at], np.int8(LightStatus.ABSENT))
        return TrafficLights(names, status)

    def _tracks(self, first: int, last: int, choose: _Choice, validate: bool) -> Tracks:
        found = self.tracks.read(self.tracks.blocks(first, last), validate=validate)
        if not len(found):
            return Tracks.empty(last - first)
        at, each = _rows_of(found, "track", first, last)
        kinds = tables.column(found, "kind")[each].astype(np.int64)
        tokens = _texts(found["token"], each)
        order = choose(at >= 0, kinds, tokens)
        at = at.take(order, axis=1)
        poses, velocities, sizes = (np.empty((*at.shape, n)) for n in (3, 2, 2))
        boxes = tuple(tables.column(found, name) for name in schema.BOX)
        _fill(at, boxes, (poses, velocities, sizes))
        names = tuple(tokens[i] for i in order)
        return Tracks(at >= 0, poses, velocities, sizes, kinds[order], names)


def _rows_of(found: pa.Table, name: str, first: int, last: int) -> tuple[IntArray, IntArray]:
    """Rows (T, N) of a table about each track, or light, whose number is in a column.

    They are those for the rows `first` … `last` - 1 of the recording, -1 where there is none; and
    any row (N,) of the table about each.
    """
    numbers = tables.column(found, name)
    starts = np.concatenate([[0], np.flatnonzero(numbers[1:] != numbers[:-1]) + 1])
    _, each, place = np.unique(numbers[starts], return_index=True, return_inverse=True)
    at = np.full((last - first, len(each)), -1)
    _find(tables.column(found, "row"), first, np.append(starts, len(numbers)), place, at)
    return at, starts[each]


@kernel
def _find(row: IntArray, first: int, starts: IntArray, place: IntArray, at: IntArray) -> None:
    """Note the rows of a table: runs of them, from `starts` (K + 1,) on, are about `place` (K,)."""
    for run in range(len(place)):
        for box in range(starts[run], starts[run + 1]):
            if 0 <= row[box] - first < len(at):  # row groups hold more than the window
                at[row[box] - first, place[run]] = box


@kernel
def _fill(at: IntArray, boxes: tuple[FloatArray, ...], out: tuple[FloatArray, ...]) -> None:
    """Write rows `at` (T, N) of the columns of `schema.BOX` into arrays of tracks; NaN if -1."""
    x, y, heading, vx, vy, length, width = boxes
    poses, velocities, sizes = out
    for time in range(at.shape[0]):
        for track in range(at.shape[1]):
            box, place = at[time, track], (time, track)
            if box < 0:
                poses[place], velocities[place], sizes[place] = np.nan, np.nan, np.nan
            else:
                poses[time, track, 0], poses[time, track, 1] = x[box], y[box]
                poses[time, track, 2] = heading[box]
                velocities[time, track, 0], velocities[time, track, 1] = vx[box], vy[box]
                sizes[time, track, 0], sizes[time, track, 1] = length[box], width[box]


def _texts(column: pa.ChunkedArray, rows: IntArray) -> tuple[str, ...]:
    """Some texts of a column that names what a row is about."""
    coded = tables.whole(column)
    texts = coded.dictionary.to_pylist()
    return tuple(texts[code] for code in coded.indices.to_numpy()[rows].tolist())


def _rows(table: tables.Table, first: int, last: int, validate: bool) -> pa.Table:
    """The rows first … last - 1 of a table with one row for each, or a DataError."""
    found = table.read(table.blocks(first, last), validate=validate)
    row = tables.column(found, "row")
    start = int(np.searchsorted(row, first))
    rows = row[start : start + last - first]
    if not first < last or not np.array_equal(rows, np.arange(first, last)):
        raise DataError(f"{table.path}: no rows {first} … {last - 1}", hint=tables.REPAIR)
    return found.slice(start, last - first)


def ego_span(table: tables.Table) -> tuple[int, int]:
    """Rows of an ego's first state and behind its last one, or a DataError."""
    rows = tables.column(table.read(columns=["row"]), "row")
    if not len(rows):
        raise DataError(f"{table.path}: there are no states", hint=tables.REPAIR)
    return int(rows[0]), int(rows[-1]) + 1


def ego_states(table: tables.Table, first: int, last: int, *, validate: bool = True) -> FloatArray:
    """(R, 11) states of an ego over the rows first … last - 1 of the recording, or a DataError."""
    found = _rows(table, first, last, validate)
    (batch,) = found.select(schema.EGO_COLUMNS).combine_chunks().to_batches()
    states: FloatArray = batch.to_tensor().to_numpy()
    return states
