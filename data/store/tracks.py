"""A recording as Parquet files, and the part of it that a window needs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from shiftsim.data.recording import EgoTrace, Recording, Window, visible_columns
from shiftsim.data.store import schema
from shiftsim.data.store.boxes import (
    HIGHEST,
    SIZE_LIMITS,
    BoxBlock,
    cut_spans,
    mark,
    restored,
    scatter,
    second_differences,
)
from shiftsim.data.store.plausible import (
    require_boxes,
    require_recording,
    require_states,
)
from shiftsim.data.store.tables import FRAMES, REPAIR, TRACKS, Table, ego_file, write_blocks
from shiftsim.errors import DataError
from shiftsim.kernels import BoolArray, FloatArray, IntArray
from shiftsim.world.ranges import STORE, require
from shiftsim.world.state import NUM_STATE, Tracks, TrafficLights

# which of some tracks are wanted, in order, from when they are there, their kinds and tokens
_Choice: TypeAlias = Callable[[BoolArray, IntArray, Sequence[str]], IntArray]


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
    footer = {"name": ego.name, "first_row": ego.first_row}
    starts = range(0, max(len(ego.states), 1), schema.FRAME_BLOCK)
    parts = [ego.states[start : start + schema.FRAME_BLOCK] for start in starts]
    codes = [_codes(part.T.reshape(-1)) for part in parts]
    blocks = [pa.Table.from_arrays([code], schema=schema.EGO) for code in codes]
    write_blocks(ego_file(folder, ego.name), blocks, footer, codec="lz4")


def _codes(values: FloatArray) -> pa.Array:
    return pa.array(second_differences(values).view(np.int64))  # unsigned ones read more slowly


def _split(table: pa.Table, rows: int) -> list[pa.Table]:
    return [table.slice(start, rows) for start in range(0, max(len(table), 1), rows)]


def _track_block(tracks: Tracks, rows: slice) -> pa.Table:
    """Boxes of some rows, track by track: neighbours in time compress well."""
    part = tracks.rows(rows)
    track, row = np.nonzero(part.valid.T)
    motion = [part.poses[..., axis] for axis in range(3)]
    motion += [part.velocities[..., axis] for axis in range(2)]
    columns = [_codes(values[row, track]) for values in motion]
    columns += [pa.array((row + rows.start).astype(np.int32)), pa.array(track.astype(np.int32))]
    columns += [pa.array(part.sizes[row, track, axis]) for axis in range(2)]
    return pa.Table.from_arrays(columns, schema=schema.TRACKS)


@dataclass(frozen=True)
class StoredRecording:
    """Open files of one recording."""

    folder: Path  # where they are
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
        blocks = _blocks(self.frames, first, last)
        times, lights = self._frames(blocks)
        begin = blocks[0] * schema.FRAME_BLOCK
        if begin + len(times) < last:
            raise DataError(f"{self.frames.path}: row groups are too short", hint=REPAIR)
        rows = slice(first - begin, last - begin)
        tracks = self._tracks(first, last, choose, plausible)
        return Recording(self.log_name, self.city, times[rows], tracks, lights.rows(rows))

    def _frames(self, blocks: list[int]) -> tuple[IntArray, TrafficLights]:
        """Times and lights of the rows of some row groups."""
        if not self.connectors:
            times = _view(self.frames.read(blocks, ["time_us"]).column(0))
            return times, TrafficLights.empty(len(times))
        frames = self.frames.read(blocks)
        shape = (len(frames), len(self.connectors))
        status = _whole(frames["light_status"]).values
        if len(status) != shape[0] * shape[1]:
            raise DataError(f"{self.frames.path}: light_status has gaps", hint=REPAIR)
        values = status.to_numpy(zero_copy_only=False).reshape(shape)
        return _view(frames["time_us"]), TrafficLights(self.connectors, values)

    def _tracks(self, first: int, last: int, choose: _Choice, plausible: bool) -> Tracks:
        blocks = range(first // self.block_rows, (last - 1) // self.block_rows + 1)
        if blocks[-1] >= self.tracks.num_blocks:
            raise DataError(f"{self.tracks.path}: row groups are missing", hint=REPAIR)
        parts = [self._block(block) for block in blocks]
        place = np.zeros(len(self.tokens), np.int64)  # of tracks in the window, from 1
        spans = [self._spans(part, first, last, place) for part in parts]
        seen, names = place.nonzero()[0], self.tokens
        if len(seen) < len(names):
            names = tuple([names[i] for i in seen.tolist()])
        place[seen] = np.arange(1, len(seen) + 1)
        there = np.zeros((len(seen), last - first), np.bool_)
        for span in spans:
            mark(span, place, there)
        order = choose(there.T, self.kinds[seen], names)
        if len(order) < len(seen) or (order != np.arange(len(seen))).any():
            there, seen = there[order], seen[order]
            names = tuple([names[i] for i in order.tolist()])
            place[:] = 0
            place[seen] = np.arange(1, len(seen) + 1)
        valid = np.ascontiguousarray(there.T)
        dense = _dense(valid)
        poses, velocities, sizes = (array.reshape(-1) for array in dense)
        out = valid.shape, HIGHEST, SIZE_LIMITS, poses.view(np.uint64), velocities.view(np.uint64)
        pairs = zip(parts, spans, strict=True)
        inside = all([scatter(*part[2:], span, place, *out, sizes) for part, span in pairs])
        tracks = Tracks(valid, *dense, self.kinds[seen], names)
        if plausible and not inside:
            require_boxes(tracks, last - first, self.tracks.path)
        return tracks

    def _spans(self, part: BoxBlock, first: int, last: int, place: IntArray) -> IntArray:
        spans = np.empty((len(part.row) + 1, 3), np.int64)
        count = cut_spans(part.row, part.track, first, last, place, spans)
        if count < 0:
            raise DataError(f"{self.tracks.path}: column 'track' names an unknown one", hint=REPAIR)
        return spans[: count + 1]

    def _block(self, block: int) -> BoxBlock:
        found, is_plain = self.tracks.read([block]), _is_former(self.tracks)
        *motion, row, track, length, width = _views(found)
        bits = tuple([column.view(np.uint64) for column in motion])
        return BoxBlock(row, track, bits, (length, width), is_plain)

    def boxes(self) -> tuple[IntArray, IntArray, FloatArray]:
        """All boxes as they are stored: rows (A,), tracks (A,) and `schema.MOTION` (A, 5).

        Raises:
            DataError: The file is damaged.
        """
        parts = [self._block(block) for block in range(self.tracks.num_blocks)]
        for part in parts:
            self._spans(part, 0, 0, np.zeros(len(self.tokens), np.int64))  # all tracks are known
        motion = [
            np.column_stack(
                [c.view(np.float64) if part.is_plain else restored(c) for c in part.motion]
            )
            for part in parts
        ]
        row, track = (np.concatenate([part[i] for part in parts]).astype(np.int64) for i in (0, 1))
        return row, track, np.concatenate(motion)


def open_recording(folder: Path) -> StoredRecording:
    """Open the files of a recording.

    Raises:
        DataError: A file or a column is missing, or is damaged.
    """
    frames = Table(folder / FRAMES, schema.FRAMES)
    tracks = Table(folder / TRACKS, schema.TRACKS, schema.FORMER_TRACKS)
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
    open_files = folder, head["log"], head["city"], frames, tracks
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
    return Table(ego_file(folder, name), schema.EGO, schema.FORMER_EGO)


def _is_former(table: Table) -> bool:
    return schema.MOTION[0] in table.names


def ego_span(table: Table) -> tuple[int, int]:
    """Row of the recording of an ego's first state, and one past that of its last.

    Raises:
        DataError: The file is damaged.
    """
    start = int(_footer(table, {"first_row": int})["first_row"])
    return start, start + table.num_rows // (1 if _is_former(table) else NUM_STATE)


def ego_states(table: Table, first: int, last: int) -> FloatArray:
    """(R, 11) states of an ego over the rows first … last - 1 of the recording.

    Raises:
        DataError: The file is damaged or does not have the rows.
    """
    start, stop = ego_span(table)
    if not start <= first < last <= stop:
        raise DataError(f"{table.path}: no rows {first} … {last - 1}", hint=REPAIR)
    blocks = _blocks(table, first - start, last - start)
    if _is_former(table):
        columns = np.array(_views(table.read(blocks)))
    else:
        codes = [_view(table.read([block]).column(0)).view(np.uint64) for block in blocks]
        if any(len(code) % NUM_STATE for code in codes):
            raise DataError(f"{table.path}: a row group holds no whole states", hint=REPAIR)
        parts = [restored(code).reshape(NUM_STATE, -1) for code in codes]
        columns = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
    low = start + blocks[0] * schema.FRAME_BLOCK
    if columns.shape[1] < last - low:
        raise DataError(f"{table.path}: row groups are too short", hint=REPAIR)
    return np.ascontiguousarray(columns[:, first - low : last - low].T)


def whole_ego(table: Table) -> tuple[int, FloatArray]:
    """Row of the recording of the first state, and all states (R, 11) of an ego."""
    start, stop = ego_span(table)
    return start, ego_states(table, start, stop)


def _blocks(table: Table, first: int, last: int) -> list[int]:
    """The row groups of frames or states that hold the rows first … last - 1."""
    blocks = range(first // schema.FRAME_BLOCK, (last - 1) // schema.FRAME_BLOCK + 1)
    if blocks[-1] >= table.num_blocks:
        raise DataError(f"{table.path}: row groups are missing", hint=REPAIR)
    return list(blocks)


def _dense(valid: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Arrays (R, N, 3), (R, N, 2) and (R, N, 2), to be filled where valid (R, N), else NaN.

    They share one block: the allocator then keeps it for the next scenario instead of returning it
    to the system, which costs more than reading the file.
    """
    size = valid.size
    block = np.empty(7 * size)
    if not valid.all():
        block.fill(np.nan)
    poses, velocities, sizes = block[: 3 * size], block[3 * size : 5 * size], block[5 * size :]
    shape = valid.shape
    return poses.reshape(*shape, 3), velocities.reshape(*shape, 2), sizes.reshape(*shape, 2)


def _views(table: pa.Table) -> list[Any]:
    """Columns of a table as arrays, read-only and without a copy where they have one chunk."""
    return [_view(column) for column in table.columns]


def _view(column: pa.ChunkedArray) -> Any:
    return _whole(column).to_numpy() if len(column) else _nothing(column.type)


def _whole(column: pa.ChunkedArray) -> pa.Array:
    return column.chunk(0) if column.num_chunks == 1 else column.combine_chunks()


def _nothing(kind: pa.DataType) -> Any:
    array = np.empty(0, kind.to_pandas_dtype())
    array.flags.writeable = False
    return array
