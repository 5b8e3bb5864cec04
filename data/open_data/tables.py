"""Columns of Parquet and Arrow files: of the type expected, or refused with the place."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from shiftsim.arrays import FloatArray
from shiftsim.errors import ConversionError, DataError
from shiftsim.world.ranges import OPEN_DATA, require

_MAX_BYTES = 2_000_000_000
_MAX_ROWS = 8_000_000


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of what is made of a file name it."""
    try:
        yield
    except DataError as error:
        if str(path) in error.message:
            raise
        raise type(error)(f"{path}: {error.message}", error.hint) from error


def read_columns(path: Path, wanted: Mapping[str, pa.DataType], hint: str) -> pa.Table:
    """Columns of a Parquet file, or of an Arrow IPC file (`.arrow`), without nulls at the top.

    Args:
        path: The file.
        wanted: Type of each column.
        hint: What to do about a file that is not as expected.

    Raises:
        ConversionError: The file is missing or broken, or a column is missing or of another type.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConversionError(f"{path}: more than {_MAX_BYTES} bytes", "split the recording")
        table = _read(path, list(wanted))
        table.validate(full=True)
    except FileNotFoundError as error:
        raise ConversionError(f"{path} is missing", "copy the whole folder") from error
    except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
        raise ConversionError(f"{path}: cannot be read ({error})", hint) from error
    if len(table) > _MAX_ROWS:
        what = f"{path}: {len(table)} rows, at most {_MAX_ROWS} can be read"
        raise ConversionError(what, "split the recording")
    for name, kind in wanted.items():
        if name not in table.column_names:
            raise ConversionError(f"{path}: column {name!r} is missing", hint)
        found = table.schema.field(name).type
        if found != kind and not (kind == pa.string() and found == pa.large_string()):
            raise ConversionError(f"{path}: column {name!r} is {found}, need {kind}", hint)
    return table


def _read(path: Path, names: list[str]) -> pa.Table:
    if path.suffix != ".arrow":
        file = pq.ParquetFile(path)
        known = [name for name in names if name in file.schema_arrow.names]
        return file.read(known, use_threads=False)
    with pa.OSFile(str(path)) as source:
        schema = pa.ipc.open_file(source).schema
        known_at = [i for i, name in enumerate(schema.names) if name in names]
        options = pa.ipc.IpcReadOptions(included_fields=known_at, use_threads=False)
        return pa.ipc.open_file(source, options=options).read_all()


def numbers(
    table: pa.Table, column: str, field: str, path: Path, *, may_be_nan: bool = False
) -> FloatArray:
    """(R,) a column as float64, all in the range of the field.

    Raises:
        ConversionError: It holds a null, or a value out of range.
    """
    if table[column].null_count:
        what = f"{path}: column {column!r} holds {table[column].null_count} nulls"
        raise ConversionError(what, "leave those rows out")
    values = table[column].to_numpy().astype(np.float64, copy=False)
    require(
        OPEN_DATA,
        field,
        values,
        f"{path}: column {column!r} as",
        error=ConversionError,
        may_be_nan=may_be_nan,
    )
    return values
