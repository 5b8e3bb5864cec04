"""A recording as Parquet files, and the part of it that a window needs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.data.recording import EgoTrace, Recording, Window, visible_columns
from shiftsim.data.store import schema
from shiftsim.data.store.plausible import (
    BOX_LIMITS,
    require_boxes,
    require_recording,
    require_states,
)
from shiftsim.data.store.tables import FRAMES, REPAIR, TRACKS, Table, ego_file, write_blocks
from shiftsim.errors import DataError
from shiftsim.world.ranges import STORE, require
from shiftsim.world.state import NUM_STATE, Tracks, TrafficLights

# which of some tracks are wanted, in order, from when they are there, their kinds and tokens
_Choice: TypeAlias = Callable[[BoolArray, IntArray, Sequence[str]], IntArray]
_MANY = 8  # rows for every value of a column that is written by a dictionary


def write_recording(folder: Path, recording: Recording) -> None:
    """Write frames and tracks of a recording.

    Raises:
        DataError: Its arrays do not fit together, or hold a number outside of its range.
    """
    lights = recording.lights
    require_recording(recording.time_us, recording.tracks, lights, folder)
    offsets = np.arange(len(lights.status) + 1, dtype=np.int32) * lights.status.shape[1]
    status = pa.ListArray.from_arrays(
        pa.array(offsets),
        pa.array(lights.status.reshape(-1), pa.int8()),
        type=schema.FRAMES.field("light_status").type,
    )
    frames = pa.Table.from_arrays([pa.array(recording.time_us), status], schema=schema.FRAMES)
    footer: dict[str, object] = {
        "city": recording.city,
        "log": recording.log_name,
        "connectors": list(lights.connector_ids),
    }
    write_blocks(folder / FRAMES, _split(frames, schema.FRAME_BLOCK), footer, codec="lz4")
    tracks = recording.tracks
    num_blocks = max(1, round(len(tracks) / schema.BLOCK_ROWS))
    rows = max(1, -(-len(tracks) // num_blocks))
    blocks = (_track_block(tracks, slice(at * rows, (at + 1) * rows)) for at in range(num_blocks))
    names = {"tokens": list(tracks.tokens), "kinds": tracks.kinds.tolist()}
    write_blocks(folder / TRACKS, blocks, {**names, "block_rows": rows}, codec="lz4")


def write_ego(folder: Path, ego: EgoTrace) -> None:
    """Write the states of one ego.

    Raises:
        DataError: A number is outside of its range.
    """
    require_states(ego.states, ego_file(folder, ego.name))
    columns = [pa.array(np.ascontiguousarray(ego.states[:, i])) for i in range(NUM_STATE)]
    table = pa.Table.from_arrays(columns, schema=schema.EGO)
    footer = {"name": ego.name, "first_row": ego.first_row}
    few = len(table) // _MANY
    repeating = [n for n, v in zip(table.column_names, columns, strict=True) if _count(v) <= few]
    blocks = _split(table, schema.FRAME_BLOCK)
    write_blocks(ego_file(folder, ego.name), blocks, footer, repeating, codec="lz4")


def _split(table: pa.Table, rows: int) -> list[pa.Table]:
    return [table.slice(start, rows) for start in range(0, max(len(table), 1), rows)]


def _count(values: pa.Array) -> int:
    """How many values there are, each counted once."""
    return len(np.unique(values.to_numpy().view(np.int64)))


def _track_block(tracks: Tracks, rows: slice) -> pa.Table:
    """Boxes of some rows, track by track: neighbours in time compress well."""
    part = tracks.rows(rows)
    track, row = np.nonzero(part.valid.T)
    columns = [pa.array((row + rows.start).astype(np.int32)), pa.array(track.astype(np.int32))]
    for values in (part.poses, part.velocities, part.sizes):
        columns += [pa.array(values[row, track, axis]) for axis in range(values.shape[2])]
    return pa.Table.from_arrays(columns, schema=schema.TRACKS)


@dataclass(frozen=True)
class StoredRecording:
    """Open files of one recording."""

    log_name: str  # its name
    city: str  # map it was recorded on
    frames: Table  # times and lights
    tracks: Table  # boxes
    connectors: tuple[str, ...]  # ids of the connectors that have lights
    tokens: tuple[str, ...]  # tokens of the tracks
    kinds: IntArray  # (N,) AgentKind codes of the tracks
    block_rows: int  # rows of the recording per row group of boxes

    @property
    def num_rows(self) -> int:
        """Number of rows in time."""
        return self.frames.num_rows

    def read(self, first: int, last: int) -> Recording:
        """The rows first … last - 1, as a recording of its own.

        Raises:
            DataError: A file is damaged or does not have the rows.
        """
        return self._read(first, last, lambda valid, kinds, names: np.arange(len(names)), False)

    def read_window(self, window: Window, *, plausible: bool) -> Recording:
        """The rows of a window, and the tracks that it shows.

        Raises:
            DataError: A file is damaged or does not have the rows, or, where `plausible` is asked
                for, a box holds a number outside of its range.
        """
        choose = partial(visible_columns, without=window.ego)
        return self._read(window.first_row, window.last_row, choose, plausible)

    def _read(self, first: int, last: int, choose: _Choice, plausible: bool) -> Recording:
        if not 0 <= first < last <= self.num_rows:
            what = f"no rows {first} … {last - 1}, there are {self.num_rows}"
            raise DataError(f"{self.frames.path}: {what}", hint=REPAIR)
        frames = _rows(self.frames, first, last)
        lights = self._lights(frames)
        tracks = self._tracks(first, last, choose, plausible)
        return Recording(self.log_name, self.city, frames["time_us"].to_numpy(), tracks, lights)

    def _lights(self, frames: pa.Table) -> TrafficLights:
        shape = (len(frames), len(self.connectors))
        status = frames["light_status"].combine_chunks().flatten()
        if len(status) != shape[0] * shape[1]:
            raise DataError(f"{self.frames.path}: light_status has gaps", hint=REPAIR)
        values = status.to_numpy(zero_copy_only=False).reshape(shape)
        return TrafficLights(self.connectors, values)

    def _tracks(self, first: int, last: int, choose: _Choice, plausible: bool) -> Tracks:
        blocks = range(first // self.block_rows, (last - 1) // self.block_rows + 1)
        if blocks[-1] >= self.tracks.num_blocks:
            raise DataError(f"{self.tracks.path}: row groups are missing", hint=REPAIR)
        row, track, *boxes = _views(self.tracks.read(list(blocks)))
        runs = _runs(row, track, first, last)
        seen = np.unique(runs[:, 0])
        if len(seen) and not 0 <= seen[0] <= seen[-1] < len(self.tokens):
            raise DataError(f"{self.tracks.path}: column 'track' names an unknown one", hint=REPAIR)
        place = np.full(len(self.tokens), -1)
        place[seen] = np.arange(len(seen))
        valid = np.zeros((last - first, len(seen)), np.bool_)
        _mark(runs, row, place, first, valid)
        order = choose(valid, self.kinds[seen], [self.tokens[i] for i in seen.tolist()])
        if len(order) < len(seen) or (order != np.arange(len(seen))).any():
            valid, seen = np.ascontiguousarray(valid[:, order]), seen[order]
            place[:] = -1
            place[seen] = np.arange(len(seen))
        dense = _dense(valid)
        inside = _scatter(runs, row, place, first, tuple(boxes), BOX_LIMITS, *dense)
        names = tuple(self.tokens[i] for i in seen.tolist())
        tracks = Tracks(valid, *dense, self.kinds[seen], names)
        if plausible and not inside:
            require_boxes(tracks, last - first, self.tracks.path)
        return tracks


def open_recording(folder: Path) -> StoredRecording:
    """Open the files of a recording.

    Raises:
        DataError: A file or a column is missing, or is damaged.
    """
    frames = Table(folder / FRAMES, schema.FRAMES)
    tracks = Table(folder / TRACKS, schema.TRACKS)
    head = _footer(frames, {"log": str, "city": str, "connectors": [str]})
    names = _footer(tracks, {"tokens": [str], "kinds": [int]})
    require(STORE, "kinds", np.array(names["kinds"], np.float64), f"{tracks.path}: footer")
    kinds = np.array(names["kinds"], np.int64)
    if len(kinds) != len(names["tokens"]):
        raise DataError(f"{tracks.path}: kinds and tokens differ in number", hint=REPAIR)
    connectors, tokens = tuple(head["connectors"]), tuple(names["tokens"])
    rows = names.get("block_rows", schema.FIRST_BLOCK_ROWS)
    if not isinstance(rows, int) or rows < 1:
        raise DataError(f"{tracks.path}: the footer has no good 'block_rows'", hint=REPAIR)
    open_files = head["log"], head["city"], frames, tracks
    return StoredRecording(*open_files, connectors, tokens, kinds, rows)


def _footer(table: Table, kinds: Mapping[str, Any]) -> Mapping[str, Any]:
    """The footer, with entries of the kinds wanted; `[str]` is a list of texts."""
    for name, kind in kinds.items():
        value: Any = table.footer.get(name)
        is_list = isinstance(kind, list) and isinstance(value, list)
        good = all(type(v) is kind[0] for v in value) if is_list else type(value) is kind
        if not good:
            raise DataError(f"{table.path}: the footer has no good {name!r}", hint=REPAIR)
    return table.footer


def open_ego(folder: Path, name: str) -> Table:
    """Open the file of an ego's states."""
    return Table(ego_file(folder, name), schema.EGO)


