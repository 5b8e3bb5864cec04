"""Files of rollouts: rows of many of them in Parquet.

A worker sends the rows of a rollout as bytes, which wait in the journal; when the run ends they go
into files `part-*.parquet`. Most of the time of writing a small Parquet file goes into headers, and
clusters dislike many small files: so rollouts share row groups, and a `Place` says which rows are
whose. The first columns name the task, for readers that know nothing of places.
"""

import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.store.tables import encodings
from shiftsim.errors import DataError
from shiftsim.files import temp_path
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.columns import NOISE_COLUMNS, STATES, TRACKS

FOLDER = "rollouts"
_PART = re.compile(r"part-\d+\.parquet")
_MAX_FILE = 1024, 256 << 20  # rollouts, bytes in memory
_MAX_GROUP = 16, 16 << 20
_REPEATING = ("planner", "noise", "token", "track_tokens", "track_length_m", "track_width_m")
_KINDS = {"planner": pa.string(), "noise": pa.string(), "seed": pa.int64(), "token": pa.string()}
_KEY = pa.schema(
    [
        pa.field(name, kind, nullable=False)
        for name, kind in (_KINDS | {"iteration": pa.int64()}).items()
    ]
)


class Place(NamedTuple):
    """Where a rollout is."""

    file: Path  # the Parquet file
    row: int  # its first row there
    rows: int  # number of its rows


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
            try:
                _check_columns(self._file.schema_arrow)
            except TypeError as error:
                raise _unreadable(place.file, error) from error
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
        batch = rows.to_batches()[0]
        noise = {batch[name].null_count for name in NOISE_COLUMNS}
        for field in batch.schema:
            column = batch[field.name]
            nulls = column.null_count
            if pa.types.is_list(field.type):
                nulls += column.flatten().null_count
            is_left_out = field.name in NOISE_COLUMNS and noise == {len(batch)}
            if nulls and not is_left_out:
                what = f"column {field.name!r} holds {nulls} nulls"
                raise _unreadable(place.file, ValueError(what))
        return batch


def _check_columns(found: pa.Schema) -> None:
    """Check that these are the columns of stored rollouts.

    Raises:
        TypeError: One is missing or has another type.
    """
    for column in [*STATES, *(TRACKS if TRACKS.names[0] in found.names else ())]:
        at = found.get_field_index(column.name)
        if at < 0 or not found.field(at).type.equals(column.type):
            raise TypeError(f"column {column.name!r} is missing or not {column.type}")


class PartWriter:
    """Writes rollouts into new files of a folder; a file is there when it is whole."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._number = next_number(folder)
        self._writer: pq.ParquetWriter | None = None
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
            self._partial = temp_path(self._path)
            self._writer = pq.ParquetWriter(
                self._partial,
                schema,
                compression="zstd",
                compression_level=3,
                **encodings(schema, _REPEATING),
                write_statistics=False,
                store_schema=False,
            )
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
    lengths = [len(rows) for _, rows in rollouts]
    owner = pa.array(np.repeat(np.arange(len(rollouts)), lengths))
    columns = [
        pa.array([getattr(task, name) for task, _ in rollouts], kind).take(owner)
        for name, kind in _KINDS.items()
    ]
    return [*columns, pa.array(np.concatenate([np.arange(length) for length in lengths]))]


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
