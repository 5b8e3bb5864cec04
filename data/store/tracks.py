"""A recording as Parquet files, and the part of it that a window needs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from shiftsim.arrays import BoolArray, FloatArray, IntArray, kernel
from shiftsim.data.recording import EgoTrace, Recording
from shiftsim.data.store import schema
from shiftsim.data.store.plausible import require_recording, require_states
from shiftsim.data.store.tables import FRAMES, REPAIR, TRACKS, Table, ego_file, write_blocks
from shiftsim.errors import DataError
from shiftsim.world.ranges import STORE, require
from shiftsim.world.state import NUM_STATE, Tracks, TrafficLights


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
    write_blocks(folder / FRAMES, _split(frames, schema.FRAME_BLOCK), footer)
    tracks = recording.tracks
    starts = range(0, max(len(tracks), 1), schema.BLOCK_ROWS)
    blocks = (_track_block(tracks, start) for start in starts)
    footer = {"tokens": list(tracks.tokens), "kinds": tracks.kinds.tolist()}
    write_blocks(folder / TRACKS, blocks, footer)


def write_ego(folder: Path, ego: EgoTrace) -> None:
    """Write the states of one ego.

    Raises:
        DataError: A number is outside of its range.
    """
    require_states(ego.states, ego_file(folder, ego.name))
    columns = [pa.array(np.ascontiguousarray(ego.states[:, i])) for i in range(NUM_STATE)]
    table = pa.Table.from_arrays(columns, schema=schema.EGO)
    footer = {"name": ego.name, "first_row": ego.first_row}
    write_blocks(ego_file(folder, ego.name), _split(table, schema.FRAME_BLOCK), footer)


def _split(table: pa.Table, rows: int) -> list[pa.Table]:
    return [table.slice(start, rows) for start in range(0, max(len(table), 1), rows)]


def _track_block(tracks: Tracks, start: int) -> pa.Table:
    """Boxes of some rows, track by track: neighbours in time compress well."""
    part = tracks.rows(slice(start, start + schema.BLOCK_ROWS))
    track, row = np.nonzero(part.valid.T)
    columns = [pa.array((row + start).astype(np.int32)), pa.array(track.astype(np.int32))]
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

    @property
    def num_rows(self) -> int:
        """Number of rows in time."""
        return self.frames.num_rows

    def read(self, first: int, last: int) -> Recording:
        """The rows first … last - 1, as a recording of its own.

        Raises:
            DataError: A file is damaged or does not have the rows.
        """
        if not 0 <= first < last <= self.num_rows:
            what = f"no rows {first} … {last - 1}, there are {self.num_rows}"
            raise DataError(f"{self.frames.path}: {what}", hint=REPAIR)
        frames = _rows(self.frames, first, last)
        tracks, lights = self._read_tracks(first, last), self._lights(frames)
        return Recording(self.log_name, self.city, frames["time_us"].to_numpy(), tracks, lights)

    def _lights(self, frames: pa.Table) -> TrafficLights:
        shape = (len(frames), len(self.connectors))
        status = frames["light_status"].combine_chunks().flatten()
        if len(status) != shape[0] * shape[1]:
            raise DataError(f"{self.frames.path}: light_status has gaps", hint=REPAIR)
        values = status.to_numpy(zero_copy_only=False).reshape(shape)
        return TrafficLights(self.connectors, values)

    def _read_tracks(self, first: int, last: int) -> Tracks:
        blocks = range(first // schema.BLOCK_ROWS, (last - 1) // schema.BLOCK_ROWS + 1)
        if blocks[-1] >= self.tracks.num_blocks:
            raise DataError(f"{self.tracks.path}: row groups are missing", hint=REPAIR)
        table = self.tracks.read(list(blocks))
        row, track, *values = _views(table, schema.TRACKS.names)
        if len(row) and not 0 <= track.min() <= track.max() < len(self.tokens):
            raise DataError(f"{self.tracks.path}: column 'track' names an unknown one", hint=REPAIR)
        place = _places(row, track, first, last, len(self.tokens))
        seen = np.flatnonzero(place >= 0)
        shape = (last - first, len(seen))
        valid = np.zeros(shape, np.bool_)
        poses, velocities, sizes = _dense(shape)
        _scatter(row, track, place, first, tuple(values), valid, poses, velocities, sizes)
        names = tuple(self.tokens[i] for i in seen.tolist())
        return Tracks(valid, poses, velocities, sizes, self.kinds[seen], names)


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
    return StoredRecording(head["log"], head["city"], frames, tracks, connectors, tokens, kinds)


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
    rows = _rows(table, first - start, last - start)
    states = np.empty((last - first, NUM_STATE))
    for index, values in enumerate(_views(rows, schema.EGO_COLUMNS)):
        states[:, index] = values
    return states


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


def _dense(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Arrays (R, N, 3), (R, N, 2) and (R, N, 2), not filled.

    They share one block: the allocator then keeps it for the next scenario instead of returning it
    to the system, which costs more than reading the file.
    """
    num = shape[0] * shape[1]
    block = np.empty(7 * num)
    return (
        block[: 3 * num].reshape(*shape, 3),
        block[3 * num : 5 * num].reshape(*shape, 2),
        block[5 * num :].reshape(*shape, 2),
    )


def _views(table: pa.Table, names: Sequence[str]) -> list[Any]:
    """Columns of a table as arrays, read-only and without a copy where it has one chunk."""
    whole = table.combine_chunks()
    return [
        whole[name].chunk(0).to_numpy() if len(whole) else _nothing(whole[name].type)
        for name in names
    ]


def _nothing(kind: pa.DataType) -> Any:
    array = np.empty(0, kind.to_pandas_dtype())
    array.flags.writeable = False
    return array


@kernel
def _places(row: IntArray, track: IntArray, first: int, last: int, num: int) -> IntArray:
    """(num,) position of each track among those that occur in the rows, -1 for the others."""
    place = np.full(num, -1)
    for box in range(len(row)):
        if first <= row[box] < last:
            place[track[box]] = 0
    count = 0
    for index in range(num):
        if place[index] == 0:
            place[index] = count
            count += 1
    return place


@kernel
def _scatter(  # type: ignore[no-untyped-def]  # compiled; the arrays are those of `Tracks`
    row: IntArray,
    track: IntArray,
    place: IntArray,
    first: int,
    values: tuple[FloatArray, ...],
    valid: BoolArray,
    poses: FloatArray,
    velocities: FloatArray,
    sizes: FloatArray,
):
    """Spread boxes over dense arrays; what no box fills becomes NaN."""
    for box in range(len(row)):
        at = row[box] - first
        if at < 0 or at >= len(valid):
            continue
        to = place[track[box]]
        valid[at, to] = True
        for axis in range(3):
            poses[at, to, axis] = values[axis][box]
        for axis in range(2):
            velocities[at, to, axis] = values[3 + axis][box]
            sizes[at, to, axis] = values[5 + axis][box]
    for at in range(valid.shape[0]):
        for to in range(valid.shape[1]):
            if not valid[at, to]:
                poses[at, to] = np.nan
                velocities[at, to] = np.nan
                sizes[at, to] = np.nan