def ego_span(table: Table) -> tuple[int, int]:
    """Row of the recording of an ego's first state, and one past that of its last.

    Raises:
        DataError: The file is damaged.
    """
    start = int(_footer(table, {"first_row": int})["first_row"])
    return start, start + table.num_rows


def ego_states(table: Table, first: int, last: int) -> FloatArray:
    """(R, 11) states of an ego over the rows first … last - 1 of the recording.

    Raises:
        DataError: The file is damaged or does not have the rows.
    """
    start, stop = ego_span(table)
    if not start <= first < last <= stop:
        raise DataError(f"{table.path}: no rows {first} … {last - 1}", hint=REPAIR)
    columns = _views(_rows(table, first - start, last - start))
    return np.ascontiguousarray(np.array(columns).T)


def whole_ego(table: Table) -> tuple[int, FloatArray]:
    """Row of the recording of the first state, and all states (R, 11) of an ego."""
    start = int(_footer(table, {"first_row": int})["first_row"])
    return start, ego_states(table, start, start + table.num_rows)


def _rows(table: Table, first: int, last: int) -> pa.Table:
    low, high = first // schema.FRAME_BLOCK, (last - 1) // schema.FRAME_BLOCK
    if high >= table.num_blocks:
        raise DataError(f"{table.path}: row groups are missing", hint=REPAIR)
    rows = table.read(list(range(low, high + 1)))
    return rows.slice(first - low * schema.FRAME_BLOCK, last - first)


