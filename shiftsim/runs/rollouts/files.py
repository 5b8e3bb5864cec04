"""Files of rollouts: rows of many of them in Parquet.

A worker sends the rows of a rollout as bytes, which wait in the journal; when the run ends they go
into files `part-*.parquet`. Most of the time of writing a small Parquet file goes into headers,
rollouts of one scenario have much in common, and clusters dislike many small files: so rollouts
share row groups, and a `RolloutLocation` says which rows are whose. The first columns name the
task, for readers that know nothing of locations.
"""

import re
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.data.store.tables import write_blocks
from shiftsim.errors import DataError
from shiftsim.runs.rollouts import Task
from shiftsim.runs.rollouts.columns import NOISE_COLUMNS, SEEN, STATES, TRACKS

FOLDER = "rollouts"
_PART = re.compile(r"part-(\d+)\.parquet")
_GROUP, _FILE = 16, 1024  # rollouts of a row group and of a file
_KINDS = {"planner": pa.string(), "noise": pa.string(), "seed": pa.int64(), "token": pa.string()}
_KEY = pa.schema(
    [
        pa.field(name, kind, nullable=False)
        for name, kind in (_KINDS | {"iteration": pa.int64()}).items()
    ]
)


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
        """The rows of a rollout, all columns.

        Raises:
            DataError: The file cannot be read, or does not hold them.
        """
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
            raise DataError(
                f"{str(location.file)!r} cannot be read: {error}", hint="make the run again"
            ) from error

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
        first = 0
        for group in range(self._file.num_row_groups):
            end = first + self._file.metadata.row_group(group).num_rows
            if first <= row < end:
                self._rows = self._file.read_row_group(group, use_threads=False)
                self._first = first
                return
            first = end
        raise IndexError(f"it has no row {row}")


def write_rollouts(
    folder: Path, rollouts: Iterable[tuple[Task, pa.RecordBatch]]
) -> dict[Task, RolloutLocation]:
    """Write rollouts into new files of a folder, and say where they are.

    They have columns of `STATES`, and of `TRACKS` and `SEEN` in all or in none. Columns that name a
    task already are written anew.
    """
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
        schema = pa.schema([*_KEY, *table.schema])
        yield pa.Table.from_arrays([*_keys(group), *table.columns], schema=schema)


def _keys(rollouts: list[tuple[Task, pa.RecordBatch]]) -> list[pa.Array]:
    """The columns of `_KEY`."""
    lengths = [len(rows) for _, rows in rollouts]
    owner = pa.array(np.repeat(np.arange(len(rollouts)), lengths))
    columns = [
        pa.array([getattr(task, name) for task, _ in rollouts], kind).take(owner)
        for name, kind in _KINDS.items()
    ]
    return [*columns, pa.array(np.concatenate([np.arange(length) for length in lengths]))]


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


def new_file(folder: Path) -> Path:
    """A file of rollouts that a folder does not have, numbered after all that it has."""
    taken = [int(found[1]) for path in folder.iterdir() if (found := _PART.fullmatch(path.name))]
    return folder / f"part-{1 + max(taken, default=-1):05d}.parquet"
