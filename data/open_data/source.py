"""A file of an open data set: what is read of it is checked, and faults name it and a remedy."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from shiftsim.arrays import FloatArray, IntArray
from shiftsim.data.lanes.pieces import clean_line
from shiftsim.data.polygons import largest_part
from shiftsim.errors import ConversionError, DataError
from shiftsim.world.ranges import OPEN_DATA, require

REPAIR = "get the file again from its source, or leave the scene out"
_MAX_BYTES = 2_000_000_000
_MAX_ROWS = 8_000_000


class Source:
    """A file, and what to do where it is not as expected."""

    def __init__(self, path: Path, remedy: str = REPAIR) -> None:
        """`remedy` is the hint of all faults that have none of their own."""
        self.path, self.remedy = path, remedy

    def fault(self, what: object, remedy: str = "") -> ConversionError:
        """The error that says what is wrong."""
        return ConversionError(f"{self.path}: {what}", remedy or self.remedy)

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Errors of what is made of the file name it."""
        try:
            yield
        except DataError as error:
            if str(self.path) in error.message:
                raise
            raise type(error)(f"{self.path}: {error.message}", error.hint) from error

    def content(self, max_bytes: int = _MAX_BYTES) -> bytes:
        """All bytes of it."""
        self._require_size(max_bytes)
        try:
            return self.path.read_bytes()
        except OSError as error:
            raise self.fault(f"cannot be read ({error})") from error

    def _require_size(self, max_bytes: int) -> None:
        try:
            size = self.path.stat().st_size
        except FileNotFoundError as error:
            what = f"{self.path} is missing"
            raise ConversionError(what, "copy all files of the scene") from error
        except OSError as error:
            raise self.fault(f"cannot be read ({error})") from error
        if size > max_bytes:
            raise self.fault(f"more than {max_bytes} bytes", "split the recording")

    def number(self, value: Any, field: str, place: str) -> float:
        """A number, or a text that is one, in the range of its field."""
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise self.fault(f"{place} is {value!r}, need a number") from None
        self.require(field, number, place)
        return number

    def require(self, field: str, values: Any, place: str, *, may_be_nan: bool = False) -> None:
        """Numbers are in the range of their field."""
        where = f"{self.path}: {place} as"
        require(OPEN_DATA, field, values, where, error=ConversionError, may_be_nan=may_be_nan)

    def line(self, points: Any, place: str, least: int = 2) -> FloatArray:
        """(K, 2) a line of points (K', 2 or 3) without repeated ones [m]."""
        if len(points) < least:
            raise self.fault(f"{place} has {len(points)} points, need {least}")
        line = np.ascontiguousarray(np.asarray(points, np.float64)[:, :2])
        self.require("position", line, place)
        return clean_line(line)

    def area(self, shape: shapely.Geometry | None, place: str) -> shapely.Polygon:
        """The largest valid part of a polygon."""
        if shape is None or shape.geom_type != "Polygon" or shape.is_empty:
            raise self.fault(f"{place} is no polygon")
        self.require("position", shapely.get_coordinates(shape), place)
        return largest_part(shapely.force_2d(shape))

    def columns(self, wanted: Mapping[str, pa.DataType], prefix: str = "") -> pa.Table:
        """Columns of a Parquet file, or of an Arrow IPC file (`.arrow`), by their plain names.

        Args:
            wanted: Type of each column.
            prefix: What their names begin with in the file.

        Raises:
            ConversionError: The file is missing or broken, or a column is missing or of another
                type.
        """
        self._require_size(_MAX_BYTES)
        names = {f"{prefix}{name}": name for name in wanted}
        try:
            table = _read(self.path, list(names))
            table.validate(full=True)
        except (OSError, ValueError, MemoryError, pa.ArrowException) as error:
            raise self.fault(f"cannot be read ({error})") from error
        if len(table) > _MAX_ROWS:
            what = f"{len(table)} rows, at most {_MAX_ROWS} can be read"
            raise self.fault(what, "split the recording")
        for name, plain in names.items():
            if name not in table.column_names:
                raise self.fault(f"column {name!r} is missing")
            kind, found = wanted[plain], table.schema.field(name).type
            if found != kind and not (kind == pa.string() and found == pa.large_string()):
                raise self.fault(f"column {name!r} is {found}, need {kind}")
        notes = table.schema.metadata
        table = table.select(list(names)).rename_columns(list(names.values()))
        return table.replace_schema_metadata(notes)

    def numbers(self, table: pa.Table, column: str, field: str) -> FloatArray:
        """(R,) a column as float64, all in the range of the field."""
        if count := table[column].null_count:
            raise self.fault(f"column {column!r} holds {count} nulls", "leave those rows out")
        values = table[column].to_numpy().astype(np.float64, copy=False)
        self.require(field, values, f"column {column!r}")
        return values

    def stamps(self, table: pa.Table) -> IntArray:
        """(R,) the column of time stamps [us]."""
        return self.numbers(table, "timestamp_us", "time").astype(np.int64)


def find_below(folder: Path, pattern: str, remedy: str) -> list[Path]:
    """Files of a folder, or below it, sorted; a file itself is the only one."""
    found = [folder] if folder.is_file() else sorted(folder.rglob(pattern))
    if not found:
        raise ConversionError(f"{folder}: no {pattern} below it", remedy)
    return found


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


def text_or_none(value: Any) -> str | None:
    """An id as text."""
    return None if value is None else str(value)