def _dense(valid: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Arrays (R, N, 3), (R, N, 2) and (R, N, 2), to be filled where valid (R, N), else NaN.

    They share one block: the allocator then keeps it for the next scenario instead of returning it
    to the system, which costs more than reading the file.
    """
    block = np.empty(7 * valid.size)
    if not valid.all():
        block.fill(np.nan)
    poses, velocities, sizes = np.split(block, (3 * valid.size, 5 * valid.size))
    shape = valid.shape
    return poses.reshape(*shape, 3), velocities.reshape(*shape, 2), sizes.reshape(*shape, 2)


def _views(table: pa.Table) -> list[Any]:
    """Columns of a table as arrays, read-only and without a copy where they have one chunk."""
    return [_view(column) for column in table.columns]


def _view(column: pa.ChunkedArray) -> Any:
    if not len(column):
        return _nothing(column.type)
    return (column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()).to_numpy()


def _nothing(kind: pa.DataType) -> Any:
    array = np.empty(0, kind.to_pandas_dtype())
    array.flags.writeable = False
    return array


@kernel
def _runs(row: IntArray, track: IntArray, first: int, last: int) -> IntArray:
    """(M, 3) track, first box and one past the last one of boxes of one track in order of time.

    Only those in the rows first … last - 1 count.
    """
    count = 0
    for box in range(len(row)):
        count += box == 0 or track[box] != track[box - 1] or row[box] <= row[box - 1]
    runs = np.empty((count, 3), np.int64)
    count, begin = 0, 0
    for stop in range(1, len(row) + 1):
        if stop < len(row) and track[stop] == track[stop - 1] and row[stop] > row[stop - 1]:
            continue
        end = stop
        while begin < end and row[begin] < first:
            begin += 1
        while begin < end and row[end - 1] >= last:
            end -= 1
        if begin < end:
            runs[count, 0], runs[count, 1], runs[count, 2] = track[begin], begin, end
            count += 1
        begin = stop
    return runs[:count]


@kernel
def _mark(runs: IntArray, row: IntArray, place: IntArray, first: int, valid: BoolArray) -> None:
    """Note in `valid` (R, N), which is false, where there are boxes."""
    for run in range(len(runs)):
        to = place[runs[run, 0]]
        for box in range(runs[run, 1], runs[run, 2]):
            valid[row[box] - first, to] = True


@kernel
def _scatter(
    runs: IntArray,
    row: IntArray,
    place: IntArray,
    first: int,
    values: tuple[FloatArray, ...],
    limits: FloatArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
) -> bool:
    """Spread boxes of the tracks that have a place over dense arrays.

    Returns whether all are within `limits` (7, 2).
    """
    x, y, heading, vx, vy, length, width = values
    num = np.uint64(poses.shape[1])
    flat, speeds, extent = poses.reshape(-1), velocities.reshape(-1), sizes.reshape(-1)
    one, two, three = np.uint64(1), np.uint64(2), np.uint64(3)  # no index is negative
    good = True
    for run in range(len(runs)):
        to = place[runs[run, 0]]
        if to < 0:
            continue
        for box in range(np.uint64(runs[run, 1]), np.uint64(runs[run, 2])):
            at = np.uint64(row[box] - first) * num + np.uint64(to)
            flat[three * at] = x[box]
            flat[three * at + one] = y[box]
            flat[three * at + two] = heading[box]
            speeds[two * at] = vx[box]
            speeds[two * at + one] = vy[box]
            extent[two * at] = length[box]
            extent[two * at + one] = width[box]
            good &= (x[box] >= limits[0, 0]) & (x[box] <= limits[0, 1])
            good &= (y[box] >= limits[1, 0]) & (y[box] <= limits[1, 1])
            good &= (heading[box] >= limits[2, 0]) & (heading[box] <= limits[2, 1])
            # velocities of static objects are NaN
            good &= not ((vx[box] < limits[3, 0]) | (vx[box] > limits[3, 1]))
            good &= not ((vy[box] < limits[4, 0]) | (vy[box] > limits[4, 1]))
            good &= (length[box] >= limits[5, 0]) & (length[box] <= limits[5, 1])
            good &= (width[box] >= limits[6, 0]) & (width[box] <= limits[6, 1])
    return good
